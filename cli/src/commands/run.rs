//! `cantap run`: nodes and tests as scripts.

mod explain;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::wire::message::Mode;
use cantap::{Channel, TraceRecord};
use cantap_address::Address;
use cantap_formats::WriteOptions;
use cantap_scripts::library::{self, LibraryError, ReadyNode};
use cantap_scripts::{
    Bench, BenchBus, BrokenOff, Live, LiveError, Message, Outcome, Report, Script, TestResult,
};
use cantap_trace::clean;
use cantap_trace::counted;
use cantap_work::{atomic_file, interrupt, rounded};
use serde_json::{Value, json};

use crate::args;
use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::keyboard::Keyboard;
use crate::trace_output::{TraceOutput, refuse_older};
use crate::usage_error::usage;
use cantap_work::channel_bitrate::ChannelBitrate;

/// How long a simulated run takes if nothing else ends it.
const SIMULATED: Duration = Duration::from_mins(1);
/// The bit rate of simulated buses that nothing else fixes.
const SIMULATED_BPS: u32 = 500_000;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Each script is a node; several are several nodes on one bus. Without -d the buses are simulated, as fast as the computer can, and a \
                  run with the same scripts and seed is the same to the bit. With -d they are real: the device then acknowledges, and sends what \
                  the scripts send.\n\n\
                  A function whose name begins with test_ is a test; the run ends with the last one, and with exit code 1 if one fails. Without \
                  tests it ends with --for (60 s if simulated), or when no script has anything left to do. The language and its functions: \
                  docs/scripts.md.\n\n\
                  node:NAME in place of a file is a ready node, which --nodes lists, with its settings after a question mark. --print shows its \
                  script, to be saved, edited and run as a file: it is all that the node is, so that a copy behaves as the node does.\n\n\
                  on_key in a script takes keys typed at the terminal with -d, and those of --keys on simulated buses.\n\n\
                  --explain opens the device, but no channel: it says for each statement that sends whether the device does it by itself, to what \
                  accuracy, or this computer.\n\n\
                  Examples:\n  cantap run 'node:obd?codes=P0301,P0420' tester.rhai\n  \
                  cantap run node:engine -d virtual -b 500k --for 1m\n  \
                  cantap run --print node:boat > boat.rhai\n  \
                  cantap run --explain node.rhai -d /dev/ttyACM0\n  cantap run node.rhai tester.rhai --junit report.xml\n  \
                  cantap run tester.rhai --bus car --for 2h -o drive.log\n  \
                  cantap run tester.rhai -d /dev/ttyACM0 -b 500k --db car.dbc"
)]
pub struct Args {
    /// The scripts; node:NAME for a ready node.
    #[arg(value_name = "FILE", required_unless_present_any = ["nodes", "print"])]
    scripts: Vec<PathBuf>,
    /// List the ready nodes.
    #[arg(long, exclusive = true)]
    nodes: bool,
    /// Print a ready node's script, or with .eds after its name its electronic data sheet.
    #[arg(long, value_name = "node:NAME", exclusive = true)]
    print: Option<String>,
    /// Say which statements send, where each of them runs and how exactly; run nothing.
    #[arg(long, conflicts_with_all = ["output", "junit"])]
    explain: bool,
    /// Where the device is: a serial port, or virtual. Without it, the buses are simulated.
    #[arg(short, long, add = completion::devices())]
    device: Option<Address>,
    /// What else is on the simulated buses, as in a virtual device's address: car, canopen, load=20, errors=1; and what goes wrong there:
    /// error_burst=2s+10ms, bus_off=NODE@2s, power_off=NODE@2s+500ms, stall=2s+200ms, lose=NODE@2s*3.
    #[arg(long, value_name = "OPTIONS", default_value = "load=0", conflicts_with = "device")]
    bus: BenchBus,
    #[command(flatten)]
    open: ChannelArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// Type keys in a simulated run: their times, and after each a colon and the key.
    #[arg(long, value_name = "TIME:KEY,…", value_parser = keys, default_value = "", hide_default_value = true, conflicts_with = "device")]
    keys: Keys,
    /// End after this time, of the bus.
    #[arg(long = "for", value_name = "TIME", value_parser = args::duration)]
    duration: Option<Duration>,
    /// Let the scripts read the files in this folder, by read(…) and csv(…); otherwise they read none.
    #[arg(long, value_name = "FOLDER")]
    allow_read: Option<PathBuf>,
    /// Select other random numbers.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write the results of the tests as JUnit's XML.
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Write the frames of the buses as a trace; its name's suffix says the format.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Overwrite an existing trace.
    #[arg(long, requires = "output")]
    force: bool,
    /// Print one JSON object per line: what scripts log, tests, and a summary.
    #[arg(long)]
    json: bool,
}

/// Keys of a simulated run, with their times in nanoseconds.
type Keys = Arc<[(u64, char)]>;

/// As in `1s:a,2.5s:b`.
fn keys(text: &str) -> Result<Keys, String> {
    let parts = text.split(',').filter(|part| !part.is_empty());
    let key = |part: &str| {
        let (time, key) = part.split_once(':').ok_or_else(|| format!("{part} is no key; write 1s:a"))?;
        let mut characters = key.chars();
        let (Some(key), None) = (characters.next(), characters.next()) else {
            return Err(format!("{key:?} is not one key; write 1s:a"));
        };
        let at_ns =
            u64::try_from(args::duration(time)?.as_nanos()).map_err(|_| format!("{time} is too long"))?;
        Ok((at_ns, key))
    };
    parts.map(key).collect()
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.nodes {
        return list_nodes();
    }
    if let Some(name) = &args.print {
        return print_node(name);
    }
    let scripts: Vec<Script> = args.scripts.iter().map(|path| read(path)).collect::<anyhow::Result<_>>()?;
    if args.explain {
        explain::explain(&scripts, args.device.as_ref(), |device| args.channels(device), args.json)?;
        return Ok(ExitCode::SUCCESS);
    }
    let given: Vec<&Address> = args.device.iter().collect();
    let databases = args.databases.or_of(given);
    let decoder = Arc::new(load(&databases, false, args.json)?);
    if let Some(path) = &args.output {
        refuse_older(path, args.force)?;
    }
    if let Some(path) = &args.junit {
        refuse_no_place(path)?;
    }
    if let Some(folder) = args.allow_read.as_ref().filter(|folder| !folder.is_dir()) {
        bail!("--allow-read {}: there is no such folder", folder.display());
    }
    interrupt::watch()?;
    let mut trace = match &args.output {
        Some(path) => Some(TraceOutput::create(path, &WriteOptions::default(), args.device.is_some())?),
        None => None,
    };
    let mut failed = None;
    let mut on_record = |record: TraceRecord| {
        if failed.is_none()
            && let Some(trace) = &mut trace
        {
            failed = trace.write(&record).err();
        }
    };
    let mut on_message = |message: Message| tell(&message, args.json);
    let mut goes_on = || !interrupt::requested();
    let (report, broken) = match &args.device {
        None => {
            let bench = args.bench(decoder)?;
            (bench.run(&scripts, &mut on_record, &mut on_message, &mut goes_on)?, None)
        }
        Some(address) => {
            let device = address.open()?;
            args.open.open(&device, args.channels(&device).into_iter(), Mode::Normal, None)?;
            let live =
                Live { decoder, seed: args.seed, readable: args.allow_read.clone(), duration: args.duration };
            let mut keyboard = Keyboard::open();
            let has_keyboard = keyboard.is_some();
            let mut next_key = || keyboard.as_mut().and_then(Keyboard::next);
            let keys: Option<&mut dyn FnMut() -> Option<char>> =
                if has_keyboard { Some(&mut next_key) } else { None };
            match live.run(&device, &scripts, &mut on_record, &mut on_message, keys, &mut goes_on) {
                Ok(report) => (report, device.stop().err().map(anyhow::Error::from)),
                Err(broken) => match *broken {
                    BrokenOff { error: error @ LiveError::Script(_), .. } => return Err(error.into()),
                    // What was on the bus until then, and the tests' results, are not lost with the device.
                    BrokenOff { error, report } => (report, Some(error.into())),
                },
            }
        }
    };
    print(&report, args.json)?;
    if let Some(error) = failed {
        return Err(error);
    }
    trace.map(TraceOutput::finish).transpose()?;
    if let Some(path) = &args.junit {
        atomic_file::write(path, report.junit().as_bytes())
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    if let Some(error) = broken {
        return Err(error);
    }
    if !report.without_keys.is_empty() {
        eprintln!("{}", no_keys(&report.without_keys, args.device.is_some()));
    }
    if interrupt::requested() {
        bail!("ended before the scripts were done");
    }
    Ok(if report.is_success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Refuses, before a run that may take hours, a file that cannot be written after it.
fn refuse_no_place(path: &Path) -> anyhow::Result<()> {
    if path.is_dir() {
        bail!("cannot write {}: it is a folder", path.display());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
        bail!("cannot write {}: there is no folder {}", path.display(), folder.display());
    }
    Ok(())
}

impl Args {
    fn bench(&self, decoder: Arc<cantap_signals::Decoder>) -> anyhow::Result<Bench> {
        if let Some(option) = self.open.given() {
            return Err(usage(format!(
                "{option} is for a device, and these buses are simulated; give one with -d"
            )));
        }
        let timing = self.open.options().timing;
        if timing.has_auto() {
            return Err(usage(
                "-b auto listens to a device; give one with -d, or the simulated bus's bit rate, such as -b 500k",
            ));
        }
        let rates = timing.known();
        let bitrates_bps = [1, 2].map(|channel| ChannelBitrate::of(&rates, channel).unwrap_or(SIMULATED_BPS));
        let duration_ns = self.duration.unwrap_or(SIMULATED).as_nanos();
        let duration_ns = u64::try_from(duration_ns)
            .ok()
            .filter(|duration_ns| i64::try_from(*duration_ns).is_ok())
            .ok_or_else(|| usage("--for is longer than the 292 years that times can hold"))?;
        Ok(Bench {
            options: self.bus.options.clone(),
            faults: self.bus.faults.clone(),
            bitrates_bps,
            decoder,
            seed: self.seed,
            keys: self.keys.to_vec(),
            readable: self.allow_read.clone(),
            duration_ns,
        })
    }

    /// The channels to open: those with a bit rate of their own; with one for all, or none, the first.
    fn channels(&self, device: &cantap_address::OpenDevice) -> Vec<Channel> {
        let rates = self.open.options().timing.bitrates;
        let own: Vec<Channel> = Channel::ALL
            .into_iter()
            .filter(|channel| rates.iter().any(|rate| rate.channel == Some(channel.number())))
            .filter(|channel| channel.number() <= device.hello().channels)
            .collect();
        if own.is_empty() { vec![Channel::Can1] } else { own }
    }
}

/// What to do for scripts that waited for keys.
fn no_keys(scripts: &[String], on_device: bool) -> String {
    let how = if on_device {
        "standard input is no terminal; run it in one"
    } else {
        "type them at times of the simulated buses, as in --keys 1s:a,2s:b"
    };
    format!("no keys came for {}: {how}", clean::line(&scripts.join(", ")))
}

fn list_nodes() -> anyhow::Result<ExitCode> {
    let mut out = std::io::stdout().lock();
    for node in ReadyNode::all() {
        writeln!(out, "{}{:<8} {}", library::PREFIX, node.name, node.title())?;
    }
    Ok(ExitCode::SUCCESS)
}

fn print_node(name: &str) -> anyhow::Result<ExitCode> {
    let name = name.strip_prefix(library::PREFIX).unwrap_or(name);
    let text = match name.strip_suffix(".eds") {
        Some(name) => library::sheet(name),
        None => ReadyNode::find(name).map(|node| node.source),
    };
    let text = text.map_err(|error| usage(error.to_string()))?;
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(ExitCode::SUCCESS)
}

fn read(path: &Path) -> anyhow::Result<Script> {
    library::read(path).map_err(|error| match error {
        LibraryError::File { .. } => error.into(),
        error => usage(error.to_string()),
    })
}

/// Prints what a script logs, at once.
fn tell(message: &Message, json: bool) {
    let Message { at_ns, script, text } = message;
    let seconds = *at_ns as f64 / 1e9;
    let mut out = std::io::stdout().lock();
    // Whoever does not read any more wants no more lines; the run goes on for its tests.
    let _ = if json {
        writeln!(out, "{}", line("log", script, seconds, text))
    } else {
        writeln!(out, "{seconds:12.6} {}: {}", clean::line(script), clean::lines(text))
    };
}

fn print(report: &Report, as_json: bool) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    for test in &report.tests {
        if as_json {
            writeln!(out, "{}", object(test))?;
        } else {
            describe(&mut out, test)?;
        }
    }
    for (script, error) in &report.errors {
        if as_json {
            writeln!(out, "{}", line("error", script, report.duration_ns as f64 / 1e9, error))?;
        } else {
            writeln!(out, "ERROR  {}: {}", clean::line(script), clean::lines(error))?;
        }
    }
    let seconds = report.duration_ns as f64 / 1e9;
    let failed = report.failed().count();
    if as_json {
        let summary = json!({ "summary": {
            "tests": report.tests.len(),
            "failed": failed,
            "errors": report.errors.len(),
            "seconds": rounded(seconds, 9),
            "frames_sent": report.frames_sent,
            "frames_received": report.frames_received,
            "frames_not_sent": report.frames_not_sent,
            "frames_lost": report.frames_lost,
        } });
        writeln!(out, "{summary}")?;
    } else {
        let passed = report.tests.len() - failed;
        writeln!(
            out,
            "{passed} passed, {failed} failed, {} ended with an error; {seconds:.3} s, {} sent, {} received",
            counted(report.errors.len(), "script"),
            counted(report.frames_sent, "frame"),
            report.frames_received
        )?;
        if report.frames_not_sent > 0 {
            writeln!(
                out,
                "not sent: {}; nobody acknowledged, or the script or the run ended first",
                counted(report.frames_not_sent, "frame")
            )?;
        }
        if report.frames_lost > 0 {
            writeln!(
                out,
                "lost: at least {}, which the scripts did not see",
                counted(report.frames_lost, "frame")
            )?;
        }
    }
    Ok(out.flush()?)
}

fn describe(out: &mut impl Write, test: &TestResult) -> std::io::Result<()> {
    let milliseconds = (test.ended_ns - test.began_ns) as f64 / 1e6;
    let name = format!("{}: {}", clean::line(&test.script), clean::line(&test.name));
    match &test.outcome {
        Outcome::Passed => writeln!(out, "ok     {name} ({milliseconds:.3} ms)"),
        Outcome::Failed(reason) => {
            writeln!(out, "FAILED {name} ({milliseconds:.3} ms): {}", clean::lines(reason))?;
            test.trace_lines().try_for_each(|line| writeln!(out, "       {line}"))
        }
    }
}

/// A line that is no test.
fn line(kind: &str, script: &str, at_s: f64, text: &str) -> Value {
    json!({ "kind": kind, "script": script, "at_s": rounded(at_s, 9), "text": text })
}

fn object(test: &TestResult) -> Value {
    let reason = match &test.outcome {
        Outcome::Passed => None,
        Outcome::Failed(reason) => Some(reason),
    };
    json!({
        "kind": "test",
        "script": test.script,
        "at_s": rounded(test.ended_ns as f64 / 1e9, 9),
        "begin_s": rounded(test.began_ns as f64 / 1e9, 9),
        "test": test.name,
        "passed": reason.is_none(),
        "text": reason,
        "trace": test.trace,
        "trace_after": test.trace_after,
    })
}
