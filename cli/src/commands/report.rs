//! `cantap report`: a trace as one page that opens in any browser, offline.

mod changes;
mod trace;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use cantap_trace::counted;
use cantap_work::atomic_file;
use cantap_work::channel_bitrate::ChannelBitrate;
use serde_json::json;

use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::page::{self, Carried};
use crate::protocols::ProtocolArgs;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
                cantap report drive.blf --db car.dbc -o drive.html\n  \
                cantap report drive.log.gz --db 1:engine.dbc -b 500k --note 'It stalls'\n  \
                cantap report today.blf --db car.dbc --against yesterday.blf\n\n\
                The page has the trace and the databases in it, and opens by a double click: rows, graphs, bits, conversations, and \
                first of all what was found. It loads nothing, and the trace can be saved out of it again, byte for byte.\n\n\
                The page itself is a part of released binaries. A build of one's own has it after cargo xtask web: set CANTAP_PAGE to \
                the file that this names.")]
pub struct Args {
    /// The trace.
    #[arg(value_name = "FILE")]
    input: PathBuf,
    /// The page to write; without it, the trace's name with .html.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// The bus's bit rate, such as 500k; with a channel before it (2:250k), only for that channel. Can be repeated. Without it
    /// there is no bus load.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", add = completion::bit_rates())]
    bitrates: Vec<ChannelBitrate>,
    /// The bit rate of CAN FD's data phases, such as 2M; with a channel before it (2:5M), only for that channel.
    #[arg(long = "data-bitrate", value_name = "[CHANNEL:]RATE", requires = "bitrates", add = completion::bit_rates())]
    data_bitrates: Vec<ChannelBitrate>,
    /// What to tell the reader. Can be repeated.
    #[arg(long = "note", value_name = "TEXT")]
    notes: Vec<String>,
    /// Another trace: the first page says what has changed since then.
    #[arg(long, value_name = "FILE")]
    against: Option<PathBuf>,
    /// The largest page, in megabytes: of a larger trace, only the beginning is in it, and the page says so.
    #[arg(long, value_name = "MB", default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..=2000))]
    size_limit: u64,
    /// Do not report what is wrong with usable databases.
    #[arg(short, long)]
    quiet: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let page = page::find()?;
    let name = file_name(&args.input)?;
    let output = args.output.clone().unwrap_or_else(|| args.input.with_extension("html"));
    if output == args.input {
        bail!("the page would replace the trace; give it another name with -o");
    }
    // Only so that faults are reported here rather than to the reader of the page.
    load(&args.databases.options(), false, args.quiet)?;
    let mut databases = page::databases(&args.databases.options().paths)?;
    let described = args.protocol.carried(args.quiet)?;
    databases.extend(described.files);
    let read = trace::read(&args.input)?;
    let mut findings = Vec::new();
    if let Some(against) = &args.against {
        let before = trace::read(against)?;
        findings = changes::findings(&before.profile, &read.profile, &file_name(against)?);
    }
    let room = (args.size_limit * 1_000_000).saturating_sub(page.len() as u64);
    let taken: usize = databases.iter().map(Carried::len).sum();
    let trace = trace::carried(&args.input, &name, &read, room.saturating_sub(taken as u64))?;
    for text in &trace.thinned {
        eprintln!("cantap: {text}");
    }
    let databases: Vec<_> = databases.into_iter().map(Carried::into_object).collect();
    let report = json!({
        "version": 1,
        "title": name,
        "created": now(),
        "command": "cantap report",
        "notes": args.notes,
        "trace": trace.file.into_object(),
        "databases": databases,
        "connections": described.connections,
        "bitrates": bitrates(args, &read.channels),
        "findings": findings,
        "thinned": trace.thinned,
    });
    let bytes = page::with(&page, page::REPORT, &report)?;
    atomic_file::write(&output, bytes.as_bytes())
        .with_context(|| format!("cannot write {}", output.display()))?;
    eprintln!(
        "cantap: {}: {}, {:.1} MB; open it in a browser",
        output.display(),
        counted(read.records, "record"),
        bytes.len() as f64 / 1e6
    );
    Ok(ExitCode::SUCCESS)
}

/// The trace's name.
fn file_name(path: &std::path::Path) -> anyhow::Result<String> {
    let name = page::file_name(path).filter(|_| path.as_os_str() != "-");
    name.context("a report is made of a file; write standard input into one first")
}

fn bitrates(args: &Args, channels: &[u8]) -> Vec<serde_json::Value> {
    let of = |channel: &u8| {
        let bitrate = ChannelBitrate::of(&args.bitrates, *channel)?;
        let data = ChannelBitrate::of(&args.data_bitrates, *channel);
        Some(json!({ "channel": channel, "bitrate": bitrate, "dataBitrate": data }))
    };
    channels.iter().filter_map(of).collect()
}

/// The time in UTC, to the second.
fn now() -> String {
    let now = jiff::Timestamp::now();
    jiff::Timestamp::from_second(now.as_second()).unwrap_or(now).to_string()
}
