//! What the firmware does on a bus on request, measured on the emulated bus with both bounds of time
//! (`docs/emulator.md`): replies, periods, times, load. Each cell shows the best, then the worst.

use anyhow::{Context, Result};
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CLOCK};
use cantap_sim::drive::{self, Range};
use cantap_sim::firmware;
use cantap_sim::rig::{MS, Rig};
use cantap_sim::stream::{self, Filled, Replayed};
use cantap_wire::Channel;
use cantap_wire::Channel::{Can1, Can2};

use super::extent::Extent;
use super::tasks;
use crate::board::Board;

const BITRATE_BPS: u32 = 1_000_000;
/// Bus time of each replay, and of each bus that is filled.
const BUS_MS: u64 = 300;

/// What channel 2 does meanwhile.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Other {
    /// It is closed.
    Idle,
    /// It receives as much as a bus can carry.
    Full,
    /// It takes part in a separate bus and does the same as channel 1.
    Joined,
}

impl Other {
    /// The channels that take part.
    fn channels(self) -> &'static [Channel] {
        if self == Self::Joined { &Channel::ALL } else { &[Can1] }
    }
}

/// Measures with the other channel idle, full, and doing the same.
pub fn run(extent: &Extent) -> Result<()> {
    println!("bus: channel 1 at 1 Mbit/s on the emulated board; each at best / at worst");
    println!("{:<40} {:>28} {:>28} {:>22}", "", "channel 2 idle", "channel 2 full", "both alike");
    let alone = &[Other::Idle, Other::Full][..];
    let all = &[Other::Idle, Other::Full, Other::Joined][..];
    let ms = extent.shortened(BUS_MS);
    let seconds = ms as f64 / 1000.0;
    rows(extent, ["reply after the frame's end, us"], alone, |rig, _| {
        Ok([range(drive::reply_latency(rig)?)])
    })?;
    rows(extent, ["period of 1 ms off by, us"], alone, |rig, _| {
        Ok([range(drive::periodic_jitter(rig, 1000)?)])
    })?;
    // Within three tenths of a second each entry's frame is sent about sixty times.
    rows(extent, ["32 periods of 5.0 to 5.4 ms, late, us"], &[Other::Joined], |rig, _| {
        let tables = drive::periodic_tables(rig, 5_000, 1000 * ms)?;
        Ok([range(tables.filter(|tables| tables.wrong == 0).map(|tables| tables.late))])
    })?;
    for load in [10.0, 30.0, 60.0, 90.0, 98.0] {
        let spacing = format!("spacing of a replay at {load} % off by, us");
        let stamps = format!("stamps of a replay at {load} % late by, us");
        rows(extent, [&spacing, &stamps], all, |rig, other| {
            let replayed: Option<Vec<Replayed>> = stream::replay(rig, other.channels(), load, seconds)?;
            let replayed = replayed.as_deref();
            let text = |us: f64| format!("{us:.2}");
            Ok([
                greatest(replayed, |one| one.late.width_us(), text),
                greatest(replayed, |one| one.stamps.max_us, text),
            ])
        })?;
    }
    for (name, kind) in [("8 bytes", Kind::Std8), ("no data", Kind::Std0)] {
        let name = format!("load by streamed frames, {name}, %");
        rows(extent, [&name], all, |rig, other| {
            let filled: Option<Vec<Filled>> = stream::fill(rig, other.channels(), kind, seconds)?;
            Ok([greatest(filled.as_deref(), |one| -one.load_percent, |load| format!("{:.2}", -load))])
        })?;
    }
    if extent.wants("tasks") {
        tasks::print(
            "both channels streamed, no data",
            |bound| rig(Other::Joined, bound),
            |rig| {
                stream::fill(rig, &Channel::ALL, Kind::Std0, seconds)?.context("a frame is missing")?;
                Ok(())
            },
        )?;
        tasks::print_locks(rig(Other::Joined, Bound::Best)?.machine.image())?;
    }
    Ok(())
}

/// Prints the rows that one measurement fills, if any of them is wanted.
fn rows<const N: usize>(
    extent: &Extent,
    names: [&str; N],
    others: &[Other],
    measure: impl Fn(&mut Rig, Other) -> Result<[String; N]>,
) -> Result<()> {
    if !names.iter().any(|name| extent.wants(name)) {
        return Ok(());
    }
    let mut cells: [[String; 3]; N] = std::array::from_fn(|_| Default::default());
    for &other in others {
        let mut measured = Vec::new();
        for bound in Bound::ALL {
            measured.push(measure(&mut rig(other, bound)?, other)?);
        }
        for (row, cells) in cells.iter_mut().enumerate() {
            let both: Vec<&str> = measured.iter().map(|figures| figures[row].as_str()).collect();
            cells[other as usize] = both.join(" / ");
        }
    }
    for (name, [idle, full, both]) in names.iter().zip(&cells) {
        println!("{name:<40} {idle:>28} {full:>28} {both:>22}");
    }
    Ok(())
}

fn range(range: Option<Range>) -> String {
    range.map_or("incomplete".to_owned(), |range| format!("{:.2} to {:.2}", range.min_us, range.max_us))
}

/// The greatest value of a figure over the channels, as text.
fn greatest<T>(measured: Option<&[T]>, figure: impl Fn(&T) -> f64, text: impl Fn(f64) -> String) -> String {
    let figures = measured.map(|measured| measured.iter().map(figure));
    figures.and_then(|figures| figures.reduce(f64::max)).map_or("incomplete".to_owned(), text)
}

/// A board with channel 1 on its bus.
fn rig(other: Other, bound: Bound) -> Result<Rig> {
    let elf = Board::ALL[0].elf();
    let image =
        firmware::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let mut rig = Rig::new(image, Setup { bound, ..board::setup() }, Timing::new(CLOCK));
    rig.connect()?;
    stream::join(&mut rig, other.channels())?;
    if other == Other::Full {
        rig.listen(Can2, BITRATE_BPS)?;
        let from = rig.now();
        // Longer than any measurement lasts.
        rig.add_traffic(Can2, BITRATE_BPS, Traffic::new(Kind::Std0, 1, 100.0, from, from + 900 * MS));
    }
    Ok(rig)
}
