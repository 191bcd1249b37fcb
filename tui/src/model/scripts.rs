//! Scripts: which there are, how they are, and what they have said.

use std::collections::VecDeque;

use cantap_scripts::{Outcome, ScriptCounts, TestResult};
use cantap_trace::clean;

/// Lines of output that are kept.
const MOST_LINES: usize = 2000;

/// How a script is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum ScriptState {
    /// It was not started.
    #[default]
    Off,
    /// It runs, and is in this test.
    Running(Option<String>),
    /// The user has stopped it.
    Stopped,
    /// It has come to its end.
    Ended,
    /// It has ended with an error.
    Failed(String),
}

/// A script in the list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ScriptRow {
    /// As typed: a file, or a ready node.
    pub name: String,
    /// How it is.
    pub state: ScriptState,
    /// Tests that have passed, since it was started.
    pub passed: u32,
    /// Tests that have failed.
    pub failed: u32,
}

/// What a line of output is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineKind {
    /// What a script has logged.
    Log,
    /// Something that went well, or that is only to be known.
    Note,
    /// A failure or an error.
    Fault,
}

/// All of them.
#[derive(Clone, Debug, Default)]
pub struct Scripts {
    /// The list.
    pub rows: Vec<ScriptRow>,
    /// Lines of output, the newest last.
    pub output: VecDeque<(LineKind, String)>,
    /// What those that run have sent and received.
    pub counts: ScriptCounts,
    /// The gateway's state, its rules with their counts, and its sums; empty if the device is none.
    pub gateway: Vec<String>,
}

impl Scripts {
    /// One more in the list.
    pub fn add(&mut self, name: &str) {
        self.rows.push(ScriptRow { name: name.to_owned(), state: ScriptState::Off, passed: 0, failed: 0 });
    }

    /// The script with this name.
    pub fn row(&mut self, name: &str) -> Option<&mut ScriptRow> {
        self.rows.iter_mut().find(|row| row.name == name)
    }

    /// Whether it runs.
    pub fn is_running(&self, name: &str) -> bool {
        self.rows.iter().any(|row| row.name == name && matches!(row.state, ScriptState::Running(_)))
    }

    /// A script is different from now on; those that were removed from the list are not.
    pub fn set_state(&mut self, name: &str, state: ScriptState) {
        if let Some(row) = self.row(name) {
            row.state = state;
        }
    }

    /// It begins.
    pub fn begin(&mut self, name: &str) {
        if let Some(row) = self.row(name) {
            (row.state, row.passed, row.failed) = (ScriptState::Running(None), 0, 0);
        }
        self.say(LineKind::Note, &format!("{name}: started"));
    }

    /// It cannot go on.
    pub fn fail(&mut self, name: &str, error: &str) {
        self.set_state(name, ScriptState::Failed(clean::line(error).into_owned()));
        self.say(LineKind::Fault, &format!("{name}: ERROR: {error}"));
    }

    /// A test has ended.
    pub fn take_test(&mut self, test: &TestResult) {
        let TestResult { script, name, outcome, began_ns, ended_ns, .. } = test;
        let milliseconds = (ended_ns - began_ns) as f64 / 1e6;
        let has_passed = *outcome == Outcome::Passed;
        if let Some(row) = self.row(script) {
            *(if has_passed { &mut row.passed } else { &mut row.failed }) += 1;
            if matches!(row.state, ScriptState::Running(_)) {
                row.state = ScriptState::Running(None);
            }
        }
        match outcome {
            Outcome::Passed => {
                self.say(LineKind::Note, &format!("{script}: ok {name} ({milliseconds:.3} ms)"));
            }
            Outcome::Failed(reason) => {
                // The verdict below its frames is in sight.
                for line in test.trace_lines() {
                    self.say(LineKind::Log, &format!("    {line}"));
                }
                let verdict = format!("{script}: FAILED {name} ({milliseconds:.3} ms): {reason}");
                self.say(LineKind::Fault, &verdict);
            }
        }
    }

    /// Adds lines of output, without what a terminal would obey.
    pub fn say(&mut self, kind: LineKind, text: &str) {
        for line in clean::lines(text).lines() {
            if self.output.len() == MOST_LINES {
                self.output.pop_front();
            }
            self.output.push_back((kind, line.to_owned()));
        }
    }
}
