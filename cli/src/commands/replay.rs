//! `cantap replay`: a trace on the bus again, at its own times.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::replay::{Pace, Replay};
use cantap::wire::CHANNELS;
use cantap::wire::message::Mode;
use cantap::{Address, Channel, Device, TraceEvent};

use crate::channel_args::{self, ChannelArgs};
use crate::input::ReadArgs;
use crate::sending::{BusWatch, Tally};
use crate::{args, interrupt};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "The device keeps the times: frames end as far apart as in the trace. Frames of channels that the device does \
                  not have, or that no mapping names, are left out.\n\nExamples:\n  \
                  cantap replay -d /dev/ttyACM0 -b 500k drive.log\n  \
                  cantap replay -d virtual -b 1M drive.blf --speed 2 -l 3 can0=can1"
)]
pub struct Args {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
    /// The trace; - for standard input.
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// Send what was captured on one channel on another, as canplayer: TO=FROM, such as can1=can0.
    #[arg(value_name = "TO=FROM", value_parser = mapping)]
    mapping: Vec<(Channel, u8)>,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    read: ReadArgs,
    /// Play so many times, or i for ever.
    #[arg(short, long = "loop", value_name = "N|i", default_value = "1", value_parser = rounds)]
    rounds: Rounds,
    /// Shorten pauses that are longer than this.
    #[arg(short, long, value_name = "TIME", value_parser = args::duration)]
    skip: Option<Duration>,
    /// Least time between two frames, in milliseconds.
    #[arg(short, long, value_name = "MS", default_value_t = 0.0, value_parser = milliseconds)]
    gap: f64,
    /// Ignore the trace's times: as fast as the bus takes it.
    #[arg(short = 't', long)]
    ignore_times: bool,
    /// Play faster (2) or slower (0.5).
    #[arg(long, default_value_t = 1.0, value_parser = speed)]
    speed: f64,
    /// End after so many frames.
    #[arg(short = 'n', long)]
    frames: Option<u64>,
    /// Print each frame that was sent.
    #[arg(short, long)]
    verbose: bool,
    /// Print one JSON object with the summary.
    #[arg(long, conflicts_with = "verbose")]
    json: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Rounds {
    Times(u32),
    ForEver,
}

fn rounds(text: &str) -> Result<Rounds, String> {
    match text {
        "i" => Ok(Rounds::ForEver),
        _ => text
            .parse()
            .ok()
            .filter(|times| *times > 0)
            .map(Rounds::Times)
            .ok_or_else(|| "write a number from 1, or i for ever".to_owned()),
    }
}

fn speed(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|speed| (0.001..=1000.0).contains(speed));
    value.ok_or_else(|| "write a factor from 0.001 to 1000; 2 is twice as fast".to_owned())
}

fn milliseconds(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|ms| (0.0..=3_600_000.0).contains(ms));
    value.ok_or_else(|| "write milliseconds, such as 1 or 0.5".to_owned())
}

fn mapping(text: &str) -> Result<(Channel, u8), String> {
    let wrong = || "write TO=FROM, such as can1=can0".to_owned();
    let (to, from) = text.split_once('=').ok_or_else(wrong)?;
    let from = from.strip_prefix("can").map_or_else(
        || from.parse::<u8>().ok(),
        |interface| interface.parse::<u8>().ok().and_then(|interface| interface.checked_add(1)),
    );
    Ok((channel_args::channel(to)?, from.filter(|from| *from > 0).ok_or_else(wrong)?))
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    // What is wrong with the file is found before anything is opened.
    if args.input.as_os_str() != "-" {
        drop(args.read.open(&args.input)?);
    } else if args.rounds != Rounds::Times(1) {
        bail!("standard input can be played once only; give a file to repeat it");
    }
    let device = Device::open(&args.device)?;
    let mut bitrates_bps = [0; CHANNELS];
    for (channel, config) in args.open.open(&device, args.channels().into_iter(), Mode::Normal, None)? {
        bitrates_bps[channel.index()] = config.timing.bitrate_bps(device.hello().can_clock_hz);
    }
    let pace = Pace {
        speed: args.speed,
        longest_gap: args.skip,
        shortest_gap: Duration::from_secs_f64(args.gap / 1e3),
        ignore_times: args.ignore_times,
    };
    let mut replay = Replay::new(&device, pace, bitrates_bps)?;
    let mut tally = Tally::new(!args.verbose);
    let mut bus = BusWatch::new(&device, args.open.rescue(&device));
    let (started, left_out) = (Instant::now(), args.play(&mut replay, &mut tally, &mut bus)?);
    // The last frames may be due long after the others.
    replay.finish(|_| bus.goes_on())?;
    tally.add(&replay.take_ended())?;
    let waiting = replay.under_way();
    let seconds = started.elapsed().as_secs_f64();
    device.stop()?;
    let accuracy = replay.accuracy();
    if args.json {
        writeln!(
            std::io::stdout(),
            "{}",
            serde_json::json!({
                "frames": tally.sent,
                "failed": tally.failed,
                "left_out": left_out,
                "seconds": seconds,
                "early_us": accuracy.early_us,
                "late_us": accuracy.late_us,
            })
        )?;
    } else {
        eprint!("cantap: {} frames in {seconds:.1} s", tally.sent);
        if left_out > 0 {
            eprint!(", {left_out} of other channels left out");
        }
        if accuracy.frames > 0 {
            eprint!(
                "; against the trace at most {:.1} us early, {:.1} us late",
                accuracy.early_us, accuracy.late_us
            );
        }
        eprintln!();
    }
    tally.verdict(if interrupt::requested() { 0 } else { waiting })?;
    Ok(ExitCode::SUCCESS)
}

impl Args {
    /// Channels that something may be sent on.
    fn channels(&self) -> Vec<Channel> {
        if self.mapping.is_empty() {
            return Channel::ALL.to_vec();
        }
        Channel::ALL.into_iter().filter(|channel| self.mapping.iter().any(|(to, _)| to == channel)).collect()
    }

    fn target(&self, from: u8) -> Option<Channel> {
        if self.mapping.is_empty() {
            return Channel::from_number(from);
        }
        self.mapping.iter().find(|(_, source)| *source == from).map(|(to, _)| *to)
    }

    /// Hands the trace to the device. Returns how many frames were left out.
    fn play(
        &self,
        replay: &mut Replay<'_>,
        tally: &mut Tally,
        bus: &mut BusWatch<'_>,
    ) -> anyhow::Result<u64> {
        let (mut pushed, mut left_out) = (0_u64, 0);
        // A round begins where the one before ended.
        let mut shift_ns = 0;
        let mut round = 0_u32;
        loop {
            let mut first_ns = None;
            let mut last_ns = 0;
            let mut records = self.read.open(&self.input)?;
            while let Some(record) = records.next()? {
                let TraceEvent::Frame { frame, .. } = record.event else {
                    continue;
                };
                let Some(channel) = self.target(record.channel) else {
                    left_out += 1;
                    continue;
                };
                if self.frames.is_some_and(|frames| pushed >= frames) {
                    return Ok(left_out);
                }
                let first_ns = *first_ns.get_or_insert(record.time_ns);
                last_ns = record.time_ns - first_ns + shift_ns;
                if !replay.push(last_ns, channel, frame, || bus.goes_on())? {
                    return Ok(left_out);
                }
                pushed += 1;
                let ends = replay.take_ended();
                bus.note(&ends);
                tally.add(&ends)?;
            }
            if first_ns.is_none() {
                bail!(
                    "'{}' has no frame to send; see `cantap replay --help` for channels",
                    self.input.display()
                );
            }
            round += 1;
            shift_ns = last_ns + 1_000_000;
            if self.rounds == Rounds::Times(round) {
                return Ok(left_out);
            }
        }
    }
}
