//! Values by their data type (CiA 301, table 44).

use cantap_signals::shortest_of_f32;

use crate::{Bytes, Value};

/// A value of a type; bytes if the type is unknown or does not fit.
pub fn value(data_type: Option<u16>, bytes: &[u8]) -> Value {
    let length = bytes.len();
    let unsigned = || bytes.iter().take(8).rev().fold(0_u64, |number, byte| number << 8 | u64::from(*byte));
    let signed = || {
        let shift = 64 - 8 * length.clamp(1, 8);
        (unsigned() << shift) as i64 >> shift
    };
    match (data_type, length) {
        (Some(0x01), 1..) => Value::Number((bytes[0] & 1).into()),
        (Some(0x02 | 0x03 | 0x04 | 0x10 | 0x12..=0x15), 1..=8) => Value::Number(signed()),
        (Some(0x05 | 0x06 | 0x07 | 0x16 | 0x18..=0x1A), 1..=8) => Value::Number(unsigned() as i64),
        (Some(0x1B), 1..=8) => Value::Hex(unsigned(), 16),
        (Some(0x08), 4) => Value::Real(shortest_of_f32(f32::from_bits(unsigned() as u32))),
        (Some(0x11), 8) => Value::Real(f64::from_bits(unsigned())),
        (Some(0x09), _) => {
            Value::Text(String::from_utf8_lossy(bytes).trim_end_matches('\0').to_owned().into())
        }
        (Some(0x0B), _) => {
            let units = bytes.chunks_exact(2).map(|two| u16::from_le_bytes([two[0], two[1]]));
            let text: String = char::decode_utf16(units).map(|letter| letter.unwrap_or('\u{FFFD}')).collect();
            Value::Text(text.into())
        }
        // Without a type, data that fit in a register are a number, and letters are a text.
        (None, 1..=4) => Value::Hex(unsigned(), 2 * length as u8),
        (None, _)
            if !bytes.is_empty() && bytes.iter().all(|byte| byte.is_ascii_graphic() || *byte == b' ') =>
        {
            Value::Text(String::from_utf8_lossy(bytes).into_owned().into())
        }
        _ => Value::Bytes(Bytes::from_slice(bytes)),
    }
}

/// Whether the type is an integer with a sign.
pub const fn is_signed(data_type: Option<u16>) -> bool {
    matches!(data_type, Some(0x02 | 0x03 | 0x04 | 0x10 | 0x12..=0x15))
}

/// The types of the communication profile's objects, for buses without an EDS.
pub const fn known(index: u16, sub: u8) -> Option<u16> {
    Some(match (index, sub) {
        (0x1008..=0x100A, 0) => 0x09,
        (0x100C | 0x1017 | 0x1015, 0) | (0x1400..=0x15FF | 0x1800..=0x19FF, 3 | 5) => 0x06,
        (0x1001 | 0x100D | 0x1003 | 0x1018 | 0x1400..=0x1BFF, 0) | (0x1400..=0x15FF | 0x1800..=0x19FF, 2) => {
            0x05
        }
        _ => return None,
    })
}

/// The number in at most four bytes, least significant first.
pub fn number_of(bytes: &[u8]) -> u32 {
    bytes.iter().take(4).rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
}
