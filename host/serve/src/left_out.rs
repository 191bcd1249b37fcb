//! What a client of a foreign protocol was not told: because its protocol has no message for it, or because it was lost in front of the client.

use std::time::{Duration, Instant};

use crate::{Board, News};

/// How often the server says so while it goes on.
const REPORT_EVERY: Duration = Duration::from_mins(1);

/// The kind of what was lost in front of a client.
pub const LOST: &str = "lost frames, or more";

/// Counts by kind.
#[derive(Default)]
pub struct LeftOut {
    kinds: Vec<(&'static str, u64)>,
    reported_at: Option<Instant>,
}

impl LeftOut {
    /// Adds some.
    pub fn count(&mut self, kind: &'static str, count: u64) {
        if count == 0 {
            return;
        }
        match self.kinds.iter_mut().find(|(name, _)| *name == kind) {
            Some((_, sum)) => *sum += count,
            None => self.kinds.push((kind, count)),
        }
    }

    /// Tells whoever runs the server, if there is anything and it is time, or the end.
    pub fn report(&mut self, is_end: bool, board: &Board, client: &str) {
        if let Some(what) = self.take(is_end) {
            board.tell(News::LeftOut { client: client.to_owned(), what });
        }
    }

    /// What was left out since the last report.
    fn take(&mut self, is_end: bool) -> Option<String> {
        if self.kinds.is_empty() || !is_end && self.reported_at.is_some_and(|at| at.elapsed() < REPORT_EVERY)
        {
            return None;
        }
        self.reported_at = Some(Instant::now());
        let all: Vec<String> = self.kinds.drain(..).map(|(kind, count)| format!("{count} {kind}")).collect();
        Some(all.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_is_reported_once_and_not_too_often() {
        let mut left_out = LeftOut::default();
        left_out.count("bus errors", 0);
        assert_eq!(left_out.take(true), None);
        left_out.count("remote frames", 2);
        assert_eq!(left_out.take(false).as_deref(), Some("2 remote frames"));
        left_out.count("remote frames", 1);
        left_out.count("bus errors", 7);
        left_out.count("remote frames", 1);
        assert_eq!(left_out.take(false), None);
        assert_eq!(left_out.take(true).as_deref(), Some("2 remote frames, 7 bus errors"));
        assert_eq!(left_out.take(true), None);
    }
}
