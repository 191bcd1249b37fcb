//! Other programs that read our files and write some that we read.
//!
//! What is the same for all crates' peers is in [`shared`].

#![allow(dead_code, reason = "each test file uses some of them")]

use cantap_testing::peers as shared;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

pub use shared::{python, skip};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/trace_peer.py");

/// A program's output, or `None` after reporting that it is missing. If it is there and fails, the test
/// fails.
pub fn run(peer: &str, probe: &[&str], command: &mut Command) -> Option<String> {
    let there = Command::new(command.get_program()).args(probe).output();
    if !there.is_ok_and(|output| output.status.success() || probe.is_empty()) {
        skip(&format!("{peer} is not installed"));
        return None;
    }
    let output = command.env("TZ", "UTC").output().unwrap();
    assert!(output.status.success(), "{peer}: {}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

pub fn python_can(arguments: &[&Path], command: &str) -> Option<String> {
    run("python-can", &["-c", "import can"], Command::new(python()).arg(SCRIPT).arg(command).args(arguments))
}

/// What python-can reads from each file.
pub fn python_can_reads(paths: &[PathBuf]) -> Option<BTreeMap<PathBuf, Vec<String>>> {
    let arguments: Vec<_> = paths.iter().map(PathBuf::as_path).collect();
    let text = python_can(&arguments, "dump")?;
    let mut files: BTreeMap<PathBuf, Vec<String>> = BTreeMap::new();
    let mut current = PathBuf::new();
    for line in text.lines() {
        match line.strip_prefix("file ") {
            Some(path) => {
                current = path.into();
                files.insert(current.clone(), Vec::new());
            }
            None => files.get_mut(&current).unwrap().push(line.to_owned()),
        }
    }
    Some(files)
}
