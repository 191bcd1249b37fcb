//! Channels of a group, and how to read the number of one in a record.

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{Block, u32_at, u64_at};
use super::conversion::Conversion;
use super::field::{Field, Place};
use super::value::{Meaning, Value};

/// More channels in a group, and deeper nesting, than any logger writes.
const MAX_CHANNELS: usize = 1 << 16;
const MAX_DEPTH: u32 = 8;

/// In a channel's flags: a bit behind the values says whether its own is one.
const MAY_BE_INVALID: u32 = 1 << 1;
/// In a channel's flags: none of its values is one.
const ALL_INVALID: u32 = 1;

// Types of channels. Others are values of a fixed length, or of a master.
pub(super) const VARIABLE: u8 = 1;
const LIMITED: u8 = 5;
const VIRTUAL: u8 = 6;

/// A channel and its components in sequence.
pub(super) struct Channel {
    pub name: String,
    pub block: Block,
    /// The bits of all elements together, if it is an array of one dimension.
    array_bits: Option<u32>,
}

/// Whether a channel's values are any.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Validity {
    Always,
    /// Not if this bit behind a record's values is set.
    UnlessBit(u32),
    Never,
}

/// A record, as its channels need it.
#[derive(Clone, Copy)]
pub(super) struct Row<'a> {
    pub record: &'a [u8],
    /// Its number in its group, from 0.
    pub number: u64,
    /// The values that are stored elsewhere, in the order of their group's channels of that kind.
    pub apart: &'a [Vec<u8>],
    /// The bits that say which values are none.
    pub invalid: &'a [u8],
}

/// How to read a whole number: a part of a bus event.
#[derive(Debug)]
pub(super) struct Number {
    source: Source,
    validity: Validity,
}

/// In a [`Source::Table`]: no number.
const NONE: u64 = u64::MAX;

/// A field of so many bits at most has its conversion in a table.
const TABLE_BITS: u32 = 8;

#[derive(Debug)]
enum Source {
    /// The raw value itself.
    Field(Field),
    Constant(u64),
    /// What each raw value stands for.
    Table(Field, Box<[u64]>),
    Any {
        raw: Raw,
        conversion: Conversion,
        meaning: Meaning,
    },
}

/// Where a raw value is.
#[derive(Debug)]
enum Raw {
    Field(Field),
    /// The number of the record.
    Number,
    /// Among those stored elsewhere; the channel's own type.
    Apart(usize, Block),
}

/// The same, where it is at a fixed place of each record.
#[derive(Debug)]
pub(super) enum PlainNumber {
    Place(Place),
    Constant(u64),
    Table(Place, Box<[u64]>),
}

impl Channel {
    /// The channels, starting at a link, with their components.
    pub(super) fn all(file: &mut Whole, first: u64) -> Result<Vec<Self>, Fault> {
        let mut found = Vec::new();
        collect(file, first, "", 0, &mut found)?;
        Ok(found)
    }

    /// Its type.
    pub(super) fn kind(&self) -> u8 {
        self.block.data.first().copied().unwrap_or(0)
    }

    /// Where the bytes of its value are in a record; if they are elsewhere, where the record says at which place.
    pub(super) fn field(&self) -> Field {
        if self.kind() == VARIABLE {
            return Field::place_of_value(&self.block);
        }
        let field = Field::of(&self.block);
        self.array_bits.map_or(field, |bits| field.with_bits(bits))
    }

    /// The channel that says how many bytes of this one's value there are; `None` if all are.
    pub(super) fn size(&self, file: &mut Whole) -> Result<Option<Number>, Fault> {
        if self.kind() != LIMITED || self.block.link(5) == 0 {
            return Ok(None);
        }
        let block = file.block(self.block.link(5), *b"##CN")?;
        let size = Self { name: String::new(), block, array_bits: None };
        Number::of(file, &size, Meaning::Number, &mut Vec::new()).map(Some)
    }

    pub(super) fn validity(&self) -> Validity {
        let flags = u32_at(&self.block.data, 12);
        if flags & ALL_INVALID != 0 {
            Validity::Never
        } else if flags & MAY_BE_INVALID != 0 {
            Validity::UnlessBit(u32_at(&self.block.data, 16))
        } else {
            Validity::Always
        }
    }
}

fn collect(
    file: &mut Whole,
    first: u64,
    parent: &str,
    depth: u32,
    found: &mut Vec<Channel>,
) -> Result<(), Fault> {
    let mut next = first;
    while next != 0 {
        if found.len() >= MAX_CHANNELS {
            return Err(Fault::malformed("a list of channels that ends", b"a circle of links"));
        }
        let block = file.block(next, *b"##CN")?;
        next = block.link(0);
        let own = file.text(block.link(2))?;
        let name = if own.contains('.') || parent.is_empty() { own } else { format!("{parent}.{own}") };
        let composition = block.link(1);
        let of_composition = if composition == 0 { *b"    " } else { file.head(composition)?.name };
        let array_bits =
            if &of_composition == b"##CA" { array_bits(file, composition, &block)? } else { None };
        found.push(Channel { name: name.clone(), block, array_bits });
        if depth < MAX_DEPTH && &of_composition == b"##CN" {
            collect(file, composition, &name, depth + 1, found)?;
        }
    }
    Ok(())
}

/// The bits of all elements of an array, if it has one dimension and they follow each other. A byte array may be one of one element.
fn array_bits(file: &mut Whole, at: u64, channel: &Block) -> Result<Option<u32>, Fault> {
    const ELEMENTS_IN_RECORD: u8 = 0;
    let array = file.block(at, *b"##CA")?;
    let bits = u64::from(u32_at(&channel.data, 8));
    let is_in_record = array.data.get(1) == Some(&ELEMENTS_IN_RECORD);
    let is_row = super::blocks::u16_at(&array.data, 2) == 1 && u64::from(u32_at(&array.data, 8)) * 8 == bits;
    let all = bits.saturating_mul(u64_at(&array.data, 16));
    Ok(u32::try_from(all).ok().filter(|all| is_in_record && is_row && *all > 0))
}

impl Validity {
    /// Whether a value is one.
    pub(super) fn holds(self, invalid: &[u8]) -> bool {
        match self {
            Self::Always => true,
            Self::Never => false,
            Self::UnlessBit(bit) => {
                invalid.get(bit as usize / 8).is_none_or(|byte| byte >> (bit % 8) & 1 == 0)
            }
        }
    }
}

impl Number {
    /// That of a channel. Where its values are stored elsewhere, it is added to `apart`.
    pub(super) fn of<'a>(
        file: &mut Whole,
        channel: &'a Channel,
        meaning: Meaning,
        apart: &mut Vec<&'a Channel>,
    ) -> Result<Self, Fault> {
        let validity = channel.validity();
        let conversion = Conversion::of(file, &channel.block)?;
        let field = channel.field();
        let raw = match channel.kind() {
            VARIABLE => {
                apart.push(channel);
                let block = Block { links: Vec::new(), ..channel.block.clone() };
                Raw::Apart(apart.len() - 1, block)
            }
            VIRTUAL => Raw::Number,
            _ => Raw::Field(field),
        };
        let any = |raw| Source::Any { raw, conversion: conversion.clone(), meaning };
        let source = match raw {
            Raw::Number if matches!(conversion, Conversion::Linear { factor: 0.0, .. }) => {
                let constant = meaning.of_converted(&Value::Unsigned(0), &conversion);
                constant.map_or_else(|| any(Raw::Number), Source::Constant)
            }
            Raw::Field(field) if field.is_unsigned() && conversion == Conversion::None => {
                Source::Field(field)
            }
            Raw::Field(field) if field.is_unsigned() && (1..=TABLE_BITS).contains(&field.bits()) => {
                let meanings = (0..1_u64 << field.bits())
                    .map(|raw| meaning.of_converted(&Value::Unsigned(raw), &conversion).unwrap_or(NONE));
                Source::Table(field, meanings.collect())
            }
            raw => any(raw),
        };
        Ok(Self { source, validity })
    }

    /// Whether a record has a value of it.
    pub(super) fn is_valid(&self, row: &Row<'_>) -> bool {
        self.validity.holds(row.invalid)
    }

    pub(super) fn validity(&self) -> Validity {
        self.validity
    }

    /// The number in a record; `None` if there is none.
    #[inline]
    pub(super) fn get(&self, row: &Row<'_>) -> Option<u64> {
        if !self.is_valid(row) {
            return None;
        }
        match &self.source {
            Source::Field(field) => field.unsigned(row.record),
            Source::Constant(number) => Some(*number),
            Source::Table(field, meanings) => {
                let raw = usize::try_from(field.unsigned(row.record)?).ok()?;
                meanings.get(raw).copied().filter(|meaning| *meaning != NONE)
            }
            Source::Any { raw, conversion, meaning } => {
                let value = match raw {
                    Raw::Field(field) => field.value(row.record)?,
                    Raw::Number => Value::Unsigned(row.number),
                    Raw::Apart(at, channel) => {
                        let bytes = row.apart.get(*at)?;
                        Field::of_whole(channel, bytes).value(bytes)?
                    }
                };
                meaning.of_converted(&value, conversion)
            }
        }
    }

    /// The same where it is at a fixed place of each record of this length and always valid.
    pub(super) fn plain(&self, record_bytes: usize) -> Option<PlainNumber> {
        if self.validity != Validity::Always {
            return None;
        }
        match &self.source {
            Source::Field(field) => field.place(record_bytes).map(PlainNumber::Place),
            Source::Constant(number) => Some(PlainNumber::Constant(*number)),
            Source::Table(field, meanings) => {
                Some(PlainNumber::Table(field.place(record_bytes)?, meanings.clone()))
            }
            Source::Any { .. } => None,
        }
    }
}

impl Meaning {
    /// The number that a raw value stands for after its conversion. A conversion into texts is often there for readers only: if what it gives
    /// says nothing known, or nothing at all, the raw value counts.
    fn of_converted(self, raw: &Value, conversion: &Conversion) -> Option<u64> {
        match conversion.apply(raw.clone()) {
            Some(Value::Text(text)) => self.of(&Value::Text(text)).or_else(|| self.of(raw)),
            Some(value) => self.of(&value),
            None if conversion.gives_texts() => self.of(raw),
            None => None,
        }
    }
}

impl PlainNumber {
    /// The number in a record that `bytes` begin with.
    #[inline]
    pub(super) fn get(&self, bytes: &[u8]) -> Option<u64> {
        match self {
            Self::Place(place) => Some(place.get(bytes)),
            Self::Constant(number) => Some(*number),
            Self::Table(place, meanings) => {
                meanings.get(place.get(bytes) as usize).copied().filter(|meaning| *meaning != NONE)
            }
        }
    }
}
