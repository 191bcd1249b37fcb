//! Databases from DBC files, parsed by can-dbc.
//!
//! Beyond the definitions themselves these attributes count: `SystemMessageLongSymbol` and
//! `SystemSignalLongSymbol` (names above 32 characters), `VFrameFormat` and `ProtocolType` (whether a
//! message is a J1939 parameter group), `GenMsgCycleTime`, `GenSigStartValue`.

use std::collections::HashMap;

use can_dbc::{
    AttributeValue, Comment, Dbc, DbcError, MessageId, MultiplexIndicator, NumericValue,
    SignalExtendedValueType, ValueDescription, ValueType,
};
use cantap_wire::Id;
use pest::error::{ErrorVariant, LineColLocation};

use super::dbc_text::{self, Index};
use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::ByteOrder;
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::{layout, validate};

/// Holds signals that belong to no message.
const NO_MESSAGE: &str = "VECTOR__INDEPENDENT_SIG_MSG";

/// The flag of an extended identifier in a DBC file.
const EXTENDED: u64 = 1 << 31;

/// More than this many statements that cannot be understood, and it is no DBC file.
const MAX_IGNORED: usize = 50;

/// Parses a DBC file's content; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let text = dbc_text::decode(bytes);
    let index = Index::of(&text);
    let mut faults = Vec::new();
    let faulty = |faults| DatabaseError::Faulty { file: file.to_owned(), faults };
    let Some(dbc) = parse_leniently(&text, &index, &mut faults) else {
        return Err(faulty(faults));
    };
    let messages = Reader::new(&dbc, &index, &mut faults).messages();
    validate::finish(file, messages, faults)
}

/// Parses; statements that decoding does not need and can-dbc does not understand are left out.
fn parse_leniently(text: &str, index: &Index, faults: &mut Vec<Fault>) -> Option<Dbc> {
    let mut text = std::borrow::Cow::Borrowed(text);
    loop {
        // can-dbc's grammar accepts a file's last line only with its end.
        let complete = format!("{text}\n");
        let error = match Dbc::try_from(complete.as_str()) {
            Ok(dbc) => return Some(dbc),
            Err(error) => error,
        };
        let (line, reason) = explain(&error, &text);
        let statement = index.statement_at(line);
        if let Some(needless) = statement.filter(|statement| statement.is_needless())
            && faults.len() < MAX_IGNORED
            && can_be_left_out(&text[needless.range.clone()])
        {
            let (line, symbol) = (needless.line, needless.symbol.clone());
            faults.push(Fault { line, symbol, kind: FaultKind::Ignored(reason) });
            text = dbc_text::blank(&text, needless.range.clone()).into();
            continue;
        }
        let symbol = statement.map(|statement| statement.symbol.clone()).unwrap_or_default();
        let form = statement.and_then(|statement| form(&statement.keyword));
        let reason = form.map_or(reason, |form| format!("not of the form {form}"));
        faults.retain(|fault| !fault.kind.is_warning());
        faults.push(Fault { line, symbol, kind: FaultKind::Syntax(reason) });
        return None;
    }
}

/// Whether a statement is still there, and has not swallowed definitions because a quote is missing.
fn can_be_left_out(statement: &str) -> bool {
    !statement.trim().is_empty() && !statement.contains("\nBO_ ") && !statement.contains("\n SG_ ")
}

/// What a statement looks like. can-dbc's errors mostly point at its start and name rules of a grammar
/// that nobody knows.
fn form(keyword: &str) -> Option<&'static str> {
    Some(match keyword {
        "BO_" => "BO_ ID NAME : LENGTH SENDER",
        "SG_" => r#"SG_ NAME : START|LENGTH@ORDER+ (FACTOR,OFFSET) [MIN|MAX] "UNIT" RECEIVER"#,
        "VAL_" => r#"VAL_ ID SIGNAL 0 "TEXT" 1 "TEXT" ;"#,
        "SIG_VALTYPE_" => "SIG_VALTYPE_ ID SIGNAL : 1 ; (1 float, 2 double)",
        "SG_MUL_VAL_" => "SG_MUL_VAL_ ID SIGNAL MULTIPLEXER 1-3, 5-5 ;",
        _ => return None,
    })
}

/// The line of can-dbc's error and what it says, in words.
fn explain(error: &DbcError, text: &str) -> (u32, String) {
    // can-dbc says which number is wrong and not where. A signal's place goes before other numbers,
    // because nothing else may not be negative.
    let line_of = |token: &str| {
        let (start, length) = (format!(": {token}|"), format!("|{token}@"));
        let is_word = |line: &str| {
            let mut words = line.split(|c: char| !(c.is_ascii_alphanumeric() || "+-._".contains(c)));
            words.any(|word| word == token)
        };
        let place = text.lines().position(|line| line.contains(&start) || line.contains(&length));
        place.or_else(|| text.lines().position(is_word)).map_or(0, |line| line as u32 + 1)
    };
    match error {
        DbcError::Pest(error) => {
            let (LineColLocation::Pos((line, column)) | LineColLocation::Span((line, column), _)) =
                error.line_col;
            let rest = text.lines().nth(line - 1).unwrap_or_default().chars().skip(column - 1);
            let found: String = rest.take(20).collect();
            let found =
                if found.is_empty() { "the line ends".to_owned() } else { format!("found {found:?}") };
            let expected = match &error.variant {
                ErrorVariant::ParsingError { positives, .. } if (1..=4).contains(&positives.len()) => {
                    let names: Vec<_> =
                        positives.iter().map(|rule| format!("{rule:?}").replace('_', " ")).collect();
                    format!("expected {}, {found}", names.join(" or "))
                }
                _ => format!("not understood, {found}"),
            };
            (line as u32, format!("column {column}: {expected}"))
        }
        DbcError::InvalidInt(token)
        | DbcError::InvalidUint(token)
        | DbcError::InvalidFloat(token)
        | DbcError::InvalidNumericValue(token)
        | DbcError::UnknownMultiplexIndicator(token) => (line_of(token), error.to_string()),
        DbcError::MessageIdOutOfRange(id) => (line_of(&id.to_string()), error.to_string()),
        _ => (0, error.to_string()),
    }
}

/// Everything that the file says about one signal elsewhere than in its definition.
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

/// Turns can-dbc's tables into messages.
struct Reader<'a> {
    dbc: &'a Dbc,
    index: &'a Index,
    faults: &'a mut Vec<Fault>,
    messages: HashMap<MessageId, MessageExtras<'a>>,
    signals: HashMap<(MessageId, &'a str), SignalExtras<'a>>,
    /// Whether extended frames without a format of their own are J1939's.
    j1939: bool,
    /// What signals without a start value of their own get.
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
        let j1939 = match (dbc.attribute_default("VFrameFormat"), protocol) {
            (Some(format), _) => is_j1939(format),
            (None, Some(AttributeValue::String(protocol))) => protocol.eq_ignore_ascii_case("J1939"),
            (None, _) => false,
        };
        let initial = dbc.attribute_default("GenSigStartValue").and_then(number);
        Self { dbc, index, faults, messages, signals, j1939, initial }
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
        // can-dbc keeps 16 bits of a standard identifier: the file's own number is the truth.
        let written = self.index.messages.get(place).map_or(message.id.raw().into(), |&(id, _, _)| id);
        let id = match u32::try_from(written & !EXTENDED) {
            Ok(raw) if written & EXTENDED != 0 => Id::extended(raw),
            Ok(raw) => Id::standard(raw),
            Err(_) => None,
        };
        let Some(id) = id else {
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
        for definition in &message.signals {
            let line = self.index.signal_line(place, &definition.name);
            match signal_place(definition) {
                Ok((start, length)) => definitions.push((definition, start, length, line)),
                Err(kind) => {
                    let symbol = format!("{name}.{}", definition.name);
                    self.faults.push(Fault { line, symbol, kind });
                }
            }
        }
        let places: HashMap<&str, usize> = definitions
            .iter()
            .enumerate()
            .map(|(place, &(definition, ..))| (definition.name.as_str(), place))
            .collect();
        let plain_switch = plain_switch(&message.signals);
        let mut signals = Vec::with_capacity(definitions.len());
        for &(definition, start, length, line) in &definitions {
            let extras = self.signals.get(&(message.id, definition.name.as_str()));
            let default = SignalExtras::default();
            let extras = extras.unwrap_or(&default);
            let mut signal = signal(definition, extras, start, length);
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
            j1939: id.is_extended() && extras.frame_format.map_or(self.j1939, is_j1939),
            signals,
            line,
        })
    }
}

/// `VFrameFormat` as text, or its place in Vector's enumeration.
fn is_j1939(format: &AttributeValue) -> bool {
    match format {
        AttributeValue::String(text) => text == "J1939PG",
        value => number(value) == Some(3.0),
    }
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

/// The signal's multiplexer and the values under which it is there.
fn switch<'a>(
    definition: &can_dbc::Signal,
    extras: &SignalExtras<'a>,
    plain_switch: Option<&'a str>,
) -> Option<(&'a str, Vec<std::ops::RangeInclusive<u64>>)> {
    // SG_MUL_VAL_ knows better than the indicator, which some writers reduce to M.
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

fn signal(definition: &can_dbc::Signal, extras: &SignalExtras, start: u16, length: u16) -> Signal {
    let kind = match (extras.float, definition.value_type) {
        // Vector's tools know 32 and 64 bits; 16 is a common extension.
        (Some(SignalExtendedValueType::IEEEfloat32Bit | SignalExtendedValueType::IEEEdouble64bit), _) => {
            match length {
                16 => ValueKind::Half,
                64 => ValueKind::Double,
                _ => ValueKind::Single,
            }
        }
        (_, ValueType::Signed) => ValueKind::Signed,
        (_, ValueType::Unsigned) => ValueKind::Unsigned,
    };
    let float = |value: NumericValue| match value {
        NumericValue::Uint(value) => value as f64,
        NumericValue::Int(value) => value as f64,
        NumericValue::Double(value) => value,
    };
    let (min, max) = (float(definition.min), float(definition.max));
    // [0|0] is how a DBC file says that it does not say.
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

/// can-dbc leaves `\"` in strings as it stands.
fn unescape(text: &str) -> String {
    text.replace("\\\"", "\"")
}
