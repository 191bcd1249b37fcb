//! `cantap capture`: what a device hears, into a file.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::device::{Gaps, channel_number};
use cantap::{TraceEvent, TraceRecord};
use cantap_formats::{Format, ReadOptions, TraceWriter, create_writer, open_reader};
use cantap_signals::trigger::{Trigger, TriggerCounts};
use cantap_trace::filter::Filter;

use super::convert::{WriteArgs, report as report_left_out, shown};
use crate::address::Address;
use crate::boards::Boards;
use crate::channel_args::ChannelArgs;
use crate::live::{Line, LiveRecords};
use crate::losses::Losses;
use crate::meter::{Meter, rounded};
use crate::progress::Progress;
use crate::trigger_args::TriggerArgs;
use crate::wrong::wrong;
use crate::{args, stderr};

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
                        cantap capture -d /dev/ttyACM0 -d /dev/ttyACM1 -b 500k -b 3:250k -o both.blf\n  \
                        cantap capture -d /dev/ttyACM0 -b 500k --db car.dbc --trigger 'Speed > 80' --pre 2s --post 5s -o fast.log"
)]
pub struct Args {
    /// Where the device is: a serial port, or virtual. Repeat for several boards in one trace: the second one's channels are 3 and
    /// 4, and so on. Without it, the board that is connected.
    #[arg(short, long = "device", value_name = "DEVICE")]
    devices: Vec<Address>,
    /// Which channels: 1, 2, several as 1,3, or both, which is all.
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
    /// Write over a file that is there already.
    #[arg(long, requires = "output")]
    force: bool,
    /// End after so many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// End after this time, as 10, 500ms or 2m.
    #[arg(short, long, value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// End with exit code 1 when every device has been away for so long. With -n it is 30s unless given, otherwise never: a device
    /// that is back goes on.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    give_up_after: Option<Duration>,
    /// Print one JSON object with the summary.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    trigger: TriggerArgs,
    #[command(flatten)]
    write: WriteArgs,
}

/// With a number of frames to wait for, devices that have been away for so long are given up.
const GIVE_UP_AFTER: Duration = Duration::from_secs(30);
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
    /// If there are several.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    devices: Vec<DeviceSummary>,
    /// If there were any.
    #[serde(skip_serializing_if = "Option::is_none")]
    gaps: Option<GapSummary>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trigger: Option<TriggerSummary>,
    /// After a failure: how many of the frames the file has.
    #[serde(skip_serializing_if = "Option::is_none")]
    frames_in_file: Option<u64>,
}

/// One of several devices.
#[derive(serde::Serialize)]
struct DeviceSummary {
    device: String,
    channels: Vec<u8>,
    clock_drift_ppm: Option<f64>,
    /// Whether its times are on the first device's clock by USB frames.
    by_usb_frames: bool,
    /// Why not.
    no_usb_frames_because: Option<String>,
    /// From when on, in seconds since the Unix epoch.
    by_usb_frames_since_s: Option<f64>,
    /// How far its own round trips had put its times off by then.
    moved_us: f64,
    /// How far off the first device's its times may be without USB frames.
    uncertainty_us: Option<f64>,
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
fn needs_bit_rate(args: &Args, board: usize, boards: &Boards) -> anyhow::Result<bool> {
    let timing = args.open.timing.on_board(board);
    for channel in boards.channels_of(board) {
        if timing.request(channel)?.is_none() {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let boards = Boards::new(&args.devices, &args.channel)?;
    args.open.timing.check_channels(boards.addresses().len())?;
    for (board, address) in boards.addresses().iter().enumerate() {
        // A virtual device without settings has no bit rate saved.
        if !address.may_have_saved() && !address.is_car() && needs_bit_rate(args, board, &boards)? {
            return Err(wrong(
                "give the bus's bit rate with -b, such as -b 500k, for each channel that -c names",
            ));
        }
    }
    refuse_output(args)?;
    let mut live = LiveRecords::open(&boards, &args.open, &args.filter, args.time)?;
    live.give_up_after(args.give_up_after.or(args.frames.map(|_| GIVE_UP_AFTER)));
    let mut sink = Sink::create(args)?;
    let started = Instant::now();
    let mut channels: Vec<_> = boards.channel_numbers().map(|number| (number, Meter::new(0))).collect();
    for (number, config, can_clock_hz) in live.opened() {
        if let Some((_, meter)) = channels.iter_mut().find(|(channel, _)| *channel == number) {
            *meter = Meter::of(&config, can_clock_hz);
        }
        if config.omit_data {
            sink.omits_data.push(number);
        }
    }
    let mut meters = Meters { channels };
    let end = write_all(args, &mut live, &mut sink, &mut meters);
    let seconds = started.elapsed().as_secs_f64();
    let trigger = sink.trigger.as_ref().map(TriggerSummary::of);
    let finished = sink.finish();
    let failed = end.is_err() || finished.is_err();
    let gaps = live.lines().lines().map(Line::gaps);
    let gaps = gaps.fold(Gaps::default(), |sum, gaps| Gaps {
        count: sum.count + gaps.count,
        time: sum.time + gaps.time,
    });
    let counters = live.lines().lines().map(Line::counters);
    let summary = Summary {
        seconds: rounded(seconds, 3),
        channels: meters.channels.iter().map(|(number, meter)| summarize(*number, meter)).collect(),
        lost: counters.map(|counters| Losses::of(&counters)).fold(Losses::default(), Losses::plus),
        clock_drift_ppm: live.lines().lines().next().and_then(drift_ppm),
        devices: devices(&live, &boards),
        gaps: (gaps.count > 0)
            .then(|| GapSummary { count: gaps.count, seconds: rounded(gaps.time.as_secs_f64(), 3) }),
        trigger,
        frames_in_file: if failed { frames_in_file(args) } else { None },
    };
    report(args, &summary)?;
    end?;
    finished?;
    judge_errors(args, &live, &summary)?;
    Ok(ExitCode::SUCCESS)
}

/// Refuses a file that cannot be written as asked, before a device is touched.
fn refuse_output(args: &Args) -> anyhow::Result<()> {
    let Some(path) = args.output.as_deref().filter(|path| path.as_os_str() != "-") else { return Ok(()) };
    if args.write.options(implied_format(path))?.format.is_none() {
        Format::of_path(path)?;
    }
    // Files that follow one another take numbers that are free.
    if path.is_file() && !args.force && args.write.rotate.is_empty() {
        bail!("'{}' is there already; choose another name, or write over it with --force", path.display());
    }
    Ok(())
}

fn drift_ppm(line: &Line) -> Option<f64> {
    line.clock().drift_ppm.map(|ppm| rounded(ppm, 2))
}

/// What is known of several devices' clocks; nothing of one, which is its own.
fn devices(live: &LiveRecords, boards: &Boards) -> Vec<DeviceSummary> {
    if live.addresses().len() < 2 {
        return Vec::new();
    }
    let uncertainty_ns = |line: &Line| line.clock().uncertainty_ns;
    let first_ns = live.lines().lines().next().and_then(uncertainty_ns);
    let mut followers = live.lines().clocks();
    let summary = |(board, (line, address)): (usize, (&Line, &Address))| {
        let clock = if board == 0 { None } else { followers.next() };
        let common = clock.map_or(Ok(()), |clock| clock.common);
        let apart_ns = common.is_err().then(|| Some(first_ns? + uncertainty_ns(line)?)).flatten();
        DeviceSummary {
            device: address.to_string(),
            channels: boards.channels_of(board).map(|channel| channel_number(board, channel)).collect(),
            clock_drift_ppm: drift_ppm(line),
            by_usb_frames: common.is_ok(),
            no_usb_frames_because: common.err().map(|reason| reason.to_string()),
            by_usb_frames_since_s: clock.and_then(|clock| clock.since_ns).map(|ns| ns as f64 / 1e9),
            moved_us: clock.map_or(0.0, |clock| clock.moved_ns as f64 / 1e3),
            uncertainty_us: apart_ns.map(|ns| ns as f64 / 1e3),
        }
    };
    live.lines().lines().zip(live.addresses()).enumerate().map(summary).collect()
}

impl DeviceSummary {
    /// How well its times are on the first device's clock, for people.
    fn line(&self) -> String {
        let Self { device, moved_us, uncertainty_us, .. } = self;
        let channels: Vec<String> = self.channels.iter().map(u8::to_string).collect();
        let clock = match (&self.no_usb_frames_because, self.by_usb_frames_since_s) {
            (None, Some(_)) => {
                format!(
                    "on the first device's clock by USB frames (its own round trips were {moved_us} us off)"
                )
            }
            (None, None) => "coming to the first device's clock by USB frames".to_owned(),
            (Some(reason), _) => {
                let known = uncertainty_us.map_or(String::new(), |us| format!(", to {us:.0} us or better"));
                format!("on the first device's clock by UTC alone{known}: {reason}")
            }
        };
        format!("channels {} of '{device}': {clock}", channels.join(" and "))
    }
}

/// The channels that are captured, by number.
struct Meters {
    channels: Vec<(u8, Meter)>,
}

impl Meters {
    fn push(&mut self, record: &TraceRecord) {
        if let Some((_, meter)) = self.channels.iter_mut().find(|(number, _)| *number == record.channel) {
            meter.push(record);
        }
    }

    fn frames(&self) -> u64 {
        self.channels.iter().map(|(_, meter)| meter.frames()).sum()
    }
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
    meters: &mut Meters,
) -> anyhow::Result<()> {
    let mut rescues: Vec<_> =
        (0..live.addresses().len()).map(|board| args.open.on_board(board).rescue()).collect();
    let mut flushed = Instant::now();
    let mut view = View::of(args);
    let mut batch = Vec::new();
    while live.next_batch(&mut batch)? {
        for record in batch.iter().filter(|record| args.counts(record)) {
            meters.push(record);
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
        if let Some(view) = &mut view {
            view.show(meters);
        }
        for (board, device) in live.lines().devices() {
            match rescues[board].look(device) {
                // The stream tells.
                Err(error) if error.is_of_the_connection() => {}
                looked => looked?,
            }
        }
    }
    Ok(())
}

/// What the terminal shows of a capture into a file while it runs.
struct View {
    progress: Progress,
    path: PathBuf,
    started: Instant,
    /// When it was last written, with the frames of each channel by then.
    before: Option<(Instant, Vec<u64>)>,
}

impl View {
    /// Where records go to standard output, they are what is seen.
    fn of(args: &Args) -> Option<Self> {
        let path = args.output.clone().filter(|path| path.as_os_str() != "-")?;
        Some(Self { progress: Progress::start()?, path, started: Instant::now(), before: None })
    }

    fn show(&mut self, meters: &Meters) {
        let Self { progress, path, started, before } = self;
        progress.tell(|| {
            let now = Instant::now();
            let counts = meters.channels.iter().map(|(_, meter)| meter.frames()).collect();
            let last = before.replace((now, counts));
            let channels = meters.channels.iter().enumerate().map(|(index, (number, meter))| {
                let rate = last.as_ref().map(|(then, counts)| {
                    (meter.frames() - counts[index]) as f64
                        / now.duration_since(*then).as_secs_f64().max(1e-3)
                });
                let rate = rate.map_or(String::new(), |rate| format!(" {rate:.0}/s"));
                let load = meter.bus_load_pct().map_or(String::new(), |load| format!(" {load:.0} %"));
                format!("{number}: {} frames{rate}{load}", meter.frames())
            });
            let channels = channels.collect::<Vec<_>>().join("  ");
            let lost: u64 = meters.channels.iter().map(|(_, meter)| meter.lost()).sum();
            let size = std::fs::metadata(&*path).map_or(0, |metadata| metadata.len());
            format!(
                "{:.0} s  {channels}  lost {lost}  {:.1} MB  Ctrl-C ends it",
                started.elapsed().as_secs_f64(),
                size as f64 / 1e6
            )
        });
    }
}

/// Whether a limit is reached, so that what follows is not wanted.
fn is_enough(args: &Args, sink: &Sink, meters: &Meters) -> bool {
    args.frames.is_some_and(|frames| meters.frames() >= frames)
        || sink.trigger.as_ref().is_some_and(|trigger| args.trigger.is_over(trigger))
}

fn summarize(channel: u8, meter: &Meter) -> ChannelSummary {
    ChannelSummary {
        channel,
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

/// Says what it means that channels heard errors and no frame, where that was not said on the way; an error if nothing else was
/// heard at all. With a filter, frames may be there all the same.
fn judge_errors(args: &Args, live: &LiveRecords, summary: &Summary) -> anyhow::Result<()> {
    if !args.filter.is_empty() {
        return Ok(());
    }
    let mut deaf = summary.channels.iter().filter(|channel| channel.frames == 0 && channel.bus_errors > 0);
    if summary.channels.iter().all(|channel| channel.frames == 0)
        && let Some(first) = deaf.next()
    {
        bail!(live.errors_only(first.channel));
    }
    for channel in deaf.filter(|channel| !live.has_told_errors(channel.channel)) {
        stderr::warn(&live.errors_only(channel.channel));
    }
    Ok(())
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
    for device in summary.devices.iter().skip(1) {
        eprintln!("{}", device.line());
    }
    Ok(())
}

/// Where records go.
struct Sink {
    writer: Option<Box<dyn TraceWriter>>,
    name: String,
    to_stdout: bool,
    trigger: Option<Trigger>,
    /// Channels, by number, that were opened to leave data out.
    omits_data: Vec<u8>,
    /// Frames written whose data is not known.
    without_data: u64,
}

impl Sink {
    fn create(args: &Args) -> anyhow::Result<Self> {
        let mut sink = Self {
            writer: None,
            name: String::new(),
            to_stdout: false,
            trigger: args.trigger.trigger(&args.devices)?,
            omits_data: Vec::new(),
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
            *without_data += u64::from(has_data && omits_data.contains(&record.channel));
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
