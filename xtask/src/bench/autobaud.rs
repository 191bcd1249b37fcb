//! How often and how fast the search for a bit rate succeeds on the emulated board: rates by densities of traffic, with and without
//! damage, by the device's time.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cantap::autobaud::{Limits, Outcome, search};
use cantap::device::Link;
use cantap::{Channel, Device};
use cantap_sim::address::Address;

use super::extent::Extent;
use crate::board::Board;

/// The bus's rate and the rate that must be reported; `None` if the controller's clock cannot reach it.
const RATES: [(u32, Option<u32>); 10] = [
    (1_000_000, Some(1_000_000)),
    (500_000, Some(500_000)),
    (250_000, Some(250_000)),
    (125_000, Some(125_000)),
    (83_333, Some(83_333)),
    (47_619, Some(47_619)),
    (33_333, Some(33_333)),
    (10_000, Some(10_000)),
    (5_000, Some(5_000)),
    (615_384, None),
];
const DENSITIES: [(&str, &str); 4] = [
    ("full", "load=100"),
    ("50/s", "burst=1/20ms"),
    ("3 each s", "burst=3/1s"),
    ("1 each 0.5 s", "burst=1/500ms"),
];
/// Frames destroyed, in per cent.
const DAMAGE: [u32; 2] = [0, 30];
/// Runs per cell, alternating between both channels: normally, and for a quick measurement.
const RUNS: [u64; 2] = [6, 2];
/// How long without anything new until a search is given up.
const SILENCE: Duration = Duration::from_secs(3);

/// Some runs under one condition.
#[derive(Default)]
struct Cell {
    runs: u32,
    right: u32,
    longest_s: f64,
    /// The largest deviation of a measurement from the bus's rate, as a fraction of it.
    farthest: f64,
}

/// Measures and prints.
pub fn run(extent: &Extent) -> Result<()> {
    let elf = Board::ALL[0].elf();
    ensure!(elf.exists(), "{}: run `cargo xtask firmware`", elf.display());
    println!(
        "autobaud: right of all runs, and the longest, in s of the device's time; frames destroyed: none / 30 %"
    );
    println!("{:<10} {}", "bit/s", DENSITIES.map(|(name, _)| format!("{name:>30}")).concat());
    let (mut all, mut damaged) = (Cell::default(), Cell::default());
    for (bitrate, expected) in RATES {
        if !extent.wants(&bitrate.to_string()) {
            continue;
        }
        let mut cells = Vec::new();
        for (_, density) in DENSITIES {
            let mut told = Vec::new();
            for errors in DAMAGE {
                let mut cell = Cell::default();
                for seed in 0..RUNS[usize::from(extent.quick)] {
                    let options =
                        format!("{},bitrate={bitrate},{density},errors={errors},seed={seed}", elf.display());
                    one(&options, Channel::ALL[seed as usize % 2], bitrate, expected, &mut cell)
                        .with_context(|| options.clone())?;
                }
                told.push(format!("{}/{} {:.2}", cell.right, cell.runs, cell.longest_s));
                let sum = if errors == 0 { &mut all } else { &mut damaged };
                sum.runs += cell.runs;
                sum.right += cell.right;
                sum.farthest = sum.farthest.max(cell.farthest);
            }
            cells.push(format!("{:>30}", told.join(" / ")));
        }
        println!("{bitrate:<10} {}", cells.concat());
    }
    for (name, sum) in [("undisturbed", all), ("30 % destroyed", damaged)] {
        let (right, runs, off) = (sum.right, sum.runs, 100.0 * sum.farthest);
        println!("{name}: {right} of {runs} right; the bit rate was measured to {off:.3} % at worst");
    }
    Ok(())
}

/// One search.
fn one(options: &str, channel: Channel, bitrate: u32, expected: Option<u32>, cell: &mut Cell) -> Result<()> {
    let port = options.parse::<Address>()?.open()?;
    let device = Device::over(Link::new(port.reader, port.writer).keeping(port.device), "emulated")?;
    let began = device.time()?;
    let outcome = search(&device, channel, &Limits { silence: SILENCE }, &mut |_| true)?;
    let seconds = (device.time()? - began) as f64 / f64::from(device.hello().tick_hz);
    let (right, measured_bps) = match outcome {
        Outcome::Found { bitrate_bps, measured_bps, .. } => (Some(bitrate_bps) == expected, measured_bps),
        Outcome::Unreachable { measured_bps, .. } => (expected.is_none(), measured_bps),
        _ => (false, f64::from(bitrate)),
    };
    cell.runs += 1;
    cell.right += u32::from(right);
    cell.longest_s = cell.longest_s.max(seconds);
    cell.farthest = cell.farthest.max((measured_bps / f64::from(bitrate) - 1.0).abs());
    if !right {
        println!("  wrong: {options}, channel {}: {outcome:?}", channel.number());
    }
    Ok(())
}
