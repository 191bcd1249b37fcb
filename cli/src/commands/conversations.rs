//! `cantap conversations`: what the frames mean.

mod line;
mod lines;
mod summary;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;

use cantap_protocols::{Options, Protocol};
use cantap_signals::Decoder;

pub use self::line::write;
use self::lines::Lines;
use self::summary::Summary;
use crate::database_args::{DatabaseArgs, load};
use crate::input::{FollowArgs, of_a_trace};
use crate::live_args::LiveArgs;
use crate::protocols::{self, ProtocolArgs};

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(of_a_trace),
    after_help = "Examples:\n  \
                cantap conversations drive.log\n  \
                cantap conversations drive.blf --protocol uds --protocol obd --json\n  \
                cantap conversations tractor.asc --db machine.dbc\n  \
                cantap conversations plant.log --eds 5:drive.eds --eds 6:io.dcf\n  \
                cantap conversations workshop.log --pair 6F1/12:612/F1\n  \
                cantap conversations workshop.log --odx car.pdx\n  \
                cantap conversations bench.log --a2l engine.a2l\n  \
                cantap conversations -d /dev/ttyACM0 -b 500k\n\n\
                Without --protocol, each channel is read by the protocols that its first frames show, and by others as \
                soon as they show; they are named on standard error. A line is: time, interface, protocol, sender > \
                receiver, what was said, and for a response how long it took. Where frames were lost, what was under \
                way says so. With --json each line is an object:\n\
                {\"time_s\", \"start_s\", \"channel\", \"protocol\", \"kind\", \"from\", \"to\", \"title\", \"fields\", \
                …}, see docs/protocols.md. The last line is {\"summary\"}."
)]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "FILE")]
    input: Option<PathBuf>,
    #[command(flatten)]
    live: LiveArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    /// Only this protocol, on every channel: isotp, uds, kwp2000, obd, j1939, nmea2000, canopen, devicenet, xcp, ccp, dronecan or cyphal. Several
    /// with commas, or repeated. isotp alone shows transfers as they are.
    #[arg(long = "protocol", value_name = "PROTOCOL", value_delimiter = ',')]
    protocols: Vec<Protocol>,
    #[command(flatten)]
    help: ProtocolArgs,
    /// Only what went wrong: refusals, unanswered requests, broken transfers.
    #[arg(long)]
    faults: bool,
    /// Print one JSON object per line, followed by one with the summary.
    #[arg(long)]
    json: bool,
    /// Leave out the summary.
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    read: FollowArgs,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let databases = args.databases.or_of(args.live.devices());
    let decoder = (!databases.is_empty())
        .then(|| load(&databases, args.read.strict, args.quiet))
        .transpose()?
        .map(Arc::new);
    let options = Options { protocols: args.protocols.clone(), ..args.help.options(args.quiet)? };
    let filters = match &decoder {
        Some(decoder) => args.read.filters(decoder)?,
        None => args.read.filters(&Decoder::new(Vec::new()))?,
    };
    let mut records = args.read.open_either(args.input.as_ref(), &args.live, filters)?;
    let mut reading = protocols::reading(options, decoder, args.quiet);
    let mut lines = Lines::new(args.json)?;
    let mut summary = Summary::default();
    let mut batch = Vec::new();
    loop {
        let more = records.next_batch(&mut batch)?;
        for record in &batch {
            summary.record(record);
        }
        reading.take(&batch, more, |event| {
            summary.event(&event);
            if !args.faults || event.is_fault() { lines.write(event) } else { Ok(()) }
        })?;
        if !more {
            break;
        }
        if records.may_wait() {
            lines.flush()?;
        }
    }
    lines.finish()?;
    if args.json && !args.quiet {
        let mut object = summary.object();
        records.missing().put_into(&mut object);
        writeln!(std::io::stdout(), "{}", serde_json::json!({ "summary": object }))?;
    }
    if !args.quiet {
        summary.tell();
    }
    records.judge()?;
    Ok(ExitCode::SUCCESS)
}
