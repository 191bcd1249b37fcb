//! How well a board's time is mapped to UTC, and one board's time to another's, on emulated boards.

use anyhow::{Context, Result};
use cantap::device::ClockReport;
use cantap_sim::firmware;

use crate::board::Board;

// The test measures the same, for a shorter time.
#[path = "../../../cli/tests/it/emulated_clock/measure.rs"]
mod measure;

use measure::Errors;

/// By how much the two crystals are off, in ppm.
const PPM: [f64; 2] = [40.0, -40.0];
/// Emulated seconds, and the second from which errors count.
const SECONDS: u32 = 300;
const SETTLED_S: [u32; 2] = [5, 60];

/// Measures.
pub fn run() -> Result<()> {
    let elf = Board::ALL[0].elf();
    let image =
        firmware::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let [fast, slow] = PPM;
    println!(
        "clock: two boards of {fast:+} and {slow:+} ppm on one emulated computer, whose clock is 25 ppm off its USB frames; {SECONDS} s"
    );
    for settled_s in SETTLED_S {
        let clocks = measure::measure(&image, PPM, SECONDS, settled_s)?;
        println!("from second {settled_s} on{:>44} {:>12}", "median, us", "worst, us");
        let line = |name: &str, errors: Errors| {
            println!("  {name:<46} {:>12.3} {:>12.3}", errors.median_us, errors.worst_us);
        };
        line("UTC by round trips alone", clocks.alone.0);
        line("UTC by USB frames and round trips", clocks.frames.0);
        line("one board's time from the other's, by each UTC", clocks.by_utc);
        line("one board's time from the other's, by frames", clocks.common?);
        line("the same while both run, as in a capture", clocks.live);
        let bound = |report: ClockReport| report.uncertainty_ns.map_or(f64::NAN, |ns| ns as f64 / 1e3);
        println!(
            "  bounds that the clock reports at the end: {:.0} us by round trips alone, {:.0} us by frames",
            bound(clocks.alone.1),
            bound(clocks.frames.1)
        );
    }
    Ok(())
}
