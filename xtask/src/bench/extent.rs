//! How much is measured on the emulated board.

/// What is measured of it, and for how long.
pub struct Extent<'a> {
    /// Only rows whose names contain this.
    pub rows: &'a str,
    /// For a tenth of the time.
    pub quick: bool,
}

impl Extent<'_> {
    /// Whether the row of this name is wanted.
    pub fn wants(&self, row: &str) -> bool {
        row.contains(self.rows)
    }

    /// A time, or what is left of it if it must be quick.
    pub fn shortened(&self, time: u64) -> u64 {
        if self.quick { time / 10 } else { time }
    }
}
