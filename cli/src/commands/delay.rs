//! `cantap delay`: how long a gateway takes, from a trace of both its buses.

mod output;

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use cantap::Channel;
use cantap_analysis::delay::{DelayOptions, Expected, Matching};
use cantap_trace::filter::{Filter, passes};
use cantap_trace::{TraceEvent, TraceFrame};
use cantap_work::gateway::{Map, Rules};

use self::output::Output;
use crate::args;
use crate::database_args::DatabaseArgs;
use crate::exit;
use crate::input::{FollowArgs, Records, of_a_trace};
use crate::live_args::LiveArgs;
use crate::usage_error::usage;

/// The command line.
#[derive(clap::Args)]
#[command(
    // In this command, --from is a channel.
    mut_arg("format", |format| format.long("format")),
    mut_args(of_a_trace),
    after_help = "Frames are found again by identifier and data. The delay is from the end of a frame on one bus to its end on the other: it \
                  contains the frame's own length there, and its waiting for that bus. -f chooses among the frames of --from; of --to \
                  it only hides extra ones.\n\nExamples:\n  \
                  cantap delay both.log --from 1 --to 2\n  \
                  cantap delay both.blf --from 2 --to 1 -f 100-1FF --within 20ms\n  \
                  cantap delay both.log --from 1 --to 2 --map rules.toml --json\n  \
                  cantap delay -d /dev/ttyACM0 -b 500k -t 60s --from 1 --to 2\n\n\
                  Exit code: 0, also if frames are missing or extra; with --check 3 if some are."
)]
pub struct Args {
    /// The trace, with both channels; - for standard input.
    #[arg(value_name = "FILE")]
    input: Option<PathBuf>,
    /// The channel whose frames the gateway passes on: 1, or can0.
    #[arg(long, value_name = "CHANNEL", value_parser = args::channel_of_trace)]
    from: u8,
    /// The channel on which they appear again.
    #[arg(long, value_name = "CHANNEL", value_parser = args::channel_of_trace)]
    to: u8,
    /// A frame that has not appeared after this time is missing.
    #[arg(long, value_name = "TIME", default_value = "100ms", value_parser = args::positive_duration)]
    within: Duration,
    /// The gateway's rules, if it changes, drops or delays frames (docs/gateway.md). What no rule passes on is not expected.
    #[arg(long, value_name = "RULES")]
    map: Option<PathBuf>,
    /// End with 3 if frames are missing or extra.
    #[arg(long)]
    check: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    live: LiveArgs,
    #[command(flatten)]
    databases: DatabaseArgs,
    #[command(flatten)]
    read: FollowArgs,
}

/// The longest window: equal frames of a whole day are kept for no gateway.
const LONGEST: Duration = Duration::from_hours(1);

/// Runs it.
pub fn run(mut args: Args) -> anyhow::Result<ExitCode> {
    args.read.read.format_option = "--format";
    if args.from == args.to {
        return Err(usage("--from and --to are the same channel; name the two that the gateway connects"));
    }
    if let Some(channel) = [args.from, args.to].into_iter().find(|of| !args.live.channels().has(*of)) {
        return Err(usage(format!(
            "-c leaves out channel {channel}, which --from or --to names; leave -c out"
        )));
    }
    if args.within > LONGEST {
        return Err(usage("--within is at most an hour"));
    }
    let map = args.map.as_deref().map(|path| map(path, args.from, args.to)).transpose()?;
    let filters = args.read.filters(&args.databases.load(args.read.strict, false)?)?;
    let mut records = args.read.open_either(args.input.as_ref(), &args.live, Vec::new())?;
    let options = DelayOptions {
        from: args.from,
        to: args.to,
        within_ns: i64::try_from(args.within.as_nanos()).unwrap_or(i64::MAX).max(1),
    };
    let expected = |frame: &TraceFrame| match &map {
        Some(map) => map.expected(frame),
        None => Some(Expected::unchanged(*frame)),
    };
    let output = analyse(Matching::new(options, expected), options, &filters, &mut records)?;
    let mut out = BufWriter::new(std::io::stdout().lock());
    if args.json {
        writeln!(out, "{}", output.object(&records.missing()))?;
    } else {
        output.print(&mut out)?;
    }
    out.flush()?;
    let total = &output.outcome.total;
    let failed = args.check && total.missing + total.extra > 0;
    Ok(if failed { ExitCode::from(exit::CHECK_FAILED) } else { ExitCode::SUCCESS })
}

/// The rules for a direction.
fn map(path: &Path, from: u8, to: u8) -> anyhow::Result<Map> {
    let rules = Rules::read(path)?;
    let channel = Channel::ALL.into_iter().find(|channel| channel.number() == from);
    let Some(channel) = channel.filter(|_| matches!(to, 1 | 2)) else {
        return Err(usage(
            "rules are for channels 1 and 2; leave --map out, or move channels with cantap convert",
        ));
    };
    let map = Map::new(&rules, channel);
    if map.is_empty() {
        bail!(
            "{} has no rule for what channel {from} receives; swap --from and --to, or add one",
            path.display()
        );
    }
    Ok(map)
}

fn analyse<M: FnMut(&TraceFrame) -> Option<Expected>>(
    mut matching: Matching<M>,
    options: DelayOptions,
    filters: &[Filter],
    records: &mut Records,
) -> anyhow::Result<Output> {
    let mut frames = [0_u64; 2];
    let mut batch = Vec::new();
    while records.next_batch(&mut batch)? {
        for record in &batch {
            matching.push(record, passes(filters, record));
            let side = [options.from, options.to].iter().position(|channel| *channel == record.channel);
            if let Some(side) = side.filter(|_| matches!(record.event, TraceEvent::Frame { .. })) {
                frames[side] += 1;
            }
        }
    }
    records.judge()?;
    if let Some(side) = frames.iter().position(|frames| *frames == 0) {
        let channel = [options.from, options.to][side];
        bail!(
            "channel {channel} has no frames in this trace; cantap stats shows which channels have, and cantap align makes one trace of two"
        );
    }
    Ok(Output { options, outcome: matching.finish() })
}
