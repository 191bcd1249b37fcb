//! What scripts do with bytes: make them from text, compute checksums over them, play lists of them.

use std::cell::RefCell;
use std::rc::Rc;

use rhai::{Array, Blob, Dynamic, Engine};

use crate::checksum;
use crate::runtime::Result;

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
