//! Finds UTC from round trips: a line through gates.
//!
//! A device read its clock somewhere between question and answer. So each round trip is a gate through which the true line (UTC over the
//! device's time) passed: no earlier than the question and no later than the answer. Nothing is assumed about where in the gate. Of the
//! lines that pass all gates, the one that keeps farthest from the gate posts is taken; quick round trips are narrow gates and decide the
//! result, slow ones do no harm. The spread of the other lines is the uncertainty.
//!
//! If answers always take longer than questions, the middle is off by half of the difference, and nothing on this side can
//! detect it.

/// Rates are searched in this range, as a fraction: a device outside it does not run in real time.
const MOST_RATE: f64 = 1e-3;
/// What is known of a rate before anything was measured: crystals are off by tens of parts per million.
const PRIOR_RATE: f64 = 30e-6;
/// Each step keeps two thirds of [`MOST_RATE`]: after this many, nothing that matters is left, (2/3)⁵⁰.
const STEPS: usize = 50;

/// A round trip, relative to the present.
#[expect(clippy::struct_field_names, reason = "units")]
#[derive(Clone, Copy, Debug)]
pub struct Gate {
    /// When the device read its clock, on the ruler: nanoseconds after the present, so negative.
    pub at_ns: f64,
    /// UTC of the question, minus `at_ns` and the reference value for the present.
    pub asked_ns: f64,
    /// UTC of the answer, minus the same.
    pub answered_ns: f64,
}

/// The line, at the present.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// UTC minus the reference value for the present.
    pub now_ns: f64,
    /// UTC per ruler time, minus one.
    pub rate: f64,
    /// The lowest and the highest value at the present of any line that passes.
    pub range_ns: (f64, f64),
    /// How far other rates that pass may be from `rate`.
    pub rate_doubt: f64,
}

/// The line through the gates. Each gate's posts are moved apart by `wander` times its age, because neither clock
/// keeps its rate for ever. `None` if no line passes them all.
pub fn line(gates: &[Gate], wander: f64) -> Option<Line> {
    // The lowest and the highest value at the present of lines with this rate.
    let passage = |rate: f64| {
        let start = (f64::NEG_INFINITY, f64::INFINITY);
        gates.iter().fold(start, |(low, high): (f64, f64), gate| {
            let slack = wander * gate.at_ns.abs();
            let rise = rate * gate.at_ns;
            (low.max(gate.asked_ns - slack - rise), high.min(gate.answered_ns + slack - rise))
        })
    };
    let width = |rate: f64| {
        let (low, high) = passage(rate);
        high - low
    };
    let best = peak(-MOST_RATE, MOST_RATE, width);
    if gates.is_empty() || width(best) < 0.0 {
        return None;
    }
    let slowest = edge(best, -MOST_RATE, |rate| width(rate) >= 0.0);
    let fastest = edge(best, MOST_RATE, |rate| width(rate) >= 0.0);
    // A few gates close to one another allow nearly any rate: then the usual error of crystals, around zero, counts for more, as far
    // as it passes. The rates that pass cover about four standard deviations.
    let usual = 0.0_f64.clamp(slowest, fastest);
    let spread = (fastest - slowest) / 4.0;
    let weight = PRIOR_RATE * PRIOR_RATE / (PRIOR_RATE * PRIOR_RATE + spread * spread);
    let rate = usual + (best - usual) * weight;
    let (low, high) = passage(rate);
    let highest = passage(peak(slowest, fastest, |rate| passage(rate).1)).1;
    let lowest = passage(peak(slowest, fastest, |rate| -passage(rate).0)).0;
    Some(Line {
        now_ns: f64::midpoint(low, high),
        rate,
        range_ns: (lowest.min(low), highest.max(high)),
        rate_doubt: (fastest - rate).max(rate - slowest),
    })
}

/// The position of the maximum of a function with a single peak.
fn peak(mut from: f64, mut to: f64, value: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..STEPS {
        let third = (to - from) / 3.0;
        if value(from + third) < value(to - third) {
            from += third;
        } else {
            to -= third;
        }
    }
    f64::midpoint(from, to)
}

/// How far a condition still holds from `inside` towards `to`.
fn edge(mut inside: f64, mut to: f64, holds: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..STEPS {
        let middle = f64::midpoint(inside, to);
        if holds(middle) {
            inside = middle;
        } else {
            to = middle;
        }
    }
    inside
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gates for a line with this rate: seconds before now, and the delays of question and answer in
    /// nanoseconds.
    fn gates(rate: f64, delays: &[(f64, f64, f64)]) -> Vec<Gate> {
        let gate = |&(ago_s, to_ns, back_ns): &(f64, f64, f64)| {
            let at_ns = -ago_s * 1e9;
            let truth = rate * at_ns;
            Gate { at_ns, asked_ns: truth - to_ns, answered_ns: truth + back_ns }
        };
        delays.iter().map(gate).collect()
    }

    #[test]
    fn narrow_gates_decide_and_wide_ones_do_no_harm() {
        let narrow = [(100.0, 1e3, 1e3), (0.0, 1e3, 1e3)];
        let line1 = line(&gates(50e-6, &narrow), 0.0).unwrap();
        assert!((line1.rate - 50e-6).abs() < 1e-9, "{line1:?}");
        assert!(line1.now_ns.abs() < 100.0 && line1.rate_doubt < 21e-12 + 2e3 / 100e9, "{line1:?}");
        let wide = [(100.0, 1e3, 1e3), (60.0, 5e6, 1e4), (30.0, 1e4, 9e6), (0.0, 1e3, 1e3)];
        let line2 = line(&gates(50e-6, &wide), 0.0).unwrap();
        assert!((line2.rate - line1.rate).abs() < 1e-12, "{line2:?}");
    }

    #[test]
    fn the_truth_is_within_the_range_whatever_the_delays() {
        for turn in 0..50_u32 {
            let delay = |n: u32| f64::from((n + 7 * turn).wrapping_mul(2_654_435_761) % 1000) * 1e3;
            let delays: Vec<_> = (0..20).map(|n| (f64::from(n), delay(2 * n), delay(2 * n + 1))).collect();
            let line = line(&gates(-80e-6, &delays), 0.0).unwrap();
            assert!(line.range_ns.0 <= 1e-3 && line.range_ns.1 >= -1e-3, "{line:?}");
            assert!((line.rate + 80e-6).abs() <= line.rate_doubt + 1e-12, "{line:?}");
        }
    }

    #[test]
    fn no_line_passes_gates_of_another_time() {
        assert_eq!(line(&gates(-0.8, &[(5.0, 1e6, 1e6), (0.0, 1e6, 1e6)]), 1e-6), None);
        assert_eq!(line(&[], 0.0), None);
    }
}
