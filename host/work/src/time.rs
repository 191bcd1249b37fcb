//! Times as users type them.

use std::time::Duration;

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

/// Like [`duration`], but greater than zero.
pub fn positive_duration(text: &str) -> Result<Duration, String> {
    let duration = duration(text)?;
    if duration.is_zero() { Err("give a time longer than zero".to_owned()) } else { Ok(duration) }
}
