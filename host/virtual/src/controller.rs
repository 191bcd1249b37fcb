//! A model of bxCAN at the level of the firmware's traits: FIFO, mailboxes, modes, fault confinement, filters.
//!
//! One controller has three faces: the firmware's traffic and control sides, and a node on a simulated bus.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use cantap_firmware::CAN_CLOCK_HZ;
use cantap_firmware::bus::filters::Bank;
use cantap_firmware::bus::mailboxes::MAILBOXES;
use cantap_firmware::ports::{Control, ErrorStatus, Outcome, Traffic};
use cantap_wire::Frame;
use cantap_wire::message::{ChannelConfig, Mode, RegisterSet};
use cantap_wire::record::{BusErrorKind, ErrorState};

use crate::simbus::{ErrorCounters, Node};

/// Number of frames that a receive FIFO holds (RM0090 Rev 21 §32.7.3).
const FIFO_FRAMES: usize = 3;

/// What a controller is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Off,
    /// Joins when no frame is on the bus.
    Joining,
    On,
    /// Leaves when no frame is on the bus.
    Leaving,
}

/// The controller's interrupt requests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Interrupts {
    pub receive: bool,
    pub transmit: bool,
    pub error: bool,
}

/// One controller.
pub struct Controller {
    phase: Phase,
    config: Option<ChannelConfig>,
    bitrate_bps: u32,
    filters: Vec<Bank>,
    fifo: VecDeque<Frame>,
    overrun: bool,
    mailboxes: [Option<Frame>; MAILBOXES],
    /// Mailboxes in the order in which they were requested.
    order: VecDeque<u8>,
    /// Written to a mailbox but not requested.
    prepared: Option<Frame>,
    finished: VecDeque<(u8, Outcome)>,
    /// Whether the first of `order` is on the bus.
    sending: bool,
    aborting: bool,
    counters: ErrorCounters,
    error: Option<BusErrorKind>,
    last_error: u32,
    /// It was started while bus-off: entering and leaving initialisation mode begins the recovery.
    is_told_to_recover: bool,
    /// Set when something happened, and cleared by the machine.
    pub interrupts: Interrupts,
    /// Frames on the bus that passed the filters while the controller took part, delivered to the FIFO or not.
    pub heard: u64,
    /// How often it put a dominant level on a bus with other nodes.
    pub driven: u64,
}

impl Controller {
    pub fn new() -> Self {
        Self {
            phase: Phase::Off,
            config: None,
            bitrate_bps: 0,
            filters: vec![Bank::ALL],
            fifo: VecDeque::with_capacity(FIFO_FRAMES),
            overrun: false,
            mailboxes: [None; MAILBOXES],
            order: VecDeque::with_capacity(MAILBOXES),
            prepared: None,
            finished: VecDeque::with_capacity(MAILBOXES),
            sending: false,
            aborting: false,
            counters: ErrorCounters::default(),
            error: None,
            last_error: 0,
            is_told_to_recover: false,
            interrupts: Interrupts::default(),
            heard: 0,
            driven: 0,
        }
    }

    /// Whether it is in a loopback mode without the bus.
    pub fn is_looped(&self) -> bool {
        matches!(self.mode(), Some(Mode::Loopback | Mode::SilentLoopback))
    }

    /// Returns whether they changed.
    pub fn set_filters(&mut self, filters: Vec<Bank>) -> bool {
        let differed = self.filters != filters;
        self.filters = filters;
        differed
    }

    /// Called as time passes: ends bus-off when its time has come.
    pub fn pass(&mut self, now_ns: u64) {
        let is_manual = self.config.is_some_and(|config| config.manual_recovery);
        if self.state() != ErrorState::BusOff
            || self.phase == Phase::Off
            || is_manual && !self.is_told_to_recover
        {
            return;
        }
        if self.counters.recover(now_ns, self.bitrate_bps) {
            self.is_told_to_recover = false;
            self.interrupts.error = true;
        }
    }

    fn clear_errors(&mut self) {
        self.counters = ErrorCounters::default();
        self.is_told_to_recover = false;
    }

    /// Leaves initialisation mode. That does not affect the error counters: only the controller's reset does, and the
    /// sequence that ends bus-off, which begins here (RM0090 Rev 21 §32.7.6).
    fn begin(&mut self) {
        self.counters.restart_recovery();
        self.is_told_to_recover = self.state() == ErrorState::BusOff;
        self.phase = Phase::Joining;
    }

    fn mode(&self) -> Option<Mode> {
        self.config.map(|config| config.mode)
    }

    fn takes_part(&self) -> bool {
        matches!(self.phase, Phase::On | Phase::Leaving)
    }

    fn state(&self) -> ErrorState {
        self.counters.state()
    }

    fn passes(&self, frame: &Frame) -> bool {
        self.filters.iter().any(|bank| bank.passes(frame))
    }

    fn receive_from_bus(&mut self, frame: &Frame) {
        if !self.passes(frame) {
            return;
        }
        self.heard += 1;
        if self.fifo.len() < FIFO_FRAMES {
            self.fifo.push_back(*frame);
        } else {
            self.overrun = true;
        }
        self.interrupts.receive = true;
    }

    fn finish_first(&mut self, outcome: Outcome) {
        if let Some(mailbox) = self.order.pop_front() {
            self.mailboxes[usize::from(mailbox)] = None;
            self.finished.push_back((mailbox, outcome));
            self.interrupts.transmit = true;
        }
    }

    fn abort_waiting(&mut self) {
        let keep = usize::from(self.sending);
        while self.order.len() > keep {
            if let Some(mailbox) = self.order.pop_back() {
                self.mailboxes[usize::from(mailbox)] = None;
                self.finished.push_back((mailbox, Outcome::Aborted));
                self.interrupts.transmit = true;
            }
        }
    }

    fn leave(&mut self) {
        self.phase = Phase::Off;
        self.sending = false;
        self.aborting = false;
        self.abort_waiting();
    }

    fn count_error(&mut self, kind: BusErrorKind, own: bool) {
        self.error = Some(kind);
        self.last_error = error_code(kind);
        self.interrupts.error = true;
        // A silent controller's counters do not change.
        if self.mode().is_some_and(|mode| mode != Mode::ListenOnly) {
            self.counters.count_error(kind, own);
        }
    }
}

impl Node for Controller {
    fn bitrate_bps(&self) -> Option<u32> {
        (self.phase != Phase::Off && self.state() != ErrorState::BusOff).then_some(self.bitrate_bps)
    }

    fn bid(&self) -> Option<Frame> {
        let sends = self.phase == Phase::On && self.state() != ErrorState::BusOff;
        let first = *self.order.front().filter(|_| sends)?;
        self.mailboxes[usize::from(first)]
    }

    fn acknowledges(&self) -> bool {
        // In loopback, the controller is its own receiver.
        self.takes_part() && self.mode().is_some_and(Mode::transmits) || self.is_looped()
    }

    fn destroys(&self) -> bool {
        let is_active = matches!(self.state(), ErrorState::Active | ErrorState::Warning);
        self.takes_part() && is_active && self.mode() == Some(Mode::Normal)
    }

    fn on_start(&mut self) {
        self.sending = true;
        self.driven += u64::from(self.mode() != Some(Mode::SilentLoopback));
    }

    fn on_lost(&mut self) {
        if self.aborting {
            self.aborting = false;
            self.finish_first(Outcome::Aborted);
        } else if self.config.is_some_and(|config| config.one_shot) {
            self.finish_first(Outcome::ArbitrationLost);
        }
    }

    fn on_frame(&mut self, frame: &Frame, own: bool) {
        if !self.takes_part() {
            return;
        }
        if own {
            self.sending = false;
            self.aborting = false;
            self.counters.count_sent();
            self.finish_first(Outcome::Sent);
        } else {
            // It acknowledges, whatever its filters.
            self.driven += u64::from(self.mode() == Some(Mode::Normal));
            self.counters.count_received();
        }
        if !own || self.is_looped() {
            self.receive_from_bus(frame);
        }
    }

    fn on_error(&mut self, kind: BusErrorKind, own: bool) {
        if !self.takes_part() {
            return;
        }
        // The flag of an error-active controller is dominant.
        self.driven += u64::from(self.destroys());
        self.count_error(kind, own);
        if own {
            self.sending = false;
            let one_shot = self.config.is_some_and(|config| config.one_shot);
            if std::mem::take(&mut self.aborting) {
                self.finish_first(Outcome::Aborted);
            } else if one_shot {
                // Otherwise the mailbox waits, even through bus-off (RM0090 Rev 21 §32.7.1: it is emptied by success or
                // abort).
                self.finish_first(Outcome::Error);
            }
        }
    }

    fn on_boundary(&mut self) {
        match self.phase {
            Phase::Joining => self.phase = Phase::On,
            Phase::Leaving => self.leave(),
            Phase::On | Phase::Off => {}
        }
    }
}

/// The firmware's traffic side of a controller.
pub struct TrafficSide(pub Rc<RefCell<Controller>>);

impl Traffic for TrafficSide {
    fn pending(&self) -> u8 {
        self.0.borrow().fifo.len() as u8
    }

    fn front(&self) -> Option<Frame> {
        self.0.borrow().fifo.front().copied()
    }

    fn receive(&mut self) -> Option<Frame> {
        self.0.borrow_mut().fifo.pop_front()
    }

    fn take_overrun(&mut self) -> bool {
        std::mem::take(&mut self.0.borrow_mut().overrun)
    }

    fn prepare(&mut self, frame: &Frame) -> Option<u8> {
        let mut controller = self.0.borrow_mut();
        let taken = |mailbox: usize| {
            controller.mailboxes[mailbox].is_some()
                || controller.finished.iter().any(|(finished, _)| usize::from(*finished) == mailbox)
        };
        let free = (0..MAILBOXES).find(|mailbox| !taken(*mailbox))?;
        controller.prepared = Some(*frame);
        Some(free as u8)
    }

    fn request(&mut self, mailbox: u8) {
        let mut controller = self.0.borrow_mut();
        controller.mailboxes[usize::from(mailbox)] = controller.prepared.take();
        controller.order.push_back(mailbox);
    }

    fn take_finished(&mut self) -> Option<(u8, Outcome)> {
        self.0.borrow_mut().finished.pop_front()
    }

    fn abort(&mut self) {
        let mut controller = self.0.borrow_mut();
        controller.aborting = controller.sending;
        controller.abort_waiting();
    }

    fn take_errors(&mut self) -> ErrorStatus {
        let mut controller = self.0.borrow_mut();
        let (tec, rec) = controller.counters.values();
        ErrorStatus { kind: controller.error.take(), state: controller.state(), tec, rec }
    }

    fn registers(&self) -> RegisterSet {
        let controller = self.0.borrow();
        let state = controller.state();
        let (tec, rec) = controller.counters.values();
        // RM0090 Rev 21 §32.9.2; only the parts that this model has.
        let esr = u32::from(state >= ErrorState::Warning)
            | u32::from(state >= ErrorState::Passive) << 1
            | u32::from(state == ErrorState::BusOff) << 2
            | controller.last_error << 4
            | u32::from(tec) << 16
            | u32::from(rec) << 24;
        let rf0r = controller.fifo.len() as u32 | u32::from(controller.overrun) << 4;
        let stopped = u32::from(controller.phase == Phase::Off);
        let btr = controller.config.map_or(0, |config| {
            let timing = config.timing;
            let (silent, looped) = match config.mode {
                Mode::Normal => (0, 0),
                Mode::ListenOnly => (1, 0),
                Mode::Loopback => (0, 1),
                Mode::SilentLoopback => (1, 1),
            };
            silent << 31
                | looped << 30
                | u32::from(timing.jump_width - 1) << 24
                | u32::from(timing.segment2 - 1) << 20
                | u32::from(timing.segment1 - 1) << 16
                | u32::from(timing.prescaler - 1)
        });
        RegisterSet { mcr: stopped, msr: stopped, rf0r, esr, btr, ..RegisterSet::default() }
    }
}

/// The firmware's control side of a controller.
pub struct ControlSide(pub Rc<RefCell<Controller>>);

impl Control for ControlSide {
    fn stop(&mut self) {
        let mut controller = self.0.borrow_mut();
        match controller.phase {
            Phase::On => controller.phase = Phase::Leaving,
            Phase::Joining => controller.phase = Phase::Off,
            Phase::Off | Phase::Leaving => {}
        }
    }

    /// Uses the controller's own reset, which clears its error counters.
    fn halt(&mut self) {
        let mut controller = self.0.borrow_mut();
        controller.leave();
        controller.clear_errors();
    }

    fn is_stopped(&self) -> bool {
        self.0.borrow().phase == Phase::Off
    }

    fn start(&mut self, config: &ChannelConfig) {
        let mut controller = self.0.borrow_mut();
        controller.bitrate_bps = config.timing.bitrate_bps(CAN_CLOCK_HZ);
        controller.config = Some(*config);
        controller.fifo.clear();
        controller.overrun = false;
        controller.error = None;
        controller.begin();
    }

    fn resume(&mut self) {
        self.0.borrow_mut().begin();
    }
}

/// The last-error code of bxCAN's ESR (RM0090 Rev 21 §32.9.2).
const fn error_code(kind: BusErrorKind) -> u32 {
    match kind {
        BusErrorKind::Stuff => 1,
        BusErrorKind::Form => 2,
        BusErrorKind::Acknowledgment => 3,
        BusErrorKind::BitRecessive => 4,
        BusErrorKind::BitDominant => 5,
        BusErrorKind::Crc => 6,
    }
}
