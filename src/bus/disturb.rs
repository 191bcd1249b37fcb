//! Error frames on purpose: the bus is driven dominant for a few bits at a planned time.
//!
//! In a build for the chip only with the feature `disturb`. The level is the hardware's ([`PulseTimer`]): a timer begins it at its tick and ends
//! it, whatever the processor does. This decides whether there may be one, connects the timer to the pin just before, and the controller
//! just after. In between, the controller neither acknowledges nor flags errors; it still receives, so nothing is lost by it.

use cantap_wire::message::{
    ChannelConfig, DISTURBANCE_LEAD_TICKS, DISTURBANCE_PAUSE_TICKS, DISTURBANCE_WORD, MAX_DISTURBANCE_BITS,
    Mode,
};
use cantap_wire::{Channel, Event, Refusal};

use crate::bus::capture::Capture;
use crate::ports::{Clock, PulseTimer};
use crate::{CAN_CLOCK_HZ, TICK_HZ, TICKS_PER_MS, TICKS_PER_US};

/// How far ahead a time may be: a day, as for frames.
const MAX_AHEAD_TICKS: u64 = 24 * 3600 * TICK_HZ as u64;
/// The alarm comes this early: as early as that for frames, and for the same reason (`hw/stamp.rs`).
const EARLY_TICKS: u64 = 14 * TICKS_PER_US as u64;
/// The pin is connected so long before the level begins: 3 µs.
const CONNECT_TICKS: u64 = 3 * TICKS_PER_US as u64;
/// If there is less time than this, it is not: interrupts that stamp may come in between, for less than a microsecond each.
const LEAST_TICKS: u64 = 2 * TICKS_PER_US as u64;
/// An alarm is never set farther ahead, a quarter of the timer's range. When it fires, the next one is set.
const ALARM_AHEAD_TICKS: u64 = 1 << 30;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Planned {
    channel: Channel,
    at: u64,
    ticks: u16,
    /// The timer is connected to the pin.
    connected: bool,
}

/// What may be driven, and what is planned. Belongs to the tasks of priority 4.
#[derive(Debug, Default)]
pub struct Disturber {
    unlocked: bool,
    planned: Option<Planned>,
    /// When the last one was planned for.
    last: Option<u64>,
    /// A record for which the queue had no room.
    owed: Option<(Event, u64)>,
}

impl Disturber {
    /// Locked, with nothing planned.
    pub const fn new() -> Self {
        Self { unlocked: false, planned: None, last: None, owed: None }
    }

    /// Permits disturbances until [`Self::lock`], if the word is right.
    pub fn unlock(&mut self, word: u32) -> Result<(), Refusal> {
        if word != DISTURBANCE_WORD {
            return Err(Refusal::DisturbanceLocked);
        }
        self.unlocked = true;
        Ok(())
    }

    /// The session ends: nothing more is driven, and nothing is owed to anyone.
    pub fn lock(&mut self, pulse: &mut dyn PulseTimer) {
        self.unlocked = false;
        self.owed = None;
        if self.planned.take().is_some() {
            pulse.set_alarm(None);
            pulse.disconnect();
        }
    }

    /// A channel leaves its bus: what is planned for it is dropped; what has begun ends, and is recorded.
    pub fn leave<const N: usize>(
        &mut self,
        channel: Channel,
        pulse: &mut dyn PulseTimer,
        capture: &mut Capture<'_, N>,
        clock: &impl Clock,
    ) {
        if let Some(planned) = self.planned.take_if(|planned| planned.channel == channel) {
            let began = pulse.disconnect();
            let now = capture.now(clock);
            let ticks = if began { now.saturating_sub(planned.at).min(planned.ticks.into()) } else { 0 };
            self.record(channel, ticks as u16, planned.at.min(now), pulse, capture, now);
        }
    }

    /// Plans a level on a channel that was opened with `config`, from `at` on and for `bits` bits.
    pub fn plan(
        &mut self,
        (channel, config): (Channel, Option<&ChannelConfig>),
        at: u64,
        bits: u8,
        pulse: &mut dyn PulseTimer,
        now: u64,
    ) -> Result<(), Refusal> {
        if !pulse.reaches(channel) {
            return Err(Refusal::Unsupported);
        }
        if !self.unlocked {
            return Err(Refusal::DisturbanceLocked);
        }
        let config = config.ok_or(Refusal::ChannelClosed)?;
        match config.mode {
            Mode::Normal => {}
            Mode::ListenOnly => return Err(Refusal::ListenOnly),
            _ => return Err(Refusal::NotNormal),
        }
        if !(1..=MAX_DISTURBANCE_BITS).contains(&bits) {
            return Err(Refusal::BadEntry);
        }
        if at < now + u64::from(DISTURBANCE_LEAD_TICKS) {
            return Err(Refusal::TooLate);
        }
        if at > now + MAX_AHEAD_TICKS {
            return Err(Refusal::TooFarAhead);
        }
        let pause = u64::from(DISTURBANCE_PAUSE_TICKS);
        if self.planned.is_some() || self.last.is_some_and(|last| at < last + pause) {
            return Err(Refusal::TooOften);
        }
        let clocks = u32::from(config.timing.prescaler)
            * (1 + u32::from(config.timing.segment1) + u32::from(config.timing.segment2));
        // At most 12 bits of 5 kbit/s: 28,800 ticks.
        let ticks = (clocks * u32::from(bits) / (CAN_CLOCK_HZ / TICK_HZ)) as u16;
        self.planned = Some(Planned { channel, at, ticks, connected: false });
        self.last = Some(at);
        Self::arm(at - EARLY_TICKS, now, pulse);
        Ok(())
    }

    /// The alarm, or any other call of its task.
    pub fn on_alarm<const N: usize>(
        &mut self,
        pulse: &mut dyn PulseTimer,
        capture: &mut Capture<'_, N>,
        clock: &impl Clock,
    ) {
        let now = capture.now(clock);
        if let Some((event, at)) = self.owed.take() {
            self.write(event, at, pulse, capture, now);
        }
        let Some(planned) = self.planned else { return };
        // One tick for the timer that takes the trigger.
        let end = planned.at + u64::from(planned.ticks) + 1;
        if planned.connected {
            if now < end {
                return Self::arm(end, now, pulse);
            }
            let ticks = if pulse.disconnect() { planned.ticks } else { 0 };
            self.planned = None;
            self.record(planned.channel, ticks, planned.at, pulse, capture, now);
        } else if now + EARLY_TICKS < planned.at {
            Self::arm(planned.at - EARLY_TICKS, now, pulse);
        } else {
            pulse.prepare(planned.channel, planned.at as u32, planned.ticks);
            if now + CONNECT_TICKS < planned.at {
                clock.wait_until((planned.at - CONNECT_TICKS) as u32);
            }
            if capture.now(clock) + LEAST_TICKS > planned.at {
                // Other tasks have taken too long.
                pulse.disconnect();
                self.planned = None;
                return self.record(planned.channel, 0, planned.at, pulse, capture, now);
            }
            pulse.connect(planned.channel);
            self.planned = Some(Planned { connected: true, ..planned });
            Self::arm(end, now, pulse);
        }
    }

    fn record<const N: usize>(
        &mut self,
        channel: Channel,
        ticks: u16,
        at: u64,
        pulse: &mut dyn PulseTimer,
        capture: &mut Capture<'_, N>,
        now: u64,
    ) {
        self.write(Event::Disturbed { channel, ticks }, at, pulse, capture, now);
    }

    /// Writes a record, or tries again in a millisecond.
    fn write<const N: usize>(
        &mut self,
        event: Event,
        at: u64,
        pulse: &mut dyn PulseTimer,
        capture: &mut Capture<'_, N>,
        now: u64,
    ) {
        if !capture.disturbed(&event, at) {
            self.owed = Some((event, at));
            Self::arm(now + u64::from(TICKS_PER_MS), now, pulse);
        }
    }

    fn arm(at: u64, now: u64, pulse: &mut dyn PulseTimer) {
        pulse.set_alarm(Some(at.clamp(now, now + ALARM_AHEAD_TICKS) as u32));
    }
}
