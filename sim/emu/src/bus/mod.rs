//! A CAN bus at bit granularity in time: the emulated controllers and simulated nodes on it, arbitration,
//! acknowledgement, errors, and the true list of everything that crossed it.
//!
//! A frame's fate is worked out when it starts ([`outcome`]) and happens at the right bits. Not
//! modelled: overload frames, and two senders of different bit rates that start at the same instant
//! (the second waits).

pub mod bits;
mod driven;
pub mod node;
pub mod outcome;
pub mod sampling;
mod start;
mod waveform;

use std::collections::VecDeque;

use cantap_can::BusErrorKind;
use cantap_can::Frame;
use fastrand::Rng;

use crate::can::fault::ErrorCounters;
use crate::can::{CanPair, Mode};
use bits::FrameBits;
use driven::Outside;
pub use node::{BitTime, Node, Source};
pub use outcome::Disturbance;
use outcome::{Detection, Participant};
pub use waveform::Edge;
use waveform::Waveform;

/// Recessive bits after which a node may take part. Recovery from bus-off takes 128 such sequences.
const SYNC_BITS: u64 = 11;
/// Bits that a simulated node in bus-off waits.
const RECOVERY_BITS: u64 = 128 * SYNC_BITS;
/// Bits that an error-passive node waits before it sends again.
const SUSPEND_BITS: u64 = 8;

/// Who sent a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Member {
    /// The emulated controller: 0 for CAN1, 1 for CAN2.
    Controller(usize),
    /// The simulated node with this number.
    Node(usize),
}

/// A frame that crossed the bus, or tried to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusFrame {
    /// Who sent it.
    pub sender: Member,
    /// The frame.
    pub frame: Frame,
    /// Core cycle of the start of frame's first edge.
    pub start: u64,
    /// Core cycle at which receivers take it: the end of the last but one bit of the end of frame.
    pub valid: u64,
    /// Core cycle of the end of the last bit of the end of frame.
    pub end: u64,
    /// How it failed for its sender, if it did.
    pub error: Option<BusErrorKind>,
    /// Which controllers received it without error (bit 0 CAN1, bit 1 CAN2), before their filters.
    pub taken_by: u8,
}

/// Something due at a certain moment of the frame under way.
#[derive(Clone, Copy, Debug)]
enum Step {
    LoseArbitration(Member),
    Error(Member, bool, Detection),
    Receive,
    Finish,
}

struct Flight {
    /// `None` if nobody sends: a level from outside began it.
    sender: Option<Member>,
    /// Members that send exactly the same frame at the same time.
    twins: Vec<Member>,
    frame: Frame,
    bits: Option<FrameBits>,
    /// Everyone who takes part, the sender first; and what each does.
    members: Vec<Member>,
    participants: Vec<Participant>,
    /// Dominant bits of each that are counted already.
    driven: Vec<u64>,
    start: u64,
    valid: u64,
    end: u64,
    free: u64,
    recessive: u64,
    error: Option<BusErrorKind>,
    bit: BitTime,
    receivers: Vec<Member>,
    taken_by: u8,
    steps: VecDeque<(u64, Step)>,
}

/// One bus.
pub struct Wire {
    attached: Vec<usize>,
    nodes: Vec<Node>,
    now: u64,
    /// The cycle from which a frame may start.
    free: u64,
    /// The cycle since which the bus has been recessive, apart from a frame under way.
    recessive: u64,
    flight: Option<Flight>,
    stuck: Option<Stuck>,
    disturbances: VecDeque<(u64, Disturbance)>,
    /// Share of the frames that are destroyed, 0 to 1, and the random numbers that decide which.
    noise: (f64, Rng),
    started: u64,
    history: Vec<BusFrame>,
    waveform: Waveform,
    outside: Outside,
}

/// A bus held dominant: when its listeners count the next error.
struct Stuck {
    next_error: u64,
}

impl Wire {
    /// A bus with these controllers on it (0 for CAN1, 1 for CAN2) and no other node.
    pub fn new(attached: &[usize]) -> Self {
        Self {
            attached: attached.to_vec(),
            nodes: Vec::new(),
            now: 0,
            free: 0,
            recessive: 0,
            flight: None,
            stuck: None,
            disturbances: VecDeque::new(),
            noise: (0.0, Rng::with_seed(0)),
            started: 0,
            history: Vec::new(),
            waveform: Waveform::default(),
            outside: Outside::default(),
        }
    }

    /// Puts a node on the bus; returns its number.
    pub fn add(&mut self, mut node: Node) -> usize {
        node.refill();
        self.nodes.push(node);
        self.nodes.len() - 1
    }

    /// A node.
    pub fn node(&mut self, number: usize) -> &mut Node {
        &mut self.nodes[number]
    }

    /// The emulated controllers on it.
    pub fn controllers(&self) -> &[usize] {
        &self.attached
    }

    /// How many nodes there are.
    pub fn node_count(&self) -> usize {
        self.nodes.len()
    }

    /// Everything that crossed the bus and was not taken out, in order.
    pub fn history(&self) -> &[BusFrame] {
        &self.history
    }

    /// Takes the history out, so that a long run needs little memory.
    pub fn take_history(&mut self) -> Vec<BusFrame> {
        std::mem::take(&mut self.history)
    }

    /// Makes edges to recessive come this many core cycles late, as on a bus with high capacitance.
    pub fn slow_recessive(&mut self, cycles: u64) {
        self.waveform.slow_recessive = cycles;
    }

    /// When the level next changes, if that is known.
    pub fn next_edge(&self) -> Option<u64> {
        self.waveform.next().map(|edge| edge.at)
    }

    /// The next edge whose time has come; each is returned once.
    pub fn pass_edge(&mut self, now: u64) -> Option<Edge> {
        self.waveform.pass(now)
    }

    /// Destroys a share of all frames from now on, 0 to 1, each at a bit determined by `seed`.
    pub fn make_noise(&mut self, share: f64, seed: u64) {
        self.noise = (share, Rng::with_seed(seed));
    }

    /// Disturbs one frame, after `frames` more have passed.
    pub fn disturb(&mut self, frames: u64, disturbance: Disturbance) {
        self.disturbances.push_back((self.started + frames, disturbance));
        self.disturbances.make_contiguous().sort_by_key(|(frame, _)| *frame);
    }

    /// Holds the bus dominant, or releases it. A frame under way is destroyed.
    pub fn hold_dominant(&mut self, hold: bool, can: &mut CanPair) {
        let bit = self.listener_bit(can);
        if hold && self.stuck.is_none() {
            self.abort_flight(can);
            self.waveform.hold(self.now, true);
            // Six dominant bits are a stuff error.
            self.stuck = Some(Stuck { next_error: self.now + bit.cycles(6) });
            // An error frame ends with eight recessive bits: until then a controller is busy and does not leave the bus on
            // request.
            for n in &self.attached {
                can.controllers[*n].bus_stuck();
            }
        } else if !hold && self.stuck.take().is_some() {
            self.waveform.hold(self.now, false);
            self.recessive = self.now;
            self.free = self.now + bit.cycles(SYNC_BITS);
            for n in &self.attached {
                can.controllers[*n].bus_free();
            }
        }
    }

    /// Something other than the controllers and nodes drives the bus dominant from cycle `at` on, or no longer does. Unlike
    /// [`Self::hold_dominant`] it becomes part of the frame under way, bit by bit; on an idle bus it is a start of frame.
    pub fn drive(&mut self, dominant: bool, at: u64, can: &mut CanPair) {
        if !self.outside.drive(dominant, at) {
            return;
        }
        if self.stuck.is_some() {
            self.hold_dominant(dominant, can);
        } else if self.flight.is_some() {
            self.replan(can);
        } else if dominant {
            self.start_driven(at, can);
        } else {
            self.outside.forget_past();
        }
    }

    /// A controller's pin is connected to something else from cycle `at` on, or to the controller again: what it sends does not
    /// reach the bus meanwhile, and it still hears everything.
    pub fn cut(&mut self, controller: usize, cut: bool, at: u64, can: &mut CanPair) {
        if !self.outside.cut(controller, cut, at) {
            return;
        }
        if self.flight.is_some() {
            self.replan(can);
        } else {
            self.outside.forget_past();
        }
    }

    /// When [`Self::advance`] must be called next.
    pub fn next_event(&self, can: &CanPair) -> Option<u64> {
        if let Some(stuck) = &self.stuck {
            return Some(stuck.next_error);
        }
        if let Some(flight) = &self.flight {
            return flight.steps.front().map(|(at, _)| *at);
        }
        let waking = self.attached.iter().filter_map(|n| self.waking(*n, can));
        let sending = self.members().filter_map(|member| Some(self.wants(member, can)?.0));
        waking.chain(sending).min()
    }

    /// Processes everything that is due at or before `now`.
    pub fn advance(&mut self, now: u64, can: &mut CanPair) {
        while let Some(due) = self.next_event(can).filter(|due| *due <= now) {
            self.now = self.now.max(due);
            if self.stuck.is_some() {
                self.stuck_error(can);
            } else if self.flight.is_some() {
                self.next_step(can);
            } else if !self.wake(can) {
                self.start_frame(can);
            }
        }
        self.now = self.now.max(now);
    }

    fn members(&self) -> impl Iterator<Item = Member> + use<'_> {
        let controllers = self.attached.iter().map(|n| Member::Controller(*n));
        controllers.chain((0..self.nodes.len()).map(Member::Node))
    }

    /// When a controller that waits for eleven recessive bits, or for the end of bus-off, has seen them.
    fn waking(&self, n: usize, can: &CanPair) -> Option<u64> {
        let controller = &can.controllers[n];
        let bit = controller.timing().bit();
        match controller.mode() {
            Mode::Synchronising { since } => Some(since.max(self.recessive) + SYNC_BITS * bit),
            Mode::BusOff { left: Some(left), since } => {
                Some(since.max(self.recessive) + u64::from(left) * SYNC_BITS * bit)
            }
            _ => None,
        }
    }

    /// Lets the controllers whose time has come take part; returns whether there was one.
    fn wake(&mut self, can: &mut CanPair) -> bool {
        let mut woke = false;
        for n in self.attached.clone() {
            if self.waking(n, can).is_some_and(|due| due <= self.now) {
                can.controllers[n].synchronised();
                can.controllers[n].recover(u32::MAX);
                woke = true;
            }
        }
        woke
    }

    /// What a member wants to send, and when it can.
    fn wants(&self, member: Member, can: &CanPair) -> Option<(u64, Frame)> {
        match member {
            Member::Controller(n) => {
                let frame = can.controllers[n].next_frame()?;
                let pause = if can.controllers[n].counters().passive() && self.last_sender() == Some(member) {
                    SUSPEND_BITS * can.controllers[n].timing().bit()
                } else {
                    0
                };
                Some((self.now.max(self.free + pause), frame))
            }
            Member::Node(n) => {
                let (at, frame) = self.nodes[n].wanted()?;
                Some((at.max(self.free), frame))
            }
        }
    }

    fn last_sender(&self) -> Option<Member> {
        self.history.last().map(|last| last.sender)
    }

    fn bit_of(&self, member: Member, can: &CanPair) -> BitTime {
        match member {
            Member::Controller(n) => BitTime::of_cycles(can.controllers[n].timing().bit()),
            Member::Node(n) => self.nodes[n].bit,
        }
    }

    /// The bit time of the bus as a listener sees it, for when nobody sends. Any value if there is no listener.
    fn listener_bit(&self, can: &CanPair) -> BitTime {
        let controller = self.attached.iter().find(|n| can.controllers[**n].listens());
        match controller {
            Some(n) => self.bit_of(Member::Controller(*n), can),
            None => self.nodes.first().map_or(BitTime::of_cycles(144), |node| node.bit),
        }
    }

    fn next_step(&mut self, can: &mut CanPair) {
        let Some(flight) = &mut self.flight else { return };
        let Some((_, step)) = flight.steps.pop_front() else { return };
        match step {
            Step::LoseArbitration(Member::Controller(n)) => can.controllers[n].lost_arbitration(),
            Step::LoseArbitration(Member::Node(_)) => {}
            Step::Error(member, sends, detection) => self.error(member, sends, detection, can),
            Step::Receive => {
                for member in flight.receivers.clone() {
                    match member {
                        Member::Controller(n) if can.controllers[n].listens() => {
                            flight.taken_by |= 1 << n;
                            can.receive(n, &flight.frame);
                        }
                        Member::Controller(_) => {}
                        Member::Node(n) => self.nodes[n].counters.received(),
                    }
                }
            }
            Step::Finish => self.finish(can),
        }
    }

    fn error(&mut self, member: Member, sends: bool, seen: Detection, can: &mut CanPair) {
        let recovery = self.bit_of(member, can).cycles(RECOVERY_BITS);
        match member {
            Member::Controller(n) if sends => can.controllers[n].transmit_error(seen.kind, seen.first),
            Member::Controller(n) => can.controllers[n].receive_error(seen.kind, seen.first),
            Member::Node(n) => {
                let node = &mut self.nodes[n];
                if sends {
                    node.counters.transmit_error(seen.kind, seen.first);
                } else {
                    node.counters.receive_error(seen.first);
                }
                if node.counters.bus_off() {
                    node.counters = ErrorCounters::default();
                    node.not_before = self.now + recovery;
                }
            }
        }
    }

    fn finish(&mut self, can: &mut CanPair) {
        let Some(flight) = self.flight.take() else { return };
        self.outside.forget_past();
        if flight.error.is_none() {
            for member in flight.sender.into_iter().chain(flight.twins) {
                match member {
                    Member::Controller(n) => can.controllers[n].sent(),
                    Member::Node(n) => self.nodes[n].frame_sent(),
                }
            }
        }
        for n in &self.attached {
            can.controllers[*n].bus_free();
        }
        self.free = flight.free;
        self.recessive = flight.recessive;
        if let Some(Member::Node(n)) = flight.sender
            && self.nodes[n].counters.passive()
        {
            let pause = flight.free + flight.bit.cycles(SUSPEND_BITS);
            self.nodes[n].not_before = self.nodes[n].not_before.max(pause);
        }
        self.history.extend(flight.sender.map(|sender| BusFrame {
            sender,
            frame: flight.frame,
            start: flight.start,
            valid: flight.valid,
            end: flight.end,
            error: flight.error,
            taken_by: flight.taken_by,
        }));
        for node in &mut self.nodes {
            node.refill();
        }
        if self.outside.is_dominant() {
            // It has lasted for longer than any error.
            self.hold_dominant(true, can);
        }
    }

    /// The frame under way is cut off by a dominant level that does not end.
    fn abort_flight(&mut self, can: &mut CanPair) {
        let Some(mut flight) = self.flight.take() else { return };
        if flight.steps.len() == 1 && flight.error.is_some() {
            self.flight = Some(flight);
            return self.finish(can);
        }
        flight.error = flight.error.or(Some(BusErrorKind::BitRecessive));
        let sender = flight.sender;
        self.flight = Some(flight);
        let detection = Detection { who: 0, bit: 0, kind: BusErrorKind::BitRecessive, first: true };
        if let Some(sender) = sender {
            self.error(sender, true, detection, can);
        }
        self.finish(can);
    }

    /// Nodes that listen to a bus held dominant keep counting errors: eight for every eight bits.
    fn stuck_error(&mut self, can: &mut CanPair) {
        let bit = self.listener_bit(can);
        for n in &self.attached {
            if can.controllers[*n].listens() {
                if self.abilities(Member::Controller(*n), can).1 {
                    can.controllers[*n].drove(outcome::FLAG as u64);
                }
                can.controllers[*n].receive_error(BusErrorKind::Stuff, true);
            }
        }
        for node in &mut self.nodes {
            node.counters.receive_error(true);
        }
        if let Some(stuck) = &mut self.stuck {
            stuck.next_error = self.now + bit.cycles(8);
        }
    }
}
