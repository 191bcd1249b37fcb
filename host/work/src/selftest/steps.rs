//! Steps that need no bus.

use std::time::{Duration, Instant};

use cantap::wire::message::{Defaults, Hello};
use cantap::wire::{CHANNELS, PROTOCOL_VERSION};
use cantap::{Channel, Device};
use cantap_address::{Address, OpenDevice};
use serde_json::{Value, json};

use super::patience::Patience;
use super::report::StepOutcome;
use crate::rounded;

/// Number of requests for the device's time.
const ROUND_TRIPS: usize = 500;
/// A crystal and this computer's clock together never differ by this much; a device running from its internal oscillator,
/// which is accurate to about 1 %, does.
const MAX_DRIFT_PPM: f64 = 500.0;
/// How long it takes to determine a drift from good samples.
const CLOCK_PATIENCE: Duration = Duration::from_secs(12);
/// How long a restarting firmware takes to be on USB again, however slow the computer.
const RESTART_PATIENCE: Duration = Duration::from_secs(15);

type Result<T = StepOutcome> = anyhow::Result<T>;

/// The device's description of itself.
pub fn identity(hello: &Hello) -> StepOutcome {
    let holds = hello.protocol == PROTOCOL_VERSION
        && usize::from(hello.channels) == CHANNELS
        && hello.tick_hz >= 10_000_000
        && !hello.serial.is_empty();
    let says = format!(
        "{} channels, CAN clock {} Hz, stamps of {} Hz, queues of {} bytes and {} frames, {} filter banks",
        hello.channels,
        hello.can_clock_hz,
        hello.tick_hz,
        hello.queue_bytes,
        hello.tx_queue,
        hello.filter_banks
    );
    let measured = json!({
        "channels": hello.channels, "can_clock_hz": hello.can_clock_hz, "tick_hz": hello.tick_hz,
        "queue_bytes": hello.queue_bytes, "tx_queue": hello.tx_queue, "periodic_slots": hello.periodic_slots,
        "trigger_slots": hello.trigger_slots, "filter_banks": hello.filter_banks,
        "capabilities": hello.capabilities,
    });
    StepOutcome::of(holds, says, measured)
}

/// The system's description of its port.
pub fn usb(address: &Address, hello: &Hello) -> Result {
    if !address.may_come_back() {
        return Ok(StepOutcome::Skip("this device has no USB port".to_owned()));
    }
    let port = address.to_string();
    let boards = cantap::device::list()?;
    let Some(board) = boards.into_iter().find(|board| board.port == port) else {
        return Ok(StepOutcome::Skip(
            "the system does not tell the USB IDs of this port, or they are not cantap's".to_owned(),
        ));
    };
    let product = board.product.unwrap_or_else(|| "-".to_owned());
    let serial = board.serial_number.unwrap_or_else(|| "-".to_owned());
    let holds = serial == hello.serial.as_str();
    let measured = json!({ "product": product, "serial_number": serial });
    Ok(StepOutcome::of(holds, format!("{product}, serial number {serial}"), measured))
}

/// How long answers take.
pub fn round_trips(patience: &Patience, device: &Device) -> Result {
    let mut times_us = Vec::with_capacity(ROUND_TRIPS);
    let mut last = device.time()?;
    let mut goes_on = true;
    for _ in 0..ROUND_TRIPS {
        patience.check()?;
        let asked = Instant::now();
        let ticks = device.time()?;
        times_us.push(asked.elapsed().as_secs_f64() * 1e6);
        goes_on &= ticks > std::mem::replace(&mut last, ticks);
    }
    times_us.sort_by(f64::total_cmp);
    let [least, median, p99, most] =
        [0, ROUND_TRIPS / 2, ROUND_TRIPS * 99 / 100, ROUND_TRIPS - 1].map(|at| rounded(times_us[at], 1));
    let clock = if goes_on { "" } else { "; its clock stood still or went back" };
    let says =
        format!("{ROUND_TRIPS}: at least {least} us, median {median}, 99 % {p99}, at most {most}{clock}");
    let measured = json!({ "count": ROUND_TRIPS, "least_us": least, "median_us": median, "p99_us": p99, "most_us": most });
    Ok(StepOutcome::of(goes_on, says, measured))
}

/// How much faster the device's clock runs than this computer's.
pub fn clock(patience: &Patience, address: &Address, device: &Device) -> Result {
    let started = Instant::now();
    let drift = || device.clock().drift_ppm;
    // A first figure from when this computer was busy does not last; that of a bad clock does.
    while drift().is_none_or(|ppm: f64| ppm.abs() > MAX_DRIFT_PPM) && started.elapsed() < CLOCK_PATIENCE {
        patience.pause(Duration::from_millis(100))?;
    }
    // A device that is part of this program has no crystal: it is as fast as this computer lets it be.
    let is_bad = |ppm: f64| ppm.abs() > MAX_DRIFT_PPM;
    let measured = drift().filter(|ppm| address.may_come_back() || !is_bad(*ppm));
    let Some(ppm) = measured.map(|ppm| rounded(ppm, 2)) else {
        let why =
            "it could not be measured: the device does not run in real time, or this computer is too busy";
        return Ok(StepOutcome::Skip(why.to_owned()));
    };
    let says = format!("{ppm} ppm against this computer's");
    Ok(StepOutcome::of(!is_bad(ppm), says, json!({ "drift_ppm": ppm })))
}

/// What the device has stored for each channel.
pub fn saved(device: &Device) -> anyhow::Result<Vec<Option<Defaults>>> {
    Ok(Channel::ALL
        .into_iter()
        .map(|channel| device.defaults(channel))
        .collect::<std::result::Result<_, _>>()?)
}

/// Whether what it has stored is the same as before.
pub fn compare_saved(before: &[Option<Defaults>], now: &[Option<Defaults>]) -> StepOutcome {
    let what = now.iter().map(|saved| if saved.is_some() { "saved" } else { "nothing saved" });
    let says = format!("as before: channel 1 {}", what.collect::<Vec<_>>().join(", channel 2 "));
    if before == now {
        StepOutcome::Pass(says, Value::Null)
    } else {
        StepOutcome::Fail("they changed".to_owned(), Value::Null)
    }
}

/// Restarts the firmware and waits for it to come back.
pub fn restart(patience: &Patience, address: &Address, device: OpenDevice) -> Result {
    let serial = device.hello().serial.clone();
    let asked = Instant::now();
    device.reset()?;
    drop(device);
    // The port remains for a moment.
    patience.pause(Duration::from_millis(500))?;
    let device = loop {
        match address.open() {
            Ok(device) => break device,
            Err(error) if asked.elapsed() > RESTART_PATIENCE => return Err(error.into()),
            Err(_) => patience.pause(Duration::from_millis(100))?,
        }
    };
    let seconds = rounded(asked.elapsed().as_secs_f64(), 1);
    let uptime_s = device.time()? as f64 / f64::from(device.hello().tick_hz);
    let holds = device.hello().serial == serial && uptime_s < asked.elapsed().as_secs_f64();
    let says = format!("back after {seconds} s, and running for {uptime_s:.1} s");
    Ok(StepOutcome::of(holds, says, json!({ "seconds": seconds, "uptime_s": rounded(uptime_s, 2) })))
}
