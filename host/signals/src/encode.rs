//! From values to frames: `EngineData:Speed=1200,Gear=Drive`.

use std::collections::{BTreeMap, BTreeSet};

use cantap_wire::Frame;

use super::decoder::{Decoder, MessageRef};
use super::fault::MAX_SWITCHES;
use super::j1939::{self, Indicator};
use super::layout;
use super::model::{Message, Multiplexed, Signal, ValueKind};
use super::select::Suggestion;

/// A frame made from values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoded {
    /// The channel that the message's database is for, if it is for one.
    pub channel: Option<u8>,
    /// The message.
    pub message: MessageRef,
    /// The frame to send.
    pub frame: Frame,
}

/// A value as the user gives it.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// A physical value: `90`, `-1.5`, `0x1F`.
    Integer(i128),
    /// A physical value with a fraction.
    Real(f64),
    /// The bits themselves: `raw:0xFF`.
    Raw(u64),
    /// A text of the value table: `Drive`, or in quotes.
    Text(String),
}

/// Why values make no frame.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The text has another form.
    #[error("{text:?} is no message with values; write it as Message:Signal=value,Signal=value")]
    Form {
        /// The text.
        text: String,
    },
    /// No database has the message.
    #[error("no database has a message {name:?}{near}")]
    UnknownMessage {
        /// The name.
        name: String,
        /// A name like it.
        near: Suggestion,
    },
    /// Databases of different channels have it.
    #[error("channels {first} and {second} both have a message {name:?}; choose the channel")]
    Ambiguous {
        /// The name.
        name: String,
        /// One channel.
        first: u8,
        /// Another.
        second: u8,
    },
    /// The message has no such signal.
    #[error("message {message} has no signal {name:?}{near}")]
    UnknownSignal {
        /// The message.
        message: String,
        /// The name.
        name: String,
        /// A name like it.
        near: Suggestion,
    },
    /// The signal is given twice.
    #[error("signal {0} is given twice")]
    Twice(String),
    /// The text is no number and not in the value table.
    #[error("{text:?} is no value for {signal}; it takes a number{choices}")]
    UnknownText {
        /// The signal.
        signal: String,
        /// The text.
        text: String,
        /// The texts that it takes, ready to be printed.
        choices: String,
    },
    /// The text stands for several raw values.
    #[error("{text:?} stands for several values of {signal}; choose one: {choices}")]
    AmbiguousText {
        /// The signal.
        signal: String,
        /// The text.
        text: String,
        /// The values, ready to be written in the text's place.
        choices: String,
    },
    /// A fraction for a signal whose values are states.
    #[error("{signal} has states and none between them, such as {value}; it takes a whole number{choices}")]
    Fraction {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The texts that it takes, ready to be printed.
        choices: String,
    },
    /// The signal has too few bits for the value.
    #[error("{value} does not fit {signal}, which goes from {low} to {high}")]
    Range {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The smallest it can hold.
        low: String,
        /// The largest it can hold.
        high: String,
    },
    /// The database forbids the value.
    #[error(
        "the database allows {signal} from {low} to {high}, not {value}; write raw:{raw} to send it all the same"
    )]
    Limits {
        /// The signal.
        signal: String,
        /// The value.
        value: String,
        /// The smallest allowed.
        low: f64,
        /// The largest allowed.
        high: f64,
        /// The bits that would be sent.
        raw: u64,
    },
    /// The multiplexer has another value.
    #[error("{signal} is only there when {switch} is {needed}, and it is {actual}")]
    Absent {
        /// The signal.
        signal: String,
        /// Its multiplexer.
        switch: String,
        /// The values under which the signal is there.
        needed: String,
        /// The value that was given.
        actual: u64,
    },
    /// No value of the multiplexer suits all the signals given.
    #[error("{first} and {second} are never in the same frame ({switch} chooses between them)")]
    Exclusive {
        /// One signal.
        first: String,
        /// Another.
        second: String,
        /// Their multiplexer.
        switch: String,
    },
    /// The message is longer than a frame, or the signal lies beyond it.
    #[error("{what} needs {bytes} bytes; {room}")]
    TooLong {
        /// Message or signal.
        what: String,
        /// Bytes it needs.
        bytes: u32,
        /// How many there are, in words.
        room: &'static str,
    },
}

/// Makes a frame from `Message:Signal=value,…`.
///
/// Signals that are not given get the database's start value, or zero. A multiplexer that is not given
/// takes the first value under which the given signals are there.
pub fn encode(decoder: &Decoder, channel: Option<u8>, text: &str) -> Result<Encoded, EncodeError> {
    let (name, inputs) = parse(text)?;
    let reference = find_message(decoder, channel, &name)?;
    let message = decoder.message(reference);
    let data = encode_message(message, &inputs)?;
    let frame = Frame::data_frame(message.id, &data).ok_or_else(|| EncodeError::TooLong {
        what: format!("message {name}"),
        bytes: message.length.into(),
        room: "a frame has 8",
    })?;
    Ok(Encoded { channel: decoder.channel(reference), message: reference, frame })
}

/// Splits `Message:Signal=value,…`. A value in double quotes is a text, whatever is in it.
pub fn parse(text: &str) -> Result<(String, Vec<(String, Input)>), EncodeError> {
    let form = || EncodeError::Form { text: text.to_owned() };
    let (name, rest) = text.split_once(':').unwrap_or((text, ""));
    let name = name.trim();
    if name.is_empty() {
        return Err(form());
    }
    let mut inputs = Vec::new();
    let mut rest = rest.trim();
    while !rest.is_empty() {
        let (signal, after) = rest.split_once('=').ok_or_else(form)?;
        let after = after.trim_start();
        let (input, after) = if let Some(quoted) = after.strip_prefix('"') {
            let (value, after) = quoted.split_once('"').ok_or_else(form)?;
            (Input::Text(value.to_owned()), after.trim_start())
        } else {
            let end = after.find(',').unwrap_or(after.len());
            (input(after[..end].trim()), &after[end..])
        };
        if signal.trim().is_empty() || input == Input::Text(String::new()) {
            return Err(form());
        }
        inputs.push((signal.trim().to_owned(), input));
        rest = match after.strip_prefix(',') {
            Some(more) if !more.trim().is_empty() => more.trim(),
            None if after.is_empty() => after,
            _ => return Err(form()),
        };
    }
    Ok((name.to_owned(), inputs))
}

fn input(text: &str) -> Input {
    if let Some(raw) = text.strip_prefix("raw:")
        && let Some(raw) = integer(raw).and_then(|raw| u64::try_from(raw).ok())
    {
        return Input::Raw(raw);
    }
    match (integer(text), text.parse::<f64>()) {
        (Some(integer), _) => Input::Integer(integer),
        // Rust also reads "inf" and "nan", which may well be texts of a value table.
        (_, Ok(real)) if text.contains(|c: char| c.is_ascii_digit()) => Input::Real(real),
        _ => Input::Text(text.to_owned()),
    }
}

fn integer(text: &str) -> Option<i128> {
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |digits| (-1, digits));
    let magnitude = match digits.strip_prefix("0x").or_else(|| digits.strip_prefix("0X")) {
        Some(hex) if !hex.starts_with('+') => u128::from_str_radix(hex, 16).ok()?,
        _ if digits.starts_with('+') => return None,
        _ => digits.parse().ok()?,
    };
    // A 64-bit value times any factor that makes sense; and nothing below can overflow.
    i128::try_from(magnitude).ok().filter(|magnitude| *magnitude < 1 << 120).map(|magnitude| sign * magnitude)
}

fn find_message(decoder: &Decoder, channel: Option<u8>, name: &str) -> Result<MessageRef, EncodeError> {
    let mut found: Option<(MessageRef, Option<u8>)> = None;
    for (reference, of_channel, message) in decoder.messages() {
        let suits = channel.is_none() || of_channel.is_none() || of_channel == channel;
        if message.name != name || !suits {
            continue;
        }
        match found {
            Some((_, Some(first)))
                if channel.is_none() && of_channel.is_some_and(|second| second != first) =>
            {
                let second = of_channel.unwrap_or(first);
                return Err(EncodeError::Ambiguous { name: name.to_owned(), first, second });
            }
            // A channel's own database goes before one for all.
            Some((_, Some(_))) if of_channel.is_none() => {}
            _ => found = Some((reference, of_channel)),
        }
    }
    found.map(|(reference, _)| reference).ok_or_else(|| {
        let near = Suggestion::nearest(name, decoder.messages().map(|(_, _, message)| message.name.as_str()));
        EncodeError::UnknownMessage { name: name.to_owned(), near }
    })
}

/// Makes a message's data, as many bytes as the message has.
pub fn encode_message(message: &Message, inputs: &[(String, Input)]) -> Result<Vec<u8>, EncodeError> {
    let mut raws = BTreeMap::new();
    for (name, input) in inputs {
        let place = place_of(message, name, inputs)?;
        let signal = &message.signals[place];
        if !fits(message, signal) {
            let (what, bytes) = (format!("signal {name}"), signal.bytes_needed());
            return Err(EncodeError::TooLong { what, bytes, room: "its message has fewer" });
        }
        if raws.insert(place, raw(message, signal, input)?).is_some() {
            return Err(EncodeError::Twice(name.clone()));
        }
    }
    let given: BTreeSet<usize> = raws.keys().copied().collect();
    choose_switches(&message.signals, &given, &mut raws)?;

    let mut data = vec![0; message.length.into()];
    let raw_of = |place: usize| raws.get(&place).copied().unwrap_or(message.signals[place].initial_raw);
    // Signals may overlap: what the user gave is written last.
    let (last, first): (Vec<_>, Vec<_>) = (0..message.signals.len()).partition(|place| given.contains(place));
    for place in first.into_iter().chain(last) {
        let signal = &message.signals[place];
        if fits(message, signal) && is_present(&message.signals, place, &raw_of) {
            layout::insert(signal.order, signal.start, signal.length, raw_of(place), &mut data);
        }
    }
    Ok(data)
}

/// Which of the message's signals a name means: of several under different values of a multiplexer, the one under the value
/// that is given for that.
fn place_of(message: &Message, name: &str, inputs: &[(String, Input)]) -> Result<usize, EncodeError> {
    let signals = &message.signals;
    let named: Vec<_> = (0..signals.len()).filter(|&place| signals[place].label() == name).collect();
    let is_there = |place: &&usize| {
        let Some(multiplexed) = multiplexed(signals, **place) else { return true };
        let switch = &signals[multiplexed.switch];
        let given = inputs.iter().find(|(name, _)| *name == switch.label());
        given.is_some_and(|(_, input)| raw(message, switch, input).is_ok_and(|raw| multiplexed.matches(raw)))
    };
    named.iter().find(is_there).or(named.first()).copied().ok_or_else(|| {
        let near = Suggestion::nearest(name, signals.iter().map(|signal| signal.name.as_str()));
        EncodeError::UnknownSignal { message: message.name.clone(), name: name.to_owned(), near }
    })
}

/// Whether the signal can be written. A database made by a program may have signals without bits.
fn fits(message: &Message, signal: &Signal) -> bool {
    (1..=64).contains(&signal.length) && signal.bytes_needed() <= message.length.into()
}

/// What a signal depends on, if it is in this message.
fn multiplexed(signals: &[Signal], place: usize) -> Option<&Multiplexed> {
    signals[place].multiplexed.as_ref().filter(|multiplexed| multiplexed.switch < signals.len())
}

/// Gives every multiplexer that the given signals need, and that is not given itself, a value.
fn choose_switches(
    signals: &[Signal],
    given: &BTreeSet<usize>,
    raws: &mut BTreeMap<usize, u64>,
) -> Result<(), EncodeError> {
    let mut demands: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for &place in given {
        let mut at = place;
        while let Some(multiplexed) = multiplexed(signals, at) {
            if !demands.entry(multiplexed.switch).or_default().insert(at) {
                break;
            }
            at = multiplexed.switch;
        }
    }
    for (switch, dependents) in demands {
        let wanted = |place: usize| multiplexed(signals, place);
        let refused = |raw| {
            let refuses = |&place: &usize| wanted(place).is_some_and(|multiplexed| !multiplexed.matches(raw));
            dependents.iter().copied().find(|place| refuses(place))
        };
        if let Some(&actual) = raws.get(&switch) {
            if let Some(place) = refused(actual) {
                return Err(EncodeError::Absent {
                    signal: signals[place].name.clone(),
                    switch: signals[switch].name.clone(),
                    needed: wanted(place).map(|multiplexed| values(&multiplexed.values)).unwrap_or_default(),
                    actual,
                });
            }
            continue;
        }
        // A value that suits all starts one of the ranges, if there is one.
        let ranges = dependents.iter().filter_map(|&place| wanted(place)).flat_map(|m| &m.values);
        let mut candidates = ranges.map(|range| *range.start());
        let raw = candidates.find(|&raw| refused(raw).is_none()).ok_or_else(|| {
            let name = |place: Option<&usize>| place.map(|&p| signals[p].name.clone()).unwrap_or_default();
            let (first, second) = (name(dependents.first()), name(dependents.last()));
            EncodeError::Exclusive { first, second, switch: signals[switch].name.clone() }
        })?;
        raws.insert(switch, raw);
    }
    Ok(())
}

fn is_present(signals: &[Signal], place: usize, raw_of: &impl Fn(usize) -> u64) -> bool {
    let mut at = place;
    // Files are checked for circles; a database made by a program may have one.
    for _ in 0..=MAX_SWITCHES {
        let Some(multiplexed) = multiplexed(signals, at) else { return true };
        if !multiplexed.matches(raw_of(multiplexed.switch)) {
            return false;
        }
        at = multiplexed.switch;
    }
    false
}

fn values(ranges: &[std::ops::RangeInclusive<u64>]) -> String {
    let texts: Vec<_> = ranges
        .iter()
        .map(|range| match (range.start(), range.end()) {
            (start, end) if start == end => start.to_string(),
            (start, end) => format!("{start} to {end}"),
        })
        .collect();
    texts.join(" or ")
}

/// The bits for a value.
fn raw(message: &Message, signal: &Signal, input: &Input) -> Result<u64, EncodeError> {
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

/// Share of a step between two raw values that calculating with floats may cost.
const STEP_ERROR: f64 = 1e-6;

/// Whether a value is between limits, which a file gives in decimals that neither a factor nor a short float may be able to meet
/// exactly: 204.70000000000002 is 204.7, and so is a float of 32 bits that is nearest to it.
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

/// The bits for a text of the value table, or for what J1939 says in place of a value. The database's limits do not apply.
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

/// The texts that a signal takes, as the end of a sentence; each once.
fn choices(signal: &Signal) -> String {
    /// A longer list hides the message.
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
        ValueKind::Signed => (mask / 2 + 1, mask / 2),
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

/// Undoes factor and offset, exactly where that can be done.
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
        _ => value as u64 & mask,
    };
    // Whatever does not read back as the value does not fit.
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
