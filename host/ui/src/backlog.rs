//! What was received last, in the order in which it came: each page takes from it at its own pace, and no page delays the capture. Its size
//! is bounded: the oldest goes first, and a page that had not taken it is given a loss in its place, with the number of frames on each channel.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::{Mutex, MutexGuard, PoisonError};

use cantap_trace::{LossStage, TraceEvent, TraceRecord, packed};

/// Most bytes of packed records: minutes of two saturated buses.
const MOST_BYTES: usize = 64 << 20;
/// Records are kept in segments of so many bytes, and the oldest one's memory is the next one's: whatever the size of chunks, which changes with the
/// computer's load, nothing is left in between that fits none of them.
const SEGMENT_BYTES: usize = 256 << 10;
/// What a chunk takes besides its records: its places in the ring, itself and the counts before it, each with what the allocator takes.
const CHUNK_BYTES: usize = 16 + (size_of::<Chunk>() + 16) + (2 * size_of::<(u8, u64)>() + 16);

/// Frames of each channel, by its number.
type Frames = Vec<(u8, u64)>;

/// See the module's description.
pub struct Backlog {
    state: Mutex<State>,
    most_bytes: usize,
}

#[derive(Default)]
struct State {
    /// Boxed: a ring grows to twice its size at once, and that is then little.
    chunks: VecDeque<Box<Chunk>>,
    segments: VecDeque<Vec<u8>>,
    /// The number of the first of them.
    first_segment: u64,
    /// An empty one, for the next.
    spare: Option<Vec<u8>>,
    /// What all this takes.
    bytes: usize,
    /// The number of records so far.
    next: u64,
    frames: Frames,
}

struct Chunk {
    first: u64,
    next: u64,
    /// Where its packed records are: the number of the segment, and the place in it.
    segment: u64,
    place: Range<usize>,
    first_ns: i64,
    /// Frames before it.
    before: Frames,
}

impl State {
    /// Adds packed records. Returns where they are.
    fn store(&mut self, packed: &[u8]) -> (u64, Range<usize>) {
        let has_room = |segment: &Vec<u8>| segment.len() + packed.len() <= SEGMENT_BYTES;
        if !self.segments.back().is_some_and(has_room) {
            let spare = self.spare.take().filter(|_| packed.len() <= SEGMENT_BYTES);
            let empty = spare.unwrap_or_else(|| Vec::with_capacity(packed.len().max(SEGMENT_BYTES)));
            self.bytes += empty.capacity();
            self.segments.push_back(empty);
        }
        let number = self.first_segment + self.segments.len() as u64 - 1;
        let Some(segment) = self.segments.back_mut() else { return (number, 0..0) };
        let from = segment.len();
        segment.extend_from_slice(packed);
        (number, from..segment.len())
    }

    /// The packed records of a chunk.
    fn packed(&self, chunk: &Chunk) -> &[u8] {
        let segment = self.segments.get((chunk.segment - self.first_segment) as usize);
        segment.and_then(|segment| segment.get(chunk.place.clone())).unwrap_or_default()
    }

    /// Forgets the oldest chunk, and the segments before the one that follows.
    fn forget_oldest(&mut self) {
        let Some(oldest) = self.chunks.pop_front() else { return };
        self.bytes -= CHUNK_BYTES;
        let needed = self.chunks.front().map_or(oldest.segment, |chunk| chunk.segment);
        while self.first_segment < needed
            && let Some(mut segment) = self.segments.pop_front()
        {
            self.first_segment += 1;
            self.bytes -= segment.capacity();
            // One that a large chunk has made larger is given back.
            segment.clear();
            self.spare = Some(segment).filter(|segment| segment.capacity() == SEGMENT_BYTES);
        }
    }
}

/// How far a page has taken.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Cursor {
    /// The number of the next record.
    pub next: u64,
    /// The frames before it; none if that is not known, as after a page has come back.
    frames: Option<Frames>,
}

impl Cursor {
    /// Where a page goes on that comes back.
    pub const fn at(next: u64) -> Self {
        Self { next, frames: None }
    }
}

/// What a page takes next.
#[derive(Debug, PartialEq, Eq)]
pub struct Taken {
    /// The number of the first record, which is later than the cursor's if some are gone.
    pub first: u64,
    /// The number of records that were received in all.
    pub latest: u64,
    /// Chunks of packed records, each behind its length in bytes (4, little-endian).
    pub chunks: Vec<u8>,
    /// Records that are gone.
    pub gone: u64,
}

impl Default for Backlog {
    fn default() -> Self {
        Self::with_bytes(MOST_BYTES)
    }
}

impl Backlog {
    /// With at most so many bytes.
    pub fn with_bytes(most_bytes: usize) -> Self {
        Self { state: Mutex::default(), most_bytes }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Every holder leaves it consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds what was received.
    pub fn push(&self, records: &[TraceRecord]) {
        let Some(first) = records.first() else { return };
        let mut packed = Vec::new();
        packed::write(records, &mut packed);
        let mut state = self.lock();
        let state = &mut *state;
        let before = state.frames.clone();
        for record in records.iter().filter(|record| record.frame().is_some()) {
            match state.frames.iter_mut().find(|(channel, _)| *channel == record.channel) {
                Some((_, count)) => *count += 1,
                None => state.frames.push((record.channel, 1)),
            }
        }
        let (segment, place) = state.store(&packed);
        let chunk = Chunk {
            first: state.next,
            next: state.next + records.len() as u64,
            segment,
            place,
            first_ns: first.time_ns,
            before,
        };
        state.next = chunk.next;
        state.bytes += CHUNK_BYTES;
        state.chunks.push_back(Box::new(chunk));
        while state.bytes > self.most_bytes && state.chunks.len() > 1 {
            state.forget_oldest();
        }
    }

    /// What comes after the cursor, in about `most_bytes`, and moves the cursor behind it; `None` if there is nothing.
    pub fn take(&self, cursor: &mut Cursor, most_bytes: usize) -> Option<Taken> {
        let state = self.lock();
        // Whoever comes back with a number of the future has it from elsewhere.
        let from = state.chunks.partition_point(|chunk| chunk.next <= cursor.next);
        let first = state.chunks.get(from)?;
        let gone = first.first.saturating_sub(cursor.next);
        let mut chunks = Vec::new();
        let mut add = |packed: &[u8]| {
            chunks.extend_from_slice(&(packed.len() as u32).to_le_bytes());
            chunks.extend_from_slice(packed);
        };
        if gone > 0 {
            let mut packed = Vec::new();
            packed::write(&losses(&first.before, cursor.frames.as_deref(), first.first_ns), &mut packed);
            add(&packed);
        }
        let (mut bytes, mut next) = (0, cursor.next);
        let mut frames = &state.frames;
        for chunk in state.chunks.range(from..) {
            let is_first = bytes == 0;
            bytes += chunk.place.len() + 4;
            if !is_first && bytes > most_bytes {
                frames = &chunk.before;
                break;
            }
            add(state.packed(chunk));
            next = chunk.next;
        }
        let taken = Taken { first: first.first, latest: state.next, chunks, gone };
        *cursor = Cursor { next, frames: Some(frames.clone()) };
        Some(taken)
    }
}

/// One loss for each channel of which frames are gone; how many, if that is known.
fn losses(before: &[(u8, u64)], seen: Option<&[(u8, u64)]>, time_ns: i64) -> Vec<TraceRecord> {
    let lost = |(channel, count): &(u8, u64)| {
        let count =
            seen.map(|seen| count - seen.iter().find(|(of, _)| of == channel).map_or(0, |(_, count)| *count));
        let count_of = |count: u64| u32::try_from(count).unwrap_or(u32::MAX);
        let event = match count {
            Some(0) => return None,
            Some(count) => {
                let at_least = count > u64::from(u32::MAX);
                TraceEvent::Lost { stage: Some(LossStage::Host), count: count_of(count), at_least }
            }
            None => TraceEvent::Lost { stage: Some(LossStage::Host), count: 0, at_least: true },
        };
        Some(TraceRecord { time_ns, device_ns: None, channel: *channel, event })
    };
    before.iter().filter_map(lost).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_trace::testing::data_record;

    fn records(taken: &Taken) -> Vec<TraceRecord> {
        let mut rest = &taken.chunks[..];
        let mut records = Vec::new();
        while let Some((len, after)) = rest.split_first_chunk::<4>() {
            let (chunk, after) = after.split_at(u32::from_le_bytes(*len) as usize);
            packed::read(chunk, |record| records.push(*record)).unwrap();
            rest = after;
        }
        records
    }

    fn on(channel: u8, time_ns: i64) -> TraceRecord {
        TraceRecord { channel, ..data_record(time_ns) }
    }

    #[test]
    fn every_page_gets_everything_in_pieces() {
        let backlog = Backlog::default();
        let all: Vec<_> = (0..1000).map(|n| on(1 + (n % 2) as u8, n)).collect();
        for piece in all.chunks(7) {
            backlog.push(piece);
        }
        for most in [1, 200, 1 << 20] {
            let mut cursor = Cursor::default();
            let mut got = Vec::new();
            while let Some(taken) = backlog.take(&mut cursor, most) {
                assert_eq!((taken.first, taken.gone, taken.latest), (got.len() as u64, 0, 1000));
                got.extend(records(&taken));
            }
            assert_eq!((got.len(), cursor.next), (1000, 1000));
            assert_eq!(got, all);
        }
        assert_eq!(backlog.take(&mut Cursor::at(5000), 100), None);
    }

    /// Their size changes with the computer's load: what was freed must fit what comes, or the memory grows.
    #[test]
    fn memory_does_not_depend_on_how_many_records_come_at_a_time() {
        const MOST: usize = 4 << 20;
        let backlog = Backlog::with_bytes(MOST);
        let mut time_ns = 0;
        for at_a_time in [40, 23, 12, 40, 1, 3000, 40, 30_000, 7] {
            for _ in 0..600_000 / at_a_time {
                let records: Vec<_> = (0..at_a_time).map(|n| on(1, time_ns + n)).collect();
                time_ns += at_a_time;
                backlog.push(&records);
            }
            let state = backlog.lock();
            let held: usize = state.segments.iter().chain(&state.spare).map(Vec::capacity).sum();
            let taken = held + state.chunks.len() * CHUNK_BYTES;
            assert!((MOST - 1_000_000..=MOST + SEGMENT_BYTES).contains(&taken), "{at_a_time}: {taken}");
        }
    }

    #[test]
    fn a_page_that_falls_behind_has_a_counted_loss_on_each_channel() {
        let backlog = Backlog::with_bytes(4 * (CHUNK_BYTES + 40));
        let mut slow = Cursor::default();
        backlog.push(&[on(1, 0), on(2, 1)]);
        assert_eq!(backlog.take(&mut slow, 1000).map(|taken| taken.gone), Some(0));
        for n in 0..100 {
            backlog.push(&[on(1, 10 * n), on(1, 10 * n + 1), on(2, 10 * n + 2)]);
        }
        let taken = backlog.take(&mut slow, usize::MAX).unwrap();
        let got = records(&taken);
        let lost: Vec<_> = got
            .iter()
            .filter_map(|record| match record.event {
                TraceEvent::Lost { stage: Some(LossStage::Host), count, at_least: false } => {
                    Some((record.channel, count))
                }
                _ => None,
            })
            .collect();
        let of = |channel| {
            got.iter().filter(|record| record.frame().is_some() && record.channel == channel).count() as u32
        };
        assert!(of(1) < 200 && of(2) > 0);
        assert_eq!(lost, [(1, 200 - of(1)), (2, 100 - of(2))]);
        assert_eq!(taken.gone, u64::from(300 - of(1) - of(2)));
        // One that comes back has not counted: it is told that frames are missing.
        let taken = backlog.take(&mut Cursor::at(2), usize::MAX).unwrap();
        let unknown = TraceEvent::Lost { stage: Some(LossStage::Host), count: 0, at_least: true };
        assert_eq!(records(&taken).iter().filter(|record| record.event == unknown).count(), 2);
    }
}
