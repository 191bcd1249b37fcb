//! Every value of a signal, for the graph: at full resolution, as far back as there is room.
//!
//! Values are kept in blocks with their extremes, so a screen column with a million values costs no more than examining a few
//! hundred.

use std::collections::VecDeque;
use std::sync::Arc;

/// Number of values in a block. To find extremes, at most the values of two blocks are examined, plus the extremes of those
/// between.
const BLOCK: usize = 256;
/// A late value, as with two devices, is sorted in up to this many blocks back; an older one means a restart, as where a
/// file is played again.
const LATE_BLOCKS: usize = 4;
/// Memory that a block takes, in bytes.
pub const BLOCK_BYTES: usize = BLOCK * size_of::<Point>() + size_of::<Block>();

/// A value and its time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Its time, in nanoseconds as in a record.
    pub time_ns: i64,
    /// Not-a-number if nothing is known from then on.
    pub value: f64,
}

impl Point {
    fn is_gap(self) -> bool {
        self.value.is_nan()
    }
}

/// The content of a stretch of time that is drawn as one column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Column {
    /// The smallest value.
    pub min: f64,
    /// The largest value.
    pub max: f64,
    /// The first value.
    pub first: Point,
    /// The last value.
    pub last: Point,
    /// Nothing is known about the time before the first value.
    pub after_gap: bool,
    /// Nothing is known about the time after the last value.
    pub before_gap: bool,
}

#[derive(Clone, Debug)]
struct Block {
    /// Sorted by time; never empty.
    points: Vec<Point>,
    min: f64,
    max: f64,
}

impl Block {
    fn new(point: Point) -> Self {
        let mut block =
            Self { points: Vec::with_capacity(BLOCK), min: f64::INFINITY, max: f64::NEG_INFINITY };
        block.insert(0, point);
        block
    }

    fn insert(&mut self, place: usize, point: Point) {
        self.points.insert(place, point);
        // Both ignore not-a-number.
        self.min = self.min.min(point.value);
        self.max = self.max.max(point.value);
    }

    fn first_ns(&self) -> i64 {
        self.points[0].time_ns
    }
}

/// The values of one signal.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Shared with the display while that is paused, so that pausing copies next to nothing.
    blocks: VecDeque<Arc<Block>>,
    /// Whether older values have been dropped.
    is_cut: bool,
}

impl Series {
    /// Takes a value, or not-a-number.
    pub fn push(&mut self, time_ns: i64, value: f64) {
        let point = Point { time_ns, value };
        let Some(last) = self.last() else {
            return self.append(point);
        };
        if time_ns >= last.time_ns {
            if !(point.is_gap() && last.is_gap()) {
                self.append(point);
            }
            return;
        }
        let late = self.blocks.iter_mut().rev().take(LATE_BLOCKS).find(|block| block.first_ns() <= time_ns);
        if let Some(block) = late {
            let place = block.points.partition_point(|other| other.time_ns <= time_ns);
            Arc::make_mut(block).insert(place, point);
        } else {
            // Time restarts: there is nothing to compare with.
            self.clear();
            self.append(point);
        }
    }

    fn append(&mut self, point: Point) {
        match self.blocks.back_mut().filter(|block| block.points.len() < BLOCK) {
            Some(block) => {
                let block = Arc::make_mut(block);
                block.insert(block.points.len(), point);
            }
            None => self.blocks.push_back(Arc::new(Block::new(point))),
        }
    }

    /// Nothing is known about the time from the last value to the next.
    pub fn interrupt(&mut self) {
        if let Some(last) = self.last() {
            self.push(last.time_ns, f64::NAN);
        }
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The number of blocks, each of [`BLOCK_BYTES`].
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// The number of values.
    pub fn len(&self) -> usize {
        self.blocks.iter().map(|block| block.points.len()).sum()
    }

    /// Drops the oldest block.
    pub fn cut(&mut self) {
        self.is_cut |= self.blocks.pop_front().is_some();
    }

    /// Whether older values have been dropped.
    pub const fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// The time of the oldest value.
    pub fn first_ns(&self) -> Option<i64> {
        self.blocks.front().map(|block| block.first_ns())
    }

    fn last(&self) -> Option<Point> {
        self.blocks.back().and_then(|block| block.points.last()).copied()
    }

    /// The position of the first point that is not older than a time: its block, and its index there.
    fn place(&self, time_ns: i64) -> (usize, usize) {
        // The last block that begins before that time, since it may also have later points.
        let block = self.blocks.partition_point(|block| block.first_ns() < time_ns).saturating_sub(1);
        let Some(points) = self.blocks.get(block).map(|block| &block.points) else {
            return (0, 0);
        };
        match points.partition_point(|point| point.time_ns < time_ns) {
            place if place == points.len() => (block + 1, 0),
            place => (block, place),
        }
    }

    /// The point before a position.
    fn before_place(&self, (block, place): (usize, usize)) -> Option<Point> {
        if place > 0 {
            return self.blocks.get(block)?.points.get(place - 1).copied();
        }
        self.blocks.get(block.checked_sub(1)?)?.points.last().copied()
    }

    /// The last value before a time; `None` if it is unknown then.
    pub fn before(&self, time_ns: i64) -> Option<Point> {
        self.before_place(self.place(time_ns)).filter(|point| !point.is_gap())
    }

    /// The first value from a time on; `None` if nothing is known until then.
    pub fn after(&self, time_ns: i64) -> Option<Point> {
        let (block, place) = self.place(time_ns);
        self.blocks.get(block)?.points.get(place).copied().filter(|point| !point.is_gap())
    }

    /// The signal's value at a time: the last one up to then.
    pub fn at(&self, time_ns: i64) -> Option<f64> {
        self.before(time_ns.saturating_add(1)).map(|point| point.value)
    }

    /// The content from one time until before another; `None` if there is no value.
    pub fn column(&self, from_ns: i64, until_ns: i64) -> Option<Column> {
        if until_ns <= from_ns {
            return None;
        }
        let (start, end) = (self.place(from_ns), self.place(until_ns));
        let mut found: Option<Column> = None;
        let mut gap = self.before_place(start).is_none_or(Point::is_gap);
        for index in start.0..=end.0 {
            let Some(block) = self.blocks.get(index) else { break };
            let low = if index == start.0 { start.1 } else { 0 };
            let high = if index == end.0 { end.1 } else { block.points.len() };
            let points = &block.points[low.min(high)..high];
            let Some(first) = points.iter().find(|point| !point.is_gap()) else {
                gap |= !points.is_empty();
                continue;
            };
            let last = points.iter().rev().find(|point| !point.is_gap()).unwrap_or(first);
            let (min, max) = if points.len() == block.points.len() {
                (block.min, block.max)
            } else {
                points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), point| {
                    (min.min(point.value), max.max(point.value))
                })
            };
            let after_gap = gap || points[0].is_gap();
            let column = found.get_or_insert(Column {
                min,
                max,
                first: *first,
                last: *last,
                after_gap,
                before_gap: false,
            });
            *column = Column { min: column.min.min(min), max: column.max.max(max), last: *last, ..*column };
            gap = points.last().is_some_and(|point| point.is_gap());
        }
        found.map(|column| Column { before_gap: gap, ..column })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: impl IntoIterator<Item = (i64, f64)>) -> Series {
        let mut series = Series::default();
        values.into_iter().for_each(|(time, value)| series.push(time, value));
        series
    }

    #[test]
    fn the_extremes_of_any_stretch_are_those_of_its_values() {
        let mut random = fastrand::Rng::with_seed(16);
        let values: Vec<(i64, f64)> = (0..5000).map(|n| (n * 7, random.f64() * 100.0)).collect();
        let series = of(values.iter().copied());
        assert_eq!((series.len(), series.blocks()), (5000, 5000_usize.div_ceil(BLOCK)));
        for _ in 0..2000 {
            let from = random.i64(-100..36_000);
            let until = from + random.i64(0..20_000);
            let inside: Vec<_> = values.iter().filter(|(time, _)| (from..until).contains(time)).collect();
            let column = series.column(from, until);
            assert_eq!(column.is_none(), inside.is_empty());
            if let Some(column) = column {
                let fold = |pick: fn(f64, f64) -> f64, start| {
                    inside.iter().fold(start, |so_far, (_, value)| pick(so_far, *value))
                };
                assert_eq!(
                    (column.min, column.max),
                    (fold(f64::min, f64::INFINITY), fold(f64::max, f64::NEG_INFINITY))
                );
                assert_eq!(
                    (column.first.time_ns, column.last.time_ns),
                    (inside[0].0, inside.last().unwrap().0)
                );
            }
            let before = values.iter().rev().find(|(time, _)| *time < from).map(|(time, _)| *time);
            assert_eq!(series.before(from).map(|point| point.time_ns), before);
            let after = values.iter().find(|(time, _)| *time >= from).map(|(time, _)| *time);
            assert_eq!(series.after(from).map(|point| point.time_ns), after);
        }
    }

    #[test]
    fn a_spike_of_one_value_in_a_million_is_there() {
        let series = of((0..1_000_000).map(|n| (n, if n == 765_432 { 9.0 } else { 1.0 })));
        let extremes = |from, until| series.column(from, until).map(|column| (column.min, column.max));
        assert_eq!(extremes(0, 1_000_000), Some((1.0, 9.0)));
        assert_eq!(extremes(765_432, 765_433), Some((9.0, 9.0)));
        assert_eq!(extremes(0, 765_432), Some((1.0, 1.0)));
    }

    #[test]
    fn where_nothing_is_known_there_is_no_value_before_or_after() {
        let mut series = of([(10, 1.0), (20, 2.0)]);
        series.interrupt();
        series.interrupt();
        series.push(50, 5.0);
        assert_eq!(
            (series.at(15), series.at(20), series.at(49), series.at(50)),
            (Some(1.0), None, None, Some(5.0))
        );
        assert_eq!((series.before(40), series.after(15).map(|point| point.value)), (None, Some(2.0)));
        let column = series.column(0, 30).unwrap();
        assert_eq!((column.after_gap, column.before_gap, column.max), (true, true, 2.0));
        assert_eq!(series.column(30, 50), None);
        assert!(series.column(30, 60).unwrap().after_gap);
    }

    #[test]
    fn what_comes_late_finds_its_place_and_a_new_beginning_forgets() {
        let mut series = of([(10, 1.0), (30, 3.0), (20, 2.0)]);
        assert_eq!((series.at(25), series.at(35)), (Some(2.0), Some(3.0)));
        series.push(5, 0.5);
        assert_eq!((series.len(), series.first_ns()), (1, Some(5)));
    }

    #[test]
    fn a_copy_shares_the_blocks_and_what_was_cut_is_told() {
        let mut series = of((0..1000).map(|n| (n, n as f64)));
        let copy = series.clone();
        series.push(1000, 0.0);
        assert_eq!((copy.len(), series.len()), (1000, 1001));
        assert!(Arc::ptr_eq(&copy.blocks[0], &series.blocks[0]));
        assert!(!series.is_cut());
        series.cut();
        assert!(series.is_cut() && series.first_ns() == Some(BLOCK as i64));
        assert_eq!(copy.first_ns(), Some(0));
    }
}
