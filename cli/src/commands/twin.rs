//! `cantap twin`: learns a bus from a trace, and writes scripts that play it.

mod table;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, bail};
use cantap_scripts::twin::{Distance, Learner, Model, Observed, compare};
use cantap_scripts::{Bench, Script};
use cantap_signals::Decoder;
use cantap_trace::counted;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::{atomic_file, interrupt};

use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::input::ReadArgs;
use crate::trace_output::{failed, refuse_older};
use crate::usage_error::usage;

/// The bit rate of buses of which nothing else is known.
const USUAL_BPS: u32 = 500_000;
/// The shortest and the longest run for the comparison.
const MIN_RUN_NS: u64 = 100_000_000;
const MAX_RUN_NS: u64 = 60_000_000_000;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "It finds each identifier's period with its jitter, counters, checksums, and who answers whom; the rest is played as recorded. Then \
                  it runs the scripts on simulated buses for as long as the trace, at most a minute, and shows how far they are from it.\n\n\
                  A script does not receive its own frames: who asks goes into a script of its own (--tester). Both are text to be edited; \
                  docs/scripts.md explains their functions.\n\n\
                  Examples:\n  cantap twin drive.log\n  \
                  cantap twin drive.blf -b 500k -o car.rhai --tester tester.rhai --db car.dbc\n  \
                  cantap run car.rhai tester.rhai -o played.log"
)]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// Write the script that plays the bus.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Write the script that asks what the other one answers.
    #[arg(long, value_name = "FILE", requires = "output")]
    tester: Option<PathBuf>,
    /// Overwrite existing scripts.
    #[arg(long, requires = "output")]
    force: bool,
    /// The bit rate of the trace's bus, such as 500k, which it is if this is not given; with a channel before it (2:250k), only for that
    /// channel. Can be repeated.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", add = completion::bit_rates())]
    bitrates: Vec<ChannelBitrate>,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    read: ReadArgs,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    for path in args.output.iter().chain(&args.tester) {
        refuse_older(path, args.force)?;
    }
    if args.output.is_some() && args.output == args.tester {
        return Err(usage("-o and --tester name the same file; they are two scripts"));
    }
    let decoder = load(&args.databases.options(), args.read.strict, args.json)?;
    let bitrates_bps = [1, 2].map(|channel| ChannelBitrate::of(&args.bitrates, channel).unwrap_or(USUAL_BPS));
    let filters = args.read.filters(&decoder)?;
    let mut records = args.read.open(&args.input, filters)?;
    let mut learner = Learner::new(bitrates_bps);
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            learner.push(record);
        }
    }
    let trace = learner.finish();
    if trace.frames() == 0 {
        bail!("{}: there is no frame to learn from", args.input.display());
    }
    let model = Model::learn(&trace);
    let names =
        |channel: u8, id| decoder.find(channel, id).map(|message| decoder.message(message).name.clone());
    let title = args.input.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let twin = Script::new("twin".to_owned(), model.twin(&title, &names));
    let tester = model.tester(&title, &names).map(|source| Script::new("tester".to_owned(), source));
    let scripts: Vec<Script> = [twin].into_iter().chain(tester).collect();
    let distance = played(&scripts, &model, &trace, bitrates_bps)?;
    if let Some(path) = &args.output {
        write(path, &scripts[0].source)?;
    }
    match (&args.tester, scripts.get(1)) {
        (Some(path), Some(tester)) => write(path, &tester.source)?,
        (Some(path), None) => {
            eprintln!("cantap: note: nobody asks in this trace; {} is not written", path.display());
        }
        (None, Some(_)) if args.output.is_some() => {
            eprintln!(
                "cantap: note: requests are not in this script; --tester FILE writes the one that asks"
            );
        }
        (None, _) => {}
    }
    // A few are stamps that are not quite exact.
    if trace.too_close * 100 > trace.frames() as u64 {
        eprintln!(
            "cantap: note: {} closer to the one before than the bit rate allows; -b gives the trace's",
            counted(trace.too_close, "frame")
        );
    }
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(out, "{}", table::object(&model, &trace, &distance, &records.missing()))?;
    } else {
        out.write_all(table::text(&model, &trace, &distance, &names).as_bytes())?;
        if args.output.is_none() {
            eprintln!("cantap: note: -o FILE writes the script");
        }
    }
    out.flush()?;
    Ok(ExitCode::SUCCESS)
}

/// Runs the scripts on simulated buses, and compares what they played with the trace.
fn played(
    scripts: &[Script],
    model: &Model,
    trace: &Observed,
    bitrates_bps: [u32; 2],
) -> anyhow::Result<Distance> {
    interrupt::watch()?;
    let duration_ns = trace.duration_ns.clamp(MIN_RUN_NS, MAX_RUN_NS);
    let bench = Bench {
        keys: Vec::new(),
        faults: Vec::new(),
        readable: None,
        options: "load=0".parse().context("the bus without anything else on it")?,
        bitrates_bps,
        decoder: Arc::new(Decoder::new(Vec::new())),
        seed: 1,
        duration_ns,
    };
    let mut learner = Learner::new(bitrates_bps);
    let report = bench
        .run(scripts, &mut |record| learner.push(&record), &mut |_| {}, &mut || !interrupt::requested())?;
    if interrupt::requested() {
        bail!("ended before the scripts were compared with the trace");
    }
    if let Some((script, error)) = report.errors.first() {
        bail!("the {script}'s script ended with an error, which should not be: {error}");
    }
    Ok(compare(model, trace, &learner.finish(), duration_ns, bitrates_bps))
}

fn write(path: &Path, source: &str) -> anyhow::Result<()> {
    atomic_file::write(path, source.as_bytes()).with_context(|| failed(path))
}
