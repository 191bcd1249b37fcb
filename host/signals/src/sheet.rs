//! Databases from tables of signals: workbooks (`.xlsx`) and texts with separators (`.csv`, `.tsv`), for people who have nothing else.
//!
//! There is no standard for such tables. Columns are known by the usual names above them, canmatrix's among them; what a table does not say is
//! taken as a database's default, and reported if values depend on it.

mod cells;
mod columns;
mod place;
mod rows;

use std::collections::HashMap;

use super::dbc_text;
use super::fault::{DatabaseError, Fault, FaultKind};
use super::layout::ByteOrder;
use super::model::{Database, Message, Multiplexed, Signal, ValueKind, ValueTable};
use super::unflagged::Unflagged;
use super::{validate, xml, zip};
use cantap_trace::counted;
use cells::{Mux, kind, mux, number, order, range, values};
use columns::{Columns, Role};
use place::{Place, Places};
use rows::Sheet;

/// Parses a table's content; `file` is its name for messages to the user.
pub fn parse(file: &str, bytes: &[u8]) -> Result<Database, DatabaseError> {
    const COMPOUND: &[u8] = &[0xD0, 0xCF, 0x11, 0xE0];
    let mut faults = Vec::new();
    let sheets = if zip::is_archive(bytes) {
        rows::of_workbook(bytes)
            .map_err(|what| xml::faulty(file, format!("a workbook that is whole was expected: {what}")))?
    } else if bytes.starts_with(COMPOUND) {
        let what = "it is a workbook of before 2007, or one with a password; save it as .xlsx or .csv";
        return Err(xml::faulty(file, what.to_owned()));
    } else {
        let (text, encoding) = dbc_text::decode(bytes);
        faults.extend(encoding.map(|name| FaultKind::Encoding(name).of_whole_file()));
        vec![rows::of_text(&text)]
    };
    let mut tables: Vec<_> = sheets.iter().filter_map(Table::of).collect();
    if !tables.iter().any(|table| table.columns.are_of_signals()) {
        let what = "no table of signals was found: the names above its columns must be such as ID, Message, Signal, Start bit, Length, Byte order, \
                    Factor, Offset, Unit";
        return Err(xml::faulty(file, what.to_owned()));
    }
    // What describes messages alone is needed first.
    tables.sort_by_key(|table| table.columns.are_of_signals());
    let mut reader = Reader { faults, ..Reader::default() };
    for table in &tables {
        reader.table(table);
    }
    let (messages, mut faults) = reader.finish();
    faults.dedup();
    validate::finish(file, messages, faults)
}

/// The rows of a text whose cells stand between commas, semicolons or tabs, whichever the first rows have most of: each with the line on which it
/// begins, from 1, and its cells without quotation marks and blanks around them. Empty rows are left out.
pub fn rows_of_text(text: &str) -> Vec<(u32, Vec<String>)> {
    rows::of_text(text).rows
}

/// A sheet with names above its columns.
struct Table<'a> {
    columns: Columns,
    rows: &'a [(u32, Vec<String>)],
    /// In front of what is said of a row: the sheet's name.
    name: &'a str,
}

impl<'a> Table<'a> {
    fn of(sheet: &'a Sheet) -> Option<Self> {
        /// How many rows may stand above the names.
        const ABOVE: usize = 40;
        let at = sheet.rows.iter().take(ABOVE).position(|(_, cells)| Columns::of(cells).is_some())?;
        let columns = Columns::of(&sheet.rows[at].1)?;
        Some(Self { columns, rows: &sheet.rows[at + 1..], name: &sheet.name })
    }

    /// Whether identifiers without a sign of it are hexadecimal, and whether that is known.
    fn ids_are_hex(&self) -> (bool, bool) {
        if let Some(is_hex) = self.columns.id_is_hex {
            return (is_hex, true);
        }
        let ids: Vec<_> = self
            .rows
            .iter()
            .map(|(_, cells)| self.columns.cell(cells, Role::MessageId))
            .filter(|id| !id.is_empty())
            .collect();
        let plain = || ids.iter().filter(|id| cells::id(id, true).is_some_and(|id| !id.is_marked));
        let has_letter = plain().any(|id| id.bytes().any(|byte| byte.is_ascii_alphabetic()));
        let has_zero = plain().any(|id| id.len() > 1 && id.starts_with('0'));
        if has_letter || has_zero || plain().next().is_none() {
            return (true, true);
        }
        // Identifiers have three digits, or eight of 29 bits; decimal ones have any number.
        let fits = plain().all(|id| matches!(id.len(), 3 | 8));
        (fits, false)
    }
}

/// What a table says of a message, before it has signals.
#[derive(Clone, Default)]
struct Head {
    id: Option<u32>,
    extended: Option<bool>,
    name: String,
    text: String,
    length: Option<u16>,
    cycle_ms: Option<u32>,
    line: u32,
}

/// A signal, before the numbering of its bits is known.
struct Entry {
    signal: Signal,
    place: Place,
    mux: Option<Mux>,
    kind: Option<ValueKind>,
}

#[derive(Default)]
struct Reader {
    faults: Vec<Fault>,
    heads: HashMap<String, Head>,
    messages: Vec<(Head, Vec<Entry>)>,
    guesses: Vec<&'static str>,
    is_canmatrix: bool,
}

const IDS_AS_HEX: &str =
    "identifiers are read as hexadecimal; 0x before them, or a column named ID (dec), says what they are";
const IDS_AS_DECIMAL: &str =
    "identifiers are read as decimal; 0x before them, or a column named ID (hex), says what they are";
const NO_ORDER: &str =
    "there is no column of byte orders: signals are read as Intel (least significant byte first)";
const NO_FACTOR: &str = "there is no column of factors: they are taken as 1";
const NO_OFFSET: &str = "there is no column of offsets: they are taken as 0";
const NO_KIND: &str = "there is no column that says which signals are signed: those are that can be negative";

impl Reader {
    fn guess(&mut self, what: &'static str) {
        if !self.guesses.contains(&what) {
            self.guesses.push(what);
        }
    }

    fn fault(&mut self, line: u32, symbol: &str, what: String) {
        self.faults.push(Fault { line, symbol: symbol.to_owned(), kind: FaultKind::Ignored(what) });
    }

    fn table(&mut self, table: &Table<'_>) {
        let columns = &table.columns;
        let (is_hex, is_sure) = table.ids_are_hex();
        if !is_sure {
            self.guess(if is_hex { IDS_AS_HEX } else { IDS_AS_DECIMAL });
        }
        self.is_canmatrix |= columns.has(Role::FactorAndUnit);
        if columns.are_of_signals() {
            let has_factor = columns.has(Role::Factor) || columns.has(Role::FactorAndUnit);
            for (is_there, missing) in [
                (columns.has(Role::Order), NO_ORDER),
                (has_factor, NO_FACTOR),
                (columns.has(Role::Offset), NO_OFFSET),
                (columns.has(Role::Kind), NO_KIND),
            ] {
                if !is_there {
                    self.guess(missing);
                }
            }
        }
        let bits = Bits::of(table);
        // Cells that are merged, or empty below the first of a message, say the same as those above them.
        let mut head = Head::default();
        for (line, cells) in table.rows {
            let cell = |role| columns.cell(cells, role);
            let (id, name) = (cell(Role::MessageId), cell(Role::MessageName));
            if !id.is_empty() || !name.is_empty() && name != head.name {
                let Some(next) = self.head(columns, cells, is_hex, *line, table.name) else {
                    head = Head::default();
                    continue;
                };
                head = next;
            }
            if !columns.are_of_signals() {
                self.heads.insert(head.name.clone(), head.clone());
                continue;
            }
            if head.length.is_none() {
                head.length = length(cell(Role::MessageLength));
            }
            if cell(Role::Name).is_empty() {
                self.begin(&head);
                continue;
            }
            match entry(columns, cells, *line, bits) {
                Ok(entry) => self.push(&head, entry),
                Err(what) => {
                    let symbol = format!("{}.{}", head.name, cell(Role::Name));
                    self.fault(*line, &symbol, what);
                }
            }
        }
    }

    /// A message's row; `None` if it is not understood.
    fn head(
        &mut self,
        columns: &Columns,
        cells: &[String],
        is_hex: bool,
        line: u32,
        sheet: &str,
    ) -> Option<Head> {
        let cell = |role| columns.cell(cells, role);
        let (shown, name) = (cell(Role::MessageId), cell(Role::MessageName));
        let known = self.heads.get(name).cloned().unwrap_or_default();
        let id = cells::id(shown, is_hex);
        if id.is_none() && (!shown.is_empty() || known.id.is_none()) {
            // Further names, a headline, a note.
            let is_row =
                columns.are_of_signals() && !cell(Role::Name).is_empty() && !cell(Role::Length).is_empty();
            if is_row && number(cell(Role::Length)).is_some() {
                let symbol = if name.is_empty() { sheet } else { name };
                self.fault(line, symbol, format!("{shown:?} is not the identifier of a message"));
            }
            return None;
        }
        let marked = id.as_ref().and_then(|id| id.extended);
        let raw = id.map(|id| id.raw).or(known.id)?;
        let name = if name.is_empty() { format!("Message_{raw:X}") } else { name.to_owned() };
        Some(Head {
            id: Some(raw),
            extended: marked.or_else(|| cells::extended(cell(Role::Extended))).or(known.extended),
            text: Some(cell(Role::MessageText))
                .filter(|text| !text.is_empty())
                .map_or(known.text, str::to_owned),
            length: length(cell(Role::MessageLength)).or(known.length),
            cycle_ms: number(cell(Role::Cycle))
                .filter(|ms| *ms >= 1.0)
                .map(|ms| ms as u32)
                .or(known.cycle_ms),
            name,
            line,
        })
    }

    fn begin(&mut self, head: &Head) -> usize {
        let same = |(other, _): &(Head, Vec<Entry>)| other.id == head.id && other.name == head.name;
        if let Some(at) = self.messages.iter().rposition(same) {
            return at;
        }
        if head.id.is_some() {
            self.messages.push((head.clone(), Vec::new()));
        }
        self.messages.len().saturating_sub(1)
    }

    fn push(&mut self, head: &Head, entry: Entry) {
        if head.id.is_none() {
            return;
        }
        let at = self.begin(head);
        let entries = &mut self.messages[at].1;
        // canmatrix repeats a signal for each of its values.
        if let Some(last) = entries.last_mut()
            && last.signal.name == entry.signal.name
            && last.place == entry.place
        {
            let all = last.signal.values.iter().chain(entry.signal.values.iter());
            let all: Vec<_> = all.map(|(value, text)| (value, text.to_owned())).collect();
            last.signal.values = ValueTable::new(all);
            return;
        }
        entries.push(entry);
    }

    /// The messages, with what is wrong with them and what was guessed.
    fn finish(mut self) -> (Vec<Message>, Vec<Fault>) {
        let heads = std::mem::take(&mut self.messages);
        let places = Places::of(
            heads.iter().map(|(head, entries)| {
                (head.length, entries.iter().map(|entry| (&entry.place, entry.mux.as_ref())))
            }),
            self.is_canmatrix,
        );
        self.guesses.extend(places.guess);
        let mut unflagged = Unflagged::default();
        let mut messages = Vec::new();
        for (head, entries) in heads {
            let raw = head.id.unwrap_or_default();
            // A table without marks of them means what its identifiers need.
            let extended = head.extended.unwrap_or(raw > cantap_can::Id::MAX_STANDARD);
            let Some(id) = unflagged.id(raw, extended, &head.name, head.line) else {
                self.faults.push(Fault {
                    line: head.line,
                    symbol: head.name,
                    kind: FaultKind::Id(raw.into()),
                });
                continue;
            };
            let mut message = Message {
                id,
                name: head.name,
                description: head.text,
                length: 0,
                cycle_ms: head.cycle_ms,
                j1939: false,
                container: None,
                signals: Vec::new(),
                line: head.line,
            };
            let (mut muxes, mut switch) = (Vec::new(), None);
            for entry in entries {
                let mut signal = entry.signal;
                let Some(start) = entry.place.start(places.numbering) else {
                    let symbol = format!("{}.{}", message.name, signal.name);
                    self.fault(signal.line, &symbol, "it does not lie in a message".to_owned());
                    continue;
                };
                signal.start = start;
                signal.kind = value_kind(entry.kind, &signal);
                if matches!(entry.mux, Some(Mux::Switch)) {
                    switch = Some(message.signals.len());
                }
                muxes.push(entry.mux);
                message.signals.push(signal);
            }
            for (at, mux) in muxes.into_iter().enumerate() {
                let Some(Mux::For(values)) = mux else { continue };
                if let Some(switch) = switch.filter(|switch| *switch != at) {
                    message.signals[at].multiplexed = Some(Multiplexed { switch, values });
                } else {
                    let symbol = format!("{}.{}", message.name, message.signals[at].name);
                    let kind = FaultKind::NoMultiplexer(String::new());
                    self.faults.push(Fault { line: message.signals[at].line, symbol, kind });
                }
            }
            let needed = message.signals.iter().map(Signal::bytes_needed).max().unwrap_or(0);
            message.length = head.length.unwrap_or_else(|| u16::try_from(needed).unwrap_or(u16::MAX).max(8));
            messages.push(message);
        }
        self.faults.extend(unflagged.warning());
        let guesses = self.guesses.iter().map(|what| FaultKind::Guessed((*what).to_owned()).of_whole_file());
        self.faults.extend(guesses);
        (messages, self.faults)
    }
}

/// The signal of a row; what is wrong with it otherwise.
fn entry(columns: &Columns, row: &[String], line: u32, of: Bits) -> Result<Entry, String> {
    let cell = |role| columns.cell(row, role);
    let needed = |role, what: &str| {
        number(cell(role)).ok_or_else(|| format!("{what} {:?} is not a number", cell(role)))
    };
    let optional = |role, what: &str, default: f64| match cell(role) {
        "" | "-" | "/" => Ok(default),
        shown => number(shown).ok_or_else(|| format!("{what} {shown:?} is not a number")),
    };
    let bits = needed(Role::Length, "length")?;
    if bits < 1.0 || bits.fract() != 0.0 {
        return Err(format!("a length of {bits}", bits = counted(bits, "bit")));
    }
    if bits > 64.0 {
        return Err(format!("{bits} bits are more than a number can have (64)"));
    }
    let bits = bits as u16;
    let bit = if columns.has(Role::StartBit) && !cell(Role::StartBit).is_empty() {
        Some(needed(Role::StartBit, "start bit")?)
    } else {
        None
    };
    let byte = number(cell(Role::StartByte)).filter(|_| !of.message).map(|byte| byte - of.first_byte);
    let order = match cell(Role::Order) {
        "" => (ByteOrder::Little, None),
        shown => order(shown).ok_or_else(|| format!("byte order {shown:?} is neither Intel nor Motorola"))?,
    };
    let place =
        Place::of(byte, bit, bits, order).ok_or_else(|| "it has no place in its message".to_owned())?;
    let (factor, unit) = if columns.has(Role::FactorAndUnit) {
        cells::factor_and_unit(cell(Role::FactorAndUnit))
    } else {
        (optional(Role::Factor, "factor", 1.0)?, cell(Role::Unit).to_owned())
    };
    let offset = optional(Role::Offset, "offset", 0.0)?;
    let (mut min, mut max) = (number(cell(Role::Min)), number(cell(Role::Max)));
    let mut texts = values(cell(Role::Values));
    let shown = cell(Role::Range);
    match (number(cell(Role::Value)), range(shown)) {
        (Some(value), _) if !shown.is_empty() => texts.push((value as i64, shown.to_owned())),
        (_, Some((low, high))) => (min, max) = (min.or(Some(low)), max.or(Some(high))),
        _ => {}
    }
    texts.extend(values(cell(Role::Value)));
    let (text, of_text) = cells::mode(cell(Role::Text));
    let mux = mux(cell(Role::Multiplexing)).or(of_text);
    let kind = match cell(Role::Kind) {
        "" => None,
        shown => kind(shown, bits),
    };
    // A range that the file does not give is often written as 0 to 0.
    let limits = (min, max) != (Some(0.0), Some(0.0));
    let mut signal = Signal { line, ..Signal::new(cell(Role::Name), 0, bits) };
    signal.description = text;
    signal.unit = unit;
    (signal.factor, signal.offset) = (factor, offset);
    (signal.min, signal.max) = if limits { (min, max) } else { (None, None) };
    signal.values = ValueTable::new(texts);
    signal.order = place.order;
    Ok(Entry { signal, place, mux, kind })
}

/// How a table counts the bytes and bits of its places.
#[derive(Clone, Copy)]
struct Bits {
    /// Whether start bits count through the whole message, whatever the byte.
    message: bool,
    /// The number of the first byte.
    first_byte: f64,
}

impl Bits {
    fn of(table: &Table<'_>) -> Self {
        let numbers =
            |role| table.rows.iter().filter_map(move |(_, cells)| number(table.columns.cell(cells, role)));
        let message = table.columns.has(Role::StartBit) && numbers(Role::StartBit).any(|bit| bit > 7.0);
        Self { message, first_byte: if numbers(Role::StartByte).any(|byte| byte == 0.0) { 0.0 } else { 1.0 } }
    }
}

fn length(cell: &str) -> Option<u16> {
    let length = number(cell)
        .filter(|length| length.fract() == 0.0 && (0.0..=f64::from(validate::MAX_BYTES)).contains(length));
    length.map(|length| length as u16)
}

/// How the bits are to be interpreted, if the table does not say it: as what its smallest value needs.
fn value_kind(kind: Option<ValueKind>, signal: &Signal) -> ValueKind {
    kind.unwrap_or_else(|| {
        let lowest = signal.min.map(|min| (min - signal.offset) / signal.factor);
        if lowest.is_some_and(|raw| raw < -0.5) { ValueKind::Signed } else { ValueKind::Unsigned }
    })
}

#[cfg(test)]
mod tests;
