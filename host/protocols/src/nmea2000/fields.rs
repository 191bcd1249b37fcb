//! A group's bytes as named values, according to CANboat's database.

use std::borrow::Cow;

use cantap_signals::shortest_of_f32;
use jiff::{ToSpan, civil};

use super::database::{Condition, Database, FieldKind, Group, Kind};
use crate::{Field, Value};

/// Limit for the values of one message: repeated sets are limited by the data, but empty ones would not be.
const MOST_FIELDS: usize = 2048;

/// Bits counted from the lowest of the first byte; `None` if the data are too short.
fn bits(data: &[u8], offset: usize, length: usize) -> Option<u64> {
    if length > 64 || offset + length > data.len() * 8 {
        return None;
    }
    let mut number = 0_u128;
    let first = offset / 8;
    for (at, byte) in data[first..(offset + length).div_ceil(8)].iter().enumerate() {
        number |= u128::from(*byte) << (8 * at);
    }
    Some((number >> (offset % 8)) as u64 & mask(length))
}

pub(super) const fn mask(length: usize) -> u64 {
    if length >= 64 { u64::MAX } else { (1 << length) - 1 }
}

/// The group whose fixed fields match the data.
pub fn group(pgn: u32, data: &[u8]) -> Option<&'static Group> {
    let database = Database::get();
    let suits = |group: &&Group| {
        group.fields.iter().all(|field| match (field.wanted, field.bit_offset) {
            (Some(wanted), Some(offset)) => bits(data, offset, field.bit_length) == Some(wanted),
            _ => true,
        })
    };
    let of_number = database.groups(pgn).iter().filter(|group| !group.fallback);
    let mut of_number = of_number.filter(suits);
    of_number.next().or_else(|| database.fallback(pgn))
}

/// The field of another group, by its place in it, from 1.
pub(super) fn parameter(pgn: u32, order: usize) -> Option<&'static FieldKind> {
    // If there are several groups with one number, their first fields, which distinguish them, are alike.
    let group = Database::get().groups(pgn).iter().find(|group| !group.fallback)?;
    group.fields.get(order.checked_sub(1)?)
}

/// Whether the group is one of those that manufacturers define.
pub(super) const fn is_proprietary(pgn: u32) -> bool {
    matches!(pgn, 0xEF00 | 0x1_EF00 | 0xFF00..=0xFFFF | 0x1_FF00..=0x1_FFFF)
}

/// What a field may refer to in the ones before it.
#[derive(Default)]
struct Reader<'a> {
    data: &'a [u8],
    /// In bits.
    at: usize,
    /// The group that a list of parameters is about, and the last parameter named.
    about: Option<u32>,
    parameter: Option<usize>,
    key: Option<&'static super::database::Key>,
    key_bytes: Option<usize>,
    counts: [Option<u64>; 2],
}

/// Appends the group's values.
pub fn read(group: &'static Group, data: &[u8], fields: &mut Vec<Field>) {
    let mut reader = Reader { data, ..Reader::default() };
    let sets = [
        (group.set_1_size, group.set_1_start, group.set_1_count),
        (group.set_2_size, group.set_2_start, group.set_2_count),
    ];
    let mut order = 1;
    while order <= group.fields.len() {
        let set = sets.iter().position(|(size, start, _)| *size > 0 && *start == order);
        let Some(set) = set else {
            reader.field(group, order, fields);
            for (set, (_, _, count)) in sets.iter().enumerate() {
                if *count == order {
                    reader.counts[set] = match fields.last().map(|field| &field.value) {
                        Some(Value::Real(count)) if *count >= 0.0 => Some(*count as u64),
                        Some(Value::Number(count)) => u64::try_from(*count).ok(),
                        _ => Some(0),
                    };
                }
            }
            order += 1;
            continue;
        };
        let (size, start, count_field) = sets[set];
        // Without a count, until the end of the data.
        let count = if count_field == 0 { u64::MAX } else { reader.counts[set].unwrap_or(0) };
        let mut done = 0;
        while done < count && reader.at < data.len() * 8 && fields.len() < MOST_FIELDS {
            let before = reader.at;
            for order in start..(start + size).min(group.fields.len() + 1) {
                reader.field(group, order, fields);
            }
            done += 1;
            if reader.at == before {
                break;
            }
        }
        order = start + size;
    }
}

impl Reader<'_> {
    fn field(&mut self, group: &'static Group, order: usize, fields: &mut Vec<Field>) {
        let Some(kind) = group.fields.get(order - 1) else { return };
        let name = kind.name.as_str();
        let left = (self.data.len() * 8).saturating_sub(self.at);
        let is_absent =
            kind.condition == Some(Condition::PgnIsProprietary) && !self.about.is_some_and(is_proprietary);
        if left == 0 || is_absent {
            return;
        }
        match kind.field_type {
            Kind::Reserved | Kind::Spare => self.at += kind.bit_length,
            Kind::StringLau | Kind::StringLz => self.string(kind, fields),
            Kind::StringFix => {
                let length = (kind.bit_length.min(left)) / 8;
                let bytes = self.bytes(length);
                let end = bytes.iter().position(|byte| matches!(byte, 0 | 0xFF)).unwrap_or(bytes.len());
                let text = String::from_utf8_lossy(&bytes[..end]);
                let text = text.trim_end_matches(['@', ' ']).to_owned();
                fields.push(if text.is_empty() { Field::missing(name) } else { Field::text(name, text) });
            }
            Kind::Binary if kind.bit_length > 64 || kind.bit_length_variable || kind.bit_length == 0 => {
                let length = if kind.bit_length == 0 { left } else { kind.bit_length.min(left) };
                let bytes = self.loose_bytes(length);
                fields.push(Field::bytes(name, &bytes));
            }
            Kind::Variable => self.parameter_value(name, fields),
            Kind::DynamicFieldValue => self.key_value(name, fields),
            _ if kind.bit_length > left => {
                self.at = self.data.len() * 8;
                fields.push(Field::missing(name).meaning(Some("cut")));
            }
            _ => {
                let (offset, length) = (self.at, kind.bit_length);
                self.at += length;
                self.number(group, kind, offset, fields);
            }
        }
    }

    /// Whole bytes, starting at the next byte boundary.
    fn bytes(&mut self, length: usize) -> Vec<u8> {
        let first = self.at.div_ceil(8).min(self.data.len());
        let end = (first + length).min(self.data.len());
        self.at = end * 8;
        self.data[first..end].to_vec()
    }

    /// Bits that need not start at a byte boundary.
    fn loose_bytes(&mut self, length: usize) -> Vec<u8> {
        let (offset, end) = (self.at, self.at + length);
        self.at = end;
        let parts = (offset..end).step_by(8);
        parts.map(|at| bits(self.data, at, (end - at).min(8)).unwrap_or_default() as u8).collect()
    }

    fn string(&mut self, kind: &'static FieldKind, fields: &mut Vec<Field>) {
        let name = kind.name.as_str();
        let Some(&length) = self.bytes(1).first() else { return };
        let text = if kind.field_type == Kind::StringLz {
            let fixed = kind.bit_length / 8;
            let bytes = self.bytes(usize::from(length));
            if kind.bit_length > 0 {
                // It always takes as much space as the longest text.
                self.at += fixed.saturating_sub(usize::from(length) + 1) * 8;
            } else if self.data.get(self.at / 8) == Some(&0) {
                self.at += 8;
            }
            String::from_utf8_lossy(&bytes).into_owned()
        } else {
            // The length includes itself and the byte with the text encoding.
            let coding = self.bytes(1).first().copied().unwrap_or(1);
            let bytes = self.bytes(usize::from(length).saturating_sub(2));
            if coding == 0 {
                let units = bytes.chunks_exact(2).map(|two| u16::from_le_bytes([two[0], two[1]]));
                char::decode_utf16(units).map(|letter| letter.unwrap_or('\u{FFFD}')).collect()
            } else {
                String::from_utf8_lossy(&bytes).into_owned()
            }
        };
        let text = text.trim_end_matches(['\0', '\u{FFFD}', ' ', '@']).to_owned();
        fields.push(if text.is_empty() { Field::missing(name) } else { Field::text(name, text) });
    }

    fn number(
        &mut self,
        group: &'static Group,
        kind: &'static FieldKind,
        offset: usize,
        fields: &mut Vec<Field>,
    ) {
        let name = kind.name.as_str();
        let length = kind.bit_length;
        if kind.field_type == Kind::Decimal {
            let pairs = (offset..offset + length).step_by(8).filter_map(|at| bits(self.data, at, 8));
            let digits = pairs.take_while(|two| *two < 100).flat_map(|two| [two / 10, two % 10]);
            let text: String = digits.map(|digit| char::from(b'0' + digit as u8)).collect();
            fields.push(if text.is_empty() { Field::missing(name) } else { Field::text(name, text) });
            return;
        }
        let Some(raw) = bits(self.data, offset, length) else { return };
        match kind.field_type {
            Kind::Lookup => {
                let table =
                    kind.lookup_enumeration.as_ref().and_then(|name| Database::get().lookups.get(name));
                let text = table.and_then(|table| table.get(&raw)).map(String::as_str);
                // The highest values mean that there is none, unless the table defines them.
                let none = text.is_none() && length > 1 && raw == mask(length);
                fields.push(if none {
                    Field::missing(name)
                } else {
                    Field::number(name, raw as i64).meaning(text)
                });
            }
            Kind::IndirectLookup => {
                let other = kind
                    .lookup_indirect_enumeration_field_order
                    .and_then(|order| group.fields.get(order - 1))
                    .and_then(|other| bits(self.data, other.bit_offset?, other.bit_length));
                let table = kind
                    .lookup_indirect_enumeration
                    .as_ref()
                    .and_then(|name| Database::get().indirect.get(name));
                let text =
                    table.zip(other).and_then(|(table, other)| table.get(&(other, raw))).map(String::as_str);
                fields.push(Field::number(name, raw as i64).meaning(text));
            }
            Kind::Bitlookup => {
                let table =
                    kind.lookup_bit_enumeration.as_ref().and_then(|name| Database::get().bits.get(name));
                fields.push(bit_field(name, raw, length, table));
            }
            Kind::DynamicFieldKey => {
                let table = kind.lookup_field_type_enumeration.as_ref();
                self.key =
                    table.and_then(|name| Database::get().kinds.get(name)).and_then(|table| table.get(&raw));
                self.key_bytes = None;
                fields.push(Field::number(name, raw as i64).meaning(self.key.map(|key| key.name.as_str())));
            }
            Kind::DynamicFieldLength => {
                self.key_bytes = Some(raw as usize);
                fields.push(Field::number(name, raw as i64).unit("bytes"));
            }
            Kind::Pgn => {
                self.about = Some(raw as u32);
                let group = Database::get().groups(raw as u32).iter().find(|group| !group.fallback);
                fields.push(
                    Field::number(name, raw as i64).meaning(group.map(|group| group.description.as_str())),
                );
            }
            Kind::FieldIndex => {
                self.parameter = Some(raw as usize);
                fields.push(Field::number(name, raw as i64));
            }
            Kind::IsoName => fields.push(Field::hex(name, raw, 16)),
            Kind::Binary => {
                let bytes = raw.to_le_bytes();
                fields.push(Field::bytes(name, &bytes[..length.div_ceil(8)]));
            }
            _ => fields.push(physical(name, kind, raw)),
        }
    }

    /// A value of the parameter named before, with that parameter's length in its own group.
    fn parameter_value(&mut self, name: &'static str, fields: &mut Vec<Field>) {
        let left = (self.data.len() * 8).saturating_sub(self.at);
        match self.about.zip(self.parameter).and_then(|(pgn, order)| parameter(pgn, order)) {
            Some(kind) if kind.bit_length > 0 && kind.bit_length <= 64 => {
                let length = kind.bit_length.div_ceil(8) * 8;
                if length > left {
                    self.at = self.data.len() * 8;
                    fields.push(Field::missing(name).meaning(Some("cut")));
                    return;
                }
                let offset = self.at;
                self.at += length;
                let Some(raw) = bits(self.data, offset, kind.bit_length) else { return };
                let table =
                    kind.lookup_enumeration.as_ref().and_then(|name| Database::get().lookups.get(name));
                let text = table.and_then(|table| table.get(&raw)).map(String::as_str);
                let field = if kind.field_type == Kind::Lookup {
                    Field::number(name, raw as i64).meaning(text)
                } else {
                    physical(name, kind, raw)
                };
                fields.push(field);
            }
            _ => {
                let bytes = self.loose_bytes(left);
                fields.push(Field::bytes(name, &bytes));
            }
        }
    }

    fn key_value(&mut self, name: &'static str, fields: &mut Vec<Field>) {
        let left = (self.data.len() * 8).saturating_sub(self.at);
        let of_key = self.key.and_then(|key| key.bits.parse::<usize>().ok());
        let length = self.key_bytes.map(|bytes| bytes * 8).or(of_key).unwrap_or(left).min(left);
        let offset = self.at;
        let Some((key, raw)) = self.key.zip(bits(self.data, offset, length).filter(|_| length > 0)) else {
            let bytes = self.loose_bytes(length);
            fields.push(Field::bytes(name, &bytes));
            return;
        };
        self.at += length;
        let lookup = key.lookup_enumeration.as_ref().and_then(|name| Database::get().lookups.get(name));
        let bit_table = key.lookup_bit_enumeration.as_ref().and_then(|name| Database::get().bits.get(name));
        fields.push(match key.field_type {
            Kind::Lookup => Field::number(name, raw as i64)
                .meaning(lookup.and_then(|table| table.get(&raw)).map(String::as_str)),
            Kind::Bitlookup => bit_field(name, raw, length, bit_table),
            Kind::Number | Kind::Duration if raw != mask(length) => {
                let value = if key.signed { signed(raw, length) } else { raw as f64 };
                Field::real(name, value * key.resolution.unwrap_or(1.0), key.unit.as_str())
            }
            Kind::Number | Kind::Duration => Field::missing(name),
            _ => Field::bytes(name, &raw.to_le_bytes()[..length.div_ceil(8)]),
        });
    }
}

fn bit_field(
    name: &'static str,
    raw: u64,
    length: usize,
    table: Option<&'static rustc_hash::FxHashMap<u64, String>>,
) -> Field {
    let set = (0..length as u64).filter(|bit| raw >> bit & 1 == 1);
    let names = set.map(|bit| {
        table.and_then(|table| table.get(&bit)).map_or_else(|| format!("bit {bit}"), Clone::clone)
    });
    let text = names.collect::<Vec<_>>().join(", ");
    let text = Some(text).filter(|text| !text.is_empty());
    Field::hex(name, raw, length.div_ceil(4) as u8).meaning(text)
}

fn signed(raw: u64, length: usize) -> f64 {
    let shift = 64 - length.clamp(1, 64);
    ((raw << shift) as i64 >> shift) as f64
}

/// A number with its resolution and unit; the highest values of its bits mean that there is none.
pub(super) fn physical(name: &'static str, kind: &'static FieldKind, raw: u64) -> Field {
    let length = kind.bit_length;
    if kind.field_type == Kind::Float {
        let value = f32::from_bits(raw as u32);
        return if value.is_finite() {
            Field::real(name, shortest_of_f32(value), kind.unit.as_str())
        } else {
            Field::missing(name)
        };
    }
    let none = if kind.signed { mask(length) >> 1 } else { mask(length) };
    let resolution = kind.resolution.unwrap_or(1.0);
    let number = if kind.signed { signed(raw, length) } else { raw as f64 };
    let in_steps = |value: f64| (value - kind.offset) / resolution;
    let most = kind.range_max.map_or(f64::INFINITY, in_steps);
    // Some small fields use their highest value, too.
    let is_value = length == 1 || (length <= 3 && kind.range_max.is_some() && number <= most + 0.5);
    if raw == none && !is_value {
        return Field::missing(name);
    }
    // The second highest means an error, if that many values are reserved.
    if length > 3 && raw == none - 1 && number > most + 0.5 {
        return Field::missing(name).meaning(Some("error"));
    }
    let value = number * resolution + kind.offset;
    match kind.field_type {
        Kind::Date => Field::real(name, value, "").unit("d").meaning(Some(date(raw as i64))),
        Kind::Time => Field::real(name, value, kind.unit.as_str()).meaning(Some(time(value))),
        Kind::Mmsi => Field::number(name, raw as i64),
        _ => {
            let least = kind.range_min.map_or(f64::NEG_INFINITY, in_steps);
            let is_in_range = (least - 0.5..=most + 0.5).contains(&number);
            Field::real(name, value, kind.unit.as_str()).meaning((!is_in_range).then_some("out of range"))
        }
    }
}

/// Days since 1970 as a date.
fn date(days: i64) -> Cow<'static, str> {
    civil::date(1970, 1, 1).saturating_add(days.days()).to_string().into()
}

/// Seconds since midnight as a time of day.
fn time(seconds: f64) -> Cow<'static, str> {
    let whole = seconds as u64;
    let rest = format!("{:.4}", seconds.fract());
    let rest = rest.trim_start_matches('0').trim_end_matches('0').trim_end_matches('.');
    format!("{:02}:{:02}:{:02}{rest}", whole / 3600, whole / 60 % 60, whole % 60).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_are_dates() {
        for (days, expected) in
            [(0, "1970-01-01"), (16_327, "2014-09-14"), (11_016, "2000-02-29"), (65_532, "2149-06-03")]
        {
            assert_eq!(date(days), expected);
        }
        assert_eq!(time(3661.25), "01:01:01.25");
        assert_eq!(time(0.0), "00:00:00");
    }

    #[test]
    fn bits_begin_anywhere() {
        assert_eq!(bits(&[0xF0, 0x0F], 4, 8), Some(0xFF));
        assert_eq!(bits(&[1, 2, 3, 4, 5, 6, 7, 8], 0, 64), Some(0x0807_0605_0403_0201));
        assert_eq!(bits(&[1], 1, 8), None);
        assert_eq!(signed(0xFF, 8) as i64, -1);
    }
}
