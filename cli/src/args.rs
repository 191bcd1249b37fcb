//! Values on the command line that several commands share.

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

#[cfg(test)]
mod tests {
    use super::*;

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
