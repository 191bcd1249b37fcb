//! `cantap compare-adapters`: two devices on one bus, measured against each other.

mod result;

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::TraceRecord;
use cantap::device::channel_number;
use cantap_address::Address;
use cantap_analysis::align::{AlignError, Alignment, RUN_LENGTHS, Sketch, Verifier, align};
use cantap_work::boards::Boards;
use cantap_work::channels::{Channels, place_of};
use cantap_work::live::LiveRecords;

use self::result::{Adapter, Comparison};
use crate::channel_args::ChannelArgs;
use crate::usage_error::usage;
use crate::{args, completion, exit, stderr};

/// Records kept of both devices together: some gigabyte.
const MOST_RECORDS: usize = 10_000_000;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Both devices must be on the same bus, which should carry frames that change, such as counters: the frames that both have \
                  show how their clocks relate. Each only listens unless --mode says otherwise; at least one node on the bus must acknowledge.\n\n\
                  Examples:\n  \
                  cantap compare-adapters -d /dev/ttyACM0 -d can0 -b 500k\n  \
                  cantap compare-adapters -d /dev/ttyACM0 -d elm327:tcp://192.168.0.10 -b 500k -t 60s --json\n\n\
                  Exit code 3: a frame is missing at one of the two, or in another order. 1: they have nothing in common that repeats in no \
                  other place."
)]
pub struct Args {
    /// Where the two devices are. Exactly two; the first one's clock is what the second is measured by.
    #[arg(short, long = "device", value_name = "DEVICE", required = true, add = completion::devices())]
    devices: Vec<Address>,
    /// Which channels: 1, 2, several as 1,3, or both, which means all. The second device's are 3 and 4.
    #[arg(short, long, default_value = "both", value_parser = args::channels, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// How long to listen, as 10, 500ms or 2m.
    #[arg(short, long, alias = "for", default_value = "10s", value_parser = args::positive_duration)]
    time: Duration,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.devices.len() != 2 {
        return Err(usage("name two devices with -d, such as -d /dev/ttyACM0 -d can0"));
    }
    let boards = Boards::new(&args.devices, &args.channel)?;
    let mut live =
        LiveRecords::open(&boards, &args.open.options(), &[], Some(args.time), &stderr::reporter())?;
    let records = receive(&mut live)?;
    let adapters = [0, 1].map(|board| Adapter::of(board, &live, &records[board]));
    let alignment = find(&records).with_context(|| {
        let [first, second] = &adapters;
        format!(
            "the {} frames of '{}' and the {} of '{}' cannot be compared",
            first.frames, first.device, second.frames, second.device
        )
    })?;
    let agreement = verify(&alignment, &records);
    let comparison = Comparison::new(adapters, &alignment, agreement);
    comparison.print(args.json)?;
    live.judge()?;
    Ok(if comparison.is_equal() { ExitCode::SUCCESS } else { ExitCode::from(exit::CHECK_FAILED) })
}

/// What each of the two received, its channels numbered from 1.
fn receive(live: &mut LiveRecords) -> anyhow::Result<[Vec<TraceRecord>; 2]> {
    let mut kept = [Vec::new(), Vec::new()];
    let mut batch = Vec::new();
    let mut ended = None;
    loop {
        match live.next_batch(&mut batch) {
            Ok(true) => {}
            Ok(false) => break,
            // One that has ended, such as a pipe, ends the comparison. What both have is compared.
            Err(error) if ended.is_none() && kept.iter().all(|records| !records.is_empty()) => {
                ended = Some(error);
                live.stop();
                continue;
            }
            Err(_) if ended.is_some() => break,
            Err(error) => return Err(error),
        }
        for record in &batch {
            let (board, channel) = place_of(record.channel);
            if let Some(records) = kept.get_mut(board) {
                records.push(TraceRecord { channel: channel_number(0, channel), ..*record });
            }
        }
        if kept.iter().map(Vec::len).sum::<usize>() >= MOST_RECORDS {
            stderr::warn(
                "there are too many frames to keep for that long: what was received so far is compared",
            );
            live.stop();
            break;
        }
    }
    if let Some(error) = ended {
        stderr::warn(&format!("{error:#}; what both received before that is compared"));
    }
    Ok(kept)
}

/// How the second one's clock relates to the first one's.
fn find(records: &[Vec<TraceRecord>; 2]) -> anyhow::Result<Alignment> {
    let mut unclear = AlignError::NothingInCommon;
    for length in RUN_LENGTHS {
        let [first, second] = records.each_ref().map(|records| {
            let mut sketch = Sketch::new(length);
            for record in records {
                sketch.add(record);
            }
            sketch
        });
        match align(&first, &second) {
            Ok(alignment) => return Ok(alignment),
            Err(error) => unclear = error,
        }
    }
    bail!(unclear)
}

/// Compares the records in the order of the first one's time.
fn verify(
    alignment: &Alignment,
    [first, second]: &[Vec<TraceRecord>; 2],
) -> cantap_analysis::align::Agreement {
    let mut verifier = Verifier::new(alignment).with_bounds();
    let mut firsts = first.iter().peekable();
    let mapped =
        |record: &TraceRecord| TraceRecord { time_ns: alignment.map.to_first(record.time_ns), ..*record };
    for record in second.iter().map(mapped) {
        while let Some(earlier) = firsts.next_if(|first| first.time_ns <= record.time_ns) {
            verifier.first(earlier);
        }
        verifier.second(&record);
    }
    firsts.for_each(|record| verifier.first(record));
    verifier.finish()
}
