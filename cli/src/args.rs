//! Values on the command line that several commands share.

use std::time::Duration;

use cantap::Channel;

/// A bit rate in bit/s: `500000`, `500k`, `83.333k`, `1M`.
pub fn bitrate(text: &str) -> Result<u32, String> {
    let (number, factor) = match text.as_bytes().last() {
        Some(b'k' | b'K') => (&text[..text.len() - 1], 1_000.0),
        Some(b'm' | b'M') => (&text[..text.len() - 1], 1_000_000.0),
        _ => (text, 1.0),
    };
    let wrong = || "write a bit rate in bit/s, such as 500000, 500k or 1M".to_owned();
    let digits = number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    let value = if digits { number.parse::<f64>().map_err(|_| wrong())? } else { return Err(wrong()) };
    let bps = (value * factor).round();
    if (1.0..=f64::from(u32::MAX)).contains(&bps) { Ok(bps as u32) } else { Err(wrong()) }
}

/// A time: `400ms`, `3s`, `250us`, `2m`, `1h`, or a number of seconds.
pub fn duration(text: &str) -> Result<Duration, String> {
    let unit_at = text.find(|symbol: char| symbol.is_ascii_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let seconds = match unit {
        "us" => 1e-6,
        "ms" => 1e-3,
        "" | "s" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("write a time with its unit, such as 400ms, 3s or 2m".to_owned()),
    };
    number
        .trim_end()
        .parse::<f64>()
        .ok()
        .and_then(|value| Duration::try_from_secs_f64(value * seconds).ok())
        .ok_or_else(|| "write a time as a number and a unit, such as 400ms, 3s or 2m".to_owned())
}

/// As [`duration`], but longer than nothing.
pub fn positive_duration(text: &str) -> Result<Duration, String> {
    let duration = duration(text)?;
    if duration.is_zero() { Err("give a time longer than zero".to_owned()) } else { Ok(duration) }
}

/// A share in per cent, above 0 and up to 100.
pub fn percent(text: &str) -> Result<f64, String> {
    let number = text.trim_end_matches('%').trim_end().parse::<f64>().ok();
    number
        .filter(|number| *number > 0.0 && *number <= 100.0)
        .ok_or_else(|| "give per cent, above 0 and up to 100".to_owned())
}

/// Channels of a device, as `1`, `2` or `both`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channels(&'static [Channel]);

impl Channels {
    /// One by one.
    pub fn iter(self) -> impl Iterator<Item = Channel> {
        self.0.iter().copied()
    }
}

/// See [`Channels`].
pub fn channels(text: &str) -> Result<Channels, String> {
    match text {
        "1" => Ok(Channels(&[Channel::Can1])),
        "2" => Ok(Channels(&[Channel::Can2])),
        "both" => Ok(Channels(&Channel::ALL)),
        _ => Err("a channel is 1, 2 or both".to_owned()),
    }
}

/// Whether the terminal shows more than ASCII, as far as its environment tells.
pub fn is_utf8_locale() -> bool {
    if cfg!(windows) {
        return true;
    }
    // The first that is set and not empty decides (POSIX.1-2017, 8.2).
    let set = ["LC_ALL", "LC_CTYPE", "LANG"].into_iter().filter_map(|name| std::env::var(name).ok());
    let locale = set.into_iter().find(|value| !value.is_empty()).unwrap_or_default().to_ascii_lowercase();
    locale.contains("utf-8") || locale.contains("utf8")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_need_a_known_unit() {
        assert_eq!(duration("400ms"), Ok(Duration::from_millis(400)));
        assert_eq!(duration("1.5"), Ok(Duration::from_millis(1500)));
        assert_eq!(duration("2m"), Ok(Duration::from_mins(2)));
        for text in ["", "ms", "-1s", "3 weeks", "1e400", "nan"] {
            assert!(duration(text).is_err(), "{text}");
        }
    }

    #[test]
    fn channels_are_one_two_or_both() {
        let numbers = |text| channels(text).map(|channels| channels.iter().map(Channel::number).collect());
        assert_eq!(numbers("2"), Ok(vec![2]));
        assert_eq!(numbers("both"), Ok(vec![1, 2]));
        assert_eq!(numbers("3"), Err("a channel is 1, 2 or both".to_owned()));
    }

    #[test]
    fn bit_rates_take_can_users_units() {
        for (text, bps) in [("500000", 500_000), ("500k", 500_000), ("83.333k", 83_333), ("1M", 1_000_000)] {
            assert_eq!(bitrate(text), Ok(bps), "{text}");
        }
        for text in ["", "0", "fast", "-5", "1e3", "5G", "k", "1.2.3", "inf"] {
            assert!(bitrate(text).is_err(), "{text}");
        }
    }
}
