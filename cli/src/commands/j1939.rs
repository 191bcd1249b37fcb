//! `cantap j1939`: acts as a node.

mod send;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use cantap_protocols::active::Machine as _;
use cantap_protocols::active::station::{Station, StationError, StationJob, StationTiming};
use cantap_protocols::j1939::J1939;
use cantap_protocols::nmea2000;
use cantap_protocols::{Event, EventKind, Party};
use cantap_trace::grammar;
use cantap_work::interrupt;

use self::send::{GLOBAL, SendArgs};
use crate::args;
use crate::database_args::DatabaseArgs;
use crate::speak_args::SpeakArgs;
use cantap_work::speaking::Speaking;

/// The group of address claims.
const CLAIM: u32 = 0xEE00;
/// Active trouble codes.
const DM1: u32 = 0xFECA;
/// An off-board diagnostic tool (J1939-81) that accepts any address, without a manufacturer and with a random
/// number.
const TOOL: u64 = 1 << 63 | 29 << 40 | 0x7FF << 21;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap j1939 -d /dev/ttyACM0 -b 250k claim\n  \
                cantap j1939 -d COM5 -b 250k request 65260 --to 0\n  \
                cantap j1939 -d COM5 -b 250k dm1\n  \
                cantap j1939 -d COM5 -b 250k send 0xEF00 0102030405060708090A --to 3\n  \
                cantap j1939 -d can0 -b 250k send 'Wind Data' 'Wind Speed=6 m/s' Reference=2\n  \
                cantap j1939 -d can0 -b 250k send 'Water Depth' Depth=4.2 --period 1s\n\n\
                It claims an address first, which takes a quarter of a second, and another one where a node with a \
                lower NAME has it. It takes part in the bus: it acknowledges, and sends what it is asked for here and \
                what its address demands.")]
pub struct Args {
    #[command(flatten)]
    speak: SpeakArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// The address to claim, 0 to 253.
    #[arg(long, value_name = "ADDRESS", default_value_t = 249, value_parser = clap::value_parser!(u8).range(0..=253), global = true)]
    address: u8,
    /// The NAME to claim it with, 16 hexadecimal digits; without it, that of a diagnostic tool with a random number.
    #[arg(long, value_name = "HEX", value_parser = name, global = true)]
    name: Option<u64>,
    /// How long to wait for the beginning of an answer (T3).
    #[arg(long, value_name = "TIME", default_value = "1250ms", value_parser = args::positive_duration, global = true)]
    timeout: Duration,
    /// Maximum time for an answer or a message of many frames, however often the other node asks to wait (T4) or for frames again.
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = args::positive_duration, global = true)]
    patience: Duration,
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand)]
enum What {
    /// Request a parameter group, and show the answer, however many frames it has.
    Request {
        /// The group: 65260, or 0xFEEC.
        #[arg(value_parser = pgn)]
        pgn: u32,
        /// Whom to ask: an address, or all.
        #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = send::address)]
        to: u8,
    },
    /// Claim an address, and show who else has one.
    Claim,
    /// Show active trouble codes.
    Dm1 {
        /// Whom to ask: an address, or all.
        #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = send::address)]
        to: u8,
    },
    /// Send a message: bytes, or the values of an NMEA 2000 group. More than a frame holds goes by NMEA 2000's fast packet or J1939's transport, as
    /// the group does.
    Send(SendArgs),
}

fn pgn(text: &str) -> Result<u32, String> {
    let advice = || "write a group's number up to 262143, as 65260 or 0xFEEC".to_owned();
    send::usable(grammar::parameter_group(text).ok_or_else(advice)?)
}

fn name(text: &str) -> Result<u64, String> {
    u64::from_str_radix(text, 16).map_err(|_| "write up to 16 hexadecimal digits".to_owned())
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let decoder = if args.databases.is_empty() {
        None
    } else {
        Some(std::sync::Arc::new(args.databases.load(false, args.speak.json)?))
    };
    let name = args.name.unwrap_or_else(|| TOOL | fastrand::u64(0..1 << 21));
    let job = match &args.what {
        What::Claim => StationJob::Request { pgn: CLAIM, to: GLOBAL },
        What::Request { pgn, to } => StationJob::Request { pgn: *pgn, to: *to },
        What::Dm1 { to } => StationJob::Request { pgn: DM1, to: *to },
        What::Send(send) => {
            let message = send.message()?;
            if send.preview {
                return message.print(args.address, args.speak.json).map(|()| ExitCode::SUCCESS);
            }
            message.job()
        }
    };
    let device = args.speak.open()?;
    let is_marine = match &job {
        StationJob::SendFast { .. } => true,
        StationJob::Send { pgn, .. } => nmea2000::is_own(*pgn),
        _ => false,
    };
    let witness = if is_marine { J1939::nmea2000(decoder) } else { J1939::new(decoder) };
    let mut speaking = args.speak.speak(&device, Box::new(witness));
    let mut station = Station::new(name, args.address, job.clone());
    station.set_timing(StationTiming {
        answer_ns: args::nanoseconds(args.timeout),
        patience_ns: args::nanoseconds(args.patience),
    });
    speaking.run(&mut station)?;
    let own = station.address();
    if own != args.address {
        eprintln!("cantap: the address {} is taken; this is node {own}", args.address);
    }
    let shown = |event: &Event| match &args.what {
        What::Claim => event.kind == EventKind::AddressClaim,
        What::Send(_) => event.from == Party::Node(own) && event.kind != EventKind::AddressClaim,
        What::Request { pgn, to } => is_answer(event, *pgn, *to, own),
        What::Dm1 { to } => is_answer(event, DM1, *to, own),
    };
    speaking.show(shown)?;
    if let What::Send(SendArgs { period: Some(period), count, time, .. }) = &args.what {
        let sent = repeat(&mut speaking, &mut station, args::nanoseconds(*period), *count, *time, shown)?;
        eprintln!("cantap: {} sent", send::were(sent));
    }
    let imposters = station.imposters();
    let ended = finish(&speaking, station.finish(), args);
    if imposters > 0 {
        let ended = ended.map_or_else(|error| format!("{error}; "), |()| String::new());
        bail!(
            "{ended}another node sends from the address {own}, too, without having claimed it, so an answer may be to its request; \
             choose another with --address"
        );
    }
    ended?;
    drop(speaking);
    device.stop()?;
    Ok(ExitCode::SUCCESS)
}

/// Sends the message, which was sent once, again and again. Returns how often it was sent.
fn repeat(
    speaking: &mut Speaking<'_>,
    station: &mut Station,
    period_ns: u64,
    count: Option<u32>,
    time: Option<Duration>,
    shown: impl Fn(&Event) -> bool,
) -> anyhow::Result<u32> {
    let started = Instant::now();
    let mut sent = 1;
    while count.is_none_or(|count| sent < count) && time.is_none_or(|time| started.elapsed() < time) {
        station.send_again(period_ns);
        // Why it cannot go on is the station's to say.
        if station.is_done() {
            break;
        }
        match speaking.run(station) {
            // The usual end.
            Err(_) if interrupt::requested() => break,
            result => result?,
        }
        speaking.show(&shown)?;
        sent += u32::from(station.is_done());
    }
    Ok(sent)
}

fn is_of(event: &Event, pgn: u32) -> bool {
    event.field("pgn").is_some_and(|field| field.value.as_number() == Some(f64::from(pgn)))
}

fn is_answer(event: &Event, pgn: u32, to: u8, own: u8) -> bool {
    let from = to == GLOBAL && event.from != Party::Node(own) || event.from == Party::Node(to);
    from && event.kind != EventKind::Request
        && (is_of(event, pgn) || event.kind == EventKind::Acknowledgement)
}

fn finish<T>(speaking: &Speaking<'_>, ended: Result<T, StationError>, args: &Args) -> anyhow::Result<()> {
    match ended {
        Ok(_) => Ok(()),
        // That there is no other node is also an answer.
        Err(StationError::NoAnswer { .. }) if matches!(args.what, What::Claim) => Ok(()),
        Err(error @ StationError::NoAnswer { .. }) => {
            Err(anyhow!("{error}; {}; `cantap j1939 claim` shows who is there", speaking.circumstances()))
        }
        Err(error @ StationError::AddressTaken { .. }) => {
            Err(anyhow!("{error}; choose another with --address, or a NAME that takes any address"))
        }
        Err(error @ StationError::TooSlow { .. }) => Err(anyhow!("{error}; --patience gives it more time")),
        Err(error) => Err(anyhow!(error)),
    }
}
