//! `cantap doctor`: what is the matter with a port, a board or a bus, and what to do next.

use std::fmt::Write as _;
use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use cantap_address::Address;
use cantap_trace::clean;
use cantap_work::channels::Channels;
use cantap_work::doctor::{Check, Examination, Verdict, examine};
use cantap_work::interrupt;
use cantap_work::requested_rate::RequestedRate;

use crate::{args, completion, exit};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "From the port (is it there, who may open it, who has it open, does ModemManager keep away) by way of the board to \
                its buses. Channels only listen: nothing is sent and nothing acknowledged. A channel without -b uses the bit rate \
                that is known of its bus or saved on the device, or finds it by listening. A silent bus is a problem only if all \
                channels are silent. Exit code 3 if there is a problem.\n\n\
                Examples:\n  \
                cantap doctor\n  \
                cantap doctor -d /dev/ttyACM0 -b 500k\n  \
                cantap doctor -d virtual --json"
)]
pub struct Args {
    /// Where the device is: a serial port, or virtual. Without it, the board that is connected, if there is one.
    #[arg(short, long, add = completion::devices())]
    device: Option<Address>,
    /// Which channels: 1, 2 or both.
    #[arg(short, long, default_value = "both", value_parser = args::channels_of_one, add = completion::channels())]
    channel: Channels,
    /// Bit rate of the bus in bit/s: 500000, 500k, 1M; or auto, to find it by listening; with a channel before it (2:250k), only
    /// for that channel. Can be repeated.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", add = completion::bit_rates())]
    bitrates: Vec<RequestedRate>,
    /// How long to listen to each channel, as 2s or 500ms.
    #[arg(short, long, default_value = "2s", value_parser = args::positive_duration)]
    time: Duration,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Columns before what was found.
const INDENT: usize = 26;

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let examination = Examination {
        address: args.device.clone(),
        channels: args.channel.clone(),
        bitrates: args.bitrates.clone(),
        time: args.time,
    };
    let mut checks: Vec<Check> = Vec::new();
    let mut written = Ok(());
    examine(&examination, &mut |check| {
        if !args.json && written.is_ok() {
            written = writeln!(std::io::stdout(), "{}", text(&check));
        }
        checks.push(check);
    })?;
    written?;
    let problems = checks.iter().filter(|check| check.outcome == Verdict::Problem).count();
    if args.json {
        let device = args.device.as_ref().map(ToString::to_string);
        let object = serde_json::json!({ "device": device, "checks": checks, "problems": problems });
        writeln!(std::io::stdout(), "{object}")?;
    }
    Ok(match (problems, interrupt::requested()) {
        (0, true) => ExitCode::from(interrupt::ENDED_BY_SIGNAL),
        (0, false) => ExitCode::SUCCESS,
        _ => ExitCode::from(exit::CHECK_FAILED),
    })
}

/// A check in lines: what was found, then what to do.
fn text(check: &Check) -> String {
    let outcome = match check.outcome {
        Verdict::Ok => "ok",
        Verdict::Note => "note",
        Verdict::Problem => "PROBLEM",
        Verdict::Skipped => "skipped",
    };
    let subject = match check.channel {
        Some(number) => format!("{} {number}", check.check),
        None => check.check.to_owned(),
    };
    let mut text = format!("{outcome:<9}{subject:<width$}{}", clean::line(&check.found), width = INDENT - 9);
    for (number, line) in check.next.iter().flat_map(|next| next.lines()).enumerate() {
        let label = if number == 0 { "next: " } else { "  " };
        // Writing to a text cannot fail.
        let _ = write!(text, "\n{:INDENT$}{label}{}", "", clean::line(line));
    }
    text
}
