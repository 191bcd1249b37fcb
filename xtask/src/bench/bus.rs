//! What the firmware does to a bus on request, measured on the emulated bus: replies, periods, times, load.

use anyhow::{Context, Result};
use cantap_sim::Image;
use cantap_sim::drive::{self, Range};
use cantap_sim::machine::Setup;
use cantap_sim::rig::{MS, Rig};
use cantap_sim::stream::{self, Filled, Replayed};
use cantap_sim::traffic::{Kind, Traffic};
use cantap_sim::usb_host::Timing;
use cantap_wire::Channel;
use cantap_wire::Channel::{Can1, Can2};

use crate::board::Board;

const BITRATE_BPS: u32 = 1_000_000;
/// Bus time of each replay, and of each bus that is filled.
const SECONDS: f64 = 0.3;

/// Measures with the other channel idle, full, and doing the same.
pub fn run() -> Result<()> {
    println!("bus: channel 1 at 1 Mbit/s on the emulated board");
    println!("{:<42} {:>18} {:>18} {:>18}", "", "channel 2 idle", "channel 2 full", "both alike");
    let line = |name: &str, cells: [String; 3]| {
        let [idle, full, both] = cells;
        println!("{name:<42} {idle:>18} {full:>18} {both:>18}");
    };
    let one = |measure: &dyn Fn(&mut Rig) -> Result<String>| -> Result<[String; 3]> {
        Ok([measure(&mut rig(Other::Idle)?)?, measure(&mut rig(Other::Full)?)?, String::new()])
    };
    line("reply after the frame's end, us", one(&|rig| Ok(range(drive::reply_latency(rig)?)))?);
    line("period of 1 ms off by, us", one(&|rig| Ok(range(drive::periodic_jitter(rig, 1000)?)))?);
    // Three tenths of a second: each entry's frame about sixty times.
    let tables = drive::periodic_tables(&mut rig(Other::Joined)?, 5_000, 300_000)?;
    let tables = tables.filter(|tables| tables.wrong == 0).map(|tables| tables.late);
    line("32 periods of 5.0 to 5.4 ms, late, us", [String::new(), String::new(), range(tables)]);
    for load in [10.0, 30.0, 60.0, 90.0, 98.0] {
        let measure = |other| -> Result<Option<Vec<Replayed>>> {
            let channels = if other == Other::Joined { &Channel::ALL[..] } else { &[Can1] };
            Ok(stream::replay(&mut rig(other)?, channels, load, SECONDS)?)
        };
        let replays = [measure(Other::Idle)?, measure(Other::Full)?, measure(Other::Joined)?];
        let spacing = |replayed: &Option<Vec<Replayed>>| {
            worst(replayed.as_deref(), |one| one.late.width_us(), |us| format!("{us:.2}"))
        };
        let stamps = |replayed: &Option<Vec<Replayed>>| {
            worst(replayed.as_deref(), |one| one.stamps.max_us, |us| format!("{us:.2}"))
        };
        line(&format!("spacing of a replay at {load} % off by, us"), replays.each_ref().map(spacing));
        line("  its confirmations' stamps late by, us", replays.each_ref().map(stamps));
    }
    for (name, kind) in [("8 bytes", Kind::Std8), ("no data", Kind::Std0)] {
        let measure = |other| -> Result<String> {
            let channels = if other == Other::Joined { &Channel::ALL[..] } else { &[Can1] };
            let filled: Option<Vec<Filled>> = stream::fill(&mut rig(other)?, channels, kind, SECONDS)?;
            Ok(worst(filled.as_deref(), |one| -one.load_percent, |load| format!("{:.2}", -load)))
        };
        let cells = [measure(Other::Idle)?, measure(Other::Full)?, measure(Other::Joined)?];
        line(&format!("load by streamed frames, {name}, %"), cells);
    }
    Ok(())
}

fn range(range: Option<Range>) -> String {
    range.map_or("incomplete".to_owned(), |range| format!("{:.2} to {:.2}", range.min_us, range.max_us))
}

/// The greatest of a figure over the channels, as text.
fn worst<T>(measured: Option<&[T]>, figure: impl Fn(&T) -> f64, text: impl Fn(f64) -> String) -> String {
    let figures = measured.map(|measured| measured.iter().map(figure));
    figures.and_then(|figures| figures.reduce(f64::max)).map_or("incomplete".to_owned(), text)
}

/// What channel 2 does meanwhile.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Other {
    /// It is closed.
    Idle,
    /// It receives all that a bus can carry.
    Full,
    /// It takes part in a bus of its own, as channel 1 does.
    Joined,
}

/// A board with channel 1 on its bus.
fn rig(other: Other) -> Result<Rig> {
    let elf = Board::ALL[0].elf();
    let image =
        Image::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let mut rig = Rig::new(image, Setup::default(), Timing::default());
    rig.connect()?;
    stream::join(&mut rig, if other == Other::Joined { &Channel::ALL } else { &[Can1] })?;
    if other == Other::Full {
        rig.listen(Can2, BITRATE_BPS)?;
        let from = rig.now();
        // Longer than any measurement lasts.
        rig.add_traffic(Can2, BITRATE_BPS, Traffic::new(Kind::Std0, 1, 100.0, from, from + 900 * MS));
    }
    Ok(rig)
}
