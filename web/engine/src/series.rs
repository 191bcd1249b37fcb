//! A signal over time, at any zoom: no value is lost.
//!
//! The values of a signal are decoded once and summed up in blocks, and blocks of blocks: the first, smallest, largest and last value.
//! A picture is put together from the largest blocks that are finer than its columns, and from decoded values at its edges and where
//! blocks would be too coarse.

use cantap_signals::{Database, Decoder, Message, MessageRef, Source};
use cantap_trace::TraceEvent;

use crate::store::Store;

/// Values of a block of the lowest level.
const BLOCK: usize = 64;
/// Blocks of a block of the next level.
const FAN: usize = 8;
/// Blocks for each column of a picture, at least: the more, the less a column's edges are shifted.
const BLOCKS_PER_COLUMN: usize = 2;
/// Rows that are decoded together.
const ROWS: usize = 512;

/// A stretch of values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// The time of the first, in nanoseconds.
    pub from_ns: i64,
    /// The time of the last, in nanoseconds.
    pub to_ns: i64,
    /// The first value.
    pub first: f64,
    /// The smallest one.
    pub min: f64,
    /// The largest one.
    pub max: f64,
    /// The last one.
    pub last: f64,
}

impl Block {
    /// A single value.
    pub const fn of(time_ns: i64, value: f64) -> Self {
        Self { from_ns: time_ns, to_ns: time_ns, first: value, min: value, max: value, last: value }
    }

    /// Adds what follows.
    pub fn add(&mut self, later: &Self) {
        self.to_ns = later.to_ns;
        self.min = self.min.min(later.min);
        self.max = self.max.max(later.max);
        self.last = later.last;
    }

    /// Whether it is a single value.
    pub fn is_one(&self) -> bool {
        self.from_ns == self.to_ns && self.min.total_cmp(&self.max).is_eq()
    }
}

/// The values of one signal of one identifier, summed up.
pub struct Series {
    decoder: Decoder,
    message: MessageRef,
    /// `levels[0]` are blocks of values, each next one of [`FAN`] blocks of the one before. The last block of each may be incomplete.
    levels: Vec<Vec<Block>>,
    /// For each block of the lowest level, the place in the identifier's list of the row of its first value.
    places: Vec<u32>,
    values: usize,
    /// How many rows of the list have been decoded.
    scanned: usize,
}

/// What a picture shows.
pub struct Picture {
    /// Its columns, in order.
    pub columns: Vec<Block>,
    /// Values behind them.
    pub values: usize,
    /// Whether each is one value.
    pub exact: bool,
}

impl Picture {
    /// Of nothing.
    pub const EMPTY: Self = Self { columns: Vec::new(), values: 0, exact: true };
}

impl Series {
    /// Of a signal, by its index in a message.
    pub fn new(message: Message, signal: usize) -> Option<Self> {
        let database = Database { messages: vec![message], ..Database::default() };
        let mut decoder = Decoder::new(vec![Source { channel: None, database }]);
        let (message, ..) = decoder.messages().next()?;
        decoder.retain(|_, index, _| index == signal);
        Some(Self { decoder, message, levels: vec![Vec::new()], places: Vec::new(), values: 0, scanned: 0 })
    }

    /// Calls `each` with place in the list, time and value of everything in these rows.
    fn decode(&self, store: &Store, rows: &[u32], first: usize, mut each: impl FnMut(usize, i64, f64)) {
        let mut columns = self.decoder.rows(self.message);
        let mut one = Vec::new();
        for (number, chunk) in rows.chunks(ROWS).enumerate() {
            let base = first + number * ROWS;
            let mut waiting: Vec<usize> = Vec::with_capacity(chunk.len());
            let mut values: Vec<(usize, f64)> = Vec::with_capacity(chunk.len());
            for (at, row) in chunk.iter().enumerate() {
                let row = *row as usize;
                match store.short_data(row) {
                    Some((data, len)) if columns.push(&data[..len]) => waiting.push(at),
                    // Long ones, those with contained PDUs, and remote frames, which have no data.
                    _ => {
                        let record = store.record(row);
                        let frame = record.as_ref().and_then(|record| match &record.event {
                            TraceEvent::Frame { frame, .. } if !frame.is_remote() => Some(frame),
                            _ => None,
                        });
                        if let Some(frame) = frame {
                            one.clear();
                            columns.one(frame.data(), &mut one);
                            values.extend(one.iter().map(|value| (at, value.value)));
                        }
                    }
                }
            }
            columns.decode(|_, found| {
                let present = |at: &usize| found.there.is_none_or(|there| there[*at]);
                values
                    .extend((0..found.value.len()).filter(present).map(|at| (waiting[at], found.value[at])));
            });
            if waiting.len() < chunk.len() {
                values.sort_by_key(|(at, _)| *at);
            }
            for (at, value) in values.into_iter().filter(|(_, value)| !value.is_nan()) {
                each(base + at, store.time_ns(chunk[at] as usize), value);
            }
        }
    }

    /// Takes the rows of the list that are new.
    pub fn extend(&mut self, store: &Store, rows: &[u32]) {
        if self.scanned == rows.len() {
            return;
        }
        // An incomplete block is made anew.
        let begun = self.values / BLOCK;
        if !self.values.is_multiple_of(BLOCK) {
            self.scanned = self.places[begun] as usize;
            self.places.truncate(begun);
            self.levels[0].truncate(begun);
            self.values = begun * BLOCK;
        }
        let (mut blocks, mut places, mut values) = (Vec::new(), Vec::new(), self.values);
        self.decode(store, &rows[self.scanned..], self.scanned, |place, time_ns, value| {
            let new = Block::of(time_ns, value);
            match blocks.last_mut() {
                Some(block) if values % BLOCK > 0 => Block::add(block, &new),
                _ => {
                    blocks.push(new);
                    places.push(place as u32);
                }
            }
            values += 1;
        });
        self.levels[0].extend(blocks);
        self.places.extend(places);
        self.values = values;
        self.scanned = rows.len();
        self.sum_up(begun);
    }

    /// Makes the higher levels anew from a block of the lowest one on.
    fn sum_up(&mut self, from: usize) {
        let (mut level, mut from) = (0, from);
        while self.levels[level].len() > 1 {
            if level + 1 == self.levels.len() {
                self.levels.push(Vec::new());
                from = 0;
            }
            from /= FAN;
            let (below, above) = self.levels.split_at_mut(level + 1);
            let (below, above) = (&below[level], &mut above[0]);
            above.truncate(from);
            above.extend(below[from * FAN..].chunks(FAN).map(sum));
            level += 1;
        }
        self.levels.truncate(level + 1);
    }

    /// The values of the time from `from_ns` to `to_ns` in at most `columns` columns, with the last one before and the first one after it.
    pub fn picture(&self, store: &Store, rows: &[u32], from_ns: i64, to_ns: i64, columns: usize) -> Picture {
        let columns = columns.max(1);
        let rows = &rows[..self.scanned];
        let lowest = &self.levels[0];
        // The blocks that may have values of the window; the first may also have the one before it.
        let first = lowest.partition_point(|block| block.to_ns < from_ns);
        let end = lowest.partition_point(|block| block.from_ns <= to_ns).max(first);
        let before = self.edge(store, rows, first, |time_ns| time_ns < from_ns, true);
        let after =
            self.edge(store, rows, end.saturating_sub(1).max(first), |time_ns| time_ns > to_ns, false);
        let mut parts: Vec<Block> = Vec::new();
        let mut values = 0;
        let mut decode = |from: usize, to: usize, parts: &mut Vec<Block>| {
            self.decode_blocks(store, rows, from, to, |time_ns, value| {
                if (from_ns..=to_ns).contains(&time_ns) {
                    parts.push(Block::of(time_ns, value));
                    values += 1;
                }
            });
        };
        // Whole blocks suffice if there are enough of them for the picture.
        let inner = (first + 1).min(end)..end.saturating_sub(1).max((first + 1).min(end));
        if inner.len() < columns * BLOCKS_PER_COLUMN {
            decode(first, end, &mut parts);
        } else {
            decode(first, inner.start, &mut parts);
            self.cover(inner.clone(), columns, &mut parts);
            decode(inner.end, end, &mut parts);
            values += inner.len() * BLOCK;
        }
        let exact_values = parts.len() == values;
        let mut merged = merge(&parts, columns);
        let exact = exact_values && merged.len() == parts.len() && merged.iter().all(Block::is_one);
        let mut columns = Vec::with_capacity(merged.len() + 2);
        columns.extend(before);
        columns.append(&mut merged);
        columns.extend(after);
        Picture { columns, values, exact }
    }

    /// The value just outside the window, which is in this block or in the neighbouring one.
    fn edge(
        &self,
        store: &Store,
        rows: &[u32],
        block: usize,
        is_outside: impl Fn(i64) -> bool,
        is_before: bool,
    ) -> Option<Block> {
        let blocks = if is_before { block.saturating_sub(1)..block + 1 } else { block..block + 2 };
        let mut found = None;
        let end = blocks.end.min(self.levels[0].len());
        self.decode_blocks(store, rows, blocks.start.min(end), end, |time_ns, value| {
            if is_outside(time_ns) && (is_before || found.is_none()) {
                found = Some(Block::of(time_ns, value));
            }
        });
        found
    }

    /// Calls `each` with the times and values for which `is_beyond` is true. It must be true from some value on, upwards or downwards: a block
    /// whose extremes are not is not decoded.
    pub fn values_beyond(
        &self,
        store: &Store,
        rows: &[u32],
        is_beyond: impl Fn(f64) -> bool,
        mut each: impl FnMut(i64, f64),
    ) {
        for (number, block) in self.levels[0].iter().enumerate() {
            if is_beyond(block.min) || is_beyond(block.max) {
                self.decode_blocks(store, &rows[..self.scanned], number, number + 1, |time_ns, value| {
                    if is_beyond(value) {
                        each(time_ns, value);
                    }
                });
            }
        }
    }

    /// Decodes the values of some blocks of the lowest level.
    fn decode_blocks(
        &self,
        store: &Store,
        rows: &[u32],
        from: usize,
        to: usize,
        mut each: impl FnMut(i64, f64),
    ) {
        if from >= to {
            return;
        }
        let begin = self.places[from] as usize;
        let end = self.places.get(to).map_or(rows.len(), |place| *place as usize);
        self.decode(store, &rows[begin..end], begin, |_, time_ns, value| each(time_ns, value));
    }

    /// Adds blocks for these blocks of the lowest level: as large ones as leave enough for each column.
    fn cover(&self, blocks: std::ops::Range<usize>, columns: usize, parts: &mut Vec<Block>) {
        let (mut level, mut size) = (0, 1);
        while level + 1 < self.levels.len() && blocks.len() / (size * FAN) >= columns * BLOCKS_PER_COLUMN {
            (level, size) = (level + 1, size * FAN);
        }
        let mut at = blocks.start;
        while at < blocks.end {
            // The largest block that begins here and ends in the range.
            let (mut of, mut step) = (level, size);
            while of > 0 && (!at.is_multiple_of(step) || at + step > blocks.end) {
                (of, step) = (of - 1, step / FAN);
            }
            parts.push(self.levels[of][at / step]);
            at += step;
        }
    }
}

fn sum(blocks: &[Block]) -> Block {
    let mut sum = blocks[0];
    blocks[1..].iter().for_each(|block| sum.add(block));
    sum
}

/// Joins neighbours until there are no more than `columns`, in equal stretches of time.
pub fn merge(parts: &[Block], columns: usize) -> Vec<Block> {
    let (Some(first), Some(last)) = (parts.first(), parts.last()) else { return Vec::new() };
    if parts.len() <= columns {
        return parts.to_vec();
    }
    let begin = first.from_ns;
    let span = (last.to_ns.saturating_sub(begin)).max(1) as f64;
    let column = |block: &Block| {
        let part = block.from_ns.saturating_sub(begin) as f64 / span;
        ((part * columns as f64) as usize).min(columns - 1)
    };
    let mut merged: Vec<(usize, Block)> = Vec::with_capacity(columns);
    for part in parts {
        let of = column(part);
        match merged.last_mut() {
            // Where the clock was set back, it stays in the column that it came to.
            Some((known, block)) if *known >= of => block.add(part),
            _ => merged.push((of, *part)),
        }
    }
    merged.into_iter().map(|(_, block)| block).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_signals::Signal;
    use cantap_trace::{Direction, Frame, Id, TraceRecord};

    fn trace(frames: usize) -> (Store, Vec<u32>) {
        let mut store = Store::default();
        let mut random = fastrand::Rng::with_seed(5);
        for n in 0..frames {
            // Multiplexed: the signal is in three of four frames.
            let value = random.u16(..).to_le_bytes();
            let frame =
                Frame::data_frame(Id::standard(0x123).unwrap(), &[n as u8 % 4, value[0], value[1]]).unwrap();
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            store.push(&TraceRecord {
                time_ns: n as i64 * 1000 + random.i64(0..900),
                device_ns: None,
                channel: 1,
                event,
            });
        }
        (store, (0..frames as u32).collect())
    }

    fn series() -> Series {
        let switch = Signal { is_switch: true, ..Signal::new("Switch", 0, 8) };
        let multiplexed = cantap_signals::Multiplexed { switch: 0, values: vec![0..=2] };
        let signal = Signal { multiplexed: Some(multiplexed), ..Signal::new("Value", 8, 16) };
        let message = Message {
            id: Id::standard(0x123).unwrap(),
            name: "M".to_owned(),
            description: String::new(),
            length: 8,
            cycle_ms: None,
            j1939: false,
            container: None,
            signals: vec![switch, signal],
            line: 0,
        };
        Series::new(message, 1).unwrap()
    }

    fn values(store: &Store) -> Vec<(i64, f64)> {
        (0..store.len())
            .map(|row| (store.time_ns(row), store.short_data(row).unwrap().0))
            .filter(|(_, data)| data[0] < 3)
            .map(|(time, data)| (time, f64::from(u16::from_le_bytes([data[1], data[2]]))))
            .collect()
    }

    /// At every zoom, the extremes, the first and the last value are those of all values, and each value is in one column.
    #[test]
    fn no_value_is_lost_at_any_zoom() {
        let (store, rows) = trace(60_000);
        let mut series = series();
        series.extend(&store, &rows);
        let all = values(&store);
        assert_eq!(series.values, all.len());
        let mut random = fastrand::Rng::with_seed(6);
        for _ in 0..300 {
            let (a, b) = (random.i64(-5_000..60_005_000), random.i64(-5_000..60_005_000));
            let span = if random.bool() { (a.min(b), a.max(b)) } else { (a, a + random.i64(0..300_000)) };
            let columns = random.usize(1..900);
            let picture = series.picture(&store, &rows, span.0, span.1, columns);
            let inside: Vec<_> = all.iter().filter(|(time, _)| (span.0..=span.1).contains(time)).collect();
            let shown: Vec<_> = picture
                .columns
                .iter()
                .filter(|block| block.from_ns >= span.0 && block.to_ns <= span.1)
                .collect();
            assert_eq!(picture.values, inside.len(), "{span:?} {columns}");
            assert!(shown.len() <= columns);
            let largest = |values: &mut dyn Iterator<Item = f64>| values.max_by(f64::total_cmp);
            let smallest = |values: &mut dyn Iterator<Item = f64>| values.min_by(f64::total_cmp);
            let mut values = inside.iter().map(|(_, value)| *value);
            assert_eq!(largest(&mut shown.iter().map(|block| block.max)), largest(&mut values.clone()));
            assert_eq!(smallest(&mut shown.iter().map(|block| block.min)), smallest(&mut values));
            assert_eq!(
                shown.first().map(|block| (block.from_ns, block.first)),
                inside.first().map(|first| **first)
            );
            assert_eq!(shown.last().map(|block| (block.to_ns, block.last)), inside.last().map(|last| **last));
            assert!(shown.windows(2).all(|pair| pair[0].to_ns < pair[1].from_ns));
            // The neighbours.
            let before = all.iter().rfind(|(time, _)| *time < span.0);
            let after = all.iter().find(|(time, _)| *time > span.1);
            let found = picture.columns.iter().find(|block| block.to_ns < span.0);
            assert_eq!(found.map(|block| (block.to_ns, block.last)), before.copied(), "{span:?}");
            let found = picture.columns.iter().find(|block| block.from_ns > span.1);
            assert_eq!(found.map(|block| (block.from_ns, block.first)), after.copied(), "{span:?}");
            assert_eq!(picture.exact, inside.len() <= columns, "{} {columns}", inside.len());
        }
    }

    #[test]
    fn a_growing_trace_gives_the_same_as_a_whole_one() {
        let (store, rows) = trace(30_000);
        let mut grown = series();
        for end in [0, 1, 50, 51, 700, 9_999, 10_000, 29_999, 30_000] {
            grown.extend(&store, &rows[..end]);
        }
        let mut whole = series();
        whole.extend(&store, &rows);
        assert_eq!(grown.levels, whole.levels);
        assert_eq!(grown.places, whole.places);
    }
}
