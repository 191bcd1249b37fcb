//! `cantap replay`: a trace on the bus again, at its own times.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::device::Transmission;
use cantap::replay::{Pace, Replay};
use cantap::wire::CHANNELS;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::{Address, Channel, Device, TraceEvent};

use crate::channel_args::{self, ChannelArgs};
use crate::input::ReadArgs;
use crate::sending::{self, BusWatch, Tally};
use crate::wrong::wrong;
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
    #[arg(value_name = "FILE", required_unless_present = "from")]
    input: Option<PathBuf>,
    /// The trace, as canplayer takes it.
    #[arg(short = 'I', value_name = "FILE")]
    from: Option<PathBuf>,
    /// Send what was captured on one channel on another, as canplayer: TO=FROM, such as can1=can0.
    #[arg(value_name = "TO=FROM", value_parser = mapping)]
    mapping: Vec<(Channel, u8)>,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    read: ReadArgs,
    /// Play so many times, or i for ever.
    #[arg(short = 'l', long = "loop", value_name = "N|i", default_value = "1", value_parser = rounds)]
    rounds: Rounds,
    /// Skip pauses that are longer than this.
    #[arg(short, long, value_name = "TIME", value_parser = args::duration)]
    skip: Option<Duration>,
    /// Least time between two frames, in milliseconds.
    #[arg(short, long, value_name = "MS", default_value_t = 0.0, value_parser = milliseconds)]
    gap: f64,
    /// Ignore the trace's times: as fast as the bus takes it, so that --gap, --skip and --speed have no meaning.
    #[arg(short = 't', long, conflicts_with_all = ["gap", "skip", "speed"])]
    ignore_times: bool,
    /// Play faster (2) or slower (0.5).
    #[arg(long, default_value_t = 1.0, value_parser = speed)]
    speed: f64,
    /// End after so many frames.
    #[arg(short = 'n', long, value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Wait for Enter before the first frame.
    #[arg(short, long)]
    interactive: bool,
    /// Accepted as canplayer's: what this device sends does not come back to other programs of this computer anyway.
    #[arg(short = 'x', hide = true)]
    no_loopback: bool,
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

/// The device's channels. One that nothing is sent on is never opened: it would acknowledge on a bus that is none of the
/// trace's business, perhaps at another bit rate.
struct Buses<'d> {
    device: &'d Device,
    /// Not opened yet, and how they will be.
    closed: Vec<(Channel, ChannelConfig)>,
}

impl Buses<'_> {
    /// Opens a channel before its first frame.
    fn open(&mut self, channel: Channel) -> anyhow::Result<()> {
        if let Some(at) = self.closed.iter().position(|(closed, _)| *closed == channel) {
            let (_, config) = self.closed.swap_remove(at);
            self.device
                .open_channel(channel, Some(config))
                .with_context(|| format!("channel {}", channel.number()))?;
        }
        Ok(())
    }
}

fn wait_for_enter() -> anyhow::Result<()> {
    eprintln!("cantap: press Enter to start");
    std::io::stdin().read_line(&mut String::new()).context("standard input cannot be read")?;
    Ok(())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let source = args.source()?;
    // What is wrong with the file is found before anything is opened.
    if source.input.as_os_str() != "-" {
        drop(args.read.open(&source.input)?);
    } else if args.rounds != Rounds::Times(1) {
        bail!("standard input can be played once only; give a file to repeat it");
    } else if args.interactive {
        bail!("standard input cannot bring both the trace and Enter; give a file with --interactive");
    }
    let device = Device::open(&args.device)?;
    let mut bitrates_bps = [0; CHANNELS];
    let mut buses =
        Buses { device: &device, closed: args.open.configs(&device, source.channels(), Mode::Normal)? };
    for (channel, config) in &buses.closed {
        bitrates_bps[channel.index()] = config.timing.bitrate_bps(device.hello().can_clock_hz);
    }
    if args.interactive {
        wait_for_enter()?;
    }
    let pace = Pace {
        speed: args.speed,
        longest_gap: args.skip,
        shortest_gap: Duration::from_secs_f64(args.gap / 1e3),
        burst: 1,
        ignore_times: args.ignore_times,
    };
    let mut replay = Replay::new(&device, pace, bitrates_bps)?;
    let mut tally = Tally::new(!args.verbose);
    let mut bus = BusWatch::new(&device, args.open.rescue(&device));
    let (started, left_out) =
        (Instant::now(), args.play(&source, &mut replay, &mut tally, &mut bus, &mut buses)?);
    // The last frames may be due long after the others.
    sending::see_out(&mut replay, &mut tally, &mut bus)?;
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

/// What is played, and where to.
struct Source {
    input: PathBuf,
    mapping: Vec<(Channel, u8)>,
}

impl Source {
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
}

impl Args {
    fn source(&self) -> anyhow::Result<Source> {
        let mut mapping = self.mapping.clone();
        let input = match (&self.from, &self.input) {
            (Some(from), first) => {
                // With -I the first word is a mapping too.
                if let Some(word) = first {
                    mapping.insert(0, self::mapping(&word.to_string_lossy()).map_err(wrong)?);
                }
                from.clone()
            }
            (None, Some(input)) => input.clone(),
            (None, None) => PathBuf::from("-"),
        };
        let repeated = mapping
            .iter()
            .enumerate()
            .find(|(at, (_, from))| mapping[..*at].iter().any(|(_, earlier)| earlier == from));
        if let Some((_, (_, from))) = repeated {
            let interface = from - 1;
            return Err(wrong(format!(
                "can{interface} is mapped twice, and each frame is sent once; give one TO=can{interface}"
            )));
        }
        Ok(Source { input, mapping })
    }

    /// Hands the trace to the device. Returns how many frames were left out.
    fn play(
        &self,
        source: &Source,
        replay: &mut Replay<'_>,
        tally: &mut Tally,
        bus: &mut BusWatch<'_>,
        buses: &mut Buses<'_>,
    ) -> anyhow::Result<u64> {
        let (mut pushed, mut left_out) = (0_u64, 0);
        // A round begins where the one before ended.
        let mut shift_ns = 0;
        let mut round = 0_u32;
        loop {
            let mut first_ns = None;
            let mut last_ns = 0;
            let mut records = self.read.open(&source.input)?;
            while let Some(record) = records.next()? {
                let TraceEvent::Frame { frame, .. } = record.event else {
                    continue;
                };
                let Some(channel) = source.target(record.channel) else {
                    left_out += 1;
                    continue;
                };
                if self.frames.is_some_and(|frames| pushed >= frames) {
                    return Ok(left_out);
                }
                buses.open(channel)?;
                let first_ns = *first_ns.get_or_insert(record.time_ns);
                last_ns = record.time_ns - first_ns + shift_ns;
                let mut told = Ok(());
                let go_on = |ends: Vec<Transmission>| {
                    bus.note(&ends);
                    told = tally.add(&ends);
                    told.is_ok() && bus.goes_on()
                };
                let goes_on = replay.push(last_ns, channel, frame, go_on)?;
                told?;
                if !goes_on {
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
                    source.input.display()
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
