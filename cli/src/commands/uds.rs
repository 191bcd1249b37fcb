//! `cantap uds`: queries an ECU.

pub mod hex;
mod key;
mod memory;
mod names;
mod scan;
mod script;
mod transfer_args;

use std::process::ExitCode;
use std::time::{Duration, Instant};

use cantap_protocols::diagnostics::Diagnostics;
use cantap_protocols::iso_tp::Pair;
use cantap_protocols::odx::{Descriptions, Ecu};

use self::hex::{Hex, byte, bytes, number};
use self::key::{KeyArgs, level};
use self::memory::{DownloadArgs, UploadArgs};
use self::names::{Identifier, identifier};
use self::scan::ScanArgs;
use self::script::{RunArgs, Step};
pub use self::transfer_args::TransferArgs;
use crate::speak_args::SpeakArgs;
use crate::usage_error::usage;
use crate::{args, stderr};
use cantap_work::interrupt;
use cantap_work::odx::{self, OdxPath};
use cantap_work::uds::{Client, REFUSAL};

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap uds -d virtual:car scan\n  \
                cantap uds -d virtual:car read F190 F18C\n  \
                cantap uds -d /dev/ttyACM0 -b 500k --session extended read F190\n  \
                cantap uds -d COM5 -b 500k --pair 18DA10F1:18DAF110 dtc\n  \
                cantap uds -d COM5 -b 500k --session extended --security 1 \\\n      \
                --key-command './key' routine start FF00\n  \
                cantap uds -d COM5 -b 500k raw '22 F1 90'\n  \
                cantap uds -d COM5 -b 500k --odx car.pdx read Vehicle_Identification\n  \
                cantap uds -d COM5 -b 500k --session extended run requests.txt\n\n\
                It takes part in the bus: it acknowledges, and sends what it is asked for here and nothing else. What \
                was said is shown as `cantap conversations` does. A refusal is exit code 1.")]
pub struct Args {
    #[command(flatten)]
    speak: SpeakArgs,
    #[command(flatten)]
    transfer: TransferArgs,
    /// First open this session: default, programming, extended, safety, or its number in hexadecimal.
    #[arg(long, value_name = "SESSION", global = true, value_parser = session)]
    session: Option<u8>,
    #[command(flatten)]
    key: KeyArgs,
    /// The ECU's description (PDX, ODX or CDD): names and values of what it is asked and answers; with a layer behind it (car.pdx:Engine_V2), that variant. Can
    /// be repeated.
    #[arg(long, value_name = "FILE[:LAYER]", global = true)]
    odx: Vec<OdxPath>,
    #[command(subcommand)]
    what: What,
}

#[derive(clap::Subcommand, Clone)]
pub enum What {
    /// Find the ECUs that answer: by the identifiers that the standards reserve, and by a maker's.
    Scan(ScanArgs),
    /// Read data by identifier.
    Read {
        /// The identifiers in hexadecimal, as F190, or by their names in --odx.
        #[arg(required = true, value_name = "DID", value_parser = identifier)]
        dids: Vec<Identifier>,
    },
    /// Open a session; it ends some seconds after the last request.
    Session {
        /// default, programming, extended, safety, or its number in hexadecimal.
        #[arg(value_name = "SESSION", value_parser = session)]
        kind: u8,
    },
    /// Control a routine.
    Routine {
        /// What to do with it.
        #[arg(value_enum)]
        action: RoutineAction,
        /// Its identifier in hexadecimal, as FF00, or its name in --odx.
        #[arg(value_name = "ID", value_parser = identifier)]
        routine: Identifier,
        /// Its option record in hexadecimal.
        #[arg(value_name = "HEX", value_parser = bytes)]
        option: Option<Hex>,
    },
    /// Send "tester present", so that a session does not end.
    TesterPresent {
        /// Repeatedly, until Ctrl-C, --count or --time, without requesting answers.
        #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
        period: Option<Duration>,
        /// How many times.
        #[arg(short = 'n', long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
        count: Option<u32>,
        /// End after this time.
        #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
        time: Option<Duration>,
    },
    /// Restart the ECU.
    Reset {
        /// Which kind of restart.
        #[arg(value_enum)]
        kind: ResetKind,
    },
    /// Read trouble codes, or clear them.
    Dtc {
        /// Only those with one of these status bits set, in hexadecimal.
        #[arg(long, value_name = "HEX", default_value = "FF", value_parser = byte)]
        mask: u8,
        /// Clear all of them; requires --yes.
        #[arg(long)]
        clear: bool,
        /// Confirm clearing.
        #[arg(short, long, requires = "clear")]
        yes: bool,
    },
    /// Do several of these in one session: each line of a file is one, as 'read F190'.
    Run(RunArgs),
    /// Unlock the ECU at a level, an odd number in hexadecimal; requires --key-command.
    Security {
        /// The level.
        #[arg(value_name = "LEVEL", value_parser = level)]
        level: u8,
    },
    /// Do nothing for this time, except for keeping the session.
    Wait {
        /// How long.
        #[arg(value_name = "TIME", value_parser = args::positive_duration)]
        time: Duration,
    },
    /// Write a file to the ECU's memory (34, 36, 37); requires --yes.
    Download(DownloadArgs),
    /// Read the ECU's memory into a file (35, 36, 37).
    Upload(UploadArgs),
    /// Send any request.
    Raw {
        /// Its bytes in hexadecimal, as 22F190 or 22 F1 90.
        #[arg(required = true, value_name = "HEX")]
        bytes: Vec<String>,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum RoutineAction {
    Start,
    Stop,
    /// The result.
    Result,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ResetKind {
    Hard,
    KeyOffOn,
    Soft,
}

/// The shortest time between two "tester present", which this computer sends one by one.
const SHORTEST_PERIOD: Duration = Duration::from_millis(10);

fn session(text: &str) -> Result<u8, String> {
    match text {
        "default" => Ok(1),
        "programming" => Ok(2),
        "extended" => Ok(3),
        "safety" => Ok(4),
        _ => number(text, 0x7F).filter(|number| *number > 0).map(|number| number as u8).ok_or_else(|| {
            "write default, programming, extended, safety, or a number from 1 to 7F".to_owned()
        }),
    }
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let What::Scan(scan) = &args.what {
        if args.session.is_some() || args.key.has_command() {
            return Err(usage(
                "a scan opens no session and unlocks nothing; leave --session, --security and --key-command out",
            ));
        }
        scan::run(&args.speak, scan, &args.transfer.options(None))?;
        return Ok(ExitCode::SUCCESS);
    }
    let steps = match &args.what {
        What::Run(RunArgs { file }) => {
            script::read(file, |what| matches!(what, What::Run { .. } | What::Scan { .. }))?
        }
        what => vec![Step { place: None, what: what.clone() }],
    };
    let descriptions = odx::load(&args.odx, &stderr::reporter())?;
    let options = args.transfer.options(descriptions.as_deref().and_then(only_pair));
    let Pair { a, b } = options.pair;
    let ecu = descriptions.as_ref().and_then(|descriptions| descriptions.of(Some(a), Some(b)));
    if descriptions.is_some() && ecu.is_none() {
        let pair = options.pair;
        return Err(usage(format!(
            "no ECU of --odx has {pair}; give --pair, or say which layer is meant, as FILE:LAYER"
        )));
    }
    let ecu = ecu.map(|ecu| &**ecu);
    // Nothing is sent unless all of it can be.
    for Step { place, what } in &steps {
        located(place.as_deref(), args.check(what, ecu))?;
    }
    let device = args.speak.open()?;
    let witness = || {
        let diagnostics = Diagnostics::new(&[options.pair.into()], false);
        Box::new(diagnostics.with_descriptions(descriptions.clone()))
    };
    let speaking = args.speak.speak(&device, witness());
    let mut client = Client::new(speaking, options, stderr::reporter());
    if let Some(session) = args.session {
        client.ask(&[0x10, session])?;
        client.show()?;
        client.all_agreed()?;
    }
    args.key.unlock(&mut client)?;
    client.show()?;
    for Step { place, what } in &steps {
        located(place.as_deref(), args.perform(what, ecu, &mut client))?;
        // A line that was ended by Ctrl-C is the last one.
        if interrupt::requested() {
            break;
        }
    }
    drop(client);
    device.stop()?;
    Ok(ExitCode::SUCCESS)
}

/// The pair of identifiers of the only ECU.
fn only_pair(descriptions: &Descriptions) -> Option<Pair> {
    let mut pairs = descriptions.pairs();
    pairs.next().filter(|_| pairs.next().is_none())
}

/// With the place of what failed, if it has one.
fn located(place: Option<&str>, done: anyhow::Result<()>) -> anyhow::Result<()> {
    match place {
        // The usage error stays one.
        Some(place) => done.map_err(|error| error.context(place.to_owned())),
        None => done,
    }
}

/// Sends "tester present" repeatedly.
fn stay(
    client: &mut Client<'_>,
    period: Duration,
    count: Option<u32>,
    time: Option<Duration>,
) -> anyhow::Result<()> {
    let started = Instant::now();
    let mut said = 0;
    loop {
        // A refusal comes within P2; the next period begins in time all the same.
        let asked = client.request_only(&[0x3E, 0x80], REFUSAL.min(period / 2));
        client.show()?;
        // Ctrl-C is its usual end, also between the request and what might answer it.
        if interrupt::requested() {
            return Ok(());
        }
        asked?;
        // No answer is wanted, but a refusal means that the session is not kept.
        client.all_agreed()?;
        said += 1;
        let is_enough = count.is_some_and(|count| said >= count)
            || time.is_some_and(|time| started.elapsed() + period > time);
        if is_enough {
            return Ok(());
        }
        let next = period * said;
        client.speaking.listen(next.saturating_sub(started.elapsed()))?;
        client.show()?;
        if interrupt::requested() {
            return Ok(());
        }
    }
}

impl Args {
    /// Does one thing.
    fn perform(&self, what: &What, ecu: Option<&Ecu>, client: &mut Client<'_>) -> anyhow::Result<()> {
        match what {
            What::TesterPresent { period: Some(period), count, time } => stay(client, *period, *count, *time),
            What::Security { level } => {
                let unlocked = self.key.unlock_at(*level, client);
                client.show()?;
                unlocked
            }
            What::Wait { time } => {
                client.wait(*time)?;
                client.show()?;
                client.all_agreed()
            }
            What::Download(download) => download.run(client),
            What::Upload(upload) => upload.run(client),
            _ => {
                for request in &requests(what, ecu)? {
                    let asked = client.ask(request);
                    client.show()?;
                    asked?;
                }
                client.all_agreed()
            }
        }
    }

    /// Whether it can be done, as far as that is known before anything is sent.
    fn check(&self, what: &What, ecu: Option<&Ecu>) -> anyhow::Result<()> {
        match what {
            What::Security { .. } if !self.key.has_command() => {
                Err(usage("unlocking requires --key-command, which computes the key"))
            }
            What::Download(download) => download.image().map(drop),
            What::Upload(upload) => upload.check(),
            _ => requests(what, ecu).map(drop),
        }
    }
}

/// The requests to send.
fn requests(what: &What, ecu: Option<&Ecu>) -> anyhow::Result<Vec<Vec<u8>>> {
    Ok(match what {
        What::Read { dids } => {
            dids.iter().map(|did| names::request(ecu, &[0x22], did, &[])).collect::<anyhow::Result<_>>()?
        }
        What::Session { kind } => vec![vec![0x10, *kind]],
        What::Routine { action, routine, option } => {
            let action = match action {
                RoutineAction::Start => 1,
                RoutineAction::Stop => 2,
                RoutineAction::Result => 3,
            };
            let option = option.as_ref().map_or(&[][..], |option| &option.0);
            vec![names::request(ecu, &[0x31, action], routine, option)?]
        }
        What::TesterPresent { count, period, .. } => {
            if period.is_some_and(|period| period < SHORTEST_PERIOD) {
                return Err(usage(format!("a period is at least {} ms", SHORTEST_PERIOD.as_millis())));
            }
            if period.is_none() && count.is_some_and(|count| count > 1) {
                return Err(usage("say how often with --period, as --period 2s"));
            }
            vec![vec![0x3E, 0]]
        }
        What::Reset { kind } => {
            let kind = match kind {
                ResetKind::Hard => 1,
                ResetKind::KeyOffOn => 2,
                ResetKind::Soft => 3,
            };
            vec![vec![0x11, kind]]
        }
        What::Dtc { clear: true, yes: false, .. } => {
            return Err(usage(
                "clearing erases what the workshop needs to find the fault; if that is meant, add --yes",
            ));
        }
        What::Dtc { clear: true, .. } => vec![vec![0x14, 0xFF, 0xFF, 0xFF]],
        What::Dtc { mask, .. } => vec![vec![0x19, 0x02, *mask]],
        What::Raw { bytes: texts } => {
            let Hex(request) = bytes(&texts.concat()).map_err(usage)?;
            vec![request]
        }
        What::Run(_)
        | What::Scan(_)
        | What::Security { .. }
        | What::Wait { .. }
        | What::Download(_)
        | What::Upload(_) => Vec::new(),
    })
}
