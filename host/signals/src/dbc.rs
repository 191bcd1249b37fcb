//! Databases from DBC files, parsed by can-dbc.
//!
//! Besides the definitions, these attributes are used: `SystemMessageLongSymbol` and `SystemSignalLongSymbol`
//! (names above 32 characters), `VFrameFormat` and `ProtocolType` (whether a message is a J1939 parameter
//! group), `GenMsgCycleTime`, `GenSigStartValue`.

use std::collections::HashMap;

use can_dbc::{
    AttributeDefinition, AttributeValue, AttributeValueType, Comment, Dbc, MessageId, MultiplexIndicator,
    NumericValue, SignalExtendedValueType, ValueDescription, ValueType,
};

use super::dbc_parse::{self, NO_MESSAGE};
use super::dbc_text::{self, Index};
use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::ByteOrder;
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::{layout, validate};

/// Parses a DBC file's content; `file` is its name for messages to the user.
///
/// A message with a fault that would make values wrong is left out, with a warning. It is an error if nothing is left.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let (text, encoding) = dbc_text::decode(bytes);
    let text = dbc_text::with_receivers(&text);
    let unusual = encoding.map(|name| FaultKind::Encoding(name).of_whole_file());
    let mut faults: Vec<_> = unusual.into_iter().collect();
    let Some((dbc, index)) = dbc_parse::parse(&text, &mut faults) else {
        faults.retain(|fault| !fault.kind.is_warning());
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults });
    };
    let messages = Reader::new(&dbc, &index, &mut faults).messages();
    validate::finish(file, messages, faults)
}

/// Everything that the file says about a signal outside its definition.
#[derive(Default)]
struct SignalExtras<'a> {
    comment: Option<&'a str>,
    values: Option<&'a [can_dbc::ValDescription]>,
    float: Option<SignalExtendedValueType>,
    long_name: Option<&'a str>,
    initial: Option<f64>,
    switch: Option<&'a can_dbc::ExtendedMultiplex>,
}

/// The same for one message.
#[derive(Default)]
struct MessageExtras<'a> {
    comment: Option<&'a str>,
    long_name: Option<&'a str>,
    cycle_ms: Option<u32>,
    frame_format: Option<&'a AttributeValue>,
}

/// Converts can-dbc's tables to messages.
struct Reader<'a> {
    dbc: &'a Dbc,
    index: &'a Index,
    faults: &'a mut Vec<Fault>,
    messages: HashMap<MessageId, MessageExtras<'a>>,
    signals: HashMap<(MessageId, &'a str), SignalExtras<'a>>,
    frame_formats: FrameFormats<'a>,
    /// Whether extended frames without their own format are J1939.
    j1939: bool,
    /// The start value of signals that have none of their own.
    initial: Option<f64>,
}

impl<'a> Reader<'a> {
    fn new(dbc: &'a Dbc, index: &'a Index, faults: &'a mut Vec<Fault>) -> Self {
        let mut messages = HashMap::<_, MessageExtras>::new();
        let mut signals = HashMap::<_, SignalExtras>::new();
        for message in &dbc.messages {
            messages.entry(message.id).or_default();
            for signal in &message.signals {
                signals.entry((message.id, signal.name.as_str())).or_default();
            }
        }
        let mut unknown = |keyword: &str, id: MessageId, signal: &str| {
            let line = index.reference_line(keyword, id.raw(), signal);
            let symbol = format!("{keyword} {} {signal}", id.raw());
            faults.push(Fault { line, symbol, kind: FaultKind::UnknownSymbol });
        };
        for comment in &dbc.comments {
            match comment {
                Comment::Message { id, comment } => {
                    messages.entry(*id).or_default().comment = Some(comment);
                }
                Comment::Signal { message_id, name, comment } => {
                    signals.entry((*message_id, name)).or_default().comment = Some(comment);
                }
                _ => {}
            }
        }
        for description in &dbc.value_descriptions {
            if let ValueDescription::Signal { message_id, name, value_descriptions } = description {
                match signals.get_mut(&(*message_id, name.as_str())) {
                    Some(extras) => extras.values = Some(value_descriptions),
                    None => unknown("VAL_", *message_id, name),
                }
            }
        }
        for kind in &dbc.signal_extended_value_type_list {
            match signals.get_mut(&(kind.message_id, kind.signal_name.as_str())) {
                Some(extras) => extras.float = Some(kind.signal_extended_value_type),
                None => unknown("SIG_VALTYPE_", kind.message_id, &kind.signal_name),
            }
        }
        for multiplex in &dbc.extended_multiplex {
            match signals.get_mut(&(multiplex.message_id, multiplex.signal_name.as_str())) {
                Some(extras) => extras.switch = Some(multiplex),
                None => unknown("SG_MUL_VAL_", multiplex.message_id, &multiplex.signal_name),
            }
        }
        for attribute in &dbc.attribute_values_message {
            let extras = messages.entry(attribute.message_id).or_default();
            match (attribute.name.as_str(), &attribute.value) {
                ("SystemMessageLongSymbol", AttributeValue::String(name)) => extras.long_name = Some(name),
                ("GenMsgCycleTime", value) => extras.cycle_ms = number(value).map(|value| value as u32),
                ("VFrameFormat", value) => extras.frame_format = Some(value),
                _ => {}
            }
        }
        for attribute in &dbc.attribute_values_signal {
            let extras = signals.entry((attribute.message_id, &attribute.signal_name)).or_default();
            match (attribute.name.as_str(), &attribute.value) {
                ("SystemSignalLongSymbol", AttributeValue::String(name)) => extras.long_name = Some(name),
                ("GenSigStartValue", value) => extras.initial = number(value),
                _ => {}
            }
        }
        let protocol =
            dbc.attribute_values_database.iter().find(|attribute| attribute.name == "ProtocolType");
        let protocol = protocol.map(|attribute| &attribute.value).or(dbc.attribute_default("ProtocolType"));
        let by_protocol = matches!(protocol, Some(AttributeValue::String(protocol)) if protocol.eq_ignore_ascii_case("J1939"));
        let frame_formats = FrameFormats::of(dbc);
        let j1939 = match dbc.attribute_default("VFrameFormat").and_then(|format| frame_formats.name(format))
        {
            // A 29-bit message cannot be a standard frame, so that default does not apply to it.
            None | Some("StandardCAN" | "StandardCAN_FD") => by_protocol,
            Some(format) => is_j1939(format),
        };
        let initial = dbc.attribute_default("GenSigStartValue").and_then(number);
        Self { dbc, index, faults, messages, signals, frame_formats, j1939, initial }
    }

    fn messages(mut self) -> Vec<Message> {
        let dbc = self.dbc;
        let mut messages = Vec::with_capacity(dbc.messages.len());
        for (place, message) in dbc.messages.iter().enumerate() {
            if message.name != NO_MESSAGE {
                messages.extend(self.message(place, message));
            }
        }
        messages
    }

    fn message(&mut self, place: usize, message: &'a can_dbc::Message) -> Option<Message> {
        let line = self.index.message_line(place);
        let extras = self.messages.remove(&message.id).unwrap_or_default();
        let name = extras.long_name.unwrap_or(&message.name).to_owned();
        // can-dbc keeps 16 bits of a standard identifier: the number in the file is the right one.
        let written = self.index.messages.get(place).map_or(message.id.raw().into(), |&(id, _, _)| id);
        let Some(id) = dbc_parse::id_of(written) else {
            self.faults.push(Fault { line, symbol: name, kind: FaultKind::Id(written) });
            return None;
        };
        let Some(length) = u16::try_from(message.size).ok().filter(|&length| length <= validate::MAX_BYTES)
        else {
            let kind = FaultKind::MessageLength(message.size);
            self.faults.push(Fault { line, symbol: name, kind });
            return None;
        };
        let mut definitions: Vec<_> = Vec::with_capacity(message.signals.len());
        let mut is_usable = true;
        for definition in &message.signals {
            let line = self.index.signal_line(place, &definition.name);
            match signal_place(definition) {
                Ok((start, length)) => definitions.push((definition, start, length, line)),
                Err(kind) => {
                    is_usable &= kind.is_warning();
                    let symbol = format!("{name}.{}", definition.name);
                    self.faults.push(Fault { line, symbol, kind });
                }
            }
        }
        if !is_usable {
            return None;
        }
        let places: HashMap<&str, usize> = definitions
            .iter()
            .enumerate()
            .map(|(place, &(definition, ..))| (definition.name.as_str(), place))
            .collect();
        let format = extras.frame_format.and_then(|format| self.frame_formats.name(format));
        let plain_switch = plain_switch(&message.signals);
        let mut signals = Vec::with_capacity(definitions.len());
        for &(definition, start, length, line) in &definitions {
            let extras = self.signals.get(&(message.id, definition.name.as_str()));
            let default = SignalExtras::default();
            let extras = extras.unwrap_or(&default);
            let mut signal = signal(definition, extras, start, length);
            if extras.float.is_some_and(is_float) && !matches!(length, 16 | 32 | 64) {
                let symbol = format!("{name}.{}", signal.name);
                self.faults.push(Fault { line, symbol, kind: FaultKind::OddFloat(length) });
            }
            let initial = extras.initial.or(self.initial).unwrap_or_default();
            signal.initial_raw = initial as i64 as u64 & layout::mask(length);
            signal.line = line;
            signal.multiplexed = match switch(definition, extras, plain_switch) {
                None => None,
                Some((switch, values)) => {
                    let place = places.get(switch).copied();
                    if place.is_none() {
                        let symbol = format!("{name}.{}", signal.name);
                        let kind = FaultKind::NoMultiplexer(switch.to_owned());
                        self.faults.push(Fault { line, symbol, kind });
                    }
                    place.map(|switch| Multiplexed { switch, values })
                }
            };
            signals.push(signal);
        }
        Some(Message {
            id,
            name,
            description: extras.comment.map(unescape).unwrap_or_default(),
            length,
            cycle_ms: extras.cycle_ms.filter(|&cycle| cycle > 0),
            j1939: id.is_extended() && format.map_or(self.j1939, is_j1939),
            container: None,
            signals,
            line,
        })
    }
}

/// The file's names for the values of `VFrameFormat`. Writers number them as they like.
struct FrameFormats<'a>(Option<&'a [String]>);

impl<'a> FrameFormats<'a> {
    fn of(dbc: &'a Dbc) -> Self {
        let names = dbc.attribute_definitions.iter().find_map(|definition| match definition {
            AttributeDefinition::Message(name, AttributeValueType::Enum(names)) if name == "VFrameFormat" => {
                Some(names.as_slice())
            }
            _ => None,
        });
        Self(names)
    }

    fn name(&self, format: &'a AttributeValue) -> Option<&'a str> {
        match (format, self.0) {
            (AttributeValue::String(name), _) => Some(name),
            (value, Some(names)) => names.get(number(value)? as usize).map(String::as_str),
            // Vector's own list, if the file has none.
            (value, None) => (number(value) == Some(3.0)).then_some("J1939PG"),
        }
    }
}

fn is_j1939(format: &str) -> bool {
    format.eq_ignore_ascii_case("J1939PG")
}

fn number(value: &AttributeValue) -> Option<f64> {
    match *value {
        AttributeValue::Uint(value) => Some(value as f64),
        AttributeValue::Int(value) => Some(value as f64),
        AttributeValue::Double(value) => Some(value),
        AttributeValue::String(_) => None,
    }
}

/// Start and length, if a signal can have them.
fn signal_place(definition: &can_dbc::Signal) -> Result<(u16, u16), FaultKind> {
    let length = match definition.size {
        0 => return Err(FaultKind::NoBits),
        size @ 1..=64 => size as u16,
        size => return Err(FaultKind::TooManyBits(size)),
    };
    let start = u16::try_from(definition.start_bit).ok().filter(|&start| start < validate::MAX_BYTES * 8);
    Ok((start.ok_or(FaultKind::Start(definition.start_bit))?, length))
}

/// The message's only multiplexer that is not multiplexed itself.
fn plain_switch(definitions: &[can_dbc::Signal]) -> Option<&str> {
    let is_plain =
        |signal: &&can_dbc::Signal| signal.multiplexer_indicator == MultiplexIndicator::Multiplexor;
    let mut plain = definitions.iter().filter(is_plain);
    let only = plain.next().filter(|_| plain.next().is_none());
    only.map(|signal| signal.name.as_str())
}

/// The signal's multiplexer and the values for which it is present.
fn switch<'a>(
    definition: &can_dbc::Signal,
    extras: &SignalExtras<'a>,
    plain_switch: Option<&'a str>,
) -> Option<(&'a str, Vec<std::ops::RangeInclusive<u64>>)> {
    // SG_MUL_VAL_ is more precise than the indicator, which some writers reduce to M.
    if let Some(multiplex) = extras.switch {
        let ranges = multiplex.mappings.iter().map(|mapping| mapping.min_value..=mapping.max_value);
        return Some((&multiplex.multiplexor_signal_name, ranges.collect()));
    }
    match definition.multiplexer_indicator {
        MultiplexIndicator::MultiplexedSignal(value)
        | MultiplexIndicator::MultiplexorAndMultiplexedSignal(value) => {
            Some((plain_switch.unwrap_or("M"), vec![value..=value]))
        }
        MultiplexIndicator::Multiplexor | MultiplexIndicator::Plain => None,
    }
}

/// `SIG_VALTYPE_` may also say that a signal is a whole number.
fn is_float(value_type: SignalExtendedValueType) -> bool {
    use SignalExtendedValueType::{IEEEdouble64bit, IEEEfloat32Bit};
    matches!(value_type, IEEEfloat32Bit | IEEEdouble64bit)
}

fn signal(definition: &can_dbc::Signal, extras: &SignalExtras, start: u16, length: u16) -> Signal {
    let kind = match (extras.float, definition.value_type) {
        // Vector's tools know 32 and 64 bits; 16 is a common extension.
        (Some(value_type), _) if is_float(value_type) => match length {
            16 => ValueKind::Half,
            64 => ValueKind::Double,
            _ => ValueKind::Single,
        },
        (_, ValueType::Signed) => ValueKind::Signed,
        (_, ValueType::Unsigned) => ValueKind::Unsigned,
    };
    let float = |value: NumericValue| match value {
        NumericValue::Uint(value) => value as f64,
        NumericValue::Int(value) => value as f64,
        NumericValue::Double(value) => value,
    };
    let (min, max) = (float(definition.min), float(definition.max));
    // In a DBC file, [0|0] means that the limits are not given.
    let limited = min != 0.0 || max != 0.0;
    let values = extras.values.unwrap_or_default();
    let texts = values.iter().map(|value| (value.id, unescape(&value.description)));
    let order = match definition.byte_order {
        can_dbc::ByteOrder::LittleEndian => ByteOrder::Little,
        can_dbc::ByteOrder::BigEndian => ByteOrder::Big,
    };
    Signal {
        description: extras.comment.map(unescape).unwrap_or_default(),
        unit: unescape(&definition.unit),
        order,
        kind,
        factor: definition.factor,
        offset: definition.offset,
        min: limited.then_some(min),
        max: limited.then_some(max),
        values: ValueTable::new(texts),
        is_switch: matches!(
            definition.multiplexer_indicator,
            MultiplexIndicator::Multiplexor | MultiplexIndicator::MultiplexorAndMultiplexedSignal(_)
        ),
        ..Signal::new(extras.long_name.unwrap_or(&definition.name), start, length)
    }
}

/// can-dbc leaves `\"` in strings unchanged.
fn unescape(text: &str) -> String {
    text.replace("\\\"", "\"")
}
