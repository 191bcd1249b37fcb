//! The results, line by line and as one object.

use std::fmt::Write;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use cantap::Device;
use serde_json::{Value, json};

use cantap_address::Address;

/// The result of a step.
#[derive(Clone, Debug)]
pub enum Outcome {
    /// As expected: what was seen, and the figures.
    Pass(String, Value),
    /// Not as expected: what was seen, and the figures.
    Fail(String, Value),
    /// Not tried, with the reason.
    Skip(String),
}

impl Outcome {
    /// A pass if `holds` is true.
    pub fn of(holds: bool, says: String, measured: Value) -> Self {
        if holds { Self::Pass(says, measured) } else { Self::Fail(says, measured) }
    }
}

#[derive(serde::Serialize)]
struct Step {
    name: String,
    outcome: &'static str,
    says: String,
    measured: Value,
}

/// The report for readers elsewhere.
#[derive(serde::Serialize)]
pub struct Report {
    cantap: &'static str,
    host: String,
    time_s: u64,
    device: String,
    board: String,
    serial_number: String,
    firmware: String,
    protocol: u16,
    steps: Vec<Step>,
    seconds: f64,
    passed: bool,
    #[serde(skip)]
    started: Instant,
    #[serde(skip)]
    shown: bool,
}

impl Report {
    /// Nothing has been tested yet; if `shown`, each step is printed as it ends.
    pub fn new(address: &Address, device: &Device, shown: bool) -> Self {
        let hello = device.hello();
        let [major, minor, patch] = hello.firmware;
        let report = Self {
            cantap: env!("CARGO_PKG_VERSION"),
            host: host(),
            time_s: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs()),
            device: address.to_string(),
            board: hello.board.as_str().to_owned(),
            serial_number: hello.serial.as_str().to_owned(),
            firmware: format!("{major}.{minor}.{patch}"),
            protocol: hello.protocol,
            steps: Vec::new(),
            seconds: 0.0,
            passed: false,
            started: Instant::now(),
            shown,
        };
        report.show(&report.head());
        report
    }

    /// Performs a step. An error is a failure, and the next step is still tried.
    pub fn step(&mut self, name: &str, act: impl FnOnce() -> anyhow::Result<Outcome>) {
        let outcome =
            act().unwrap_or_else(|error| Outcome::Fail(crate::advice::sentence(&error), Value::Null));
        let (outcome, says, measured) = match outcome {
            Outcome::Pass(says, measured) => ("pass", says, measured),
            Outcome::Fail(says, measured) => ("FAIL", says, measured),
            Outcome::Skip(says) => ("skip", says, Value::Null),
        };
        let step = Step { name: name.to_owned(), outcome, says, measured };
        self.show(&line(&step));
        self.steps.push(step);
    }

    /// Prints the result.
    pub fn finish(&mut self) {
        self.seconds = cantap_work::rounded(self.started.elapsed().as_secs_f64(), 1);
        self.passed = self.count("FAIL") == 0;
        self.show(&self.tail());
    }

    /// Whether no step failed.
    pub const fn has_passed(&self) -> bool {
        self.passed
    }

    /// The whole report: the lines, followed by the object.
    pub fn text(&self) -> serde_json::Result<String> {
        let mut text = self.head();
        for step in &self.steps {
            text.push_str(&line(step));
        }
        text.push_str(&self.tail());
        text.push('\n');
        text.push_str(&serde_json::to_string_pretty(&json!(self))?);
        text.push('\n');
        Ok(text)
    }

    fn show(&self, text: &str) {
        if self.shown {
            print!("{text}");
        }
    }

    fn count(&self, outcome: &str) -> usize {
        self.steps.iter().filter(|step| step.outcome == outcome).count()
    }

    fn head(&self) -> String {
        let Self { cantap, host, device, board, serial_number, firmware, protocol, .. } = self;
        format!(
            "cantap {cantap} on {host}\n{board} {serial_number} at {device}, firmware {firmware}, protocol {protocol}\n\n"
        )
    }

    fn tail(&self) -> String {
        let mut text = String::new();
        let (passed, failed, skipped) = (self.count("pass"), self.count("FAIL"), self.count("skip"));
        let _ = writeln!(text, "\n{passed} passed, {failed} failed, {skipped} skipped, {} s", self.seconds);
        text
    }
}

fn line(step: &Step) -> String {
    format!("{}  {}: {}\n", step.outcome, step.name, step.says)
}

/// This computer's operating system.
fn host() -> String {
    let (system, machine) = (std::env::consts::OS, std::env::consts::ARCH);
    // Linux provides its release as text.
    match std::fs::read_to_string("/proc/sys/kernel/osrelease") {
        Ok(release) => format!("{system} {} {machine}", release.trim()),
        Err(_) => format!("{system} {machine}"),
    }
}
