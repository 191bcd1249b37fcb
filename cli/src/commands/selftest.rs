//! `cantap selftest`: tests what a board can show on its own, with a single command, and makes a report to
//! send in.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use cantap_work::selftest::{Patience, Report, ReportLines, TestPlan, run as test};
use cantap_work::{atomic_file, interrupt};

use crate::one_board::OneBoard;
use crate::{args, exit};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Without --loop no channel puts a dominant bit on its bus, whatever is connected: channels only listen, \
                or play with themselves inside the controller. With --loop both channels send, so that nothing else may \
                be connected: channel 1 to channel 2, CANH to CANH, CANL to CANL, and 120 ohms at each end. A step \
                passes, fails, or is skipped with the reason. Exit code 3 if one fails. What to do by hand besides is \
                in docs/bring-up.md. Ctrl-C ends the test with what was tried so far.\n\n\
                Examples:\n  \
                cantap selftest -d /dev/ttyACM0 --report board.txt\n  \
                cantap selftest -d COM5 --loop --load-time 1m\n  \
                cantap selftest -d virtual:wire=joined,load=0,ack=no --loop --json"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// Channel 1 is wired to channel 2 and nothing else: both take part in the bus and send.
    #[arg(long = "loop")]
    looped: bool,
    /// How long each saturating load lasts, as 5s or 2m.
    #[arg(long, alias = "seconds", value_name = "TIME", default_value = "5s", value_parser = args::positive_duration)]
    load_time: Duration,
    /// Restart the firmware at the end, and wait for it to come back.
    #[arg(long)]
    restart: bool,
    /// Write the report to this file: the lines, followed by the JSON object.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let address = args.device.address()?;
    let device = address.open()?;
    let shown = ReportLines::Shown { out: Box::new(std::io::stdout()), is_kept: args.report.is_some() };
    let lines = if args.json { ReportLines::Kept } else { shown };
    let mut report = Report::new(&address, &device, lines, Patience::until(interrupt::requested));
    let plan = TestPlan { has_loop: args.looped, load_time: args.load_time, restarts: args.restart };
    test(plan, &address, device, &mut report);
    if let Some(path) = &args.report {
        atomic_file::write(path, report.text()?.as_bytes())
            .with_context(|| format!("'{}' cannot be written; choose another place", path.display()))?;
    }
    if args.json {
        writeln!(std::io::stdout(), "{}", serde_json::to_string(&report)?)?;
    }
    let code = match (report.has_passed(), report.was_cut_short()) {
        (true, _) => ExitCode::SUCCESS,
        (false, true) => ExitCode::from(interrupt::ENDED_BY_SIGNAL),
        (false, false) => ExitCode::from(exit::CHECK_FAILED),
    };
    report.output_error().map_or(Ok(code), |error| Err(error.into()))
}
