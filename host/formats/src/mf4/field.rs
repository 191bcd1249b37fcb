//! Fields: where a record has a channel's raw value, and the number, text or bytes there.

use super::blocks::{Block, u32_at};
use super::value::Value;

/// A field of a record.
#[derive(Clone, Copy, Debug)]
pub(super) struct Field {
    at: usize,
    bit: u8,
    bits: u32,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Integer {
        big_endian: bool,
        signed: bool,
    },
    Float {
        big_endian: bool,
    },
    /// ISO 8859-1 or UTF-8.
    Text {
        is_latin: bool,
    },
    Utf16 {
        big_endian: bool,
    },
    Bytes,
}

impl Kind {
    fn of(channel: &Block) -> Self {
        match channel.data.get(2) {
            Some(0) => Self::Integer { big_endian: false, signed: false },
            Some(1) => Self::Integer { big_endian: true, signed: false },
            Some(2) => Self::Integer { big_endian: false, signed: true },
            Some(3) => Self::Integer { big_endian: true, signed: true },
            Some(4) => Self::Float { big_endian: false },
            Some(5) => Self::Float { big_endian: true },
            Some(6) => Self::Text { is_latin: true },
            Some(7) => Self::Text { is_latin: false },
            Some(8) => Self::Utf16 { big_endian: false },
            Some(9) => Self::Utf16 { big_endian: true },
            _ => Self::Bytes,
        }
    }
}

impl Field {
    /// The value of a channel, which is in the record.
    pub(super) fn of(channel: &Block) -> Self {
        Self { kind: Kind::of(channel), ..Self::place_of_value(channel) }
    }

    /// Of a channel whose values are elsewhere: where the record says at which place. That is an unsigned number, whatever the type of the
    /// values.
    pub(super) fn place_of_value(channel: &Block) -> Self {
        let data = &channel.data;
        let kind = Kind::Integer { big_endian: false, signed: false };
        let bit = data.get(3).copied().unwrap_or(0) & 7;
        Self { at: u32_at(data, 4) as usize, bit, bits: u32_at(data, 8), kind }
    }

    /// The whole of a value that is elsewhere.
    pub(super) fn of_whole(channel: &Block, value: &[u8]) -> Self {
        Self { at: 0, bit: 0, bits: 8 * value.len() as u32, kind: Kind::of(channel) }
    }

    /// The same field with another length, in bits.
    pub(super) fn with_bits(self, bits: u32) -> Self {
        Self { bits, ..self }
    }

    pub(super) fn bits(&self) -> u32 {
        self.bits
    }

    /// Whether its raw value is a number without a sign.
    pub(super) fn is_unsigned(&self) -> bool {
        matches!(self.kind, Kind::Integer { signed: false, .. })
    }

    /// The bytes of a text or of a byte array.
    pub(super) fn bytes<'a>(&self, record: &'a [u8]) -> Option<&'a [u8]> {
        record.get(self.at..)?.get(..self.bits as usize / 8)
    }

    /// A number's bits, at most 64 of them; `None` if it is not an integer or lies outside the record.
    pub(super) fn unsigned(&self, record: &[u8]) -> Option<u64> {
        let Kind::Integer { big_endian, .. } = self.kind else { return None };
        self.bits_of(record, big_endian)
    }

    #[inline]
    fn bits_of(&self, record: &[u8], big_endian: bool) -> Option<u64> {
        if self.bits == 0 || self.bits > 64 {
            return None;
        }
        let mask = u64::MAX >> (64 - self.bits);
        let end = u32::from(self.bit) + self.bits;
        if !big_endian
            && end <= 64
            && let Some(word) = record.get(self.at..).and_then(<[u8]>::first_chunk)
        {
            return Some(u64::from_le_bytes(*word) >> self.bit & mask);
        }
        let len = end.div_ceil(8) as usize;
        let bytes = record.get(self.at..)?.get(..len)?;
        let join = |value: u128, byte: &u8| value << 8 | u128::from(*byte);
        let all = if big_endian { bytes.iter().fold(0, join) } else { bytes.iter().rev().fold(0, join) };
        Some((all >> self.bit) as u64 & mask)
    }

    /// Where its number stands in each record of this length; `None` where [`Self::unsigned`] has more to do than to look there.
    pub(super) fn place(&self, record_bytes: usize) -> Option<Place> {
        let Kind::Integer { big_endian: false, .. } = self.kind else { return None };
        let end = u32::from(self.bit) + self.bits;
        let is_inside = self.at.checked_add(end.div_ceil(8) as usize)? <= record_bytes;
        let is_word = self.bits > 0 && end <= 64;
        (is_inside && is_word).then(|| Place {
            at: self.at,
            bit: self.bit,
            mask: u64::MAX >> (64 - self.bits),
        })
    }

    /// As [`Self::place`], if its highest bit is not a sign that the rest of a word would lack.
    pub(super) fn counter(&self, record_bytes: usize) -> Option<Place> {
        let is_signed = matches!(self.kind, Kind::Integer { signed: true, .. });
        self.place(record_bytes).filter(|_| !is_signed || self.bits == 64)
    }

    /// Where a floating-point number of eight bytes is.
    pub(super) fn double(&self, record_bytes: usize) -> Option<usize> {
        let is_double = self.kind == Kind::Float { big_endian: false } && self.bits == 64 && self.bit == 0;
        self.span(record_bytes).filter(|_| is_double).map(|(at, _)| at)
    }

    /// Where its bytes begin, and how many there are; `None` if not all are inside a record of this length.
    pub(super) fn span(&self, record_bytes: usize) -> Option<(usize, usize)> {
        let len = self.bits as usize / 8;
        (self.at.checked_add(len)? <= record_bytes).then_some((self.at, len))
    }

    /// The raw value; `None` if it is not inside the record or has a length that its type cannot have.
    pub(super) fn value(&self, record: &[u8]) -> Option<Value> {
        match self.kind {
            Kind::Integer { signed: false, .. } => self.unsigned(record).map(Value::Unsigned),
            Kind::Integer { signed: true, .. } => self.signed(record).map(Value::Signed),
            Kind::Float { .. } => self.float(record).map(Value::Float),
            Kind::Text { is_latin } => {
                let bytes = self.bytes(record)?.split(|byte| *byte == 0).next()?;
                Some(Value::Text(if is_latin {
                    bytes.iter().map(|byte| char::from(*byte)).collect()
                } else {
                    String::from_utf8_lossy(bytes).into_owned()
                }))
            }
            Kind::Utf16 { big_endian } => {
                let units = self.bytes(record)?.chunks_exact(2).filter_map(<[u8]>::first_chunk);
                let units =
                    units.map(
                        |unit| if big_endian { u16::from_be_bytes(*unit) } else { u16::from_le_bytes(*unit) },
                    );
                let units: Vec<_> = units.take_while(|unit| *unit != 0).collect();
                Some(Value::Text(String::from_utf16_lossy(&units)))
            }
            // Bytes that stand for a text, which a few programs write.
            Kind::Bytes => {
                let bytes = self.bytes(record)?.split(|byte| *byte == 0).next()?;
                Some(Value::Text(String::from_utf8_lossy(bytes).into_owned()))
            }
        }
    }

    /// A signed integer, exactly.
    #[inline]
    pub(super) fn signed(&self, record: &[u8]) -> Option<i64> {
        let Kind::Integer { big_endian, signed } = self.kind else { return None };
        let bits = self.bits_of(record, big_endian)?;
        let unused = 64 - self.bits;
        if signed { Some((bits << unused).cast_signed() >> unused) } else { i64::try_from(bits).ok() }
    }

    pub(super) fn float(&self, record: &[u8]) -> Option<f64> {
        let Kind::Float { big_endian } = self.kind else { return None };
        let bits = self.bits_of(record, big_endian)?;
        match self.bits {
            16 => Some(half(bits as u16)),
            32 => Some(f64::from(f32::from_bits(bits as u32))),
            64 => Some(f64::from_bits(bits)),
            _ => None,
        }
    }
}

/// A floating-point number of 16 bits (IEEE 754 binary16).
fn half(bits: u16) -> f64 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 0x3FF));
    let sign = if bits >> 15 == 1 { -1.0 } else { 1.0 };
    sign * match exponent {
        0 => fraction * 2_f64.powi(-24),
        31 if fraction > 0.0 => f64::NAN,
        31 => f64::INFINITY,
        _ => (1024.0 + fraction) * 2_f64.powi(exponent - 25),
    }
}

/// Where a number stands, in a word of eight bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    at: usize,
    bit: u8,
    mask: u64,
}

impl Place {
    /// So many bytes must be there behind the place.
    pub(super) const BYTES: usize = 8;

    /// The number; 0 if there are fewer bytes.
    #[inline]
    pub(super) fn get(&self, bytes: &[u8]) -> u64 {
        let word = bytes.get(self.at..).and_then(<[u8]>::first_chunk);
        word.map_or(0, |word| u64::from_le_bytes(*word) >> self.bit & self.mask)
    }
}
