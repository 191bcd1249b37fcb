//! Waiting within a step, and what may spoil it: Ctrl-C, and a computer that is too busy to test anything.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// How often to check whether to go on.
const SLICE: Duration = Duration::from_millis(20);
/// A program that is held up for this long at a time cannot judge a device's answers: it is a seventh of what the session
/// allows a device.
const TOO_BUSY: Duration = Duration::from_millis(200);

/// Ctrl-C ends the test, and the step has no outcome.
#[derive(Debug, thiserror::Error)]
#[error("Ctrl-C ended it")]
pub struct Interrupted;

/// How long to go on.
#[derive(Clone)]
pub struct Patience(Arc<dyn Fn() -> bool + Send + Sync>);

impl Patience {
    /// Until this returns true, which it is asked often.
    pub fn until(is_over: impl Fn() -> bool + Send + Sync + 'static) -> Self {
        Self(Arc::new(is_over))
    }

    /// To the end.
    pub fn endless() -> Self {
        Self::until(|| false)
    }

    /// Whether it is over.
    pub(super) fn is_over(&self) -> bool {
        (self.0)()
    }

    /// An error if it is over.
    pub(super) fn check(&self) -> Result<(), Interrupted> {
        if self.is_over() { Err(Interrupted) } else { Ok(()) }
    }

    /// Waits for this long, unless it is over before.
    pub(super) fn pause(&self, time: Duration) -> Result<(), Interrupted> {
        let until = Instant::now() + time;
        loop {
            self.check()?;
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(SLICE));
        }
    }
}

/// Measures how long this computer keeps the program from running: a thread that only sleeps, and notes how late it woke.
pub struct BusyWatch(Arc<Seen>);

#[derive(Default)]
struct Seen {
    longest_us: AtomicU64,
    quit: AtomicBool,
}

impl Seen {
    fn note(&self, late: Duration) {
        self.longest_us.fetch_max(late.as_micros() as u64, Ordering::Relaxed);
    }
}

impl BusyWatch {
    /// Begins to measure. If the system refuses the thread, nothing is ever held up.
    pub fn start() -> Self {
        let watch = Self(Arc::default());
        let seen = Arc::clone(&watch.0);
        let body = move || {
            while !seen.quit.load(Ordering::Relaxed) {
                let slept = Instant::now();
                std::thread::sleep(SLICE);
                seen.note(slept.elapsed().saturating_sub(SLICE));
            }
        };
        let _ = std::thread::Builder::new().name("busy watch".to_owned()).spawn(body);
        watch
    }

    /// The longest time that the program was held up since the last call, if that was too long for a test.
    pub fn take_too_busy(&self) -> Option<Duration> {
        let longest = Duration::from_micros(self.0.longest_us.swap(0, Ordering::Relaxed));
        (longest >= TOO_BUSY).then_some(longest)
    }

    /// What holds the program up, for a test.
    #[cfg(test)]
    pub fn busy_computer(&self) -> impl Fn(Duration) + use<> {
        let seen = Arc::clone(&self.0);
        move |late| seen.note(late)
    }
}

impl Drop for BusyWatch {
    fn drop(&mut self) {
        self.0.quit.store(true, Ordering::Relaxed);
    }
}
