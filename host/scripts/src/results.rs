//! What a run collects for its report.

use std::collections::{BTreeMap, VecDeque};

use cantap_can::{Channel, Frame};

use crate::exchange::Output;
use crate::node::Node;
use crate::report::{Message, Outcome, Report, TestResult};

/// How many of the last frames go with a failure.
const TRACE: usize = 40;

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
}

impl Results {
    /// A frame was on the bus.
    pub fn frame(&mut self, at_ns: u64, channel: Channel, frame: Frame) {
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
            Output::TestBegan(name) => {
                self.tests.insert(script.to_owned(), name);
                None
            }
            Output::Test { name, outcome, began_ns } => {
                self.tests.remove(script);
                let trace = if outcome == Outcome::Passed { Vec::new() } else { self.trace() };
                let script = script.to_owned();
                self.report.tests.push(TestResult {
                    script,
                    name,
                    outcome,
                    began_ns,
                    ended_ns: now_ns,
                    trace,
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

    /// The last frames, each as a line of candump's log format.
    pub fn trace(&self) -> Vec<String> {
        let line = |(at_ns, channel, frame): &(u64, Channel, Frame)| {
            format!(
                "({}.{:06}) can{} {frame}",
                at_ns / 1_000_000_000,
                at_ns / 1000 % 1_000_000,
                channel.index()
            )
        };
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
                });
            }
        }
        let errors = nodes.iter().filter_map(|node| Some((node.name.clone(), node.error.clone()?)));
        self.report.errors.extend(errors);
        self.report
    }
}

/// Whether a run is over: every script with tests has ended, or, if none has tests, every script has.
pub fn is_over(nodes: &[Node]) -> bool {
    let mut deciding = nodes.iter().filter(|node| !node.tests.is_empty()).peekable();
    if deciding.peek().is_some() {
        deciding.all(|node| node.has_ended)
    } else {
        nodes.iter().all(|node| node.has_ended)
    }
}
