//! Captures both channels for a while into a BLF file: `cargo run -p cantap --example capture_to_file [PORT]`.

mod device;

use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

use cantap::device::ChannelCounters;
use cantap::{Channel, Device};
use cantap_formats::{WriteOptions, create_writer};

/// Returns the frames that were received and those that were lost.
pub fn capture(device: &Device, file: &Path, time: Duration) -> Result<(u64, u64), Box<dyn Error>> {
    let mut writer = create_writer(file, &WriteOptions::default())?;
    let mut records = device.records();
    for channel in Channel::ALL {
        device.listen(channel, 500_000)?;
    }
    let end = Instant::now() + time;
    let mut stopped = false;
    // After `stop` comes whatever was captured until then, and finally `None`.
    while let Some(batch) = records.next_batch(Duration::from_millis(50))? {
        for record in &batch {
            writer.write(record)?;
        }
        if !stopped && Instant::now() >= end {
            device.stop()?;
            stopped = true;
        }
    }
    for (what, count) in writer.finish()?.iter() {
        println!("the file has no place for: {what}, {count} times");
    }
    let counters = device.counters().channels;
    Ok((
        counters.iter().map(|channel| channel.received).sum(),
        counters.iter().map(ChannelCounters::lost).sum(),
    ))
}

fn main() -> Result<(), Box<dyn Error>> {
    let (frames, lost) =
        capture(&device::chosen("load=30")?, Path::new("capture.blf"), Duration::from_secs(2))?;
    println!("{frames} frames are in capture.blf, {lost} were lost");
    Ok(())
}
