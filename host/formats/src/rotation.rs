//! When a trace continues in a new file.

use std::str::FromStr;
use std::time::Duration;

/// When to begin a new file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RotateAt {
    /// Before the file grows beyond this many bytes.
    Bytes(u64),
    /// When the records in it span this time.
    Time(Duration),
}

/// Not a size or time.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is neither a size such as 100M (k, M, G) nor a time such as 30s, 10m, 1h or 1d")]
pub struct BadRotation(String);

impl FromStr for RotateAt {
    type Err = BadRotation;

    /// A whole number with a unit: k, M, G (powers of 1000, as disks are sold), Ki, Mi, Gi, B; s, m or
    /// min, h, d. Sizes and times differ by unit; `m` is minutes, `M` megabytes.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad = || BadRotation(text.to_owned());
        let digits = text.len() - text.trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let (number, unit) = text.split_at(digits);
        let number: u64 = number.parse().map_err(|_| bad())?;
        let (factor, is_time) = match unit {
            "B" => (1, false),
            "k" | "K" | "kB" | "KB" => (1000, false),
            "M" | "MB" => (1_000_000, false),
            "G" | "GB" => (1_000_000_000, false),
            "Ki" | "KiB" => (1 << 10, false),
            "Mi" | "MiB" => (1 << 20, false),
            "Gi" | "GiB" => (1 << 30, false),
            "s" => (1, true),
            "m" | "min" => (60, true),
            "h" => (3600, true),
            "d" => (86_400, true),
            _ => return Err(bad()),
        };
        let value = number.checked_mul(factor).filter(|value| *value > 0).ok_or_else(bad)?;
        Ok(if is_time { Self::Time(Duration::from_secs(value)) } else { Self::Bytes(value) })
    }
}

/// How to split a trace into files.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Rotation {
    /// Any of these begins a new file; if empty, there is only one file, with the plain name.
    pub at: Vec<RotateAt>,
    /// How many files to keep: older ones of this run are deleted. All, if not given.
    pub keep: Option<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_read_with_their_units() {
        let parse = str::parse::<RotateAt>;
        assert_eq!(parse("100M"), Ok(RotateAt::Bytes(100_000_000)));
        assert_eq!(parse("4KiB"), Ok(RotateAt::Bytes(4096)));
        assert_eq!(parse("1h"), Ok(RotateAt::Time(Duration::from_hours(1))));
        assert_eq!(parse("90m"), Ok(RotateAt::Time(Duration::from_mins(90))));
        for bad in ["", "M", "10", "0M", "1.5h", "-1h", "1 h", "99999999999999999G"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
