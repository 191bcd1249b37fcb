//! `cantap decode`: a trace as signals.

#[cfg(feature = "parquet")]
mod columns;
mod csv;
mod decoded;
mod json;
mod output;
mod text;
mod wide;

pub use decoded::Seconds;
pub use text::write_values;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use cantap::TraceEvent;
#[cfg(feature = "parquet")]
use cantap_columns::parquet::Key;
use cantap_signals::Decoder;

use self::decoded::Decoded;
use self::output::{Form, Output};
use crate::args;
use crate::completion;
use crate::databases::DatabaseArgs;
use crate::input::{ReadArgs, Records};
use crate::live::LiveArgs;
use crate::wrong::wrong;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    cantap decode --db car.dbc trace.log\n  \
    cantap decode --db car.dbc --db 2:body.toml trace.asc --signal '*Speed' --signal 'Engine.*' --csv\n  \
    candump -L can0 | cantap decode --db car.dbc - --json\n  \
    cantap decode --db car.dbc trace.log --resample 100ms -o drive.csv\n  \
    cantap decode --db car.dbc trace.log -o drive.parquet\n  \
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
    /// Write to this file instead of standard output. Its name may say the form: .csv, .json, or .parquet, a table for DuckDB,
    /// Polars, pandas and Spark with a row per value, and one per loss or bus error.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// One line of CSV per signal.
    #[arg(long, conflicts_with = "json")]
    csv: bool,
    /// In CSV and Parquet: a column per signal and a line per frame. Written at the end of the trace.
    #[arg(long)]
    wide: bool,
    /// In CSV and Parquet: a column per signal and a line every TIME, with the last value of each signal; empty where it was silent for long or
    /// frames were lost. Written at the end of the trace.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    resample: Option<Duration>,
    /// Make FILE a folder with a Parquet file for each message, which has a column per signal, and one for losses and bus errors.
    #[cfg(feature = "parquet")]
    #[arg(long, requires = "output", conflicts_with_all = ["csv", "json", "wide", "resample"])]
    per_message: bool,
    /// Make FILE a folder of Parquet files, in folders named by these in this order: day, channel, or NAME=VALUE. Engines read it
    /// as one table. Files are called as IN: decoding it again replaces them.
    #[cfg(feature = "parquet")]
    #[arg(long, value_name = "KEY", value_delimiter = ',', requires = "output")]
    #[arg(conflicts_with_all = ["csv", "json", "wide", "resample", "per_message"])]
    partition: Vec<Key>,
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
    let form = Form::of(args)?;
    let mut records = args.read.open_either(args.input.as_ref(), &args.live)?;
    let mut output = Output::open(args, form, &decoder)?;
    let count = decode(args, &decoder, &mut records, &mut output)?;
    let mut summary = serde_json::to_value(&count)?;
    records.missing().put_into(&mut summary);
    output.finish(&summary)?;
    let Count { frames, decoded, values, lost } = count;
    eprintln!("cantap: decoded {decoded} of {frames} frames, {values} values");
    if lost > 0 {
        eprintln!("cantap: {lost} frames or more are missing in the trace");
    }
    Ok(ExitCode::SUCCESS)
}

fn decode(
    args: &Args,
    decoder: &Decoder,
    records: &mut Records,
    output: &mut Output,
) -> anyhow::Result<Count> {
    let mut count = Count::default();
    let mut values = Vec::new();
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            if let TraceEvent::Lost { count: lost, .. } = record.event {
                count.lost += u64::from(lost);
            }
            let Some(frame) = record.frame() else {
                output.push_event(record)?;
                continue;
            };
            count.frames += 1;
            let Some(reference) = decoder.decode(record.channel, frame, &mut values) else { continue };
            // Chosen signals only: a message without any of them is not worth a line.
            if values.is_empty() && !args.signals.is_empty() {
                continue;
            }
            count.decoded += 1;
            count.values += values.len() as u64;
            let message = decoder.message(reference);
            output.push(&Decoded { record, frame, reference, message, values: &values })?;
        }
        if records.may_wait() {
            output.flush()?;
        }
    }
    Ok(count)
}
