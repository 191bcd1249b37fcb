//! cantap's own signal file: TOML that carries everything a database can say.
//!
//! `docs/signal-file.md` describes it for users; the structures here define its grammar.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use cantap_can::Id;
use cantap_trace::counted;
use serde::Deserialize;
use toml::Spanned;

use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::ByteOrder;
use super::model::{Alarms, Colour, Database, Digital, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::text_places::Lines;
use super::{layout, validate};

/// The version of the format that this program reads.
const VERSION: u32 = 1;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default = "current_version")]
    version: Spanned<u32>,
    #[serde(default)]
    message: Vec<Spanned<MessageEntry>>,
}

fn current_version() -> Spanned<u32> {
    Spanned::new(0..0, VERSION)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MessageEntry {
    name: String,
    id: u64,
    extended: Option<bool>,
    #[serde(default)]
    j1939: bool,
    #[serde(default = "eight")]
    length: u64,
    #[serde(default)]
    description: String,
    cycle_ms: Option<u32>,
    #[serde(default)]
    signal: Vec<Spanned<SignalEntry>>,
}

fn eight() -> u64 {
    8
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SignalEntry {
    name: String,
    #[serde(default)]
    description: String,
    #[serde(default)]
    unit: String,
    at: Option<String>,
    start: Option<u64>,
    length: Option<u64>,
    order: Option<Order>,
    #[serde(default, rename = "type")]
    kind: Kind,
    #[serde(default = "one")]
    factor: f64,
    #[serde(default)]
    offset: f64,
    min: Option<f64>,
    max: Option<f64>,
    #[serde(default)]
    values: BTreeMap<String, String>,
    when: Option<When>,
    #[serde(default)]
    initial_raw: u64,
    digital: Option<DigitalEntry>,
    #[serde(default)]
    alarm: AlarmEntry,
    colour: Option<String>,
}

fn one() -> f64 {
    1.0
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Order {
    #[serde(alias = "intel")]
    Little,
    #[serde(alias = "motorola")]
    Big,
}

#[derive(Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Kind {
    #[default]
    Unsigned,
    Signed,
    SignMagnitude,
    Half,
    Float,
    Double,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct When {
    signal: String,
    is: OneOrMany,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a number, a range such as \"3-5\", or a list of them")]
enum OneOrMany {
    One(Choice),
    Many(Vec<Choice>),
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a number or a range such as \"3-5\"")]
enum Choice {
    Value(u64),
    Range(String),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DigitalEntry {
    low: f64,
    high: f64,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct AlarmEntry {
    min: Option<f64>,
    max: Option<f64>,
}

/// Parses a signal file's content; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let faulty = |fault| DatabaseError::Faulty { file: file.to_owned(), faults: vec![fault] };
    let text = str::from_utf8(bytes).map_err(|error| {
        let line = Lines::of_bytes(bytes).line(error.valid_up_to());
        let kind = FaultKind::Syntax("a signal file is in UTF-8; this byte is not".to_owned());
        faulty(Fault { line, symbol: String::new(), kind })
    })?;
    let lines = Lines::of_bytes(bytes);
    let content: File = toml::from_str(text).map_err(|error| {
        let line = error.span().map_or(0, |span| lines.line(span.start));
        let kind = FaultKind::Syntax(error.message().to_owned());
        faulty(Fault { line, symbol: symbol_at(text, line), kind })
    })?;
    if *content.version.get_ref() != VERSION {
        let line = lines.line(content.version.span().start);
        let version = content.version.get_ref();
        let kind = FaultKind::Syntax(format!("this program reads version {VERSION}, the file has {version}"));
        return Err(faulty(Fault { line, symbol: "version".to_owned(), kind }));
    }
    let mut faults = Vec::new();
    let messages = content.message.into_iter().filter_map(|entry| {
        let line = lines.line(entry.span().start);
        message(entry.into_inner(), line, &lines, &mut faults)
    });
    let messages = messages.collect();
    validate::finish_strictly(file, messages, faults)
}

/// The message, or message and signal, in whose table a line is.
fn symbol_at(text: &str, line: u32) -> String {
    let mut tables: Vec<(u32, bool, &str)> = Vec::new();
    for (number, content) in (1..).zip(text.lines()) {
        let content = content.trim();
        if let Some(header) = content.strip_prefix("[[") {
            tables.push((number, header.trim_start().starts_with("message.signal"), ""));
        } else if let Some(value) =
            content.strip_prefix("name").and_then(|rest| rest.trim_start().strip_prefix('='))
            && let Some(table) = tables.last_mut()
        {
            table.2 = value.trim().split('"').nth(1).unwrap_or_default();
        }
    }
    let here = tables.partition_point(|&(first, ..)| first <= line);
    let Some(&(_, is_signal, name)) = tables[..here].last() else { return String::new() };
    if !is_signal {
        return name.to_owned();
    }
    let message = tables[..here].iter().rev().find(|&&(_, is_signal, _)| !is_signal);
    format!("{}.{name}", message.map_or("", |&(.., name)| name))
}

fn message(entry: MessageEntry, line: u32, lines: &Lines, faults: &mut Vec<Fault>) -> Option<Message> {
    let extended = entry.extended.unwrap_or(entry.id > u64::from(Id::MAX_STANDARD));
    let id = u32::try_from(entry.id).ok();
    let id = id.and_then(|id| if extended { Id::extended(id) } else { Id::standard(id) });
    let length = u16::try_from(entry.length).ok().filter(|&length| length <= validate::MAX_BYTES);
    let (Some(id), Some(length)) = (id, length) else {
        let kind =
            if id.is_none() { FaultKind::Id(entry.id) } else { FaultKind::MessageLength(entry.length) };
        faults.push(Fault { line, symbol: entry.name, kind });
        return None;
    };
    let mut signals = Vec::new();
    let mut conditions = Vec::new();
    for signal_entry in entry.signal {
        let line = lines.line(signal_entry.span().start);
        let signal_entry = signal_entry.into_inner();
        let symbol = format!("{}.{}", entry.name, signal_entry.name);
        match signal(signal_entry, line) {
            Ok((signal, when)) => {
                signals.push(signal);
                conditions.push((when, line, symbol));
            }
            Err(kind) => faults.push(Fault { line, symbol, kind }),
        }
    }
    for (place, (when, line, symbol)) in conditions.into_iter().enumerate() {
        let Some(when) = when else { continue };
        let switch = signals.iter().position(|signal| signal.name == when.signal);
        let kind = match (switch, ranges(when.is)) {
            (Some(switch), Ok(values)) => {
                signals[place].multiplexed = Some(Multiplexed { switch, values });
                continue;
            }
            (None, _) => {
                let name = when.signal;
                FaultKind::Syntax(format!("there is no signal {name:?} in this message to depend on"))
            }
            (_, Err(kind)) => kind,
        };
        faults.push(Fault { line, symbol, kind });
    }
    Some(Message {
        id,
        name: entry.name,
        description: entry.description,
        length,
        cycle_ms: entry.cycle_ms,
        j1939: entry.j1939 && id.is_extended(),
        container: None,
        signals,
        line,
    })
}

fn ranges(choices: OneOrMany) -> Result<Vec<RangeInclusive<u64>>, FaultKind> {
    let choices = match choices {
        OneOrMany::One(choice) => vec![choice],
        OneOrMany::Many(choices) => choices,
    };
    let range = |choice: Choice| match choice {
        Choice::Value(value) => Ok(value..=value),
        Choice::Range(text) => {
            let (low, high) = text.split_once('-').unwrap_or((&text, &text));
            match (low.trim().parse::<u64>(), high.trim().parse::<u64>()) {
                (Ok(low), Ok(high)) if low <= high => Ok(low..=high),
                _ => Err(FaultKind::Syntax(format!(
                    "{text:?} is not a range; write the lower value first, as in \"3-5\""
                ))),
            }
        }
    };
    choices.into_iter().map(range).collect()
}

fn signal(entry: SignalEntry, line: u32) -> Result<(Signal, Option<When>), FaultKind> {
    let order = entry.order.map(|order| match order {
        Order::Little => ByteOrder::Little,
        Order::Big => ByteOrder::Big,
    });
    let (start, length, order) = match (&entry.at, entry.start, entry.length) {
        (Some(at), None, None) => place_at(at, order)?,
        (None, Some(start), Some(length)) => place(start, length, order)?,
        _ => {
            let text = "say where it is, either at = \"D2:D3\" or start = 8 and length = 16";
            return Err(FaultKind::Syntax(text.to_owned()));
        }
    };
    let values = entry.values.into_iter().map(|(value, text)| match value.parse() {
        Ok(value) => Ok((value, text)),
        Err(_) => {
            Err(FaultKind::Syntax(format!("the text {text:?} stands for {value:?}, which is not an integer")))
        }
    });
    let values: Vec<_> = values.collect::<Result<_, _>>()?;
    let colour = entry.colour.map(|colour| {
        colour
            .parse::<Colour>()
            .map_err(|hint| FaultKind::Syntax(format!("{colour:?} is not a colour; {hint}")))
    });
    let kind = match entry.kind {
        Kind::Unsigned => ValueKind::Unsigned,
        Kind::Signed => ValueKind::Signed,
        Kind::SignMagnitude => ValueKind::SignMagnitude,
        Kind::Half => ValueKind::Half,
        Kind::Float => ValueKind::Single,
        Kind::Double => ValueKind::Double,
    };
    if entry.initial_raw > layout::mask(length) {
        let raw = entry.initial_raw;
        return Err(FaultKind::Syntax(format!(
            "initial_raw = {raw} does not fit {length}",
            length = counted(length, "bit")
        )));
    }
    let signal = Signal {
        description: entry.description,
        unit: entry.unit,
        order,
        kind,
        factor: entry.factor,
        offset: entry.offset,
        min: entry.min,
        max: entry.max,
        values: ValueTable::new(values),
        initial_raw: entry.initial_raw,
        digital: entry.digital.map(|digital| Digital { low: digital.low, high: digital.high }),
        alarms: Alarms { min: entry.alarm.min, max: entry.alarm.max },
        colour: colour.transpose()?,
        line,
        ..Signal::new(entry.name, start, length)
    };
    Ok((signal, entry.when))
}

type Place = (u16, u16, ByteOrder);

fn place(start: u64, length: u64, order: Option<ByteOrder>) -> Result<Place, FaultKind> {
    let size = match length {
        0 => return Err(FaultKind::NoBits),
        1..=64 => length as u16,
        _ => return Err(FaultKind::Syntax(format!("{length} bits are more than a number can have (64)"))),
    };
    let first = u16::try_from(start).ok().filter(|&start| start < validate::MAX_BYTES * 8);
    let first = first.ok_or(FaultKind::Start(start))?;
    let order = match order {
        Some(order) => order,
        None if first % 8 + size <= 8 => ByteOrder::Little,
        None => return Err(order_missing()),
    };
    Ok((first, size, order))
}

fn order_missing() -> FaultKind {
    let text = "it spans several bytes: say order = \"big\" (Motorola, first byte most significant) or \"little\" (Intel)";
    FaultKind::Syntax(text.to_owned())
}

/// `D2`, `D2:D3`, `D1.5`, `D1.7-4`: bytes count from 1, bits from 0 at the least significant.
fn place_at(at: &str, order: Option<ByteOrder>) -> Result<Place, FaultKind> {
    let bad = || {
        FaultKind::Syntax(format!(
            "at = {at:?} is not a place; write \"D2\", \"D2:D3\", \"D1.5\" or \"D1.7-4\""
        ))
    };
    let byte = |text: &str| {
        let number = text.trim().strip_prefix(['D', 'd']).and_then(|digits| digits.parse::<u16>().ok());
        number.filter(|number| (1..=validate::MAX_BYTES).contains(number)).ok_or_else(bad)
    };
    if let Some((data, bits)) = at.split_once('.') {
        let (high, low) = bits.split_once('-').unwrap_or((bits, bits));
        let bit = |text: &str| text.trim().parse::<u16>().ok().filter(|&bit| bit < 8).ok_or_else(bad);
        let (first, high, low) = (byte(data)? - 1, bit(high)?, bit(low)?);
        if high < low {
            return Err(bad());
        }
        let order = order.unwrap_or(ByteOrder::Little);
        let start = if order == ByteOrder::Big { high } else { low };
        return Ok((first * 8 + start, high - low + 1, order));
    }
    let (first, last) = at.split_once(':').unwrap_or((at, at));
    let (first, last) = (byte(first)? - 1, byte(last)? - 1);
    if last < first || last - first >= 8 {
        return Err(bad());
    }
    let order = match order {
        Some(order) => order,
        None if first == last => ByteOrder::Little,
        None => return Err(order_missing()),
    };
    let start = first * 8 + if order == ByteOrder::Big { 7 } else { 0 };
    Ok((start, (last - first + 1) * 8, order))
}
