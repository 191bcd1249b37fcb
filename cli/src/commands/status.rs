//! `cantap status`: a device's state, counters and registers.

use std::io::Write;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use cantap::Channel;
use cantap::wire::message::{ChannelStatus, Failures, Hello, Mode, RegisterSet, Status};
use cantap_trace::BusErrorKind;
use cantap_trace::counted;
use serde_json::{Value, json};

use crate::channel_args::ChannelArgs;
use crate::completion;
use crate::one_board::OneBoard;
use crate::usage_error::usage;
use crate::{args, clock};
use cantap_work::channels::Channels;
use cantap_work::interrupt;

/// The command line.
#[derive(clap::Args)]
#[command(
    after_help = "Connecting begins a session: it closes both channels and sets the counters to zero. So to learn \
                something of a bus, listen to it for a while first, with --time. With --json, mode and bitrate_bps of a \
                channel are null while it is closed; modes have the names that --mode takes.\n\n\
                Examples:\n  \
                cantap status -d /dev/ttyACM0\n  \
                cantap status -d /dev/ttyACM0 -b 500k --time 2s\n  \
                cantap status -d virtual --registers --json"
)]
pub struct Args {
    #[command(flatten)]
    device: OneBoard,
    /// Open the channels for this long before asking, as 2s or 500ms; they only listen, unless --mode says otherwise.
    #[arg(short, long, value_name = "TIME", value_parser = args::positive_duration)]
    time: Option<Duration>,
    /// Which channels --time opens: 1, 2 or both.
    #[arg(short, long, default_value = "both", requires = "time", value_parser = args::channels_of_one, add = completion::channels())]
    channel: Channels,
    #[command(flatten)]
    open: ChannelArgs,
    /// Also the controllers' registers, now and at the last error.
    #[arg(long)]
    registers: bool,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// How often to check for Ctrl-C.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// Runs it.
pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.time.is_none() && args.open.options().is_given() {
        return Err(usage(
            "without --time no channel is opened, so these options have no effect; add --time to listen for a while before asking",
        ));
    }
    interrupt::watch()?;
    let device = args.device.open()?;
    if let Some(time) = args.time {
        args.open.open(&device, args.channel.iter(), Mode::ListenOnly, Some(&[]))?;
        let mut recovery = args.open.bus_off_recovery();
        let ends = Instant::now() + time;
        while Instant::now() < ends && !interrupt::requested() {
            std::thread::sleep(LOOK_EVERY.min(ends.saturating_duration_since(Instant::now())));
            recovery.look(&device)?;
        }
    }
    let status = device.status()?;
    let failures = device.failures()?;
    let mut registers = Vec::new();
    if args.registers {
        for channel in Channel::ALL {
            registers.push(device.registers(channel)?);
        }
    }
    let mut out = std::io::stdout().lock();
    let uptime_s = status.ticks as f64 / f64::from(device.hello().tick_hz);
    if args.json {
        let mut object = object(&status, &failures, uptime_s, device.hello());
        object["clock"] = clock::object(&device.clock());
        for (channel, registers) in object["channels"].as_array_mut().into_iter().flatten().zip(&registers) {
            channel["registers"] = register_object(&registers.now);
            channel["registers_at_last_error"] =
                registers.at_last_error.as_ref().map_or(Value::Null, register_object);
        }
        writeln!(out, "{object}")?;
        return Ok(ExitCode::SUCCESS);
    }
    writeln!(out, "uptime       {uptime_s:.1} s")?;
    writeln!(out, "clock        {}", clock::line(&device.clock()))?;
    let tenths = |value: i16| format!("{:.1} C", f64::from(value) / 10.0);
    let unknown = || "not measured by this device".to_owned();
    writeln!(out, "temperature  {}", status.temperature_decicelsius.map_or_else(unknown, tenths))?;
    let volts = |value: u16| format!("{:.2} V", f64::from(value) / 1e3);
    writeln!(out, "supply       {}", status.supply_millivolts.map_or_else(unknown, volts))?;
    writeln!(
        out,
        "queue        {} of {}, at most {}",
        status.queue_bytes,
        counted(device.hello().queue_bytes, "byte"),
        status.queue_high_water_bytes
    )?;
    writeln!(out, "bad requests {}", status.bad_requests)?;
    writeln!(out, "failures     {}", failures_text(&failures))?;
    for (channel, state) in Channel::ALL.into_iter().zip(&status.channels) {
        let open = state.open.map_or("closed".to_owned(), |config| {
            match config.timing.known_bitrate_bps(device.hello().can_clock_hz) {
                Some(bitrate) => format!("open, {}, {bitrate} bit/s", config.mode.name()),
                None => format!("open, {}, bit rate not known", config.mode.name()),
            }
        });
        writeln!(out, "\nchannel {}    {open}", channel.number())?;
        writeln!(out, "  state      {}, TEC {}, REC {}", state.state.name(), state.tec, state.rec)?;
        writeln!(out, "  last error {}", state.last_error.map_or("none", BusErrorKind::name))?;
        writeln!(
            out,
            "  received   {}; lost: controller {}, queue {}",
            counted(state.frames, "frame"),
            if device.hello().counts_losses() {
                format!("at least {}", state.lost_controller)
            } else {
                "not counted by this adapter".to_owned()
            },
            state.lost_queue
        )?;
        writeln!(
            out,
            "  sent       {}; failed {}, waiting {}",
            counted(state.transmitted, "frame"),
            state.transmit_failures,
            state.tx_pending
        )?;
        writeln!(out, "  bus errors {}", state.bus_errors)?;
    }
    for (channel, registers) in Channel::ALL.into_iter().zip(&registers) {
        writeln!(out, "\nregisters of channel {}", channel.number())?;
        writeln!(out, "            {:>8}  at last error", "now")?;
        let then = registers.at_last_error.as_ref().map(register_values);
        for (at, (register, value)) in register_values(&registers.now).into_iter().enumerate() {
            let then = then.map_or("-".to_owned(), |then| format!("{:08X}", then[at].1));
            writeln!(out, "  CAN_{register:<4}  {value:08X}  {then}")?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// How often the firmware has failed since power-on, and the last reason.
fn failures_text(failures: &Failures) -> String {
    match failures.count {
        0 => "none since power-on".to_owned(),
        1 => format!("1 since power-on: {}", failures.last),
        count => format!("{count} since power-on, the last: {}", failures.last),
    }
}

fn object(status: &Status, failures: &Failures, uptime_s: f64, hello: &Hello) -> Value {
    let channels: Vec<Value> = Channel::ALL
        .into_iter()
        .zip(&status.channels)
        .map(|(channel, state)| channel_object(channel, state, hello))
        .collect();
    json!({
        "uptime_s": uptime_s,
        "temperature_celsius": status.temperature_decicelsius.map(|value| f64::from(value) / 10.0),
        "supply_volts": status.supply_millivolts.map(|value| f64::from(value) / 1e3),
        "queue_bytes": status.queue_bytes,
        "queue_size_bytes": hello.queue_bytes,
        "queue_high_water_bytes": status.queue_high_water_bytes,
        "bad_requests": status.bad_requests,
        "failures": failures.count,
        "last_failure": (failures.count > 0).then_some(failures.last.as_str()),
        "channels": channels,
    })
}

fn channel_object(channel: Channel, state: &ChannelStatus, hello: &Hello) -> Value {
    let can_clock_hz = hello.can_clock_hz;
    json!({
        "channel": channel.number(),
        "open": state.open.is_some(),
        "mode": state.open.map(|config| config.mode.name()),
        "bitrate_bps": state.open.and_then(|config| config.timing.known_bitrate_bps(can_clock_hz)),
        "state": state.state.name(),
        "tec": state.tec,
        "rec": state.rec,
        "last_error": state.last_error.map(BusErrorKind::name),
        "frames": state.frames,
        "lost_controller": hello.counts_losses().then_some(state.lost_controller),
        "lost_queue": state.lost_queue,
        "bus_errors": state.bus_errors,
        "transmitted": state.transmitted,
        "transmit_failures": state.transmit_failures,
        "tx_pending": state.tx_pending,
    })
}

fn register_values(set: &RegisterSet) -> [(&'static str, u32); 7] {
    [
        ("MCR", set.mcr),
        ("MSR", set.msr),
        ("TSR", set.tsr),
        ("RF0R", set.rf0r),
        ("IER", set.ier),
        ("ESR", set.esr),
        ("BTR", set.btr),
    ]
}

fn register_object(set: &RegisterSet) -> Value {
    register_values(set)
        .into_iter()
        .map(|(name, value)| (name.to_lowercase(), Value::from(format!("0x{value:08X}"))))
        .collect::<serde_json::Map<_, _>>()
        .into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_are_told_with_the_last_ones_words() {
        let last = "panicked at src/a.rs:7:5: no";
        for (count, words) in [
            (0, "none since power-on".to_owned()),
            (1, format!("1 since power-on: {last}")),
            (2, format!("2 since power-on, the last: {last}")),
        ] {
            let last = if count > 0 { last } else { "" };
            assert_eq!(failures_text(&Failures { count, last: last.try_into().unwrap() }), words);
        }
    }
}
