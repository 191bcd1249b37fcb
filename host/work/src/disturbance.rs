//! Error frames on purpose, at a planned time or onto a periodic frame, by a board that was built for it (`docs/disturb.md`).

mod prediction;

use std::time::Duration;

use anyhow::{bail, ensure};
use cantap::device::{Ticks, UtcNs};
use cantap::wire::message::MAX_DISTURBANCE_BITS;
use cantap::{Channel, Device, Id, TraceEvent, TraceRecord};

use self::prediction::{Expected, Prediction};

/// How long to wait for records before checking whether to go on.
pub const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Least time from a request to its level, so that it arrives in time.
const LEAD_MS: u64 = 20;
/// An error that began by a level is on record within so many bits of its end: the flags of all, and an interrupt's latency.
const ERROR_BITS: u64 = 40;
/// A level that has not been reported this long after its time never will be.
const REPORTED_WITHIN_MS: u64 = 2000;
/// What a level caused is on record within this time, on a bus that is never silent.
const SETTLED_MS: u64 = 100;

/// When.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// From a time after the beginning on, in the device's time, so far from one to the next.
    At {
        /// The first.
        first: Duration,
        /// From one to the next; at least 20 ms.
        every: Duration,
    },
    /// In the middle of periodic frames.
    Onto {
        /// Their identifier.
        id: Id,
        /// Onto which of them first, from 1 since the beginning; `None`: the first whose time can be predicted.
        nth: Option<u64>,
    },
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// The channel, open in normal mode.
    pub channel: Channel,
    /// Its bit rate.
    pub bitrate_bps: u32,
    /// When.
    pub when: When,
    /// For how many bits, 1 to 12.
    pub bits: u8,
    /// How many.
    pub count: u32,
}

/// What became of one disturbance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Disturbance {
    /// Its planned time, in the device's ticks.
    pub at_ticks: u64,
    /// When the level began, in nanoseconds since 1970.
    pub time_ns: i64,
    /// How long it was, in nanoseconds; 0 if it came to nothing.
    pub length_ns: u32,
    /// Bus errors that the device recorded then.
    pub errors: u32,
    /// Onto a frame: how much later than predicted its next one ended, in nanoseconds.
    pub late_ns: Option<i64>,
}

impl Disturbance {
    /// As an object, as `cantap disturb --json` prints it (docs/json.md).
    pub fn json(&self, channel: Channel) -> serde_json::Value {
        let us = |ns: f64| ns / 1000.0;
        serde_json::json!({
            "channel": channel.number(),
            "at_ticks": self.at_ticks,
            "time_s": self.time_ns as f64 / 1e9,
            "length_us": us(f64::from(self.length_ns)),
            "errors": self.errors,
            "late_us": self.late_ns.map(|late_ns| us(late_ns as f64)),
        })
    }
}

/// Where the device's records come from: all of the channel, from before the beginning on.
pub trait Records {
    /// Those within a time, perhaps none; `None` if it is to end.
    ///
    /// # Errors
    ///
    /// The device is gone.
    fn next(&mut self, wait: Duration) -> anyhow::Result<Option<Vec<TraceRecord>>>;
}

/// Permits disturbances until the session ends.
///
/// # Errors
///
/// The device does not disturb a bus.
pub fn unlock(device: &Device, name: &str) -> anyhow::Result<()> {
    if !device.hello().disturbs() {
        bail!(
            "{name} does not disturb a bus: that needs a board of one's own, with a TX pin on a timer, and a firmware built for it (docs/disturb.md); \
             released ones, servers, adapters and the virtual device cannot"
        );
    }
    Ok(device.unlock_disturbances()?)
}

/// Disturbs as planned, after [`unlock`], and passes on what became of each.
///
/// # Errors
///
/// The plan is none, the frame's times cannot be predicted, or the device refuses or is gone.
pub fn disturb(
    device: &Device,
    plan: &Plan,
    records: &mut dyn Records,
    mut each: impl FnMut(&Disturbance) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    ensure!(
        (1..=MAX_DISTURBANCE_BITS).contains(&plan.bits),
        "{} bits is no length: give 1 to {MAX_DISTURBANCE_BITS}",
        plan.bits
    );
    let mut run = Run { plan, device, records, bit_ns: 1_000_000_000 / u64::from(plan.bitrate_bps.max(1)) };
    let per_second = f64::from(device.hello().tick_hz);
    let ticks = |time: Duration| (time.as_secs_f64() * per_second) as u64;
    let began = device.time()?;
    let mut prediction = match plan.when {
        When::Onto { id, .. } => Some(Prediction::new(id, plan.channel.number(), run.bit_ns)),
        When::At { .. } => None,
    };
    for round in 0..u64::from(plan.count) {
        let (at, expected) = match plan.when {
            When::At { first, every } => {
                let every = ticks(every).max(run.ms(LEAD_MS));
                let at = began + ticks(first) + round * every;
                (at.max(device.time()? + run.ms(LEAD_MS)), None)
            }
            When::Onto { nth, .. } => {
                let Some(prediction) = &mut prediction else { break };
                let Some(expected) = run.predict(prediction, nth.filter(|_| round == 0))? else { break };
                (device.clock_map().ticks(UtcNs(expected.middle_ns)).0, Some(expected))
            }
        };
        let Some(outcome) = run.disturb(at, expected.as_ref(), prediction.as_mut())? else { break };
        each(&outcome)?;
    }
    Ok(())
}

struct Run<'a> {
    plan: &'a Plan,
    device: &'a Device,
    records: &'a mut dyn Records,
    bit_ns: u64,
}

impl Run<'_> {
    fn ms(&self, ms: u64) -> u64 {
        ms * u64::from(self.device.hello().tick_hz) / 1000
    }

    /// Waits until the time of the wanted frame can be predicted; `None` if it is to end before.
    fn predict(&mut self, prediction: &mut Prediction, nth: Option<u64>) -> anyhow::Result<Option<Expected>> {
        loop {
            let map = self.device.clock_map();
            let soonest_ns = map.utc(Ticks(self.device.time()? + self.ms(LEAD_MS))).0;
            if let Some(expected) = prediction.next(nth, soonest_ns)? {
                return Ok(Some(expected));
            }
            let Some(batch) = self.records.next(LOOK_EVERY)? else { return Ok(None) };
            for record in &batch {
                prediction.take(record);
            }
        }
    }

    /// One disturbance, and what came of it; `None` if it is to end before.
    fn disturb(
        &mut self,
        at: u64,
        expected: Option<&Expected>,
        mut prediction: Option<&mut Prediction>,
    ) -> anyhow::Result<Option<Disturbance>> {
        let Plan { channel, bits, .. } = *self.plan;
        self.device.disturb(channel, at, bits)?;
        let mut seen: Vec<TraceRecord> = Vec::new();
        let mut outcome: Option<Disturbance> = None;
        let window_ns = ((u64::from(bits) + ERROR_BITS) * self.bit_ns) as i64;
        let next_frame = |record: &TraceRecord, since_ns: i64| {
            let id = expected?.id;
            let frame = record.frame().filter(|frame| frame.id() == id)?;
            (record.channel == channel.number() && !frame.is_remote() && record.time_ns > since_ns)
                .then_some(record.time_ns)
        };
        loop {
            let Some(batch) = self.records.next(LOOK_EVERY)? else { return Ok(outcome) };
            let was_silent = batch.is_empty();
            for record in batch {
                if let Some(prediction) = &mut prediction {
                    prediction.take(&record);
                }
                if record.channel != channel.number() {
                    continue;
                }
                seen.push(record);
                if let TraceEvent::Disturbed { length_ns } = record.event {
                    let time_ns = record.time_ns;
                    outcome =
                        Some(Disturbance { at_ticks: at, time_ns, length_ns, errors: 0, late_ns: None });
                }
            }
            let now = self.device.time()?;
            let Some(known) = &mut outcome else {
                if now > at + self.ms(REPORTED_WITHIN_MS) {
                    bail!("the device has not reported the disturbance; `cantap status` shows how it is");
                }
                continue;
            };
            let during = known.time_ns..=known.time_ns + window_ns;
            let is_error = |record: &&TraceRecord| {
                matches!(record.event, TraceEvent::BusError { .. }) && during.contains(&record.time_ns)
            };
            known.errors = seen.iter().filter(is_error).count() as u32;
            known.late_ns = expected.and_then(|expected| {
                let ended_ns = seen.iter().find_map(|record| next_frame(record, known.time_ns))?;
                Some(ended_ns - expected.end_ns)
            });
            let complete = expected.is_none() || known.late_ns.is_some();
            let patience_ms = if complete { SETTLED_MS } else { REPORTED_WITHIN_MS };
            if complete && was_silent || now > at + self.ms(patience_ms) {
                return Ok(outcome);
            }
        }
    }
}
