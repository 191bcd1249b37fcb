//! Opens a device and prints what it hears: `cargo run -p cantap-work --example print_frames [DEVICE]`.

use std::error::Error;
use std::io::Write;

use cantap::Channel;

/// Prints this many records of channel 1; returns the number of frames lost.
pub fn print_frames(address: &str, records: usize, out: &mut impl Write) -> Result<u64, Box<dyn Error>> {
    let device = cantap_address::open(address)?;
    device.listen(Channel::Can1, 500_000)?;
    for record in device.records().take(records) {
        let record = record?;
        if let Some(frame) = record.frame() {
            writeln!(out, "{:.6} {} {frame}", record.time_ns as f64 / 1e9, record.channel)?;
        }
    }
    Ok(device.counters().channels[0].lost())
}

fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "virtual".to_owned());
    let lost = print_frames(&address, 1000, &mut std::io::stdout())?;
    println!("{lost} frames lost");
    Ok(())
}
