//! What scripts do with bytes: make them from text, compute checksums over them, play lists of them.

use std::cell::RefCell;
use std::rc::Rc;

use cantap_trace::counted;
use rhai::{Array, Blob, Dynamic, Engine};

use crate::checksum;
use crate::script_result::Result;

/// A list that is played again and again. Copies share their place in it.
#[derive(Clone, Debug)]
pub struct Steps(Rc<RefCell<Place>>);

#[derive(Debug)]
struct Place {
    /// Each value, and how often it is played in a row.
    steps: Vec<(Dynamic, u32)>,
    at: usize,
    played: u32,
}

impl Steps {
    fn new(steps: Vec<(Dynamic, u32)>) -> Result<Self> {
        if steps.is_empty() {
            return Err("a list of steps has at least one".into());
        }
        Ok(Self(Rc::new(RefCell::new(Place { steps, at: 0, played: 0 }))))
    }

    fn next(&self) -> Dynamic {
        let place = &mut *self.0.borrow_mut();
        let (value, times) = &place.steps[place.at];
        let value = value.clone();
        place.played += 1;
        if place.played >= *times {
            (place.at, place.played) = ((place.at + 1) % place.steps.len(), 0);
        }
        value
    }
}

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine) {
    engine.register_fn("bytes", bytes);
    engine.register_fn("bytes", |parts: Array| data_of(Dynamic::from_array(parts)));
    engine.register_fn("le", |value: i64, length: i64| -> Result<Blob> {
        Ok(value.to_le_bytes()[..number_bytes(length)?].to_vec())
    });
    engine.register_fn("be", |value: i64, length: i64| -> Result<Blob> {
        Ok(value.to_be_bytes()[8 - number_bytes(length)?..].to_vec())
    });
    engine.register_fn("from_le", |data: Blob, at: i64, length: i64| -> Result<i64> {
        Ok(part(&data, at, length)?.iter().rev().fold(0, |number, byte| number << 8 | i64::from(*byte)))
    });
    engine.register_fn("from_be", |data: Blob, at: i64, length: i64| -> Result<i64> {
        Ok(part(&data, at, length)?.iter().fold(0, |number, byte| number << 8 | i64::from(*byte)))
    });
    engine.register_fn("without", |data: Blob, at: i64| -> Result<Blob> {
        let at = usize::try_from(at).ok().filter(|at| *at < data.len());
        let at = at.ok_or_else(|| format!("there is no byte there; there are {}", data.len()))?;
        Ok([&data[..at], &data[at + 1..]].concat())
    });
    engine.register_fn("xor8", |data: Blob| i64::from(checksum::xor8(data)));
    engine.register_fn("sum8", |data: Blob| i64::from(checksum::sum8(data)));
    engine.register_fn("nibble_sum", |data: Blob| i64::from(checksum::nibble_sum(data)));
    engine.register_fn("crc8", |data: Blob, polynomial: i64| -> Result<i64> {
        Ok(checksum::crc8(data, byte(polynomial)?, 0, 0).into())
    });
    engine.register_fn("crc8", |data: Blob, polynomial: i64, start: i64, xor_out: i64| -> Result<i64> {
        Ok(checksum::crc8(data, byte(polynomial)?, byte(start)?, byte(xor_out)?).into())
    });
    engine.register_fn("crc8_reflected", |data: Blob, polynomial: i64| -> Result<i64> {
        Ok(checksum::crc8_reflected(data, byte(polynomial)?, 0, 0).into())
    });
    engine.register_fn(
        "crc8_reflected",
        |data: Blob, polynomial: i64, start: i64, xor_out: i64| -> Result<i64> {
            Ok(checksum::crc8_reflected(data, byte(polynomial)?, byte(start)?, byte(xor_out)?).into())
        },
    );
    engine.register_type_with_name::<Steps>("Steps");
    engine.register_fn("steps", |values: Array| {
        Steps::new(values.into_iter().map(|value| (value, 1)).collect())
    });
    engine.register_fn("payloads", |texts: Array| -> Result<Steps> {
        Steps::new(texts.iter().map(payload).collect::<Result<_>>()?)
    });
    engine.register_fn("next", |steps: &mut Steps| steps.next());
}

/// A payload and how often it is played, as `0011AA*3`.
fn payload(text: &Dynamic) -> Result<(Dynamic, u32)> {
    let text = text.clone().into_immutable_string()?;
    let (data, times) = match text.split_once('*') {
        Some((data, times)) => (data, times.parse().ok().filter(|times| *times > 0)),
        None => (text.as_str(), Some(1)),
    };
    let times = times.ok_or_else(|| format!("{text}: after * is how often it is played, from 1"))?;
    Ok((Dynamic::from_blob(bytes(data)?), times))
}

/// Bytes from pairs of hexadecimal digits.
fn bytes(text: &str) -> Result<Blob> {
    let digits = text.as_bytes();
    let pair = |pair: &[u8]| match pair {
        [high, low] if high.is_ascii_hexdigit() && low.is_ascii_hexdigit() => {
            u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()
        }
        _ => None,
    };
    let all: Option<Blob> = digits.chunks(2).map(pair).collect();
    all.ok_or_else(|| {
        format!("{text} is not bytes; write them as pairs of hexadecimal digits, such as 00AAFF").into()
    })
}

/// A number from 0 to 255.
pub fn byte(value: i64) -> Result<u8> {
    u8::try_from(value).map_err(|_| format!("{value} is no byte").into())
}

/// How many bytes of a number are meant.
fn number_bytes(length: i64) -> Result<usize> {
    let valid = usize::try_from(length).ok().filter(|length| (1..=8).contains(length));
    valid.ok_or_else(|| format!("a number has 1 to 8 bytes, and not {length}").into())
}

/// The bytes of a number in others.
fn part(data: &[u8], at: i64, length: i64) -> Result<&[u8]> {
    let length = number_bytes(length)?;
    let found = usize::try_from(at).ok().and_then(|at| data.get(at..)?.get(..length));
    found.ok_or_else(|| {
        format!("there are no {length} at {at}; there are {}", data.len(), length = counted(length, "byte"))
            .into()
    })
}

/// Bytes from what scripts have them in: bytes, numbers, texts, and lists of these. Nothing is no bytes.
pub fn data_of(value: Dynamic) -> Result<Blob> {
    if value.is_unit() {
        return Ok(Blob::new());
    }
    if let Ok(number) = value.as_int() {
        return Ok(vec![byte(number)?]);
    }
    if value.is_blob() {
        return value.into_blob().map_err(Into::into);
    }
    if value.is_string() {
        return Ok(value.into_immutable_string()?.as_bytes().to_vec());
    }
    if value.is_array() {
        let parts = value.into_array()?.into_iter().map(data_of).collect::<Result<Vec<Blob>>>()?;
        return Ok(parts.concat());
    }
    Err(format!("{value} is no bytes; write a list of numbers, or bytes(…)").into())
}
