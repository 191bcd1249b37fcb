//! Data frames out of records whose fields stand at fixed places: most records of most files are such.

use super::channel::{Number, PlainNumber};
use super::clock::Clock;
use super::field::Place;
use super::layout::{BusGroup, Bytes, Events};
use cantap_can::Id;
use cantap_trace::PlainFrame;

/// Where a record says its time.
enum Time {
    /// A mere counter, and what it counts, in nanoseconds.
    Counter(Place, i64),
    /// A floating-point number at this byte.
    Float(usize),
    /// [`Clock::ns`] knows.
    Other,
}

/// Where a group has what a plain frame is made of. What [`BusGroup::record`] says of a record, in a few instructions.
pub(super) struct Plain {
    clock: Clock,
    time: Time,
    start_ns: i64,
    bus: u8,
    bus_channel: Option<PlainNumber>,
    id: PlainNumber,
    ide: Option<PlainNumber>,
    edl: Option<PlainNumber>,
    dlc: Option<PlainNumber>,
    data_length: Option<PlainNumber>,
    bytes_at: usize,
    most_bytes: u64,
    record_bytes: usize,
    /// How many bytes must be there from the record's first on: places are read as words of eight.
    reach: usize,
}

impl Plain {
    /// `None` for groups of other events, and of fields of which there is more to say.
    pub(super) fn of(bus: &BusGroup, record_bytes: usize, start_ns: i64) -> Option<Self> {
        let place = |number: &Option<Number>| match number {
            None => Some(None),
            Some(number) => number.plain(record_bytes).map(Some),
        };
        let Some(Bytes::Here(bytes, None)) = &bus.bytes else { return None };
        let (bytes_at, most_bytes) = bytes.span(record_bytes)?;
        let plain = Self {
            clock: bus.clock.clone(),
            time: match (bus.clock.counter(record_bytes), bus.clock.float(record_bytes)) {
                (Some((place, step_ns)), _) => Time::Counter(place, step_ns),
                (None, Some(at)) => Time::Float(at),
                (None, None) => Time::Other,
            },
            start_ns,
            bus: bus.bus,
            bus_channel: place(&bus.bus_channel)?,
            id: place(&bus.id)??,
            ide: place(&bus.ide)?,
            edl: place(&bus.edl)?,
            dlc: place(&bus.dlc)?,
            data_length: place(&bus.data_length)?,
            bytes_at,
            most_bytes: most_bytes as u64,
            record_bytes,
            reach: record_bytes + Place::BYTES,
        };
        (bus.events == Events::Frames && bus.is_complete).then_some(plain)
    }

    /// Appends the frames of the records that `bytes` begin with, which follow each other, at most `most`: as long as there is no more to say
    /// about them, enough follows them, and it is their turn by `is_next`. `number` is the first one's. Returns how many there were.
    pub(super) fn frames(
        &self,
        bytes: &[u8],
        number: u64,
        most: usize,
        is_next: impl Fn(i64) -> bool,
        frames: &mut Vec<PlainFrame>,
    ) -> usize {
        let before = frames.len();
        let mut rest = bytes;
        frames.extend((number..).take(most).map_while(|number| {
            let frame = self.frame(rest, number).filter(|frame| is_next(frame.time_ns))?;
            rest = &rest[self.record_bytes..];
            Some(frame)
        }));
        frames.len() - before
    }

    /// The frame in a record that `bytes` begin with; `None` if there is more to say about it, or if not enough follows it.
    #[inline]
    pub(super) fn frame(&self, bytes: &[u8], number: u64) -> Option<PlainFrame> {
        const EXTENDED: u64 = 1 << 31;
        const IDENTIFIER: u64 = (1 << 29) - 1;
        let bytes = bytes.get(..self.reach)?;
        // What is there but no number, there is more to say about.
        let get = |number: &Option<PlainNumber>| match number {
            None => Some(None),
            Some(number) => number.get(bytes).map(Some),
        };
        if get(&self.edl)?.is_some_and(|is_fd| is_fd != 0) {
            return None;
        }
        let channel = get(&self.bus_channel)?.map_or(Some(self.bus), |channel| u8::try_from(channel).ok())?;
        let raw = self.id.get(bytes)?;
        let extended =
            get(&self.ide)?.map_or(raw & EXTENDED != 0, |flag| flag != 0) || raw & IDENTIFIER > 0x7FF;
        let id = (raw & IDENTIFIER) as u32;
        let id = if extended { Id::extended(id) } else { Id::standard(id) }?;
        let len = match get(&self.data_length)? {
            Some(len) => len,
            None => get(&self.dlc)?.map_or(self.most_bytes, |code| code.min(8)),
        };
        if len > self.most_bytes.min(8) {
            return None;
        }
        let data = bytes.get(self.bytes_at..)?.first_chunk()?;
        let offset_ns = match &self.time {
            // With its highest bit set it may be negative or too large.
            Time::Counter(place, step_ns) => {
                i64::try_from(place.get(bytes)).ok().and_then(|count| count.checked_mul(*step_ns))
            }
            Time::Float(at) => self.clock.ns_of(f64::from_le_bytes(*bytes.get(*at..)?.first_chunk()?)),
            Time::Other => None,
        };
        let offset_ns = offset_ns.or_else(|| self.clock.ns(&bytes[..self.record_bytes], number))?;
        let time_ns = self.start_ns.saturating_add(offset_ns);
        Some(PlainFrame::new(time_ns, channel, id, len as u8, *data))
    }
}
