//! What the real firmware costs and can bear, measured on the emulated board with both bounds of
//! time (`docs/emulator.md`): each cell shows the best, then the worst.

use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cantap_emu::machine::Setup;
use cantap_emu::timing::Bound;
use cantap_emu::traffic::{Kind, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::{self, CAPTURE_IRQS, CLOCK};
use cantap_sim::firmware;
use cantap_sim::rig::{MS, Rig};
use cantap_sim::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_wire::Channel;

use super::extent::Extent;
use super::tasks;
use crate::board::Board;

const BITRATE_BPS: u32 = 1_000_000;
/// Interrupts are numbered after the 16 system exceptions.
const FIRST_IRQ: u16 = 16;
/// How long each load lasts.
const LOAD_MS: u64 = 500;
/// How long the host stops reading: longer than any queue lasts.
const STALL_MS: u64 = 1_600;
/// Frames before the stall.
const BEFORE_STALL_MS: u64 = 100;

/// Measures loads, then a host that stalls.
pub fn run(extent: &Extent) -> Result<()> {
    let ms = extent.shortened(LOAD_MS);
    println!("emulated: {ms} ms at 100 % of 1 Mbit/s, per channel in use; each at best / at worst");
    println!(
        "{:<10} {:>8} {:>13} {:>12} {:>13} {:>37} {:>6} {:>12}",
        "frames", "frames/s", "CPU, %", "cycles per", "masked, ns", "stamp late, ns", "USB B", "host s per"
    );
    println!(
        "{:<10} {:>8} {:>13} {:>12} {:>13} {:>37} {:>6} {:>12}",
        "", "", "", "frame", "at most", "min, median, max", "/frame", "emulated s"
    );
    for (name, kind, channels) in [
        ("std0 ×1", Kind::Std0, &Channel::ALL[..1]),
        ("std0 ×2", Kind::Std0, &Channel::ALL[..]),
        ("std8 ×2", Kind::Std8, &Channel::ALL[..]),
        ("ext8 ×2", Kind::Ext8, &Channel::ALL[..]),
        ("mix ×2", Kind::Mix, &Channel::ALL[..]),
    ] {
        if extent.wants(name) {
            load(name, kind, channels, ms)?.print(name);
        }
    }
    for (name, channels) in [("tasks ×1", &Channel::ALL[..1]), ("tasks ×2", &Channel::ALL[..])] {
        if extent.wants(name) {
            let prepare = |bound| {
                let mut rig = loaded(Kind::Std0, channels, ms, bound)?;
                rig.run_for(MS)?;
                Ok(rig)
            };
            tasks::print(&format!("std0 ×{}", channels.len()), prepare, |rig| {
                Ok(rig.run_for(ms * MS - MS)?)
            })?;
        }
    }
    if extent.wants("stall") {
        for bound in Bound::ALL {
            stall(bound)?;
        }
    }
    Ok(())
}

/// A board with its firmware that captures `channels`, and traffic that begins after a millisecond and lasts for
/// `ms`.
fn loaded(kind: Kind, channels: &[Channel], ms: u64, bound: Bound) -> Result<Rig> {
    let elf = Board::ALL[0].elf();
    let image =
        firmware::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let mut rig = Rig::new(image, Setup { bound, ..board::setup() }, Timing::new(CLOCK));
    rig.connect()?;
    for &channel in channels {
        rig.listen(channel, BITRATE_BPS)?;
    }
    let from = rig.now() + MS;
    for &channel in channels {
        let seed = u64::from(channel.number());
        rig.add_traffic(channel, BITRATE_BPS, Traffic::new(kind, seed, 100.0, from, from + ms * MS));
    }
    rig.machine.reset_probe();
    Ok(rig)
}

/// One load's figures, at best and at worst.
struct Load {
    frames_per_s: u64,
    cpu: [f64; 2],
    cycles: [u64; 2],
    masked_ns: [u64; 2],
    late_ns: [[i64; 3]; 2],
    bytes_per_frame: f64,
    host_s: [f64; 2],
}

impl Load {
    fn print(&self, name: &str) {
        let [best, worst] = self.late_ns.map(|[min, median, max]| format!("{min}, {median}, {max}"));
        let both = |[best, worst]: [f64; 2]| format!("{best:.1} / {worst:.1}");
        println!(
            "{name:<10} {:>8} {:>13} {:>12} {:>13} {:>37} {:>6.2} {:>12}",
            self.frames_per_s,
            both(self.cpu),
            format!("{} / {}", self.cycles[0], self.cycles[1]),
            format!("{} / {}", self.masked_ns[0], self.masked_ns[1]),
            format!("{best} / {worst}"),
            self.bytes_per_frame,
            both(self.host_s),
        );
    }
}

/// Measures one load under both bounds.
fn load(name: &str, kind: Kind, channels: &[Channel], ms: u64) -> Result<Load> {
    let mut measured = Load {
        frames_per_s: 0,
        cpu: [0.0; 2],
        cycles: [0; 2],
        masked_ns: [0; 2],
        late_ns: [[0; 3]; 2],
        bytes_per_frame: 0.0,
        host_s: [0.0; 2],
    };
    for (n, bound) in Bound::ALL.into_iter().enumerate() {
        let mut rig = loaded(kind, channels, ms, bound)?;
        let sent_before = usb_bytes(&mut rig);
        let begin = Instant::now();
        rig.run_for((ms + 1) * MS)?;
        measured.host_s[n] = begin.elapsed().as_secs_f64() * 1000.0 / ms as f64;
        let probe = rig.machine.probe();
        measured.cpu[n] = probe.load_percent(rig.now());
        measured.masked_ns[n] = probe.longest_masked().cycles * 1000 / CYCLES_PER_US;
        let capture: u64 = channels
            .iter()
            .flat_map(|channel| &CAPTURE_IRQS[channel.index()])
            .map(|irq| probe.cycles(FIRST_IRQ + irq))
            .sum();
        rig.drain(CYCLES_PER_SECOND)?;
        let bytes = usb_bytes(&mut rig) - sent_before;
        for &channel in channels {
            rig.close(channel)?;
        }
        ensure!(rig.ledger.holds(), "{name}, {bound}: the counting law: {:?}", rig.ledger.faults());
        let frames: u64 = channels.iter().map(|&channel| rig.ledger.delivered_count(channel)).sum();
        let stamps = rig.ledger.stamps();
        measured.frames_per_s = frames * 1000 / ms;
        measured.cycles[n] = capture / frames.max(1);
        measured.late_ns[n] = [stamps.min, stamps.median, stamps.max];
        measured.bytes_per_frame = bytes as f64 / frames.max(1) as f64;
    }
    Ok(measured)
}

/// The host stops reading in the middle of the worst traffic on one channel, then resumes.
fn stall(bound: Bound) -> Result<()> {
    let channel = Channel::Can1;
    let mut rig = loaded(Kind::Std0, &[channel], STALL_MS + 2 * BEFORE_STALL_MS, bound)?;
    rig.run_for(BEFORE_STALL_MS * MS)?;
    let until_stall = rig.ledger.on_bus_count(channel);
    rig.with_host(|host, _| host.read(false));
    rig.run_for(STALL_MS * MS)?;
    rig.with_host(|host, _| host.read(true));
    let (sent_before, from) = (usb_bytes(&mut rig), rig.now());
    rig.run_for(50 * MS)?;
    let rate =
        (usb_bytes(&mut rig) - sent_before) as f64 * CYCLES_PER_SECOND as f64 / (rig.now() - from) as f64;
    rig.drain(2 * CYCLES_PER_SECOND)?;
    let status = rig.status()?;
    rig.close(channel)?;
    ensure!(rig.ledger.holds(), "stall, {bound}: the counting law: {:?}", rig.ledger.faults());

    let sent = rig.ledger.on_bus_count(channel) - until_stall;
    let lost = rig.ledger.losses(channel).total();
    // Frames are 48 µs apart, and apart from a few after there is room again, the lost ones are the last.
    let lost_ms = lost as f64 * 0.048;
    println!("host stall at 100 % of one channel (std0), {STALL_MS} ms, at {bound}:");
    println!(
        "  queue filled to {} bytes; {lost} of {sent} frames lost, each counted",
        status.queue_high_water_bytes
    );
    println!("  survived without loss: {:.0} ms", STALL_MS as f64 - lost_ms);
    println!("  USB while the queue drained: {:.2} MB/s", rate / 1e6);
    Ok(())
}

/// Bytes that the device has sent over USB so far.
fn usb_bytes(rig: &mut Rig) -> u64 {
    rig.with_host(|host, _| host.counters().in_bytes)
}
