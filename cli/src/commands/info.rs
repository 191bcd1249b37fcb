//! `cantap info`: what a device is.

use std::io::Write;
use std::process::ExitCode;

use cantap::wire::message::capability;

use crate::boards::OneBoard;

use crate::clock;

/// The command line.
#[derive(clap::Args)]
#[command(after_help = "Examples:\n  cantap info -d /dev/ttyACM0\n  cantap info -d virtual --json")]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Names of the device's capabilities.
const CAPABILITIES: [(u32, &str); 6] = [
    (capability::TRANSMIT, "transmit"),
    (capability::TIMED_TRANSMIT, "timed-transmit"),
    (capability::SLCAN, "slcan"),
    (capability::DEFAULTS, "defaults"),
    (capability::BOOTLOADER, "bootloader"),
    (capability::EDGES, "edges"),
];

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let device = args.device.open()?;
    let hello = device.hello();
    let [major, minor, patch] = hello.firmware;
    let firmware = format!("{major}.{minor}.{patch}");
    let capabilities: Vec<&str> =
        CAPABILITIES.iter().filter(|(bit, _)| hello.capabilities & bit != 0).map(|(_, name)| *name).collect();
    let round_trip_us = device.clock().round_trip_ns as f64 / 1e3;
    let mut out = std::io::stdout().lock();
    if args.json {
        let object = serde_json::json!({
            "device": device.name(),
            "board": hello.board.as_str(),
            "serial_number": hello.serial.as_str(),
            "firmware": firmware,
            "protocol": hello.protocol,
            "channels": hello.channels,
            "tick_hz": hello.tick_hz,
            "can_clock_hz": hello.can_clock_hz,
            "queue_bytes": hello.queue_bytes,
            "tx_queue": hello.tx_queue,
            "periodic_slots": hello.periodic_slots,
            "trigger_slots": hello.trigger_slots,
            "filter_banks": hello.filter_banks,
            "capabilities": capabilities,
            "round_trip_us": round_trip_us,
            "clock": clock::object(&device.clock()),
        });
        writeln!(out, "{object}")?;
    } else {
        writeln!(out, "board           {}", hello.board)?;
        writeln!(out, "serial number   {}", hello.serial)?;
        writeln!(out, "firmware        {firmware}, protocol version {}", hello.protocol)?;
        writeln!(out, "channels        {}", hello.channels)?;
        writeln!(out, "CAN clock       {} MHz", f64::from(hello.can_clock_hz) / 1e6)?;
        writeln!(out, "time stamps     {} MHz", f64::from(hello.tick_hz) / 1e6)?;
        writeln!(out, "record queue    {} bytes", hello.queue_bytes)?;
        writeln!(
            out,
            "transmission    queue of {} frames, {} periodic and {} reply entries per channel",
            hello.tx_queue, hello.periodic_slots, hello.trigger_slots
        )?;
        writeln!(out, "filter banks    {}", hello.filter_banks)?;
        writeln!(out, "capabilities    {}", capabilities.join(", "))?;
        writeln!(out, "round trip      {round_trip_us:.0} us")?;
        writeln!(out, "clock           {}", clock::line(&device.clock()))?;
    }
    Ok(ExitCode::SUCCESS)
}
