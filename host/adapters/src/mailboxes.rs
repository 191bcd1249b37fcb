//! The firmware's view of an adapter's channel: three mailboxes and an error status.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use cantap_firmware::bus::mailboxes::MAILBOXES;
use cantap_firmware::ports::{Control, ErrorStatus, Outcome, Traffic};
use cantap_trace::TraceFrame;
use cantap_wire::message::{ChannelConfig, RegisterSet};
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{FdFrame, Frame};

/// Whether a channel takes part in its bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    /// It does not.
    Off,
    /// The adapter has opened it, and the firmware is about to start it.
    Opened,
    /// It does.
    On,
    /// The engine is to close it.
    Leaving,
}

/// One channel, shared by the firmware's two sides and the engine.
pub(crate) struct Mailboxes {
    pub phase: Phase,
    prepared: Option<TraceFrame>,
    /// Requested, and not yet taken by the adapter.
    pub waiting: VecDeque<(u8, TraceFrame)>,
    /// Taken by the adapter, and not yet confirmed.
    handed: [bool; MAILBOXES],
    finished: VecDeque<(u8, Outcome)>,
    pub error: Option<BusErrorKind>,
    pub state: ErrorState,
    pub counters: (u8, u8),
}

impl Mailboxes {
    pub const fn new() -> Self {
        Self {
            phase: Phase::Off,
            prepared: None,
            waiting: VecDeque::new(),
            handed: [false; MAILBOXES],
            finished: VecDeque::new(),
            error: None,
            state: ErrorState::Active,
            counters: (0, 0),
        }
    }

    /// The adapter has taken the first waiting frame.
    pub fn taken(&mut self) {
        if let Some((mailbox, _)) = self.waiting.pop_front() {
            self.handed[usize::from(mailbox)] = true;
        }
    }

    /// Whether the adapter has frames that it has not confirmed.
    pub fn has_handed(&self) -> bool {
        self.handed.iter().any(|handed| *handed)
    }

    /// A frame has ended. Returns false if there is no such frame: an adapter may confirm what it was not given.
    pub fn finish(&mut self, mailbox: u8, outcome: Outcome) -> bool {
        let Some(handed) = self.handed.get_mut(usize::from(mailbox)).filter(|handed| **handed) else {
            return false;
        };
        *handed = false;
        self.finished.push_back((mailbox, outcome));
        true
    }

    /// Keeps a frame for the mailbox returned, if one is free.
    fn prepare(&mut self, frame: TraceFrame) -> Option<u8> {
        let taken = |mailbox: u8| {
            self.handed[usize::from(mailbox)]
                || self.waiting.iter().any(|(waiting, _)| *waiting == mailbox)
                || self.finished.iter().any(|(finished, _)| *finished == mailbox)
        };
        let free = (0..MAILBOXES as u8).find(|mailbox| !taken(*mailbox))?;
        self.prepared = Some(frame);
        Some(free)
    }

    /// Whether the firmware must collect what has ended.
    pub fn has_finished(&self) -> bool {
        !self.finished.is_empty()
    }

    /// The channel is off: nothing that it was given will be confirmed.
    pub fn switch_off(&mut self) {
        self.phase = Phase::Off;
        for mailbox in 0..MAILBOXES as u8 {
            self.finish(mailbox, Outcome::Aborted);
        }
        self.abort_waiting();
        (self.state, self.counters, self.error) = (ErrorState::Active, (0, 0), None);
    }

    fn abort_waiting(&mut self) {
        for (mailbox, _) in self.waiting.drain(..) {
            self.finished.push_back((mailbox, Outcome::Aborted));
        }
    }
}

/// What the firmware receives and sends through. Received frames do not pass it: they have stamps of their own.
pub(crate) struct TrafficSide(pub Rc<RefCell<Mailboxes>>);

impl Traffic for TrafficSide {
    fn pending(&self) -> u8 {
        0
    }

    fn front(&self) -> Option<Frame> {
        None
    }

    fn receive(&mut self) -> Option<Frame> {
        None
    }

    fn take_overrun(&mut self) -> bool {
        false
    }

    fn prepare(&mut self, frame: &Frame) -> Option<u8> {
        self.0.borrow_mut().prepare((*frame).into())
    }

    fn prepare_fd(&mut self, frame: &FdFrame) -> Option<u8> {
        self.0.borrow_mut().prepare((*frame).into())
    }

    fn request(&mut self, mailbox: u8) {
        let mut boxes = self.0.borrow_mut();
        if let Some(frame) = boxes.prepared.take() {
            boxes.waiting.push_back((mailbox, frame));
        }
    }

    fn take_finished(&mut self) -> Option<(u8, Outcome)> {
        self.0.borrow_mut().finished.pop_front()
    }

    fn abort(&mut self) {
        self.0.borrow_mut().abort_waiting();
    }

    fn take_errors(&mut self) -> ErrorStatus {
        let mut boxes = self.0.borrow_mut();
        let (tec, rec) = boxes.counters;
        ErrorStatus { kind: boxes.error.take(), state: boxes.state, tec, rec }
    }

    fn registers(&self) -> RegisterSet {
        RegisterSet::default()
    }
}

/// What the firmware switches channels with. The adapter itself is asked by the engine.
pub(crate) struct ControlSide(pub Rc<RefCell<Mailboxes>>);

impl Control for ControlSide {
    fn stop(&mut self) {
        let mut boxes = self.0.borrow_mut();
        if boxes.phase == Phase::On {
            boxes.phase = Phase::Leaving;
        }
    }

    /// Only the engine can close a channel, and it does so in bounded time.
    fn halt(&mut self) {
        self.stop();
    }

    fn is_stopped(&self) -> bool {
        matches!(self.0.borrow().phase, Phase::Off | Phase::Opened)
    }

    fn start(&mut self, _config: &ChannelConfig) {
        self.0.borrow_mut().phase = Phase::On;
    }

    fn resume(&mut self) {
        self.0.borrow_mut().phase = Phase::On;
    }
}
