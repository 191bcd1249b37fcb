//! How many reports of a kind are made: anybody who reaches a port can have as many as he likes, and must not fill a disk with them.

use std::time::{Duration, Instant};

/// Lets a few reports through and counts the others.
#[derive(Debug)]
pub struct LogLimit {
    /// Reports made however fast they come,
    burst: u32,
    /// after which one is made in this time.
    every: Duration,
    /// When the reports so far would have been made, one in that time.
    due: Option<Instant>,
    omitted: u64,
}

impl LogLimit {
    /// For refusals: some hundred kilobytes a day.
    pub const fn of_refusals() -> Self {
        Self { burst: 100, every: Duration::from_secs(30), due: None, omitted: 0 }
    }

    /// For sessions, which come, open channels, close them and leave: some megabytes a day, and more than anybody has who works with a bus.
    pub const fn of_sessions() -> Self {
        Self { burst: 1000, every: Duration::from_secs(2), due: None, omitted: 0 }
    }

    /// Whether something that happens now is reported; if so, how many were not since the last report.
    pub fn pass(&mut self, now: Instant) -> Option<u64> {
        let due = self.due.map_or(now, |due| due.max(now));
        if due - now > self.every * (self.burst - 1) {
            self.omitted += 1;
            return None;
        }
        self.due = Some(due + self.every);
        Some(std::mem::take(&mut self.omitted))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_refusals_is_counted_and_a_few_are_reported() {
        let began = Instant::now();
        let mut limit = LogLimit::of_refusals();
        let (burst, every) = (limit.burst, limit.every);
        let mut flood = |at: Instant| (0..10_000).filter_map(|_| limit.pass(at)).collect::<Vec<_>>();
        assert_eq!(flood(began), vec![0; burst as usize]);
        assert_eq!(flood(began + every), [9_900]);
        assert_eq!(flood(began + every * 2), [9_999]);
        // After a quiet hour, as at first.
        let later = flood(began + Duration::from_hours(1));
        assert_eq!((later.len(), later[0]), (burst as usize, 9_999));
    }
}
