//! A message's bytes as named values.

use std::borrow::Cow;

use cantap_signals::shortest_of_f32;
use half::f16;

use super::bits::{BitReader, TooShort};
use super::library::Library;
use super::meaning;
use super::model::{Generation, Kind, Member, Section, Size, bits_for};
use crate::{Bytes, Field, Value};

/// How many values of one message are shown.
const MOST_FIELDS: usize = 2048;
/// How many elements and fields of one message are read: those of no length would never end, and types in types that have none come to as many.
const MOST_ELEMENTS: usize = 100_000;
/// How deep types may be nested; a library has none that are deeper.
const MOST_DEPTH: u8 = 32;

/// Why a message cannot be read to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unread {
    /// It has fewer bytes than its type.
    Short,
    /// It has a number that its type does not allow.
    Wrong(&'static str),
}

impl From<TooShort> for Unread {
    fn from(_: TooShort) -> Self {
        Self::Short
    }
}

struct Reader<'a> {
    library: &'a Library,
    prefix: &'a str,
    fields: &'a mut Vec<Field>,
    elements: usize,
}

/// Appends the values of a message, as far as they can be read, with names that begin so. `is_open` leaves out the length of an array at the
/// end, as DroneCAN does on classical CAN. Returns the bytes that are left.
pub(crate) fn read<'a>(
    library: &Library,
    section: &Section,
    data: &'a [u8],
    is_open: bool,
    prefix: &str,
    fields: &mut Vec<Field>,
) -> Result<&'a [u8], Unread> {
    let mut bits = BitReader::of(data, library.generation);
    let mut reader = Reader { library, prefix, fields, elements: 0 };
    reader.section(section, &mut bits, is_open, &mut String::new(), 0)?;
    Ok(bits.rest())
}

impl Reader<'_> {
    fn section(
        &mut self,
        section: &Section,
        bits: &mut BitReader<'_>,
        is_open: bool,
        path: &mut String,
        depth: u8,
    ) -> Result<(), Unread> {
        if depth > MOST_DEPTH {
            return Err(Unread::Wrong("types that are nested too deep"));
        }
        if section.is_union {
            let most = section.members.len().saturating_sub(1) as u32;
            let width = self.width(most.max(1));
            let tag = bits.take(width)? as usize;
            let member = section.members.get(tag).ok_or(Unread::Wrong("a union without that member"))?;
            return self.member(member, bits, is_open, path, depth);
        }
        let last = section.members.len().wrapping_sub(1);
        for (at, member) in section.members.iter().enumerate() {
            self.member(member, bits, is_open && at == last, path, depth)?;
        }
        Ok(())
    }

    /// The bits of a number that says which, or how many.
    fn width(&self, most: u32) -> u8 {
        match self.library.generation {
            Generation::DroneCan => bits_for(most),
            Generation::Cyphal => bits_for(most).max(8).next_power_of_two(),
        }
    }

    fn member(
        &mut self,
        member: &Member,
        bits: &mut BitReader<'_>,
        is_open: bool,
        path: &mut String,
        depth: u8,
    ) -> Result<(), Unread> {
        self.read_elements(1)?;
        let before = path.len();
        if !path.is_empty() && !member.name.is_empty() {
            path.push('.');
        }
        path.push_str(&member.name);
        let done = self.value(member, &member.kind, bits, is_open, path, depth);
        path.truncate(before);
        done
    }

    fn value(
        &mut self,
        member: &Member,
        kind: &Kind,
        bits: &mut BitReader<'_>,
        is_open: bool,
        path: &mut String,
        depth: u8,
    ) -> Result<(), Unread> {
        match kind {
            Kind::Void(count) => {
                if self.library.generation == Generation::DroneCan && usize::from(*count) > bits.left() {
                    return Err(Unread::Short);
                }
                bits.skip(usize::from(*count));
            }
            Kind::Bool => {
                let value = bits.take(1)?;
                self.integer(member, value as i64, path);
            }
            Kind::Unsigned(count) => {
                let value = bits.take(*count)?;
                match i64::try_from(value) {
                    Ok(value) => self.integer(member, value, path),
                    Err(_) => self.push(path, Value::Hex(value, 16), member.unit, None),
                }
            }
            Kind::Signed(count) => {
                let shift = 64 - u32::from(*count);
                let value = ((bits.take(*count)? << shift) as i64) >> shift;
                self.integer(member, value, path);
            }
            Kind::Float(count) => {
                let value = bits.take(*count)?;
                let value = match count {
                    16 => shortest_of_f32(f16::from_bits(value as u16).to_f32()),
                    32 => shortest_of_f32(f32::from_bits(value as u32)),
                    _ => f64::from_bits(value),
                };
                let value = if value.is_nan() { Value::Missing } else { Value::Real(value) };
                self.push(path, value, member.unit, None);
            }
            Kind::Nested(of) => {
                let of = &self.library.nested(*of).request;
                match self.library.generation {
                    Generation::DroneCan => self.section(of, bits, is_open, path, depth + 1)?,
                    Generation::Cyphal => {
                        bits.align();
                        if of.is_sealed {
                            self.section(of, bits, false, path, depth + 1)?;
                        } else {
                            let length = bits.take(32)?;
                            let mut part = bits.part(length as usize)?;
                            self.section(of, &mut part, false, path, depth + 1)?;
                        }
                        bits.align();
                    }
                }
            }
            Kind::Text(size) => {
                let bytes = self.bytes(*size, bits, is_open)?;
                let value = match std::str::from_utf8(&bytes) {
                    Ok(text) => Value::Text(Cow::Owned(text.to_owned())),
                    Err(_) => Value::Bytes(bytes),
                };
                self.push(path, value, "", None);
            }
            Kind::Array(element, size) => self.array(member, element, *size, bits, is_open, path, depth)?,
        }
        Ok(())
    }

    #[expect(clippy::too_many_arguments, reason = "one place in a tree")]
    fn array(
        &mut self,
        member: &Member,
        element: &Kind,
        size: Size,
        bits: &mut BitReader<'_>,
        is_open: bool,
        path: &mut String,
        depth: u8,
    ) -> Result<(), Unread> {
        match element {
            Kind::Unsigned(8) if member.meanings.is_empty() => {
                let bytes = self.bytes(size, bits, is_open)?;
                self.push(path, Value::Bytes(bytes), member.unit, None);
                return Ok(());
            }
            Kind::Bool => {
                let count = self.count(size, bits)?;
                self.read_elements(count as usize)?;
                let mut set = Vec::new();
                for number in 0..count {
                    if bits.take(1)? == 1 {
                        set.push(number.to_string());
                    }
                }
                self.push(path, Value::Text(set.join(", ").into()), "", None);
                return Ok(());
            }
            _ => {}
        }
        let without_count = is_open && matches!(size, Size::UpTo(_)) && self.least_bits(element) >= 8;
        let count = if without_count { u32::MAX } else { self.count(size, bits)? };
        let before = path.len();
        let mut number = 0;
        while number < count && !(without_count && bits.left() < 8) {
            if number >= size.most() {
                return Err(Unread::Wrong("more elements than its array can have"));
            }
            self.read_elements(1)?;
            path.push('[');
            path.push_str(itoa::Buffer::new().format(number));
            path.push(']');
            let is_last = is_open && !without_count && number + 1 == count;
            let done = self.value(member, element, bits, is_last, path, depth);
            path.truncate(before);
            done?;
            number += 1;
        }
        Ok(())
    }

    /// The number of elements.
    fn count(&self, size: Size, bits: &mut BitReader<'_>) -> Result<u32, Unread> {
        match size {
            Size::Fixed(count) => Ok(count),
            Size::UpTo(most) => {
                let count = bits.take(self.width(most))?;
                let count = u32::try_from(count).ok().filter(|count| *count <= most);
                count.ok_or(Unread::Wrong("more elements than its array can have"))
            }
        }
    }

    fn bytes(&mut self, size: Size, bits: &mut BitReader<'_>, is_open: bool) -> Result<Bytes, Unread> {
        let without_count = is_open && matches!(size, Size::UpTo(_));
        let count = if without_count { (bits.left() / 8) as u32 } else { self.count(size, bits)? };
        if count > size.most() {
            return Err(Unread::Wrong("more elements than its array can have"));
        }
        self.read_elements(count as usize)?;
        (0..count).map(|_| bits.take(8).map(|byte| byte as u8).map_err(Unread::from)).collect()
    }

    fn least_bits(&self, kind: &Kind) -> u32 {
        match kind {
            Kind::Nested(of) => self.library.nested(*of).request.least_bits,
            Kind::Bool => 1,
            Kind::Void(bits) | Kind::Unsigned(bits) | Kind::Signed(bits) | Kind::Float(bits) => {
                (*bits).into()
            }
            Kind::Array(..) | Kind::Text(_) => 0,
        }
    }

    fn read_elements(&mut self, count: usize) -> Result<(), Unread> {
        self.elements += count;
        if self.elements > MOST_ELEMENTS { Err(Unread::Wrong("too many elements")) } else { Ok(()) }
    }

    fn integer(&mut self, member: &Member, value: i64, path: &str) {
        self.push(path, Value::Number(value), member.unit, meaning::of(member, value));
    }

    fn push(&mut self, path: &str, value: Value, unit: &'static str, text: Option<String>) {
        if self.fields.len() >= MOST_FIELDS {
            return;
        }
        let name = format!("{}{path}", self.prefix);
        let field = Field { name: name.into(), value, unit: unit.into(), text: text.map(Into::into) };
        self.fields.push(field);
    }
}
