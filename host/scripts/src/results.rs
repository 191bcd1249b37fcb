//! What a run collects for its report.

use std::collections::{BTreeMap, VecDeque};

use cantap_can::{Channel, Frame};

use crate::exchange::Output;
use crate::node::Node;
use crate::report::{Message, Outcome, Report, TestResult};

/// How many of the last frames go with a failure.
const TRACE: usize = 40;
/// How many of the frames after it do, at most.
const AFTER: usize = 20;
/// And for how long, in nanoseconds.
pub const AFTER_NS: u64 = 100_000_000;

/// Collects tests and frames while a run goes on.
#[derive(Default)]
pub struct Results {
    /// The report so far.
    pub report: Report,
    /// Lines that scripts logged, to be taken.
    pub messages: Vec<Message>,
    /// The test that each script is in.
    pub tests: BTreeMap<String, String>,
    last: VecDeque<(u64, Channel, Frame)>,
    /// Tests by their place in the report whose failure was not long ago, and until when frames go with it.
    followed: Vec<(usize, u64)>,
}

impl Results {
    /// A frame was on the bus.
    pub fn frame(&mut self, at_ns: u64, channel: Channel, frame: Frame) {
        let tests = &mut self.report.tests;
        self.followed.retain(|(test, until_ns)| at_ns <= *until_ns && tests[*test].trace_after.len() < AFTER);
        for (test, _) in &self.followed {
            tests[*test].trace_after.push(line(&(at_ns, channel, frame)));
        }
        if self.last.len() == TRACE {
            self.last.pop_front();
        }
        self.last.push_back((at_ns, channel, frame));
    }

    /// Takes what is for the report; returns what is for the bus.
    pub fn take(&mut self, script: &str, now_ns: u64, output: Output) -> Option<Output> {
        match output {
            Output::Log(text) => {
                self.messages.push(Message { at_ns: now_ns, script: script.to_owned(), text });
                None
            }
            // The node knows them.
            Output::Tests(_) => None,
            Output::TestBegan(name) => {
                self.tests.insert(script.to_owned(), name);
                None
            }
            Output::Test { name, outcome, began_ns } => {
                self.tests.remove(script);
                let has_passed = outcome == Outcome::Passed;
                let trace = if has_passed { Vec::new() } else { self.trace() };
                if !has_passed {
                    self.followed.push((self.report.tests.len(), now_ns.saturating_add(AFTER_NS)));
                }
                let script = script.to_owned();
                self.report.tests.push(TestResult {
                    script,
                    name,
                    outcome,
                    began_ns,
                    ended_ns: now_ns,
                    trace,
                    trace_after: Vec::new(),
                });
                None
            }
            for_the_bus => Some(for_the_bus),
        }
    }

    /// Scripts wait for keys, and none will come: each is told of once.
    pub fn without_keys(&mut self, nodes: &[Node], now_ns: u64) {
        for node in nodes.iter().filter(|node| node.waits_for_keys()) {
            if !self.report.without_keys.contains(&node.name) {
                self.report.without_keys.push(node.name.clone());
                let text = "on_key: no keys come in this run".to_owned();
                self.messages.push(Message { at_ns: now_ns, script: node.name.clone(), text });
            }
        }
    }

    /// Whether frames still go with a failure.
    pub fn is_tracing(&self, now_ns: u64) -> bool {
        let is_short = |test: usize| self.report.tests[test].trace_after.len() < AFTER;
        self.followed.iter().any(|(test, until_ns)| now_ns < *until_ns && is_short(*test))
    }

    /// The last frames.
    fn trace(&self) -> Vec<String> {
        self.last.iter().map(line).collect()
    }

    /// The report of a run that is over. A test that has not ended by then has not passed.
    pub fn finish(mut self, nodes: &[Node], now_ns: u64) -> Report {
        self.report.duration_ns = now_ns;
        for node in nodes.iter().filter(|node| !node.has_ended) {
            let mut began_ns = node.test_began_ns;
            for name in node.tests.iter().skip(node.tests_ended) {
                let (what, trace) =
                    if began_ns.is_some() { ("ended", self.trace()) } else { ("begun", Vec::new()) };
                let seconds = now_ns as f64 / 1e9;
                self.report.tests.push(TestResult {
                    script: node.name.clone(),
                    name: name.clone(),
                    outcome: Outcome::Failed(format!(
                        "the run was over, after {seconds} s, before it had {what}"
                    )),
                    began_ns: began_ns.take().unwrap_or(now_ns),
                    ended_ns: now_ns,
                    trace,
                    trace_after: Vec::new(),
                });
            }
            if node.waits_for_tests() {
                self.report.tests.push(TestResult {
                    script: node.name.clone(),
                    name: "test(…)".to_owned(),
                    outcome: Outcome::Failed(format!(
                        "the run was over, after {} s, before the script had made its tests",
                        now_ns as f64 / 1e9
                    )),
                    began_ns: now_ns,
                    ended_ns: now_ns,
                    trace: Vec::new(),
                    trace_after: Vec::new(),
                });
            }
        }
        let errors = nodes.iter().filter_map(|node| Some((node.name.clone(), node.error.clone()?)));
        self.report.errors.extend(errors);
        self.report
    }
}

/// A frame as a line of candump's log format.
fn line((at_ns, channel, frame): &(u64, Channel, Frame)) -> String {
    format!("({}.{:06}) can{} {frame}", at_ns / 1_000_000_000, at_ns / 1000 % 1_000_000, channel.index())
}

/// Whether a run is over: every script with tests has ended, or, if none has tests, every script has, for good.
pub fn is_over(nodes: &[Node]) -> bool {
    let mut deciding = nodes.iter().filter(|node| node.has_tests()).peekable();
    if deciding.peek().is_some() {
        deciding.all(|node| node.has_ended)
    } else {
        nodes.iter().all(|node| node.has_ended && !node.comes_back)
    }
}
