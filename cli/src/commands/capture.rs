//! `cantap capture`: what a device hears, into a file.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Context;
use cantap::wire::CHANNELS;
use cantap::wire::message::Mode;
use cantap::{Channel, TraceEvent, TraceRecord};
use cantap_formats::{Format, ReadOptions, TraceWriter, create_writer, open_reader};
use cantap_signals::trigger::{Trigger, TriggerCounts};
use cantap_trace::filter::Filter;

use super::convert::{WriteArgs, report as report_left_out, shown};
use crate::address::Address;
use crate::args;
use crate::channel_args::ChannelArgs;
use crate::live::LiveRecords;
use crate::losses::Losses;
use crate::meter::{Meter, rounded};
use crate::trigger_args::TriggerArgs;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Channels only listen, unless --mode says otherwise: nothing is sent and nothing acknowledged.\n\
                        Without -o the trace goes to standard output, unless --json is given.\n\n\
                        The summary counts a channel's bus errors whatever the filters, those reported and those only counted. With \
                        --no-stamps\nit has no frames/s and no bus load, with --no-data no bus load where data was left out \
                        (null with --json): they are not known.\n\n\
                        Examples:\n  cantap capture -d /dev/ttyACM0 -b 500k -o drive.log\n  \
                        cantap capture -d virtual -b 1M -n 1000\n  \
                        cantap capture -d COM5 -c 2 -b 250k -t 60s -o trace.blf --json\n  \
                        cantap capture -d /dev/ttyACM0 -b 500k --db car.dbc --trigger 'Speed > 80' --pre 2s --post 5s -o fast.log"
)]
pub struct Args {
    /// Where the device is: a serial port, or virtual.
    #[arg(short, long)]
    device: Address,
    /// Which channels: 1, 2 or both.
    #[arg(short, long, default_value = "both", value_parser = args::channels)]
    channel: args::Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j. In hardware as far as it can, where 123:7FF counts
    /// twice (standard and extended) and 123:C00007FF once. Repeat for any of several.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<Filter>,
    /// File to write; its suffix picks the format, if --format does not. Without a suffix it is a candump log.
    #[arg(short, long)]
    output: Option<PathBuf>,
    /// End after this many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// End after this time, as 10, 500ms or 2m.
    #[arg(short, long, value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Print one JSON object with the summary.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    trigger: TriggerArgs,
    #[command(flatten)]
    write: WriteArgs,
}

/// How long records may stay in memory while others follow slowly.
const FLUSH_EVERY: Duration = Duration::from_millis(200);

/// A channel in the JSON object.
#[derive(serde::Serialize)]
struct ChannelSummary {
    channel: u8,
    frames: u64,
    lost: u64,
    /// Reported and suppressed ones, whatever the filters.
    bus_errors: u64,
    /// `null` where the device left out what it takes to know it, as the next one.
    frames_per_s: Option<f64>,
    bus_load_pct: Option<f64>,
}

#[derive(serde::Serialize)]
struct Summary {
    seconds: f64,
    channels: Vec<ChannelSummary>,
    lost: Losses,
    clock_drift_ppm: Option<f64>,
    /// If there were any.
    #[serde(skip_serializing_if = "Option::is_none")]
    gaps: Option<GapSummary>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trigger: Option<TriggerSummary>,
    /// After a failure: how many of the frames the file has.
    #[serde(skip_serializing_if = "Option::is_none")]
    frames_in_file: Option<u64>,
}

/// Times in which the device was not there. The frames of that time are in no count.
#[derive(serde::Serialize)]
struct GapSummary {
    count: u32,
    seconds: f64,
}

#[derive(serde::Serialize)]
struct TriggerSummary {
    events: u64,
    kept: u64,
    forgotten: u64,
}

impl TriggerSummary {
    fn of(trigger: &Trigger) -> Self {
        let TriggerCounts { events, kept, forgotten } = trigger.counts();
        Self { events, kept, forgotten }
    }
}

/// Whether a channel to open has no bit rate.
fn needs_bit_rate(args: &Args) -> anyhow::Result<bool> {
    for channel in args.channel.iter() {
        if args.open.timing.request(channel)?.is_none() {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    // A virtual device without settings has no bit rate saved.
    if !args.device.may_have_saved() && !args.device.is_car() && needs_bit_rate(args)? {
        let message = "give the bus's bit rate with -b, such as -b 500k, for each channel that -c names\n";
        clap::Error::raw(clap::error::ErrorKind::MissingRequiredArgument, message).exit();
    }
    let (open, channels, filters) = (args.open.clone(), args.channel, args.filter.clone());
    let mut live = LiveRecords::open(&args.device, args.time, move |device| {
        open.open(device, channels.iter(), Mode::ListenOnly, Some(&filters)).map(|_| ())
    })?;
    let mut sink = Sink::create(args)?;
    let started = Instant::now();
    let mut meters = Channel::ALL.map(|_| Meter::new(0));
    if let Some(device) = live.line().device() {
        for (channel, config) in device.open_channels() {
            meters[channel.index()] = Meter::of(&config, device.hello().can_clock_hz);
            sink.omits_data[channel.index()] = config.omit_data;
        }
    }
    let end = write_all(args, &mut live, &mut sink, &mut meters);
    let seconds = started.elapsed().as_secs_f64();
    let trigger = sink.trigger.as_ref().map(TriggerSummary::of);
    let finished = sink.finish();
    let failed = end.is_err() || finished.is_err();
    let gaps = live.line().gaps();
    let summary = Summary {
        seconds: rounded(seconds, 3),
        channels: args.channel.iter().map(|channel| summarize(channel, &meters)).collect(),
        lost: Losses::of(&live.line().counters()),
        clock_drift_ppm: live.line().clock().drift_ppm.map(|ppm| rounded(ppm, 2)),
        gaps: (gaps.count > 0)
            .then(|| GapSummary { count: gaps.count, seconds: rounded(gaps.time.as_secs_f64(), 3) }),
        trigger,
        frames_in_file: if failed { frames_in_file(args) } else { None },
    };
    report(args, &summary)?;
    end?;
    finished?;
    Ok(ExitCode::SUCCESS)
}

impl Args {
    /// What the hardware could not filter is filtered here.
    fn accepts(&self, record: &TraceRecord) -> bool {
        self.filter.is_empty() || self.filter.iter().any(|filter| filter.accepts(record))
    }

    /// Whether a record counts in the summary: errors say how the bus is, whatever is captured of it.
    fn counts(&self, record: &TraceRecord) -> bool {
        matches!(record.event, TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. })
            || self.accepts(record)
    }
}

/// Writes what is captured until Ctrl-C or a limit, and what had been captured by then.
fn write_all(
    args: &Args,
    live: &mut LiveRecords,
    sink: &mut Sink,
    meters: &mut [Meter; 2],
) -> anyhow::Result<()> {
    let mut rescue = args.open.rescue();
    let mut flushed = Instant::now();
    let mut batch = Vec::new();
    while live.next_batch(&mut batch)? {
        for record in batch.iter().filter(|record| args.counts(record)) {
            meters[usize::from(record.channel == 2)].push(record);
            if !args.accepts(record) {
                continue;
            }
            if !sink.write(record)? || is_enough(args, sink, meters) {
                return live.end();
            }
        }
        if flushed.elapsed() >= FLUSH_EVERY {
            if !sink.flush()? {
                return live.end();
            }
            flushed = Instant::now();
        }
        match live.line().device().map(|device| rescue.look(device)) {
            // The stream tells.
            Some(Err(error)) if error.is_of_the_connection() => {}
            Some(looked) => looked?,
            None => {}
        }
    }
    Ok(())
}

/// Whether a limit is reached, so that what follows is not wanted.
fn is_enough(args: &Args, sink: &Sink, meters: &[Meter; 2]) -> bool {
    args.frames.is_some_and(|frames| meters.iter().map(Meter::frames).sum::<u64>() >= frames)
        || sink.trigger.as_ref().is_some_and(|trigger| args.trigger.is_over(trigger))
}

fn summarize(channel: Channel, meters: &[Meter; 2]) -> ChannelSummary {
    let meter = &meters[channel.index()];
    ChannelSummary {
        channel: channel.number(),
        frames: meter.frames(),
        lost: meter.lost(),
        bus_errors: meter.bus_errors(),
        frames_per_s: meter.frames_per_s().map(|rate| rounded(rate, 1)),
        bus_load_pct: meter.bus_load_pct().map(|load| rounded(load, 2)),
    }
}

impl ChannelSummary {
    /// One line, without what is not known.
    fn line(&self) -> String {
        let Self { channel, frames, lost, bus_errors, frames_per_s, bus_load_pct } = self;
        let rate = frames_per_s.map_or_else(String::new, |rate| format!(", {rate} frames/s"));
        let load = bus_load_pct.map_or_else(String::new, |load| format!(", bus load {load} %"));
        format!("channel {channel}: {frames} frames{rate}{load}, {lost} lost, {bus_errors} bus errors")
    }
}

/// Says what it usually means that channels heard errors and no frame. With a filter, there may still be frames.
fn explain_errors(args: &Args, summary: &Summary) {
    let has_errors_only = |channel: &&ChannelSummary| channel.frames == 0 && channel.bus_errors > 0;
    for channel in summary.channels.iter().filter(has_errors_only).filter(|_| args.filter.is_empty()) {
        eprintln!(
            "cantap: channel {}: only errors and no frame, which usually means a wrong bit rate or a broken bus; `cantap \
             autobaud` finds the bit rate, if the bus is whole",
            channel.channel
        );
    }
}

/// The format where the file's suffix does not say one.
fn implied_format(path: &Path) -> Option<Format> {
    path.extension().is_none().then_some(Format::Candump)
}

/// How many frames are in the one regular file that was written, by reading it again; `None` if there is no such file, or
/// not every frame was meant for it.
fn frames_in_file(args: &Args) -> Option<u64> {
    let is_one = args.write.rotate.is_empty() && args.trigger.trigger.is_none();
    let path = args.output.as_deref().filter(|path| is_one && path.is_file())?;
    let format = args.write.options(implied_format(path)).ok()?.format;
    let options = ReadOptions { format, ..ReadOptions::default() };
    let records = open_reader(path, &options).ok()?.filter_map(Result::ok);
    Some(records.filter(|record| record.frame().is_some()).count() as u64)
}

fn report(args: &Args, summary: &Summary) -> anyhow::Result<()> {
    explain_errors(args, summary);
    if args.json {
        writeln!(io::stdout().lock(), "{}", serde_json::to_string(summary)?)?;
        return Ok(());
    }
    eprintln!("captured {} s", summary.seconds);
    for channel in &summary.channels {
        eprintln!("{}", channel.line());
    }
    if let Some(TriggerSummary { events, kept, forgotten }) = &summary.trigger {
        eprintln!("trigger: {events} events, {kept} records kept");
        if *forgotten > 0 {
            eprintln!("{forgotten} records before events were too many to remember; use a shorter --pre");
        }
    }
    let frames: u64 = summary.channels.iter().map(|channel| channel.frames).sum();
    if let (Some(path), Some(in_file)) =
        (&args.output, summary.frames_in_file.filter(|in_file| *in_file != frames))
    {
        eprintln!("{in_file} of the {frames} frames are in '{}'", path.display());
    }
    eprintln!("lost: {}", summary.lost.line());
    if let Some(GapSummary { count, seconds }) = &summary.gaps {
        eprintln!(
            "gaps: {count}, {seconds} s in which the device was not there: what was on the bus then nobody counted"
        );
    }
    if let Some(ppm) = summary.clock_drift_ppm {
        let how = if ppm < 0.0 { "slower" } else { "faster" };
        eprintln!("the device's clock runs {} ppm {how} than this computer's", ppm.abs());
    }
    Ok(())
}

/// Where records go.
struct Sink {
    writer: Option<Box<dyn TraceWriter>>,
    name: String,
    to_stdout: bool,
    trigger: Option<Trigger>,
    /// Which channels were opened to leave data out.
    omits_data: [bool; CHANNELS],
    /// Frames written whose data is not known.
    without_data: u64,
}

impl Sink {
    fn create(args: &Args) -> anyhow::Result<Self> {
        let mut sink = Self {
            writer: None,
            name: String::new(),
            to_stdout: false,
            trigger: args.trigger.trigger([&args.device])?,
            omits_data: [false; CHANNELS],
            without_data: 0,
        };
        let path = match &args.output {
            Some(path) => path.as_path(),
            // Standard output is for one JSON object then.
            None if args.json => return Ok(sink),
            None => Path::new("-"),
        };
        let options = args.write.options(implied_format(path))?;
        sink.name = path.display().to_string();
        sink.to_stdout = sink.name == "-";
        let writer = create_writer(path, &options).with_context(|| {
            format!("cannot write to '{}'; choose a folder and name that you may write", sink.name)
        })?;
        sink.writer = Some(writer);
        Ok(sink)
    }

    /// Writes a record, if the trigger does not hold it back. Returns whether anybody still reads.
    fn write(&mut self, record: &TraceRecord) -> anyhow::Result<bool> {
        let Self { writer, omits_data, without_data, .. } = self;
        let mut write = |record: &TraceRecord| {
            let has_data = record.frame().is_some_and(|frame| frame.data_len() > 0);
            *without_data += u64::from(has_data && omits_data[usize::from(record.channel == 2)]);
            writer.as_mut().map_or(Ok(()), |writer| writer.write(record))
        };
        let result = match &mut self.trigger {
            Some(trigger) => trigger.push(record, write),
            None => write(record),
        };
        self.judge(result)
    }

    fn flush(&mut self) -> anyhow::Result<bool> {
        let result = self.writer.as_mut().map_or(Ok(()), |writer| writer.flush());
        self.judge(result)
    }

    fn judge(&mut self, result: io::Result<()>) -> anyhow::Result<bool> {
        match result {
            Ok(()) => Ok(true),
            Err(error) if self.to_stdout && error.kind() == io::ErrorKind::BrokenPipe => {
                self.writer = None;
                Ok(false)
            }
            Err(error) => {
                // Nothing more can be written; what was is complete to the last whole record.
                self.writer = None;
                Err(error).with_context(|| self.failure())
            }
        }
    }

    fn failure(&self) -> String {
        format!(
            "writing to '{}' failed, and what was captured before is in it; make room or choose another place",
            self.name
        )
    }

    /// Ends the file, and says what it could not carry.
    fn finish(mut self) -> anyhow::Result<()> {
        let Some(writer) = self.writer.take() else { return Ok(()) };
        match writer.finish() {
            Ok(left_out) => {
                let path = Path::new(&self.name);
                report_left_out(&left_out, path);
                if self.without_data > 0 {
                    eprintln!(
                        "cantap: {} does not carry the data that the device left out, and has zeros in its place ({})",
                        shown(path),
                        self.without_data
                    );
                }
                Ok(())
            }
            Err(error) if self.to_stdout && error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
            Err(error) => Err(error).with_context(|| self.failure()),
        }
    }
}
