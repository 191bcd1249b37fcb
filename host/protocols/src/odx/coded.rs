//! Internal values, out of the bytes of a message.

use encoding_rs::{ISO_8859_2, UTF_16BE, UTF_16LE, WINDOWS_1252};

use super::model::{BaseType, Coded, Coding, Internal};

/// The longest integer.
const MOST_BITS: u32 = 64;

/// Why there is no value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Stop {
    /// The message ends before it.
    #[error("the message is shorter than its description")]
    Ends,
    /// It is another message: a constant differs.
    #[error("a constant differs")]
    Differs,
    /// What it is cannot be said.
    #[error("not evaluated: {0}")]
    NotEvaluated(String),
}

impl Stop {
    /// For this reason.
    pub(super) fn not_evaluated(what: impl Into<String>) -> Self {
        Self::NotEvaluated(what.into())
    }
}

/// The value of so many bits at this place, by which it is told how many bytes it takes.
///
/// A number's bytes are turned around if its order is Intel's, then it begins at the bit, counted from the least significant one
/// (ISO 22901-1, 7.3.6.3).
pub fn extract(
    coded: &Coded,
    data: &[u8],
    byte: usize,
    bit: u32,
    bits: u64,
) -> Result<(Internal, usize), Stop> {
    if bits == 0 {
        let empty = match coded.base {
            BaseType::Int | BaseType::Uint => Internal::Int(0),
            BaseType::Float32 | BaseType::Float64 => Internal::Real(0.0),
            BaseType::Bytes => Internal::Bytes(Vec::new()),
            BaseType::Ascii | BaseType::Utf8 | BaseType::Unicode => Internal::Text(String::new()),
        };
        return Ok((empty, 0));
    }
    if bit > 7 {
        return Err(Stop::not_evaluated(format!("bit position {bit}")));
    }
    let length = usize::try_from((bits + u64::from(bit)).div_ceil(8)).map_err(|_| Stop::Ends)?;
    let end = byte.checked_add(length).ok_or(Stop::Ends)?;
    let bytes = data.get(byte..end).ok_or(Stop::Ends)?;
    let value = match coded.base {
        BaseType::Bytes | BaseType::Ascii | BaseType::Utf8 | BaseType::Unicode => {
            if bit != 0 || !bits.is_multiple_of(8) {
                return Err(Stop::not_evaluated("text or bytes that do not begin and end with a byte"));
            }
            if coded.base == BaseType::Bytes { Internal::Bytes(bytes.to_vec()) } else { text(coded, bytes)? }
        }
        _ => number(coded, bytes, bit, bits)?,
    };
    Ok((value, length))
}

fn number(coded: &Coded, bytes: &[u8], bit: u32, bits: u64) -> Result<Internal, Stop> {
    let is_wrong = match coded.base {
        BaseType::Float32 => bits != 32,
        BaseType::Float64 => bits != 64,
        _ => bits > u64::from(MOST_BITS),
    };
    if is_wrong {
        return Err(Stop::not_evaluated(format!("a number of {bits} bits")));
    }
    let gather = |raw: u128, byte: &u8| raw << 8 | u128::from(*byte);
    let raw =
        if coded.big_endian { bytes.iter().fold(0, gather) } else { bytes.iter().rev().fold(0, gather) };
    let raw = (raw >> bit) as u64 & (u64::MAX >> (u64::from(MOST_BITS) - bits));
    Ok(match coded.base {
        BaseType::Float32 => Internal::Real(f32::from_bits(raw as u32).into()),
        BaseType::Float64 => Internal::Real(f64::from_bits(raw)),
        BaseType::Int => Internal::Int(signed(coded.coding, raw, bits)?),
        _ => Internal::Int(unsigned(coded.coding, raw)?),
    })
}

fn signed(coding: Coding, raw: u64, bits: u64) -> Result<i128, Stop> {
    let raw = i128::from(raw);
    let sign = 1_i128 << (bits - 1);
    if raw < sign {
        return match coding {
            Coding::Plain | Coding::OnesComplement | Coding::SignMagnitude => Ok(raw),
            _ => Err(Stop::not_evaluated("a signed number in this encoding")),
        };
    }
    match coding {
        Coding::Plain => Ok(raw - 2 * sign),
        Coding::OnesComplement => Ok(raw - 2 * sign + 1),
        Coding::SignMagnitude => Ok(sign - raw),
        _ => Err(Stop::not_evaluated("a signed number in this encoding")),
    }
}

fn unsigned(coding: Coding, raw: u64) -> Result<i128, Stop> {
    let step = match coding {
        Coding::BcdPacked => 4,
        Coding::BcdUnpacked => 8,
        Coding::Plain => return Ok(raw.into()),
        _ => return Err(Stop::not_evaluated("an unsigned number in this encoding")),
    };
    let mut number = 0_i128;
    for at in (0..MOST_BITS).step_by(step).rev() {
        let digit = raw >> at & ((1 << step) - 1);
        if digit > 9 {
            return Err(Stop::not_evaluated("a decimal digit above 9"));
        }
        number = number * 10 + i128::from(digit);
    }
    Ok(number)
}

fn text(coded: &Coded, bytes: &[u8]) -> Result<Internal, Stop> {
    let coding = match (coded.coding, coded.base) {
        (Coding::Plain, BaseType::Ascii) => Coding::Latin1,
        (Coding::Plain, BaseType::Unicode) => Coding::Ucs2,
        (Coding::Plain, _) => Coding::Utf8,
        (coding, _) => coding,
    };
    let decoded = match coding {
        Coding::Latin1 => Some(bytes.iter().map(|byte| char::from(*byte)).collect()),
        Coding::Utf8 => str::from_utf8(bytes).ok().map(str::to_owned),
        Coding::Ucs2 => {
            let encoding = if coded.big_endian { UTF_16BE } else { UTF_16LE };
            encoding.decode_without_bom_handling_and_without_replacement(bytes).map(Into::into)
        }
        Coding::Latin2 => {
            ISO_8859_2.decode_without_bom_handling_and_without_replacement(bytes).map(Into::into)
        }
        Coding::Windows1252 => {
            let decoded = WINDOWS_1252.decode_without_bom_handling_and_without_replacement(bytes);
            // Of the bytes that the code page leaves open, the decoder makes control characters.
            decoded
                .map(String::from)
                .filter(|text| !text.contains(|letter| ('\u{80}'..='\u{9F}').contains(&letter)))
        }
        _ => return Err(Stop::not_evaluated("a text in this encoding")),
    };
    decoded.map(Internal::Text).ok_or_else(|| Stop::not_evaluated("bytes that are no text in its encoding"))
}
