//! Watches a controller's errors and fault confinement, and keeps a broken bus from flooding the link.

use cantap_wire::message::RegisterSet;
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{Channel, Event};

use crate::bus::recorder::Recorder;
use crate::ports::{ErrorStatus, Traffic};
use crate::{TICK_HZ, TICKS_PER_MS};

/// How many errors are reported one by one in each [`WINDOW_TICKS`]; a broken bus causes up to 50 000 a
/// second.
const REPORTED_PER_WINDOW: u8 = 20;
/// After this time the number of the remaining errors is reported.
const WINDOW_TICKS: u64 = (TICK_HZ / 10) as u64;

/// Times that the error interrupt may come within [`STORM_WINDOW_TICKS`]. Two errors are at least 14 bit times apart (an error flag and a
/// delimiter), so that at 1 Mbit/s a window has 72 of them, and a few changes of state.
const MOST_CALLS: u8 = 100;
const STORM_WINDOW_TICKS: u32 = TICKS_PER_MS;

/// One channel's errors.
pub struct ErrorMonitor {
    channel: Channel,
    status: ErrorStatus,
    last_error: Option<BusErrorKind>,
    registers: Option<RegisterSet>,
    errors: u32,
    reported: u8,
    suppressed: u32,
    window_ends: u64,
}

/// Notices an error interrupt whose flag is not cleared by clearing it: it would come at once and for ever, and nothing below it would run.
/// By the stamps of the interrupt rather than by the tick, which may be late when there is much to do.
pub(crate) struct StormGuard {
    /// When the window began.
    from: u32,
    /// Calls within it.
    calls: u8,
    held: bool,
    storms: u32,
}

impl StormGuard {
    /// No calls yet.
    pub const fn new() -> Self {
        Self { from: 0, calls: 0, held: false, storms: 0 }
    }

    /// The interrupt came. Returns whether it may come again; if not, it must stay silent until [`Self::take_held`].
    pub fn admits(&mut self, entered: u32) -> bool {
        if entered.wrapping_sub(self.from) >= STORM_WINDOW_TICKS {
            (self.from, self.calls) = (entered, 0);
        }
        self.calls = self.calls.saturating_add(1);
        if self.calls > MOST_CALLS && !self.held {
            self.held = true;
            self.storms = self.storms.wrapping_add(1);
        }
        !self.held
    }

    /// Once a millisecond: whether the interrupt was left silent, and may come again now.
    pub const fn take_held(&mut self) -> bool {
        let held = core::mem::replace(&mut self.held, false);
        if held {
            self.calls = 0;
        }
        held
    }

    /// How often the interrupt was left silent, since the start; wraps.
    pub const fn storms(&self) -> u32 {
        self.storms
    }
}

impl ErrorMonitor {
    /// No errors yet.
    pub const fn new(channel: Channel) -> Self {
        Self {
            channel,
            status: ErrorStatus { kind: None, state: ErrorState::Active, tec: 0, rec: 0 },
            last_error: None,
            registers: None,
            errors: 0,
            reported: 0,
            suppressed: 0,
            window_ends: 0,
        }
    }

    /// The channel.
    pub const fn channel(&self) -> Channel {
        self.channel
    }

    /// Forgets state and errors, as the controller does when it leaves the bus. The count stays.
    pub fn restart(&mut self) {
        *self = Self { errors: self.errors, ..Self::new(self.channel) };
    }

    /// Reads the controller's errors and records what is new. Called by the error interrupt, and once a
    /// millisecond, because a change to a better state raises no interrupt.
    pub fn update<const N: usize>(
        &mut self,
        traffic: &mut impl Traffic,
        recorder: &mut Recorder<'_, N>,
        now: u64,
    ) {
        let channel = self.channel;
        let status = traffic.take_errors();
        let ErrorStatus { kind, state, tec, rec } = status;
        if let Some(kind) = kind {
            self.errors = self.errors.wrapping_add(1);
            self.last_error = Some(kind);
            let reported = self.reported < REPORTED_PER_WINDOW
                && recorder.event(&Event::BusError { channel, kind, tec, rec }, now);
            if reported {
                self.reported += 1;
                self.registers = Some(traffic.registers());
            } else {
                self.suppressed += 1;
            }
        }
        // If there is no room, the next update records the state.
        if state != self.status.state && !recorder.event(&Event::State { channel, state, tec, rec }, now) {
            self.status = ErrorStatus { state: self.status.state, ..status };
        } else {
            self.status = status;
        }
    }

    /// Once a millisecond: opens the next window and reports what the last one suppressed.
    pub fn tick<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) {
        if now >= self.window_ends {
            self.window_ends = now + WINDOW_TICKS;
            self.reported = 0;
            self.flush(recorder, now);
        }
    }

    /// Reports how many errors were suppressed.
    pub fn flush<const N: usize>(&mut self, recorder: &mut Recorder<'_, N>, now: u64) {
        let event = Event::ErrorsSuppressed { channel: self.channel, count: self.suppressed };
        if self.suppressed > 0 && recorder.event(&event, now) {
            self.suppressed = 0;
        }
    }

    /// The last status read.
    pub const fn status(&self) -> ErrorStatus {
        self.status
    }

    /// The last error since the channel was opened.
    pub const fn last_error(&self) -> Option<BusErrorKind> {
        self.last_error
    }

    /// Registers at the last reported error since the channel was opened.
    pub const fn registers(&self) -> Option<RegisterSet> {
        self.registers
    }

    /// Errors counted since `Hello`.
    pub const fn errors(&self) -> u32 {
        self.errors
    }
}

const _: () = assert!(WINDOW_TICKS > TICKS_PER_MS as u64);
