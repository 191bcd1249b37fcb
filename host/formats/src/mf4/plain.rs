//! Data frames out of records whose fields stand at fixed places: most records of most files are such.

use super::layout::{BusGroup, Bytes, Clock, Events, Place};
use cantap_trace::PlainFrame;
use cantap_wire::Id;

/// Where a group has what a plain frame is made of. What [`BusGroup::record`] says of a record, in a few instructions.
pub(super) struct Plain {
    clock: Clock,
    /// Where the clock is a mere counter, and what it counts, in nanoseconds.
    counter: Option<(Place, i64)>,
    start_ns: i64,
    bus: u8,
    bus_channel: Option<Place>,
    id: Place,
    ide: Option<Place>,
    edl: Option<Place>,
    dlc: Option<Place>,
    data_length: Option<Place>,
    bytes_at: usize,
    most_bytes: u64,
    record_bytes: usize,
    /// How many bytes must be there from the record's first on: places are read as words of eight.
    reach: usize,
}

impl Plain {
    /// `None` for groups of other events, and of fields of which there is more to say.
    pub(super) fn of(bus: &BusGroup, record_bytes: usize, start_ns: i64) -> Option<Self> {
        let place = |field: &Option<super::layout::Field>| match field {
            None => Some(None),
            Some(field) => field.place(record_bytes).map(Some),
        };
        let Some(Bytes::Here(bytes)) = &bus.bytes else { return None };
        let (bytes_at, most_bytes) = bytes.span(record_bytes)?;
        let plain = Self {
            clock: bus.clock,
            counter: bus.clock.counter(record_bytes),
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
        (bus.events == Events::Frames && bus.is_complete()).then_some(plain)
    }

    /// The frame in a record that `bytes` begin with; `None` if there is more to say about it, or if not enough follows it.
    #[inline]
    pub(super) fn frame(&self, bytes: &[u8], number: u64) -> Option<PlainFrame> {
        const EXTENDED: u64 = 1 << 31;
        const IDENTIFIER: u64 = (1 << 29) - 1;
        let bytes = bytes.get(..self.reach)?;
        let get = |place: &Option<Place>| place.as_ref().map(|place| place.get(bytes));
        if get(&self.edl).is_some_and(|is_fd| is_fd != 0) {
            return None;
        }
        let channel = get(&self.bus_channel).map_or(Some(self.bus), |channel| u8::try_from(channel).ok())?;
        let raw = self.id.get(bytes);
        let extended =
            get(&self.ide).map_or(raw & EXTENDED != 0 || raw & IDENTIFIER > 0x7FF, |flag| flag != 0);
        let id = (raw & IDENTIFIER) as u32;
        let id = if extended { Id::extended(id) } else { Id::standard(id) }?;
        let len = get(&self.data_length).or_else(|| get(&self.dlc).map(|code| code.min(8)));
        let len = len.unwrap_or(self.most_bytes);
        if len > self.most_bytes.min(8) {
            return None;
        }
        let data = bytes.get(self.bytes_at..)?.first_chunk()?;
        let counted = self.counter.as_ref().and_then(|(place, step_ns)| {
            // With its highest bit set it may be negative or too large.
            i64::try_from(place.get(bytes)).ok()?.checked_mul(*step_ns)
        });
        let offset_ns = counted.or_else(|| self.clock.ns(&bytes[..self.record_bytes], number))?;
        let time_ns = self.start_ns.saturating_add(offset_ns);
        Some(PlainFrame::new(time_ns, channel, id, len as u8, *data))
    }
}
