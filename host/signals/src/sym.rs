//! Databases from SYM files, PCAN's symbols, versions 5 and 6.
//!
//! For Motorola signals (`-m`), a start bit counts from the highest bit of the first byte. The blocks of one symbol, of
//! which only the first has an identifier, are the values of its multiplexer.

use std::collections::HashMap;

use cantap_can::Id;

use super::dbc_text;
use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::{ByteOrder, wire_position};
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::unflagged::Unflagged;
use super::{layout, validate};

/// Parses a SYM file's content; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    let (text, encoding) = dbc_text::decode(bytes);
    let is_head = |line: &str| line.trim_start().starts_with("FormatVersion");
    if !text.lines().any(is_head) {
        let reason = if text.trim().is_empty() {
            "the file is empty; is it the right one, and was it copied to its end?"
        } else {
            "there is no line FormatVersion=, as every SYM file has"
        };
        let fault = Fault { line: 0, symbol: String::new(), kind: FaultKind::Syntax(reason.to_owned()) };
        return Err(DatabaseError::Faulty { file: file.to_owned(), faults: vec![fault] });
    }
    let mut reader = Reader::default();
    for (line, content) in statements(&text) {
        reader.statement(line, &content);
    }
    let unusual = encoding.map(|name| FaultKind::Encoding(name).of_whole_file());
    let mut faults: Vec<_> = unusual.into_iter().chain(std::mem::take(&mut reader.faults)).collect();
    let messages = reader.messages(&mut faults);
    validate::finish(file, messages, faults)
}

/// Joins lines that belong together: an enumeration may span several, each with a comment.
fn statements(text: &str) -> Vec<(u32, Statement)> {
    let mut statements: Vec<(u32, Statement)> = Vec::new();
    let mut open = false;
    for (number, line) in (1..).zip(text.lines()) {
        let (content, comment) = split_comment(line);
        let content = content.trim();
        if open {
            if let Some((_, last)) = statements.last_mut() {
                last.content.push(' ');
                last.content.push_str(content);
                open = !is_closed(&last.content);
            }
        } else if !content.is_empty() {
            let lower = content.to_ascii_lowercase();
            let is_enum = lower.starts_with("enum=") || lower.starts_with("enum ");
            open = is_enum && !is_closed(content);
            statements.push((number, Statement { content: content.to_owned(), comment: comment.to_owned() }));
        }
    }
    statements
}

/// A statement and the comment after it.
struct Statement {
    content: String,
    comment: String,
}

/// Cuts off `// comment`, unless it is within quotes.
fn split_comment(line: &str) -> (&str, &str) {
    let mut quoted = false;
    for (at, character) in line.char_indices() {
        match character {
            '"' => quoted = !quoted,
            '/' if !quoted && line[at..].starts_with("//") => return (&line[..at], line[at + 2..].trim()),
            _ => {}
        }
    }
    (line, "")
}

/// Whether an enumeration's parenthesis is closed.
fn is_closed(text: &str) -> bool {
    let mut quoted = false;
    text.chars().any(|character| {
        quoted ^= character == '"';
        character == ')' && !quoted
    })
}

/// Splits into words, removing quotes: `"A B"`, `/u:"A B"`.
fn words(text: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut quoted = false;
    for character in text.chars() {
        match character {
            '"' => quoted = !quoted,
            character if character.is_whitespace() && !quoted => words.push(String::new()),
            character => {
                if let Some(word) = words.last_mut() {
                    word.push(character);
                }
            }
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

/// `12`, `-3`, `1Fh`.
fn integer(text: &str) -> Option<i64> {
    match text.strip_suffix(['h', 'H']) {
        Some(hex) => i64::from_str_radix(hex, 16).ok(),
        None => super::xml::integer(text).and_then(|value| i64::try_from(value).ok()),
    }
}

#[derive(Default)]
struct Reader {
    faults: Vec<Fault>,
    enums: HashMap<String, ValueTable>,
    /// Signals that blocks refer to.
    signals: HashMap<String, Signal>,
    blocks: Vec<Block>,
    in_block: bool,
}

/// The content under one `[Symbol]`.
struct Block {
    name: String,
    line: u32,
    ids: Option<(u32, u32, usize)>,
    kind: Option<String>,
    length: Option<u64>,
    cycle_ms: Option<u32>,
    comment: String,
    switch: Option<(Signal, u64)>,
    signals: Vec<Signal>,
    is_bad: bool,
}

impl Reader {
    fn statement(&mut self, line: u32, statement: &Statement) {
        let content = statement.content.as_str();
        if content.starts_with('{') {
            self.in_block = false;
            return;
        }
        if let Some(name) = content.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            self.in_block = true;
            self.blocks.push(Block {
                name: name.trim().trim_matches('"').to_owned(),
                line,
                ids: None,
                kind: None,
                length: None,
                cycle_ms: None,
                comment: String::new(),
                switch: None,
                signals: Vec::new(),
                is_bad: false,
            });
            return;
        }
        let lower = content.to_ascii_lowercase();
        if lower.starts_with("enum=") || lower.starts_with("enum ") {
            self.enumeration(&content[5..]);
            return;
        }
        let Some((key, rest)) = content.split_once('=') else { return };
        if let Err(kind) = self.entry(key.trim(), rest.trim(), line, &statement.comment) {
            let block = self.blocks.last_mut().filter(|_| self.in_block);
            let symbol = block.as_ref().map_or(String::new(), |block| block.name.clone());
            if let Some(block) = block {
                block.is_bad |= !kind.is_warning();
            }
            // A faulty signal that nothing refers to does no harm; one that is referred to is then missing.
            let kind = if self.in_block { kind } else { FaultKind::Ignored(kind.to_string()) };
            self.faults.push(Fault { line, symbol, kind });
        }
    }

    fn enumeration(&mut self, text: &str) {
        let Some((name, values)) = text.split_once('(') else { return };
        let values = values.rsplit_once(')').map_or(values, |(values, _)| values);
        let mut texts = Vec::new();
        let mut rest = values;
        while let Some((value, after)) = rest.split_once('=') {
            let Some((_, after)) = after.split_once('"') else { break };
            let Some((text, after)) = after.split_once('"') else { break };
            if let Some(value) = integer(value.trim().trim_start_matches(',').trim()) {
                texts.push((value, text.to_owned()));
            }
            rest = after;
        }
        self.enums.insert(name.trim().trim_matches('"').to_owned(), ValueTable::new(texts));
    }

    fn entry(&mut self, key: &str, rest: &str, line: u32, comment: &str) -> Result<(), FaultKind> {
        let words = words(rest);
        let bad = |what: &str| FaultKind::Syntax(format!("{key}={rest} is not a valid {what}"));
        let first = words.first().map_or("", String::as_str);
        if !self.in_block {
            if key.eq_ignore_ascii_case("Sig") {
                let signal = self.signal(&words, false, line, comment)?;
                self.signals.insert(first.to_owned(), signal);
            }
            return Ok(());
        }
        let known = match key.to_ascii_lowercase().as_str() {
            "sig" => {
                let start =
                    words.get(1).and_then(|start| integer(start)).ok_or_else(|| bad("Sig=NAME START"))?;
                let signal = self.signals.get(first);
                let signal = signal.ok_or_else(|| {
                    FaultKind::Syntax(format!("there is no signal {first:?} under {{SIGNALS}}"))
                })?;
                Some(at(Signal { line, ..signal.clone() }, start)?)
            }
            "var" => Some(self.signal(&words, true, line, comment)?),
            _ => None,
        };
        let Some(block) = self.blocks.last_mut() else { return Ok(()) };
        match (key.to_ascii_lowercase().as_str(), known) {
            (_, Some(signal)) => block.signals.push(signal),
            ("id", _) => {
                let (low, high) = rest.split_once('-').unwrap_or((first, first));
                let parse = |text: &str| integer(text.trim()).and_then(|id| u32::try_from(id).ok());
                let (low_id, high_id) = parse(low).zip(parse(high)).ok_or_else(|| bad("ID=NUMBERh"))?;
                let digits = low.trim().trim_end_matches(['h', 'H']).len();
                block.ids = Some((low_id, high_id, digits));
                comment.clone_into(&mut block.comment);
            }
            ("type", _) => block.kind = Some(first.to_ascii_lowercase()),
            ("len" | "dlc", _) => {
                block.length = Some(
                    integer(first)
                        .and_then(|length| u64::try_from(length).ok())
                        .ok_or_else(|| bad("length"))?,
                );
            }
            ("cycletime", _) => block.cycle_ms = first.parse().ok().filter(|&cycle| cycle > 0),
            ("mux", _) => {
                // Mux=NAME START,LENGTH VALUE -m
                let place = words.get(1).and_then(|place| place.split_once(','));
                let place = place.and_then(|(start, length)| Some((integer(start)?, integer(length)?)));
                let value =
                    words.get(2).and_then(|value| integer(value)).and_then(|value| u64::try_from(value).ok());
                let ((start, length), value) =
                    place.zip(value).ok_or_else(|| bad("Mux=NAME START,LENGTH VALUE"))?;
                // Without bits, it is a name for the only variant.
                if length > 0 {
                    let order = order_of(&words);
                    let length = u16::try_from(length)
                        .ok()
                        .filter(|&length| length <= 64)
                        .ok_or_else(|| bad("multiplexer"))?;
                    let signal = Signal { order, is_switch: true, line, ..Signal::new(first, 0, length) };
                    block.switch = Some((at(signal, start)?, value));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// `NAME TYPE [START,LENGTH | LENGTH] /u:UNIT /f:FACTOR …`.
    fn signal(&self, words: &[String], placed: bool, line: u32, comment: &str) -> Result<Signal, FaultKind> {
        let [name, kind, rest @ ..] = words else {
            return Err(FaultKind::Syntax("a signal has a name and a type".to_owned()));
        };
        let place = rest.first().filter(|word| !word.starts_with(['/', '-'])).map(String::as_str);
        let (start, length) = match place.map(|place| place.split_once(',')) {
            Some(Some((start, length))) => (integer(start), integer(length)),
            Some(None) if placed => (place.and_then(integer), None),
            Some(None) => (Some(0), place.and_then(integer)),
            None => (Some(0), None),
        };
        let fixed = match kind.as_str() {
            "bit" => Some(1),
            "char" => Some(8),
            "float" => Some(32),
            "double" => Some(64),
            _ => None,
        };
        let length = match length.or(fixed) {
            Some(0) => return Err(FaultKind::NoBits),
            Some(length @ 1..=64) => length as u16,
            Some(length) => return Err(FaultKind::TooManyBits(length.unsigned_abs())),
            None => return Err(FaultKind::Syntax(format!("{name} has no length"))),
        };
        let start = start.ok_or_else(|| FaultKind::Syntax(format!("{name} has no start bit")))?;
        let mut signal = Signal {
            kind: match kind.as_str() {
                "signed" => ValueKind::Signed,
                "float" => ValueKind::Single,
                "double" => ValueKind::Double,
                _ => ValueKind::Unsigned,
            },
            order: order_of(words),
            description: comment.to_owned(),
            values: self.enums.get(kind).cloned().unwrap_or_default(),
            line,
            ..Signal::new(name.as_str(), 0, length)
        };
        let mut initial = None;
        for word in rest {
            let Some((option, value)) = word.split_once(':') else { continue };
            let number = || {
                let value = value.parse::<f64>();
                value.map_err(|_| FaultKind::Syntax(format!("{word} of {name} is not a number")))
            };
            match option {
                "/u" => value.clone_into(&mut signal.unit),
                "/f" => signal.factor = number()?,
                "/o" => signal.offset = number()?,
                "/min" => signal.min = Some(number()?),
                "/max" => signal.max = Some(number()?),
                "/e" => signal.values = self.enums.get(value).cloned().unwrap_or_default(),
                "/d" => initial = value.parse::<f64>().ok(),
                _ => {}
            }
        }
        if let Some(initial) = initial {
            let raw = (initial - signal.offset) / signal.factor;
            signal.initial_raw = raw.round() as i64 as u64 & layout::mask(length);
        }
        if placed { at(signal, start) } else { Ok(signal) }
    }

    /// Combines blocks of the same name.
    fn messages(self, faults: &mut Vec<Fault>) -> Vec<Message> {
        let (mut groups, mut names) = (Vec::<Vec<Block>>::new(), HashMap::<String, usize>::new());
        for block in self.blocks {
            // A block without identifiers goes on with the last one of its name.
            if let Some(at) = names.get(&block.name).filter(|_| block.ids.is_none()) {
                groups[*at].push(block);
            } else {
                names.insert(block.name.clone(), groups.len());
                groups.push(vec![block]);
            }
        }
        let mut unflagged = Unflagged::default();
        let messages =
            groups.into_iter().flat_map(|group| messages_of(&group, &mut unflagged, faults)).collect();
        faults.extend(unflagged.warning());
        messages
    }
}

/// The byte order according to the options.
fn order_of(words: &[String]) -> ByteOrder {
    if words.iter().any(|word| word == "-m") { ByteOrder::Big } else { ByteOrder::Little }
}

/// The signal at this start bit.
fn at(signal: Signal, start: i64) -> Result<Signal, FaultKind> {
    let place = u16::try_from(start).ok().filter(|&start| start < validate::MAX_BYTES * 8);
    let place = place.ok_or(FaultKind::Start(start.unsigned_abs()))?;
    let start = if signal.order == ByteOrder::Big { wire_position(place.into()) as u16 } else { place };
    Ok(Signal { start, ..signal })
}

/// No symbol has a range of more identifiers.
const MOST_IDS: u32 = 256;

/// A symbol's messages: one for each identifier.
fn messages_of(group: &[Block], unflagged: &mut Unflagged, faults: &mut Vec<Fault>) -> Vec<Message> {
    let head = &group[0];
    if group.iter().any(|block| block.is_bad) {
        return Vec::new();
    }
    let mut fault = |kind| {
        faults.push(Fault { line: head.line, symbol: head.name.clone(), kind });
        Vec::new()
    };
    let Some((low, high, digits)) = head.ids else {
        return fault(FaultKind::Syntax("the symbol has no identifier".to_owned()));
    };
    let extended = match head.kind.as_deref() {
        Some(kind) => kind.contains("extended"),
        None => digits == 8 || low > Id::MAX_STANDARD,
    };
    let length = group.iter().filter_map(|block| block.length).max().unwrap_or(8);
    let Some(length) = u16::try_from(length).ok().filter(|&length| length <= validate::MAX_BYTES) else {
        return fault(FaultKind::MessageLength(length));
    };
    let mut signals = Vec::new();
    let switch = group.iter().find_map(|block| block.switch.as_ref());
    signals.extend(switch.map(|(signal, _)| signal.clone()));
    for block in group {
        let multiplexed =
            block.switch.as_ref().map(|&(_, value)| Multiplexed { switch: 0, values: vec![value..=value] });
        signals.extend(
            block.signals.iter().map(|signal| Signal { multiplexed: multiplexed.clone(), ..signal.clone() }),
        );
    }
    if high < low || high - low >= MOST_IDS {
        return fault(FaultKind::Syntax(format!("the identifiers {low:X}h to {high:X}h are no range")));
    }
    let mut messages = Vec::new();
    for raw in low..=high {
        let Some(id) = unflagged.id(raw, extended, &head.name, head.line) else {
            return fault(FaultKind::Id(raw.into()));
        };
        messages.push(Message {
            id,
            name: head.name.clone(),
            description: head.comment.clone(),
            length,
            cycle_ms: head.cycle_ms,
            j1939: false,
            container: None,
            signals: signals.clone(),
            line: head.line,
        });
    }
    messages
}
