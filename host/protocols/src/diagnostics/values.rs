//! Forms that several services have in common: numbers, sets of numbers, texts.

use std::fmt::Write as _;

use crate::{Bytes, Field, Value};

/// An integer that is shown in decimal where that is possible: fields have 63 bits for it.
pub fn unsigned(name: &'static str, value: u64) -> Field {
    i64::try_from(value).map_or_else(|_| Field::hex(name, value, 16), |value| Field::number(name, value))
}

pub fn number(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

/// The numbers whose bits are set.
pub fn supported(first: u8, bytes: &[u8]) -> String {
    let bits = number(bytes);
    let mut text = String::new();
    for bit in 0..32_u8 {
        if bits >> (31 - bit) & 1 == 1 {
            // Writing to a String cannot fail.
            let _ =
                write!(text, "{}{:02X}", if text.is_empty() { "" } else { " " }, first.wrapping_add(bit + 1));
        }
    }
    text
}

/// Bytes as text if they are text, otherwise unchanged.
pub fn text_or_bytes(bytes: &[u8]) -> Value {
    let end =
        bytes.iter().rposition(|byte| *byte != 0 && *byte != b' ' && *byte != 0xFF).map_or(0, |at| at + 1);
    let shown = &bytes[..end];
    if shown.len() >= 3 && shown.iter().all(|byte| byte.is_ascii_graphic() || *byte == b' ') {
        Value::Text(String::from_utf8_lossy(shown).into_owned().into())
    } else {
        Value::Bytes(Bytes::from_slice(bytes))
    }
}
