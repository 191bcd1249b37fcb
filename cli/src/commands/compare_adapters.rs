//! `cantap compare-adapters`: two devices on one bus, measured against each other.

mod result;

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use cantap::TraceRecord;
use cantap::device::channel_number;
use cantap_address::Address;
use cantap_analysis::align::compare;
use cantap_trace::counted;
use cantap_work::boards::Boards;
use cantap_work::channels::{Channels, place_of};
use cantap_work::live::LiveRecords;

use self::result::{Adapter, Outcome};
use crate::channel_args::ChannelArgs;
use crate::usage_error::usage;
use crate::{args, completion, exit, stderr};

/// Records kept of both devices together: some gigabyte with what the comparison needs.
const MOST_RECORDS: usize = 4_000_000;

/// How long to go on when one of the two has ended: frames that it has may still be on their way from the other.
const ON_THE_WAY: Duration = Duration::from_millis(500);

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Both devices must be on the same bus, which should carry frames that change, such as counters: the frames that both have \
                  show how their clocks relate. Each only listens unless --mode says otherwise; at least one node on the bus must acknowledge.\n\n\
                  Examples:\n  \
                  cantap compare-adapters -d /dev/ttyACM0 -d can0 -b 500k\n  \
                  cantap compare-adapters -d COM3 -d elm327:COM4 -b 500k -t 60s --json\n\n\
                  Exit code 3: one of the two missed a frame, has one more often than the other, or has them in another order. \
                  1: one received nothing, or they have nothing in common that occurs only once."
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
    if let Some(board) = (0..2).find(|board| boards.channels_of(*board).next().is_none()) {
        let of = ["first device's are 1 and 2", "second device's are 3 and 4"][board];
        return Err(usage(format!("-c must name a channel of each device; the {of}, such as -c 1,3")));
    }
    let mut live =
        LiveRecords::open(&boards, &args.open.options(), &[], Some(args.time), &stderr::reporter())?;
    let mut adapters = [0, 1].map(|board| Adapter::of(board, &live));
    let Received { records, is_cut } = receive(&mut live)?;
    for (board, adapter) in adapters.iter_mut().enumerate() {
        adapter.received(board, &live, &records[board]);
    }
    if let Some(silent) = adapters.iter().find(|adapter| adapter.frames == 0) {
        live.judge()?;
        bail!(silent.nothing_received());
    }
    let [first, second] = &records;
    let comparison = compare(first, second).with_context(|| {
        let [first, second] = &adapters;
        format!(
            "the {} of '{}' and the {} of '{}' cannot be compared",
            counted(first.frames, "frame"),
            first.device,
            second.frames,
            second.device
        )
    })?;
    let result = Outcome::new(adapters, &comparison, is_cut);
    result.print(args.json)?;
    live.judge()?;
    Ok(if result.is_equal() { ExitCode::SUCCESS } else { ExitCode::from(exit::CHECK_FAILED) })
}

/// What the two received.
struct Received {
    /// Of each, its channels numbered from 1.
    records: [Vec<TraceRecord>; 2],
    /// One of them ended before the other.
    is_cut: bool,
}

fn receive(live: &mut LiveRecords) -> anyhow::Result<Received> {
    let mut records = [Vec::new(), Vec::new()];
    let mut batch = Vec::new();
    let mut ended = None;
    loop {
        match live.next_batch(&mut batch) {
            Ok(true) => {}
            // One that has ended, such as a pipe, ends the comparison. What both have is compared.
            Err(error) if ended.is_none() => {
                ended = Some(error);
                std::thread::sleep(ON_THE_WAY);
                live.stop();
                continue;
            }
            Ok(false) | Err(_) => break,
        }
        for record in &batch {
            let (board, channel) = place_of(record.channel);
            if let Some(records) = records.get_mut(board) {
                records.push(TraceRecord { channel: channel_number(0, channel), ..*record });
            }
        }
        if records.iter().map(Vec::len).sum::<usize>() >= MOST_RECORDS {
            stderr::warn(
                "there are too many frames to keep for that long: what was received so far is compared",
            );
            live.end()?;
            break;
        }
    }
    let is_cut = ended.is_some();
    if let Some(error) = ended {
        stderr::warn(&format!("{error:#}; what both received before that is compared"));
    }
    Ok(Received { records, is_cut })
}
