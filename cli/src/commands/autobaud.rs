//! `cantap autobaud`: the bit rate of a bus, found by listening only.

use std::io::{IsTerminal, Write};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::Channel;
use cantap::autobaud::{self, Limits, Outcome, Progress};

use crate::boards::OneBoard;
use crate::completion;
use crate::{args, interrupt};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Nothing is sent and nothing acknowledged.\n\nExamples:\n  cantap autobaud -d /dev/ttyACM0\n  \
                        cantap autobaud -d virtual:bitrate=125k -c 2 --json"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// Which channel: 1 or 2.
    #[arg(short, long, default_value = "1", value_parser = args::channel, add = completion::channel())]
    channel: Channel,
    /// Give up after this time without any sign of traffic, but not before each common rate was tried once.
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
    let limits = Limits { silence: args.time, ..Limits::default() };
    let outcome = autobaud::search(&device, args.channel, &limits, &mut progress)?;
    if shown {
        eprint!("\r\x1b[K");
    }
    let seconds = started.elapsed().as_secs_f64();
    match outcome {
        Outcome::Found { bitrate_bps, timing, frames } => {
            let mut out = std::io::stdout().lock();
            if args.json {
                let object = serde_json::json!({
                    "channel": args.channel.number(),
                    "bitrate_bps": bitrate_bps,
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
        Outcome::NoTraffic => bail!(
            "no traffic on channel {} in {seconds:.1} s; check the wiring, and that the bus is awake and has two nodes",
            args.channel.number()
        ),
        Outcome::NoMatch { about_bps: Some(bps), .. } => bail!(
            "the bus on channel {} runs at about {bps:.0} bit/s, and no rate that the device's clock reaches is near \
             enough",
            args.channel.number()
        ),
        Outcome::NoMatch { errors, .. } => bail!(
            "there is traffic on channel {}, but no bit rate fits ({errors} errors): is it classical CAN, are the wires \
             swapped, is the termination right?",
            args.channel.number()
        ),
        Outcome::Stopped => bail!("stopped before a bit rate was found"),
    }
}

fn show(progress: Progress) {
    match progress {
        Progress::Common { bitrate_bps, at, of } => {
            eprint!("\r\x1b[Kcommon rates {}/{of}: {bitrate_bps} bit/s", at + 1);
        }
        Progress::Scan { bitrate_bps, at, of } => {
            eprint!("\r\x1b[Kall rates {}/{of}: {bitrate_bps} bit/s", at + 1);
        }
        Progress::Checking { bitrate_bps } => eprint!("\r\x1b[Kframes at {bitrate_bps} bit/s, making sure"),
    }
}
