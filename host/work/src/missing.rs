//! What is missing from the records read or written, counted by kind.

use cantap_formats::{LeftOut, TraceReader};
use cantap_trace::counted;
use serde_json::{Map, Value};

/// Counts by kind, as in the JSON objects.
pub fn by_kind(counts: &LeftOut) -> Map<String, Value> {
    counts.iter().map(|(what, count)| (what.to_owned(), count.into())).collect()
}

/// What is missing from the records of a file.
#[derive(Clone, Default)]
pub struct Missing {
    /// Places that could not be read.
    pub issues: u64,
    /// What is not part of a CAN trace, by kind.
    pub left_out: LeftOut,
    /// Records that were read.
    pub entries: u64,
    /// Whether compressed data end early or are damaged, so that nobody knows how much was in the rest.
    pub unknown: bool,
}

impl Missing {
    /// For what has been read so far.
    pub fn of(reader: &TraceReader) -> Self {
        Self {
            issues: reader.issues(),
            left_out: reader.left_out().clone(),
            entries: reader.records(),
            unknown: reader.is_of_unknown_length(),
        }
    }

    /// The percentage of the file's entries that is missing; an issue counts as one entry. `None` if nobody can know.
    pub fn share_pct(&self) -> Option<f64> {
        let missing = self.issues + self.left_out.total();
        (!self.unknown).then(|| missing as f64 * 100.0 / (self.entries + missing).max(1) as f64)
    }

    /// Adds those of another file.
    pub fn merge(&mut self, other: &Self) {
        self.issues += other.issues;
        self.left_out.merge(&other.left_out);
        self.entries += other.entries;
        self.unknown |= other.unknown;
    }

    /// Adds the members that every object with `--json` has about what was read.
    pub fn put_into(&self, object: &mut Value) {
        object["issues"] = self.issues.into();
        object["left_out"] = by_kind(&self.left_out).into();
        object["missing_pct"] = self.share_pct().into();
    }

    /// A sentence about it; `None` if nothing is.
    pub fn description(&self) -> Option<String> {
        let places = match self.issues {
            0 => None,
            1 => Some("1 place could not be read".to_owned()),
            issues => Some(format!("{issues} could not be read", issues = counted(issues, "place"))),
        };
        let kinds: Vec<_> = self.left_out.iter().map(|(what, count)| format!("{what} ({count})")).collect();
        let kinds = (!kinds.is_empty()).then(|| format!("no part of a CAN trace: {}", kinds.join(", ")));
        let all: Vec<_> = places.into_iter().chain(kinds).collect();
        let share = match self.share_pct() {
            None => "its compressed data end early, so nobody knows how much is missing".to_owned(),
            Some(share) if share < 0.05 => "less than 0.1 % of the file left out".to_owned(),
            Some(share) => format!("{share:.1} % of the file left out"),
        };
        (!all.is_empty()).then(|| format!("{}; {share}", all.join("; ")))
    }
}
