//! Steps on the buses, and without them.

use std::time::{Duration, Instant};

use cantap::wire::Refusal;
use cantap::wire::message::{ChannelConfig, ChannelStatus, Mode, TxFrame};
use cantap::wire::record::{ErrorState, TransmitFailure};
use cantap::{Channel, Device, DeviceError, Frame};
use serde_json::{Value, json};

use super::patience::Patience;
use super::report::StepOutcome;
use super::traffic::{Amount, Flow, STAMP_TOLERANCE_US, exchange, forget, load_together_pct};
use crate::rounded;

/// Bit rate of the steps that need only one.
const BITRATE_BPS: u32 = 500_000;
/// The rate at which a load is hardest.
const FULL_RATE_BPS: u32 = 1_000_000;
/// Number of frames on a channel at each bit rate.
const FRAMES: u32 = 100;
/// How long a channel listens.
const LISTENING: Duration = Duration::from_secs(1);
/// The load of a bus that counts as full.
const FULL_PCT: f64 = 90.0;
/// The transmit error counter stops here if a frame is not acknowledged (ISO 11898-1:2015, 12.1.4.2).
const UNACKNOWLEDGED_TEC: u8 = 128;
/// The longest wait; everything awaited comes sooner.
const PATIENCE: Duration = Duration::from_secs(3);
/// How long to wait at a time.
const GLANCE: Duration = Duration::from_millis(20);

type Result = anyhow::Result<StepOutcome>;

fn open(device: &Device, channel: Channel, bitrate_bps: u32, mode: Mode) -> anyhow::Result<()> {
    let config = ChannelConfig { mode, ..ChannelConfig::listen_only(device.timing(bitrate_bps)?) };
    device.open_channel(channel, Some(config))?;
    Ok(())
}

fn state(device: &Device, channel: Channel) -> anyhow::Result<ChannelStatus> {
    Ok(device.status()?.channels[channel.index()])
}

/// Listens, and must not have driven the bus: nothing was sent, and the transmit error counter, which a controller may keep
/// from earlier, has not increased.
pub fn listen(patience: &Patience, device: &Device, channel: Channel) -> Result {
    open(device, channel, BITRATE_BPS, Mode::ListenOnly)?;
    let before = state(device, channel)?;
    patience.pause(LISTENING)?;
    let seen = state(device, channel)?;
    device.close_channel(channel)?;
    let ChannelStatus { frames, bus_errors, tec, rec, transmitted, .. } = seen;
    let remark = match (frames, bus_errors) {
        (0, 0) => "nothing is connected, or the bus is quiet",
        (0, _) => "the bus has another bit rate, or nothing but noise",
        _ => "a bus is connected, and it is at this bit rate",
    };
    let says = format!(
        "{frames} frames, {bus_errors} errors, TEC {tec}, REC {rec} at {BITRATE_BPS} bit/s: {remark}"
    );
    let measured = json!({ "frames": frames, "bus_errors": bus_errors, "tec": tec, "rec": rec });
    let holds = tec <= before.tec && transmitted == before.transmitted && seen.state != ErrorState::BusOff;
    Ok(StepOutcome::of(holds, says, measured))
}

/// A channel in loopback inside the controller; its bus sees nothing. Then it is opened again, and its error counters are
/// reported.
pub fn alone(patience: &Patience, device: &Device, channel: Channel, bitrate_bps: u32) -> Result {
    let mut records = device.records();
    forget(&mut records);
    open(device, channel, bitrate_bps, Mode::SilentLoopback)?;
    let flows =
        exchange(patience, device, &mut records, &[(channel, channel)], bitrate_bps, Amount::Frames(FRAMES))?;
    open(device, channel, bitrate_bps, Mode::ListenOnly)?;
    let again = state(device, channel)?;
    device.close_channel(channel)?;
    let flow = &flows[0];
    let (early_us, median_us) = flow.spacing_us();
    let holds = is_clean(flow)
        && flow.sent == FRAMES
        && early_us <= STAMP_TOLERANCE_US
        && median_us.abs() <= STAMP_TOLERANCE_US;
    let says = format!(
        "{}; stamps against exact lengths: at most {early_us:.2} us early, median {median_us:.2} us late; opened again: TEC {}, REC {}",
        flow.line(),
        again.tec,
        again.rec
    );
    let mut measured = flow.measured();
    measured["tec_opened_again"] = again.tec.into();
    measured["rec_opened_again"] = again.rec.into();
    Ok(StepOutcome::of(holds, says, measured))
}

fn is_clean(flow: &Flow) -> bool {
    flow.is_accounted_for() && flow.lost == 0 && flow.bus_errors == 0
}

/// Frames for later fill the queue completely; once withdrawn, each is reported.
pub fn fill_queue(patience: &Patience, device: &Device, channel: Channel) -> Result {
    open(device, channel, BITRATE_BPS, Mode::SilentLoopback)?;
    let ends = device.transmissions();
    let places = u32::from(device.hello().tx_queue);
    // Long after the end of this step, but within the day that a device allows.
    let at_ticks = Some(device.time()? + u64::from(device.hello().tick_hz) * 60);
    let frame: Frame = "123#".parse()?;
    let (mut queued, mut refused) = (0, false);
    while queued <= 2 * places && !refused {
        match device.send(channel, &[TxFrame { tag: queued, frame, at_ticks }]) {
            Ok(_) => queued += 1,
            Err(DeviceError::Refused { refusal: Refusal::QueueFull { free: 0 } }) => refused = true,
            Err(error) => return Err(error.into()),
        }
    }
    device.abort(channel)?;
    let started = Instant::now();
    let mut told = 0;
    while told < queued && started.elapsed() < PATIENCE {
        patience.check()?;
        if let Ok(end) = ends.recv_timeout(GLANCE) {
            told += u32::from(end.result == Err(TransmitFailure::Aborted) && end.tag == told);
        }
    }
    device.close_channel(channel)?;
    // Mailboxes take a few more than the queue.
    let holds = refused && queued >= places && told == queued;
    let says = format!(
        "{queued} frames taken (the queue has {places}), then refused; {told} reported as withdrawn, in order"
    );
    Ok(StepOutcome::of(holds, says, json!({ "queued": queued, "refused": refused, "told": told })))
}

/// Both channels send as much as possible: each on its own bus, or both on one.
pub fn saturate(patience: &Patience, device: &Device, is_one_bus: bool, time: Duration) -> Result {
    let mut records = device.records();
    forget(&mut records);
    let mode = if is_one_bus { Mode::Normal } else { Mode::SilentLoopback };
    for channel in Channel::ALL {
        open(device, channel, FULL_RATE_BPS, mode)?;
    }
    let [first, second] = Channel::ALL;
    let ways =
        if is_one_bus { [(first, second), (second, first)] } else { [(first, first), (second, second)] };
    let before = device.status()?;
    let flows = exchange(patience, device, &mut records, &ways, FULL_RATE_BPS, Amount::For(time))?;
    let after = device.status()?;
    let loads: Vec<f64> = flows.iter().map(Flow::load_pct).collect();
    let is_full = if is_one_bus {
        load_together_pct(&flows) >= FULL_PCT
    } else {
        loads.iter().all(|load| *load >= FULL_PCT)
    };
    // The device's own count agrees.
    let counted = Channel::ALL.into_iter().zip(&flows).all(|(channel, flow)| {
        let transmitted =
            |status: &cantap::wire::message::Status| status.channels[channel.index()].transmitted;
        transmitted(&after).wrapping_sub(transmitted(&before)) == flow.sent
    });
    let holds = counted && flows.iter().all(is_clean);
    let queue_pct =
        f64::from(after.queue_high_water_bytes) * 100.0 / f64::from(device.hello().queue_bytes.max(1));
    let remark = if is_full { "" } else { "; this computer or the device did not fill the bus" };
    let lines: Vec<String> = flows.iter().map(Flow::line).collect();
    let says = format!("{}; record queue at most {queue_pct:.0} % full{remark}", lines.join("; "));
    let measured = json!({
        "flows": flows.iter().map(Flow::measured).collect::<Vec<Value>>(),
        "queue_high_water_bytes": after.queue_high_water_bytes,
        "bus_full": is_full, "device_counts_agree": counted,
    });
    Ok(StepOutcome::of(holds, says, measured))
}

/// Both channels send to each other.
pub fn cross(patience: &Patience, device: &Device, bitrate_bps: u32) -> Result {
    let mut records = device.records();
    forget(&mut records);
    for channel in Channel::ALL {
        open(device, channel, bitrate_bps, Mode::Normal)?;
    }
    let [first, second] = Channel::ALL;
    let flows = exchange(
        patience,
        device,
        &mut records,
        &[(first, second), (second, first)],
        bitrate_bps,
        Amount::Frames(FRAMES),
    )?;
    let holds = flows.iter().all(|flow| is_clean(flow) && flow.sent == FRAMES);
    let lines: Vec<String> = flows.iter().map(Flow::line).collect();
    let measured = Value::Array(flows.iter().map(Flow::measured).collect());
    let hint = if flows.iter().all(|flow| flow.heard == 0) {
        "; nothing arrived: are the channels wired to each other, CANH to CANH and CANL to CANL, with 120 ohms?"
    } else {
        ""
    };
    Ok(StepOutcome::of(holds, format!("{}{hint}", lines.join("; ")), measured))
}

/// One channel sends while the other only listens: nobody acknowledges, so the frame never ends, and the sender stops counting
/// at error-passive. Whether it keeps that across Close and Open depends on the controller, and is reported.
pub fn unacknowledged(patience: &Patience, device: &Device, sender: Channel) -> Result {
    let listener = if sender == Channel::Can1 { Channel::Can2 } else { Channel::Can1 };
    open(device, listener, BITRATE_BPS, Mode::ListenOnly)?;
    open(device, sender, BITRATE_BPS, Mode::Normal)?;
    let before = state(device, sender)?.transmitted;
    device.send(sender, &[TxFrame { tag: 1, frame: "123#55".parse()?, at_ticks: None }])?;
    let started = Instant::now();
    let seen = loop {
        patience.check()?;
        let seen = state(device, sender)?;
        if seen.tec >= UNACKNOWLEDGED_TEC || seen.transmitted != before || started.elapsed() > PATIENCE {
            break seen;
        }
    };
    device.abort(sender)?;
    device.close_channel(sender)?;
    open(device, sender, BITRATE_BPS, Mode::ListenOnly)?;
    let again = state(device, sender)?;
    for channel in Channel::ALL {
        device.close_channel(channel)?;
    }
    let transmitted = seen.transmitted.wrapping_sub(before);
    let holds = seen.tec == UNACKNOWLEDGED_TEC && seen.state == ErrorState::Passive && transmitted == 0;
    let who = if transmitted == 0 {
        "nobody acknowledged"
    } else {
        "somebody acknowledged: with --loop nothing but the two channels may be connected (the virtual and the emulated device \
         have other nodes unless they are given ack=no)"
    };
    let says = format!(
        "{who}: TEC {}, REC {}, {}; opened again: TEC {}, REC {}",
        seen.tec,
        seen.rec,
        seen.state.name(),
        again.tec,
        again.rec
    );
    let measured = json!({
        "tec": seen.tec, "rec": seen.rec, "transmitted": transmitted,
        "tec_opened_again": again.tec, "rec_opened_again": again.rec,
        "seconds": rounded(started.elapsed().as_secs_f64(), 3),
    });
    Ok(StepOutcome::of(holds, says, measured))
}
