//! Has the device repeat a frame with a counter and a checksum, which the device itself
//! keeps up to date: `cargo run -p cantap --example periodic [PORT]`. It takes part in the
//! bus.

mod device;

use std::error::Error;
use std::time::Duration;

use cantap::periodic::{check_modifiers, period_ticks};
use cantap::wire::message::{Checksum, Modifier, Periodic};
use cantap::{Channel, Device, Frame, TraceFrame};

/// Sends `count` frames, 10 ms apart; returns them as they were on the bus.
pub fn repeat(device: &Device, count: u32) -> Result<Vec<TraceFrame>, Box<dyn Error>> {
    let frame: Frame = "123#00A5000000000000".parse()?;
    let modifiers = [
        Modifier::Counter { byte: 0, low_bit: 0, bits: 4 },
        Modifier::Checksum { byte: 7, algorithm: Checksum::Crc8J1850 },
    ];
    check_modifiers(&frame, &modifiers)?;
    let period_ticks = period_ticks(Duration::from_millis(10), device.hello().tick_hz)?;

    device.join(Channel::Can1, 500_000)?;
    let ends = device.transmissions();
    let entry = Periodic { frame, period_ticks, count, modifiers: modifiers.into_iter().collect() };
    device.set_periodic(Channel::Can1, 0, Some(entry))?;
    let mut sent = Vec::new();
    while sent.len() < count as usize {
        let end = ends.recv_timeout(Duration::from_secs(2))?;
        let frame = end.result.map_err(|reason| format!("not sent: {reason:?}"))?;
        println!("{} ns: {frame}", end.time_ns);
        sent.push(frame);
    }
    Ok(sent)
}

fn main() -> Result<(), Box<dyn Error>> {
    repeat(&device::chosen("load=0,bitrate=500k")?, 20)?;
    Ok(())
}
