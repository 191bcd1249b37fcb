//! Makes a group's bytes of its fields' values: the reverse of `fields`.

use rustc_hash::FxHashMap;

use super::database::{Condition, Database, FieldKind, Group, Key, Kind};
use super::encode_error::EncodeError;
use super::fields::{is_proprietary, mask, parameter};
use super::values::{absent, bytes, of_key, plain, raw, whole};
use crate::j1939::MOST_FAST_BYTES;

/// A group with its bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncodedGroup {
    /// The group's number.
    pub pgn: u32,
    /// Its name.
    pub name: &'static str,
    /// The priority that the database has for it, 0 to 7.
    pub priority: Option<u8>,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// The message of a group, by its number or name, with these fields' values by their names. Upper and lower case, blanks and punctuation
/// do not count in names. Of a name that occurs several times, `NAME_2` is the second. What is not given is not available; numbers of repeated
/// fields are counted.
///
/// # Errors
/// See [`EncodeError`].
pub fn encode(group: &str, values: &[(&str, &str)]) -> Result<EncodedGroup, EncodeError> {
    let chosen = choose(group, values)?;
    let data = encode_as(chosen, values)?;
    Ok(EncodedGroup { pgn: chosen.pgn, name: &chosen.description, priority: chosen.priority, data })
}

/// The bytes of this group.
pub(super) fn encode_as(group: &'static Group, values: &[(&str, &str)]) -> Result<Vec<u8>, EncodeError> {
    let data = Writer::new(group, values)?.write()?;
    if data.len() > MOST_FAST_BYTES {
        return Err(EncodeError::TooLong { bytes: data.len() });
    }
    Ok(data)
}

/// The group that is meant.
fn choose(name: &str, values: &[(&str, &str)]) -> Result<&'static Group, EncodeError> {
    let database = Database::get();
    let wanted = plain(name);
    let is_it = |group: &&Group| match whole(name) {
        Some(pgn) => u64::from(group.pgn) == pgn,
        None => plain(&group.description) == wanted,
    };
    let all: Vec<&'static Group> =
        database.all().iter().filter(|group| !group.fallback).filter(is_it).collect();
    let names = |groups: &[&'static Group]| groups.iter().map(|group| group.description.as_str()).collect();
    match all[..] {
        [] => {
            let parts = database.all().iter().filter(|group| !group.fallback);
            let near: Vec<_> = parts
                .filter(|group| !wanted.is_empty() && plain(&group.description).contains(&wanted))
                .collect();
            Err(EncodeError::NoGroup { name: name.to_owned(), near: names(&near) })
        }
        [only] => Ok(only),
        _ => {
            let suits = |group: &&&'static Group| Writer::new(group, values).is_ok();
            let suitable: Vec<_> = all.iter().filter(suits).copied().collect();
            match suitable[..] {
                [only] => Ok(only),
                [] => Err(EncodeError::SeveralGroups { name: name.to_owned(), names: names(&all) }),
                _ => Err(EncodeError::SeveralGroups { name: name.to_owned(), names: names(&suitable) }),
            }
        }
    }
}

/// Which field a name means: its plain name, and the how manieth of that name, from 1. A name as it is written comes before a number behind a
/// name, so that `Unknown_1` is `Unknown 1` if there is one, and that before a name without its blanks.
fn occurrence(group: &Group, name: &str) -> Option<(String, usize)> {
    let fields = || group.fields.iter().filter(|field| is_value(field));
    let words = |name: &str| {
        let split = name.split(|letter: char| !letter.is_alphanumeric()).filter(|word| !word.is_empty());
        split.map(str::to_lowercase).collect::<Vec<_>>()
    };
    let whole_name = plain(name);
    if fields().any(|field| words(&field.name) == words(name)) {
        return Some((whole_name, 1));
    }
    let has = |name: &str| fields().any(|field| plain(&field.name) == name);
    let numbered = name.rsplit_once('_').and_then(|(name, number)| {
        let number = number.parse().ok().filter(|number| *number > 0)?;
        Some((plain(name), number)).filter(|(name, _)| has(name))
    });
    numbered.or_else(|| has(&whole_name).then_some((whole_name, 1)))
}

/// Whether a field has a value, and is not there to fill a place.
fn is_value(field: &FieldKind) -> bool {
    !matches!(field.field_type, Kind::Reserved | Kind::Spare)
}

/// Writes a group's fields one after the other.
struct Writer<'a> {
    group: &'static Group,
    values: FxHashMap<(String, usize), &'a str>,
    /// How many fields of each name were written.
    seen: FxHashMap<String, usize>,
    bytes: Vec<u8>,
    at: usize,
    /// The numbers of the fields so far, by their place.
    raws: FxHashMap<usize, u64>,
    about: Option<u32>,
    parameter: Option<usize>,
    key: Option<&'static Key>,
    /// Fields that must have a value and have none.
    needed: Vec<String>,
}

impl<'a> Writer<'a> {
    fn new(group: &'static Group, values: &[(&str, &'a str)]) -> Result<Self, EncodeError> {
        let mut given = FxHashMap::default();
        for (name, text) in values {
            let Some(place) = occurrence(group, name) else {
                let names = group.fields.iter().filter(|field| is_value(field));
                return Err(EncodeError::NoField {
                    group: &group.description,
                    name: (*name).to_owned(),
                    names: names.map(|field| field.name.as_str()).collect(),
                });
            };
            // What distinguishes the group from others with its number is fixed.
            let field = group.fields.iter().find(|field| plain(&field.name) == place.0);
            if let Some((field, wanted)) = field.and_then(|field| Some((field, field.wanted?)))
                && place.1 == 1
                && raw(field, text, None) != Ok(wanted)
            {
                let reason = format!("in this group it is always {wanted}");
                return Err(EncodeError::Value { field: &field.name, text: (*text).to_owned(), reason });
            }
            given.insert(place, *text);
        }
        Ok(Self {
            group,
            values: given,
            seen: FxHashMap::default(),
            bytes: Vec::new(),
            at: 0,
            raws: FxHashMap::default(),
            about: None,
            parameter: None,
            key: None,
            needed: Vec::new(),
        })
    }

    fn write(mut self) -> Result<Vec<u8>, EncodeError> {
        let group = self.group;
        let sets = [
            (group.set_1_size, group.set_1_start, group.set_1_count),
            (group.set_2_size, group.set_2_start, group.set_2_count),
        ];
        let mut order = 1;
        while order <= group.fields.len() {
            let Some(&(size, start, count)) =
                sets.iter().find(|(size, start, _)| *size > 0 && *start == order)
            else {
                self.field(order)?;
                order += 1;
                continue;
            };
            let times = match self.raws.get(&count) {
                Some(times) => usize::try_from(*times).unwrap_or(usize::MAX).min(MOST_FAST_BYTES * 8),
                None => self.times(size, start),
            };
            for _ in 0..times {
                for order in start..(start + size).min(group.fields.len() + 1) {
                    self.field(order)?;
                }
            }
            order = start + size;
        }
        // A value of a repeated field that has no place any more, since there are fewer of them.
        let left =
            self.values.keys().find(|(name, number)| self.seen.get(name).is_none_or(|seen| seen < number));
        if let Some((name, number)) = left {
            return Err(EncodeError::NoField {
                group: &group.description,
                name: format!("{name}_{number}"),
                names: Vec::new(),
            });
        }
        if self.needed.is_empty() { Ok(self.bytes) } else { Err(EncodeError::Needed { fields: self.needed }) }
    }

    /// How often a repeated set occurs, by the highest occurrence of a name in it that has a value.
    fn times(&self, size: usize, start: usize) -> usize {
        let set = &self.group.fields[start - 1..(start - 1 + size).min(self.group.fields.len())];
        let times = set.iter().filter(|field| is_value(field)).map(|field| {
            let name = plain(&field.name);
            let in_each = set.iter().filter(|other| is_value(other) && plain(&other.name) == name).count();
            let before = self.seen.get(&name).copied().unwrap_or(0);
            let most =
                self.values.keys().filter(|(given, _)| *given == name).map(|(_, number)| *number).max();
            most.unwrap_or(0).saturating_sub(before).div_ceil(in_each)
        });
        times.max().unwrap_or(0)
    }

    fn push(&mut self, number: u64, length: usize) {
        self.bytes.resize((self.at + length).div_ceil(8), 0);
        for bit in (0..length).filter(|bit| number >> bit & 1 == 1) {
            self.bytes[(self.at + bit) / 8] |= 1 << ((self.at + bit) % 8);
        }
        self.at += length;
    }

    fn push_bytes(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.push((*byte).into(), 8);
        }
    }

    fn field(&mut self, order: usize) -> Result<(), EncodeError> {
        let Some(kind) = self.group.fields.get(order - 1) else { return Ok(()) };
        let length = kind.bit_length;
        if kind.condition == Some(Condition::PgnIsProprietary) && !self.about.is_some_and(is_proprietary) {
            return Ok(());
        }
        match kind.field_type {
            Kind::Reserved => {
                self.fill(true, length);
                return Ok(());
            }
            Kind::Spare => {
                self.fill(false, length);
                return Ok(());
            }
            _ => {}
        }
        let number = self.seen.entry(plain(&kind.name)).or_insert(0);
        *number += 1;
        let number = *number;
        let text = self.values.get(&(plain(&kind.name), number)).copied();
        let wrong = |reason: String| EncodeError::Value {
            field: &kind.name,
            text: text.unwrap_or_default().to_owned(),
            reason,
        };
        match kind.field_type {
            Kind::StringFix => {
                let fills = !self.is_open(order);
                self.fixed_text(length / 8, text.unwrap_or_default(), fills).map_err(wrong)
            }
            Kind::StringLau => self.text_with_coding(text.unwrap_or_default()).map_err(wrong),
            Kind::StringLz => self.counted_text(length / 8, text.unwrap_or_default()).map_err(wrong),
            Kind::Binary if length > 64 || kind.bit_length_variable || length == 0 => {
                let is_open = length == 0 || self.is_open(order);
                let Some(text) = text else {
                    self.fill(true, if is_open { 0 } else { length });
                    return Ok(());
                };
                let most = length.div_ceil(8);
                let fits =
                    |data: &Vec<u8>| is_open && (length == 0 || data.len() <= most) || data.len() == most;
                let size = || match (is_open, length) {
                    (_, 0) => "bytes".to_owned(),
                    (true, _) => format!("up to {most} bytes"),
                    _ => format!("{most} bytes"),
                };
                let data = bytes(text)
                    .filter(fits)
                    .ok_or_else(|| wrong(format!("it is {} in hexadecimal", size())))?;
                let end = self.at + if is_open { 8 * data.len() } else { length };
                for byte in data {
                    self.push(byte.into(), (end - self.at).min(8));
                }
                Ok(())
            }
            Kind::Variable => self.parameter_value(text.unwrap_or_default()).map_err(wrong),
            Kind::DynamicFieldValue => {
                let Some(key) = self.key else {
                    let data = bytes(text.unwrap_or_default());
                    let data = data.ok_or_else(|| wrong("it is bytes in hexadecimal".to_owned()))?;
                    self.push_bytes(&data);
                    return Ok(());
                };
                let (number, length) = of_key(key, text.unwrap_or_default()).map_err(wrong)?;
                self.push(number, length);
                Ok(())
            }
            _ => {
                let number = self.number(kind, order, number, text)?;
                match kind.field_type {
                    Kind::Pgn => self.about = Some(number as u32),
                    Kind::FieldIndex => self.parameter = Some(number as usize),
                    Kind::DynamicFieldKey => {
                        let keys = kind.lookup_field_type_enumeration.as_ref();
                        let keys = keys.and_then(|name| Database::get().kinds.get(name));
                        self.key = keys.and_then(|keys| keys.get(&number));
                    }
                    _ => {}
                }
                self.raws.insert(order, number);
                self.push(number, length);
                Ok(())
            }
        }
    }

    /// Whether a field takes what is left of a message: the last one of a group that would be longer than a message can be.
    fn is_open(&self, order: usize) -> bool {
        let fields = &self.group.fields;
        let bits: usize = fields.iter().map(|field| field.bit_length).sum();
        order == fields.len() && bits > 8 * MOST_FAST_BYTES
    }

    /// The bits of a field of a fixed length.
    fn number(
        &mut self,
        kind: &'static FieldKind,
        order: usize,
        number: usize,
        text: Option<&str>,
    ) -> Result<u64, EncodeError> {
        let other =
            kind.lookup_indirect_enumeration_field_order.and_then(|order| self.raws.get(&order)).copied();
        if let Some(text) = text {
            let wrong = |reason| EncodeError::Value { field: &kind.name, text: text.to_owned(), reason };
            return raw(kind, text, other).map_err(wrong);
        }
        let counted = kind.wanted.or_else(|| self.counted(kind, order)).or_else(|| absent(kind));
        Ok(counted.unwrap_or_else(|| {
            let name = &kind.name;
            self.needed.push(if number > 1 { format!("{name}_{number}") } else { name.clone() });
            0
        }))
    }

    /// The number of a field that says how often, or how long, others are.
    fn counted(&self, kind: &'static FieldKind, order: usize) -> Option<u64> {
        let group = self.group;
        let fields = &group.fields;
        let text = |field: &FieldKind| {
            let seen = self.seen.get(&plain(&field.name)).copied().unwrap_or(0);
            self.values.get(&(plain(&field.name), seen + 1)).copied()
        };
        if group.set_1_count == order {
            return Some(self.times(group.set_1_size, group.set_1_start) as u64);
        }
        if group.set_2_count == order {
            return Some(self.times(group.set_2_size, group.set_2_start) as u64);
        }
        if kind.field_type == Kind::DynamicFieldLength {
            let value = fields.get(order).filter(|next| next.field_type == Kind::DynamicFieldValue)?;
            let length = match self.key {
                Some(key) => of_key(key, text(value)?).ok()?.1.div_ceil(8),
                None => bytes(text(value)?)?.len(),
            };
            return Some(length as u64);
        }
        let long = fields.iter().find(|field| field.bit_length_field == Some(order))?;
        Some(8 * text(long).and_then(bytes).map_or(0, |bytes| bytes.len()) as u64)
    }

    /// Ones for what is reserved or not available, or zeros.
    fn fill(&mut self, with_ones: bool, length: usize) {
        let mut left = length;
        while left > 0 {
            let part = left.min(64);
            self.push(if with_ones { mask(part) } else { 0 }, part);
            left -= part;
        }
    }

    fn align(&mut self) {
        self.fill(true, self.at.next_multiple_of(8) - self.at);
    }

    fn fixed_text(&mut self, places: usize, text: &str, fills: bool) -> Result<(), String> {
        self.align();
        // A text of a fixed length ends at its first 0 or FF, and blanks and @ at its end do not count.
        if text.len() > places || text.contains('\0') {
            return Err(format!("it has room for {places} bytes"));
        }
        self.push_bytes(text.as_bytes());
        self.fill(true, if fills { 8 * (places - text.len()) } else { 0 });
        Ok(())
    }

    /// Its length with these two bytes, its coding, its letters.
    fn text_with_coding(&mut self, text: &str) -> Result<(), String> {
        self.align();
        let (coding, letters) = if text.is_ascii() {
            (1, text.as_bytes().to_vec())
        } else {
            (0, text.encode_utf16().flat_map(u16::to_le_bytes).collect())
        };
        let length = u8::try_from(letters.len() + 2).map_err(|_| "it has room for 253 bytes".to_owned())?;
        self.push_bytes(&[length, coding]);
        self.push_bytes(&letters);
        Ok(())
    }

    /// Its length, its letters, and, unless its place is of a fixed length, a zero.
    fn counted_text(&mut self, places: usize, text: &str) -> Result<(), String> {
        self.align();
        let room = if places > 0 { places - 1 } else { 254 };
        if text.len() > room {
            return Err(format!("it has room for {room} bytes"));
        }
        self.push_bytes(&[text.len() as u8]);
        self.push_bytes(text.as_bytes());
        self.fill(false, if places > 0 { 8 * (room - text.len()) } else { 8 });
        Ok(())
    }

    /// A value of the parameter that was named before, in whole bytes.
    fn parameter_value(&mut self, text: &str) -> Result<(), String> {
        match self.about.zip(self.parameter).and_then(|(pgn, order)| parameter(pgn, order)) {
            Some(kind) if kind.bit_length > 0 && kind.bit_length <= 64 => {
                let number = raw(kind, text, None)?;
                self.push(number, kind.bit_length);
                self.fill(true, kind.bit_length.next_multiple_of(8) - kind.bit_length);
            }
            _ => {
                let data = bytes(text).ok_or("it is bytes in hexadecimal, as it is not known what it is")?;
                self.push_bytes(&data);
            }
        }
        Ok(())
    }
}
