//! Ctrl-C as a flag: a command that runs until it is stopped ends cleanly, with its summary. Any other command ends immediately,
//! and leaves no half-written file behind.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// The exit code that shells report for a program ended by Ctrl-C.
pub const ENDED_BY_SIGNAL: u8 = 130;
/// A second signal this soon after the first is the same request: `timeout` and some shells signal the program and then
/// its whole process group.
const ECHO: Duration = Duration::from_secs(2);

static HANDLER: OnceLock<()> = OnceLock::new();
static STATE: Mutex<State> = Mutex::new(State {
    is_watched: false,
    is_left: false,
    request: Request::NONE,
    unfinished: Vec::new(),
    last: None,
});

/// What a signal acts on.
struct State {
    /// Whether the command checks the flag.
    is_watched: bool,
    /// The terminal is another program's, and so is Ctrl-C.
    is_left: bool,
    request: Request,
    /// Incomplete files.
    unfinished: Vec<PathBuf>,
    /// What else is done first.
    last: Option<fn()>,
}

/// The signals received.
#[derive(Clone, Copy, Debug)]
struct Request {
    first_at: Option<Instant>,
    signals: u32,
}

impl Request {
    const NONE: Self = Self { first_at: None, signals: 0 };

    /// Takes the next signal; returns whether to end immediately.
    fn signal(&mut self, now: Instant) -> bool {
        self.signals += 1;
        let first_at = *self.first_at.get_or_insert(now);
        self.signals > 2 || now.duration_since(first_at) > ECHO
    }
}

fn state() -> MutexGuard<'static, State> {
    STATE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn handle() -> Result<(), ctrlc::Error> {
    if HANDLER.set(()).is_err() {
        return Ok(());
    }
    ctrlc::set_handler(|| {
        let mut state = state();
        if state.is_left {
            return;
        }
        if state.request.signal(Instant::now()) || !state.is_watched {
            for path in state.unfinished.drain(..) {
                let _ = std::fs::remove_file(path);
            }
            if let Some(last) = state.last {
                last();
            }
            std::process::exit(ENDED_BY_SIGNAL.into());
        }
    })
}

/// From now on, Ctrl-C (and the system's request to terminate) sets a flag instead of ending the program. Only a third one, or
/// one that comes two seconds after the first, ends it immediately.
pub fn watch() -> Result<(), ctrlc::Error> {
    handle()?;
    state().is_watched = true;
    Ok(())
}

/// Whether it was pressed.
pub fn requested() -> bool {
    state().request.first_at.is_some()
}

/// Does something while signals have no effect here: the terminal is another program's, and Ctrl-C means that one.
pub fn leave_to<R>(other: impl FnOnce() -> R) -> R {
    state().is_left = true;
    let result = other();
    state().is_left = false;
    result
}

/// Registers what a signal that ends the program immediately does first, such as giving the terminal back; [`None`] for nothing.
pub fn before_the_end(last: Option<fn()>) {
    state().last = last;
}

/// Registers a file to remove if a signal ends the program.
pub fn unfinished(path: &Path) {
    // Without a handler the file stays, which is untidy but does no harm.
    let _ = handle();
    state().unfinished.push(path.to_owned());
}

/// The file should stay, or is gone.
pub fn finished(path: &Path) {
    state().unfinished.retain(|unfinished| unfinished != path);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_echo_changes_nothing_and_insisting_ends_at_once() {
        let start = Instant::now();
        let after = |times_ms: &[u64]| {
            let mut request = Request::NONE;
            times_ms.iter().map(|ms| request.signal(start + Duration::from_millis(*ms))).collect::<Vec<_>>()
        };
        assert_eq!(after(&[0, 0]), [false, false]);
        assert_eq!(after(&[0, 1, 2]), [false, false, true]);
        assert_eq!(after(&[0, 3000]), [false, true]);
    }
}
