//! Times of records as text.

/// Seconds with six decimals, or nine if the trace has them.
pub struct Seconds(pub i64);

impl std::fmt::Display for Seconds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let (seconds, ns) = (self.0.unsigned_abs() / 1_000_000_000, self.0.unsigned_abs() % 1_000_000_000);
        if ns % 1000 == 0 {
            write!(f, "{sign}{seconds}.{:06}", ns / 1000)
        } else {
            write!(f, "{sign}{seconds}.{ns:09}")
        }
    }
}
