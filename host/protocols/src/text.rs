//! Events as text: `uds 7E0 > 7E8 ReadDataByIdentifier: did 0xF190 (VIN), value "…", after 2.5 ms`.
//!
//! A long trace has millions of them, so numbers are written without the machinery of `fmt`.

use std::borrow::Cow;
use std::fmt::{self, Write as _};

use crate::event::{Event, Field, Party, Value};

const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
/// Positions have seven decimals.
const UNITS: u64 = 10_000_000;

impl Event {
    /// Appends it, without time and channel.
    pub fn push_to(&self, out: &mut String) {
        out.push_str(self.protocol.name());
        out.push(' ');
        self.from.push_to(out);
        if self.to != Party::Unknown {
            out.push_str(" > ");
            self.to.push_to(out);
        }
        out.push(' ');
        out.push_str(&self.title);
        for (at, field) in self.fields.iter().enumerate() {
            out.push_str(if at == 0 { ": " } else { ", " });
            push_field(out, field);
        }
        if let Some(response_ns) = self.response_ns {
            out.push_str(if self.fields.is_empty() { ": after " } else { ", after " });
            push_real(out, response_ns as f64 / 1e6);
            out.push_str(" ms");
        }
        if let Some(trouble) = &self.trouble {
            // Writing to a String cannot fail.
            let _ = write!(out, "; {trouble}");
        }
        if self.frames_lost {
            out.push_str("; frames were lost meanwhile");
        }
    }
}

impl Field {
    /// What a table has beside the number: what the value stands for, or the value itself if it is a text, bytes as `0A F1`, or `not available`.
    /// A text that stands for something is followed by that: `P0133 (O2 sensor slow response)`.
    pub fn text_for_tables(&self) -> Option<Cow<'_, str>> {
        let own = match &self.value {
            Value::Text(text) => Some(Cow::Borrowed(&**text)),
            Value::Bytes(bytes) => Some(hex(bytes).into()),
            Value::Missing => Some("not available".into()),
            Value::Number(_) | Value::Hex(..) | Value::Real(_) => None,
        };
        match (own, &self.text) {
            (Some(own), Some(text)) => Some(format!("{own} ({text})").into()),
            (own, text) => own.or_else(|| text.as_deref().map(Cow::Borrowed)),
        }
    }
}

impl Party {
    /// Appends it: `7E0`, `6F1/12`, `5`, `all`; `?` if unknown.
    pub fn push_to(self, out: &mut String) {
        match self {
            Self::Unknown => out.push('?'),
            Self::Everyone => out.push_str("all"),
            Self::Id(id) => push_hex(out, id.raw().into(), if id.is_extended() { 8 } else { 3 }),
            Self::Addressed(id, address) => {
                Self::Id(id).push_to(out);
                out.push('/');
                push_hex(out, address.into(), 2);
            }
            Self::Node(node) => push_number(out, node),
        }
    }
}

fn push_value(out: &mut String, value: &Value) {
    match value {
        Value::Number(value) => push_number(out, *value),
        Value::Hex(value, digits) => {
            out.push_str("0x");
            push_hex(out, *value, (*digits).into());
        }
        Value::Real(value) => push_real(out, *value),
        Value::Text(text) => {
            out.push('"');
            let plain = |byte: u8| matches!(byte, b' '..=b'~') && !matches!(byte, b'"' | b'\'' | b'\\');
            if text.bytes().all(plain) {
                out.push_str(text);
            } else {
                out.extend(text.escape_debug());
            }
            out.push('"');
        }
        Value::Bytes(bytes) if bytes.is_empty() => out.push_str("nothing"),
        Value::Bytes(bytes) => push_bytes(out, bytes),
        Value::Missing => out.push_str("not available"),
    }
}

/// `did 0xF190 (VIN)`.
fn push_field(out: &mut String, field: &Field) {
    out.push_str(&field.name);
    out.push(' ');
    push_value(out, &field.value);
    if !field.unit.is_empty() && field.value != Value::Missing {
        out.push(' ');
        out.push_str(&field.unit);
    }
    if let Some(text) = &field.text {
        out.push_str(" (");
        out.push_str(text);
        out.push(')');
    }
}

fn push_number(out: &mut String, number: impl itoa::Integer) {
    out.push_str(itoa::Buffer::new().format(number));
}

/// With at least this many digits.
fn push_hex(out: &mut String, value: u64, digits: usize) {
    let needed = (64 - value.leading_zeros() as usize).div_ceil(4).max(1);
    out.extend(std::iter::repeat_n('0', digits.saturating_sub(needed)));
    for at in (0..needed).rev() {
        out.push(char::from(DIGITS[(value >> (at * 4) & 15) as usize]));
    }
}

/// `62 F1 90`.
fn push_bytes(out: &mut String, bytes: &[u8]) {
    out.reserve(bytes.len() * 3);
    for (at, byte) in bytes.iter().enumerate() {
        if at > 0 {
            out.push(' ');
        }
        out.push(char::from(DIGITS[usize::from(byte >> 4)]));
        out.push(char::from(DIGITS[usize::from(byte & 15)]));
    }
}

/// At most seven decimals, without trailing zeros; with an exponent what would be long, or zero.
fn push_real(out: &mut String, value: f64) {
    let units = (value.abs() * UNITS as f64).round();
    // Above this, the product's own rounding would show in the last decimal.
    let fits = units < 1e15;
    if !fits || (units == 0.0 && value != 0.0) {
        // Writing to a String cannot fail.
        let _ = if value.abs() < 1e15 && units != 0.0 {
            let text = format!("{value:.7}");
            out.write_str(text.trim_end_matches('0').trim_end_matches('.'))
        } else {
            write!(out, "{value:e}")
        };
        return;
    }
    let units = units as u64;
    if value < 0.0 {
        out.push('-');
    }
    push_number(out, units / UNITS);
    let mut rest = units % UNITS;
    if rest > 0 {
        out.push('.');
        let mut place = UNITS / 10;
        while rest > 0 {
            out.push(char::from(b'0' + (rest / place) as u8));
            rest %= place;
            place /= 10;
        }
    }
}

/// `62 F1 90`.
pub(crate) fn hex(bytes: &[u8]) -> String {
    let mut text = String::new();
    push_bytes(&mut text, bytes);
    text
}

/// What `push` appends.
fn display(f: &mut fmt::Formatter<'_>, push: impl FnOnce(&mut String)) -> fmt::Result {
    let mut text = String::new();
    push(&mut text);
    f.write_str(&text)
}

impl fmt::Display for Party {
    /// `7E0`, `6F1/12`, `5`, `all`; `?` if unknown.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |out| self.push_to(out))
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |out| push_value(out, self))
    }
}

impl fmt::Display for Field {
    /// `did 0xF190 (VIN)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |out| push_field(out, self))
    }
}

impl fmt::Display for Event {
    /// Without time and channel: `uds 7E0 > 7E8 ReadDataByIdentifier: did 0xF190 (VIN), value "…"`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        display(f, |out| self.push_to(out))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn real(value: f64) -> String {
        Value::Real(value).to_string()
    }

    #[test]
    fn reals_have_the_decimals_that_they_need() {
        for (value, expected) in [
            (0.0, "0"),
            (-0.0, "0"),
            (0.1 + 0.2, "0.3"),
            (-12.5, "-12.5"),
            (1726.0, "1726"),
            (53.123_456_78, "53.1234568"),
            (0.000_000_1, "0.0000001"),
            (1e-9, "1e-9"),
            (-1e-9, "-1e-9"),
            (99_999_999.999_999_9, "99999999.9999999"),
            (1e12 + 0.5, "1000000000000.5"),
            (1e15, "1e15"),
            (f64::NEG_INFINITY, "-inf"),
        ] {
            assert_eq!(real(value), expected);
        }
        assert_eq!(real(f64::NAN), "NaN");
    }

    /// Rust's own digits are the judge, but for the last one of a value that is half way between two.
    #[test]
    fn reals_are_rounded_as_by_fmt() {
        let mut random = fastrand::Rng::with_seed(7);
        for round in 0..200_000 {
            let scale = 10_f64.powi(random.i32(-6..=15));
            let digits = random.i64(-1_000_000_000..=1_000_000_000);
            let value = if round % 2 == 0 {
                digits as f64 / 10_f64.powi(random.i32(0..=7))
            } else {
                (random.f64() - 0.5) * scale
            };
            let (ours, fmt) = (real(value), format!("{value:.7}"));
            let fmt = fmt.trim_end_matches('0').trim_end_matches('.');
            if ours != fmt && !ours.contains('e') {
                let (ours, value) = (ours.parse::<f64>().unwrap(), value);
                let half = 0.5e-7 + value.abs() * f64::EPSILON;
                assert!((ours - value).abs() <= half, "{ours} instead of {fmt}");
                assert!(round % 2 == 1, "{ours} instead of {fmt}");
            }
        }
    }

    #[test]
    fn numbers_in_hexadecimal_have_at_least_their_digits() {
        for (value, digits, expected) in [
            (0, 0, "0x0"),
            (0xF190, 4, "0xF190"),
            (0x5, 2, "0x05"),
            (0x12345, 4, "0x12345"),
            (u64::MAX, 16, "0xFFFFFFFFFFFFFFFF"),
        ] {
            assert_eq!(Value::Hex(value, digits).to_string(), expected);
        }
    }

    #[test]
    fn texts_are_quoted_so_that_their_end_is_known() {
        let text = |text: &'static str| Value::Text(text.into()).to_string();
        assert_eq!(text("ECU 5"), "\"ECU 5\"");
        assert_eq!(text("a\"b\\\n"), "\"a\\\"b\\\\\\n\"");
        assert_eq!(text("Öl"), "\"Öl\"");
    }
}
