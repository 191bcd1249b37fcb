//! `cantap stats`: measures a trace or a bus: load, rates, periods, losses, errors.

mod live;
mod table;
mod windows;

use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use cantap_address::Address;
use cantap_analysis::stats::{Options, Statistics, Summary};

use self::windows::Windows;
use crate::args;
use crate::completion;
use crate::database_args::{DatabaseArgs, load};
use crate::input::{FollowArgs, filtered, needs_a_trace, of_a_trace};
use crate::live_args::AUTO_NEEDS_A_DEVICE;
use crate::protocols::{Known, ProtocolArgs, needs_protocols};
use crate::range_args::RangeArgs;
use crate::usage_error::usage;
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channels::Channels;
use cantap_work::missing::{Missing, by_kind};
use cantap_work::requested_rate::RequestedRate;
use cantap_work::timing_options::TimingOptions;

/// The command line.
#[derive(clap::Args)]
#[command(
    mut_args(of_a_trace),
    mut_args(needs_protocols),
    mut_arg("strict", needs_a_trace),
    after_help = "Examples:\n  \
                cantap stats trace.log -b 500k\n  \
                cantap stats trace.blf -b 1M -b 2:250k --window 100ms --per-id\n  \
                cantap stats fd.asc -b 500k --data-bitrate 2M\n  \
                cantap stats -d virtual -b 1M -t 10\n  \
                cantap stats workshop.log --protocols\n\n\
                A frame's load is its exact length, stuff bits and intermission included, over the time since the frame \
                before. Windows also count error frames, with their minimum length. Where frames were lost, the load is \
                a lower bound and says so."
)]
pub struct Args {
    /// The trace; - for standard input.
    #[arg(value_name = "FILE")]
    input: Option<PathBuf>,
    /// Listen to a device instead of reading a file, until Ctrl-C. Repeat for several, with channels numbered
    /// consecutively. Without this and without a file, it listens to the board that is connected.
    #[arg(short, long, conflicts_with = "input", add = completion::devices())]
    device: Vec<Address>,
    /// The bus's bit rate, such as 500k; with a channel before it (2:250k), only for that channel; auto has a device find it by
    /// listening. Can be repeated. Without it, a file has a load if it
    /// says its bit rates (pcapng, ASC, BLF, TRC, MF4), and a device listens at the saved bit rate.
    #[arg(short, long = "bitrate", value_name = "[CHANNEL:]RATE", add = completion::bit_rates())]
    bitrates: Vec<RequestedRate>,
    /// The bit rate of CAN FD's data phases, such as 2M; with a channel before it (2:5M), only for that channel. Can
    /// be repeated. Without it a channel with switched bit rates has no load, unless a device knows it.
    #[arg(
        long = "data-bitrate",
        value_name = "[CHANNEL:]RATE",
        add = completion::bit_rates()
    )]
    data_bitrates: Vec<ChannelBitrate>,
    /// The channels, of the device or in the file: 1, 2, several as 1,3, or both, which means all.
    #[arg(short, long, default_value = "both", value_parser = args::channels, add = completion::channels())]
    channel: Channels,
    /// How long to listen.
    #[arg(short = 't', long, value_name = "TIME", conflicts_with = "input", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Keep intervals as the device's crystal measures them, instead of following UTC.
    #[arg(long, conflicts_with = "input")]
    device_intervals: bool,
    /// Length of the windows in which peaks are searched.
    #[arg(short, long, value_name = "TIME", default_value = "1s", value_parser = args::positive_duration)]
    window: Duration,
    /// List every window.
    #[arg(long)]
    windows: bool,
    /// List every identifier with count, period, jitter and DLCs.
    #[arg(long)]
    per_id: bool,
    /// Also show response times by service, and nodes with their states and trouble codes, by the protocols found on each channel.
    #[arg(long)]
    protocols: bool,
    #[command(flatten)]
    protocol: ProtocolArgs,
    /// Print one JSON object, including identifiers.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    range: RangeArgs,
    #[command(flatten)]
    read: FollowArgs,
}

impl Args {
    fn timing(&self) -> TimingOptions {
        TimingOptions { bitrates: self.bitrates.clone(), ..TimingOptions::default() }
    }

    fn options(&self) -> Options {
        let data = ChannelBitrate::options(&self.data_bitrates);
        Options {
            window: self.window,
            data_bitrate_bps: data.bitrate_bps,
            channel_data_bitrate_bps: data.channel_bitrate_bps,
            ..ChannelBitrate::options(&self.timing().known())
        }
    }
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let range = args.range.of(args.input.as_ref())?;
    let names =
        if args.input.is_some() { args.databases.options() } else { args.databases.or_of(&args.device) };
    let filters = args.read.filters(&load(&names, false, true)?)?;
    // Before a device is touched.
    Statistics::new(args.options()).map_err(|error| usage(error.to_string()))?;
    let live = if args.input.is_some() {
        if args.timing().has_auto() {
            return Err(usage(AUTO_NEEDS_A_DEVICE));
        }
        if args.bitrates.is_empty() && !args.data_bitrates.is_empty() {
            return Err(usage("give the bit rate outside data phases, too, with -b, such as -b 500k"));
        }
        None
    } else {
        Some(live::open(&args.device, &args.channel, &args.bitrates, args.time, args.device_intervals)?)
    };
    let mut options = args.options();
    if let Some(live) = &live {
        options.channel_bitrate_bps = live.bit_rates();
        // What the command line says comes first.
        let mut data = live.data_bit_rates();
        data.retain(|(number, _)| options.data_bitrate_of(*number).is_none());
        options.channel_data_bitrate_bps.extend(data);
        options.filtered = live.filtered();
    }
    options.filtered.extend(filtered(&filters));
    let mut statistics = Statistics::new(options).map_err(|error| usage(error.to_string()))?;
    let mut windows = args.windows.then(Windows::new).transpose()?;
    let mut known = args.protocols.then(|| args.protocol.known(args.json)).transpose()?;
    let mut ended = Ok(());
    let mut missing = Missing::default();
    if let Some(mut live) = live {
        ended = live::run(!args.json, &filters, &mut live, &mut statistics, &mut windows, &mut known);
        // What was received is shown, but it is a failure if there were only errors.
        ended = ended.and_then(|()| live.judge());
    } else if let Some(path) = &args.input {
        let mut records = args.read.open(path, filters)?.of_channels(&args.channel).within(range)?;
        let mut closed = |window: &_| {
            if let Some(windows) = &mut windows {
                windows.push(window);
            }
        };
        let mut batch = Vec::new();
        while records.next_batch(&mut batch)? {
            for (channel, bitrate_bps) in records.bit_rates() {
                statistics.learn_bitrate(*channel, *bitrate_bps);
            }
            for record in &batch {
                statistics.push_with(record, &mut closed);
            }
            if let Some(known) = &mut known {
                known.take(&batch, true);
            }
        }
        statistics.finish_with(&mut closed);
        missing = records.missing();
    }
    if let Some(known) = &mut known {
        known.take(&[], false);
    }
    if statistics.channels().is_empty() {
        // Nothing was received: the reason is all that can be reported.
        ended?;
        ended = Ok(());
    }
    let summary = statistics.summary();
    // The reader may have gone; that is an error like any other.
    let mut out = BufWriter::new(std::io::stdout().lock());
    if args.json {
        write_json(&summary, &missing, windows, known.as_ref(), &mut out)?;
    } else {
        out.write_all(table::text(&summary, &missing, args.per_id).as_bytes())?;
        if let Some(windows) = windows {
            write_windows(&summary, windows, &mut out)?;
        }
        if let Some(known) = &known {
            out.write_all(known.text().as_bytes())?;
        }
        out.write_all(table::hint(&summary, args.per_id).as_bytes())?;
    }
    out.flush()?;
    ended?;
    Ok(ExitCode::SUCCESS)
}

/// One object; the windows are its last member and are written one by one.
fn write_json(
    summary: &Summary,
    missing: &Missing,
    windows: Option<Windows>,
    known: Option<&Known>,
    out: &mut impl Write,
) -> anyhow::Result<()> {
    let object = serde_json::to_string(summary)?;
    let members = object.strip_suffix('}').context("a summary is an object")?;
    let (issues, left_out) = (missing.issues, serde_json::to_string(&by_kind(&missing.left_out))?);
    let share = missing.share_pct().map_or("null".to_owned(), |share| share.to_string());
    let members = format!("{members},\"issues\":{issues},\"left_out\":{left_out},\"missing_pct\":{share}");
    let protocols = known.map_or(String::new(), |known| format!(",\"protocols\":{}", known.object()));
    let members = members + protocols.as_str();
    let Some(windows) = windows else { return Ok(writeln!(out, "{members}}}")?) };
    write!(out, "{members},\"windows\":[")?;
    let mut comma = "";
    windows.for_each(|window| {
        let window = serde_json::to_string(window)?;
        Ok(write!(out, "{}{window}", std::mem::replace(&mut comma, ","))?)
    })?;
    Ok(writeln!(out, "]}}")?)
}

fn write_windows(summary: &Summary, windows: Windows, out: &mut impl Write) -> anyhow::Result<()> {
    let zero_s = summary.origin_s.unwrap_or(0.0);
    let mut head = "\nWindows\n";
    windows.for_each(|window| {
        let line = table::window_line(window, zero_s);
        Ok(writeln!(out, "{}{line}", std::mem::take(&mut head))?)
    })
}
