//! The options of `cantap decode`.

use std::path::PathBuf;
use std::time::Duration;

#[cfg(feature = "parquet")]
use cantap_columns::parquet::Key;

use crate::args;
use crate::completion;
use crate::database_args::DatabaseArgs;
use crate::input::{FollowArgs, of_a_trace};
use crate::live_args::LiveArgs;
use crate::protocols::{ProtocolArgs, needs_protocols};
use crate::range_args::RangeArgs;

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(of_a_trace),
    mut_args(needs_protocols),
    after_help = "Examples:\n  \
                cantap decode --db car.dbc trace.log\n  \
                cantap decode --db car.dbc --db 2:body.toml trace.asc --signal '*Speed' \\\n      \
                --signal 'Engine.*' --csv\n  \
                candump -L can0 | cantap decode --db car.dbc - --json\n  \
                cantap decode --db car.dbc trace.log --resample 100ms -o drive.csv\n  \
                cantap decode --db car.dbc trace.log -o drive.parquet\n  \
                cantap decode --db car.dbc trace.log -o drive.mcap\n  \
                cantap decode --db car.dbc -d /dev/ttyACM0 -b 500k\n  \
                cantap decode workshop.log --protocols --csv\n\n\
                JSON lines are {\"time_s\", \"channel\", \"id\", \"message\", \"signals\": {NAME: NUMBER}}:\n\
                seconds, channel from 1, identifier in hexadecimal (3 or 8 digits), physical values (null where there \
                is none: a float that is not a number, or J1939's error or not available). With --details each signal \
                is {\"value\", \"unit\", \"text\", \"raw\"}, without those that it does not have. With --protocols, \
                what was said has also protocol, from and to. The last line is {\"summary\"}: how much there was, was \
                decoded, and could not be read."
)]
pub struct Args {
    #[command(flatten)]
    pub databases: DatabaseArgs,
    /// The trace; - for standard input.
    #[arg(value_name = "IN")]
    pub input: Option<PathBuf>,
    #[command(flatten)]
    pub live: LiveArgs,
    /// Only signals of this name, or Message.Signal; with *, ? and [a-z]. Several with commas, or
    /// repeated.
    #[arg(short, long = "signal", value_name = "PATTERN", value_delimiter = ',', add = completion::signals())]
    pub signals: Vec<String>,
    /// Also what frames say together, by the protocols found on each channel: their fields as signals, named uds.sid, j1939.pgn
    /// and so on (docs/protocols.md). Tables with a column per signal contain the numbers; Parquet with a row per value has no
    /// place for them.
    #[arg(long)]
    pub protocols: bool,
    #[command(flatten)]
    pub protocol: ProtocolArgs,
    /// Write to this file instead of standard output. Its name may select the form: .csv, .json, .mcap for
    /// Foxglove with a channel per message, or .parquet, a table for DuckDB, Polars, pandas and Spark with a row per value. Both have losses and
    /// bus errors, too.
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// One line of CSV per signal.
    #[arg(long, conflicts_with = "json")]
    pub csv: bool,
    /// In CSV: an apostrophe in front of names and texts that begin with = + - @, which a spreadsheet would take for formulas.
    #[arg(long, conflicts_with = "json")]
    pub text_cells: bool,
    /// In CSV and Parquet: a column per signal and a line per frame. Written at the end of the trace.
    #[arg(long)]
    pub wide: bool,
    /// In CSV and Parquet: a column per signal and a line every TIME, with the last value of each signal; empty where it was silent for long or
    /// frames were lost. Written at the end of the trace.
    #[arg(long, value_name = "TIME", value_parser = args::positive_duration)]
    pub resample: Option<Duration>,
    /// Make FILE a folder with a Parquet file for each message, with a column per signal, and one for losses and bus errors.
    #[cfg(feature = "parquet")]
    #[arg(long, requires = "output", conflicts_with_all = ["csv", "json", "wide", "resample"])]
    pub per_message: bool,
    /// Make FILE a folder of Parquet files, in folders named after these, in this order: day, channel, or NAME=VALUE. Engines
    /// read it as one table. The files are named after IN: decoding it again replaces them.
    #[cfg(feature = "parquet")]
    #[arg(long, value_name = "KEY", value_delimiter = ',', requires = "output")]
    #[arg(conflicts_with_all = ["csv", "json", "wide", "resample", "per_message"])]
    pub partition: Vec<Key>,
    /// Print one JSON object per message, followed by one with the summary.
    #[arg(long)]
    pub json: bool,
    /// Also unit, text and raw value of each signal.
    #[arg(long, requires = "json")]
    pub details: bool,
    /// Do not report what is wrong with usable databases, and which of them replaces another.
    #[arg(short, long)]
    pub quiet: bool,
    #[command(flatten)]
    pub range: RangeArgs,
    #[command(flatten)]
    pub read: FollowArgs,
}
