//! What the firmware does to a bus on request, measured on the emulated bus: replies, periods, times, load.

use anyhow::{Context, Result};
use cantap_sim::Image;
use cantap_sim::drive::{self, Range};
use cantap_sim::machine::Setup;
use cantap_sim::rig::{MS, Rig};
use cantap_sim::traffic::{Kind, Traffic};
use cantap_sim::usb_host::Timing;
use cantap_wire::Channel;

use crate::board::Board;

const BITRATE_BPS: u32 = 1_000_000;

/// Measures with the other channel idle, then full.
pub fn run() -> Result<()> {
    println!("bus: channel 1 at 1 Mbit/s on the emulated board, 100 to 240 frames each");
    println!("{:<38} {:>18} {:>18}", "", "channel 2 idle", "channel 2 full");
    let both = |measure: &dyn Fn(&mut Rig) -> Result<String>| -> Result<[String; 2]> {
        Ok([measure(&mut rig(false)?)?, measure(&mut rig(true)?)?])
    };
    let line = |name: &str, [idle, full]: [String; 2]| println!("{name:<38} {idle:>18} {full:>18}");
    line("reply after the frame's end, us", both(&|rig| Ok(range(drive::reply_latency(rig)?)))?);
    line("period of 1 ms off by, us", both(&|rig| Ok(range(drive::periodic_jitter(rig, 1000)?)))?);
    for load in [30.0, 60.0, 90.0] {
        let spacing = |rig: &mut Rig| {
            let late = drive::timed_start(rig, load)?;
            Ok(late.map_or("incomplete".to_owned(), |late| format!("{:.2}", late.width_us())))
        };
        line(&format!("spacing of a replay at {load} % off by, us"), both(&spacing)?);
    }
    line(
        "load by queued 8-byte frames, %",
        both(&|rig| Ok(format!("{:.2}", drive::back_to_back_load(rig)?)))?,
    );
    Ok(())
}

fn range(range: Option<Range>) -> String {
    range.map_or("incomplete".to_owned(), |range| format!("{:.2} to {:.2}", range.min_us, range.max_us))
}

/// A board on its bus, with the other channel idle or full for longer than any measurement lasts.
fn rig(full: bool) -> Result<Rig> {
    let elf = Board::ALL[0].elf();
    let image =
        Image::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let mut rig = Rig::new(image, Setup::default(), Timing::default());
    rig.connect()?;
    drive::join(&mut rig)?;
    if full {
        rig.listen(Channel::Can2, BITRATE_BPS)?;
        let from = rig.now();
        rig.add_traffic(
            Channel::Can2,
            BITRATE_BPS,
            Traffic::new(Kind::Std0, 1, 100.0, from, from + 500 * MS),
        );
    }
    Ok(rig)
}
