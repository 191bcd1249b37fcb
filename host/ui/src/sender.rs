//! What pages have the device send: frames once, and frames that it repeats by itself. Those stop when no page is there any more.

use std::time::Duration;

use anyhow::{Context, bail};
use cantap::periodic;
use cantap::wire::message::{Periodic, TxFrame};
use cantap::{Channel, Frame};
use cantap_signals::Decoder;
use cantap_trace::counted;
use cantap_trace::grammar;
use cantap_work::channels::place_of;
use cantap_work::live::{Line, Lines};

use crate::request::{self, Change};
use crate::state::PeriodicState;

/// Longest text of a frame, in bytes.
const MOST_TEXT: usize = 4096;

/// A frame as `cantap send` takes it: `123#DEADBEEF`, or `Message:Signal=value` by the databases.
pub fn frame(decoder: &Decoder, channel: u8, text: &str) -> anyhow::Result<Frame> {
    if text.len() > MOST_TEXT {
        bail!("that is too long for a frame; write it as 123#DEADBEEF or Message:Signal=value");
    }
    if text.contains(':') && !text.contains('#') {
        return Ok(cantap_signals::encode::encode(decoder, Some(channel), text)?.frame);
    }
    grammar::frame(text).map_err(|reason| anyhow::anyhow!("'{text}' is not a frame: {reason}"))
}

/// The device of a channel, and the channel there.
fn device(lines: &Lines, number: u8) -> anyhow::Result<(&Line, Channel)> {
    let (board, channel) = place_of(number.max(1));
    let line = lines.lines().nth(board).filter(|_| number > 0);
    let line = line.with_context(|| format!("there is no channel {number}; choose one that is open"))?;
    Ok((line, channel))
}

fn open_device(lines: &Lines, number: u8) -> anyhow::Result<(&cantap::Device, Channel)> {
    let (line, channel) = device(lines, number)?;
    let device = line.device().context("the device is away; nothing is sent until it is back")?;
    if device.open_channels().iter().all(|(open, _)| *open != channel) {
        bail!("channel {number} is not open; choose one that is");
    }
    Ok((device, channel))
}

/// Sends a frame once.
pub fn send(lines: &Lines, number: u8, frame: Frame) -> anyhow::Result<()> {
    let (device, channel) = open_device(lines, number)?;
    device.send(channel, &[TxFrame { tag: 0, frame, at_ticks: None }])?;
    Ok(())
}

/// Has the device send a frame periodically, in a place that is free.
pub fn start(
    lines: &Lines,
    entries: &[PeriodicState],
    number: u8,
    frame: Frame,
    period_ms: f64,
    changes: &[Change],
) -> anyhow::Result<PeriodicState> {
    let period = Duration::try_from_secs_f64(period_ms / 1000.0).ok();
    let period =
        period.with_context(|| format!("{period_ms} ms is no period; give milliseconds, such as 10"))?;
    let modifiers = request::modifiers(&frame, changes)?;
    let (device, channel) = open_device(lines, number)?;
    let period_ticks = periodic::period_ticks(period, device.hello().tick_hz)?;
    let in_use = |slot: u8| entries.iter().any(|entry| (entry.channel, entry.slot) == (number, slot));
    let slots = device.hello().periodic_slots;
    let slot = (0..slots).find(|slot| !in_use(*slot));
    let slot = slot.with_context(|| {
        format!(
            "the device repeats {slots} on a channel; stop another one first",
            slots = counted(slots, "frame")
        )
    })?;
    device.set_periodic(channel, slot, Some(Periodic { frame, period_ticks, count: 0, modifiers }))?;
    Ok(PeriodicState { channel: number, slot, frame: frame.to_string(), period_ms })
}

/// Ends one.
pub fn stop(lines: &Lines, number: u8, slot: u8) -> anyhow::Result<()> {
    let (line, channel) = device(lines, number)?;
    // A device that is away has forgotten it.
    if let Some(device) = line.device() {
        device.set_periodic(channel, slot, None)?;
    }
    Ok(())
}
