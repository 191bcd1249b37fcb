//! `cantap autobaud`: the bit rate of a bus, measured by listening only.

use std::io::{IsTerminal, Write};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::Channel;
use cantap::autobaud::{Limits, Outcome, Progress};

use crate::args;
use crate::completion;
use crate::one_board::OneBoard;
use crate::stderr;
use cantap_work::bit_rate_search::{failure, measure};
use cantap_work::interrupt;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Nothing is sent and nothing acknowledged. The bits of one frame are measured; more frames at that bit rate \
                        confirm it. It is remembered for the device's channel; -b auto finds it in every command.\n\nExamples:\n  cantap autobaud -d /dev/ttyACM0\n  \
                        cantap autobaud -d virtual:bitrate=125k -c 2 --json"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// Which channel: 1 or 2.
    #[arg(short, long, default_value = "1", value_parser = args::channel, add = completion::channel())]
    channel: Channel,
    /// Give up after this time without anything new on the bus.
    #[arg(short, long, alias = "timeout", default_value = "10s", value_name = "TIME", value_parser = args::positive_duration)]
    time: Duration,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let device = args.device.open()?;
    let started = Instant::now();
    let shown = std::io::stderr().is_terminal();
    let mut progress = |progress: Progress| {
        if shown {
            show(progress);
        }
        !interrupt::requested()
    };
    let limits = Limits { silence: args.time };
    let outcome = measure(&device, args.channel, &limits, &mut progress)?;
    if shown {
        stderr::replace_line("");
    }
    let seconds = started.elapsed().as_secs_f64();
    match outcome {
        Outcome::Found { bitrate_bps, measured_bps, timing, frames } => {
            let mut out = std::io::stdout().lock();
            if args.json {
                let object = serde_json::json!({
                    "channel": args.channel.number(),
                    "bitrate_bps": bitrate_bps,
                    "measured_bps": measured_bps,
                    "frames": frames,
                    "sample_point_pct": f64::from(timing.sample_point_permille()) / 10.0,
                    "segments": [u16::from(timing.segment1), u16::from(timing.segment2)],
                    "prescaler": timing.prescaler,
                    "sjw": timing.jump_width,
                    "seconds": seconds,
                });
                writeln!(out, "{object}")?;
            } else {
                writeln!(out, "{bitrate_bps} bit/s, {frames} good frames, after {seconds:.2} s")?;
            }
            Ok(ExitCode::SUCCESS)
        }
        outcome => bail!("{}", failure(outcome, args.channel.number(), seconds)),
    }
}

fn show(progress: Progress) {
    match progress {
        Progress::Measuring { edges: 0 } => stderr::replace_line("waiting for traffic"),
        Progress::Measuring { edges } => stderr::replace_line(&format!("measuring bits, {edges} edges")),
        Progress::Confirming { bitrate_bps, frames } => {
            stderr::replace_line(&format!("{bitrate_bps} bit/s measured; good frames at it: {frames}"));
        }
    }
}
