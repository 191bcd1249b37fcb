//! The results, line by line and as one object.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use cantap::{Device, DeviceError};
use serde_json::{Value, json};

use super::patience::{BusyWatch, Interrupted, Patience};
use cantap_address::Address;

/// The result of a step.
#[derive(Clone, Debug)]
pub enum StepOutcome {
    /// As expected: what was seen, and the figures.
    Pass(String, Value),
    /// Not as expected: what was seen, and the figures.
    Fail(String, Value),
    /// Not tried, with the reason.
    Skip(String),
}

impl StepOutcome {
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
    /// Whether Ctrl-C ended it before all steps were tried.
    interrupted: bool,
    passed: bool,
    #[serde(skip)]
    started: Instant,
    #[serde(skip)]
    lines: ReportLines,
    #[serde(skip)]
    patience: Patience,
    #[serde(skip)]
    busy: BusyWatch,
    /// The step in which the connection was lost.
    #[serde(skip)]
    lost_in: Option<String>,
}

/// Where the lines go as the steps end.
pub enum ReportLines {
    /// Nowhere: they are wanted at the end, or as an object.
    Kept,
    /// To an output. Nobody may read it any more; the report is made even so if it goes elsewhere, too.
    Shown {
        /// The output.
        out: Box<dyn Write + Send>,
        /// Whether the report also goes elsewhere.
        is_kept: bool,
    },
    /// The output failed.
    Failed {
        /// Whether the report also goes elsewhere.
        is_kept: bool,
        /// How.
        error: io::Error,
    },
}

impl Report {
    /// Nothing has been tested yet.
    pub fn new(address: &Address, device: &Device, lines: ReportLines, patience: Patience) -> Self {
        let hello = device.hello();
        let [major, minor, patch] = hello.firmware;
        let mut report = Self {
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
            interrupted: false,
            passed: false,
            started: Instant::now(),
            lines,
            patience,
            busy: BusyWatch::start(),
            lost_in: None,
        };
        report.show(&report.head());
        report
    }

    /// Performs a step. An error is a failure, and the next step is still tried: unless there is no connection any more, which is one
    /// failure, or Ctrl-C was pressed, or nobody wants the report.
    pub(super) fn step(&mut self, name: &str, act: impl FnOnce(&Patience) -> anyhow::Result<StepOutcome>) {
        if self.interrupted || self.patience.is_over() {
            self.interrupted = true;
            return;
        }
        if matches!(self.lines, ReportLines::Failed { is_kept: false, .. }) {
            return;
        }
        self.busy.take_too_busy();
        let outcome = match &self.lost_in {
            Some(step) => Ok(StepOutcome::Skip(format!("the connection was lost in the step '{step}'"))),
            None => act(&self.patience),
        };
        let outcome = match outcome {
            Err(error) if error.is::<Interrupted>() => {
                self.interrupted = true;
                StepOutcome::Skip("Ctrl-C ended it".to_owned())
            }
            Err(error) => {
                if error.downcast_ref().is_some_and(ends_connection) {
                    self.lost_in = Some(name.to_owned());
                }
                match self.excuse() {
                    // No advice on what to do with the board.
                    Some(excuse) => StepOutcome::Fail(format!("{error:#}{excuse}"), Value::Null),
                    None => StepOutcome::Fail(crate::advice::sentence(&error), Value::Null),
                }
            }
            Ok(StepOutcome::Fail(says, measured)) => {
                StepOutcome::Fail(says + self.excuse().unwrap_or_default().as_str(), measured)
            }
            Ok(outcome) => outcome,
        };
        let (outcome, says, measured) = match outcome {
            StepOutcome::Pass(says, measured) => ("pass", says, measured),
            StepOutcome::Fail(says, measured) => ("FAIL", says, measured),
            StepOutcome::Skip(says) => ("skip", says, Value::Null),
        };
        let step = Step { name: name.to_owned(), outcome, says, measured };
        self.show(&line(&step));
        self.steps.push(step);
    }

    /// Why a failure in this step may not be the board's.
    fn excuse(&self) -> Option<String> {
        let held_up = self.busy.take_too_busy()?;
        Some(format!(
            "; this computer was too busy meanwhile, and held this program up for {:.1} s, so this may not be the board: close \
             other programs and test again",
            held_up.as_secs_f64()
        ))
    }

    /// Prints the result.
    pub(super) fn finish(&mut self) {
        self.seconds = crate::rounded(self.started.elapsed().as_secs_f64(), 1);
        self.passed = self.count("FAIL") == 0 && !self.interrupted;
        self.show(&self.tail());
    }

    /// Whether Ctrl-C ended it before all steps were tried, and none had failed by then.
    pub fn was_cut_short(&self) -> bool {
        self.interrupted && self.count("FAIL") == 0
    }

    /// How the output failed, if it did.
    pub fn output_error(self) -> Option<io::Error> {
        match self.lines {
            // `cantap … | head` has read enough, and the file has all of it.
            ReportLines::Failed { is_kept: true, error } if error.kind() == io::ErrorKind::BrokenPipe => None,
            ReportLines::Failed { error, .. } => Some(error),
            _ => None,
        }
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

    fn show(&mut self, text: &str) {
        let ReportLines::Shown { out, is_kept } = &mut self.lines else { return };
        let is_kept = *is_kept;
        if let Err(error) = out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
            self.lines = ReportLines::Failed { is_kept, error };
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
        let end = if self.interrupted { "; Ctrl-C ended it, and not all steps were tried" } else { "" };
        let _ =
            writeln!(text, "\n{passed} passed, {failed} failed, {skipped} skipped, {} s{end}", self.seconds);
        text
    }
}

/// Whether no later request can succeed.
const fn ends_connection(error: &DeviceError) -> bool {
    matches!(
        error,
        DeviceError::Vanished { .. } | DeviceError::Silent { .. } | DeviceError::SessionEnded { .. }
    )
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn silent() -> anyhow::Error {
        DeviceError::Silent { address: "/dev/ttyACM0".to_owned(), seconds: 1.4 }.into()
    }

    /// The lines of a report in which one step fails, with a computer that holds the program up for this long meanwhile.
    fn lines(held_up: Duration, error: impl FnOnce() -> anyhow::Result<StepOutcome>) -> String {
        let address: Address = "virtual:load=0".parse().unwrap();
        let device = address.open().unwrap();
        let mut report = Report::new(&address, &device, ReportLines::Kept, Patience::endless());
        let computer = report.busy.busy_computer();
        report.step("round trips", |_| {
            computer(held_up);
            error()
        });
        report.step("clock", |_| Ok(StepOutcome::Pass("steady".to_owned(), Value::Null)));
        report.steps.iter().map(line).collect()
    }

    #[test]
    fn a_busy_computer_is_named_and_nobody_is_sent_to_the_cable() {
        let busy = lines(Duration::from_millis(800), || Err(silent()));
        assert!(
            busy.starts_with("FAIL  round trips: the device at '/dev/ttyACM0' has answered nothing"),
            "{busy}"
        );
        assert!(
            busy.contains("; this computer was too busy meanwhile, and held this program up for "),
            "{busy}"
        );
        assert!(!busy.contains("unplug"), "{busy}");
        let busy =
            lines(Duration::from_millis(800), || Ok(StepOutcome::Fail("99 of 100".to_owned(), Value::Null)));
        assert!(busy.starts_with("FAIL  round trips: 99 of 100; this computer was too busy"), "{busy}");
        assert!(busy.ends_with("pass  clock: steady\n"), "{busy}");
    }

    #[test]
    fn a_lost_connection_is_one_failure() {
        let lost = lines(Duration::ZERO, || Err(silent()));
        assert_eq!(lost.matches("FAIL").count(), 1, "{lost}");
        assert!(lost.ends_with("skip  clock: the connection was lost in the step 'round trips'\n"), "{lost}");
        let refused = lines(Duration::ZERO, || Err(DeviceError::Timeout { seconds: 2.0 }.into()));
        assert!(refused.ends_with("pass  clock: steady\n"), "{refused}");
    }
}
