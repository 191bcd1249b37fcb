//! `cantap selftest`: tests what a board can show on its own, with a single command, and makes a report to
//! send in.

mod buses;
mod patience;
mod report;
mod steps;
mod traffic;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use cantap::{Channel, Device};
use cantap_address::{Address, OpenDevice};

use self::report::{Lines, Outcome, Report};
use crate::one_board::OneBoard;
use crate::{args, exit};
use cantap_work::atomic_file;
use cantap_work::interrupt;

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

/// Bit rates at which frames are sent.
const BITRATES_BPS: [u32; 4] = [1_000_000, 500_000, 250_000, 125_000];

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let address = args.device.address()?;
    let device = address.open()?;
    let lines = if args.json { Lines::Kept } else { Lines::Shown { is_kept: args.report.is_some() } };
    let mut report = Report::new(&address, &device, lines);
    test(args, &address, &device, &mut report);
    let serial = device.hello().serial.as_str().to_owned();
    restart(args, &address, device, &serial, &mut report);
    report.finish();
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

/// All steps except the restart.
fn test(args: &Args, address: &Address, device: &Device, report: &mut Report) {
    // If something is wrong with it, that shows when it is read again.
    let saved = steps::saved(device).unwrap_or_default();
    report.step("identity", || Ok(steps::identity(device.hello())));
    report.step("USB", || steps::usb(address, device.hello()));
    report.step("round trips", || steps::round_trips(device));
    for channel in Channel::ALL {
        report.step(&format!("channel {} listens", channel.number()), || buses::listen(device, channel));
    }
    for channel in Channel::ALL {
        for bitrate_bps in BITRATES_BPS {
            let name = format!("channel {} by itself, {bitrate_bps} bit/s", channel.number());
            report.step(&name, || buses::alone(device, channel, bitrate_bps));
        }
    }
    for channel in Channel::ALL {
        let name = format!("channel {} transmit queue", channel.number());
        report.step(&name, || buses::fill_queue(device, channel));
    }
    report.step("both channels saturated, each by itself", || buses::saturate(device, false, args.load_time));
    if args.looped {
        for bitrate_bps in BITRATES_BPS {
            report.step(&format!("channel 1 to channel 2 and back, {bitrate_bps} bit/s"), || {
                buses::cross(device, bitrate_bps)
            });
        }
        for sender in Channel::ALL {
            let name = format!("channel {} without an acknowledgement", sender.number());
            report.step(&name, || buses::unacknowledged(device, sender));
        }
        report.step("both channels saturate one bus", || buses::saturate(device, true, args.load_time));
    } else {
        report.step("channel 1 to channel 2", || {
            Ok(Outcome::Skip("they are not said to be wired to each other (--loop)".to_owned()))
        });
    }
    report.step("clock", || steps::clock(address, device));
    report.step("saved settings untouched", || {
        let now = steps::saved(device)?;
        Ok(steps::compare_saved(&saved, &now))
    });
}

fn restart(args: &Args, address: &Address, device: OpenDevice, serial: &str, report: &mut Report) {
    report.step("restart", move || match (args.restart, address.may_come_back()) {
        (false, _) => Ok(Outcome::Skip("it was not asked for (--restart)".to_owned())),
        (true, true) => steps::restart(address, device, serial),
        (true, false) => {
            Ok(Outcome::Skip("this device lives in this process, and would end with it".to_owned()))
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_virtual::{Options, start};
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    /// How often each channel put a dominant level on its bus.
    fn driven(line: &str, options: &str) -> [u64; 2] {
        let args = Line::parse_from(
            ["x", "-d", "virtual", "--load-time", "100ms"].into_iter().chain(line.split_whitespace()),
        )
        .args;
        let connection = start(options.parse::<Options>().unwrap()).unwrap();
        let witness = std::sync::Arc::clone(&connection.witness);
        let device = Device::over(connection.into_link(), "virtual").unwrap();
        let address = args.device.address().unwrap();
        test(&args, &address, &device, &mut Report::new(&address, &device, Lines::Kept));
        witness.activity().driven
    }

    #[test]
    fn nothing_is_driven_unless_a_loop_is_asked_for() {
        assert_eq!(driven("", "load=20"), [0, 0]);
        let [first, second] = driven("--loop", "load=0,wire=joined,ack=no");
        assert!(first > 500 && second > 500, "{first}, {second}");
    }
}
