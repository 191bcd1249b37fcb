//! How much is measured.

/// What to measure, and for how long.
pub struct Extent<'a> {
    /// Only rows whose names contain this.
    pub rows: &'a str,
    /// Measure for a tenth of the time, or a fifth of the size.
    pub quick: bool,
    /// How many times as long a trace is.
    pub times: u64,
}

impl Extent<'_> {
    /// Whether the row of this name is wanted.
    pub fn wants(&self, row: &str) -> bool {
        row.contains(self.rows)
    }

    /// A time, shortened if it must be quick.
    pub fn shortened(&self, time: u64) -> u64 {
        if self.quick { time / 10 } else { time }
    }
}
