//! The bits of a field's value that is given as a text: a number with or without its unit, the name of a value, a date, a time of day.

use jiff::civil;
use rustc_hash::FxHashMap;

use super::database::{Database, FieldKind, Key, Kind};
use super::fields::{mask, physical};
use crate::Value;

/// Letters and digits alone, in lower case, so that `Wind Speed`, `windSpeed` and `wind_speed` are one name.
pub fn plain(text: &str) -> String {
    text.chars().filter(|letter| letter.is_alphanumeric()).flat_map(char::to_lowercase).collect()
}

/// A whole number in decimal, or after `0x` in hexadecimal.
pub fn whole(text: &str) -> Option<u64> {
    match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
        Some(digits) => u64::from_str_radix(digits, 16).ok(),
        None => text.parse().ok(),
    }
}

/// Bytes in hexadecimal, with or without blanks.
pub fn bytes(text: &str) -> Option<Vec<u8>> {
    let digits: String = text.chars().filter(|letter| !letter.is_whitespace()).collect();
    let is_right = digits.is_ascii() && digits.len().is_multiple_of(2);
    let pairs = (0..digits.len()).step_by(2);
    is_right.then(|| pairs.map(|at| u8::from_str_radix(digits.get(at..at + 2)?, 16).ok()).collect())?
}

/// The bits for "not available"; `None` where every number is a value.
pub fn absent(kind: &'static FieldKind) -> Option<u64> {
    let (length, all) = (kind.bit_length, mask(kind.bit_length));
    match kind.field_type {
        // None of them is set.
        Kind::Bitlookup => Some(0),
        Kind::Binary | Kind::Decimal | Kind::IndirectLookup => Some(all),
        Kind::Lookup => {
            let name = table(kind.lookup_enumeration.as_ref()).and_then(|table| table.get(&all));
            let is_none =
                name.is_none_or(|name| matches!(name.as_str(), "Unknown" | "Take no action (no change)"));
            (length > 1 && is_none).then_some(all)
        }
        Kind::Pgn | Kind::FieldIndex | Kind::IsoName | Kind::DynamicFieldKey | Kind::DynamicFieldLength => {
            None
        }
        _ => {
            let none = if kind.signed && kind.field_type != Kind::Float { all >> 1 } else { all };
            (physical("", kind, none).value == Value::Missing).then_some(none)
        }
    }
}

fn table(name: Option<&'static String>) -> Option<&'static FxHashMap<u64, String>> {
    name.and_then(|name| Database::get().lookups.get(name))
}

fn bit_table(name: Option<&'static String>) -> Option<&'static FxHashMap<u64, String>> {
    name.and_then(|name| Database::get().bits.get(name))
}

/// The bits of a value. `other` is that of the field on which an indirect one depends. The error says what would be right.
pub fn raw(kind: &'static FieldKind, text: &str, other: Option<u64>) -> Result<u64, String> {
    let length = kind.bit_length;
    let number = match kind.field_type {
        Kind::Lookup => named(table(kind.lookup_enumeration.as_ref()), text)?,
        Kind::IndirectLookup => {
            let table = kind.lookup_indirect_enumeration.as_ref();
            let table = table.and_then(|name| Database::get().indirect.get(name));
            let entries = table.into_iter().flatten().filter(|((of, _), _)| Some(*of) == other);
            pick(entries.map(|((_, raw), name)| (*raw, name.as_str())), text)?
        }
        Kind::Bitlookup => bit_set(bit_table(kind.lookup_bit_enumeration.as_ref()), text)?,
        Kind::DynamicFieldKey => {
            let keys =
                kind.lookup_field_type_enumeration.as_ref().and_then(|name| Database::get().kinds.get(name));
            pick(
                keys.into_iter().flat_map(|keys| keys.values()).map(|key| (key.value, key.name.as_str())),
                text,
            )?
        }
        Kind::Pgn | Kind::FieldIndex | Kind::DynamicFieldLength | Kind::Mmsi => {
            whole(text).ok_or("it is a whole number")?
        }
        Kind::IsoName => u64::from_str_radix(text.trim_start_matches("0x"), 16)
            .map_err(|_| "it is a NAME of up to 16 hexadecimal digits")?,
        Kind::Binary => {
            let bytes = bytes(text).filter(|bytes| bytes.len() == length.div_ceil(8));
            let bytes = bytes.ok_or_else(|| {
                format!("it is {} in hexadecimal", cantap_trace::counted(length.div_ceil(8), "byte"))
            })?;
            bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
        }
        Kind::Decimal => decimal(length, text)?,
        Kind::Float => {
            let number: f32 = number(text, &kind.unit)?;
            u64::from(number.to_bits())
        }
        _ => return of_physical(kind, text),
    };
    if number > mask(length) {
        return Err(format!("it has {length} bits, so at most {}", mask(length)));
    }
    Ok(number)
}

/// Two digits in each byte.
fn decimal(length: usize, text: &str) -> Result<u64, String> {
    let digits = length / 4;
    if text.len() > digits
        || !text.len().is_multiple_of(2)
        || !text.bytes().all(|digit| digit.is_ascii_digit())
    {
        return Err(format!("it is an even number of digits, at most {digits}"));
    }
    let mut number = mask(length);
    for (at, pair) in text.as_bytes().chunks(2).enumerate() {
        let two = u64::from((pair[0] - b'0') * 10 + pair[1] - b'0');
        number = number & !(0xFF << (8 * at)) | two << (8 * at);
    }
    Ok(number)
}

/// A number, with or without its unit.
fn number<T: std::str::FromStr>(text: &str, unit: &str) -> Result<T, String> {
    let text = text.trim();
    let bare = if unit.is_empty() { text } else { text.strip_suffix(unit).unwrap_or(text).trim_end() };
    bare.parse().map_err(|_| match unit {
        "" => "it is a number".to_owned(),
        unit => format!("it is a number in {unit}"),
    })
}

/// The value with this name or number among those that have names. A name that looks like another value's number is neither.
fn pick<'n>(names: impl Iterator<Item = (u64, &'n str)> + Clone, text: &str) -> Result<u64, String> {
    let text = text.trim();
    let exact =
        names.clone().filter(|(_, name)| name.trim().eq_ignore_ascii_case(text)).map(|(raw, _)| raw).min();
    match (whole(text), exact) {
        (Some(number), Some(raw)) if number != raw => {
            return Err(format!("it is a number, and the name of {raw}; write 0x{raw:X} or 0x{number:X}"));
        }
        (Some(number), _) => return Ok(number),
        (None, Some(raw)) => return Ok(raw),
        (None, None) => {}
    }
    let wanted = plain(text);
    let mut alike = names.clone().filter(|(_, name)| !wanted.is_empty() && plain(name) == wanted);
    if let (Some((raw, _)), None) = (alike.next(), alike.next()) {
        return Ok(raw);
    }
    let mut all: Vec<_> = names.collect();
    all.sort_unstable();
    let all: Vec<_> = all.iter().take(20).map(|(_, name)| *name).collect();
    Err(format!("it is a number, or one of: {}", all.join(", ")))
}

fn named(table: Option<&'static FxHashMap<u64, String>>, text: &str) -> Result<u64, String> {
    pick(table.into_iter().flatten().map(|(raw, name)| (*raw, name.as_str())), text)
}

/// Bits by their names, with commas, or all of them as a number.
fn bit_set(table: Option<&'static FxHashMap<u64, String>>, text: &str) -> Result<u64, String> {
    if let Some(number) = whole(text) {
        return Ok(number);
    }
    // A name may contain a comma.
    if let Ok(bit) = named(table, text) {
        return Ok(1 << bit.min(63));
    }
    text.split(',').try_fold(0, |set, name| {
        let unnamed = name.trim().strip_prefix("bit ").and_then(whole);
        let bit = unnamed.map_or_else(|| named(table, name.trim()), Ok)?;
        Ok(set | 1 << bit.min(63))
    })
}

/// A physical value, in the field's resolution and range.
fn of_physical(kind: &'static FieldKind, text: &str) -> Result<u64, String> {
    let (length, resolution) = (kind.bit_length, kind.resolution.unwrap_or(1.0));
    let in_steps = |value: f64| ((value - kind.offset) / resolution).round() as i128;
    let steps = match kind.field_type {
        Kind::Date => match text.parse::<civil::Date>() {
            Ok(date) => {
                let since = civil::date(1970, 1, 1).until(date).map_err(|error| error.to_string())?;
                i128::from(since.get_days())
            }
            Err(_) => in_steps(
                number(text, &kind.unit).map_err(|_| "it is a date, as 2026-11-30, or days since 1970")?,
            ),
        },
        Kind::Time if text.contains(':') => in_steps(time_of_day(text).ok_or("a time of day is 12:34:56.5")?),
        // Every digit of a long one counts.
        _ if kind.resolution.is_none_or(|resolution| resolution.to_bits() == 1_f64.to_bits())
            && kind.offset == 0.0
            && text.trim().parse::<i128>().is_ok() =>
        {
            text.trim().parse().map_err(|_| "it is a whole number")?
        }
        _ => match whole(text.trim()).filter(|_| text.trim().starts_with("0x")) {
            Some(number) => in_steps(number as f64),
            None => in_steps(number(text, &kind.unit)?),
        },
    };
    let (least, most) = if kind.signed {
        (-(mask(length) as i128 >> 1) - 1, mask(length) as i128 >> 1)
    } else {
        (0, mask(length) as i128)
    };
    let outside = || {
        let edge = |steps: i128| (steps as f64).mul_add(resolution, kind.offset);
        let from = kind.range_min.unwrap_or_else(|| edge(least));
        let to = kind.range_max.unwrap_or_else(|| edge(most));
        format!("it is from {from} to {to} {}", kind.unit).trim_end().to_owned()
    };
    let raw = (least..=most).contains(&steps).then_some(steps as u64 & mask(length)).ok_or_else(outside)?;
    // What is reserved, for "not available" or an error, or out of range would be read as that.
    let read = physical("", kind, raw);
    let is_odd = matches!(read.text.as_deref(), Some("out of range" | "error"));
    if read.value == Value::Missing || is_odd { Err(outside()) } else { Ok(raw) }
}

/// Seconds since midnight; a leap second is one.
fn time_of_day(text: &str) -> Option<f64> {
    let parts: Vec<&str> = text.split(':').collect();
    let (&[hours, minutes], seconds) = (parts.get(..2)?, parts.get(2).copied().unwrap_or("0")) else {
        return None;
    };
    let (hours, minutes): (u32, u32) = (hours.parse().ok()?, minutes.parse().ok()?);
    let seconds: f64 = seconds.parse().ok().filter(|seconds| (0.0..61.0).contains(seconds))?;
    (hours < 24 && minutes < 60 && parts.len() <= 3)
        .then_some(f64::from(hours * 3600 + minutes * 60) + seconds)
}

/// The bits of a key's value, and how many they are.
pub fn of_key(key: &'static Key, text: &str) -> Result<(u64, usize), String> {
    let length = key.bits.parse::<usize>().ok().filter(|bits| (1..=64).contains(bits));
    let Some(length) = length else {
        let bytes = bytes(text).filter(|bytes| !bytes.is_empty() && bytes.len() <= 8);
        let bytes = bytes.ok_or("it is one to eight bytes in hexadecimal")?;
        let number = bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte));
        return Ok((number, bytes.len() * 8));
    };
    let number = match key.field_type {
        Kind::Lookup => named(table(key.lookup_enumeration.as_ref()), text)?,
        Kind::Bitlookup => bit_set(bit_table(key.lookup_bit_enumeration.as_ref()), text)?,
        Kind::Number | Kind::Duration => {
            let value: f64 = number(text, &key.unit)?;
            let steps = (value / key.resolution.unwrap_or(1.0)).round() as i128;
            let most = if key.signed { mask(length) as i128 >> 1 } else { mask(length) as i128 - 1 };
            let least = if key.signed { -most - 1 } else { 0 };
            if !(least..=most).contains(&steps) {
                return Err(format!("it has {length} bits"));
            }
            steps as u64 & mask(length)
        }
        _ => {
            let bytes = bytes(text).filter(|bytes| bytes.len() == length.div_ceil(8));
            let bytes = bytes.ok_or_else(|| format!("it is {} bytes in hexadecimal", length.div_ceil(8)))?;
            bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
        }
    };
    if number > mask(length) { Err(format!("it has {length} bits")) } else { Ok((number, length)) }
}
