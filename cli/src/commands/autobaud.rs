//! `cantap autobaud`: the bit rate of a bus, measured by listening only.

use std::io::{IsTerminal, Write};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::Channel;
use cantap::autobaud::{self, Limits, Outcome, Progress};

use crate::args;
use crate::completion;
use crate::one_board::OneBoard;
use crate::stderr;
use cantap_work::interrupt;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Nothing is sent and nothing acknowledged. The bits of one frame are measured; more frames at that bit rate \
                        confirm it.\n\nExamples:\n  cantap autobaud -d /dev/ttyACM0\n  \
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
    let outcome = autobaud::search(&device, args.channel, &limits, &mut progress)?;
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
        outcome => bail!("{}", failure(outcome, args.channel, seconds)),
    }
}

/// Why no bit rate was found, and what to do.
pub fn failure(outcome: Outcome, channel: Channel, seconds: f64) -> String {
    let channel = channel.number();
    match outcome {
        Outcome::NoTraffic => format!(
            "no traffic on channel {channel} in {seconds:.1} s; check the wiring, and that the bus is awake and has two nodes"
        ),
        Outcome::Stuck => format!(
            "the bus on channel {channel} is dominant all the time; look for a short circuit, swapped wires or a transceiver \
             without supply"
        ),
        Outcome::Unreadable { edges } => format!(
            "there is traffic on channel {channel} ({edges} edges), but not one whole frame: is it classical CAN, are the wires \
             swapped, is the termination right?"
        ),
        Outcome::Unreachable { measured_bps, nearest_bps } => {
            let nearest = nearest_bps.map_or_else(String::new, |nearest_bps| {
                let off = (f64::from(nearest_bps) / measured_bps - 1.0) * 100.0;
                format!("; the nearest, {nearest_bps} bit/s, is {off:+.1} % off and would lose frames")
            });
            format!(
                "the bus on channel {channel} runs at {measured_bps:.0} bit/s, and no rate that the device's clock reaches is near \
                 enough{nearest}"
            )
        }
        Outcome::Unconfirmed { bitrate_bps, measured_bps, acknowledged, errors } => {
            let why = if !acknowledged {
                "nobody acknowledges what is sent: is there a second node, and does it run at the same bit rate?"
            } else if errors > 0 {
                "check termination and wiring"
            } else {
                "try again when there is more traffic"
            };
            format!(
                "a bit on channel {channel} is one of {bitrate_bps} bit/s (measured: {measured_bps:.0}), but no good frame followed, and \
                 {errors} errors; {why}"
            )
        }
        Outcome::Stopped | Outcome::Found { .. } => "stopped before a bit rate was found".to_owned(),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_failure_says_what_was_found_and_what_to_do() {
        let told = |outcome| failure(outcome, Channel::Can2, 10.04);
        assert_eq!(
            told(Outcome::Unreachable { measured_bps: 615_384.3, nearest_bps: Some(600_000) }),
            "the bus on channel 2 runs at 615384 bit/s, and no rate that the device's clock reaches is near enough; the nearest, \
             600000 bit/s, is -2.5 % off and would lose frames"
        );
        assert!(told(Outcome::NoTraffic).starts_with("no traffic on channel 2 in 10.0 s; check the wiring"));
        assert!(told(Outcome::Stuck).contains("short circuit"));
        assert!(told(Outcome::Unreadable { edges: 7 }).contains("(7 edges)"));
        let unconfirmed = |acknowledged, errors| {
            told(Outcome::Unconfirmed { bitrate_bps: 500_000, measured_bps: 499_990.0, acknowledged, errors })
        };
        assert!(unconfirmed(false, 12).ends_with("does it run at the same bit rate?"));
        assert!(unconfirmed(true, 12).ends_with("check termination and wiring"));
        assert!(unconfirmed(true, 0).ends_with("when there is more traffic"));
    }
}
