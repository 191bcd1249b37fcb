//! Where the parts of a message are: the lines of `data/isobus.csv`, which describes their form.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use super::tables::FILE;
use crate::Field;
use crate::table::{Table, lines};

/// A message of one frame has no more.
const FRAME_BYTES: usize = 8;

/// A message's name and parts.
#[derive(Debug)]
pub struct Layout {
    /// What it does.
    pub name: &'static str,
    parts: Vec<Part>,
}

/// One part.
#[derive(Debug)]
struct Part {
    name: &'static str,
    /// From the lowest bit of the first byte.
    bit: usize,
    /// `None` for all that follows.
    bits: Option<usize>,
    form: Form,
    unit: &'static str,
    /// The table of its meanings.
    table: &'static str,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Number,
    Signed,
    Hex,
    Text,
}

/// By direction and function.
static LAYOUTS: LazyLock<BTreeMap<(&'static str, u8), Layout>> =
    // What cannot be read is left out, of which the table has nothing: a test counts the lines.
    LazyLock::new(|| lines(FILE).filter_map(read).collect());
static MEANINGS: LazyLock<BTreeMap<&'static str, Table>> = LazyLock::new(|| {
    let used = LAYOUTS.values().flat_map(|layout| &layout.parts).map(|part| part.table);
    used.filter(|table| !table.is_empty()).map(|table| (table, Table::new(FILE, table))).collect()
});

/// A direction's message.
pub fn find(direction: &'static str, function: u8) -> Option<&'static Layout> {
    LAYOUTS.get(&(direction, function))
}

/// How many messages there are.
#[cfg(test)]
pub fn count() -> usize {
    LAYOUTS.len()
}

fn read(line: &'static str) -> Option<((&'static str, u8), Layout)> {
    let columns: Vec<_> = line.split(',').collect();
    let &[direction @ ("to_vt" | "to_ecu" | "technical"), function, name, parts] = &columns[..] else {
        return None;
    };
    let parts = parts.split_whitespace().map(Part::read).collect::<Option<_>>()?;
    Some(((direction, u8::from_str_radix(function, 16).ok()?), Layout { name, parts }))
}

impl Part {
    /// `name@byte.bit:bits`, a letter for the form, `=unit`, `#table`.
    fn read(text: &'static str) -> Option<Self> {
        let (text, table) = text.split_once('#').unwrap_or((text, ""));
        let (text, unit) = text.split_once('=').unwrap_or((text, ""));
        let (name, place) = text.split_once('@')?;
        let (place, size) = place.split_once(':')?;
        let (byte, bit) = place.split_once('.').unwrap_or((place, "0"));
        let digits = size.trim_end_matches(['i', 'x', 't']);
        let form = match &size[digits.len()..] {
            "" => Form::Number,
            "i" => Form::Signed,
            "x" => Form::Hex,
            "t" => Form::Text,
            _ => return None,
        };
        let bits = if digits.is_empty() { None } else { Some(digits.parse().ok()?) };
        let bit = byte.parse::<usize>().ok()? * 8 + bit.parse::<usize>().ok()?;
        Some(Self { name, bit, bits, form, unit, table })
    }

    fn meaning(&self, number: u64) -> Option<&'static str> {
        MEANINGS.get(self.table)?.get(u32::try_from(number).ok()?)
    }

    /// `None` if the message ends before it, or in it.
    fn field(&self, data: &[u8], length: Option<usize>) -> Option<Field> {
        if self.form == Form::Text {
            let rest = data.get(self.bit / 8..)?;
            let end = self.bits.map(|bits| bits / 8).or(length).unwrap_or(rest.len());
            let text = rest.get(..end).unwrap_or(rest);
            let text = text.iter().map(|byte| char::from(*byte));
            let text: String = text.filter(|letter| !cantap_trace::clean::is_harmful(*letter)).collect();
            // Labels end in blanks, or in what was not filled in.
            return Some(Field::text(self.name, text.trim_end_matches([' ', '\u{FF}']).to_owned()));
        }
        let bits = self.bits?;
        let bytes = data.get(self.bit / 8..(self.bit + bits).div_ceil(8))?;
        let raw = bytes.iter().rev().fold(0, |number: u64, byte| number << 8 | u64::from(*byte));
        let raw = raw >> (self.bit % 8) & (u64::MAX >> (64 - bits));
        let field = match self.form {
            Form::Hex => Field::hex(self.name, raw, bits.div_ceil(4) as u8),
            Form::Signed => Field::number(self.name, (raw << (64 - bits)) as i64 >> (64 - bits)),
            Form::Number | Form::Text => Field::number(self.name, raw as i64),
        };
        Some(field.unit(self.unit).meaning(self.meaning(raw)))
    }
}

impl Layout {
    /// What a message of several packets has behind its parts, without what fills it up.
    pub fn rest<'d>(&self, data: &'d [u8]) -> &'d [u8] {
        if data.len() <= FRAME_BYTES {
            return &[];
        }
        let end = |part: &Part| part.bits.map_or(data.len(), |bits| (part.bit + bits).div_ceil(8));
        let begin = self.parts.iter().map(end).max().unwrap_or(1).clamp(1, data.len());
        let end = data.iter().rposition(|byte| *byte != 0xFF).map_or(0, |last| last + 1);
        data.get(begin..end).unwrap_or_default()
    }

    /// Adds the parts that the message has.
    pub fn fields(&self, data: &[u8], fields: &mut Vec<Field>) {
        let mut length = None;
        for part in &self.parts {
            let Some(field) = part.field(data, length) else { continue };
            if part.name == "length" {
                length = field.value.as_number().map(|length| length as usize);
            }
            fields.push(field);
        }
    }
}
