//! Bit rates and clocks.

/// Below this, in bit/s, the k was probably forgotten. Controllers start at 5000.
const LEAST_BITRATE_BPS: f64 = 1_500.0;

/// A bit rate in bit/s: `500000`, `500k`, `83.333k`, `1M`, `500kbit/s`.
pub fn bit_rate(text: &str) -> Result<u32, String> {
    let bps = per_second(text).ok_or("write a bit rate in bit/s, such as 500000, 500k or 1M")?;
    if f64::from(bps) < LEAST_BITRATE_BPS {
        return Err(format!("{text} bit/s is slower than any CAN bus; write {text}k for {text} kbit/s"));
    }
    Ok(bps)
}

/// A number per second, at least one: bits or clock cycles.
pub fn per_second(text: &str) -> Option<u32> {
    let text = text.trim();
    let units = ["bit/s", "bits/s", "bps", "bit", "Hz", "hz"];
    let text = units.iter().find_map(|unit| text.strip_suffix(unit)).unwrap_or(text).trim_end();
    let (number, factor) = match text.as_bytes().last() {
        Some(b'k' | b'K') => (&text[..text.len() - 1], 1_000.0),
        Some(b'm' | b'M') => (&text[..text.len() - 1], 1_000_000.0),
        _ => (text, 1.0),
    };
    let number = number.trim_end();
    if !number.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.') {
        return None;
    }
    let value = (number.parse::<f64>().ok()? * factor).round();
    (1.0..=f64::from(u32::MAX)).contains(&value).then_some(value as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bit_rates_take_can_users_units() {
        for (text, bps) in [
            ("500000", 500_000),
            ("500k", 500_000),
            ("83.333k", 83_333),
            ("1M", 1_000_000),
            ("0.5M", 500_000),
            ("500 kbit/s", 500_000),
            ("250kbps", 250_000),
        ] {
            assert_eq!(bit_rate(text), Ok(bps), "{text}");
        }
        assert_eq!(per_second("36 MHz"), Some(36_000_000));
        assert_eq!(
            bit_rate("500").unwrap_err(),
            "500 bit/s is slower than any CAN bus; write 500k for 500 kbit/s"
        );
        for text in ["", "0", "fast", "-5", "1e3", "5G", "k", "1.2.3", "inf", "83.333", "500kk", "bit/s"] {
            assert!(bit_rate(text).is_err(), "{text}");
        }
    }

    #[test]
    fn the_slowest_rate_that_is_taken_as_written_is_1500() {
        assert_eq!((bit_rate("1500"), bit_rate("1499").is_err()), (Ok(1_500), true));
    }
}
