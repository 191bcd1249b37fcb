//! `cantap send`: sends frames now, periodically, or as replies.

mod modifiers;
mod replies;
mod timed;

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::bail;
use cantap::periodic::{self, BadPeriodic, SHORTEST_PERIOD};
use cantap::transmit::Stream;
use cantap::wire::message::{DEVICE_TAG, Filter as HardwareFilter, FrameKind, Mode, Periodic, Trigger};
use cantap::{Channel, Device, Frame, Id, TraceFrame, hw_filter};
use cantap_address::Address;
use cantap_signals::named::NamedFilter;
use cantap_signals::{Decoder, encode};
use cantap_trace::grammar;
use modifiers::Modifiers;
use replies::{Counts, Replies};
use timed::Repeated;

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::fd_frames;
use crate::input::not_a_message;
use crate::one_board::OneBoard;
use crate::print_sent::print_sent;
use crate::usage_error::usage;
use cantap_work::changing::{Changing, modified};
use cantap_work::interrupt;
use cantap_work::rounded;
use cantap_work::sending::{LOOK_EVERY, Sending};

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Frames are written as 123#DEADBEEF, 5A1#11.22.33, 123#R3, 1F334455#1122, or as \
                Message:Signal=value,Signal=value with --db; CAN FD frames as 123##1DEADBEEF, where the digit has the flags \
                (1: the bit rate is switched, 2: the sender is error passive). Each frame that was sent is printed with the time at which \
                it ended on the bus. When none leaves for a second, it ends and says why.\n\n\
                With --period a value may change with time: sine(LOW,HIGH,PERIOD), triangle, square, ramp(FROM,TO,PERIOD), random(LOW,HIGH), \
                values(1,2,3), file(PATH) with one in each line.\n\n\
                Examples:\n  \
                cantap send -d /dev/ttyACM0 -b 500k can0 123#DEADBEEF\n  \
                cantap send -d virtual can1 123#00 --period 10ms --count 100 --counter 0\n  \
                cantap send -d COM5 -b 250k can0 7E8#0341 --on-rx 7E0:7FF\n  \
                cantap send -d COM5 -b 250k can0 'Dashboard:Speed=88' --db car.dbc\n  \
                cantap send -d virtual:car 1 'ECM_Engine1:EngineSpeed=sine(800,6000,10s)' \\\n      \
                --period 10ms --time 10s --counter 6.0:4 --checksum 7:crc8")]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// 1 or 2; can0 is channel 1, can1 is channel 2.
    #[arg(value_parser = channel, add = completion::channel())]
    channel: Channel,
    /// The frames, in this order.
    #[arg(required = true, value_name = "FRAME", add = completion::values())]
    frames: Vec<String>,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// Send repeatedly, by the device's own timer, at intervals of at least 47us.
    #[arg(long, value_name = "TIME", value_parser = args::duration)]
    period: Option<Duration>,
    /// How many times to send each frame. Without --period and --on-rx they are sent back to back.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    count: Option<u32>,
    /// Send when a frame is received that this filter accepts: ID, or ID:MASK as in candump, or with a database a
    /// message's name.
    #[arg(long, value_name = "FILTER", conflicts_with = "period")]
    on_rx: Option<NamedFilter>,
    /// Send as the answer to remote frames of the same ID.
    #[arg(long, conflicts_with_all = ["period", "on_rx"])]
    reply: bool,
    /// End after this time. Without this and --count, periodic frames and replies continue until Ctrl-C.
    #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
    #[command(flatten)]
    modifiers: modifiers::ModifierArgs,
    /// Fill CAN FD frames of a length that CAN FD does not have with zeros up to the next one, as cansend does unasked.
    #[arg(long)]
    pad: bool,
    /// Switch the bit rate in CAN FD frames that are made from a database's messages of more than eight bytes.
    #[arg(long)]
    brs: bool,
    /// Print nothing about frames that were sent.
    #[arg(short, long)]
    quiet: bool,
    /// Print one JSON object at the end, and nothing about individual frames.
    #[arg(long)]
    json: bool,
}

/// A channel; a frame in its place shows that it was forgotten.
fn channel(text: &str) -> Result<Channel, String> {
    args::channel(text).map_err(|reason| {
        // can2 is an interface of this computer, too, and here a channel that there is not.
        if grammar::channel(text).is_none() && Address::is_meant_by(Path::new(text)) {
            format!("a device is given with -d, and the channel follows, as in: cantap send -d {text} 1")
        } else if text.contains(['#', ':']) {
            format!("say on which channel before the frame, as in: cantap send 1 {text}")
        } else {
            reason
        }
    })
}

/// Whether it is a message with values: no frame contains a colon.
fn is_message(text: &str) -> bool {
    text.contains(':') && !text.contains('#')
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // Everything wrong on the command line is found before anything is sent.
    let decoder = args.decoder()?;
    let sources = args.sources(&decoder)?;
    let frames: Vec<TraceFrame> = sources.iter().map(|source| source.first).collect();
    let changes = sources.iter().any(|source| source.changing.is_some());
    if changes && args.period.is_none() {
        return Err(usage("a value that changes with time needs --period, such as --period 20ms"));
    }
    let classic: Vec<Frame> = frames.iter().filter_map(|frame| frame.classic().copied()).collect();
    let has_fd = classic.len() < frames.len();
    let switches = |(source, text): (&Source, &String)| is_message(text) && source.first.classic().is_none();
    if args.brs && !sources.iter().zip(&args.frames).any(switches) {
        return Err(usage(
            "--brs is for CAN FD frames made from a database's messages of more than eight bytes, and none of these is one; in a frame, the \
             digit behind ## says it, as in 123##1DEADBEEF",
        ));
    }
    if has_fd && (args.reply || args.on_rx.is_some()) {
        return Err(usage("a reply is a classical frame; give one, as in 123#1122"));
    }
    let triggers = args.triggers(&classic, &decoder)?;
    let periodic = args.periodic(&classic)?;
    if has_fd && periodic.as_ref().is_some_and(|(_, modifiers)| !modifiers.is_empty()) {
        return Err(usage(
            "--counter, --random and --checksum change classical frames only; omit them for CAN FD",
        ));
    }
    interrupt::watch()?;
    let device = args.device.open()?;
    fd_frames::check(&device, &frames)?;
    args.open.open(&device, [args.channel].into_iter(), Mode::Normal, None)?;
    let on_sent = (!args.quiet && !args.json).then(print_sent);
    let started = Instant::now();
    let mut replies = None;
    let mut sending = if triggers.is_some() {
        Sending::fed(&device, args.open.bus_off_recovery(), on_sent)
    } else {
        Sending::new(&device, args.open.bus_off_recovery(), on_sent)
    };
    let outcome = match (triggers, periodic) {
        (Some(triggers), _) => {
            let slots = device.hello().trigger_slots;
            if triggers.len() > usize::from(slots) {
                bail!("that takes {} of the device's {slots} replies; give fewer frames", triggers.len());
            }
            let wanted = args.count.map(|count| u64::from(count) * frames.len() as u64);
            let mut waited = Replies::set(&device, args.channel, triggers)?;
            waited.watch(&mut sending, |sending| {
                args.is_over(started) || wanted.is_some_and(|wanted| sending.ended() >= wanted)
            })?;
            let Counts { asked, merged } = waited.counts();
            replies = Some(waited);
            sending.outcome_of_replies(asked, merged)?
        }
        (None, Some((period, modifiers))) if has_fd || changes => {
            let frames = |round, since_s| {
                sources
                    .iter()
                    .map(|source| source.frame(&decoder, args, &modifiers, round, since_s))
                    .collect()
            };
            let what = Repeated {
                count: sources.len(),
                frames: &frames,
                period,
                rounds: args.count,
                time: args.time,
            };
            let asked = timed::send(&device, args.channel, &what, &mut sending, || args.is_over(started))?;
            sending.outcome(asked)?
        }
        (None, Some((period, modifiers))) => {
            let period_ticks = periodic::period_ticks(period, device.hello().tick_hz)
                .map_err(|error| usage(error.to_string()))?;
            let slots = device.hello().periodic_slots;
            if frames.len() > usize::from(slots) {
                bail!("the device keeps {slots} periodic frames and these are {}; give fewer", frames.len());
            }
            let stream = Stream::new(&device);
            for (slot, frame) in (0..).zip(&classic) {
                let entry = Periodic {
                    frame: *frame,
                    period_ticks,
                    count: args.count.unwrap_or(0),
                    modifiers: modifiers.clone(),
                };
                device.set_periodic(args.channel, slot, Some(entry))?;
            }
            let wanted = args.count.map(|count| u64::from(count) * frames.len() as u64);
            let asked = args.watch_periodic(stream, &device, frames.len(), &mut sending, wanted)?;
            sending.outcome(asked)?
        }
        (None, None) => {
            let asked = args.send_now(&device, &frames, &mut sending)?;
            sending.outcome(asked)?
        }
    };
    let seconds = started.elapsed().as_secs_f64();
    if !outcome.is_cut_short() {
        device.stop()?;
    }
    if args.json {
        let mut object = outcome.object();
        object["channel"] = args.channel.number().into();
        object["sent"] = sending.sent().into();
        object["seconds"] = rounded(seconds, 3).into();
        object["issues"] = decoder.faults().into();
        if let Some(replies) = &replies {
            object["replies"] = replies.objects();
        }
        writeln!(std::io::stdout().lock(), "{object}")?;
    } else if let Some(replies) = replies.filter(|_| !args.quiet) {
        replies.tell();
    }
    outcome.verdict()?;
    Ok(ExitCode::SUCCESS)
}

/// A frame to be sent, or where it comes from.
struct Source {
    /// What it is at the beginning.
    first: TraceFrame,
    changing: Option<Changing>,
}

impl Source {
    /// What it is in a round, from 0, that is due so many seconds after the first.
    fn frame(
        &self,
        decoder: &Decoder,
        args: &Args,
        modifiers: &Modifiers,
        round: u32,
        since_s: f64,
    ) -> anyhow::Result<TraceFrame> {
        Ok(match (&self.changing, self.first.classic()) {
            (Some(changing), _) => {
                changing.frame(decoder, Some(args.channel.number()), since_s, round)?.into()
            }
            (None, Some(frame)) => modified(frame, modifiers, round).into(),
            (None, None) => self.first,
        })
    }
}

impl Args {
    fn decoder(&self) -> anyhow::Result<Decoder> {
        let is_sent = self.frames.iter().any(|text| is_message(text));
        let device = self.device.given().filter(|_| is_sent || self.on_rx.is_some());
        // What is wrong with the databases matters to what is sent by them.
        load(&self.databases.or_of(device), false, self.quiet || !is_sent && self.databases.is_empty())
    }

    fn sources(&self, decoder: &Decoder) -> anyhow::Result<Vec<Source>> {
        let modifiers = self.modifiers.list()?;
        let source = |text: &String| {
            if is_message(text)
                && let Some(changing) = Changing::parse(text)?
            {
                let changing = changing.with_modifiers(modifiers.clone());
                let first = changing.check(decoder, Some(self.channel.number()))?.into();
                return Ok(Source { first, changing: Some(changing) });
            }
            self.frame(text, decoder).map(|first| Source { first, changing: None })
        };
        self.frames.iter().map(source).collect()
    }

    fn frame(&self, text: &str, decoder: &Decoder) -> anyhow::Result<TraceFrame> {
        if is_message(text) {
            let how = (self.brs, self.pad);
            return Ok(encode::encode_any(decoder, Some(self.channel.number()), text, how)?);
        }
        let frame = grammar::any_frame(text, self.pad);
        frame.map_err(|error| {
            let is_fd = text.contains("##") && !self.pad;
            let advice = if is_fd { "; --pad fills it up with zeros to the next of these" } else { "" };
            let advice = if error.contains("carries 0 to 8, 12") { advice } else { "" };
            usage(format!("'{text}' is not a frame: {error}{advice}"))
        })
    }

    /// The period and what changes each time, if frames should be sent periodically.
    fn periodic(&self, frames: &[Frame]) -> anyhow::Result<Option<(Duration, Modifiers)>> {
        let Some(period) = self.period else { return Ok(None) };
        if period < SHORTEST_PERIOD {
            return Err(usage(BadPeriodic::TooShort { period }.to_string()));
        }
        let modifiers = self.modifiers.list()?;
        for frame in frames {
            periodic::check_modifiers(frame, &modifiers).map_err(|error| usage(error.to_string()))?;
        }
        Ok(Some((period, modifiers)))
    }

    /// The replies, if requested: for each frame, one per hardware filter.
    fn triggers(&self, frames: &[Frame], decoder: &Decoder) -> anyhow::Result<Option<Vec<Trigger>>> {
        let count = self.count.unwrap_or(0);
        if self.reply {
            let answer = |frame: &Frame| Trigger {
                filter: exactly(frame.id(), FrameKind::Remote),
                reply: *frame,
                count,
            };
            return Ok(Some(frames.iter().map(answer).collect()));
        }
        let Some(named) = &self.on_rx else { return Ok(None) };
        let filters = {
            let filter = named.resolve(decoder).map_err(|error| not_a_message("--on-rx", &error))?;
            let compiled = hw_filter::compile(&[filter], self.channel);
            if let Some(remainder) = compiled.remainder {
                return Err(usage(format!(
                    "'{named}' cannot start a reply: {remainder}, which is too late for it"
                )));
            }
            if compiled.hardware.is_empty() {
                let all = |extended| HardwareFilter { extended, kind: FrameKind::Any, id: 0, mask: 0 };
                vec![all(false), all(true)]
            } else {
                compiled.hardware
            }
        };
        let each = |filter: &HardwareFilter| {
            let filter = *filter;
            frames.iter().map(move |frame| Trigger { filter, reply: *frame, count })
        };
        Ok(Some(filters.iter().flat_map(each).collect()))
    }

    fn is_over(&self, started: Instant) -> bool {
        interrupt::requested() || self.time.is_some_and(|time| started.elapsed() >= time)
    }

    /// Sends the frames one after the other, `count` times. Returns how many were requested.
    fn send_now(
        &self,
        device: &Device,
        frames: &[TraceFrame],
        sending: &mut Sending<'_>,
    ) -> anyhow::Result<u64> {
        let mut stream = Stream::new(device);
        let started = Instant::now();
        let rounds = self.count.unwrap_or(1);
        let mut goes_on = |stream: &mut Stream<'_>| {
            sending.goes_on(&stream.take_ended(), stream.oldest_due()) && !self.is_over(started)
        };
        'rounds: for _ in 0..rounds {
            for frame in frames {
                if stream.push(self.channel, *frame, None, &mut goes_on)?.is_none() || !goes_on(&mut stream) {
                    break 'rounds;
                }
            }
        }
        sending.finish(&mut stream)?;
        let all = u64::from(rounds) * frames.len() as u64;
        Ok(if sending.stands_still() { all } else { sending.ended() })
    }

    /// Watches the periodic frames in the first `entries` slots until the requested number has ended, then clears them. Returns how many
    /// frames were requested.
    fn watch_periodic(
        &self,
        mut stream: Stream<'_>,
        device: &Device,
        entries: usize,
        sending: &mut Sending<'_>,
        wanted: Option<u64>,
    ) -> anyhow::Result<u64> {
        let started = Instant::now();
        let mut next = |wait: Duration| -> anyhow::Result<_> {
            stream.wait(wait)?;
            let mut ends = stream.take_ended();
            ends.retain(|end| end.tag >= DEVICE_TAG);
            Ok(ends)
        };
        while !self.is_over(started) && wanted.is_none_or(|wanted| sending.ended() < wanted) {
            if !sending.device_goes_on(&next(LOOK_EVERY)?) {
                break;
            }
        }
        sending.check()?;
        for slot in (0..).take(entries) {
            device.set_periodic(self.channel, slot, None)?;
        }
        let missed = sending.settle(self.channel, |_| next(LOOK_EVERY))?;
        Ok(match wanted {
            Some(wanted) if sending.stands_still() => wanted,
            // Ended by time or Ctrl-C: count what was due until then.
            Some(wanted) => wanted.min(sending.ended() + missed),
            None => sending.ended() + missed,
        })
    }
}

/// A filter for one identifier.
const fn exactly(id: Id, kind: FrameKind) -> HardwareFilter {
    let extended = id.is_extended();
    let mask = if extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
    HardwareFilter { extended, kind, id: id.raw(), mask }
}
