//! `cantap capture`: captures what a device receives, into a file.

mod sink;
mod summary;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use cantap::{TraceEvent, TraceRecord};
use cantap_address::Address;
use cantap_formats::{ChannelInfo, Format, ReadOptions, WriteOptions, open_reader};
use cantap_signals::named::NamedFilter;
use cantap_signals::trigger::Trigger;
use cantap_trace::counted;
use cantap_trace::filter::{Filter, passes};

use self::sink::Sink;
use self::summary::{ChannelSummary, Summary, TriggerSummary};
use super::convert::WriteArgs;
use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::input::resolved;
use crate::progress::Progress;
use crate::stderr;
use crate::trace_output::{refuse_older, refuse_unwritten};
use crate::trigger_args::TriggerArgs;
use crate::usage_error::usage;
use cantap_work::boards::Boards;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::channels::Channels;
use cantap_work::live::LiveRecords;
use cantap_work::{Meter, lost_frames};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Channels only listen, unless --mode says otherwise: nothing is sent and nothing acknowledged. Without \
                -o the trace goes to standard output, unless --json is given.\n\n\
                The summary counts a channel's bus errors whatever the filters, those reported and those only counted. \
                What is not known is – with its reason (null with --json): frames/s and bus load with --no-stamps, the \
                bus load where --no-data left data out, and where the device's filters keep frames back.\n\n\
                Examples:\n  \
                cantap capture -d /dev/ttyACM0 -b 500k -o drive.log\n  \
                cantap capture -d virtual -b 1M -n 1000\n  \
                cantap capture -d COM5 -c 2 -b 250k -t 60s -o trace.blf --json\n  \
                cantap capture -d /dev/ttyACM0 -d /dev/ttyACM1 -b 500k -b 3:250k -o both.blf\n  \
                cantap capture -d /dev/ttyACM0 -b 500k --db car.dbc --trigger 'Speed > 80' \\\n      \
                --pre 2s --post 5s -o fast.log"
)]
pub struct Args {
    /// Where the device is: a serial port, or virtual. Repeat for several boards in one trace: the second one's channels are 3 and
    /// 4, and so on. Without it, the board that is connected.
    #[arg(short, long = "device", value_name = "DEVICE", add = completion::devices())]
    devices: Vec<Address>,
    /// Which channels: 1, 2, several as 1,3, or both, which means all.
    #[arg(short, long, default_value = "both", value_parser = args::channels, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Only these frames, in candump's syntax: can0,123:7FF,400~7F0,#FF,j; with --db also EngineData. In hardware as far as it can, where 123:7FF counts
    /// twice (standard and extended) and 123:C00007FF once. Repeat for any of several.
    #[arg(short, long, value_name = "FILTER")]
    filter: Vec<NamedFilter>,
    /// File to write; its suffix determines the format, unless --format does. Without a suffix it is a candump
    /// log.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite an existing file.
    #[arg(long, requires = "output")]
    force: bool,
    /// End after this many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// End after this time, as 10, 500ms or 2m.
    #[arg(short, long, value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// End with exit code 1 when every device has been away for this long. The default is 30s with -n, otherwise never: a device
    /// that comes back continues.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    give_up_after: Option<Duration>,
    /// Keep intervals as the device's crystal measures them. Otherwise times follow UTC, and corrections change the intervals around them, by up
    /// to 100 ppm.
    #[arg(long)]
    device_intervals: bool,
    /// Print one JSON object with the summary.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    trigger: TriggerArgs,
    #[command(flatten)]
    write: WriteArgs,
}

/// When waiting for a number of frames, devices that have been away for this long are given up.
const GIVE_UP_AFTER: Duration = Duration::from_secs(30);
/// How long records may stay in memory while others arrive slowly.
const FLUSH_EVERY: Duration = Duration::from_millis(200);

/// Whether a channel to be opened has no bit rate.
fn needs_bit_rate(args: &Args, board: usize, boards: &Boards) -> anyhow::Result<bool> {
    let timing = args.open.options().timing.on_board(board);
    for channel in boards.channels_of(board) {
        if timing.request(channel)?.is_none() && !timing.is_auto(channel.number()) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let boards = Boards::new(&args.devices, &args.channel)?;
    args.open.options().timing.check_channels(boards.addresses().len())?;
    for (board, address) in boards.addresses().iter().enumerate() {
        // A virtual device without settings has no bit rate saved.
        if !address.may_have_saved() && !address.has_bit_rate() && needs_bit_rate(args, board, &boards)? {
            return Err(usage(
                "give the bus's bit rate with -b, such as -b 500k, for each channel that -c names",
            ));
        }
    }
    refuse_output(args)?;
    let decoder = args.trigger.decoder(boards.addresses())?;
    let trigger = args.trigger.trigger(&decoder)?;
    let filters = resolved(&args.filter, &decoder)?;
    let open = ChannelOptions { device_intervals: args.device_intervals, ..args.open.options() };
    let mut live = LiveRecords::open(&boards, &open, &filters, args.time, &stderr::reporter())?;
    live.give_up_after(args.give_up_after.or(args.frames.map(|_| GIVE_UP_AFTER)));
    // The requested time starts here.
    let started = Instant::now();
    let mut sink = create_sink(args, trigger, live.channels())?;
    let mut channels: Vec<_> = boards.channel_numbers().map(|number| (number, Meter::new(0))).collect();
    for (number, config, can_clock_hz) in live.opened() {
        if let Some((_, meter)) = channels.iter_mut().find(|(channel, _)| *channel == number) {
            *meter = Meter::of(&config, can_clock_hz);
        }
        if config.omit_data {
            sink.omits_data.push(number);
        }
    }
    let data_rates = live.data_bit_rates();
    let data_rate = |number: u8| data_rates.iter().find(|(of, _)| *of == number).map(|(_, rate)| *rate);
    // One that was left out has no figures.
    channels.retain(|(number, _)| live.opened().any(|(opened, ..)| opened == *number));
    let filtered = live.filtered();
    let channels = channels
        .into_iter()
        .map(|(number, meter)| (number, meter.with_data_bitrate(data_rate(number))))
        .map(|(number, meter)| (number, if filtered.contains(&number) { meter.filtered() } else { meter }));
    let mut meters = Meters { channels: channels.collect() };
    let end = write_all(args, &filters, &mut live, &mut sink, &mut meters);
    let seconds = started.elapsed().as_secs_f64();
    let trigger = sink.trigger.as_ref().map(TriggerSummary::of);
    let finished = sink.finish();
    let failed = end.is_err() || finished.is_err();
    let of = |(number, meter): &(u8, Meter)| ChannelSummary::of(*number, meter, live.hint(*number));
    let channels = meters.channels.iter().map(of).collect();
    let mut summary = Summary::of(seconds, channels, &live, &boards);
    summary.trigger = trigger;
    summary.frames_in_file = if failed { frames_in_file(args) } else { None };
    summary.is_closed = matches!(finished, Ok(false));
    summary.tell(args.json, args.output.as_deref())?;
    end?;
    finished?;
    for (number, _) in &meters.channels {
        if let Some(hint) = live.hint_sentence(*number) {
            stderr::warn(&hint);
        }
    }
    live.judge()?;
    Ok(ExitCode::SUCCESS)
}

/// Where the records go.
fn create_sink(args: &Args, trigger: Option<Trigger>, channels: Vec<ChannelInfo>) -> anyhow::Result<Sink> {
    let mut sink = Sink::new(trigger);
    let path = match &args.output {
        Some(path) => path.as_path(),
        // Standard output is then reserved for one JSON object.
        None if args.json => return Ok(sink),
        None => Path::new("-"),
    };
    let options = args.write.options(implied_format(path))?;
    sink.create(path, &WriteOptions { channels, ..options })?;
    Ok(sink)
}

/// Refuses a file that cannot be written as asked, before a device is touched.
fn refuse_output(args: &Args) -> anyhow::Result<()> {
    let path = args.output.as_deref();
    if let (None, true, Some(option)) = (path, args.json, args.write.given()) {
        return Err(usage(format!(
            "{option} is about a trace, and --json without -o writes none; give its name with -o"
        )));
    }
    let path = path.filter(|path| path.as_os_str() != "-");
    let given = args.write.options(path.map_or(Some(Format::Candump), implied_format))?.format;
    let format = match (given, path) {
        (None, Some(path)) => Format::of_path(path)?,
        (given, _) => given.unwrap_or(Format::Candump),
    };
    refuse_unwritten(format)?;
    args.write.check_style(Some(format))?;
    let Some(path) = path else { return Ok(()) };
    // Files of a series get numbers that are free.
    if args.write.rotate.is_empty() { refuse_older(path, args.force) } else { Ok(()) }
}

/// The captured channels, by number.
struct Meters {
    channels: Vec<(u8, Meter)>,
}

impl Meters {
    /// Takes a record; one that does not count still loads its bus.
    fn push(&mut self, record: &TraceRecord, counts: bool) {
        if let Some((_, meter)) = self.channels.iter_mut().find(|(number, _)| *number == record.channel) {
            if counts { meter.push(record) } else { meter.pass_by(record) }
        }
    }

    fn frames(&self) -> u64 {
        self.channels.iter().map(|(_, meter)| meter.frames()).sum()
    }
}

/// Whether a record counts in the summary: errors describe the state of the bus, whatever is captured of it.
fn counts(filters: &[Filter], record: &TraceRecord) -> bool {
    matches!(record.event, TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. })
        || passes(filters, record)
}

/// Writes what is captured until Ctrl-C or a limit, including what had been captured by then.
fn write_all(
    args: &Args,
    filters: &[Filter],
    live: &mut LiveRecords,
    sink: &mut Sink,
    meters: &mut Meters,
) -> anyhow::Result<()> {
    let mut recoveries: Vec<_> = (0..live.addresses().len())
        .map(|board| args.open.options().on_board(board).bus_off_recovery(&stderr::reporter()))
        .collect();
    let mut flushed = Instant::now();
    let mut view = View::of(args);
    let mut batch = Vec::new();
    while live.next_batch(&mut batch)? {
        for record in &batch {
            meters.push(record, counts(filters, record));
            // What the hardware could not filter is filtered here.
            if !passes(filters, record) {
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
            match recoveries[board].look(device) {
                // The stream reports it.
                Err(error) if error.is_of_the_connection() => {}
                looked => looked?,
            }
        }
    }
    Ok(())
}

/// The terminal's display of a capture into a file while it runs.
struct View {
    progress: Progress,
    path: PathBuf,
    started: Instant,
    /// When it was last updated, with the number of frames of each channel at that time.
    before: Option<(Instant, Vec<u64>)>,
}

impl View {
    /// If records go to standard output, they are the display.
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
                format!("{number}: {}{rate}{load}", counted(meter.frames(), "frame"))
            });
            let channels = channels.collect::<Vec<_>>().join("  ");
            let of = |meter: &Meter| (meter.lost(), meter.lost_at_least());
            let lost = meters.channels.iter().map(|(_, meter)| of(meter));
            let (lost, at_least) = lost.fold((0, false), |sum, of| (sum.0 + of.0, sum.1 | of.1));
            let lost = lost_frames(lost, at_least);
            let size = std::fs::metadata(&*path).map_or(0, |metadata| metadata.len());
            format!(
                "{:.0} s  {channels}  lost {lost}  {:.1} MB  Ctrl-C ends it",
                started.elapsed().as_secs_f64(),
                size as f64 / 1e6
            )
        });
    }
}

/// Whether a limit has been reached, so that nothing more is wanted.
fn is_enough(args: &Args, sink: &Sink, meters: &Meters) -> bool {
    args.frames.is_some_and(|frames| meters.frames() >= frames)
        || sink.trigger.as_ref().is_some_and(|trigger| args.trigger.is_over(trigger))
}

/// The format if the file's suffix does not determine one.
fn implied_format(path: &Path) -> Option<Format> {
    path.extension().is_none().then_some(Format::Candump)
}

/// The number of frames in the only regular file that was written, by reading it again; `None` if there is no such file,
/// or not every frame was meant for it.
fn frames_in_file(args: &Args) -> Option<u64> {
    let is_one = args.write.rotate.is_empty() && args.trigger.trigger.is_none();
    let path = args.output.as_deref().filter(|path| is_one && path.is_file())?;
    let format = args.write.options(implied_format(path)).ok()?.format;
    let options = ReadOptions { format, ..ReadOptions::default() };
    let records = open_reader(path, &options).ok()?.filter_map(Result::ok);
    Some(records.filter(|record| record.frame().is_some()).count() as u64)
}
