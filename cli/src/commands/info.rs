//! `cantap info`: what a device is.

use std::io::Write;
use std::process::ExitCode;

use cantap::wire::Channel;
use cantap::wire::message::capability;
use cantap_adapters::Row;
use cantap_trace::counted;

use crate::one_board::OneBoard;

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
const CAPABILITIES: [(u32, &str); 13] = [
    (capability::TRANSMIT, "transmit"),
    (capability::TIMED_TRANSMIT, "timed-transmit"),
    (capability::SLCAN, "slcan"),
    (capability::DEFAULTS, "defaults"),
    (capability::BOOTLOADER, "bootloader"),
    (capability::EDGES, "edges"),
    (capability::GATEWAY, "gateway"),
    (capability::ADAPTER, "adapter"),
    (capability::ALWAYS_ACKNOWLEDGES, "always-acknowledges"),
    (capability::NO_BIT_RATE, "no-bit-rate"),
    (capability::UNCOUNTED_LOSSES, "uncounted-losses"),
    (capability::FD_TRANSMIT, "fd-transmit"),
    (capability::DISTURB, "disturb"),
];

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let device = args.device.open()?;
    let hello = device.hello();
    let [major, minor, patch] = hello.firmware;
    let firmware = format!("{major}.{minor}.{patch}");
    let capabilities: Vec<&str> =
        CAPABILITIES.iter().filter(|(bit, _)| hello.capabilities & bit != 0).map(|(_, name)| *name).collect();
    let can_fd = cantap_adapters::can_fd(hello, device.data_bitrate(Channel::Can1));
    let round_trip_us = device.clock().round_trip_ns as f64 / 1e3;
    let mut out = std::io::stdout().lock();
    if args.json {
        let mut object = serde_json::json!({
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
            "can_fd": {
                "receives": can_fd.receives,
                "sends": can_fd.sends,
                "data_bitrate_bps": can_fd.data_bitrate_bps,
                "source": can_fd.source,
            },
            "capabilities": capabilities,
            "round_trip_us": round_trip_us,
            "clock": clock::object(&device.clock()),
        });
        if let (Some(row), Some(object)) = (cantap_adapters::row(&hello.board), object.as_object_mut()) {
            object.insert("adapter".to_owned(), adapter(row));
        }
        writeln!(out, "{object}")?;
    } else {
        writeln!(out, "board           {}", hello.board)?;
        writeln!(out, "serial number   {}", hello.serial)?;
        writeln!(out, "firmware        {firmware}, protocol version {}", hello.protocol)?;
        writeln!(out, "channels        {}", hello.channels)?;
        writeln!(out, "CAN clock       {} MHz", f64::from(hello.can_clock_hz) / 1e6)?;
        writeln!(out, "time stamps     {} MHz", f64::from(hello.tick_hz) / 1e6)?;
        writeln!(out, "record queue    {}", counted(hello.queue_bytes, "byte"))?;
        writeln!(
            out,
            "transmission    queue of {}, {} periodic and {} reply entries per channel",
            counted(hello.tx_queue, "frame"),
            hello.periodic_slots,
            hello.trigger_slots
        )?;
        writeln!(out, "filter banks    {}", hello.filter_banks)?;
        writeln!(out, "CAN FD          {can_fd}")?;
        writeln!(out, "capabilities    {}", capabilities.join(", "))?;
        writeln!(out, "round trip      {round_trip_us:.0} us")?;
        writeln!(out, "clock           {}", clock::line(&device.clock()))?;
        if let Some(row) = cantap_adapters::row(&hello.board) {
            writeln!(out, "adapter         {}", row.what)?;
            writeln!(out, "  stamps        {}", row.stamps)?;
            writeln!(out, "  losses        {}", row.losses_before())?;
            writeln!(out, "  errors        {}", row.errors)?;
            writeln!(out, "  confirmation  {}", row.confirmation)?;
            writeln!(out, "  listen-only   {}", row.listen_only)?;
            if let Some(limits) = row.limits {
                writeln!(out, "  limits        {limits}")?;
            }
            let failures = device.failures()?;
            if failures.count > 0 {
                writeln!(out, "  left out      {}", failures.last)?;
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// What another maker's adapter can tell, for scripts.
fn adapter(row: &Row) -> serde_json::Value {
    serde_json::json!({
        "kind": row.what,
        "stamps": row.stamps.to_string(),
        "losses": row.losses_before(),
        "errors": row.errors,
        "confirmation": row.confirmation.to_string(),
        "listen_only": row.listen_only.to_string(),
        "counts_losses": row.losses.are_counted(),
        "limits": row.limits,
    })
}
