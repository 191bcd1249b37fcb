//! `cantap gen`: made-up frames, with cangen's options.

mod filled;

use std::io::Write;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::replay::{Pace, Replay};
use cantap::wire::CHANNELS;
use cantap::wire::message::Mode;
use cantap::{Channel, FdFrame, Frame, Id, TraceFrame};
use cantap_trace::counted;
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::one_board::OneBoard;
use crate::print_sent::print_sent;
use crate::usage_error::usage;
use cantap_work::interrupt;
use cantap_work::rounded;
use cantap_work::sending::Sending;
use filled::Filled;

/// Frames that leave this much later than their gap says are told: more than other frames on the bus explain at any common bit rate.
const WORTH_TELLING_US: f64 = 10_000.0;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Modes for -I, -L and -D: r random, i counting up, e even random, o odd random, or a value. Data that count up are one byte \
                        at least. A full queue is always waited for, so cangen's -p and -i change nothing. When no frame leaves for a second, it \
                        ends and says why.\n\n\
                        Examples:\n  cantap gen -d virtual can0 -g 10 -I 42A -L 8 -D i -n 1000\n  \
                        cantap gen -d /dev/ttyACM0 -b 1M can0 -g 0 -m\n  cantap gen -d /dev/ttyACM0 -b 1M both --saturate\n  cantap gen -d virtual can1 -g 100 -c 8 -n 80"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// can0 or 1, can1 or 2; or both.
    #[arg(value_parser = channels, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Time from one frame to the next, in milliseconds, or with a unit, as 1ms or 2s; 0 for as fast as the bus can take them.
    #[arg(short, long, value_name = "MS", default_value_t = 200.0, value_parser = args::milliseconds)]
    gap: f64,
    /// Fill the bus: no gap, and frames without data (the most that a bus can carry), unless -L or -D says otherwise.
    /// Reports at the end how full it was.
    #[arg(long, conflicts_with_all = ["gap", "burst"])]
    saturate: bool,
    /// 29-bit identifiers.
    #[arg(short, long)]
    extended: bool,
    /// Remote frames.
    #[arg(short = 'R', long)]
    remote: bool,
    /// Mix standard and extended, data and remote frames.
    #[arg(short, long)]
    mix: bool,
    /// Identifiers.
    #[arg(short = 'I', long, value_name = "MODE|HEX", default_value = "r", value_parser = identifier)]
    id: Values,
    /// Lengths, 0 to 8; of CAN FD frames also 12, 16, 20, 24, 32, 48 and 64.
    #[arg(short = 'L', long, value_name = "MODE|N", value_parser = length)]
    length: Option<Values>,
    /// Data.
    #[arg(short = 'D', long, value_name = "MODE|HEX", default_value = "r", value_parser = data)]
    data: Data,
    /// End after this many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Frames per burst: they are sent back to back, and the gap is from burst to burst.
    #[arg(short = 'c', long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    burst: u32,
    /// Lengths up to 15, of which a controller carries eight bytes.
    #[arg(short = '8', long)]
    raw_dlc: bool,
    /// Accepted for compatibility with cangen: a full queue is always waited for.
    #[arg(short = 'p', value_name = "MS", hide = true, value_parser = args::milliseconds)]
    poll: Option<f64>,
    /// Accepted for compatibility with cangen: a full queue is not an error here.
    #[arg(short = 'i', hide = true)]
    ignore_full: bool,
    /// Accepted for compatibility with cangen: what this device sends never comes back to other programs on this
    /// computer.
    #[arg(short = 'x', hide = true)]
    no_loopback: bool,
    /// CAN FD frames; with -m, classical ones among them.
    #[arg(short, long, conflicts_with_all = ["remote", "raw_dlc"])]
    fd: bool,
    /// CAN FD frames whose bit rate is switched: cangen's -b.
    #[arg(long, conflicts_with_all = ["remote", "raw_dlc"])]
    brs: bool,
    /// CAN FD frames that say that their sender is error passive.
    #[arg(short = 'E', long, conflicts_with_all = ["remote", "raw_dlc"])]
    esi: bool,
    /// Select another sequence.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print each frame that was sent.
    #[arg(short, long)]
    verbose: bool,
    /// Print one JSON object with the summary.
    #[arg(long, conflicts_with = "verbose")]
    json: bool,
}

impl Args {
    /// Whether CAN FD frames are wanted.
    const fn is_fd(&self) -> bool {
        self.fd || self.brs || self.esi
    }

    /// Finds lengths that the frames cannot have.
    fn check(&self) -> anyhow::Result<()> {
        let is_fd_length = |bytes: usize| FD_LENGTHS.iter().any(|len| usize::from(*len) == bytes);
        let most = if self.raw_dlc { 15 } else { 8 };
        let (given, fixed) = match (&self.length, &self.data) {
            (Some(Values::Fixed(bytes)), Data::Fixed(data)) => (*bytes as usize, data.len()),
            (Some(Values::Fixed(bytes)), Data::Varying(_)) => (*bytes as usize, 0),
            (_, Data::Fixed(data)) => (0, data.len()),
            _ => (0, 0),
        };
        if self.is_fd() && !(is_fd_length(given) && is_fd_length(fixed)) {
            return Err(usage("a CAN FD frame carries 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes"));
        }
        if (!self.is_fd() || self.mix) && (given > most || fixed > 8) {
            return Err(usage(
                "a classical frame carries 0 to 8 bytes; -8 allows lengths up to 15, which say eight, and --fd without --mix up to 64",
            ));
        }
        Ok(())
    }
}

/// One channel, or both in turns.
type Channels = heapless::Vec<Channel, CHANNELS>;

fn channels(text: &str) -> Result<Channels, String> {
    if text == "both" {
        return Ok(Channel::ALL.into_iter().collect());
    }
    let channel = args::channel(text)
        .map_err(|error| args::in_place_of_channel(text).unwrap_or_else(|| format!("{error}, or both")))?;
    Ok([channel].into_iter().collect())
}

/// The source of a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Values {
    Random,
    Even,
    Odd,
    Count,
    Fixed(u32),
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Data {
    Varying(Values),
    Fixed(Vec<u8>),
}

fn mode(text: &str) -> Option<Values> {
    match text {
        "r" => Some(Values::Random),
        "e" => Some(Values::Even),
        "o" => Some(Values::Odd),
        "i" => Some(Values::Count),
        _ => None,
    }
}

fn identifier(text: &str) -> Result<Values, String> {
    let text = text.strip_prefix("0x").unwrap_or(text);
    let hex = text.bytes().all(|digit| digit.is_ascii_hexdigit());
    let number = || u32::from_str_radix(text, 16).ok().filter(|id| hex && *id <= Id::MAX_EXTENDED);
    mode(text)
        .or_else(|| number().map(Values::Fixed))
        .ok_or_else(|| "write r, i, e, o or a hexadecimal identifier up to 1FFFFFFF".to_owned())
}

fn length(text: &str) -> Result<Values, String> {
    let number = || text.parse().ok().filter(|length| *length <= 64);
    mode(text)
        .or_else(|| number().map(Values::Fixed))
        .ok_or_else(|| "write r, i, e, o or a length from 0 to 8, with -8 to 15, with --fd to 64".to_owned())
}

fn data(text: &str) -> Result<Data, String> {
    if let Some(mode) = mode(text) {
        return Ok(Data::Varying(mode));
    }
    // The frame's own parser checks the data.
    let frame = |text: String| text.parse::<TraceFrame>().ok().filter(|frame| !frame.is_remote());
    frame(format!("000#{text}"))
        .or_else(|| frame(format!("000##0{text}")))
        .map(|frame| Data::Fixed(frame.data().to_vec()))
        .ok_or_else(|| {
            "write r, i, e, o or up to 8 bytes in hexadecimal, with --fd 12, 16, 20, 24, 32, 48 or 64"
                .to_owned()
        })
}

/// Generates the frames.
struct Generator<'a> {
    args: &'a Args,
    random: fastrand::Rng,
    count: u64,
}

impl Generator<'_> {
    fn number(&mut self, values: Values, below: u32) -> u32 {
        match values {
            Values::Random => self.random.u32(..below),
            Values::Even => self.random.u32(..below) & !1,
            // With an odd limit (lengths 0 to 8), the highest number is even.
            Values::Odd => self.random.u32(..below & !1) | 1,
            Values::Count => (self.count % u64::from(below)) as u32,
            Values::Fixed(value) => value,
        }
    }

    fn frame(&mut self) -> TraceFrame {
        if self.args.is_fd() && !(self.args.mix && self.random.bool()) {
            return self.fd_frame().into();
        }
        self.classic_frame().into()
    }

    /// Its length is one that CAN FD has: modes choose among the length codes.
    fn fd_frame(&mut self) -> FdFrame {
        let Args { extended, mix, id, length, data, brs, esi, .. } = self.args;
        let id = self.id(*id, *extended, *mix);
        let codes = FD_LENGTHS.len() as u32;
        let len = match (length, data) {
            (Some(Values::Fixed(bytes)), _) => *bytes as usize,
            (None, Data::Fixed(bytes)) => bytes.len(),
            (None, Data::Varying(Values::Random)) if self.args.saturate => 0,
            (Some(values), _) => FD_LENGTHS[self.number(*values, codes) as usize].into(),
            (None, Data::Varying(_)) => FD_LENGTHS[self.random.usize(..FD_LENGTHS.len())].into(),
        };
        let len = if *data == Data::Varying(Values::Count) { len.max(1) } else { len };
        let mut bytes = [0; FD_MAX_BYTES];
        self.fill(&mut bytes);
        self.count += 1;
        // Cannot fail: the command line is checked for lengths.
        FdFrame::padded(id, *brs, *esi, &bytes[..len.min(FD_MAX_BYTES)]).unwrap_or_else(|| unreachable!())
    }

    fn id(&mut self, id: Values, extended: bool, mix: bool) -> Id {
        let wide = matches!(id, Values::Fixed(id) if id > Id::MAX_STANDARD);
        if wide || if mix { self.random.bool() } else { extended } {
            Id::extended_truncated(self.number(id, Id::MAX_EXTENDED + 1))
        } else {
            Id::standard_truncated(self.number(id, Id::MAX_STANDARD + 1))
        }
    }

    /// Fills the data. Bytes beyond a frame's length do not matter.
    fn fill(&mut self, bytes: &mut [u8]) {
        match &self.args.data {
            Data::Fixed(fixed) => {
                let len = fixed.len().min(bytes.len());
                bytes[..len].copy_from_slice(&fixed[..len]);
            }
            // Counts as one number, least significant byte first, as cangen does.
            Data::Varying(Values::Count) => bytes[..8].copy_from_slice(&self.count.to_le_bytes()),
            Data::Varying(values) => {
                let (keep, set) = match values {
                    Values::Even => (0xFE, 0),
                    Values::Odd => (0xFF, 1),
                    _ => (0xFF, 0),
                };
                bytes.fill_with(|| self.random.u8(..) & keep | set);
            }
        }
    }

    fn classic_frame(&mut self) -> Frame {
        let Args { extended, remote, mix, id, length, data, .. } = self.args;
        let wide = matches!(id, Values::Fixed(id) if *id > Id::MAX_STANDARD);
        let extended = wide || if *mix { self.random.bool() } else { *extended };
        let remote = if *mix { self.random.bool() } else { *remote };
        let id = self.id(*id, extended, false);
        let lengths = if self.args.raw_dlc { 16 } else { 9 };
        let length = match (length, data) {
            (Some(values), _) => self.number(*values, lengths),
            (None, Data::Varying(Values::Random)) if self.args.saturate => 0,
            (None, Data::Fixed(bytes)) => bytes.len() as u32,
            (None, Data::Varying(_)) => self.random.u32(..lengths),
        };
        let counts = *data == Data::Varying(Values::Count);
        let length = if counts && !remote { length.max(1) } else { length };
        let mut bytes = [0; 8];
        self.fill(&mut bytes);
        self.count += 1;
        Frame::from_bus(id, remote, length as u8, bytes)
    }
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    args.check()?;
    interrupt::watch()?;
    let device = args.device.open()?;
    if args.is_fd() && !device.hello().sends_fd() {
        bail!("CAN FD frames cannot be sent: {}", cantap_adapters::fd_advice(device.hello()));
    }
    let mut bitrates_bps = [0; CHANNELS];
    for (channel, config) in args.open.open(&device, args.channel.iter().copied(), Mode::Normal, None)? {
        bitrates_bps[channel.index()] = config.timing.bitrate_bps(device.hello().can_clock_hz);
    }
    let gap = Duration::from_secs_f64(if args.saturate { 0.0 } else { args.gap / 1e3 });
    // A trace in which all frames end at the same time, separated by the gap.
    let pace = Pace { shortest_gap: gap, burst: args.burst, ignore_times: gap.is_zero(), ..Pace::default() };
    let mut replay = Replay::new(&device, pace, bitrates_bps)?;
    let mut sending = Sending::new(&device, args.open.bus_off_recovery(), args.verbose.then(print_sent));
    let mut generator = Generator { args, random: fastrand::Rng::with_seed(args.seed), count: 0 };
    let mut filled = Filled::new(bitrates_bps, Channel::ALL.map(|channel| device.data_bitrate(channel)));
    let started = Instant::now();
    let mut turns = args.channel.iter().cycle();
    while args.frames.is_none_or(|frames| generator.count < frames)
        && let Some(channel) = turns.next()
    {
        let frame = generator.frame();
        let mut goes_on = |replay: &mut Replay<'_>| {
            let ends = replay.take_ended();
            filled.add(&ends);
            sending.goes_on(&ends, replay.oldest_due())
        };
        if !goes_on(&mut replay) {
            break;
        }
        match replay.push(0, *channel, frame, goes_on) {
            Ok(true) => {}
            Ok(false) => break,
            Err(error) => {
                sending.fail(error);
                break;
            }
        }
    }
    if !sending.stands_still()
        && !sending.has_failed()
        && let Err(error) = sending.finish(&mut replay)
    {
        sending.fail(error);
    }
    let asked = if sending.stands_still() { args.frames.unwrap_or(generator.count) } else { sending.ended() };
    let outcome = sending.outcome(asked)?;
    if !outcome.is_cut_short() {
        device.stop()?;
    }
    let accuracy = replay.accuracy();
    if args.json {
        let mut object = outcome.object();
        object["sent"] = sending.sent().into();
        object["seconds"] = rounded(started.elapsed().as_secs_f64(), 3).into();
        let known = |us: f64| (accuracy.frames > 0).then_some(us);
        object["early_us"] = known(accuracy.early_us).into();
        object["late_us"] = known(accuracy.late_us).into();
        object["channels"] = filled.object(device.hello().tick_hz);
        writeln!(std::io::stdout(), "{object}")?;
    } else {
        eprint!("cantap: {} sent", counted(sending.sent() as usize, "frame"));
        if accuracy.late_us >= WORTH_TELLING_US {
            eprint!(", up to {:.1} ms late: a busy bus or computer delays them", accuracy.late_us / 1e3);
        }
        eprintln!("");
        if args.saturate {
            filled.tell(device.hello().tick_hz);
        }
    }
    outcome.verdict()?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    fn frames(line: &str, count: usize) -> Vec<String> {
        let line = ["x", "-d", "virtual", "can0"].into_iter().chain(line.split_whitespace());
        let args = Line::parse_from(line).args;
        let mut generator = Generator { args: &args, random: fastrand::Rng::with_seed(args.seed), count: 0 };
        (0..count).map(|_| generator.frame().to_string()).collect()
    }

    #[test]
    fn options_mean_what_cangen_says() {
        assert_eq!(frames("-I 42A -L 1 -D i", 3), ["42A#00", "42A#01", "42A#02"]);
        assert_eq!(frames("-I i -D 11.22", 2), ["000#1122", "001#1122"]);
        assert_eq!(frames("-I 7FF -L 4 -R", 1), ["7FF#R4"]);
        assert_eq!(frames("-e -I 1 -L 0", 1), ["00000001#"]);
        assert_eq!(frames("-I 1FFFFFFF -L 0", 1), ["1FFFFFFF#"]);
        // Counting data have at least one byte.
        assert_eq!(frames("-I 1 -L 0 -D i", 2), ["001#00", "001#01"]);
        assert!(frames("-I 1 -L r -D i", 200).iter().all(|frame| !frame.ends_with('#')));
        assert_eq!(frames("-I 1 -L 15 -8 -D 1122334455667788", 1), ["001#1122334455667788_F"]);
        assert_eq!(frames("--fd --brs -I 1 -L 12 -D i", 1), [format!("001##1{}", "00".repeat(12))]);
        assert_eq!(
            frames("--fd -E -I 1 -D 11223344556677881122334455667788", 1),
            ["001##211223344556677881122334455667788"]
        );
        assert!(frames("--fd -L r", 200).iter().all(|frame| frame.parse::<TraceFrame>().unwrap().is_fd()));
        let mixed = frames("--brs -m", 200);
        assert!(
            mixed.iter().any(|frame| frame.contains("##1"))
                && mixed.iter().any(|frame| !frame.contains("##"))
        );
        assert!(frames("-L r -8", 200).iter().any(|frame| frame.contains('_')));
    }

    #[test]
    fn random_values_keep_their_parity_and_range() {
        for frame in frames("-I o -L e -D e", 200) {
            let frame: Frame = frame.parse().unwrap();
            assert!(frame.id().raw() % 2 == 1 && frame.dlc().is_multiple_of(2) && frame.dlc() <= 8);
            assert!(frame.data().iter().all(|byte| byte.is_multiple_of(2)));
        }
        assert!(frames("-L o", 100).iter().all(|frame| frame.parse::<Frame>().unwrap().dlc() % 2 == 1));
        assert_ne!(frames("--seed 2", 10), frames("--seed 3", 10));
    }
}
