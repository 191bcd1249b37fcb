//! `cantap bits`: a frame's exact length on the bus.

use std::io::Write;
use std::process::ExitCode;

use cantap::{Frame, FrameBits};

use crate::args;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  cantap bits 000#55\n  cantap bits 1F334455#1122334455667788 -b 500k\n  \
                        cantap bits 123#R4 --json"
)]
pub struct Args {
    /// The frame, as 123#DEADBEEF, 1F334455#, or 123#R4.
    frame: Frame,
    /// Bit rate for the duration, in bit/s: 500000, 500k, 1M.
    #[arg(short, long, default_value = "1M", value_parser = args::bitrate)]
    bitrate: u32,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let bits = FrameBits::of(&args.frame);
    let duration_us = bits.duration_ns(args.bitrate) as f64 / 1e3;
    let mut out = std::io::stdout().lock();
    if args.json {
        writeln!(
            out,
            "{}",
            serde_json::json!({
                "frame": args.frame.to_string(),
                "bits": bits.total(),
                "frame_bits": bits.unstuffed,
                "stuff_bits": bits.stuff,
                "crc": bits.crc,
                "bitrate_bps": args.bitrate,
                "duration_us": duration_us,
            })
        )?;
    } else {
        writeln!(out, "frame       {}", args.frame)?;
        writeln!(out, "length      {} bits, intermission included", bits.total())?;
        writeln!(out, "frame bits  {}", bits.unstuffed)?;
        writeln!(out, "stuff bits  {}", bits.stuff)?;
        writeln!(out, "CRC         0x{:03X}", bits.crc)?;
        writeln!(out, "duration    {duration_us} us at {} bit/s", args.bitrate)?;
    }
    Ok(ExitCode::SUCCESS)
}
