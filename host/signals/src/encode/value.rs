//! Converts a value to the bits of its signal.

use super::error::EncodeError;
use super::parse::Input;
use crate::j1939::{self, Indicator};
use crate::layout;
use crate::model::{Message, Signal, ValueKind};

/// The bits for a value.
pub(super) fn raw(message: &Message, signal: &Signal, input: &Input) -> Result<u64, EncodeError> {
    let mask = layout::mask(signal.length);
    let (physical, text) = match input {
        Input::Raw(raw) if *raw <= mask => return Ok(*raw),
        Input::Raw(raw) => return Err(range_error(signal, format!("raw:{raw}"))),
        Input::Text(text) => return raw_of_text(message, signal, text),
        Input::Integer(value) => (*value as f64, value.to_string()),
        Input::Real(value) => (*value, value.to_string()),
    };
    let unscaled = (physical - signal.offset) / signal.factor;
    let raw = match input {
        Input::Integer(value) if signal.integer(0).is_some() => {
            raw_of_integer(signal, unscaled_integer(signal, *value, physical))
        }
        // A float beyond 64 bits becomes the largest integer, which no signal can hold.
        _ if signal.integer(0).is_some() => raw_of_integer(signal, unscaled.round_ties_even() as i128),
        _ => raw_of_float(signal, unscaled),
    };
    let raw = raw.filter(|_| physical.is_finite()).ok_or_else(|| range_error(signal, text.clone()))?;
    if !signal.values.is_empty()
        && signal.integer(0).is_some()
        && (unscaled - unscaled.round()).abs() > STEP_ERROR
    {
        let choices = choices(signal);
        return Err(EncodeError::Fraction { signal: signal.name.clone(), value: text, choices });
    }
    let (low, high) = (signal.min.unwrap_or(f64::NEG_INFINITY), signal.max.unwrap_or(f64::INFINITY));
    if !is_within(signal, physical, low, high) {
        return Err(EncodeError::Limits { signal: signal.name.clone(), value: text, low, high, raw });
    }
    Ok(raw)
}

/// The fraction of a step between two raw values that may be lost to floating-point errors.
const STEP_ERROR: f64 = 1e-6;

/// Whether a value is within limits. A file gives them in decimal, which neither a factor nor a short float may be able to
/// represent exactly: 204.70000000000002 counts as 204.7, and so does the nearest 32-bit float.
fn is_within(signal: &Signal, physical: f64, low: f64, high: f64) -> bool {
    let nearest = |limit: f64| match signal.integer(0) {
        Some(_) => None,
        None => raw_of_float(signal, (limit - signal.offset) / signal.factor).map(|raw| signal.physical(raw)),
    };
    let slack = if signal.integer(0).is_some() { signal.factor.abs() * STEP_ERROR } else { 0.0 };
    let low = nearest(low).map_or(low, |nearest| nearest.min(low)) - slack;
    let high = nearest(high).map_or(high, |nearest| nearest.max(high)) + slack;
    (low..=high).contains(&physical)
}

/// The bits for a text of the value table, or for what J1939 sends instead of a value. The database's limits do not apply.
fn raw_of_text(message: &Message, signal: &Signal, text: &str) -> Result<u64, EncodeError> {
    let values = signal.values.values(text);
    let raws: Vec<_> = values
        .iter()
        .filter_map(|&value| {
            raw_of_integer(signal, value.into()).or_else(|| raw_of_float(signal, value as f64))
        })
        .collect();
    match raws[..] {
        [raw] => Ok(raw),
        [] if !values.is_empty() => Err(range_error(signal, text.to_owned())),
        [] => {
            let indicators = [Indicator::Error, Indicator::NotAvailable].into_iter();
            let mut meant = indicators.filter(|indicator| message.j1939 && indicator.name() == text);
            let raw = meant.find_map(|indicator| j1939::raw_of(signal, indicator));
            raw.ok_or_else(|| unknown_text(signal, text))
        }
        _ => {
            let choices: Vec<_> = raws.iter().map(|raw| format!("raw:{raw}")).collect();
            let choices = choices.join(", ");
            Err(EncodeError::AmbiguousText { signal: signal.name.clone(), text: text.to_owned(), choices })
        }
    }
}

fn unknown_text(signal: &Signal, text: &str) -> EncodeError {
    let choices = choices(signal);
    EncodeError::UnknownText { signal: signal.name.clone(), text: text.to_owned(), choices }
}

/// The texts that a signal accepts, each once, as the end of a sentence.
fn choices(signal: &Signal) -> String {
    /// A longer list would hide the message.
    const SHOWN: usize = 12;
    let mut texts: Vec<&str> = Vec::new();
    for (_, text) in signal.values.iter() {
        if !texts.contains(&text) {
            texts.push(text);
        }
        if texts.len() > SHOWN {
            texts[SHOWN] = "…";
            break;
        }
    }
    if texts.is_empty() { String::new() } else { format!(" or one of: {}", texts.join(", ")) }
}

fn range_error(signal: &Signal, value: String) -> EncodeError {
    let mask = layout::mask(signal.length);
    let (low, high) = match signal.kind {
        ValueKind::Unsigned => (0, mask),
        ValueKind::Signed | ValueKind::OnesComplement => (mask / 2 + 1, mask / 2),
        ValueKind::SignMagnitude => (mask, mask / 2),
        ValueKind::Half => (0xFBFF, 0x7BFF),
        ValueKind::Single => (u64::from(f32::MIN.to_bits()) >> (32 - signal.length.min(32)), {
            u64::from(f32::MAX.to_bits()) >> (32 - signal.length.min(32))
        }),
        ValueKind::Double => {
            (f64::MIN.to_bits() >> (64 - signal.length), f64::MAX.to_bits() >> (64 - signal.length))
        }
    };
    let (mut low, mut high) = (signal.number(low), signal.number(high));
    if low.as_f64() > high.as_f64() {
        std::mem::swap(&mut low, &mut high);
    }
    EncodeError::Range { signal: signal.name.clone(), value, low: low.to_string(), high: high.to_string() }
}

/// Reverses factor and offset, exactly where possible.
fn unscaled_integer(signal: &Signal, value: i128, physical: f64) -> i128 {
    let (factor, offset) = (signal.factor as i128, signal.offset as i128);
    let whole = signal.factor.fract() == 0.0 && signal.offset.fract() == 0.0 && factor != 0;
    match value.checked_sub(offset) {
        Some(difference) if whole && difference % factor == 0 => difference / factor,
        _ => ((physical - signal.offset) / signal.factor).round_ties_even() as i128,
    }
}

fn raw_of_integer(signal: &Signal, value: i128) -> Option<u64> {
    let mask = layout::mask(signal.length);
    let raw = match signal.kind {
        ValueKind::SignMagnitude if value < 0 => {
            let magnitude =
                u64::try_from(value.checked_neg()?).ok().filter(|&magnitude| magnitude <= mask >> 1)?;
            magnitude | mask ^ mask >> 1
        }
        ValueKind::OnesComplement if value < 0 => (value - 1) as u64 & mask,
        _ => value as u64 & mask,
    };
    // If it does not read back as the same value, it does not fit.
    (signal.integer(raw)? == value).then_some(raw)
}

fn raw_of_float(signal: &Signal, value: f64) -> Option<u64> {
    let raw = match signal.kind {
        ValueKind::Half => half::f16::from_f64(value).to_bits().into(),
        ValueKind::Single => u64::from((value as f32).to_bits()) >> (32 - signal.length.min(32)),
        ValueKind::Double => value.to_bits() >> (64 - signal.length),
        _ => return None,
    };
    signal.raw_to_f64(raw).is_finite().then_some(raw)
}
