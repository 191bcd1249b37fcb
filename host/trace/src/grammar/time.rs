//! How long something takes.

use std::time::Duration;

/// Units, in seconds. The longer of two that begin alike comes first.
const UNITS: [(&str, f64); 9] = [
    ("ns", 1e-9),
    ("us", 1e-6),
    ("µs", 1e-6),
    ("ms", 1e-3),
    ("s", 1.0),
    ("min", 60.0),
    ("m", 60.0),
    ("h", 3_600.0),
    ("d", 86_400.0),
];

/// A time: `400ms`, `3s`, `250us`, `2m`, `1h`, `1d`, several of them as in `1m30s`, `1:30` and `1:02:03` as on a clock, or a number of
/// seconds.
pub fn duration(text: &str) -> Result<Duration, String> {
    let seconds = if text.contains(':') { clock(text) } else { units(text) };
    seconds
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok())
        .ok_or_else(|| "write a time as a number and a unit, such as 400ms, 3s, 2m, 1m30s or 1d".to_owned())
}

/// Like [`duration`], but greater than zero.
pub fn positive_duration(text: &str) -> Result<Duration, String> {
    let duration = duration(text)?;
    if duration.is_zero() { Err("give a time longer than zero".to_owned()) } else { Ok(duration) }
}

/// A decimal number, without sign or exponent.
fn decimal(text: &str) -> Option<f64> {
    let plain = text.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
    text.parse().ok().filter(|_| plain)
}

/// Seconds, or numbers with units, the longest first.
fn units(text: &str) -> Option<f64> {
    let mut rest = text.trim();
    if let Some(seconds) = decimal(rest) {
        return Some(seconds);
    }
    let mut sum = 0.0;
    let mut before = f64::INFINITY;
    while !rest.is_empty() {
        let number_end = rest.find(|character: char| !character.is_ascii_digit() && character != '.')?;
        let (number, behind) = rest.split_at(number_end);
        let behind = behind.trim_start();
        let unit_end = behind.find(|character: char| !character.is_alphabetic()).unwrap_or(behind.len());
        let (unit, behind) = behind.split_at(unit_end);
        let (_, seconds) = UNITS.into_iter().find(|(name, _)| *name == unit)?;
        if seconds >= before {
            return None;
        }
        before = seconds;
        sum += decimal(number)? * seconds;
        rest = behind.trim_start();
    }
    (before < f64::INFINITY).then_some(sum)
}

/// Minutes and seconds, or hours, minutes and seconds.
fn clock(text: &str) -> Option<f64> {
    let parts: Vec<&str> = text.split(':').collect();
    let (seconds, before) = parts.split_last()?;
    let whole =
        |part: &&str| part.parse::<u32>().ok().filter(|_| part.bytes().all(|byte| byte.is_ascii_digit()));
    let (hours, minutes) = match before {
        [minutes] => (0, whole(minutes)?),
        [hours, minutes] => (whole(hours)?, whole(minutes).filter(|minutes| *minutes < 60)?),
        _ => return None,
    };
    let seconds = decimal(seconds).filter(|seconds| *seconds < 60.0)?;
    Some(f64::from(hours) * 3_600.0 + f64::from(minutes) * 60.0 + seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_units_and_may_have_several() {
        for (text, ms) in [
            ("400ms", 400),
            ("1.5", 1_500),
            ("2m", 120_000),
            ("2 min", 120_000),
            ("1m30s", 90_000),
            ("1h 1m 1s", 3_661_000),
            ("1d", 86_400_000),
            ("1:30", 90_000),
            ("1:02:03.5", 3_723_500),
            ("1500us", 1),
        ] {
            assert_eq!(duration(text).map(|time| time.as_millis()), Ok(ms), "{text}");
        }
        assert_eq!(duration("250µs"), Ok(Duration::from_micros(250)));
        assert_eq!(duration("100ns"), Ok(Duration::from_nanos(100)));
        for text in [
            "", "ms", "-1s", "3 weeks", "1e400", "nan", "inf", "1s1m", "1s2s", "1:60", "1:2:3:4", ":", "1s5",
            "1..2s",
        ] {
            assert!(duration(text).is_err(), "{text}");
        }
        assert_eq!(positive_duration("0s").unwrap_err(), "give a time longer than zero");
    }

    #[test]
    fn sixty_seconds_are_a_minute_and_sixty_minutes_an_hour() {
        assert_eq!(
            (duration("1:59.5").map(|time| time.as_millis()), duration("1:59:00").map(|time| time.as_secs())),
            (Ok(119_500), Ok(7_140))
        );
        assert_eq!(duration("90:00").map(|time| time.as_secs()), Ok(5_400));
        assert!(duration("1:60:00").is_err() && duration("1:00:60").is_err() && duration("0:60").is_err());
    }
}
