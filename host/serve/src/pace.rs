//! How often a client of a foreign protocol is written to. The board's batches come every millisecond. Written one by one, they are small packets,
//! each of which takes a packet's room in the system's buffer, so that a few dozen fill it; on a busy computer the writer then waited until the
//! peer's system got round to acknowledging them, 40 ms later or more. So what comes within a few milliseconds goes in one piece.

use std::time::{Duration, Instant};

/// The least time between two pieces, unless nothing was written for as long: a frame on a quiet bus does not wait.
const EVERY: Duration = Duration::from_millis(5);

/// When the next piece is due.
#[derive(Default)]
pub struct Pace {
    written_at: Option<Instant>,
}

impl Pace {
    /// How long what is there may still wait for more.
    pub fn left(&self, now: Instant) -> Duration {
        self.written_at.map_or(Duration::ZERO, |at| EVERY.saturating_sub(now.saturating_duration_since(at)))
    }

    /// A piece was written.
    pub fn has_written(&mut self, now: Instant) {
        self.written_at = Some(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_piece_waits_only_for_as_long_as_the_last_one_is_fresh() {
        let mut pace = Pace::default();
        let now = Instant::now();
        assert_eq!(pace.left(now), Duration::ZERO);
        pace.has_written(now);
        assert_eq!(pace.left(now), EVERY);
        assert_eq!(pace.left(now + EVERY / 5), EVERY * 4 / 5);
        assert_eq!(pace.left(now + EVERY * 2), Duration::ZERO);
    }
}
