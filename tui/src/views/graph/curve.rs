//! One curve, dot by dot: each column of dots extends from the smallest to the largest value in it.

use ratatui::style::Color;
use ratatui::widgets::canvas::{Painter, Shape};

use super::super::super::model::{Column, Point, Series};

/// A stretch of time in columns of equal length.
#[derive(Clone, Copy, Debug)]
pub struct Time {
    /// Its beginning, in nanoseconds as in a record.
    pub from_ns: i64,
    /// Its length, in nanoseconds.
    pub span_ns: i64,
    /// Number of columns.
    pub columns: usize,
}

impl Time {
    /// The beginning of a column; for the one after the last, the end.
    fn start(&self, column: usize) -> i64 {
        let ahead = i128::from(self.span_ns) * column as i128 / self.columns.max(1) as i128;
        self.from_ns.saturating_add(ahead as i64)
    }

    /// The column of a time, as a number with a fraction; also outside the stretch.
    fn column(&self, time_ns: i64) -> f64 {
        (time_ns as f64 - self.from_ns as f64) / self.span_ns.max(1) as f64 * self.columns as f64
    }

    /// The column of a time, if it is one of these; the end belongs to the last.
    pub fn place(&self, time_ns: i64) -> Option<usize> {
        let ahead = i128::from(time_ns) - i128::from(self.from_ns);
        let is_in = (0..=i128::from(self.span_ns)).contains(&ahead) && self.columns > 0;
        let place = ahead * self.columns as i128 / i128::from(self.span_ns.max(1));
        is_in.then(|| (place as usize).min(self.columns - 1))
    }
}

/// A signal's course in a stretch of time.
pub struct Trail {
    time: Time,
    /// The content of each column.
    columns: Vec<Option<Column>>,
    before: Option<Point>,
    after: Option<Point>,
}

impl Trail {
    /// Evaluates a signal's values.
    pub fn new(series: &Series, time: Time) -> Self {
        // The end itself belongs to the last column, where the newest value is.
        let end = |column| time.start(column + 1).saturating_add(i64::from(column + 1 == time.columns));
        let columns = (0..time.columns).map(|column| series.column(time.start(column), end(column)));
        let until = time.start(time.columns).saturating_add(1);
        Self {
            columns: columns.collect(),
            before: series.before(time.from_ns),
            after: series.after(until),
            time,
        }
    }

    /// The content of each column.
    pub fn columns(&self) -> &[Option<Column>] {
        &self.columns
    }

    /// The value at the beginning, if there was one before.
    pub fn before(&self) -> Option<f64> {
        self.before.map(|point| point.value)
    }

    /// Whether a value before or after the stretch continues its content.
    pub const fn goes_on(&self) -> bool {
        self.after.is_some()
    }

    /// The smallest and the largest visible value, including one held from before or, with lines, one that
    /// leads out.
    pub fn extremes(&self, lines: bool) -> Option<(f64, f64)> {
        let mut inside = self.columns.iter().flatten();
        let held = self.before.filter(|_| inside.clone().next().is_none_or(|first| !first.after_gap));
        let led_to = self.after.filter(|_| lines);
        let outside = held.into_iter().chain(led_to).map(|point| (point.value, point.value));
        let inside = inside.by_ref().map(|column| (column.min, column.max));
        inside.chain(outside).reduce(|(low, high), (min, max)| (low.min(min), high.max(max)))
    }
}

/// A curve to be drawn.
pub struct Curve<'a> {
    /// The signal's course.
    pub trail: &'a Trail,
    /// The values at the lower and upper edge.
    pub range: [f64; 2],
    /// Number of rows of dots.
    pub rows: usize,
    /// Its colour.
    pub colour: Color,
    /// Straight lines between values instead of steps.
    pub lines: bool,
}

impl Curve<'_> {
    fn row(&self, value: f64) -> usize {
        let [low, high] = self.range;
        let share = ((high - value) / (high - low)).clamp(0.0, 1.0);
        (share * (self.rows.saturating_sub(1)) as f64).round() as usize
    }

    fn upright(&self, painter: &mut Painter<'_, '_>, column: usize, from: f64, to: f64) {
        let (top, bottom) = (self.row(from.max(to)), self.row(from.min(to)));
        (top..=bottom).for_each(|row| painter.paint(column, row, self.colour));
    }

    /// Joins one value to the next, whose columns may lie outside.
    fn join(&self, painter: &mut Painter<'_, '_>, from: Point, to: Point) {
        let time = &self.trail.time;
        let (start, end) = (time.column(from.time_ns), time.column(to.time_ns));
        let last = time.columns.saturating_sub(1);
        let first_dot = start.floor().max(0.0) as usize;
        let last_dot = (end.floor().max(0.0) as usize).min(last);
        if self.lines {
            let at = |column: f64| {
                let share =
                    if end > start { ((column - start) / (end - start)).clamp(0.0, 1.0) } else { 1.0 };
                from.value + (to.value - from.value) * share
            };
            for dot in first_dot..=last_dot {
                self.upright(painter, dot, at(dot as f64), at((dot + 1) as f64));
            }
            return;
        }
        for dot in first_dot..=last_dot {
            self.upright(painter, dot, from.value, from.value);
        }
        self.upright(painter, last_dot, from.value, to.value);
    }
}

impl Shape for Curve<'_> {
    fn draw(&self, painter: &mut Painter<'_, '_>) {
        let Trail { columns, before, after, .. } = self.trail;
        let mut from = *before;
        for (place, column) in columns.iter().enumerate() {
            let Some(column) = column else { continue };
            if let Some(from) = from.filter(|_| !column.after_gap) {
                self.join(painter, from, column.first);
            }
            self.upright(painter, place, column.min, column.max);
            from = (!column.before_gap).then_some(column.last);
        }
        if let (Some(from), Some(to)) = (from, after) {
            // Up to the edge; if nothing comes after it, the curve ends with its last value.
            let to = if self.lines { *to } else { Point { value: from.value, ..*to } };
            self.join(painter, from, to);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_in_exactly_one_column() {
        let mut series = Series::default();
        (0..=1000).for_each(|n| series.push(n, n as f64));
        for columns in [1, 7, 100, 640] {
            let trail = Trail::new(&series, Time { from_ns: 100, span_ns: 800, columns });
            let found: Vec<_> = trail.columns().iter().flatten().collect();
            assert_eq!((found[0].min, found.last().unwrap().max), (100.0, 900.0));
            assert!(found.windows(2).all(|pair| (pair[1].min - pair[0].max - 1.0).abs() < 1e-9), "{columns}");
            assert_eq!((trail.before(), trail.goes_on()), (Some(99.0), true));
        }
        let time = Time { from_ns: 0, span_ns: 100, columns: 10 };
        assert_eq!(
            [-1, 0, 9, 10, 100, 101].map(|at| time.place(at)),
            [None, Some(0), Some(0), Some(1), Some(9), None]
        );
    }
}
