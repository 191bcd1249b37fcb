//! Maps one trace's clock to the other's: straight pieces between points, each determined by many moments.

use super::chain::{Chain, MOST_DRIFT};
use super::sketch::Pair;

/// A piece of the map is at least this long and has at least [`PIECE_PAIRS`] moments: a crystal's rate is constant for a
/// second to 0.1 ppm or better, and the error of single stamps averages out.
const PIECE_NS: i64 = 1_000_000_000;
/// Number of moments in a piece.
const PIECE_PAIRS: usize = 32;
/// Moments farther from a piece's line than this many times the typical distance are left out.
const OUTLIER: f64 = 4.0;
/// How many times to leave out outliers.
const ROUNDS: usize = 3;

/// Maps the second trace's times to the first one's.
#[derive(Clone, Debug)]
pub struct ClockMap {
    knots: Vec<Knot>,
    /// How many times the clocks were set against each other while both recorded.
    steps: usize,
}

/// The middle of a piece: at `b_ns` the first clock showed `b_ns + ahead_ns + fraction_ns`.
#[derive(Clone, Copy, Debug)]
struct Knot {
    b_ns: i64,
    ahead_ns: i64,
    fraction_ns: f64,
    /// How much the first clock gains on the second, in nanoseconds per nanosecond.
    rate: f64,
    /// The chain it belongs to: between two chains, a clock was set.
    chain: usize,
}

impl ClockMap {
    pub(super) fn new(chains: &[Chain]) -> Self {
        let mut knots = Vec::new();
        for (number, chain) in chains.iter().enumerate() {
            knots.extend(pieces(&chain.pairs).into_iter().map(|piece| Knot::fit(piece, number)));
        }
        Self { knots, steps: chains.len().saturating_sub(1) }
    }

    /// A time of the second trace as a time of the first, in nanoseconds.
    pub fn to_first(&self, b_ns: i64) -> i64 {
        let after = self.knots.partition_point(|knot| knot.b_ns <= b_ns);
        let (before, after) = (after.checked_sub(1).map(|at| &self.knots[at]), self.knots.get(after));
        match (before, after) {
            (Some(before), Some(after)) if before.chain == after.chain => before.between(after, b_ns),
            // A clock was set somewhere between them: the nearer side is the better guess.
            (Some(before), Some(after)) => {
                if b_ns - before.b_ns <= after.b_ns - b_ns {
                    before.extend(b_ns)
                } else {
                    after.extend(b_ns)
                }
            }
            (Some(knot), None) | (None, Some(knot)) => knot.extend(b_ns),
            (None, None) => b_ns,
        }
    }

    /// How far the first clock is ahead of the second at the beginning of the common time, in nanoseconds.
    pub fn ahead_ns(&self) -> i64 {
        self.knots.first().map_or(0, |knot| knot.ahead_ns + knot.fraction_ns.round() as i64)
    }

    /// How much faster the first clock runs than the second, in parts per million, over the longest time without a step.
    pub fn drift_ppm(&self) -> f64 {
        let mut longest = (0, 0.0);
        for chain in self.knots.chunk_by(|one, next| one.chain == next.chain) {
            let (Some(first), Some(last)) = (chain.first(), chain.last()) else { continue };
            let span = last.b_ns - first.b_ns;
            let gained = (last.ahead_ns - first.ahead_ns) as f64 + last.fraction_ns - first.fraction_ns;
            let rate = if span > 0 { gained / span as f64 } else { first.rate };
            if span >= longest.0 {
                longest = (span, rate);
            }
        }
        longest.1 * 1e6
    }

    /// How often one of the clocks was set while both recorded.
    pub fn steps(&self) -> usize {
        self.steps
    }
}

/// Cuts a chain into pieces; what remains at the end belongs to the last one.
fn pieces(pairs: &[Pair]) -> Vec<&[Pair]> {
    let mut pieces = Vec::new();
    let mut begin = 0;
    for at in 0..pairs.len() {
        let (piece, rest) = (&pairs[begin..=at], &pairs[at + 1..]);
        if is_long(piece) && is_long(rest) {
            pieces.push(piece);
            begin = at + 1;
        }
    }
    pieces.push(&pairs[begin..]);
    pieces
}

fn is_long(piece: &[Pair]) -> bool {
    let (Some(first), Some(last)) = (piece.first(), piece.last()) else { return false };
    last.b_ns - first.b_ns >= PIECE_NS && piece.len() >= PIECE_PAIRS
}

impl Knot {
    /// The straight line through a piece's moments, excluding outliers.
    fn fit(pairs: &[Pair], chain: usize) -> Self {
        let (first, last) = (pairs[0], pairs[pairs.len() - 1]);
        let b_ns = first.b_ns + (last.b_ns - first.b_ns) / 2;
        let ahead_ns = first.a_ns - first.b_ns;
        // Small numbers, so that a float has all their digits.
        let mut points: Vec<(f64, f64)> = pairs
            .iter()
            .map(|pair| ((pair.b_ns - b_ns) as f64, (pair.a_ns - pair.b_ns - ahead_ns) as f64))
            .collect();
        let mut line = line(&points);
        for _ in 0..ROUNDS {
            let mut distances: Vec<f64> = points.iter().map(|point| line.distance(point)).collect();
            let middle = distances.len() / 2;
            let (_, typical, _) = distances.select_nth_unstable_by(middle, f64::total_cmp);
            let most = (*typical * OUTLIER).max(1.0);
            let before = points.len();
            points.retain(|point| line.distance(point) <= most);
            line = self::line(&points);
            if points.len() == before {
                break;
            }
        }
        Self { b_ns, ahead_ns, fraction_ns: line.at_zero, rate: line.slope, chain }
    }

    fn extend(&self, b_ns: i64) -> i64 {
        let gained = self.fraction_ns + (b_ns - self.b_ns) as f64 * self.rate;
        b_ns + self.ahead_ns + gained.round() as i64
    }

    fn between(&self, next: &Self, b_ns: i64) -> i64 {
        let part = (b_ns - self.b_ns) as f64 / (next.b_ns - self.b_ns) as f64;
        let difference = (next.ahead_ns - self.ahead_ns) as f64 + next.fraction_ns - self.fraction_ns;
        b_ns + self.ahead_ns + (self.fraction_ns + difference * part).round() as i64
    }
}

struct Line {
    at_zero: f64,
    slope: f64,
}

impl Line {
    fn distance(&self, (x, y): &(f64, f64)) -> f64 {
        (y - self.at_zero - self.slope * x).abs()
    }
}

/// Least squares. The slope is limited to [`MOST_DRIFT`], however little a short piece says.
fn line(points: &[(f64, f64)]) -> Line {
    let count = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0, y + point.1));
    let (x, y) = (x / count, y / count);
    let (xx, xy) = points.iter().fold((0.0, 0.0), |(xx, xy), point| {
        (xx + (point.0 - x) * (point.0 - x), xy + (point.0 - x) * (point.1 - y))
    });
    let slope = if xx > 0.0 { (xy / xx).clamp(-MOST_DRIFT, MOST_DRIFT) } else { 0.0 };
    Line { at_zero: y - slope * x, slope }
}
