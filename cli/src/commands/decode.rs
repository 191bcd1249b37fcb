//! `cantap decode`: a trace as signals.

mod csv;
mod decoded;
mod json;
mod text;
mod wide;

pub use decoded::Seconds;
pub use text::write_values;

use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use cantap::TraceEvent;
use cantap_signals::Decoder;

use self::decoded::Decoded;
use self::wide::Wide;
use crate::args;
use crate::completion;
use crate::databases::DatabaseArgs;
use crate::input::ReadArgs;
use crate::live::LiveArgs;
use crate::missing::Missing;
use crate::wrong::wrong;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    cantap decode --db car.dbc trace.log\n  \
    cantap decode --db car.dbc --db 2:body.toml trace.asc --signal '*Speed' --signal 'Engine.*' --csv\n  \
    candump -L can0 | cantap decode --db car.dbc - --json\n  \
    cantap decode --db car.dbc trace.log --csv --resample 100ms > drive.csv\n  \
    cantap decode --db car.dbc -d /dev/ttyACM0 -b 500k\n\n\
JSON lines are {\"time_s\", \"channel\", \"id\", \"message\", \"signals\": {NAME: NUMBER}}:\nseconds, channel from 1, \
    identifier in hexadecimal (3 or 8 digits),\nphysical values (null where there is none: a float that is no number, or J1939's error or not available).\n\
With --details each signal is {\"value\", \"unit\", \"text\", \"raw\"}, without those that it does not have.\n\
The last line is {\"summary\"}: how much there was, was decoded, and could not be read.")]
pub struct Args {
    #[command(flatten)]
    databases: DatabaseArgs,
    /// The trace; - for standard input.
    #[arg(value_name = "IN")]
    input: Option<PathBuf>,
    #[command(flatten)]
    live: LiveArgs,
    /// Only signals of this name, or Message.Signal; with *, ? and [a-z]. Several with commas, or
    /// repeated.
    #[arg(short, long = "signal", value_name = "PATTERN", value_delimiter = ',', add = completion::signals())]
    signals: Vec<String>,
    /// One line of CSV per signal.
    #[arg(long, conflicts_with = "json")]
    csv: bool,
    /// A column per signal and a line per frame. Written at the end of the trace.
    #[arg(long, requires = "csv")]
    wide: bool,
    /// A column per signal and a line every TIME, with the last value of each signal; empty where it was silent for long or
    /// frames were lost. Written at the end of the trace.
    #[arg(long, value_name = "TIME", requires = "csv", value_parser = args::positive_duration)]
    resample: Option<Duration>,
    /// Print one JSON object per message, and behind them one with the summary.
    #[arg(long)]
    json: bool,
    /// Unit, text and raw value of each signal too.
    #[arg(long, requires = "json")]
    details: bool,
    /// Leave out what is wrong with databases that can be used, and which of them replaces another.
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    read: ReadArgs,
}

/// What the summary says.
#[derive(Default, serde::Serialize)]
struct Count {
    frames: u64,
    decoded: u64,
    values: u64,
    lost: u64,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let databases = args.databases.or_of(args.live.devices());
    if databases.is_empty() {
        return Err(wrong(
            "no database to decode by; give one with --db FILE (.dbc, .kcd, .sym, .arxml or .toml)",
        ));
    }
    let decoder = databases.load_some(args.read.strict, args.quiet, &args.signals)?;
    let mut out = BufWriter::with_capacity(1 << 16, std::io::stdout().lock());
    let (count, missing) = decode(args, &decoder, &mut out)?;
    if args.json {
        let mut summary = serde_json::to_value(&count)?;
        missing.put_into(&mut summary);
        writeln!(out, "{}", serde_json::json!({ "summary": summary }))?;
    }
    out.flush()?;
    let Count { frames, decoded, values, lost } = count;
    eprintln!("cantap: decoded {decoded} of {frames} frames, {values} values");
    if lost > 0 {
        eprintln!("cantap: {lost} frames or more are missing in the trace");
    }
    Ok(ExitCode::SUCCESS)
}

fn decode(args: &Args, decoder: &Decoder, out: &mut impl Write) -> anyhow::Result<(Count, Missing)> {
    let mut records = args.read.open_either(args.input.as_ref(), &args.live)?;
    let mut count = Count::default();
    let mut values = Vec::new();
    let step_ns = args.resample.map(|step| i64::try_from(step.as_nanos()).unwrap_or(i64::MAX));
    let mut wide = (args.wide || step_ns.is_some()).then(|| Wide::new(step_ns)).transpose()?;
    if args.csv && wide.is_none() {
        csv::write_header(out)?;
    }
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            if let TraceEvent::Lost { count: lost, .. } = record.event {
                count.lost += u64::from(lost);
                if let Some(wide) = &mut wide {
                    wide.interrupt(record.channel);
                }
            }
            let Some(frame) = record.frame() else { continue };
            count.frames += 1;
            let Some(reference) = decoder.decode(record.channel, frame, &mut values) else { continue };
            // Chosen signals only: a message without any of them is not worth a line.
            if values.is_empty() && !args.signals.is_empty() {
                continue;
            }
            count.decoded += 1;
            count.values += values.len() as u64;
            let message = decoder.message(reference);
            let decoded = Decoded { record, frame, reference, message, values: &values };
            match (&mut wide, args.json, args.csv) {
                (Some(wide), ..) => wide.push(&decoded)?,
                (_, true, _) => json::write(out, &decoded, args.details)?,
                (.., true) => csv::write(out, &decoded)?,
                _ => text::write(out, &decoded)?,
            }
        }
        if records.may_wait() {
            out.flush()?;
        }
    }
    if let Some(wide) = wide {
        wide.finish(out)?;
    }
    Ok((count, records.missing()))
}
