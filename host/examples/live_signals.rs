//! Shows the signals of a bus as they arrive: `cargo run -p cantap --example live_signals [PORT]`.

mod device;

use std::error::Error;

use cantap::{Channel, Device};
use cantap_signals::{Decoder, Source, dbc};

const DATABASE: &str = include_str!("data/engine.dbc");

/// Shows `messages` messages; returns the signals of the last one as text.
pub fn show(device: &Device, messages: usize) -> Result<String, Box<dyn Error>> {
    let database = dbc::parse("engine.dbc", DATABASE.as_bytes())?;
    let decoder = Decoder::new(vec![Source { channel: None, database }]);
    device.listen(Channel::Can1, 500_000)?;
    let mut shown = 0;
    for record in device.records() {
        let readings = decoder.readings(&record?);
        let Some(first) = readings.first() else { continue };
        let line = readings.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        println!("{}: {line}", first.message.name);
        shown += 1;
        if shown == messages {
            return Ok(line);
        }
    }
    Err("the device stopped".into())
}

fn main() -> Result<(), Box<dyn Error>> {
    let log = concat!("bitrate=500k,log=", env!("CARGO_MANIFEST_DIR"), "/examples/data/engine.log");
    show(&device::chosen(log)?, 40)?;
    Ok(())
}
