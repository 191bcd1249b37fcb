//! `cantap demo`: the worst possible traffic, without a board, and the check that nothing is lost silently.

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use anyhow::Context;
use cantap::device::{Link, Records};
use cantap::wire::CHANNELS;
use cantap::{Channel, Device, TraceRecord};
use cantap_formats::{Format, ReadOptions, TraceWriter, WriteOptions, create_writer, open_reader};
use cantap_virtual::simbus::Frames;
use cantap_virtual::{Options, SequenceCheck, start};
use cantap_work::{Losses, Meter, duration, interrupt, positive_duration, rounded};
use indicatif::{ProgressBar, ProgressStyle};

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Both channels of a virtual device run at 1 Mbit/s in real time. By default they carry standard frames \
                without data at 100 % load, 20833 frames/s each: more frames than any other traffic. Exit code 0 means \
                that every frame sent was received in order or counted lost.\n\n\
                Examples:\n  \
                cantap demo\n  \
                cantap demo --stall 400ms     the device's queue bridges it\n  \
                cantap demo --stall 3s        frames are lost, and every one is counted\n  \
                cantap demo --kind ext8 --load 80 --time 20s --json"
)]
pub struct Args {
    /// How long to capture, as 10, 500ms or 2m.
    #[arg(short, long, alias = "seconds", value_name = "TIME", default_value = "5s", value_parser = positive_duration)]
    time: Duration,
    /// Bus load in per cent.
    #[arg(long, default_value = "100", value_name = "PCT", value_parser = percent)]
    load: f64,
    /// Which frames: std0, std8, ext0, ext8, rtr or mix.
    #[arg(long, alias = "frames", default_value = "std0")]
    kind: Frames,
    /// Make the host stop reading for this time in mid-run.
    #[arg(long, value_name = "TIME", value_parser = duration)]
    stall: Option<Duration>,
    /// Keep the captured trace in this file.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// The exit code if the check did not hold.
const CHECK_FAILED: u8 = 3;
const BITRATE_BPS: u32 = 1_000_000;
/// The minimum time for which the capture runs before and after a stall.
const AROUND_STALL: Duration = Duration::from_secs(1);
const LOOK_EVERY: Duration = Duration::from_millis(50);

#[derive(serde::Serialize)]
struct ChannelSummary {
    channel: u8,
    sent: u64,
    delivered: u64,
    lost: u64,
    frames_per_s: f64,
    bus_load_pct: f64,
}

#[derive(serde::Serialize)]
struct Summary {
    seconds: f64,
    channels: Vec<ChannelSummary>,
    wire_bytes_per_frame: f64,
    queue_bytes: u32,
    queue_high_water_bytes: u32,
    lost: Losses,
    in_order: bool,
    ok: bool,
}

/// Where the captured trace goes.
pub trait Output {
    /// Adds a record.
    fn write(&mut self, record: &TraceRecord) -> anyhow::Result<()>;
    /// Ends the file.
    fn finish(self: Box<Self>) -> anyhow::Result<()>;
}

/// Begins a file by its name, or by a format if its name tells none.
pub type Create = dyn Fn(&Path, Option<Format>) -> anyhow::Result<Box<dyn Output>>;

/// A file in any of the formats of [`cantap_formats`].
pub fn trace_file(path: &Path, format: Option<Format>) -> anyhow::Result<Box<dyn Output>> {
    let format = format.map_or_else(|| Format::of_path(path), Ok)?;
    let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
    Ok(Box::new(Plain(create_writer(path, &options)?)))
}

struct Plain(Box<dyn TraceWriter>);

impl Output for Plain {
    fn write(&mut self, record: &TraceRecord) -> anyhow::Result<()> {
        Ok(self.0.write(record)?)
    }

    fn finish(self: Box<Self>) -> anyhow::Result<()> {
        Ok(self.0.finish().map(drop)?)
    }
}

/// Runs it, with files that `create` begins.
pub fn run(args: &Args, create: &Create) -> anyhow::Result<ExitCode> {
    interrupt::watch()?;
    let length = args.stall.map_or(args.time, |stall| args.time.max(stall + 2 * AROUND_STALL));
    let options = Options { load_percent: args.load, frames: args.kind, ..Options::default() };
    let connection = start(options.clone())?;
    let witness = Arc::clone(&connection.witness);
    let stall = Stall::default();
    let reader = StallingReader { inner: connection.reader, stall: stall.clone() };
    let link = Link::new(reader, connection.writer).keeping(connection.device);
    let device = Device::over(link, "virtual")?;
    let mut file = TraceFile::create(args.output.as_deref(), create)?;

    let bytes_before = device.counters().bytes;
    for channel in Channel::ALL {
        device.listen(channel, BITRATE_BPS)?;
    }
    let started = Instant::now();
    if let Some(pause) = args.stall {
        stall.plan(started + length.saturating_sub(pause) / 2, pause);
    }
    let mut books = Books::new(&options);
    let mut records = device.records();
    let bar = progress_bar(length, args.json);
    while started.elapsed() < length && !interrupt::requested() {
        if let Some(batch) = records.next_batch(LOOK_EVERY)? {
            for record in &batch {
                books.push(record);
                file.writer.write(record).context("the trace cannot be written; make room on the disk")?;
            }
            records.recycle(batch);
        }
        bar.set_position(started.elapsed().as_millis() as u64);
        bar.set_message(format!("{} frames", books.delivered()));
    }
    let status = device.stop()?;
    drain(&mut records, &mut books, &mut file)?;
    bar.finish_and_clear();

    let counters = device.counters();
    let kept = file.finish()?;
    let heard = witness.activity().frames;
    let received: u64 = counters.channels.iter().map(|channel| channel.received).sum();
    let in_order = books.checks.iter().all(SequenceCheck::in_order);
    let holds = books.checks.iter().zip(heard).all(|(check, sent)| check.holds(sent));
    let summary = Summary {
        seconds: rounded(books.meters.iter().map(Meter::seconds).fold(0.0, f64::max), 3),
        channels: Channel::ALL.map(|channel| books.summarize(channel, heard)).into(),
        wire_bytes_per_frame: per_frame(counters.bytes - bytes_before, received),
        queue_bytes: device.hello().queue_bytes,
        queue_high_water_bytes: status.queue_high_water_bytes,
        lost: Losses::of(&counters),
        in_order,
        ok: holds && kept.is_none_or(|kept| kept == books.delivered()),
    };
    report(args, &summary)?;
    Ok(if summary.ok { ExitCode::SUCCESS } else { ExitCode::from(CHECK_FAILED) })
}

/// What is kept of the records as they arrive.
struct Books {
    meters: [Meter; CHANNELS],
    checks: [SequenceCheck; CHANNELS],
}

impl Books {
    fn new(options: &Options) -> Self {
        Self {
            meters: [Meter::new(BITRATE_BPS), Meter::new(BITRATE_BPS)],
            checks: [0, 1].map(|channel| SequenceCheck::new(options.source(channel))),
        }
    }

    fn push(&mut self, record: &TraceRecord) {
        let channel = usize::from(record.channel == 2);
        self.meters[channel].push(record);
        self.checks[channel].push(record);
    }

    fn delivered(&self) -> u64 {
        self.checks.iter().map(SequenceCheck::delivered).sum()
    }

    fn summarize(&self, channel: Channel, heard: [u64; CHANNELS]) -> ChannelSummary {
        let (meter, check) = (&self.meters[channel.index()], &self.checks[channel.index()]);
        ChannelSummary {
            channel: channel.number(),
            sent: heard[channel.index()],
            delivered: check.delivered(),
            lost: check.lost(),
            frames_per_s: rounded(meter.frames_per_s().unwrap_or(0.0), 1),
            bus_load_pct: rounded(meter.bus_load_pct().unwrap_or(0.0), 2),
        }
    }
}

/// Takes what had been captured by the time the channels were closed.
fn drain(records: &mut Records, books: &mut Books, file: &mut TraceFile) -> anyhow::Result<()> {
    for record in records {
        let record = record?;
        books.push(&record);
        file.writer.write(&record).context("the trace cannot be written; make room on the disk")?;
    }
    Ok(())
}

fn per_frame(bytes: u64, frames: u64) -> f64 {
    if frames == 0 { 0.0 } else { rounded(bytes as f64 / frames as f64, 3) }
}

fn progress_bar(length: Duration, hidden: bool) -> ProgressBar {
    if hidden {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(length.as_millis() as u64);
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} %  {msg}");
    style.map_or(bar.clone(), |style| bar.with_style(style))
}

fn report(args: &Args, summary: &Summary) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    if args.json {
        writeln!(out, "{}", serde_json::to_string(summary)?)?;
        return Ok(());
    }
    writeln!(
        out,
        "two channels at 1 Mbit/s, {} % load of {} frames, {} s",
        args.load, args.kind, summary.seconds
    )?;
    for channel in &summary.channels {
        let ChannelSummary { channel, sent, delivered, lost, frames_per_s, bus_load_pct } = channel;
        writeln!(
            out,
            "channel {channel}: {sent} sent = {delivered} delivered + {lost} lost, {frames_per_s} frames/s, \
             bus load {bus_load_pct} %"
        )?;
    }
    writeln!(out, "on the wire: {} bytes per frame", summary.wire_bytes_per_frame)?;
    writeln!(
        out,
        "device's queue: at most {} of {} bytes full",
        summary.queue_high_water_bytes, summary.queue_bytes
    )?;
    writeln!(out, "lost: {}", summary.lost.line())?;
    if let Some(path) = &args.output {
        writeln!(out, "trace: {}", path.display())?;
    }
    let verdict = if summary.ok {
        "every frame sent was received in order or counted lost"
    } else {
        "THE CHECK DID NOT HOLD: a frame is missing, out of order or not counted"
    };
    writeln!(out, "{verdict}")?;
    Ok(())
}

/// The captured trace: where the user wants it, or in a temporary file that is read back and removed.
struct TraceFile {
    writer: Box<dyn Output>,
    temporary: Option<tempfile::TempPath>,
}

impl TraceFile {
    fn create(output: Option<&Path>, create: &Create) -> anyhow::Result<Self> {
        let mut temporary = None;
        if output.is_none() {
            let file = tempfile::Builder::new().prefix("cantap-demo-").suffix(".log").tempfile();
            temporary = Some(file.context("no temporary file; name one with -o")?.into_temp_path());
        }
        let path = output.or(temporary.as_deref()).unwrap_or(Path::new("-"));
        let format = path.extension().is_none().then_some(Format::Candump);
        let writer = create(path, format)
            .with_context(|| format!("cannot write to '{}'; choose another place with -o", path.display()))?;
        Ok(Self { writer, temporary })
    }

    /// Ends the file. Returns how many frames it contains, if it can be read back.
    fn finish(self) -> anyhow::Result<Option<u64>> {
        self.writer.finish().context("the trace cannot be written; make room on the disk")?;
        let Some(path) = self.temporary else { return Ok(None) };
        let mut frames = 0;
        for record in open_reader(&path, &ReadOptions::default())? {
            frames += u64::from(record?.frame().is_some());
        }
        Ok(Some(frames))
    }
}

/// A percentage, above 0 and up to 100.
fn percent(text: &str) -> Result<f64, String> {
    let number = text.trim_end_matches('%').trim_end().parse::<f64>().ok();
    number
        .filter(|number| *number > 0.0 && *number <= 100.0)
        .ok_or_else(|| "give per cent, above 0 and up to 100".to_owned())
}

/// A pause in the host's reading: its start and length.
#[derive(Clone, Default)]
struct Stall(Arc<OnceLock<(Instant, Duration)>>);

impl Stall {
    fn plan(&self, from: Instant, length: Duration) {
        // It is set only once.
        let _ = self.0.set((from, length));
    }
}

/// Reads nothing during the stall.
struct StallingReader<R> {
    inner: R,
    stall: Stall,
}

impl<R: Read> Read for StallingReader<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if let Some((from, length)) = self.stall.0.get() {
            let since = Instant::now().saturating_duration_since(*from);
            if !since.is_zero() && since < *length {
                std::thread::sleep(length.saturating_sub(since));
            }
        }
        self.inner.read(out)
    }
}
