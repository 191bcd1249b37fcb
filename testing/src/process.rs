//! Tests that cannot share their process or the machine with others, or wait for what other threads do.

use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The variable that names the test whose body is to run in this process.
const ALONE: &str = "CANTAP_TEST_ALONE";

/// Runs a test's body in a process of its own, for tests that count what their process holds. `test` is the test's full
/// name, as in `reconnects::nothing_stays`.
///
/// # Panics
/// If the body does.
pub fn alone(test: &str, body: impl FnOnce()) {
    if std::env::var(ALONE).is_ok_and(|name| name == test) {
        return body();
    }
    let program = std::env::current_exe().expect("a test knows its program");
    let status = Command::new(program).args([test, "--exact", "--nocapture"]).env(ALONE, test).status();
    assert!(status.is_ok_and(|status| status.success()), "{test} failed in its own process");
}

static TURN: Mutex<()> = Mutex::new(());

/// Waits until no other test that fills a processor in real time runs in this program. Keep what it returns until the end.
pub fn turn() -> MutexGuard<'static, ()> {
    // Whoever failed while it had its turn is no concern of the next.
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Far longer than anything takes, even on a busy machine: only what never happens takes this long.
const PATIENCE: Duration = Duration::from_mins(1);

/// Waits until something holds.
///
/// # Panics
/// If it never does, with `what` is wrong then.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !holds() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}
