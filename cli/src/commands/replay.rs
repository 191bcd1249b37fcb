//! `cantap replay`: plays a trace on the bus again, with its original timing.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::replay::{Pace, Replay};
use cantap::wire::CHANNELS;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::{Channel, Device, TraceEvent};

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::database_args::DatabaseArgs;
use crate::input::FollowArgs;
use crate::one_board::OneBoard;
use crate::print_sent::print_sent;
use crate::stderr;
use crate::usage_error::usage;
use cantap_trace::counted;
use cantap_trace::filter::Filter;
use cantap_trace::grammar;
use cantap_work::interrupt;
use cantap_work::missing::Missing;
use cantap_work::rounded;
use cantap_work::sending::Sending;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "The device keeps the times: frames end as far apart as in the trace. Frames of channels that the device does \
                  not have, or that no mapping names, are left out. When frames that are due do not leave for a second, it ends \
                  and says why; with --json as reason.\n\nExamples:\n  \
                  cantap replay -d /dev/ttyACM0 -b 500k drive.log\n  \
                  cantap replay -d virtual -b 1M drive.blf --speed 2 -l 3 can0=can1"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// The trace; - for standard input.
    #[arg(value_name = "FILE", required_unless_present = "from")]
    input: Option<PathBuf>,
    /// The trace, as an option for compatibility with canplayer.
    #[arg(short = 'I', value_name = "FILE")]
    from: Option<PathBuf>,
    /// Send what was captured on one channel on another, as with canplayer: TO=FROM, such as can1=can0.
    #[arg(value_name = "TO=FROM", value_parser = mapping)]
    mapping: Vec<(Channel, u8)>,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    read: FollowArgs,
    /// Play this many times, or i for ever.
    #[arg(short = 'l', long = "loop", value_name = "N|i", default_value = "1", value_parser = rounds)]
    rounds: Rounds,
    /// Skip pauses longer than this.
    #[arg(short, long, value_name = "TIME", value_parser = args::duration)]
    skip: Option<Duration>,
    /// Minimum time between two frames, in milliseconds.
    #[arg(short, long, value_name = "MS", default_value_t = 0.0, value_parser = args::milliseconds)]
    gap: f64,
    /// Ignore the trace's times: as fast as the bus can take it. --gap, --skip and --speed then have no effect.
    #[arg(short = 't', long, conflicts_with_all = ["gap", "skip", "speed"])]
    ignore_times: bool,
    /// Play faster (2) or slower (0.5).
    #[arg(long, default_value_t = 1.0, value_parser = speed)]
    speed: f64,
    /// End after this many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Wait for Enter before the first frame.
    #[arg(short, long)]
    interactive: bool,
    /// Accepted for compatibility with canplayer: what this device sends never comes back to other programs on this
    /// computer.
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

fn mapping(text: &str) -> Result<(Channel, u8), String> {
    let wrong = || "write TO=FROM, such as can1=can0".to_owned();
    let (to, from) = text.split_once('=').ok_or_else(wrong)?;
    Ok((args::channel(to)?, grammar::channel(from).ok_or_else(wrong)?))
}

/// The device's channels. A channel on which nothing is sent is never opened: it would acknowledge on a bus that has
/// nothing to do with the trace, perhaps at another bit rate.
struct Buses<'d> {
    device: &'d Device,
    /// Those not yet opened, with their configurations.
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
    // Faults in the file are found before anything is opened.
    if !source.is_pipe() {
        drop(args.read.open(&source.input, source.filters.clone())?);
    } else if args.rounds != Rounds::Times(1) {
        bail!("standard input can be played once only; give a file to repeat it");
    } else if args.interactive {
        bail!("standard input cannot bring both the trace and Enter; give a file with --interactive");
    }
    let device = args.device.open()?;
    let mut bitrates_bps = [0; CHANNELS];
    let mut buses = Buses {
        device: &device,
        closed: args.open.options().configs(&device, source.channels(), Mode::Normal, &stderr::reporter())?,
    };
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
    let mut sending = Sending::new(&device, args.open.bus_off_recovery(), args.verbose.then(print_sent));
    let started = Instant::now();
    let Played { asked, left_out, fd_left_out, missing } =
        args.play(&source, &mut replay, &mut sending, &mut buses)?;
    let seconds = started.elapsed().as_secs_f64();
    let outcome = sending.outcome(asked)?;
    if !outcome.is_cut_short() {
        device.stop()?;
    }
    let accuracy = replay.accuracy();
    if args.json {
        let mut object = outcome.object();
        object["sent"] = sending.sent().into();
        object["seconds"] = rounded(seconds, 3).into();
        object["early_us"] = accuracy.early_us.into();
        object["late_us"] = accuracy.late_us.into();
        let not_sent = object["left_out"].take();
        missing.put_into(&mut object);
        for (reason, count) in not_sent.as_object().into_iter().flatten() {
            object["left_out"][reason] = count.clone();
        }
        for (kind, count) in [(OTHER_CHANNELS, left_out), (FD, fd_left_out)] {
            if count > 0 {
                object["left_out"][kind] = count.into();
            }
        }
        writeln!(std::io::stdout(), "{object}")?;
    } else {
        eprint!("cantap: {} in {seconds:.1} s", counted(sending.sent(), "frame"));
        if left_out > 0 {
            eprint!(", {left_out} of other channels left out");
        }
        if fd_left_out > 0 {
            let advice = cantap_adapters::fd_advice(device.hello());
            eprint!(", {fd_left_out} CAN FD frames left out: {advice}");
        }
        if accuracy.frames > 0 {
            eprint!(
                "; against the trace at most {:.1} us early, {:.1} us late",
                accuracy.early_us, accuracy.late_us
            );
        }
        eprintln!("");
    }
    outcome.verdict()?;
    Ok(ExitCode::SUCCESS)
}

/// What was played.
#[derive(Default)]
struct Played {
    /// Frames that should have been sent: after a standstill including those never handed over, after Ctrl-C only those
    /// that ended.
    asked: u64,
    /// Frames of channels that are not mapped to any.
    left_out: u64,
    /// CAN FD frames, which the device cannot send.
    fd_left_out: u64,
    /// What was not read from the file in the last round.
    missing: Missing,
}

/// Kinds of frames that are left out, as named in the JSON object.
const OTHER_CHANNELS: &str = "frames of channels that nothing is sent to";
const FD: &str = "CAN FD frames, which the device cannot send";

/// What is played, and on which channels.
struct Source {
    input: PathBuf,
    mapping: Vec<(Channel, u8)>,
    filters: Vec<Filter>,
}

impl Source {
    /// Channels on which something may be sent.
    fn channels(&self) -> Vec<Channel> {
        if self.mapping.is_empty() {
            return Channel::ALL.to_vec();
        }
        Channel::ALL.into_iter().filter(|channel| self.mapping.iter().any(|(to, _)| to == channel)).collect()
    }

    /// Whether it can be read only once, and only as fast as it arrives.
    fn is_pipe(&self) -> bool {
        self.input.as_os_str() == "-"
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
                // With -I, the first word is a mapping too.
                if let Some(word) = first {
                    mapping.insert(0, self::mapping(&word.to_string_lossy()).map_err(usage)?);
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
            return Err(usage(format!(
                "can{interface} is mapped twice, and each frame is sent once; give one TO=can{interface}"
            )));
        }
        let filters = self.read.filters(&self.databases.load(false, true)?)?;
        Ok(Source { input, mapping, filters })
    }

    /// Plays the trace until everything has ended, or frames can no longer be sent.
    fn play(
        &self,
        source: &Source,
        replay: &mut Replay<'_>,
        sending: &mut Sending<'_>,
        buses: &mut Buses<'_>,
    ) -> anyhow::Result<Played> {
        let mut played = Played::default();
        // A round begins where the previous one ended.
        let mut shift_ns = 0;
        let mut round = 0_u32;
        while self.rounds != Rounds::Times(round) && !self.has_all(&played) && !sending.has_stopped() {
            let before = played.asked;
            let mut first_ns = None;
            let mut last_ns = 0;
            let mut records = self.read.open(&source.input, source.filters.clone())?;
            // A pipe may have no end, and endless playing has none: in those cases, what was not read is not counted.
            let ends = !source.is_pipe() && self.rounds != Rounds::ForEver;
            while !self.has_all(&played)
                && (ends || !sending.has_stopped())
                && !interrupt::requested()
                && let Some(record) = records.next()?
            {
                let TraceEvent::Frame { frame, .. } = record.event else {
                    continue;
                };
                if frame.is_fd() && !buses.device.hello().sends_fd() {
                    played.fd_left_out += 1;
                    continue;
                }
                let Some(channel) = source.target(record.channel) else {
                    played.left_out += 1;
                    continue;
                };
                played.asked += 1;
                if sending.has_stopped() {
                    // Never handed over, but requested.
                    continue;
                }
                buses.open(channel)?;
                let first_ns = *first_ns.get_or_insert(record.time_ns);
                last_ns = record.time_ns - first_ns + shift_ns;
                let goes_on =
                    |replay: &mut Replay<'_>| sending.goes_on(&replay.take_ended(), replay.oldest_due());
                if replay.push(last_ns, channel, frame, goes_on)? {
                    sending.goes_on(&replay.take_ended(), replay.oldest_due());
                }
            }
            if played.asked == 0 && played.fd_left_out > 0 && !interrupt::requested() {
                bail!(
                    "'{}' has only CAN FD frames for these channels, which the device cannot send: {}",
                    source.input.display(),
                    cantap_adapters::fd_advice(buses.device.hello())
                );
            }
            if played.asked == 0 && !interrupt::requested() {
                bail!(
                    "'{}' has no frame to send; see `cantap replay --help` for channels",
                    source.input.display()
                );
            }
            played.missing = records.missing();
            round += 1;
            shift_ns = last_ns + 1_000_000;
            if let (true, Rounds::Times(rounds)) = (sending.has_stopped(), self.rounds) {
                played.asked += u64::from(rounds - round) * (played.asked - before);
            }
        }
        sending.finish(replay)?;
        played.asked = match self.frames {
            _ if !sending.stands_still() => sending.ended(),
            Some(frames) => played.asked.min(frames),
            None => played.asked,
        };
        Ok(played)
    }

    fn has_all(&self, played: &Played) -> bool {
        self.frames.is_some_and(|frames| played.asked >= frames)
    }
}
