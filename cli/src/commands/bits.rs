//! `cantap bits`: a frame's exact length on the bus.

use std::io::Write;
use std::process::ExitCode;

use cantap::{FdBits, FdFrame, Frame, FrameBits, TraceFrame};

use cantap_trace::counted;
use cantap_trace::grammar;

use crate::args;
use crate::completion;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  cantap bits 000#55\n  cantap bits 1F334455#1122334455667788 -b 500k\n  \
                        cantap bits 123#R4 --json\n  cantap bits 123##1112233 -b 500k --data-bitrate 2M"
)]
pub struct Args {
    /// The frame, as 123#DEADBEEF, 1F334455#, or 123#R4; a CAN FD one as 123##1DEADBEEF (1: switched bit rate, 2: error
    /// passive sender, 3: both, 0: neither).
    #[arg(value_parser = frame)]
    frame: TraceFrame,
    /// Bit rate for the duration, in bit/s: 500000, 500k, 1M.
    #[arg(short, long, value_name = "RATE", default_value = "1M", value_parser = args::bitrate, add = completion::bit_rates())]
    bitrate: u32,
    /// Bit rate of a CAN FD frame's data phase, if it switches.
    #[arg(long, default_value = "2M", value_name = "RATE", value_parser = args::bitrate, add = completion::bit_rates())]
    data_bitrate: u32,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

fn frame(text: &str) -> Result<TraceFrame, String> {
    grammar::any_frame(text, false)
}

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    match &args.frame {
        TraceFrame::Classic(frame) => classic(args, frame)?,
        TraceFrame::Fd(frame) => flexible(args, frame)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn classic(args: &Args, frame: &Frame) -> std::io::Result<()> {
    let bits = FrameBits::of(frame);
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
        writeln!(out, "length      {}, intermission included", counted(bits.total(), "bit"))?;
        writeln!(out, "frame bits  {}", bits.unstuffed)?;
        writeln!(out, "stuff bits  {}", bits.stuff)?;
        writeln!(out, "CRC         0x{:03X}", bits.crc)?;
        writeln!(out, "duration    {duration_us} us at {} bit/s", args.bitrate)?;
    }
    Ok(())
}

fn flexible(args: &Args, frame: &FdFrame) -> std::io::Result<()> {
    let bits = FdBits::of(frame);
    let duration_us = bits.duration_ns(args.bitrate, args.data_bitrate) as f64 / 1e3;
    let mut out = std::io::stdout().lock();
    if args.json {
        return writeln!(
            out,
            "{}",
            serde_json::json!({
                "frame": frame.to_string(),
                "bits": bits.total(),
                "nominal_bits": bits.nominal,
                "data_phase_bits": bits.data,
                "stuff_bits": bits.stuff,
                "fixed_stuff_bits": bits.fixed_stuff,
                "crc": bits.crc,
                "bitrate_bps": args.bitrate,
                "data_bitrate_bps": frame.brs().then_some(args.data_bitrate),
                "duration_us": duration_us,
            })
        );
    }
    writeln!(out, "frame       {frame}")?;
    writeln!(out, "length      {}, intermission included", counted(bits.total(), "bit"))?;
    if frame.brs() {
        writeln!(
            out,
            "            {} of them at the nominal rate, {} in the data phase",
            bits.nominal, bits.data
        )?;
    }
    writeln!(out, "stuff bits  {}, and {} at fixed places", bits.stuff, bits.fixed_stuff)?;
    writeln!(out, "CRC         0x{:05X}", bits.crc)?;
    if frame.brs() {
        writeln!(out, "duration    {duration_us} us at {} and {} bit/s", args.bitrate, args.data_bitrate)
    } else {
        writeln!(out, "duration    {duration_us} us at {} bit/s", args.bitrate)
    }
}
