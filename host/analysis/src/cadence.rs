//! How often something comes, and when it has been silent for long.

/// How many intervals are remembered. The middle one of them is the usual length, whatever a few of them are.
const REMEMBERED: usize = 15;

/// So many times its usual interval without a new value is silence, and no slow change.
const SILENCE: i64 = 10;

/// When something came last, and how long its intervals usually are.
#[derive(Clone, Debug)]
pub struct Cadence {
    /// As long as a database says it is, in nanoseconds; 0 if it does not say.
    cycle_ns: i64,
    last_ns: Option<i64>,
    intervals: [i64; REMEMBERED],
    count: usize,
}

impl Cadence {
    /// Nothing came yet. The cycle is that of a database, in milliseconds.
    pub fn new(cycle_ms: Option<u32>) -> Self {
        let cycle_ns = i64::from(cycle_ms.unwrap_or(0)) * 1_000_000;
        Self { cycle_ns, last_ns: None, intervals: [0; REMEMBERED], count: 0 }
    }

    /// It came at this time; says whether it had been silent until then.
    pub fn arrive(&mut self, time_ns: i64) -> bool {
        let Some(before) = self.last_ns.replace(time_ns) else { return false };
        let interval = time_ns.saturating_sub(before);
        if interval <= 0 {
            return false;
        }
        let silent = self.is_silence(interval);
        self.intervals[self.count % REMEMBERED] = interval;
        // It stays below twice the number, where it would overflow on a long trace.
        self.count = if self.count + 1 < 2 * REMEMBERED { self.count + 1 } else { REMEMBERED };
        silent
    }

    /// Whether an interval of this many nanoseconds is much longer than usual. Of the first nobody can tell.
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
        // Whoever becomes slow is silent until that is what is usual.
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
