//! Other people's programs that tests run as witnesses.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`. If a program is missing, its test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`. Even then `CANTAP_WITHOUT_PEERS` may name some that were left out on purpose.

use std::process::Command;

/// The Python to run.
pub fn python() -> String {
    std::env::var("CANTAP_PYTHON").unwrap_or_else(|_| "python3".to_owned())
}

/// Python, if it has these modules, as in `can, canopen`.
pub fn python_with(modules: &str) -> Option<String> {
    let python = python();
    has(Command::new(&python).args(["-c", &format!("import {modules}")]), modules).then_some(python)
}

/// Chromium, which Debian packages, if it is installed.
pub fn chromium() -> Option<&'static str> {
    let probe = Command::new("chromium").arg("--version").output();
    if probe.is_ok_and(|output| output.status.success()) {
        return Some("chromium");
    }
    // It is large, and the same is shown without it.
    eprintln!("SKIPPED: chromium is not installed");
    None
}

/// Whether this command succeeds; if not, `peer` is reported as missing.
pub fn has(probe: &mut Command, peer: &str) -> bool {
    let is_there = probe.output().is_ok_and(|output| output.status.success());
    if !is_there {
        skip(&format!("{peer} is not installed"));
    }
    is_there
}

/// Reports why a test does not run. Panics if peers are required.
pub fn skip(reason: &str) {
    let is_required = std::env::var_os("CANTAP_REQUIRE_PEERS").is_some_and(|value| value == "1");
    assert!(!is_required, "peers are required, but {reason}");
    eprintln!("SKIPPED: {reason}");
}

/// The same for a peer that may have been left out on purpose, which is then not required.
pub fn skip_without(peer: &str, reason: &str) {
    let left_out = std::env::var("CANTAP_WITHOUT_PEERS").unwrap_or_default();
    if left_out.split_whitespace().any(|name| name == peer) {
        eprintln!("SKIPPED: {reason}");
    } else {
        skip(reason);
    }
}
