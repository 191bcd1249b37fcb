//! Times of records as text.

/// Seconds with six decimals, or nine if the trace has them.
/// ```
/// use cantap_trace::Seconds;
///
/// assert_eq!(Seconds(1_500_000_000).to_string(), "1.500000");
/// assert_eq!(Seconds(-1).to_string(), "-0.000000001");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seconds(
    /// Nanoseconds.
    pub i64,
);

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_have_six_decimals_or_nine() {
        for (ns, text) in [
            (0, "0.000000"),
            (1_500_000_000, "1.500000"),
            (61_000_001_000, "61.000001"),
            (1_000_000_001, "1.000000001"),
            (-1, "-0.000000001"),
            (-1_500_000_000, "-1.500000"),
            (i64::MIN, "-9223372036.854775808"),
        ] {
            assert_eq!(Seconds(ns).to_string(), text);
        }
    }
}
