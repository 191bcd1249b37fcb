//! `cantap j1939`: acts as a node.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{anyhow, bail};
use cantap_protocols::active::station::{Station, StationError, StationJob, StationTiming};
use cantap_protocols::j1939::J1939;
use cantap_protocols::{Event, EventKind, Party};
use cantap_trace::grammar;

use super::uds::hex::{self, Hex};
use crate::args;
use crate::database_args::DatabaseArgs;
use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use cantap_work::speaking::Speaking;

/// The group of address claims.
const CLAIM: u32 = 0xEE00;
/// Active trouble codes.
const DM1: u32 = 0xFECA;
const GLOBAL: u8 = 255;
/// An off-board diagnostic tool (J1939-81) that accepts any address, without a manufacturer and with a random
/// number.
const TOOL: u64 = 1 << 63 | 29 << 40 | 0x7FF << 21;
/// The longest message, in bytes.
const MOST_BYTES: usize = 1785;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap j1939 -d /dev/ttyACM0 -b 250k claim\n  \
                cantap j1939 -d COM5 -b 250k request 65260 --to 0\n  \
                cantap j1939 -d COM5 -b 250k dm1\n  \
                cantap j1939 -d COM5 -b 250k send 0xEF00 0102030405060708090A --to 3\n\n\
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
        #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = address)]
        to: u8,
    },
    /// Claim an address, and show who else has one.
    Claim,
    /// Show active trouble codes.
    Dm1 {
        /// Whom to ask: an address, or all.
        #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = address)]
        to: u8,
    },
    /// Send a message of up to 1785 bytes.
    Send {
        /// The group: 65260, or 0xFEEC.
        #[arg(value_parser = pgn)]
        pgn: u32,
        /// Its bytes in hexadecimal.
        #[arg(value_name = "HEX", value_parser = bytes)]
        data: Bytes,
        /// The receiver: an address, or all.
        #[arg(long, value_name = "ADDRESS", default_value = "all", value_parser = address)]
        to: u8,
        /// 0, the highest, to 7.
        #[arg(long, value_name = "N", default_value_t = 6, value_parser = clap::value_parser!(u8).range(0..=7))]
        priority: u8,
    },
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Bytes(Vec<u8>);

fn bytes(text: &str) -> Result<Bytes, String> {
    let Hex(data) = hex::bytes(text)?;
    if data.len() > MOST_BYTES {
        Err(format!("a message has at most {MOST_BYTES} bytes"))
    } else {
        Ok(Bytes(data))
    }
}

fn pgn(text: &str) -> Result<u32, String> {
    let advice = || "write a group's number up to 262143, as 65260 or 0xFEEC".to_owned();
    let pgn = grammar::parameter_group(text).ok_or_else(advice)?;
    if pgn >> 8 & 0xFF < 240 && pgn & 0xFF != 0 {
        return Err(
            "groups below 0xF000 end in 00: the last byte is the address, which --to gives".to_owned()
        );
    }
    Ok(pgn)
}

fn address(text: &str) -> Result<u8, String> {
    match (text, args::byte(text)) {
        ("all", _) => Ok(GLOBAL),
        (_, Some(address @ 0..=253)) => Ok(address),
        _ => Err("addresses are 0 to 253 (0x00 to 0xFD), or all".to_owned()),
    }
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
        What::Send { pgn, data, to, priority } => {
            if *to != GLOBAL && pgn >> 8 & 0xFF >= 240 {
                return Err(usage(format!("the group {pgn} goes to all; omit --to")));
            }
            StationJob::Send { pgn: *pgn, to: *to, priority: *priority, data: data.0.clone() }
        }
    };
    let device = args.speak.open()?;
    let mut speaking = args.speak.speak(&device, Box::new(J1939::new(decoder)));
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
        What::Send { pgn, .. } => event.from == Party::Node(own) && is_of(event, *pgn),
        What::Request { pgn, to } => is_answer(event, *pgn, *to, own),
        What::Dm1 { to } => is_answer(event, DM1, *to, own),
    };
    speaking.show(shown)?;
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
