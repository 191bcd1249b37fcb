//! What a device's gateway has done, as text.

use std::fmt::Write as _;
use std::io::Write;

use cantap::wire::Channel;
use cantap_work::gateway::{Counts, Direction, Named, Row, Sums, other_number};

/// Counts as text.
pub trait AsText {
    /// On one line.
    fn line(&self) -> String;
    /// One row for each rule, and one for each direction.
    fn print(&self, named: &Named, out: &mut impl Write) -> std::io::Result<()>;
}

impl AsText for Counts {
    fn line(&self) -> String {
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

    fn print(&self, named: &Named, out: &mut impl Write) -> std::io::Result<()> {
        let titles = ["matched", "sent", "dropped", "replaced", "lost", "failed"];
        write!(out, "{:<4} {:<20}", "from", "rule")?;
        titles.iter().try_for_each(|title| write!(out, " {title:>8}"))?;
        writeln!(out)?;
        let mut row = |from: Channel, name: &str, sums: &Sums| {
            let Sums { matched, sent, dropped, replaced, lost, failed } = sums;
            write!(out, "{:<4} {name:<20}", from.number())?;
            [matched, sent, dropped, replaced, lost, failed]
                .iter()
                .try_for_each(|count| write!(out, " {count:>8}"))?;
            writeln!(out)
        };
        for (Row { name, from, .. }, sums) in named.rows.iter().zip(&self.rows) {
            row(*from, name, sums)?;
        }
        Channel::ALL.into_iter().try_for_each(|from| row(from, "all", &self.directions[from.index()].sums))
    }
}
