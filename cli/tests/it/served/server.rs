//! `cantap serve` as a user starts it, and the commands that use it.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

pub const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

pub fn cantap(arguments: &str) -> Command {
    let mut command = Command::new(CANTAP);
    command
        .args(arguments.split_whitespace())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

pub fn run(arguments: &str) -> (Option<i32>, String, String) {
    said(&cantap(arguments).output().unwrap())
}

pub fn said(output: &Output) -> (Option<i32>, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

/// A running server.
pub struct Server {
    pub child: Child,
    /// Its addresses, as printed.
    pub at: Vec<String>,
}

impl Server {
    /// Starts one that prints so many addresses.
    pub fn start(arguments: &str, ways: usize) -> Self {
        Self::reporting(arguments, ways, Stdio::inherit())
    }

    /// The same; `stderr` is where its remarks go.
    pub fn reporting(arguments: &str, ways: usize, stderr: Stdio) -> Self {
        Self::of(cantap(&format!("serve {arguments}")).stderr(stderr), ways)
    }

    /// The one that a command starts.
    pub fn of(command: &mut Command, ways: usize) -> Self {
        let mut child = command.spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let at = (0..ways).map(|_| lines.next().expect("it listens").unwrap()).collect();
        Self { child, at }
    }

    pub fn interrupt(&mut self) -> ExitStatus {
        signal(&self.child, Signal::INT);
        self.child.wait().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until a file contains a text, and returns all of it.
pub fn wait_for(file: &Path, wanted: &str) -> String {
    let deadline = Instant::now() + Duration::from_mins(1);
    loop {
        let text = std::fs::read_to_string(file).unwrap_or_default();
        if text.contains(wanted) {
            return text;
        }
        assert!(Instant::now() < deadline, "{wanted}: {text}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

pub fn signal(child: &Child, signal: Signal) {
    kill_process(Pid::from_child(child), signal).unwrap();
}

pub fn socket(folder: &Path) -> String {
    folder.join("cantap.sock").display().to_string()
}

/// A candump log's lines as (seconds, channel and frame), without errors and losses.
pub fn log(path: &Path) -> Vec<(f64, String)> {
    let text = std::fs::read_to_string(path).unwrap();
    let line = |line: &str| {
        let (time, frame) = line.split_once(") ")?;
        Some((time.trim_start_matches('(').parse().ok()?, frame.to_owned()))
    };
    text.lines().filter_map(line).filter(|(_, frame)| !frame.contains(" 20000")).collect()
}

/// Checks two traces of one bus: the frames in both are the same, in the same order and at the same times.
pub fn agree(one: &[(f64, String)], other: &[(f64, String)]) {
    let of = |all: &[(f64, String)], channel: &str| {
        all.iter().filter(|(_, frame)| frame.starts_with(channel)).cloned().collect::<Vec<_>>()
    };
    for channel in ["can0", "can1"] {
        let (one, other) = (of(one, channel), of(other, channel));
        assert!(one.len() > 100 && other.len() > 100, "{channel}: {} and {}", one.len(), other.len());
        let frames = |of: &[(f64, String)], at: usize| {
            of[at..at + 12].iter().map(|(_, frame)| frame.clone()).collect::<Vec<_>>()
        };
        let find =
            |of: &[(f64, String)], what: &[String]| (0..of.len() - 12).find(|at| frames(of, *at) == what);
        // The one that began later starts within the other.
        let (from, to) = match find(&one, &frames(&other, 0)) {
            Some(at) => (at, 0),
            None => (0, find(&other, &frames(&one, 0)).expect("common frames")),
        };
        let common = (one.len() - from).min(other.len() - to);
        assert!(common > 100, "{channel}: {common}");
        for (a, b) in one[from..].iter().zip(&other[to..]) {
            assert_eq!(a.1, b.1);
            // Each has measured UTC by its own round trips, on a busy computer.
            assert!((a.0 - b.0).abs() < 0.02, "{a:?} {b:?}");
        }
    }
}

pub fn capture(at: &str, file: &Path, rest: &str) -> Command {
    cantap(&format!("capture -d {at} -o {} --json {rest}", file.display()))
}

pub fn nothing_lost(output: &Output) {
    let (code, out, err) = said(output);
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    for stage in summary["lost"].as_object().unwrap() {
        assert_eq!(*stage.1, 0, "{summary}");
    }
}
