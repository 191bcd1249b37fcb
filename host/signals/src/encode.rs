//! Turns values into frames: `EngineData:Speed=1200,Gear=Drive`.

mod error;
mod parse;
mod value;

use std::collections::{BTreeMap, BTreeSet};

use cantap_can::{FdFrame, Frame};
use cantap_trace::TraceFrame;

use super::decoder::{Decoder, MessageRef};
use super::fault::MAX_SWITCHES;
use super::layout;
use super::model::{Message, Multiplexed, Signal};
use super::select::Suggestion;

pub use error::EncodeError;
pub use parse::{Input, parse};
use value::raw;

/// A frame made from values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoded {
    /// The channel that the message's database is for, if it is for a single one.
    pub channel: Option<u8>,
    /// The message.
    pub message: MessageRef,
    /// The frame to send.
    pub frame: Frame,
}

/// Makes a frame from `Message:Signal=value,…`.
///
/// Signals that are not given have the database's start value, or zero. A multiplexer that is not given has
/// the first value for which the given signals are present.
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

/// The same for a message of any length: above eight bytes it is a CAN FD frame, of which a database does not say whether its bit rate is switched
/// (`brs`). With `pad`, one of a length that CAN FD does not have is filled with zeros up to the next one.
pub fn encode_any(
    decoder: &Decoder,
    channel: Option<u8>,
    text: &str,
    (brs, pad): (bool, bool),
) -> Result<TraceFrame, EncodeError> {
    let (name, inputs) = parse(text)?;
    let message = decoder.message(find_message(decoder, channel, &name)?);
    // A longer parameter group of J1939 is none of CAN FD, but of a transport protocol.
    if message.length <= 8 || message.j1939 {
        return Ok(encode(decoder, channel, text)?.frame.into());
    }
    let data = encode_message(message, &inputs)?;
    let frame = if pad {
        FdFrame::padded(message.id, brs, false, &data)
    } else {
        FdFrame::new(message.id, brs, false, &data)
    };
    frame.map(TraceFrame::Fd).ok_or_else(|| EncodeError::TooLong {
        what: format!("message {name}"),
        bytes: message.length.into(),
        room: if message.length > 64 {
            "a CAN FD frame has 64"
        } else {
            "a CAN FD frame has 12, 16, 20, 24, 32, 48 or 64; --pad fills it up with zeros"
        },
    })
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
            // A channel's own database takes precedence over one for all channels.
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
    if message.container.is_some() {
        return Err(EncodeError::Container(message.name.clone()));
    }
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

/// Which of the message's signals a name means: if there are several for different values of a multiplexer, the one for its
/// given value.
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

/// The multiplexer a signal depends on, if it is in this message.
fn multiplexed(signals: &[Signal], place: usize) -> Option<&Multiplexed> {
    signals[place].multiplexed.as_ref().filter(|multiplexed| multiplexed.switch < signals.len())
}

/// Gives a value to every multiplexer that the given signals need and that is not given itself.
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
        // A value that suits all of them is the start of one of the ranges, if it exists.
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
    // Files are checked for cycles; a database made by a program may have one.
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
