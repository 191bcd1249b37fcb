//! How many refusals are reported: anybody who reaches a port can have as many as he likes, and must not fill a disk with them.

use std::time::{Duration, Instant};

/// Refusals reported however fast they come,
const BURST: u32 = 100;
/// after which one is reported in this time: some hundred kilobytes a day.
const EVERY: Duration = Duration::from_secs(30);

/// Lets a few reports through and counts the others.
#[derive(Debug, Default)]
pub struct LogLimit {
    /// When the reports so far would have been made, one every [`EVERY`].
    due: Option<Instant>,
    omitted: u64,
}

impl LogLimit {
    /// Whether something that happens now is reported; if so, how many were not since the last report.
    pub fn pass(&mut self, now: Instant) -> Option<u64> {
        let due = self.due.map_or(now, |due| due.max(now));
        if due - now > EVERY * (BURST - 1) {
            self.omitted += 1;
            return None;
        }
        self.due = Some(due + EVERY);
        Some(std::mem::take(&mut self.omitted))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_of_refusals_is_counted_and_a_few_are_reported() {
        let began = Instant::now();
        let mut limit = LogLimit::default();
        let mut flood = |at: Instant| (0..10_000).filter_map(|_| limit.pass(at)).collect::<Vec<_>>();
        assert_eq!(flood(began), [0; BURST as usize]);
        assert_eq!(flood(began + EVERY), [9_900]);
        assert_eq!(flood(began + EVERY * 2), [9_999]);
        // After a quiet hour, as at first.
        let later = flood(began + Duration::from_hours(1));
        assert_eq!((later.len(), later[0]), (BURST as usize, 9_999));
    }
}
