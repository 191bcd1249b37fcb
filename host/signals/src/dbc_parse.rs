//! Converts a DBC file's text to can-dbc's tables, leaving out what cannot be understood.
//!
//! can-dbc accepts or refuses a file as a whole. So a file that it refuses is passed to it statement by statement, and
//! each part it refuses is left out with a warning: a message with its signals, or a single statement about them.

use std::borrow::Cow;
use std::collections::HashSet;
use std::ops::{Range, RangeInclusive};

use can_dbc::{Dbc, DbcError};
use cantap_can::Id;
use pest::error::{ErrorVariant, LineColLocation};

use super::dbc_text::{self, Index, Statement};
use super::fault::{Fault, FaultKind};

/// Holds signals that belong to no message, under an identifier that no frame can have.
pub const NO_MESSAGE: &str = "VECTOR__INDEPENDENT_SIG_MSG";

/// The flag of an extended identifier in a DBC file.
const EXTENDED: u64 = 1 << 31;

/// The identifiers that need 29 bits.
const LONG_IDS: RangeInclusive<u64> = 0x800..=0x1FFF_FFFF;

/// The identifier for a number in the file, if a frame can have it.
pub fn id_of(written: u64) -> Option<Id> {
    match u32::try_from(written & !EXTENDED) {
        Ok(raw) if written & EXTENDED != 0 => Id::extended(raw),
        Ok(raw) => Id::standard(raw),
        Err(_) => None,
    }
}

/// The tables, and where in the text their content is. `None` if the text is not a DBC file at all; the faults then say why.
pub fn parse(text: &str, faults: &mut Vec<Fault>) -> Option<(Dbc, Index)> {
    let index = Index::of(text);
    if index.statements.is_empty() {
        let reason = if text.trim().is_empty() {
            "the file is empty; is it the right one, and was it copied to its end?".to_owned()
        } else {
            "no statement of a DBC file is in it, such as BO_ or SG_".to_owned()
        };
        faults.push(Fault { line: 0, symbol: String::new(), kind: FaultKind::Syntax(reason) });
        return None;
    }
    let (flagged, index) = with_flags(text, index, faults);
    let (mut text, mut index) = without_bad_ids(&flagged, index, faults);
    let mut error = match try_parse(&text) {
        Ok(dbc) => return Some((dbc, index)),
        Err(error) => error,
    };
    text = without_bad_statements(&text, faults).into();
    index = Index::of(&text);
    // Statements that are right individually are right together. Should can-dbc ever disagree, it says where.
    for _ in 0..=index.statements.len() {
        match try_parse(&text) {
            Ok(dbc) => return Some((dbc, index)),
            Err(other) => error = other,
        }
        let (line, reason) = explain(&error, &text);
        let Some(place) = index.place_at(line) else { break };
        let block = block(&index.statements, place);
        let range = range_of(&index.statements[block.clone()]);
        if text[range.clone()].trim().is_empty() {
            break;
        }
        faults.push(fault(&index.statements[place], line, reason, false));
        let mut blanks = Blanks::of(&text);
        blanks.blank(range);
        text = blanks.text().into();
        index = Index::of(&text);
    }
    let (line, reason) = explain(&error, &text);
    let statement = index.place_at(line).map(|place| &index.statements[place]);
    let symbol = statement.map(|statement| statement.symbol.clone()).unwrap_or_default();
    faults.push(Fault { line, symbol, kind: FaultKind::Syntax(reason) });
    None
}

fn try_parse(text: &str) -> Result<Dbc, DbcError> {
    // can-dbc's grammar requires a line end after a file's last line.
    Dbc::try_from(format!("{text}\n").as_str())
}

/// The text with the flag on each identifier that needs 29 bits, in everything said about these messages: many files
/// lack it. With the flag can-dbc keeps all bits.
fn with_flags<'a>(text: &'a str, index: Index, faults: &mut Vec<Fault>) -> (Cow<'a, str>, Index) {
    let is_unflagged = |(id, name, _): &&(u64, String, u32)| LONG_IDS.contains(id) && name != NO_MESSAGE;
    let mut unflagged = index.messages.iter().filter(is_unflagged);
    let Some((first, name, line)) = unflagged.next() else { return (Cow::Borrowed(text), index) };
    let kind = FaultKind::UnflaggedIds { id: *first, messages: 1 + unflagged.count() };
    faults.push(Fault { line: *line, symbol: name.clone(), kind });
    let ids: HashSet<_> = index.messages.iter().filter(is_unflagged).map(|&(id, ..)| id).collect();
    let (mut flagged, mut used) = (String::with_capacity(text.len() + 2 * index.statements.len()), 0);
    for statement in &index.statements {
        let Some(place) = dbc_text::id_place(&text[statement.range.clone()]) else { continue };
        let place = statement.range.start + place.start..statement.range.start + place.end;
        if let Some(id) = text[place.clone()].parse().ok().filter(|id| ids.contains(id)) {
            flagged.push_str(&text[used..place.start]);
            flagged.push_str(&(id | EXTENDED).to_string());
            used = place.end;
        }
    }
    flagged.push_str(&text[used..]);
    let index = Index::of(&flagged);
    (flagged.into(), index)
}

/// Leaves out messages whose identifier no frame can have, and everything said about them: can-dbc keeps 16 bits of a
/// standard identifier and would attach those statements to another message.
fn without_bad_ids<'a>(text: &'a str, index: Index, faults: &mut Vec<Fault>) -> (Cow<'a, str>, Index) {
    let mut bad = HashSet::new();
    for (id, name, line) in &index.messages {
        if id_of(*id).is_none() && name != NO_MESSAGE {
            let kind = FaultKind::LeftOut(FaultKind::Id(*id).into());
            faults.push(Fault { line: *line, symbol: name.clone(), kind });
            bad.insert(id.to_string());
        }
    }
    if bad.is_empty() {
        return (Cow::Borrowed(text), index);
    }
    let blanked = without_messages(text, &index, &bad);
    let index = Index::of(&blanked);
    (blanked.into(), index)
}

/// The text with messages of these identifiers, as written in the file, and everything said about them replaced by
/// spaces.
fn without_messages(text: &str, index: &Index, ids: &HashSet<String>) -> String {
    let mut blanks = Blanks::of(text);
    let mut place = 0;
    while place < index.statements.len() {
        let block = block(&index.statements, place);
        let range = range_of(&index.statements[block.clone()]);
        if dbc_text::id(&text[range.clone()]).is_some_and(|id| ids.contains(id)) {
            blanks.blank(range);
        }
        place = block.end;
    }
    blanks.text()
}

/// The text with each statement that can-dbc refuses replaced by spaces; a message goes with its signals.
fn without_bad_statements(text: &str, faults: &mut Vec<Fault>) -> String {
    let mut blanks = Blanks::of(text);
    let mut index = Index::of(text);
    let mut place = 0;
    // Signals at the beginning of a block belong to a message that was left out.
    let mut left_out = false;
    // Without these statements, a message's signals would have other values or appear at other times.
    let mut messages = HashSet::new();
    while place < index.statements.len() {
        let block = block(&index.statements, place);
        let range = range_of(&index.statements[block.clone()]);
        let piece = &text[range.clone()];
        let first = &index.statements[place];
        let is_orphan = first.keyword == "SG_";
        let error = try_parse(piece).err();
        if error.is_none() && !is_orphan {
            (place, left_out) = (block.end, false);
            continue;
        }
        let (line, reason) = match &error {
            Some(error) => {
                let (line, reason) = explain(error, piece);
                (first.line + line.saturating_sub(1), reason)
            }
            None => (first.line, "no message is before it".to_owned()),
        };
        // A statement with an unterminated string swallows others: then only its first line is removed, and the rest is
        // examined again.
        let swallower = block.clone().find(|&place| {
            let content = &text[index.statements[place].range.clone()];
            ["\nBO_ ", "\n SG_ ", "\nCM_ ", "\nBA_ ", "\nVAL_ "].iter().any(|start| content.contains(start))
        });
        let found = || index.place_at(line).filter(|place| block.contains(place)).unwrap_or(place);
        let culprit = &index.statements[swallower.unwrap_or_else(found)];
        let line = if swallower.is_some() { culprit.line } else { line };
        let is_message = first.keyword == "BO_";
        if !(is_orphan && left_out) {
            faults.push(fault(culprit, line, reason, is_message || is_orphan));
        }
        let changes_values = matches!(first.keyword.as_str(), "BO_" | "SIG_VALTYPE_" | "SG_MUL_VAL_");
        if changes_values && let Some(id) = dbc_text::id(piece) {
            messages.insert(id.to_owned());
        }
        left_out = is_message || is_orphan;
        if swallower.is_none() {
            blanks.blank(range);
            place = block.end;
            continue;
        }
        let start = culprit.range.start;
        let end = start + text[start..].find('\n').unwrap_or(range.end - start);
        blanks.blank(range.start..end);
        index = Index::of(&blanks.text());
        place = index.statements.partition_point(|statement| statement.range.start < end);
    }
    let text = blanks.text();
    let index = Index::of(&text);
    for (_, name, line) in index.messages.iter().filter(|(id, ..)| messages.contains(&id.to_string())) {
        let kind = FaultKind::LeftOut(FaultKind::Related.into());
        faults.push(Fault { line: *line, symbol: name.clone(), kind });
    }
    without_messages(&text, &index, &messages)
}

/// A text in which statements are replaced by spaces, so that everything else keeps its place.
struct Blanks(Vec<u8>);

impl Blanks {
    fn of(text: &str) -> Self {
        Self(text.as_bytes().to_vec())
    }

    /// Replaces whole characters by spaces, except for line ends.
    fn blank(&mut self, range: Range<usize>) {
        let bytes = &mut self.0[range];
        bytes.iter_mut().filter(|byte| !matches!(byte, b'\n' | b'\r')).for_each(|byte| *byte = b' ');
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.0).into_owned()
    }
}

/// A message's statement with those of its signals, or a single statement.
fn block(statements: &[Statement], place: usize) -> Range<usize> {
    let heads = matches!(statements[place].keyword.as_str(), "BO_" | "SG_");
    let signals = statements[place + 1..].iter().take_while(|statement| heads && statement.keyword == "SG_");
    place..place + 1 + signals.count()
}

fn range_of(block: &[Statement]) -> Range<usize> {
    match (block.first(), block.last()) {
        (Some(first), Some(last)) => first.range.start..last.range.end,
        _ => 0..0,
    }
}

fn fault(statement: &Statement, line: u32, reason: String, of_message: bool) -> Fault {
    let reason = form(&statement.keyword).map_or(reason, |form| format!("not of the form {form}"));
    let kind = if of_message {
        FaultKind::LeftOut(FaultKind::Syntax(reason).into())
    } else {
        FaultKind::Ignored(reason)
    };
    Fault { line, symbol: statement.symbol.clone(), kind }
}

/// The form of a statement. can-dbc's errors mostly point at its beginning and name rules of an obscure
/// grammar.
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

/// The line of can-dbc's error, and its meaning in words.
fn explain(error: &DbcError, text: &str) -> (u32, String) {
    // can-dbc says which number is wrong but not where. A signal's position is tried before other numbers,
    // because only it must not be negative.
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
