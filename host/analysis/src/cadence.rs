//! Measures how often something comes, and detects when it has been silent for long.

/// How many intervals are remembered. Their median is the usual length, unaffected by a few outliers.
const REMEMBERED: usize = 15;

/// After this many of its usual intervals without a new value, it is silent, not just slow.
const SILENCE: i64 = 10;

/// When something last came, and its usual interval.
#[derive(Clone, Debug)]
pub struct Cadence {
    /// The length according to a database, in nanoseconds; 0 if it gives none.
    cycle_ns: i64,
    last_ns: Option<i64>,
    intervals: [i64; REMEMBERED],
    count: usize,
}

impl Cadence {
    /// Nothing has come yet. The cycle comes from a database, in milliseconds.
    pub fn new(cycle_ms: Option<u32>) -> Self {
        let cycle_ns = i64::from(cycle_ms.unwrap_or(0)) * 1_000_000;
        Self { cycle_ns, last_ns: None, intervals: [0; REMEMBERED], count: 0 }
    }

    /// It came at this time; returns whether it had been silent until then.
    pub fn arrive(&mut self, time_ns: i64) -> bool {
        let Some(before) = self.last_ns.replace(time_ns) else { return false };
        let interval = time_ns.saturating_sub(before);
        if interval <= 0 {
            return false;
        }
        let silent = self.is_silence(interval);
        self.intervals[self.count % REMEMBERED] = interval;
        // It is kept below twice the number, because it would overflow on a long trace.
        self.count = if self.count + 1 < 2 * REMEMBERED { self.count + 1 } else { REMEMBERED };
        silent
    }

    /// Whether an interval of this many nanoseconds is much longer than usual. For the first one that is
    /// unknown.
    pub fn is_silence(&self, interval_ns: i64) -> bool {
        let known = self.count.min(REMEMBERED);
        let mut intervals = self.intervals;
        let intervals = &mut intervals[..known];
        intervals.sort_unstable();
        let usual = intervals.get(known / 2).copied().unwrap_or(0).max(self.cycle_ns);
        usual > 0 && interval_ns > usual.saturating_mul(SILENCE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_pause_is_silence_and_a_slow_signal_is_not() {
        let mut fast = Cadence::new(None);
        let silences = (0..100).filter(|n| fast.arrive(n * 100)).count();
        assert_eq!(silences, 0);
        assert!(!fast.arrive(9_900 + 900));
        assert!(fast.arrive(10_800 + 1_500_000));
        // Something that becomes slow counts as silent until the new interval is the usual one.
        let mut slower = Cadence::new(None);
        (0..20).for_each(|n| {
            slower.arrive(n * 10);
        });
        let silent = (1..20).filter(|n| slower.arrive(190 + n * 1000)).count();
        assert!((1..=8).contains(&silent), "{silent}");
    }

    #[test]
    fn the_databases_cycle_counts_from_the_first_interval() {
        let mut known = Cadence::new(Some(100));
        assert!(!known.arrive(0));
        assert!(known.arrive(25 * 60 * 1_000_000_000));
        let mut unknown = Cadence::new(None);
        unknown.arrive(0);
        assert!(!unknown.arrive(25 * 60 * 1_000_000_000));
    }
}
