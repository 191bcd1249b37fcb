//! Numbered frames that the device itself sends: who received which, in what order, how far apart.

use std::time::{Duration, Instant};

use cantap::device::Records;
use cantap::transmit::Stream;
use cantap::{Channel, Device, Direction, Frame, Id, TraceEvent, TraceFrame, TraceRecord, bits_on_bus};
use serde_json::{Value, json};

use super::patience::Patience;
use crate::rounded;

/// If no frame has ended for this long, sending is stuck.
const PATIENCE: Duration = Duration::from_secs(3);
/// How far a stamp may be from the position given by the frame's exact length, in microseconds.
pub const STAMP_TOLERANCE_US: f64 = 5.0;

/// How much to send.
#[derive(Clone, Copy)]
pub enum Amount {
    /// This many frames on each sending channel.
    Frames(u32),
    /// As many as possible.
    For(Duration),
}

/// The frame with a number: the number and the channel are in the data, everything else varies.
fn numbered(from: Channel, number: u32) -> Frame {
    let [a, b, c, d] = number.to_be_bytes();
    // Scattered, so that both channels win and lose arbitration; never the same identifier, which two nodes
    // must not send.
    let scattered = number.wrapping_mul(0x9E37_79B1) << 1 | from.index() as u32;
    let id =
        if number % 4 == 3 { Id::extended_truncated(scattered) } else { Id::standard_truncated(scattered) };
    let dlc = 5 + (number % 4) as u8;
    Frame::from_bus(id, false, dlc, [from.number(), a, b, c, d, !a, !d, d])
}

/// The results for one channel's frames.
pub struct Flow {
    pub from: Channel,
    pub to: Channel,
    /// Frames whose end was confirmed.
    pub sent: u32,
    /// Those that were not sent.
    pub failed: u32,
    /// Those received, in order and bit for bit.
    pub heard: u32,
    /// Anything else received.
    pub wrong: u32,
    /// Counted as lost where they should have been received.
    pub lost: u64,
    pub bus_errors: u32,
    /// The next number to be received if none is lost.
    next: u32,
    bits: u64,
    bitrate_bps: u32,
    tick_hz: u32,
    /// Device time of the first and last confirmation.
    span_ticks: Option<(u64, u64)>,
    /// For each frame, how much later it ended than its length after the previous one, in microseconds.
    behind_us: Vec<f32>,
}

impl Flow {
    fn confirm(&mut self, frame: &Frame, ticks: u64) {
        self.sent += 1;
        let bits = bits_on_bus(frame);
        match &mut self.span_ticks {
            None => self.span_ticks = Some((ticks, ticks)),
            Some((_, last)) => {
                self.bits += u64::from(bits);
                let exact_us = f64::from(bits) * 1e6 / f64::from(self.bitrate_bps);
                let apart_us = ticks.wrapping_sub(*last) as f64 * 1e6 / f64::from(self.tick_hz);
                self.behind_us.push((apart_us - exact_us) as f32);
                *last = ticks;
            }
        }
    }

    fn hear(&mut self, frame: &Frame) {
        // What was lost is counted, and its number is missing.
        let data = frame.data();
        let number = data.get(1..5).and_then(|number| number.try_into().ok()).map(u32::from_be_bytes);
        match number {
            Some(number) if *frame == numbered(self.from, number) && number >= self.next => {
                self.heard += 1;
                self.next = number + 1;
            }
            _ => self.wrong += 1,
        }
    }

    /// Load caused by the frames, in per cent, between the first and the last.
    pub fn load_pct(&self) -> f64 {
        let (first, last) = self.span_ticks.unwrap_or_default();
        let seconds = last.wrapping_sub(first) as f64 / f64::from(self.tick_hz);
        if seconds > 0.0 { self.bits as f64 * 100.0 / (f64::from(self.bitrate_bps) * seconds) } else { 0.0 }
    }

    /// The most that a frame ended too early, and the median lateness, compared with exact lengths, in
    /// microseconds.
    pub fn spacing_us(&self) -> (f64, f64) {
        let mut behind = self.behind_us.clone();
        behind.sort_by(f32::total_cmp);
        let early = behind.first().map_or(0.0, |first| -f64::from(*first));
        let median = behind.get(behind.len() / 2).map_or(0.0, |middle| f64::from(*middle));
        (early.max(0.0), median)
    }

    /// Whether each requested frame was sent, and was received once or counted as lost.
    pub fn is_accounted_for(&self) -> bool {
        self.sent > 0
            && self.failed == 0
            && self.wrong == 0
            && u64::from(self.heard) + self.lost == u64::from(self.sent)
    }

    /// One line.
    pub fn line(&self) -> String {
        let Self { from, to, sent, heard, lost, failed, wrong, bus_errors, .. } = self;
        let (from, to) = (from.number(), to.number());
        format!(
            "{from} to {to}: {sent} sent, {heard} heard, {lost} lost, {failed} failed, {wrong} wrong, {bus_errors} bus errors, \
             load {:.1} %",
            self.load_pct()
        )
    }

    /// The figures.
    pub fn measured(&self) -> Value {
        let (early_us, median_us) = self.spacing_us();
        json!({
            "from": self.from.number(), "to": self.to.number(), "bitrate_bps": self.bitrate_bps,
            "sent": self.sent, "failed": self.failed, "heard": self.heard, "wrong": self.wrong,
            "lost": self.lost, "bus_errors": self.bus_errors, "bus_load_pct": rounded(self.load_pct(), 2),
            "stamps_early_us": rounded(early_us, 2), "stamps_median_late_us": rounded(median_us, 2),
        })
    }
}

/// Load caused by the frames of several channels on one bus, in per cent, from the very first to the last.
pub fn load_together_pct(flows: &[Flow]) -> f64 {
    let first = flows.iter().filter_map(|flow| Some(flow.span_ticks?.0)).min().unwrap_or_default();
    let last = flows.iter().filter_map(|flow| Some(flow.span_ticks?.1)).max().unwrap_or_default();
    let bits: u64 = flows.iter().map(|flow| flow.bits).sum();
    let rates = flows.first().map(|flow| f64::from(flow.bitrate_bps) / f64::from(flow.tick_hz));
    rates.filter(|_| last > first).map_or(0.0, |rate| bits as f64 * 100.0 / ((last - first) as f64 * rate))
}

/// Sends on each channel of `ways`, and listens where it should be received. The channels are open, and stay
/// open.
pub fn exchange(
    patience: &Patience,
    device: &Device,
    records: &mut Records,
    ways: &[(Channel, Channel)],
    bitrate_bps: u32,
    amount: Amount,
) -> anyhow::Result<Vec<Flow>> {
    let flow = |(from, to): &(Channel, Channel)| Flow {
        from: *from,
        to: *to,
        sent: 0,
        failed: 0,
        heard: 0,
        wrong: 0,
        lost: 0,
        bus_errors: 0,
        next: 0,
        bits: 0,
        bitrate_bps,
        tick_hz: device.hello().tick_hz,
        span_ticks: None,
        behind_us: Vec::new(),
    };
    let mut flows: Vec<Flow> = ways.iter().map(flow).collect();
    let before = device.counters();
    let mut stream = Stream::new(device);
    let started = Instant::now();
    let mut moved = started;
    let mut number = 0;
    'sending: while match amount {
        Amount::Frames(frames) => number < frames,
        Amount::For(time) => started.elapsed() < time,
    } {
        for (from, _) in ways {
            let go_on = |stream: &mut Stream<'_>| {
                take(stream, records, &mut flows, &mut moved);
                moved.elapsed() < PATIENCE && !patience.is_over()
            };
            if stream.push(*from, numbered(*from, number), None, go_on)?.is_none() {
                break 'sending;
            }
        }
        number += 1;
        take(&mut stream, records, &mut flows, &mut moved);
    }
    patience.check()?;
    stream.flush()?;
    while stream.under_way() > 0 && moved.elapsed() < PATIENCE {
        patience.check()?;
        stream.wait(Duration::from_millis(20))?;
        take(&mut stream, records, &mut flows, &mut moved);
    }
    for channel in Channel::ALL {
        device.close_channel(channel)?;
    }
    take(&mut stream, records, &mut flows, &mut moved);
    let after = device.counters();
    for flow in &mut flows {
        // Nothing is proved for the time in which the device was off the bus.
        let lost = |counters: &cantap::device::Counters| {
            let of = &counters.channels[flow.to.index()];
            of.lost() + of.off_bus
        };
        flow.lost = lost(&after) - lost(&before);
        flow.failed += number.saturating_sub(flow.sent + flow.failed);
    }
    Ok(flows)
}

/// Takes ends of transmissions, and received records.
fn take(stream: &mut Stream<'_>, records: &mut Records, flows: &mut [Flow], moved: &mut Instant) {
    for end in stream.take_ended() {
        *moved = Instant::now();
        let Some(flow) = flows.iter_mut().find(|flow| flow.from == end.channel) else { continue };
        match end.result {
            Ok(TraceFrame::Classic(frame)) => flow.confirm(&frame, end.ticks),
            // Nobody here sends one of CAN FD.
            Ok(TraceFrame::Fd(_)) | Err(_) => flow.failed += 1,
        }
    }
    while let Ok(Some(batch)) = records.next_batch(Duration::ZERO)
        && !batch.is_empty()
    {
        for record in &batch {
            hear(record, flows);
        }
        records.recycle(batch);
    }
}

fn hear(record: &TraceRecord, flows: &mut [Flow]) {
    let on = |flow: &&mut Flow| flow.to.number() == record.channel;
    let Some(flow) = flows.iter_mut().find(on) else { return };
    match &record.event {
        TraceEvent::Frame { frame: TraceFrame::Classic(frame), direction: Direction::Rx, .. } => {
            flow.hear(frame);
        }
        TraceEvent::BusError { .. } => flow.bus_errors += 1,
        TraceEvent::ErrorsSuppressed { count } => flow.bus_errors += count,
        _ => {}
    }
}

/// Discards everything that is there: it belongs to the previous step.
pub fn forget(records: &mut Records) {
    while records.next_batch(Duration::ZERO).is_ok_and(|batch| batch.is_some_and(|batch| !batch.is_empty())) {
    }
}
