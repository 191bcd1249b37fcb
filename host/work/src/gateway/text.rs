//! What modifies a frame, as users write it: alike in `cantap send` and in a file of rules.

use cantap::wire::message::{Checksum, Modifier};

/// `BYTE` or `BYTE.LOWBIT:BITS`.
pub fn counter(text: &str) -> Result<Modifier, String> {
    let wrong = || "write a counter as BYTE or BYTE.LOWBIT:BITS, such as 7 or 7.0:4".to_owned();
    let number = |text: &str| text.parse::<u8>().map_err(|_| wrong());
    let Some((byte, bits)) = text.split_once('.') else {
        return Ok(Modifier::Counter { byte: number(text)?, low_bit: 0, bits: 8 });
    };
    let (low_bit, bits) = bits.split_once(':').ok_or_else(wrong)?;
    Ok(Modifier::Counter { byte: number(byte)?, low_bit: number(low_bit)?, bits: number(bits)? })
}

/// `BYTE:KIND`.
pub fn checksum(text: &str) -> Result<Modifier, String> {
    let parts = text.split_once(':').and_then(|(byte, kind)| {
        let algorithm = match kind {
            "xor" => Checksum::Xor,
            "sum" => Checksum::Sum,
            "crc8" => Checksum::Crc8J1850,
            _ => return None,
        };
        Some(Modifier::Checksum { byte: byte.parse().ok()?, algorithm })
    });
    parts.ok_or_else(|| "write a checksum as BYTE:xor, BYTE:sum or BYTE:crc8".to_owned())
}

/// Up to eight bytes; `?` stands for a digit that stays. Blanks and dots may separate bytes. Returns the bits that are given, and their values.
pub(super) fn bytes(text: &str) -> Result<([u8; 8], [u8; 8]), String> {
    let wrong = || {
        "write up to 8 bytes in hexadecimal, such as 11.22.33, with ? for a digit that stays, such as ??.2?"
            .to_owned()
    };
    let digits: Vec<_> = text.chars().filter(|character| !matches!(character, ' ' | '.')).collect();
    if digits.is_empty() || digits.len() % 2 != 0 || digits.len() > 16 {
        return Err(wrong());
    }
    let (mut given, mut values) = ([0; 8], [0; 8]);
    for (at, digit) in digits.into_iter().enumerate() {
        let shift = if at % 2 == 0 { 4 } else { 0 };
        if digit != '?' {
            given[at / 2] |= 0xF << shift;
            values[at / 2] |= u8::try_from(digit.to_digit(16).ok_or_else(wrong)?).unwrap_or(0) << shift;
        }
    }
    Ok((given, values))
}
