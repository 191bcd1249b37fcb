//! Statistics: frames per second of a saturated bus that `Statistics` measures on one core.

use std::time::Instant;

use anyhow::{Result, ensure};
use cantap_analysis::stats::{Options, Statistics};
use cantap_trace::{Direction, Frame, Id, TraceEvent, TraceRecord};

/// Frames in one round.
const FRAMES: usize = 1 << 20;
/// The best of this many rounds counts.
const ROUNDS: usize = 5;
/// What the design requires, in frames/s.
const AT_LEAST: f64 = 5e6;

pub(super) fn run() -> Result<()> {
    println!("Statistics: load, windows, periods and DLCs of two saturated channels");
    println!("| identifiers | frames/s |\n|---|---|");
    for ids in [16, 1000, 50_000] {
        let records = records(ids);
        let mut best = 0.0f64;
        for _ in 0..ROUNDS {
            let options = Options { bitrate_bps: Some(1_000_000), ..Options::default() };
            let mut statistics = Statistics::new(options)?;
            let started = Instant::now();
            for record in &records {
                statistics.push(record);
            }
            let per_s = FRAMES as f64 / started.elapsed().as_secs_f64();
            ensure!(statistics.summary().frames == FRAMES as u64, "frames went missing in the statistics");
            best = best.max(per_s);
        }
        println!("| {ids} | {best:.0} |");
        ensure!(best >= AT_LEAST, "{best:.0} frames/s are below the {AT_LEAST:.0} required");
    }
    Ok(())
}

/// Frames with eight bytes, alternating between both channels, from `ids` extended identifiers in random
/// order.
fn records(ids: u32) -> Vec<TraceRecord> {
    (0..FRAMES as u64)
        .map(|n| {
            // A multiplicative generator's upper bits (Knuth's MMIX constant) are random enough for this.
            let random = (n + 1).wrapping_mul(6_364_136_223_846_793_005).rotate_left(32);
            let id = Id::extended_truncated((random % u64::from(ids)) as u32 * 8191);
            let frame = Frame::from_bus(id, false, 8, random.to_be_bytes());
            let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
            TraceRecord { time_ns: n as i64 * 70_000, device_ns: None, channel: 1 + (n % 2) as u8, event }
        })
        .collect()
}
