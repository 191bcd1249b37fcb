//! A curve's points. A picture needs only a limited number of them, so memory does not grow with the trace.

/// Maximum number of points in a [`Series`].
pub const MOST_POINTS: usize = 32_768;

/// Number of stretches to which a full series is reduced. Each keeps up to four points and a break.
const STRETCHES: usize = MOST_POINTS / 8;

/// A point of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Horizontal position, in seconds or the axis's unit.
    pub x: f64,
    /// Vertical position. Not-a-number where the curve is interrupted.
    pub y: f64,
}

/// Points in ascending horizontal order. If there are too many, each short stretch is reduced to its first,
/// lowest, highest and last point: at a picture's resolution the curve looks the same, peaks included.
#[derive(Clone, Debug, Default)]
pub struct Series {
    points: Vec<Point>,
}

impl Series {
    /// Appends a point. Non-finite values interrupt the curve.
    pub fn push(&mut self, x: f64, y: f64) {
        let point = Point { x, y: if y.is_finite() { y } else { f64::NAN } };
        if !x.is_finite() || (point.y.is_nan() && self.points.last().is_none_or(|last| last.y.is_nan())) {
            return;
        }
        // Three in a row at the same height need only the outer two.
        #[expect(clippy::float_cmp, reason = "only points of exactly the same height are left out")]
        if let [.., before, last] = self.points.as_mut_slice()
            && before.y == y
            && last.y == y
        {
            last.x = x;
            return;
        }
        self.points.push(point);
        if self.points.len() > MOST_POINTS {
            self.thin();
        }
    }

    /// Interrupts the curve after the last point: what came then is unknown.
    pub fn interrupt(&mut self) {
        if let Some(last) = self.points.last().copied() {
            self.push(last.x, f64::NAN);
        }
    }

    /// The points to draw.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// The last point that is not an interruption.
    pub fn last(&self) -> Option<Point> {
        self.points.iter().rev().find(|point| !point.y.is_nan()).copied()
    }

    fn thin(&mut self) {
        let (Some(first), Some(last)) = (self.points.first(), self.points.last()) else {
            return;
        };
        let (start, width) = (first.x, (last.x - first.x) / STRETCHES as f64);
        let stretch = |point: &Point| ((point.x - start) / width) as usize;
        let mut thinned = Vec::with_capacity(MOST_POINTS + 1);
        for points in self.points.chunk_by(|a, b| stretch(a) == stretch(b)) {
            keep_outline(points, &mut thinned);
        }
        // If all points are at one position there are no stretches; keep half of them.
        if thinned.len() > MOST_POINTS / 4 * 3 {
            thinned = thinned.chunks(2).map(|pair| pair[0]).collect();
        }
        self.points = thinned;
    }
}

/// Keeps a stretch's first, lowest, highest and last point in order, and an interruption.
fn keep_outline(points: &[Point], out: &mut Vec<Point>) {
    let values = || points.iter().enumerate().filter(|(_, point)| !point.y.is_nan());
    let by_y = |a: &(usize, &Point), b: &(usize, &Point)| a.1.y.total_cmp(&b.1.y);
    let mut kept = [
        values().next(),
        values().min_by(by_y),
        values().max_by(by_y),
        values().next_back(),
        points.iter().enumerate().rfind(|(_, point)| point.y.is_nan()),
    ]
    .map(|found| found.map(|(index, _)| index));
    kept.sort_unstable();
    let mut before = None;
    for index in kept.into_iter().flatten() {
        if before != Some(index) {
            out.push(points[index]);
        }
        before = Some(index);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_curve_keeps_every_point() {
        let mut series = Series::default();
        for n in 0..1000 {
            series.push(f64::from(n), f64::from(n * 7 % 13));
        }
        assert_eq!(series.points().len(), 1000);
    }

    #[test]
    fn a_constant_stretch_is_a_line_between_two_points() {
        let mut series = Series::default();
        for n in 0..1000 {
            series.push(f64::from(n), 5.0);
        }
        series.push(1000.0, 6.0);
        let points: Vec<_> = series.points().iter().map(|point| (point.x, point.y)).collect();
        assert_eq!(points, [(0.0, 5.0), (999.0, 5.0), (1000.0, 6.0)]);
    }

    #[test]
    fn a_long_curve_stays_bounded_and_keeps_its_peaks_and_ends() {
        let mut series = Series::default();
        for n in 0..1_000_000 {
            let peak = if n == 123_456 { 1000.0 } else { 0.0 };
            series.push(f64::from(n), f64::from(n % 100) + peak);
            assert!(series.points().len() <= MOST_POINTS);
        }
        assert!(series.points().len() > STRETCHES);
        assert_eq!(series.points()[0], Point { x: 0.0, y: 0.0 });
        assert_eq!(series.last(), Some(Point { x: 999_999.0, y: 99.0 }));
        assert!(series.points().iter().any(|point| point.y > 1000.0 && (point.x - 123_456.0).abs() < 0.5));
        assert!(series.points().is_sorted_by_key(|point| point.x));
    }

    #[test]
    fn interruptions_survive_thinning_and_do_not_pile_up() {
        let mut series = Series::default();
        series.interrupt();
        assert!(series.points().is_empty());
        for n in 0..100_000 {
            series.push(f64::from(n), f64::from(n % 3));
            if n == 50_000 {
                series.interrupt();
                series.interrupt();
            }
        }
        assert_eq!(series.points().iter().filter(|point| point.y.is_nan()).count(), 1);
    }

    #[test]
    fn a_hundred_thousand_points_at_one_place_stay_bounded() {
        let mut series = Series::default();
        for n in 0..100_000 {
            series.push(1.0, f64::from(n % 17));
        }
        assert!(series.points().len() <= MOST_POINTS);
    }
}
