//! What an MF4 file says about its groups: which of them carry bus events, and where each field is in a
//! record.

use std::collections::HashMap;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{Block, u16_at, u32_at, u64_at};
use super::stream::Stream;

/// More channels in a group, and deeper nesting, than any logger writes.
const MAX_CHANNELS: usize = 1 << 16;
const MAX_DEPTH: u32 = 8;

/// Group flag: its records have variable length and belong to another group's channel.
const VARIABLE_LENGTH: u16 = 1;
/// In a group's flags: the times of its records are the records of another group (4.2).
const REMOTE_MASTER: u16 = 1 << 3;

/// In a channel's flags: a bit behind the values says whether its own is one.
const MAY_BE_INVALID: u32 = 1 << 1;
/// In a channel's flags: none of its values is one.
const ALL_INVALID: u32 = 1;

// Types of channels.
const VARIABLE: u8 = 1;
const MASTER: u8 = 2;
const VIRTUAL_MASTER: u8 = 3;
/// What a master channel counts.
const TIME: u8 = 1;

/// A field of a record.
#[derive(Clone, Copy, Debug)]
pub(super) struct Field {
    at: usize,
    bit: u8,
    bits: u32,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Integer { big_endian: bool, signed: bool },
    Float { big_endian: bool },
    Text,
}

impl Field {
    fn of(channel: &Block) -> Self {
        let data = &channel.data;
        let kind = match data.get(2) {
            Some(0) => Kind::Integer { big_endian: false, signed: false },
            Some(1) => Kind::Integer { big_endian: true, signed: false },
            Some(2) => Kind::Integer { big_endian: false, signed: true },
            Some(3) => Kind::Integer { big_endian: true, signed: true },
            Some(4) => Kind::Float { big_endian: false },
            Some(5) => Kind::Float { big_endian: true },
            _ => Kind::Text,
        };
        let bit = data.get(3).copied().unwrap_or(0) & 7;
        Self { at: u32_at(data, 4) as usize, bit, bits: u32_at(data, 8), kind }
    }

    /// The bytes of a text or of a byte array.
    pub(super) fn bytes<'a>(&self, record: &'a [u8]) -> Option<&'a [u8]> {
        record.get(self.at..)?.get(..self.bits as usize / 8)
    }

    /// A number's bits, at most 64 of them; `None` if it is not an integer or lies outside the record.
    pub(super) fn unsigned(&self, record: &[u8]) -> Option<u64> {
        let Kind::Integer { big_endian, .. } = self.kind else { return None };
        self.bits_of(record, big_endian)
    }

    #[inline]
    fn bits_of(&self, record: &[u8], big_endian: bool) -> Option<u64> {
        if self.bits == 0 || self.bits > 64 {
            return None;
        }
        let mask = u64::MAX >> (64 - self.bits);
        let end = u32::from(self.bit) + self.bits;
        if !big_endian
            && end <= 64
            && let Some(word) = record.get(self.at..).and_then(<[u8]>::first_chunk)
        {
            return Some(u64::from_le_bytes(*word) >> self.bit & mask);
        }
        let len = end.div_ceil(8) as usize;
        let bytes = record.get(self.at..)?.get(..len)?;
        let join = |value: u128, byte: &u8| value << 8 | u128::from(*byte);
        let all = if big_endian { bytes.iter().fold(0, join) } else { bytes.iter().rev().fold(0, join) };
        Some((all >> self.bit) as u64 & mask)
    }

    /// Where its number stands in each record of this length; `None` where [`Self::unsigned`] has more to do than to look there.
    pub(super) fn place(&self, record_bytes: usize) -> Option<Place> {
        let Kind::Integer { big_endian: false, .. } = self.kind else { return None };
        let end = u32::from(self.bit) + self.bits;
        let is_inside = self.at.checked_add(end.div_ceil(8) as usize)? <= record_bytes;
        let is_word = self.bits > 0 && end <= 64;
        (is_inside && is_word).then(|| Place {
            at: self.at,
            bit: self.bit,
            mask: u64::MAX >> (64 - self.bits),
        })
    }

    /// Where its bytes begin, and how many there are; `None` if not all are inside a record of this length.
    pub(super) fn span(&self, record_bytes: usize) -> Option<(usize, usize)> {
        let len = self.bits as usize / 8;
        (self.at.checked_add(len)? <= record_bytes).then_some((self.at, len))
    }

    /// Whether a flag is set, or a text says what the flag stands for.
    pub(super) fn flag(&self, record: &[u8], text: &[u8]) -> bool {
        match self.kind {
            Kind::Text => self.bytes(record).is_some_and(|bytes| bytes.starts_with(text)),
            Kind::Integer { .. } | Kind::Float { .. } => {
                self.unsigned(record).is_some_and(|value| value != 0)
            }
        }
    }

    /// A signed integer, exactly.
    #[inline]
    fn signed(&self, record: &[u8]) -> Option<i64> {
        let Kind::Integer { big_endian, signed } = self.kind else { return None };
        let bits = self.bits_of(record, big_endian)?;
        let unused = 64 - self.bits;
        if signed { Some((bits << unused).cast_signed() >> unused) } else { i64::try_from(bits).ok() }
    }

    fn float(&self, record: &[u8]) -> Option<f64> {
        let Kind::Float { big_endian } = self.kind else { return None };
        let bits = self.bits_of(record, big_endian)?;
        match self.bits {
            32 => Some(f64::from(f32::from_bits(bits as u32))),
            64 => Some(f64::from_bits(bits)),
            _ => None,
        }
    }
}

/// Where a number stands, in a word of eight bytes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    at: usize,
    bit: u8,
    mask: u64,
}

impl Place {
    /// So many bytes must be there behind the place.
    pub(super) const BYTES: usize = 8;

    /// The number; 0 if there are fewer bytes.
    #[inline]
    pub(super) fn get(&self, bytes: &[u8]) -> u64 {
        let word = bytes.get(self.at..).and_then(<[u8]>::first_chunk);
        word.map_or(0, |word| u64::from_le_bytes(*word) >> self.bit & self.mask)
    }
}

/// How a group tells the time of its records.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    /// If `None`, the number of the record.
    field: Option<Field>,
    offset_s: f64,
    factor_s: f64,
    /// A counter of whole nanoseconds, or of a multiple, is exact; a floating-point number would not be.
    step_ns: Option<i64>,
}

const NS_PER_S: f64 = 1e9;

impl Clock {
    fn new(field: Option<Field>, offset_s: f64, factor_s: f64) -> Self {
        let step_ns = (factor_s * NS_PER_S).round();
        let is_whole = step_ns >= 1.0 && (factor_s * NS_PER_S - step_ns).abs() < 1e-9 * step_ns;
        let step_ns = (is_whole && offset_s == 0.0).then_some(step_ns as i64);
        Self { field, offset_s, factor_s, step_ns }
    }

    /// Where a counter is that needs nothing but to be multiplied, and by what; [`Self::ns`] is for the others, and for what is too large.
    pub(super) fn counter(&self, record_bytes: usize) -> Option<(Place, i64)> {
        let field = self.field.as_ref()?;
        let is_signed = matches!(field.kind, Kind::Integer { signed: true, .. });
        Some((field.place(record_bytes).filter(|_| !is_signed || field.bits == 64)?, self.step_ns?))
    }

    /// Where a floating-point number of eight bytes is that counts; [`Self::ns_of`] says what it means.
    pub(super) fn float(&self, record_bytes: usize) -> Option<usize> {
        let field = self.field.as_ref()?;
        let is_float = field.kind == Kind::Float { big_endian: false } && field.bits == 64 && field.bit == 0;
        let (at, _) = field.span(record_bytes).filter(|_| is_float)?;
        Some(at)
    }

    /// Nanoseconds since the start of the measurement, from a number that is not counted exactly.
    #[inline]
    pub(super) fn ns_of(&self, raw: f64) -> Option<i64> {
        let ns = (raw * self.factor_s + self.offset_s) * NS_PER_S;
        (ns.abs() < 9e18).then(|| rounded(ns))
    }

    /// Nanoseconds since the start of the measurement.
    pub(super) fn ns(&self, record: &[u8], number: u64) -> Option<i64> {
        let integer = match &self.field {
            None => i64::try_from(number).ok(),
            Some(field) => field.signed(record),
        };
        if let (Some(integer), Some(step_ns)) = (integer, self.step_ns) {
            return integer.checked_mul(step_ns);
        }
        self.ns_of(integer.map(|integer| integer as f64).or_else(|| self.field?.float(record))?)
    }
}

/// As [`f64::round`], which is a call where not every processor of the kind has an instruction for it.
#[inline]
fn rounded(number: f64) -> i64 {
    let whole = number as i64;
    let rest = number - whole as f64;
    whole + i64::from(rest >= 0.5) - i64::from(rest <= -0.5)
}

/// Which bus events a group has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Events {
    Frames,
    RemoteFrames,
    ErrorFrames,
    /// Our own words for events that the standard has no form for.
    Words,
    /// Something else, which is left out.
    Other(&'static str),
}

/// Where the frames' bytes are.
pub(super) enum Bytes {
    /// In the record.
    Here(Field),
    /// In a separate stream, at the position given in the record.
    Stream { place: Field, stream: Stream },
    /// In the records of another group, at this address.
    Group { place: Field, address: u64 },
}

/// Which group a group of data consists of, by its address, where it is the only one: its data, from which its records can be read by number.
pub(super) type Alone = HashMap<u64, u64>;

/// The records of another group, of which each has the time of one here.
pub(super) struct Times {
    pub stream: Stream,
    pub record_bytes: usize,
}

/// The bytes of a record: its values, then a bit for each that may be none.
#[derive(Clone, Copy, Default)]
pub(super) struct RecordBytes {
    pub values: usize,
    pub invalid: usize,
}

impl RecordBytes {
    fn of(group: &Block) -> Self {
        // Behind the links there is one more in a group with times elsewhere, but the fields are the same.
        Self { values: u32_at(&group.data, 24) as usize, invalid: u32_at(&group.data, 28) as usize }
    }

    /// All of them.
    pub(super) fn all(self) -> usize {
        self.values.saturating_add(self.invalid)
    }
}

/// A group whose records are events of a bus.
pub(super) struct BusGroup {
    pub events: Events,
    pub clock: Clock,
    /// Where the clock's field is, if it is not in the record.
    pub times: Option<Times>,
    /// Bits that say that what a record cannot do without is no value.
    pub invalid_bits: Vec<u32>,
    /// Whether none of its records is valid.
    pub all_invalid: bool,
    /// The channel named by the group's source, if its records do not name one.
    pub bus: u8,
    pub bus_channel: Option<Field>,
    pub id: Option<Field>,
    pub ide: Option<Field>,
    pub dlc: Option<Field>,
    pub data_length: Option<Field>,
    pub bytes: Option<Bytes>,
    pub dir: Option<Field>,
    pub edl: Option<Field>,
    pub brs: Option<Field>,
    pub esi: Option<Field>,
    pub error_type: Option<Field>,
    pub words: Option<Field>,
}

/// What a channel group is.
pub(super) enum Content {
    Bus(Box<BusGroup>),
    /// Records of varying length: values of another group's channel.
    Values,
    /// Measured signals, and anything else that is not a bus event.
    Signals,
    /// Nothing but times, for other groups.
    Times,
}

/// A group of channels: records of one kind.
pub(super) struct Group {
    pub address: u64,
    pub record_id: u64,
    pub records: u64,
    pub record_bytes: RecordBytes,
    pub content: Content,
}

/// The fields by the last part of their names, except for the first two; and the kind of group that has them.
const FRAMES: [(&str, Events); 10] = [
    ("CAN_DataFrame", Events::Frames),
    ("CAN_RemoteFrame", Events::RemoteFrames),
    ("CAN_ErrorFrame", Events::ErrorFrames),
    (super::WORDS, Events::Words),
    ("CAN_OverloadFrame", Events::Other("overload frames")),
    ("LIN_", Events::Other("events of LIN")),
    ("FLX_", Events::Other("events of FlexRay")),
    ("ETH_", Events::Other("events of Ethernet")),
    ("MOST_", Events::Other("events of MOST")),
    ("K_LINE", Events::Other("events of K-Line")),
];

/// A channel and its components in sequence.
struct Channel {
    name: String,
    block: Block,
}

/// The channels, starting at a link.
fn channels(
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
        found.push(Channel { name: name.clone(), block });
        // Arrays have components, too; a byte array's bytes are those of its channel.
        if composition != 0 && depth < MAX_DEPTH && &file.head(composition)?.name == b"##CN" {
            channels(file, composition, &name, depth + 1, found)?;
        }
    }
    Ok(())
}

fn is_master(channel: &Channel) -> bool {
    matches!(channel.block.data.first(), Some(&(MASTER | VIRTUAL_MASTER)))
        && matches!(channel.block.data.get(1), Some(&(TIME | 0)))
}

/// The clock of a group, from its time channel.
fn clock(file: &mut Whole, channels: &[Channel]) -> Result<Option<Clock>, Fault> {
    let Some(master) = channels.iter().find(|channel| is_master(channel)) else { return Ok(None) };
    let is_virtual = master.block.data.first() == Some(&VIRTUAL_MASTER);
    let field = (!is_virtual).then(|| Field::of(&master.block));
    let (mut offset_s, mut factor_s) = (0.0, 1.0);
    if master.block.link(4) != 0 {
        const NO_CHANGE: u8 = 0;
        const LINEAR: u8 = 1;
        /// After type, precision, flags, numbers of links and values, and range come the values.
        const VALUES_AT: usize = 24;
        let conversion = file.block(master.block.link(4), *b"##CC")?;
        let value = |at: usize| f64::from_bits(u64_at(&conversion.data, VALUES_AT + 8 * at));
        match conversion.data.first() {
            Some(&NO_CHANGE) => {}
            Some(&LINEAR) => (offset_s, factor_s) = (value(0), value(1)),
            _ => return Err(Fault::Unsupported("a group whose times are no line over their counter".into())),
        }
    }
    Ok(Some(Clock::new(field, offset_s, factor_s)))
}

/// The clock that is another group's, and that group's records.
fn elsewhere(file: &mut Whole, address: u64, open_end: bool, alone: &Alone) -> Result<(Clock, Times), Fault> {
    let what = || Fault::Unsupported("a group of frames whose times cannot be found".to_owned().into());
    let data = alone.get(&address).ok_or_else(what)?;
    let group = file.block(address, *b"##CG")?;
    let mut all = Vec::new();
    channels(file, group.link(1), "", 0, &mut all)?;
    let clock = clock(file, &all)?.ok_or_else(what)?;
    let bytes = RecordBytes::of(&group);
    let mut stream = Stream::of_records(file, *data, open_end, bytes.values, bytes.invalid)?;
    let record_bytes = if stream.invalid().is_some() { bytes.values } else { bytes.all() };
    Ok((clock, Times { stream, record_bytes }))
}

/// The number at the end of a name: 2 for `CAN2`, 1 if there is none.
fn number_of(name: &str) -> u8 {
    let digits = name.len() - name.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    name[name.len() - digits..].parse().unwrap_or(1)
}

impl Group {
    /// The group at a link, and the link to the next.
    pub(super) fn open(
        file: &mut Whole,
        address: u64,
        open_end: bool,
        alone: &Alone,
    ) -> Result<(Self, u64), Fault> {
        let block = file.block(address, *b"##CG")?;
        let (record_id, records) = (u64_at(&block.data, 0), u64_at(&block.data, 8));
        let record_bytes = RecordBytes::of(&block);
        let content = if u16_at(&block.data, 16) & VARIABLE_LENGTH != 0 {
            Content::Values
        } else {
            let mut all = Vec::new();
            channels(file, block.link(1), "", 0, &mut all)?;
            match BusGroup::open(file, &block, &all, open_end, alone)? {
                Some(bus) => Content::Bus(Box::new(bus)),
                None if all.len() == 1 && is_master(&all[0]) => Content::Times,
                None => Content::Signals,
            }
        };
        Ok((Self { address, record_id, records, record_bytes, content }, block.link(0)))
    }
}

impl BusGroup {
    fn open(
        file: &mut Whole,
        group: &Block,
        all: &[Channel],
        open_end: bool,
        alone: &Alone,
    ) -> Result<Option<Self>, Fault> {
        let begins = |prefix: &str| all.iter().any(|channel| channel.name.starts_with(prefix));
        let Some((prefix, events)) = FRAMES.iter().find(|(prefix, _)| begins(prefix)) else {
            return Ok(None);
        };
        let (clock, times) = match clock(file, all)? {
            Some(clock) => (clock, None),
            None if u16_at(&group.data, 16) & REMOTE_MASTER != 0 => {
                let (clock, times) = elsewhere(file, group.link(6), open_end, alone)?;
                (clock, Some(times))
            }
            None => return Err(Fault::Unsupported("a group of frames without times".to_owned().into())),
        };
        let find = |suffix: &str| {
            let is_it = |channel: &&Channel| {
                let name = channel.name.strip_suffix(suffix);
                name.is_some_and(|before| before.ends_with('.'))
            };
            all.iter().find(is_it)
        };
        let field = |suffix: &str| find(suffix).map(|channel| Field::of(&channel.block));
        let bytes = match find("DataBytes") {
            Some(channel) if channel.block.data.first() == Some(&VARIABLE) => {
                let (place, link) = (Field::of(&channel.block), channel.block.link(5));
                let is_group = link != 0 && &file.head(link)?.name == b"##CG";
                Some(if is_group {
                    Bytes::Group { place, address: link }
                } else {
                    Bytes::Stream { place, stream: Stream::open(file, link, open_end)? }
                })
            }
            Some(channel) => Some(Bytes::Here(Field::of(&channel.block))),
            None => None,
        };
        let mut bus = 1;
        if group.link(3) != 0 {
            let source = file.block(group.link(3), *b"##SI")?;
            bus = number_of(&file.text(source.link(0))?);
        }
        // Without these it is no frame. What else is no value is read as it stands.
        let needed = ["ID", "DLC", "DataLength", "DataBytes"];
        let flags = all.iter().filter(|channel| {
            channel.name == *prefix || needed.iter().any(|part| channel.name == format!("{prefix}.{part}"))
        });
        let flags: Vec<_> =
            flags.map(|channel| (u32_at(&channel.block.data, 12), u32_at(&channel.block.data, 16))).collect();
        let invalid_bits = flags.iter().filter(|(flags, _)| flags & MAY_BE_INVALID != 0);
        Ok(Some(Self {
            events: *events,
            clock,
            times,
            invalid_bits: invalid_bits.map(|(_, bit)| *bit).collect(),
            all_invalid: flags.iter().any(|(flags, _)| flags & ALL_INVALID != 0),
            bus,
            bus_channel: field("BusChannel"),
            id: field("ID"),
            ide: field("IDE"),
            dlc: field("DLC"),
            data_length: field("DataLength"),
            bytes,
            dir: field("Dir"),
            edl: field("EDL"),
            brs: field("BRS"),
            esi: field("ESI"),
            error_type: field("ErrorType"),
            words: field("Words"),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::rounded;
    use proptest::prelude::*;

    #[test]
    fn halves_are_rounded_away_from_zero() {
        for number in [
            0.0,
            -0.0,
            0.5,
            -0.5,
            0.499_999_999_999_999_94,
            -0.499_999_999_999_999_94,
            1.5,
            2.5,
            -2.5,
            8.9e18,
            -8.9e18,
        ] {
            assert_eq!(rounded(number), number.round() as i64, "{number}");
        }
    }

    proptest! {
        #[test]
        fn it_is_what_round_gives(number in -9e18..9e18, small in -1e6..1e6, of_halves in -1_000_000_i64..1_000_000) {
            for number in [number, small, of_halves as f64 / 2.0] {
                prop_assert_eq!(rounded(number), number.round() as i64);
            }
        }
    }
}
