//! Summarises a trace: `cargo run -p cantap-work --example statistics_of_a_file FILE [BITRATE]`.

use std::error::Error;
use std::path::Path;

use cantap_analysis::stats::{Options, Statistics, Summary};
use cantap_formats::{ReadOptions, open_reader};

/// Summarises a file recorded on buses of this bit rate, and says what of it could not be read.
pub fn summary(file: &Path, bitrate_bps: u32) -> Result<(Summary, String), Box<dyn Error>> {
    let mut statistics = Statistics::new(Options { bitrate_bps: Some(bitrate_bps), ..Options::default() })?;
    let mut records = open_reader(file, &ReadOptions::default())?.readable();
    for record in records.by_ref() {
        statistics.push(&record);
    }
    statistics.finish();
    Ok((statistics.summary(), records.unread().to_string()))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let file = arguments.next().ok_or("name a trace")?;
    let bitrate_bps = arguments.next().map_or(Ok(500_000), |bitrate| bitrate.parse())?;
    let (summary, unread) = summary(file.as_ref(), bitrate_bps)?;
    println!("{} frames in {:.3} s, {} lost", summary.frames, summary.duration_s, summary.lost);
    for channel in &summary.channels {
        println!("channel {}: {:.2} % load", channel.channel, channel.bus_load_pct.unwrap_or_default());
        for id in &channel.ids {
            println!("  {}: {} frames", id.id, id.count);
        }
    }
    eprint!("{unread}");
    Ok(())
}
