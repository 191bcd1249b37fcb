//! Databases from DBF files, BUSMASTER's.
//!
//! A signal's byte and bit are those of its least significant bit, in both byte orders. Source: BUSMASTER's own converters to and from DBC; canmatrix reads
//! the same of it.

use cantap_can::Id;

use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::{ByteOrder, wire_position};
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::unflagged::Unflagged;
use super::{dbc_parse, dbc_text, validate};

/// What a database has at least one of.
const TAGS: [&str; 2] = ["[START_MSG]", "[NUMBER_OF_MESSAGES]"];

/// Parses a DBF file's content; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let (text, encoding) = dbc_text::decode(bytes);
    let mut lines = text.lines().map(str::trim_start);
    if !lines.any(|line| TAGS.iter().any(|tag| line.starts_with(tag))) {
        let reason = "there is no [NUMBER_OF_MESSAGES], as every database of BUSMASTER has";
        let fault = Fault { line: 0, symbol: String::new(), kind: FaultKind::Syntax(reason.to_owned()) };
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults: vec![fault] });
    }
    let mut reader = Reader::default();
    for (number, line) in (1..).zip(text.lines()) {
        reader.line(number, line.trim());
    }
    reader.end_message();
    let unusual = encoding.map(|name| FaultKind::Encoding(name).of_whole_file());
    let faults = unusual.into_iter().chain(reader.faults).chain(reader.unflagged.warning()).collect();
    validate::finish(file, reader.messages, faults)
}

/// What the lines of a section say.
#[derive(Clone, Copy, Default, PartialEq)]
enum Section {
    #[default]
    Messages,
    MessageComments,
    SignalComments,
    MessageValues,
    /// One that decoding does not need.
    Other,
}

#[derive(Default)]
struct Reader {
    section: Section,
    is_j1939: bool,
    messages: Vec<Message>,
    faults: Vec<Fault>,
    unflagged: Unflagged,
    /// The message whose lines are read; `None` if it is left out.
    open: Option<Message>,
    /// The values of the multiplexer for which each of its signals is present.
    multiplexed: Vec<Option<u64>>,
    values: Vec<(i64, String)>,
}

impl Reader {
    fn line(&mut self, number: u32, line: &str) {
        if let Some(tag) = line.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
            self.tag(number, tag.0, tag.1.trim());
            return;
        }
        if line.is_empty() || line.starts_with("//") {
            return;
        }
        match self.section {
            Section::MessageComments | Section::SignalComments => self.comment(number, line),
            Section::MessageValues => self.value_of_message(line),
            Section::Messages | Section::Other => {}
        }
    }

    fn tag(&mut self, number: u32, tag: &str, rest: &str) {
        match tag {
            "PROTOCOL" => self.is_j1939 = rest.eq_ignore_ascii_case("J1939"),
            "START_MSG" => {
                self.end_message();
                match self.message(number, rest) {
                    Ok(message) => self.open = message,
                    Err(kind) => self.fault(number, rest.split(',').next().unwrap_or_default(), kind),
                }
            }
            "START_SIGNALS" => {
                self.end_signal();
                self.signal(number, rest);
            }
            "VALUE_DESCRIPTION" => {
                // The text may have commas, and no quotation marks.
                let Some((text, value)) = rest.rsplit_once(',') else { return };
                let Ok(value) = value.trim().parse() else { return };
                self.values.push((value, text.trim().trim_matches('"').to_owned()));
            }
            "END_MSG" => self.end_message(),
            "START_DESC_MSG" => self.section = Section::MessageComments,
            "START_DESC_SIG" => self.section = Section::SignalComments,
            "START_PARAM_MSG_VAL" => self.section = Section::MessageValues,
            _ if tag.starts_with("START_") => self.section = Section::Other,
            _ if tag.starts_with("END_") => self.section = Section::Messages,
            _ => {}
        }
    }

    fn fault(&mut self, line: u32, symbol: &str, kind: FaultKind) {
        self.faults.push(Fault { line, symbol: symbol.to_owned(), kind });
    }

    /// `NAME,ID,LENGTH,SIGNALS,ORDER,S or X,NODE`; `None` if it is the one that holds the signals of no message.
    fn message(&mut self, line: u32, rest: &str) -> Result<Option<Message>, FaultKind> {
        let mut parts = rest.split(',').map(str::trim);
        let mut next = || parts.next().unwrap_or_default();
        let [name, id, length, _, _, format] = [(); 6].map(|()| next());
        if name == dbc_parse::NO_MESSAGE {
            return Ok(None);
        }
        let bad = |what: &str| FaultKind::Syntax(format!("{rest} has no valid {what}"));
        let raw: u32 = id.parse().map_err(|_| bad("identifier"))?;
        let length: u64 = length.parse().map_err(|_| bad("length"))?;
        let length = u16::try_from(length)
            .ok()
            .filter(|length| *length <= validate::MAX_BYTES)
            .ok_or(FaultKind::MessageLength(length))?;
        let id = if self.is_j1939 { group(raw) } else { self.id(line, name, raw, format) };
        Ok(Some(Message {
            id: id.ok_or(FaultKind::Id(raw.into()))?,
            name: name.to_owned(),
            description: String::new(),
            length,
            cycle_ms: None,
            j1939: self.is_j1939,
            container: None,
            signals: Vec::new(),
            line,
        }))
    }

    fn id(&mut self, line: u32, name: &str, raw: u32, format: &str) -> Option<Id> {
        let is_extended = format.eq_ignore_ascii_case("X") || raw & FLAG != 0;
        self.unflagged.id(raw & !FLAG, is_extended, name, line)
    }

    /// `NAME,BITS,BYTE,BIT,TYPE,MAX,MIN,ORDER,OFFSET,FACTOR,UNIT,MULTIPLEXING,NODES`.
    fn signal(&mut self, line: u32, rest: &str) {
        let Some(message) = &self.open else { return };
        let name = rest.split(',').next().unwrap_or_default().trim();
        let symbol = format!("{}.{name}", message.name);
        match signal(line, rest) {
            Ok((signal, present)) => {
                if let Some(message) = &mut self.open {
                    message.signals.push(signal);
                    self.multiplexed.push(present);
                }
            }
            Err(kind @ FaultKind::TooManyBits(_)) => self.fault(line, &symbol, kind),
            Err(kind) => {
                // Without one of its signals the message would say less than the file.
                self.fault(line, &symbol, kind);
                self.open = None;
                self.multiplexed.clear();
            }
        }
    }

    fn end_signal(&mut self) {
        let values = std::mem::take(&mut self.values);
        let last = self.open.as_mut().and_then(|message| message.signals.last_mut());
        if let Some(signal) = last.filter(|_| !values.is_empty()) {
            signal.values = ValueTable::new(values);
        }
    }

    fn end_message(&mut self) {
        self.end_signal();
        let present = std::mem::take(&mut self.multiplexed);
        let Some(mut message) = self.open.take() else { return };
        let switch = message.signals.iter().position(|signal| signal.is_switch);
        for (signal, value) in message.signals.iter_mut().zip(present) {
            let Some(value) = value else { continue };
            if let Some(switch) = switch {
                signal.multiplexed = Some(Multiplexed { switch, values: vec![value..=value] });
            } else {
                let kind = FaultKind::NoMultiplexer("M".to_owned());
                self.faults.push(Fault { line: signal.line, symbol: signal.name.clone(), kind });
            }
        }
        self.messages.push(message);
    }

    /// Those of this identifier.
    fn known(&mut self, id: &str, format: &str) -> Option<&mut Message> {
        let raw: u32 = id.trim().parse().ok()?;
        let id = if self.is_j1939 {
            group(raw)?
        } else if format.trim() == "X" || raw & FLAG != 0 || raw > Id::MAX_STANDARD {
            Id::extended(raw & !FLAG)?
        } else {
            Id::standard(raw)?
        };
        self.messages.iter_mut().find(|message| message.id == id)
    }

    /// `ID S "text";`, or `ID S SIGNAL "text";`.
    fn comment(&mut self, line: u32, content: &str) {
        let is_of_signal = self.section == Section::SignalComments;
        let Some((head, text)) = content.split_once('"') else { return };
        let text = text.trim_end_matches(';').trim_end().trim_end_matches('"');
        let mut words = head.split_whitespace();
        let (id, format) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        let name = words.next();
        let message = self.known(id, format);
        let place = match (message, name) {
            (Some(message), Some(name)) if is_of_signal => message
                .signals
                .iter_mut()
                .find(|signal| signal.name == name)
                .map(|signal| &mut signal.description),
            (Some(message), None) if !is_of_signal => Some(&mut message.description),
            _ => None,
        };
        match place {
            Some(place) => text.clone_into(place),
            None => self.fault(line, head.trim(), FaultKind::UnknownSymbol),
        }
    }

    /// `ID,S,"NAME",VALUE`.
    fn value_of_message(&mut self, content: &str) {
        let mut parts = content.split(',').map(str::trim);
        let mut next = || parts.next().unwrap_or_default();
        let [id, format, name, value] = [(); 4].map(|()| next());
        if name.trim_matches('"') != "GenMsgCycleTime" {
            return;
        }
        let cycle = value.trim_matches(|mark: char| mark == '"' || mark == ';').parse().ok();
        if let Some(message) = self.known(id, format) {
            message.cycle_ms = cycle.filter(|cycle| *cycle > 0);
        }
    }
}

/// The flag of 29 bits, which files made of DBC files may have in their identifiers.
const FLAG: u32 = 0x8000_0000;

/// The identifier of a parameter group, which stands in a file for J1939 in its place: priority and source do not matter.
fn group(number: u32) -> Option<Id> {
    const MOST: u32 = 0x3_FFFF;
    Id::extended(if number > MOST { number & !FLAG } else { number << 8 | 0xFE })
}

/// A signal, and the value of the multiplexer for which it is present.
fn signal(line: u32, rest: &str) -> Result<(Signal, Option<u64>), FaultKind> {
    let mut parts = rest.split(',').map(str::trim);
    let mut next = || parts.next().unwrap_or_default();
    let [name, bits, byte, bit, kind, max, min, order, offset, factor, unit, multiplexing] =
        [(); 12].map(|()| next());
    let bad = |what: &str| FaultKind::Syntax(format!("{rest} has no valid {what}"));
    let number = |text: &str, what: &str| text.parse::<u64>().map_err(|_| bad(what));
    let length = match number(bits, "length")? {
        0 => return Err(FaultKind::NoBits),
        length @ 1..=64 => length as u16,
        length => return Err(FaultKind::TooManyBits(length)),
    };
    let (byte, bit) = (number(byte, "byte")?, number(bit, "bit")?);
    if byte == 0 || bit > 7 {
        return Err(bad("place: a byte from 1 and a bit from 0 to 7"));
    }
    let lowest = (byte - 1).saturating_mul(8).saturating_add(bit);
    let lowest = u32::try_from(lowest).ok().filter(|place| *place < u32::from(validate::MAX_BYTES) * 8);
    let lowest = lowest.ok_or(FaultKind::Start(byte.saturating_mul(8)))?;
    let (order, start) = match order {
        "1" => (ByteOrder::Little, lowest),
        "0" => {
            let highest = (wire_position(lowest) + 1).checked_sub(length.into());
            (
                ByteOrder::Big,
                wire_position(highest.ok_or_else(|| bad("place: it begins before the message"))?),
            )
        }
        _ => return Err(bad("byte order: 1 is Intel, 0 Motorola")),
    };
    let decimal = |text: &str, what: &str| text.parse::<f64>().map_err(|_| bad(what));
    let (offset, factor) = (decimal(offset, "offset")?, decimal(factor, "factor")?);
    let is_float = matches!(kind, "F" | "D");
    let value_kind = match kind {
        "B" | "U" => ValueKind::Unsigned,
        "I" => ValueKind::Signed,
        "F" | "D" if length == 16 => ValueKind::Half,
        "F" | "D" if length <= 32 => ValueKind::Single,
        "F" | "D" => ValueKind::Double,
        _ => return Err(bad("type: one of B, I, U, F and D")),
    };
    // Limits are raw values; some versions write the largest of 64 bits as -1.
    let limit = |text: &str| {
        let raw = text.parse::<f64>().ok().filter(|raw| value_kind != ValueKind::Unsigned || *raw >= 0.0)?;
        Some(if is_float { raw } else { raw * factor + offset })
    };
    let (min, max) = (limit(min), limit(max));
    let (min, max) = match (min, max) {
        (Some(min), Some(max)) => (Some(min.min(max)), Some(min.max(max))),
        both => both,
    };
    let present = match multiplexing.strip_prefix('m') {
        Some(value) => Some(number(value, "multiplexing: M, or m and a value")?),
        None => None,
    };
    let signal = Signal {
        order,
        kind: value_kind,
        factor,
        offset,
        min,
        max,
        unit: unit.to_owned(),
        is_switch: multiplexing == "M",
        line,
        ..Signal::new(name, start as u16, length)
    };
    Ok((signal, present))
}
