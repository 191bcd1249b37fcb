//! What the real firmware costs and bears, measured on the emulated board.
//!
//! Cycles are a lower bound: the emulator knows no flash wait states and no delays of the peripheral buses.

use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cantap_sim::machine::Setup;
use cantap_sim::rig::{MS, Rig};
use cantap_sim::soc::CAN_IRQS;
use cantap_sim::traffic::{Kind, Traffic};
use cantap_sim::usb_host::Timing;
use cantap_sim::{CYCLES_PER_SECOND, CYCLES_PER_US, Image};
use cantap_wire::Channel;

use crate::board::Board;

const BITRATE_BPS: u32 = 1_000_000;
/// Exceptions are numbered from the system's 16 on.
const FIRST_IRQ: u16 = 16;
/// How long each load lasts.
const LOAD_MS: u64 = 500;
/// How long the host stops reading: longer than any queue lasts.
const STALL_MS: u64 = 1_600;

/// Measures loads, then a host that stalls.
pub fn run() -> Result<()> {
    println!("emulated: {LOAD_MS} ms at 100 % of 1 Mbit/s, per channel in use");
    println!(
        "{:<10} {:>8} {:>7} {:>10} {:>9} {:>20} {:>8} {:>10}",
        "frames", "frames/s", "CPU %", "cycles per", "masked", "stamp late, ns", "USB B", "host s per"
    );
    println!(
        "{:<10} {:>8} {:>7} {:>10} {:>9} {:>20} {:>8} {:>10}",
        "", "", "", "frame", "ns, most", "min / median / max", "/frame", "emulated s"
    );
    let mut shares = Vec::new();
    for (name, kind, channels) in [
        ("std0 ×1", Kind::Std0, &Channel::ALL[..1]),
        ("std0 ×2", Kind::Std0, &Channel::ALL[..]),
        ("std8 ×2", Kind::Std8, &Channel::ALL[..]),
        ("ext8 ×2", Kind::Ext8, &Channel::ALL[..]),
        ("mix ×2", Kind::Mix, &Channel::ALL[..]),
    ] {
        shares.push((name, load(name, kind, channels)?));
    }
    println!("processor by interrupt, %:");
    for (name, tasks) in shares.iter().take(2) {
        for (task, entries, share) in tasks {
            println!("  {name:<10} {task:<24} {share:>6.2}  ({entries} times)");
        }
    }
    stall()
}

/// A board with its firmware that captures `channels`, and traffic that begins in a millisecond and lasts for `ms`.
fn loaded(kind: Kind, channels: &[Channel], ms: u64) -> Result<Rig> {
    let elf = Board::ALL[0].elf();
    let image =
        Image::open(&elf).with_context(|| format!("{}; run `cargo xtask firmware`", elf.display()))?;
    let mut rig = Rig::new(image, Setup::default(), Timing::default());
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

/// Measures one load and prints it. Returns what ran, with its share of the time in per cent.
fn load(name: &str, kind: Kind, channels: &[Channel]) -> Result<Vec<(String, u64, f64)>> {
    let mut rig = loaded(kind, channels, LOAD_MS)?;
    let sent_before = usb_bytes(&mut rig);
    let begin = Instant::now();
    rig.run_for((LOAD_MS + 1) * MS)?;
    let host_s = begin.elapsed().as_secs_f64();
    let probe = rig.machine.probe();
    let cpu = probe.load_percent(rig.now());
    let masked_ns = probe.longest_masked().cycles * 1000 / CYCLES_PER_US;
    let tasks = rig.machine.tasks(rig.now() - probe.since());
    let capture: u64 = channels
        .iter()
        .flat_map(|channel| &CAN_IRQS[channel.index()][1..3])
        .map(|irq| probe.cycles(FIRST_IRQ + irq))
        .sum();
    rig.drain(CYCLES_PER_SECOND)?;
    let bytes = usb_bytes(&mut rig) - sent_before;
    for &channel in channels {
        rig.close(channel)?;
    }
    ensure!(rig.ledger.holds(), "{name}: the counting law does not hold: {:?}", rig.ledger.faults());
    let frames: u64 = channels.iter().map(|&channel| rig.ledger.delivered_count(channel)).sum();
    let stamps = rig.ledger.stamps();
    println!(
        "{name:<10} {:>8} {cpu:>7.1} {:>10} {masked_ns:>9} {:>20} {:>8.2} {:>10.1}",
        frames * 1000 / LOAD_MS,
        capture / frames.max(1),
        format!("{} / {} / {}", stamps.min, stamps.median, stamps.max),
        bytes as f64 / frames as f64,
        host_s * 1000.0 / LOAD_MS as f64,
    );
    Ok(tasks)
}

/// The host stops reading in the middle of the worst traffic on one channel, and reads again.
fn stall() -> Result<()> {
    let channel = Channel::Can1;
    let mut rig = loaded(Kind::Std0, &[channel], STALL_MS + 200)?;
    rig.run_for(100 * MS)?;
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
    ensure!(rig.ledger.holds(), "stall: the counting law does not hold: {:?}", rig.ledger.faults());

    let sent = rig.ledger.on_bus_count(channel) - until_stall;
    let lost = rig.ledger.losses(channel).total();
    // Frames are 48 µs apart; but for the few after there is room again, those lost are the last ones.
    let lost_ms = lost as f64 * 0.048;
    println!("host stall at 100 % of one channel (std0), {STALL_MS} ms:");
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
