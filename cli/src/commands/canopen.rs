//! `cantap canopen`: talks with nodes.

mod drive;
mod lss;
mod objects;
mod scan;

use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use cantap::{Frame, Id};
use cantap_protocols::active::Broadcast;
use cantap_protocols::canopen::{CanOpen, Sheet, state_name};
use cantap_protocols::{Event, EventKind};
use cantap_trace::counted;
use cantap_trace::grammar;
use cantap_work::eds::SheetPath;
use cantap_work::report::Reporter;

use crate::args;
use crate::speak_args::SpeakArgs;
use crate::stderr;
use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap canopen -d /dev/ttyACM0 -b 500k scan\n  \
                cantap canopen -d COM5 -b 250k read 5 1018 4\n  \
                cantap canopen -d COM5 -b 250k write 5 1017 0 500 --type u16\n  \
                cantap canopen -d COM5 -b 250k --eds 5:drive.eds read 5 6041\n  \
                cantap canopen -d COM5 -b 250k nmt 5 start\n  \
                cantap canopen -d COM5 -b 125k lss --node 12 --store\n  \
                cantap canopen -d COM5 -b 1M drive 5 status\n  \
                cantap canopen -d COM5 -b 1M drive 5 velocity 1500 -t 10s --yes\n\n\
                It takes part in the bus: it acknowledges, and sends what it is asked for here and nothing else. What \
                was said is shown as `cantap conversations` does.")]
pub struct Args {
    #[command(flatten)]
    speak: SpeakArgs,
    /// The sheet (EDS, DCF, XDD or XDC) of nodes; with a node's number before it (5:drive.eds), that node's. Can be repeated.
    #[arg(long = "eds", value_name = "[NODE:]FILE", global = true)]
    sheets: Vec<SheetPath>,
    /// How long to wait for each answer; default 1s, or 100ms for LSS.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration, global = true)]
    timeout: Option<Duration>,
    /// Maximum time for reading or writing one object, however well it gets on.
    #[arg(long, value_name = "TIME", default_value = "10m", value_parser = args::positive_duration, global = true)]
    patience: Duration,
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Find nodes: by asking each for its device type, and by heartbeats.
    Scan(scan::ScanArgs),
    /// Read an object.
    Read(objects::ReadObject),
    /// Write an object.
    Write(objects::WriteObject),
    /// Change the state of a node, or of all.
    Nmt {
        /// The node, 1 to 127, or all.
        #[arg(value_parser = node_or_all)]
        node: u8,
        /// What it is to do.
        #[arg(value_enum)]
        command: Command,
    },
    /// Show what nodes say: states, emergencies, missing heartbeats, other clients' transfers. Nothing is sent.
    Monitor {
        /// End after this time.
        #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
        time: Option<Duration>,
    },
    /// Send SYNC periodically, timed by the device's clock.
    Sync {
        #[command(flatten)]
        cyclic: Cyclic,
        /// Its identifier in hexadecimal.
        #[arg(long, value_name = "ID", default_value = "080", value_parser = grammar::identifier)]
        cob_id: Id,
    },
    /// Send a node's heartbeat periodically, timed by the device's clock.
    Heartbeat {
        /// The number of the node to imitate, 1 to 127.
        #[arg(value_parser = node)]
        node: u8,
        /// The state to report.
        #[arg(long, value_enum, default_value = "operational")]
        state: State,
        #[command(flatten)]
        cyclic: Cyclic,
    },
    /// Find a node that has no number (fast scan), and give it a number and a bit rate.
    Lss(lss::LssArgs),
    /// Command a drive (CiA 402): its state, its mode, a motion. Each step is confirmed by its statusword.
    Drive(drive::DriveArgs),
}

/// How often to send.
#[derive(clap::Args)]
struct Cyclic {
    /// The time between two frames.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    period: Duration,
    /// How many frames.
    #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    count: Option<u32>,
    /// End after this time. Without this and --count, it continues until Ctrl-C.
    #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Command {
    Start,
    Stop,
    /// Enter pre-operational.
    Preop,
    Reset,
    /// Reset the communication only.
    ResetComm,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum State {
    Stopped,
    Operational,
    PreOperational,
}

fn node_or_all(text: &str) -> Result<u8, String> {
    if text == "all" { Ok(0) } else { node(text).map_err(|error| error + ", or all") }
}

fn node(text: &str) -> Result<u8, String> {
    let node = args::byte(text).filter(|node| (1..=127).contains(node));
    node.ok_or_else(|| "nodes are 1 to 127 (0x01 to 0x7F)".to_owned())
}

/// How long to listen for the new state after requesting it.
const OBEYS: Duration = Duration::from_secs(1);
const ANSWER: Duration = Duration::from_secs(1);

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let reporter = if args.speak.json { Reporter::silent() } else { stderr::reporter() };
    let sheets = args.sheets.iter().map(|path| path.load(&reporter)).collect::<anyhow::Result<Vec<_>>>()?;
    let ns = |default: Duration| args::nanoseconds(args.timeout.unwrap_or(default));
    let times =
        |default| objects::Times { timeout_ns: ns(default), patience_ns: args::nanoseconds(args.patience) };
    match &args.what {
        What::Scan(scan) => scan::run(&args.speak, scan, ns(Duration::from_millis(250)), sheets)?,
        What::Read(read) => objects::read(&args.speak, read, times(ANSWER), sheets)?,
        What::Write(write) => objects::write(&args.speak, write, times(ANSWER), sheets)?,
        What::Nmt { node, command } => nmt(&args.speak, *node, *command, sheets)?,
        What::Monitor { time } => monitor(&args.speak, *time, sheets)?,
        What::Sync { cyclic, cob_id } => {
            let Some(frame) = Frame::data_frame(*cob_id, &[]) else { bail!("SYNC has no data") };
            repeat(&args.speak, frame, cyclic)?;
        }
        What::Heartbeat { node, state, cyclic } => {
            let state = match state {
                State::Stopped => 4,
                State::Operational => 5,
                State::PreOperational => 127,
            };
            let id = Id::standard_truncated(0x700 + u32::from(*node));
            let Some(frame) = Frame::data_frame(id, &[state]) else { bail!("a heartbeat has one byte") };
            repeat(&args.speak, frame, cyclic)?;
        }
        What::Drive(drive) => drive::run(&args.speak, drive, ns(ANSWER), sheets)?,
        What::Lss(lss) => lss::run(&args.speak, lss, ns(Duration::from_millis(100)))?,
    }
    Ok(ExitCode::SUCCESS)
}

fn nmt(speak: &SpeakArgs, node: u8, command: Command, sheets: Vec<Sheet>) -> anyhow::Result<()> {
    let (number, becomes) = match command {
        Command::Start => (1, 5),
        Command::Stop => (2, 4),
        Command::Preop => (128, 127),
        Command::Reset => (129, 127),
        Command::ResetComm => (130, 127),
    };
    let Some(frame) = Frame::data_frame(Id::standard_truncated(0), &[number, node]) else {
        bail!("a command has two bytes");
    };
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(sheets)));
    speaking.run(&mut Broadcast::new([frame]))?;
    let shown = |event: &Event| {
        matches!(event.kind, EventKind::Nmt | EventKind::BootUp | EventKind::State | EventKind::Emergency)
    };
    speaking.show(shown)?;
    // Show the result, if nodes report their states.
    speaking.listen(OBEYS)?;
    let events = speaking.take_events();
    // Zero is for all nodes.
    let is_heard = events.iter().any(|event| {
        matches!(event.kind, EventKind::BootUp | EventKind::State)
            && (node == 0 || event.from.node() == Some(node))
    });
    speaking.put_back(events);
    speaking.show(shown)?;
    if !is_heard {
        let state = state_name(becomes).unwrap_or_default();
        eprintln!(
            "cantap: the command was sent and acknowledged; {} reported a new state within {} s, so it is unknown whether it is {state}",
            if node == 0 { "no node".to_owned() } else { format!("node {node} has not") },
            OBEYS.as_secs()
        );
    }
    drop(speaking);
    device.stop()?;
    Ok(())
}

fn monitor(speak: &SpeakArgs, time: Option<Duration>, sheets: Vec<Sheet>) -> anyhow::Result<()> {
    let device = speak.listen()?;
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(sheets)));
    let started = std::time::Instant::now();
    while !cantap_work::interrupt::requested() {
        let left = time.map(|time| time.saturating_sub(started.elapsed()));
        if left.is_some_and(|left| left.is_zero()) {
            break;
        }
        speaking.listen(left.unwrap_or(Duration::MAX).min(Duration::from_millis(50)))?;
        speaking.show(|_| true)?;
    }
    // A silent bus is not a failure, but it is said; errors alone are one.
    let deaf = speaking.judge();
    if deaf.is_ok() && !speaking.has_received() {
        let seconds = started.elapsed().as_secs_f64();
        eprintln!("cantap: no frame was heard in {seconds:.1} s; check the bit rate and that the bus is on");
    }
    drop(speaking);
    device.stop()?;
    deaf
}

/// `1 frame was`, `2 frames were`.
fn were(frames: u64) -> String {
    let number = usize::try_from(frames).unwrap_or(usize::MAX);
    format!("{} {}", counted(number, "frame"), if frames == 1 { "was" } else { "were" })
}

fn repeat(speak: &SpeakArgs, frame: Frame, cyclic: &Cyclic) -> anyhow::Result<()> {
    if cyclic.period < cantap::periodic::SHORTEST_PERIOD {
        return Err(usage(format!(
            "a period is at least {} us",
            cantap::periodic::SHORTEST_PERIOD.as_micros()
        )));
    }
    let device = speak.open()?;
    let mut speaking = speak.speak(&device, Box::new(CanOpen::new(Vec::new())));
    let own = |event: &Event| matches!(event.kind, EventKind::Sync | EventKind::State);
    speaking.show_as_it_comes(Box::new(own));
    let (sent, verdict) = speaking.repeat(frame, cyclic.period, cyclic.count, cyclic.time)?;
    eprintln!("cantap: {} sent", were(sent));
    drop(speaking);
    device.stop()?;
    verdict
}
