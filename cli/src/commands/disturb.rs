//! `cantap disturb`: error frames on purpose, by a board that was built for it.

mod prediction;

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use cantap::device::{Records, Ticks, UtcNs};
use cantap::wire::message::{MAX_DISTURBANCE_BITS, Mode};
use cantap::{Channel, Device, Id, TraceEvent, TraceRecord};
use cantap_address::OpenDevice;
use cantap_trace::grammar;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::interrupt;
use cantap_work::terms::counted;
use prediction::{Expected, Prediction};

use crate::one_board::OneBoard;
use crate::timing_args::TimingArgs;
use crate::{args, completion, exit, stderr};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "For a test bench only: each disturbance destroys what is on the bus, and raises the error counters of every node on it. The \
                  device drives its TX pin dominant for so many bits; a timer ends that even if the firmware hangs. It takes part in the bus \
                  meanwhile. Only a board built with the feature `disturb` can do this, and only where the TX pin has a timer (docs/disturb.md).\n\n\
                  bxCAN knows a frame only at its end. --id therefore hits a periodic frame at its predicted time, in its middle, from the \
                  intervals of the last ones; how far off that was, the output says.\n\nExamples:\n  \
                  cantap disturb -d /dev/ttyACM0 -b 500k --at 100ms --yes-on-a-test-bench\n  \
                  cantap disturb -b 500k --id 123 --nth 20 --yes-on-a-test-bench\n  \
                  cantap disturb -b 500k --id 123 --count 16 --length 1 \\\n      \
                  --yes-on-a-test-bench\n\n\
                  Exit code: 1 if a disturbance came to nothing."
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// The channel: 1 or 2.
    #[arg(short, long, default_value = "1", value_parser = args::channel, add = completion::channels())]
    channel: Channel,
    #[command(flatten)]
    timing: TimingArgs,
    /// When, from the channel's opening on, in the device's time: 100ms, 2s.
    #[arg(long, value_name = "TIME", value_parser = args::duration, required_unless_present = "id")]
    at: Option<Duration>,
    /// Onto a periodic frame with this identifier.
    #[arg(long, value_name = "ID", value_parser = grammar::identifier, conflicts_with_all = ["at", "every"])]
    id: Option<Id>,
    /// Onto which of them, counted from 1 since the channel's opening; without it, the first whose time can be predicted.
    #[arg(long, value_name = "N", requires = "id", value_parser = clap::value_parser!(u64).range(1..))]
    nth: Option<u64>,
    /// For how many bits, 1 to 12. Six are an error frame anywhere.
    #[arg(long, value_name = "BITS", default_value = "6",
          value_parser = clap::value_parser!(u8).range(1..=i64::from(MAX_DISTURBANCE_BITS)))]
    length: u8,
    /// How many disturbances.
    #[arg(short = 'n', long, value_name = "N", default_value = "1", value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
    /// The time from one to the next: 20ms or more.
    #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = args::duration)]
    every: Duration,
    /// Nothing depends on this bus. Without it nothing is done.
    #[arg(long, required = true)]
    yes_on_a_test_bench: bool,
    /// Print one JSON object per disturbance.
    #[arg(long)]
    json: bool,
}

/// How often to check whether to go on.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Least time from a request to its level, so that it arrives in time.
const LEAD_MS: u64 = 20;
/// An error that began by a level is on record within so many bits of its end: the flags of all, and an interrupt's latency.
const ERROR_BITS: u64 = 40;
/// A level that has not been reported this long after its time never will be.
const REPORTED_WITHIN_MS: u64 = 2000;

/// What a level caused is on record within this time, on a bus that is never silent.
const SETTLED_MS: u64 = 100;

/// What became of one disturbance.
struct Outcome {
    at_ticks: u64,
    time_ns: i64,
    length_ns: u32,
    /// Bus errors that the device recorded then.
    errors: u32,
    /// With an identifier, how much later than predicted its next frame ended.
    late_ns: Option<i64>,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let device = args.device.open()?;
    if !device.hello().disturbs() {
        bail!(
            "{} does not disturb a bus: that needs a board of one's own, with a TX pin on a timer, and a firmware built for it (docs/disturb.md); \
             released ones, servers, adapters and the virtual device cannot",
            device.name()
        );
    }
    let options = ChannelOptions { timing: args.timing.options(), ..ChannelOptions::default() };
    let mut records = device.records();
    let opened =
        options.open(&device, [args.channel].into_iter(), Mode::Normal, None, &stderr::reporter())?;
    device.unlock_disturbances()?;
    let clock_hz = device.hello().can_clock_hz;
    let bitrate_bps = opened.first().map_or(500_000, |(_, config)| config.timing.bitrate_bps(clock_hz));
    let run = Run { args, device: &device, bit_ns: 1_000_000_000 / u64::from(bitrate_bps.max(1)) };
    let done = run.all(&mut records);
    let stopped = device.stop();
    let to_nothing = done?;
    stopped?;
    Ok(if to_nothing == 0 { ExitCode::SUCCESS } else { ExitCode::from(exit::FAILURE) })
}

struct Run<'a> {
    args: &'a Args,
    device: &'a OpenDevice,
    bit_ns: u64,
}

impl Run<'_> {
    fn ms(&self, ms: u64) -> u64 {
        ms * u64::from(self.device.hello().tick_hz) / 1000
    }

    /// Disturbs as often as requested. Returns how many came to nothing.
    fn all(&self, records: &mut Records) -> anyhow::Result<u32> {
        let per_second = f64::from(self.device.hello().tick_hz);
        let ticks = |time: Duration| (time.as_secs_f64() * per_second) as u64;
        let began = self.device.time()?;
        let every = ticks(self.args.every).max(self.ms(LEAD_MS));
        let mut prediction =
            self.args.id.map(|id| Prediction::new(id, self.args.channel.number(), self.bit_ns));
        let mut to_nothing = 0;
        for round in 0..u64::from(self.args.count) {
            let expected = match &mut prediction {
                Some(prediction) => {
                    let nth = self.args.nth.filter(|_| round == 0);
                    let Some(expected) = self.predict(prediction, nth, records)? else { break };
                    Some(expected)
                }
                None => None,
            };
            let at = match &expected {
                Some(expected) => self.device.clock_map().ticks(UtcNs(expected.middle_ns)).0,
                None => began + ticks(self.args.at.unwrap_or_default()) + round * every,
            };
            let at = if expected.is_some() { at } else { at.max(self.device.time()? + self.ms(LEAD_MS)) };
            let Some(outcome) = self.disturb(at, expected.as_ref(), prediction.as_mut(), records)? else {
                break;
            };
            to_nothing += u32::from(outcome.length_ns == 0);
            self.print(&outcome)?;
        }
        Ok(to_nothing)
    }

    /// Waits until the time of the wanted frame can be predicted; `None` if it is to end before.
    fn predict(
        &self,
        prediction: &mut Prediction,
        nth: Option<u64>,
        records: &mut Records,
    ) -> anyhow::Result<Option<Expected>> {
        while !interrupt::requested() {
            let map = self.device.clock_map();
            let soonest_ns = map.utc(Ticks(self.device.time()? + self.ms(LEAD_MS))).0;
            if let Some(expected) = prediction.next(nth, soonest_ns)? {
                return Ok(Some(expected));
            }
            let Some(batch) = records.next_batch(LOOK_EVERY)? else { return Ok(None) };
            for record in &batch {
                prediction.take(record);
            }
            records.recycle(batch);
        }
        Ok(None)
    }

    /// One disturbance, and what came of it; `None` if it is to end before.
    fn disturb(
        &self,
        at: u64,
        expected: Option<&Expected>,
        mut prediction: Option<&mut Prediction>,
        records: &mut Records,
    ) -> anyhow::Result<Option<Outcome>> {
        let device: &Device = self.device;
        device.disturb(self.args.channel, at, self.args.length)?;
        let mut seen: Vec<TraceRecord> = Vec::new();
        let mut outcome: Option<Outcome> = None;
        let window_ns = ((u64::from(self.args.length) + ERROR_BITS) * self.bit_ns) as i64;
        let next_frame = |record: &TraceRecord, since_ns: i64| {
            let id = expected?.id;
            let frame = record.frame().filter(|frame| frame.id() == id)?;
            (record.channel == self.args.channel.number() && !frame.is_remote() && record.time_ns > since_ns)
                .then_some(record.time_ns)
        };
        while !interrupt::requested() {
            let Some(batch) = records.next_batch(LOOK_EVERY)? else { return Ok(outcome) };
            let was_silent = batch.is_empty();
            for record in &batch {
                if let Some(prediction) = &mut prediction {
                    prediction.take(record);
                }
                if record.channel == self.args.channel.number() {
                    seen.push(*record);
                }
                if let TraceEvent::Disturbed { length_ns } = record.event {
                    let time_ns = record.time_ns;
                    outcome = Some(Outcome { at_ticks: at, time_ns, length_ns, errors: 0, late_ns: None });
                }
            }
            records.recycle(batch);
            let now = device.time()?;
            let Some(known) = &mut outcome else {
                if now > at + self.ms(REPORTED_WITHIN_MS) {
                    bail!("the device has not reported the disturbance; `cantap status` shows how it is");
                }
                continue;
            };
            let during = known.time_ns..=known.time_ns + window_ns;
            let is_error = |record: &&TraceRecord| {
                matches!(record.event, TraceEvent::BusError { .. }) && during.contains(&record.time_ns)
            };
            known.errors = seen.iter().filter(is_error).count() as u32;
            known.late_ns = expected.and_then(|expected| {
                let ended_ns = seen.iter().find_map(|record| next_frame(record, known.time_ns))?;
                Some(ended_ns - expected.end_ns)
            });
            let complete = expected.is_none() || known.late_ns.is_some();
            let patience_ms = if complete { SETTLED_MS } else { REPORTED_WITHIN_MS };
            if complete && was_silent || now > at + self.ms(patience_ms) {
                return Ok(outcome);
            }
        }
        Ok(outcome)
    }

    fn print(&self, outcome: &Outcome) -> anyhow::Result<()> {
        let Outcome { at_ticks, time_ns, length_ns, errors, late_ns } = outcome;
        let mut out = std::io::stdout().lock();
        if self.args.json {
            let object = serde_json::json!({
                "channel": self.args.channel.number(),
                "at_ticks": at_ticks,
                "time_s": *time_ns as f64 / 1e9,
                "length_us": f64::from(*length_ns) / 1000.0,
                "errors": errors,
                "late_us": late_ns.map(|late_ns| late_ns as f64 / 1000.0),
            });
            writeln!(out, "{object}")?;
        } else {
            let event = TraceEvent::Disturbed { length_ns: *length_ns };
            let (seconds, us) = (time_ns / 1_000_000_000, time_ns / 1000 % 1_000_000);
            let errors = match errors {
                0 => "no bus error".to_owned(),
                errors => counted(*errors as usize, "bus error"),
            };
            write!(out, "({seconds}.{us:06}) can{} {event}; {errors}", self.args.channel.index())?;
            if let Some(late_ns) = late_ns {
                write!(
                    out,
                    "; the next frame ended {:.1} us later than predicted",
                    *late_ns as f64 / 1000.0
                )?;
            }
            writeln!(out)?;
        }
        out.flush()?;
        Ok(())
    }
}
