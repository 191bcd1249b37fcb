//! What an MF4 file says about its groups: which of them carry bus events, and how each part of one is read.

use super::super::codec::OTHER_LIN;
use super::super::issue::Fault;
use super::super::whole::Whole;
use super::blocks::{Block, u16_at, u32_at, u64_at};
use super::channel::{Channel, Number, VARIABLE, Validity};
use super::clock::{Clock, is_master};
use super::field::Field;
use super::map::Map;
use super::stream::Stream;
use super::value::Meaning;
use cantap_trace::LinFault;

/// Group flag: its records have variable length and belong to another group's channel.
const VARIABLE_LENGTH: u16 = 1;
/// In a group's flags: the times of its records are the records of another group (4.2).
const REMOTE_MASTER: u16 = 1 << 3;

/// Records of a group with which something is wrong, which is reported once.
const UNREADABLE: &str = "records of a group that cannot be read";

/// Which bus events a group has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Events {
    Frames,
    RemoteFrames,
    ErrorFrames,
    /// Frames of LIN, or those with which this was wrong.
    Lin(Option<LinFault>),
    /// Our own words for events that the standard has no form for.
    Words,
}

/// Where the frames' bytes are.
pub(super) enum Bytes {
    /// In the record; only so many of them, if there is a number of them.
    Here(Field, Option<Number>),
    /// Among the values that are stored elsewhere.
    Apart(usize),
}

/// Values that are stored elsewhere.
pub(super) struct Apart {
    /// Where the record says at which place.
    pub place: Field,
    pub values: Elsewhere,
}

/// Where.
pub(super) enum Elsewhere {
    /// In a stream of their own.
    Stream(Stream),
    /// In the records of another group, at this address.
    Group(u64),
}

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
    /// Whether its records alone say everything about their events.
    pub is_complete: bool,
    /// What a record must have.
    pub needed: Vec<Validity>,
    /// Of these it must have one, if there are any: the length, and the code of the length.
    pub lengths: Vec<Validity>,
    /// The values that are not in the records.
    pub apart: Vec<Apart>,
    /// The channel named by the group's source, if its records do not name one.
    pub bus: u8,
    pub bus_channel: Option<Number>,
    pub id: Option<Number>,
    pub ide: Option<Number>,
    pub dlc: Option<Number>,
    pub data_length: Option<Number>,
    pub bytes: Option<Bytes>,
    pub dir: Option<Number>,
    pub edl: Option<Number>,
    pub brs: Option<Number>,
    pub esi: Option<Number>,
    pub error_type: Option<Number>,
    pub checksum: Option<Number>,
    pub device_time: Option<Number>,
    pub words: Option<Field>,
}

/// What a channel group is.
pub(super) enum Content {
    Bus(Box<BusGroup>),
    /// Events of another bus, or of a kind that a trace does not hold.
    Other(&'static str),
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

/// The kinds of groups by the names of their channels.
const FRAMES: [(&str, Result<Events, &str>); 14] = [
    ("CAN_DataFrame", Ok(Events::Frames)),
    ("CAN_RemoteFrame", Ok(Events::RemoteFrames)),
    ("CAN_ErrorFrame", Ok(Events::ErrorFrames)),
    (super::WORDS, Ok(Events::Words)),
    ("CAN_OverloadFrame", Err("overload frames")),
    ("LIN_Frame", Ok(Events::Lin(None))),
    ("LIN_ChecksumError", Ok(Events::Lin(Some(LinFault::Checksum)))),
    ("LIN_TransmissionError", Ok(Events::Lin(Some(LinFault::NoResponse)))),
    ("LIN_ReceiveError", Ok(Events::Lin(Some(LinFault::Response)))),
    ("LIN_", Err(OTHER_LIN)),
    ("FLX_", Err("events of FlexRay")),
    ("ETH_", Err("events of Ethernet")),
    ("MOST_", Err("events of MOST")),
    ("K_LINE", Err("events of K-Line")),
];

/// The clock that is another group's, and that group's records.
fn elsewhere(file: &mut Whole, address: u64, map: &Map) -> Result<(Clock, Times), Fault> {
    let what = || Fault::Unsupported("a group of frames whose times cannot be found".to_owned().into());
    let data = map.alone.get(&address).ok_or_else(what)?;
    let group = file.block(address, *b"##CG")?;
    let all = Channel::all(file, group.link(1))?;
    let clock = Clock::of(file, &all)?.ok_or_else(what)?;
    let bytes = RecordBytes::of(&group);
    let mut stream = map.stream(file, *data, bytes.values, bytes.invalid)?;
    let record_bytes = if stream.invalid().is_some() { bytes.values } else { bytes.all() };
    Ok((clock, Times { stream, record_bytes }))
}

/// The number at the end of a name: 2 for `CAN2`, 1 if there is none.
fn number_of(name: &str) -> u8 {
    let digits = name.len() - name.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    name[name.len() - digits..].parse().unwrap_or(1)
}

impl Group {
    /// The group at a link, the link to the next, and what is wrong with the group if its records cannot be read.
    pub(super) fn open(
        file: &mut Whole,
        address: u64,
        map: &Map,
    ) -> Result<(Self, u64, Option<Fault>), Fault> {
        let block = file.block(address, *b"##CG")?;
        let (record_id, records) = (u64_at(&block.data, 0), u64_at(&block.data, 8));
        let record_bytes = RecordBytes::of(&block);
        let mut fault = None;
        let content = if u16_at(&block.data, 16) & VARIABLE_LENGTH != 0 {
            Content::Values
        } else {
            match Content::of(file, &block, map) {
                Ok(content) => content,
                Err(Fault::Io(error)) => return Err(error.into()),
                // The other groups of its data can still be read.
                Err(other) => {
                    fault = Some(other);
                    Content::Other(UNREADABLE)
                }
            }
        };
        Ok((Self { address, record_id, records, record_bytes, content }, block.link(0), fault))
    }
}

impl Content {
    fn of(file: &mut Whole, group: &Block, map: &Map) -> Result<Self, Fault> {
        let all = Channel::all(file, group.link(1))?;
        let begins = |prefix: &str| all.iter().any(|channel| channel.name.starts_with(prefix));
        Ok(match FRAMES.iter().find(|(prefix, _)| begins(prefix)) {
            Some((prefix, Ok(events))) => {
                Self::Bus(Box::new(BusGroup::open(file, group, &all, (prefix, *events), map)?))
            }
            Some((_, Err(what))) => Self::Other(what),
            None if all.len() == 1 && is_master(&all[0]) => Self::Times,
            None => Self::Signals,
        })
    }
}

impl BusGroup {
    fn open(
        file: &mut Whole,
        group: &Block,
        all: &[Channel],
        (prefix, events): (&str, Events),
        map: &Map,
    ) -> Result<Self, Fault> {
        let (clock, times) = match Clock::of(file, all)? {
            Some(clock) => (clock, None),
            None if u16_at(&group.data, 16) & REMOTE_MASTER != 0 => {
                let (clock, times) = elsewhere(file, group.link(6), map)?;
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
        let mut apart = Vec::new();
        let mut number = |suffix: &str, meaning: Meaning| {
            let channel = find(suffix);
            channel.map(|channel| Number::of(file, channel, meaning, &mut apart)).transpose()
        };
        let bus_channel = number("BusChannel", Meaning::Number)?;
        let id = number("ID", Meaning::Number)?;
        let ide = number("IDE", Meaning::Extended)?;
        let dlc = number("DLC", Meaning::Number)?;
        let data_length = number("DataLength", Meaning::Number)?;
        let dir = number("Dir", Meaning::Direction)?;
        let edl = number("EDL", Meaning::Flag)?;
        let brs = number("BRS", Meaning::Flag)?;
        let esi = number("ESI", Meaning::Flag)?;
        let error_type = number("ErrorType", Meaning::Number)?;
        let checksum = number("Checksum", Meaning::Number)?;
        let device_time = number(super::DEVICE_TIME, Meaning::Number)?;
        let data_bytes = find("DataBytes");
        let bytes = match data_bytes {
            Some(channel) if channel.kind() == VARIABLE => {
                apart.push(channel);
                Some(Bytes::Apart(apart.len() - 1))
            }
            Some(channel) => Some(Bytes::Here(channel.field(), channel.size(file)?)),
            None => None,
        };
        let apart = apart.into_iter().map(|channel| Apart::open(file, channel, map));
        let apart = apart.collect::<Result<_, _>>()?;
        let mut bus = 1;
        if group.link(3) != 0 {
            let source = file.block(group.link(3), *b"##SI")?;
            bus = number_of(&file.text(source.link(0))?);
        }
        // Without these it is no frame.
        let whole = all.iter().find(|channel| channel.name == prefix).map(Channel::validity);
        let needed = whole.into_iter().chain(id.as_ref().map(Number::validity));
        let needed = needed.chain(data_bytes.map(Channel::validity)).collect();
        let lengths = [&dlc, &data_length].into_iter().flatten().map(Number::validity).collect();
        let words = find("Words").map(Channel::field);
        let mut group = Self {
            events,
            is_complete: false,
            clock,
            times,
            needed,
            lengths,
            apart,
            bus,
            bus_channel,
            id,
            ide,
            dlc,
            data_length,
            bytes,
            dir,
            edl,
            brs,
            esi,
            error_type,
            checksum,
            device_time,
            words,
        };
        group.is_complete = group.says_everything();
        Ok(group)
    }
}

impl Apart {
    fn open(file: &mut Whole, channel: &Channel, map: &Map) -> Result<Self, Fault> {
        let link = channel.block.link(5);
        let is_group = link != 0 && &file.head(link)?.name == b"##CG";
        let values =
            if is_group { Elsewhere::Group(link) } else { Elsewhere::Stream(map.stream(file, link, 0, 0)?) };
        Ok(Self { place: channel.field(), values })
    }
}
