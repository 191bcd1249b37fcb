//! Replays a trace file with its original timing, which the device keeps: `cargo run -p cantap --example
//! replay [PORT]`. It takes part in the bus.

mod device;

use std::error::Error;
use std::time::Duration;

use cantap::replay::{Accuracy, Pace, Replay};
use cantap::{Channel, Device, TraceFrame};
use cantap_formats::{ReadOptions, open_reader};

/// Gives up when nothing could be sent for this long.
const PATIENCE: Duration = Duration::from_secs(5);

/// Replays a file on channel 1; returns how accurately its timing was kept.
pub fn replay(device: &Device, file: &str) -> Result<Accuracy, Box<dyn Error>> {
    device.join(Channel::Can1, 500_000)?;
    let mut replay = Replay::new(device, Pace::default(), [500_000; 2])?;
    for record in open_reader(file, &ReadOptions::default())? {
        let record = record?;
        // The device supports classical CAN only: CAN FD frames are skipped.
        if let Some(frame) = record.frame().and_then(TraceFrame::classic) {
            replay.push(record.time_ns, Channel::Can1, *frame, |_| true)?;
        }
    }
    if !replay.finish(|since_the_last| since_the_last < PATIENCE)? {
        return Err("nothing leaves any more; is there another node on the bus?".into());
    }
    // How each frame ended, from which the accuracy is computed.
    let ended = replay.take_ended();
    println!("{} frames replayed", ended.len());
    Ok(replay.accuracy())
}

fn main() -> Result<(), Box<dyn Error>> {
    let device = device::chosen("load=0,bitrate=500k")?;
    let accuracy = replay(&device, concat!(env!("CARGO_MANIFEST_DIR"), "/examples/data/engine.log"))?;
    println!("at most {:.1} µs late, {:.1} µs early", accuracy.late_us, accuracy.early_us);
    Ok(())
}
