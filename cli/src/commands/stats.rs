//! `cantap stats`: what a trace or a bus does: load, rates, periods, losses, errors.

mod live;
mod table;

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use cantap::Address;
use cantap::stats::{Options, PeakSummary, Statistics, Summary};

use crate::args;
use crate::channel_bitrate::ChannelBitrate;
use crate::input::ReadArgs;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  \
    cantap stats trace.log -b 500k\n  \
    cantap stats trace.blf -b 1M -b 2:250k --window 100ms --per-id\n  \
    cantap stats -d virtual -b 1M -t 10\n\n\
A frame's load is its exact length, stuff bits and intermission included, over the time since the frame\n\
before. Windows also count error frames, with their least length. Where frames were lost, the load is a\n\
lower bound and says so.")]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "FILE", required_unless_present = "device")]
    input: Option<PathBuf>,
    /// Listen to a device instead of reading a file, until Ctrl-C.
    #[arg(short, long, conflicts_with = "input")]
    device: Option<Address>,
    /// The bus's bit rate, such as 500k; with a channel before it (2:250k), that channel's only. Can be
    /// repeated. A file has no load without it.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]BITRATE", required_unless_present = "input")]
    bitrates: Vec<ChannelBitrate>,
    /// The device's channel to listen to: 1, 2 or both.
    #[arg(short, long, default_value = "both", requires = "device", value_parser = args::channels)]
    channel: args::Channels,
    /// Listen only for so long.
    #[arg(short = 't', long, value_name = "TIME", requires = "device", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Length of the windows that peaks are looked for in.
    #[arg(short, long, value_name = "TIME", default_value = "1s", value_parser = args::duration)]
    window: Duration,
    /// List every window.
    #[arg(long)]
    windows: bool,
    /// List every identifier with count, period, jitter and DLCs.
    #[arg(short, long)]
    per_id: bool,
    /// Print one JSON object, identifiers included.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    read: ReadArgs,
}

impl Args {
    fn options(&self) -> Options {
        Options { window: self.window, ..ChannelBitrate::options(&self.bitrates) }
    }
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let mut statistics = Statistics::new(args.options())?;
    let mut windows = Vec::new();
    if let Some(address) = &args.device {
        live::run(args, address, &mut statistics, &mut windows)?;
    } else if let Some(path) = &args.input {
        let mut records = args.read.open(path)?;
        let keep = args.windows;
        let mut closed = |window: &_| {
            if keep {
                windows.push(PeakSummary::of(window));
            }
        };
        let mut batch = Vec::new();
        while records.next_batch(&mut batch)? {
            for record in &batch {
                statistics.push_with(record, &mut closed);
            }
        }
        statistics.finish_with(&mut closed);
    } else {
        bail!("name a file, or a device with -d");
    }
    let summary = statistics.summary();
    if args.json {
        print_json(&summary, args.windows.then_some(&windows))?;
    } else {
        print(&table::text(&summary, &windows, args.per_id))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn print_json(summary: &Summary, windows: Option<&Vec<PeakSummary>>) -> anyhow::Result<()> {
    let mut object = serde_json::to_value(summary)?;
    if let Some(windows) = windows {
        object["windows"] = serde_json::to_value(windows)?;
    }
    print(&format!("{object}\n"))
}

/// To standard output, whose reader may have gone.
fn print(text: &str) -> anyhow::Result<()> {
    Ok(std::io::stdout().lock().write_all(text.as_bytes())?)
}
