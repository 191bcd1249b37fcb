//! What an MF4 file says about its groups: which of them carry bus events, and where each field is in a
//! record.

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{Block, u16_at, u32_at, u64_at};
use super::stream::Stream;

/// More channels in a group, and deeper nesting, than any logger writes.
const MAX_CHANNELS: usize = 1 << 16;
const MAX_DEPTH: u32 = 8;

/// Group flag: its records have variable length and belong to another group's channel.
const VARIABLE_LENGTH: u16 = 1;

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

    /// Whether a flag is set, or has the text that means it is set.
    pub(super) fn flag(&self, record: &[u8], text: &[u8]) -> bool {
        match self.kind {
            Kind::Text => self.bytes(record).is_some_and(|bytes| bytes.starts_with(text)),
            Kind::Integer { .. } | Kind::Float { .. } => {
                self.unsigned(record).is_some_and(|value| value != 0)
            }
        }
    }

    /// A signed integer, exactly.
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

/// How a group gives the time of its records.
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

    /// Nanoseconds since the start of the measurement.
    pub(super) fn ns(&self, record: &[u8], number: u64) -> Option<i64> {
        let integer = match &self.field {
            None => i64::try_from(number).ok(),
            Some(field) => field.signed(record),
        };
        if let (Some(integer), Some(step_ns)) = (integer, self.step_ns) {
            return integer.checked_mul(step_ns);
        }
        let raw = integer.map(|integer| integer as f64).or_else(|| self.field?.float(record))?;
        let ns = (raw * self.factor_s + self.offset_s) * NS_PER_S;
        (ns.abs() < 9e18).then(|| ns.round() as i64)
    }
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

/// A group whose records are events of a bus.
pub(super) struct BusGroup {
    pub events: Events,
    pub clock: Clock,
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
}

/// A group of channels: records of one kind.
pub(super) struct Group {
    pub address: u64,
    pub record_id: u64,
    pub records: u64,
    pub record_bytes: usize,
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

/// The clock of a group, from its time channel.
fn clock(file: &mut Whole, channels: &[Channel]) -> Result<Option<Clock>, Fault> {
    let is_master = |channel: &&Channel| {
        matches!(channel.block.data.first(), Some(&(MASTER | VIRTUAL_MASTER)))
            && matches!(channel.block.data.get(1), Some(&(TIME | 0)))
    };
    let Some(master) = channels.iter().find(is_master) else { return Ok(None) };
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

/// The number at the end of a name: 2 for `CAN2`, 1 if there is none.
fn number_of(name: &str) -> u8 {
    let digits = name.len() - name.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    name[name.len() - digits..].parse().unwrap_or(1)
}

impl Group {
    /// The group at a link, and the link to the next.
    pub(super) fn open(file: &mut Whole, address: u64, open_end: bool) -> Result<(Self, u64), Fault> {
        let block = file.block(address, *b"##CG")?;
        let (record_id, records) = (u64_at(&block.data, 0), u64_at(&block.data, 8));
        let record_bytes = u32_at(&block.data, 24) as usize + u32_at(&block.data, 28) as usize;
        let content = if u16_at(&block.data, 16) & VARIABLE_LENGTH != 0 {
            Content::Values
        } else {
            match BusGroup::open(file, &block, open_end)? {
                Some(bus) => Content::Bus(Box::new(bus)),
                None => Content::Signals,
            }
        };
        Ok((Self { address, record_id, records, record_bytes, content }, block.link(0)))
    }
}

impl BusGroup {
    fn open(file: &mut Whole, group: &Block, open_end: bool) -> Result<Option<Self>, Fault> {
        let mut all = Vec::new();
        channels(file, group.link(1), "", 0, &mut all)?;
        let begins = |prefix: &str| all.iter().any(|channel| channel.name.starts_with(prefix));
        let Some((_, events)) = FRAMES.iter().find(|(prefix, _)| begins(prefix)) else { return Ok(None) };
        let Some(clock) = clock(file, &all)? else {
            let what = "a group of frames without times (MDF 4.2 can keep them in another group, as columns)";
            return Err(Fault::Unsupported(what.to_owned().into()));
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
        Ok(Some(Self {
            events: *events,
            clock,
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
