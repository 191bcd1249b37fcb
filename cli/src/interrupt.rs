//! Ctrl-C as a flag: a command that runs until it is stopped ends cleanly, with its summary.

use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// What shells report for a program that Ctrl-C ended.
const ENDED_BY_SIGNAL: i32 = 130;
/// A second signal so soon after the first is the same request: `timeout` and some shells signal the program, and then its
/// whole group, it among them.
const ECHO: Duration = Duration::from_secs(2);

static REQUEST: OnceLock<Mutex<Request>> = OnceLock::new();

/// Signals that came.
#[derive(Clone, Copy, Debug, Default)]
struct Request {
    first_at: Option<Instant>,
    signals: u32,
}

impl Request {
    /// Takes the next signal; returns whether to end at once.
    fn signal(&mut self, now: Instant) -> bool {
        self.signals += 1;
        let first_at = *self.first_at.get_or_insert(now);
        self.signals > 2 || now.duration_since(first_at) > ECHO
    }
}

/// From now on Ctrl-C (and the system's polite request to end) sets a flag instead of ending the program. Only a third one, or
/// one that comes [`ECHO`] after the first, ends it at once.
pub fn watch() -> anyhow::Result<()> {
    if REQUEST.get().is_some() {
        return Ok(());
    }
    let request = REQUEST.get_or_init(Mutex::default);
    ctrlc::set_handler(move || {
        if request.lock().unwrap_or_else(PoisonError::into_inner).signal(Instant::now()) {
            std::process::exit(ENDED_BY_SIGNAL);
        }
    })?;
    Ok(())
}

/// Whether it was pressed.
pub fn requested() -> bool {
    REQUEST
        .get()
        .is_some_and(|request| request.lock().unwrap_or_else(PoisonError::into_inner).first_at.is_some())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_echo_changes_nothing_and_insisting_ends_at_once() {
        let start = Instant::now();
        let after = |times_ms: &[u64]| {
            let mut request = Request::default();
            times_ms.iter().map(|ms| request.signal(start + Duration::from_millis(*ms))).collect::<Vec<_>>()
        };
        assert_eq!(after(&[0, 0]), [false, false]);
        assert_eq!(after(&[0, 1, 2]), [false, false, true]);
        assert_eq!(after(&[0, 3000]), [false, true]);
    }
}
