//! The command, run in a folder of a test's own.

use std::path::Path;
use std::process::{Command, Output};

/// Runs a line, whose words are separated by single blanks; returns its exit code and what it printed.
pub fn cantap(directory: &Path, line: &str) -> (Option<i32>, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(line.split(' ')).current_dir(directory).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}
