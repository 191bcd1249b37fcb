//! A node's controller on a simulated bus.

use std::collections::VecDeque;

use cantap_can::{BusErrorKind, ErrorState, Frame};
use cantap_virtual::simbus::{ErrorCounters, Node as BusNode};

/// A script's controller on one bus, or the caller's.
pub struct Attached {
    /// The bit rate of both.
    pub bitrate_bps: u32,
    /// Each frame, and the handle of its repetition if it is a repeated one.
    pub to_send: VecDeque<(Frame, Option<u32>)>,
    /// Whether the first of them is on the bus.
    is_sending: bool,
    counters: ErrorCounters,
    /// As last seen.
    state: ErrorState,
    is_powered: bool,
    takes_part: bool,
    /// Its frames are destroyed until it is bus-off.
    is_disturbed: bool,
    /// What it has seen since it was last asked, in order.
    seen: Vec<Sighting>,
}

/// What a controller sees of its bus, with its transmit and receive error counters after it.
#[derive(Clone, Copy, Debug)]
pub enum Sighting {
    /// A frame ended well.
    Frame(Frame, Whose),
    /// One was destroyed.
    Error(BusErrorKind, (u8, u8)),
    /// The controller's state is another one.
    State(ErrorState, (u8, u8)),
}

/// Who sent a frame, for a script's controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Whose {
    Others,
    Own,
    /// Its own too, but not one that the script waits to see confirmed.
    Repeated,
}

impl Attached {
    pub const fn new(bitrate_bps: u32) -> Self {
        Self {
            bitrate_bps,
            to_send: VecDeque::new(),
            is_sending: false,
            counters: ErrorCounters::NEW,
            state: ErrorState::Active,
            is_powered: true,
            takes_part: true,
            is_disturbed: false,
            seen: Vec::new(),
        }
    }

    /// Whether a repetition's last frame has not been sent yet.
    pub fn holds(&self, handle: u32) -> bool {
        self.to_send.iter().any(|(_, of)| *of == Some(handle))
    }

    /// What is not on the bus yet is not sent; returns how many frames that were.
    pub fn drop_waiting(&mut self) -> usize {
        let kept = usize::from(self.is_sending);
        let dropped = self.to_send.len().saturating_sub(kept);
        self.to_send.truncate(kept);
        dropped
    }

    pub fn take_seen(&mut self) -> Vec<Sighting> {
        std::mem::take(&mut self.seen)
    }

    /// Without power, it leaves the bus, and with it, it joins, when no frame is on it: now, if it is free.
    pub fn set_power(&mut self, is_powered: bool, is_free: bool) {
        self.is_powered = is_powered;
        self.is_disturbed = false;
        self.counters = ErrorCounters::NEW;
        self.state = ErrorState::Active;
        if is_free {
            self.on_boundary();
        }
    }

    /// From its next frame on, they are destroyed until it is bus-off.
    pub const fn disturb(&mut self) {
        self.is_disturbed = true;
    }

    /// When its bus-off ends, if it is that.
    pub fn recovers_at_ns(&mut self, now_ns: u64) -> Option<u64> {
        self.counters.recovers_at_ns(now_ns, self.bitrate_bps)
    }

    /// Ends bus-off if its time has come.
    pub fn recover(&mut self, now_ns: u64, is_free: bool) {
        if self.counters.recover(now_ns, self.bitrate_bps) {
            self.note_state();
            if is_free {
                self.on_boundary();
            }
        }
    }

    fn note_state(&mut self) {
        let state = self.counters.state();
        if state != self.state {
            self.state = state;
            self.seen.push(Sighting::State(state, self.counters.values()));
            self.is_disturbed &= state != ErrorState::BusOff;
        }
    }
}

impl BusNode for Attached {
    fn bitrate_bps(&self) -> Option<u32> {
        self.takes_part.then_some(self.bitrate_bps)
    }

    fn bid(&self) -> Option<Frame> {
        self.to_send.front().filter(|_| self.takes_part).map(|(frame, _)| *frame)
    }

    fn acknowledges(&self) -> bool {
        self.takes_part
    }

    fn destroys(&self) -> bool {
        false
    }

    fn is_disturbed(&self) -> bool {
        self.is_disturbed
    }

    fn on_start(&mut self) {
        self.is_sending = true;
    }

    fn on_lost(&mut self) {}

    fn on_frame(&mut self, frame: &Frame, own: bool) {
        let sent = if own { self.to_send.pop_front() } else { None };
        self.is_sending &= !own;
        let whose = match (own, sent) {
            (false, _) => Whose::Others,
            (true, Some((_, Some(_)))) => Whose::Repeated,
            (true, _) => Whose::Own,
        };
        if own {
            self.counters.count_sent();
        } else {
            self.counters.count_received();
        }
        self.seen.push(Sighting::Frame(*frame, whose));
        self.note_state();
    }

    fn on_error(&mut self, kind: BusErrorKind, own: bool) {
        self.is_sending &= !own;
        self.counters.count_error(kind, own);
        self.seen.push(Sighting::Error(kind, self.counters.values()));
        self.note_state();
    }

    fn on_boundary(&mut self) {
        self.takes_part = self.is_powered && self.counters.state() != ErrorState::BusOff;
    }
}
