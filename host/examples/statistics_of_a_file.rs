//! Summarises a trace file: `cargo run -p cantap --example statistics_of_a_file [FILE] [BITRATE]`.

use std::error::Error;

use cantap_analysis::stats::{Options, Statistics, Summary};
use cantap_formats::{ReadOptions, open_reader};

/// Summarises a file recorded on buses of this bit rate.
pub fn summary(file: &str, bitrate_bps: u32) -> Result<Summary, Box<dyn Error>> {
    let mut statistics = Statistics::new(Options { bitrate_bps: Some(bitrate_bps), ..Options::default() })?;
    for record in open_reader(file, &ReadOptions::default())? {
        match record {
            Ok(record) => statistics.push(&record),
            // Reading continues after a damaged place.
            Err(issue) => eprintln!("{issue}"),
        }
    }
    statistics.finish();
    Ok(statistics.summary())
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let file = arguments
        .next()
        .unwrap_or_else(|| concat!(env!("CARGO_MANIFEST_DIR"), "/examples/data/engine.log").to_owned());
    let bitrate_bps = arguments.next().map_or(Ok(500_000), |bitrate| bitrate.parse())?;
    let summary = summary(&file, bitrate_bps)?;
    println!("{} frames in {:.3} s, {} lost", summary.frames, summary.duration_s, summary.lost);
    for channel in &summary.channels {
        println!("channel {}: {:.2} % load", channel.channel, channel.bus_load_pct.unwrap_or_default());
        for id in &channel.ids {
            println!("  {}: {} frames", id.id, id.count);
        }
    }
    Ok(())
}
