//! What is missing from the records read or written, counted by kind.

use cantap_formats::{LeftOut, TraceReader};
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
}

impl Missing {
    /// For what has been read so far.
    pub fn of(reader: &TraceReader) -> Self {
        Self { issues: reader.issues(), left_out: reader.left_out().clone(), entries: reader.records() }
    }

    /// The percentage of the file's entries that is missing; an issue counts as one entry.
    pub fn share_pct(&self) -> f64 {
        let missing = self.issues + self.left_out.total();
        missing as f64 * 100.0 / (self.entries + missing).max(1) as f64
    }

    /// Adds those of another file.
    pub fn merge(&mut self, other: &Self) {
        self.issues += other.issues;
        self.left_out.merge(&other.left_out);
        self.entries += other.entries;
    }

    /// Adds the members that every object with `--json` has about what was read.
    pub fn put_into(&self, object: &mut Value) {
        object["issues"] = self.issues.into();
        object["left_out"] = by_kind(&self.left_out).into();
        object["missing_pct"] = self.share_pct().into();
    }

    /// What is missing, in words; `None` if nothing is.
    pub fn in_words(&self) -> Option<String> {
        let places = match self.issues {
            0 => None,
            1 => Some("1 place could not be read".to_owned()),
            issues => Some(format!("{issues} places could not be read")),
        };
        let kinds: Vec<_> = self.left_out.iter().map(|(what, count)| format!("{what} ({count})")).collect();
        let kinds = (!kinds.is_empty()).then(|| format!("no part of a CAN trace: {}", kinds.join(", ")));
        let all: Vec<_> = places.into_iter().chain(kinds).collect();
        let few = if self.share_pct() < 0.05 {
            "less than 0.1".to_owned()
        } else {
            format!("{:.1}", self.share_pct())
        };
        (!all.is_empty()).then(|| format!("{}; {few} % of the file left out", all.join("; ")))
    }
}
