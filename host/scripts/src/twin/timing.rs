//! Whether frames come periodically, and how exactly.

use super::learner::Seen;

/// The fewest regular intervals that make a period.
const FEWEST: usize = 4;
/// Of all intervals, how many must be regular, and how much of the time must be covered by those and by what is explained.
const MOSTLY: f64 = 0.6;
const NEARLY_ALL: f64 = 0.8;
/// The largest multiple of the period that lost frames explain.
const MOST_MISSED: f64 = 10.0;
/// Silent for as many periods at the end of the trace, a sender has stopped.
const STOPPED: f64 = 10.0;

/// A period in nanoseconds: its mean, and the standard deviation of its intervals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Period {
    /// The mean.
    pub mean_ns: f64,
    /// The standard deviation.
    pub jitter_ns: f64,
}

/// The period of frames, if they have one. Intervals across losses do not count, multiples of the usual one are lost frames.
pub fn period(seen: &[Seen]) -> Option<Period> {
    let neighbours = || seen.windows(2).map(|pair| (pair[0], pair[1]));
    let interval = |(a, b): (Seen, Seen)| b.at_ns.saturating_sub(a.at_ns) as f64;
    let intervals: Vec<f64> = neighbours().filter(|(a, b)| a.stretch == b.stretch).map(interval).collect();
    let mut sorted = intervals.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let median = *sorted.get(sorted.len() / 2)?;
    if median <= 0.0 {
        return None;
    }
    let regular: Vec<f64> =
        intervals.iter().copied().filter(|each| (0.5 * median..=1.5 * median).contains(each)).collect();
    if regular.len() < FEWEST || (regular.len() as f64) < MOSTLY * intervals.len() as f64 {
        return None;
    }
    let is_multiple = |each: f64| {
        let times = (each / median).round();
        (2.0..=MOST_MISSED).contains(&times) && (each - times * median).abs() < 0.3 * median
    };
    let explained: f64 = intervals.iter().copied().filter(|each| is_multiple(*each)).sum();
    let across: f64 = neighbours().filter(|(a, b)| a.stretch != b.stretch).map(interval).sum();
    let sum: f64 = regular.iter().sum();
    let whole = interval((*seen.first()?, *seen.last()?));
    if sum + explained + across < NEARLY_ALL * whole {
        return None;
    }
    let mean_ns = sum / regular.len() as f64;
    let variance = regular.iter().map(|each| (each - mean_ns).powi(2)).sum::<f64>() / regular.len() as f64;
    let jitter_ns = variance.sqrt();
    // A random time between two frames is no period.
    (jitter_ns < 0.25 * mean_ns).then_some(Period { mean_ns, jitter_ns })
}

/// When a sender stopped before a trace that is this long ended, if it did.
pub fn stop_ns(seen: &[Seen], period: Period, duration_ns: u64) -> Option<u64> {
    let last_ns = seen.last()?.at_ns;
    let silent = duration_ns.saturating_sub(last_ns) as f64;
    (silent > STOPPED * period.mean_ns).then_some(last_ns + (period.mean_ns / 2.0) as u64)
}
