//! What a device's gateway has done, as text.

use std::fmt::Write as _;

use cantap::wire::Channel;

use super::counts::{Counts, Direction, Named, Row, Sums, other_number};

impl Counts {
    /// Both directions on one line.
    pub fn line(&self) -> String {
        let direction = |from: Channel| {
            let Direction { sums, unmatched, waiting } = &self.directions[from.index()];
            let mut text = format!(
                "{}>{}: {} received, {} sent",
                from.number(),
                other_number(from),
                sums.matched + unmatched,
                sums.sent
            );
            for (count, of) in [
                (*unmatched, "unmatched"),
                (sums.dropped, "dropped"),
                (sums.replaced, "replaced"),
                (sums.lost, "LOST"),
                (sums.failed, "FAILED"),
                (u64::from(*waiting), "waiting"),
            ] {
                if count > 0 {
                    let _ = write!(text, ", {count} {of}");
                }
            }
            text
        };
        Channel::ALL.map(direction).join("; ")
    }

    /// A heading, a row for each rule, and one for each direction.
    pub fn table(&self, named: &Named) -> Vec<String> {
        let mut heading = format!("{:<4} {:<20}", "from", "rule");
        for title in ["matched", "sent", "dropped", "replaced", "lost", "failed"] {
            let _ = write!(heading, " {title:>8}");
        }
        let row = |from: Channel, name: &str, sums: &Sums| {
            let Sums { matched, sent, dropped, replaced, lost, failed } = sums;
            let mut text = format!("{:<4} {name:<20}", from.number());
            for count in [matched, sent, dropped, replaced, lost, failed] {
                let _ = write!(text, " {count:>8}");
            }
            text
        };
        let rules = named.rows.iter().zip(&self.rows);
        let rules = rules.map(|(Row { name, from, .. }, sums)| row(*from, name, sums));
        let all = |from: Channel| row(from, "all", &self.directions[from.index()].sums);
        std::iter::once(heading).chain(rules).chain(Channel::ALL.map(all)).collect()
    }
}
