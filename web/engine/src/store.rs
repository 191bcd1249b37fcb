//! The records of a trace in columns: 22 bytes for a frame of up to eight data bytes, 26 if the device's time is known, where a
//! [`TraceRecord`] has 96.

use cantap_trace::{
    Direction, FdFrame, Frame, Id, Interval, Moment, TraceEvent, TraceFrame, TraceRecord, fd::FD_LENGTHS,
};

use crate::device_times::DeviceTimes;

/// Rows of a block: blocks are filled one after another, so that nothing is copied when the trace grows.
pub const BLOCK_ROWS: usize = 1 << 16;

/// The identifier's column also has these.
const EXTENDED: u32 = 1 << 31;
const SENT: u32 = 1 << 30;
const LATE: u32 = 1 << 29;
const ID_BITS: u32 = LATE - 1;

/// The upper four bits of the kind's column; the lower ones are the length code.
const DATA: u8 = 0;
const REMOTE: u8 = 1;
/// And the two after it: bit rate switched, sender passive.
const FD: u8 = 4;
const FD_BRS: u8 = 1;
const FD_ESI: u8 = 2;
const EVENT: u8 = 8;

/// Data bytes that stand in their column; those of longer frames stand together elsewhere.
const INLINE: usize = 8;

/// The records of a trace.
#[derive(Default)]
pub struct Store {
    blocks: Vec<Block>,
    rows: usize,
    latest_ns: i64,
    is_unordered: bool,
    has_device_times: bool,
}

#[derive(Default)]
struct Block {
    times: Vec<i64>,
    device_times: DeviceTimes,
    ids: Vec<u32>,
    channels: Vec<u8>,
    kinds: Vec<u8>,
    /// The data bytes, the first one lowest; or where they are in `long`, or the event's place in `events`.
    data: Vec<u64>,
    long: Vec<u8>,
    events: Vec<TraceEvent>,
}

/// A row without its data, for loops over many.
#[derive(Clone, Copy)]
pub struct Key {
    /// As [`TraceRecord::channel`].
    pub channel: u8,
    /// The identifier; `None` if it is no frame.
    pub id: Option<Id>,
}

impl Store {
    /// How many records there are.
    pub const fn len(&self) -> usize {
        self.rows
    }

    /// Whether a record has an earlier time than one before it.
    pub const fn is_unordered(&self) -> bool {
        self.is_unordered
    }

    /// Whether a record has the device's own time.
    pub const fn has_device_times(&self) -> bool {
        self.has_device_times
    }

    /// Adds a record.
    pub fn push(&mut self, record: &TraceRecord) {
        if self.rows.is_multiple_of(BLOCK_ROWS) {
            self.blocks.push(Block::new());
        }
        self.is_unordered |= self.rows > 0 && record.time_ns < self.latest_ns;
        self.has_device_times |= record.device_ns.is_some();
        self.latest_ns = record.time_ns;
        self.rows += 1;
        if let Some(block) = self.blocks.last_mut() {
            block.push(record);
        }
    }

    /// Forgets the first blocks, as long as another one stays. Returns the number of rows in them.
    pub fn forget_blocks(&mut self, blocks: usize) -> usize {
        let blocks = blocks.min(self.blocks.len().saturating_sub(1));
        self.blocks.drain(..blocks);
        let rows = blocks * BLOCK_ROWS;
        self.rows -= rows;
        rows
    }

    fn block(&self, row: usize) -> Option<(&Block, usize)> {
        Some((self.blocks.get(row / BLOCK_ROWS)?, row % BLOCK_ROWS))
    }

    /// The time of a row in nanoseconds; that of the last one for rows that there are not.
    #[inline]
    pub fn time_ns(&self, row: usize) -> i64 {
        self.block(row).and_then(|(block, at)| block.times.get(at).copied()).unwrap_or(self.latest_ns)
    }

    /// When a row's record happened, by both clocks; of rows that there are not, as [`Self::time_ns`].
    #[inline]
    pub fn moment(&self, row: usize) -> Moment {
        match self.block(row) {
            Some((block, at)) if at < block.times.len() => block.moment(at),
            _ => Moment { time_ns: self.latest_ns, device_ns: None },
        }
    }

    /// How long after one row's record another one's was.
    #[inline]
    pub fn interval(&self, from: usize, to: usize) -> Interval {
        self.moment(to).interval_since(self.moment(from))
    }

    /// The first row at or after a time, if the records are in order.
    pub fn row_at(&self, time_ns: i64) -> usize {
        if self.is_unordered {
            return (0..self.rows).find(|row| self.time_ns(*row) >= time_ns).unwrap_or(self.rows);
        }
        let block =
            self.blocks.partition_point(|block| block.times.last().is_some_and(|last| *last < time_ns));
        let Some(found) = self.blocks.get(block) else { return self.rows };
        block * BLOCK_ROWS + found.times.partition_point(|time| *time < time_ns)
    }

    /// A record, exactly as it was added.
    pub fn record(&self, row: usize) -> Option<TraceRecord> {
        let (block, at) = self.block(row)?;
        block.record(at)
    }

    /// Calls `each` with the number, channel and identifier of the rows from `from` on.
    pub fn each_key(&self, from: usize, mut each: impl FnMut(usize, Key)) {
        for (number, block) in self.blocks.iter().enumerate().skip(from / BLOCK_ROWS) {
            let first = number * BLOCK_ROWS;
            for at in from.saturating_sub(first)..block.times.len() {
                let (id, kind) = (block.ids[at], block.kinds[at]);
                let id = (kind >> 4 != EVENT).then(|| unpack_id(id));
                each(first + at, Key { channel: block.channels[at], id });
            }
        }
    }

    /// The data bytes of a row's frame in `out`, and how many; `None` for what carries none. Frames of more than eight bytes are
    /// found by [`Self::record`].
    #[inline]
    pub fn short_data(&self, row: usize) -> Option<([u8; INLINE], usize)> {
        let (block, at) = self.block(row)?;
        let kind = *block.kinds.get(at)?;
        let len = match kind >> 4 {
            DATA => usize::from(kind & 15).min(INLINE),
            REMOTE | EVENT => return None,
            _ => usize::from(FD_LENGTHS[usize::from(kind & 15)]),
        };
        (len <= INLINE).then(|| (block.data[at].to_le_bytes(), len))
    }
}

fn unpack_id(packed: u32) -> Id {
    if packed & EXTENDED == 0 {
        Id::standard_truncated(packed & ID_BITS)
    } else {
        Id::extended_truncated(packed & ID_BITS)
    }
}

impl Block {
    fn new() -> Self {
        Self {
            times: Vec::with_capacity(BLOCK_ROWS),
            ids: Vec::with_capacity(BLOCK_ROWS),
            channels: Vec::with_capacity(BLOCK_ROWS),
            kinds: Vec::with_capacity(BLOCK_ROWS),
            data: Vec::with_capacity(BLOCK_ROWS),
            ..Self::default()
        }
    }

    fn push(&mut self, record: &TraceRecord) {
        self.device_times.push(self.times.len(), record.moment());
        self.times.push(record.time_ns);
        self.channels.push(record.channel);
        let (id, kind, data) = match &record.event {
            TraceEvent::Frame { frame, direction, late } => self.pack(frame, *direction, *late),
            event => {
                self.events.push(*event);
                (0, EVENT << 4, (self.events.len() - 1) as u64)
            }
        };
        self.ids.push(id);
        self.kinds.push(kind);
        self.data.push(data);
    }

    fn pack(&mut self, frame: &TraceFrame, direction: Direction, late: bool) -> (u32, u8, u64) {
        let id = frame.id();
        let flags = [(id.is_extended(), EXTENDED), (direction == Direction::Tx, SENT), (late, LATE)];
        let packed = flags.iter().filter(|(is, _)| *is).fold(id.raw(), |bits, (_, flag)| bits | flag);
        let kind = match frame {
            TraceFrame::Classic(frame) if frame.is_remote() => REMOTE,
            TraceFrame::Classic(_) => DATA,
            TraceFrame::Fd(frame) => {
                FD + if frame.brs() { FD_BRS } else { 0 } + if frame.esi() { FD_ESI } else { 0 }
            }
        };
        let bytes = frame.data();
        let data = if bytes.len() <= INLINE {
            let mut padded = [0; INLINE];
            padded[..bytes.len()].copy_from_slice(bytes);
            u64::from_le_bytes(padded)
        } else {
            self.long.extend_from_slice(bytes);
            (self.long.len() - bytes.len()) as u64
        };
        (packed, kind << 4 | frame.dlc() & 15, data)
    }

    fn moment(&self, at: usize) -> Moment {
        let time_ns = self.times[at];
        Moment { time_ns, device_ns: self.device_times.get(at, time_ns) }
    }

    fn record(&self, at: usize) -> Option<TraceRecord> {
        let (time_ns, channel) = (*self.times.get(at)?, self.channels[at]);
        let device_ns = self.device_times.get(at, time_ns);
        let (packed, kind, data) = (self.ids[at], self.kinds[at], self.data[at]);
        if kind >> 4 == EVENT {
            return Some(TraceRecord {
                time_ns,
                device_ns,
                channel,
                event: *self.events.get(data as usize)?,
            });
        }
        let id = unpack_id(packed);
        let frame = match kind >> 4 {
            DATA | REMOTE => {
                Frame::from_clean_parts(id, kind >> 4 == REMOTE, kind & 15, data.to_le_bytes()).into()
            }
            fd => {
                let len = usize::from(FD_LENGTHS[usize::from(kind & 15)]);
                let inline = data.to_le_bytes();
                let bytes = if len <= INLINE {
                    &inline[..len]
                } else {
                    self.long.get(data as usize..data as usize + len)?
                };
                FdFrame::new(id, fd & FD_BRS != 0, fd & FD_ESI != 0, bytes)?.into()
            }
        };
        let direction = if packed & SENT == 0 { Direction::Rx } else { Direction::Tx };
        let event = TraceEvent::Frame { frame, direction, late: packed & LATE != 0 };
        Some(TraceRecord { time_ns, device_ns, channel, event })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::testing::{record_or_fd, with_device_time};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_record_comes_out_as_it_went_in(records in prop::collection::vec(prop_oneof![record_or_fd(3), with_device_time(record_or_fd(3))], 1..60)) {
            let mut store = Store::default();
            for record in &records {
                store.push(record);
            }
            for (row, record) in records.iter().enumerate() {
                prop_assert_eq!(store.record(row), Some(*record));
                prop_assert_eq!(store.moment(row), record.moment());
                let short = record.frame().filter(|frame| !frame.is_remote() && frame.data_len() <= 8);
                let found = store.short_data(row);
                prop_assert_eq!(found.map(|(bytes, len)| bytes[..len].to_vec()), short.map(|frame| frame.data().to_vec()));
            }
            prop_assert_eq!(store.record(records.len()), None);
        }
    }

    #[test]
    fn a_time_is_found_over_blocks() {
        let mut store = Store::default();
        let event = TraceEvent::GAP;
        for n in 0..BLOCK_ROWS as i64 + 10 {
            store.push(&TraceRecord { time_ns: n * 10, device_ns: None, channel: 1, event });
        }
        for (time, row) in
            [(-5, 0), (0, 0), (1, 1), (655_360, 65_536), (655_361, 65_537), (9_999_999, 65_546)]
        {
            assert_eq!(store.row_at(time), row, "{time}");
        }
    }
}
