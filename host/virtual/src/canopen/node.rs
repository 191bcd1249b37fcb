//! One node: its state, its heartbeat, its PDOs and emergencies, and its drive.

use std::collections::VecDeque;

use cantap_protocols::canopen::codec::lss::{self, NO_NODE};
use cantap_protocols::canopen::codec::sdo::SdoObject;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::serving::canopen::{ObjectDictionary, SdoServer};
use cantap_wire::{Frame, Id};

use cantap_protocols::serving::lss::LssSlave;

const MS_NS: u64 = 1_000_000;
/// How long the node takes to answer, and to boot.
const THINKS_NS: u64 = 300_000;
const BOOT_NS: u64 = 100 * MS_NS;
/// The first heartbeat of a node that was running before anybody listened.
const FIRST_BEAT_NS: u64 = 150 * MS_NS;
/// Time between two segments of a block.
const SEGMENT_GAP_NS: u64 = 100_000;
/// How many frames may wait to be sent; beyond that, none are made, like a node on a bus without room.
const MOST_WAITING: usize = 512;
/// How fast the drive's speed changes, in increments per second squared.
const RAMP: i64 = 2000;
/// How often the drive's movement is computed.
const STEP_NS: u64 = 10 * MS_NS;

const SYNC: u32 = 0x80;

/// States as heartbeats say them (CiA 301, table 31).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Without a node number, or about to boot.
    Silent,
    Stopped,
    Operational,
    PreOperational,
}

impl State {
    const fn code(self) -> u8 {
        match self {
            Self::Silent => 0,
            Self::Stopped => 4,
            Self::Operational => 5,
            Self::PreOperational => 0x7F,
        }
    }
}

/// A node on the bus.
#[derive(Debug)]
pub struct CanOpenNode {
    sheet: Eds,
    serial: u32,
    dictionary: ObjectDictionary,
    server: SdoServer,
    slave: LssSlave,
    state: State,
    boots_ns: Option<u64>,
    beat_ns: u64,
    toggle: bool,
    /// When each TPDO with a timer is due, and how many SYNCs have passed since each was sent.
    timers_ns: [u64; 2],
    syncs: [u8; 2],
    /// A thousand times the drive's position, and the time for which it was computed.
    position_milli: i64,
    moved_ns: u64,
    waiting: VecDeque<(u64, Frame)>,
}

fn frame(id: u32, bytes: &[u8]) -> Frame {
    let mut data = [0; 8];
    data[..bytes.len()].copy_from_slice(bytes);
    Frame::from_bus(Id::standard_truncated(id), false, bytes.len() as u8, data)
}

impl CanOpenNode {
    /// A node with this number, or without one ([`NO_NODE`]), that has booted before.
    pub fn new(sheet: &Eds, node: u8, serial: u32) -> Self {
        let mut made = Self {
            sheet: sheet.clone(),
            serial,
            dictionary: ObjectDictionary::default(),
            server: SdoServer::default(),
            slave: LssSlave::new([0; 4], node),
            state: if node == NO_NODE { State::Silent } else { State::PreOperational },
            boots_ns: None,
            beat_ns: FIRST_BEAT_NS,
            toggle: false,
            timers_ns: [0; 2],
            syncs: [0; 2],
            position_milli: 0,
            moved_ns: 0,
            waiting: VecDeque::new(),
        };
        made.load();
        let identity = [1, 2, 3, 4].map(|sub| made.dictionary.number(0x1018, sub));
        made.slave = LssSlave::new(identity, node);
        made
    }

    /// Sets everything according to the sheet.
    fn load(&mut self) {
        self.dictionary = ObjectDictionary::new(&self.sheet, self.slave.node());
        self.dictionary.set(0x1018, 4, &self.serial.to_le_bytes());
        self.server = SdoServer::default();
        (self.position_milli, self.syncs) = (0, [0; 2]);
    }

    fn node(&self) -> u32 {
        self.slave.node().into()
    }

    fn send(&mut self, at_ns: u64, frame: Frame) {
        if self.waiting.len() < MOST_WAITING {
            let after = self.waiting.back().map_or(0, |(due_ns, _)| *due_ns);
            self.waiting.push_back((at_ns.max(after), frame));
        }
    }

    /// Sends a frame again as soon as the bus is free.
    pub fn send_again(&mut self, frame: Frame) {
        self.waiting.push_front((0, frame));
    }

    /// The next frame to send, and the earliest time for it.
    pub fn bid(&self) -> Option<(u64, Frame)> {
        self.waiting.front().copied()
    }

    /// The frame is on the bus.
    pub fn sent(&mut self) {
        self.waiting.pop_front();
    }

    /// When the node next does something on its own.
    pub fn due(&self) -> u64 {
        let mut due_ns = self.boots_ns.unwrap_or(u64::MAX);
        due_ns = due_ns.min(self.server.due().unwrap_or(u64::MAX));
        if self.state != State::Silent && self.beat_period_ns() > 0 {
            due_ns = due_ns.min(self.beat_ns);
        }
        for (place, at_ns) in self.timers_ns.iter().enumerate() {
            if self.timer_ns(place).is_some() {
                due_ns = due_ns.min(*at_ns);
            }
        }
        due_ns.min(self.bid().map_or(u64::MAX, |(at_ns, _)| at_ns))
    }

    fn beat_period_ns(&self) -> u64 {
        u64::from(self.dictionary.number(0x1017, 0)) * MS_NS
    }

    /// The interval at which a timer sends a TPDO.
    fn timer_ns(&self, place: usize) -> Option<u64> {
        let parameter = 0x1800 + place as u16;
        let period_ns = u64::from(self.dictionary.number(parameter, 5)) * MS_NS;
        let by_timer = self.dictionary.number(parameter, 2) >= 254;
        (self.state == State::Operational && by_timer && period_ns > 0).then_some(period_ns)
    }

    /// Does what is due.
    pub fn advance(&mut self, now_ns: u64) {
        if self.boots_ns.is_some_and(|at_ns| at_ns <= now_ns) {
            self.boots_ns = None;
            self.send(now_ns, frame(0x700 + self.node(), &[0]));
            self.enter(State::PreOperational, now_ns);
            self.beat_ns = now_ns + self.beat_period_ns();
        }
        if self.server.due().is_some_and(|due_ns| due_ns <= now_ns) {
            let abort = self.server.give_up();
            self.send(now_ns, frame(0x580 + self.node(), &abort));
        }
        let period_ns = self.beat_period_ns();
        if self.state != State::Silent && period_ns > 0 && self.beat_ns <= now_ns {
            self.send(now_ns, frame(0x700 + self.node(), &[self.state.code()]));
            // Those due while the bus was busy are left out.
            self.beat_ns += period_ns * ((now_ns - self.beat_ns) / period_ns + 1);
        }
        self.drive(now_ns);
        for place in 0..self.timers_ns.len() {
            if let Some(period_ns) = self.timer_ns(place)
                && self.timers_ns[place] <= now_ns
            {
                self.send_pdo(place, now_ns);
                self.timers_ns[place] = now_ns + period_ns;
            }
        }
    }

    fn enter(&mut self, state: State, now_ns: u64) {
        if state == State::Operational && self.state != state {
            self.timers_ns = [now_ns + MS_NS; 2];
            self.moved_ns = now_ns;
        }
        self.state = state;
    }

    /// Moves the speed towards its target, and the position with the speed.
    fn drive(&mut self, now_ns: u64) {
        if self.state != State::Operational {
            self.moved_ns = now_ns;
            return;
        }
        while self.moved_ns + STEP_NS <= now_ns {
            // After a long time unobserved, computing each step is not worth it.
            if now_ns - self.moved_ns > 1000 * STEP_NS {
                self.moved_ns = now_ns - 1000 * STEP_NS;
            }
            self.moved_ns += STEP_NS;
            let is_on = self.dictionary.number(0x6041, 0) == 0x0237;
            let target = if is_on { i64::from(self.dictionary.number(0x2001, 0) as i32) } else { 0 };
            let speed = i64::from(self.dictionary.number(0x2002, 0) as i32);
            let step_ms = (STEP_NS / MS_NS) as i64;
            let most = RAMP * step_ms / 1000;
            let speed = speed + (target - speed).clamp(-most, most);
            self.position_milli += speed * step_ms;
            self.dictionary.set(0x2002, 0, &(speed as i32).to_le_bytes());
            self.dictionary.set(0x6064, 0, &((self.position_milli / 1000) as i32).to_le_bytes());
        }
    }

    /// The controlword's first four bits (CiA 402, state machine), as far as this drive supports them.
    fn control(&mut self) {
        let status: u16 = match self.dictionary.number(0x6040, 0) & 0xF {
            0x6 => 0x0231,
            0x7 => 0x0233,
            0xF => 0x0237,
            _ => 0x0250,
        };
        self.dictionary.set(0x6041, 0, &status.to_le_bytes());
    }

    fn send_pdo(&mut self, place: usize, now_ns: u64) {
        let id = self.dictionary.number(0x1800 + place as u16, 1);
        // Bit 31: the PDO does not exist.
        if id & 0x8000_0000 != 0 || self.state != State::Operational {
            return;
        }
        let bytes = self.dictionary.pdo(0x1A00 + place as u16);
        self.send(now_ns, frame(id & 0x7FF, &bytes));
    }

    fn take_pdo(&mut self, data: &[u8], now_ns: u64) {
        if self.dictionary.take_pdo(0x1600, data).is_none() {
            self.emergency(0x8210, now_ns);
            return;
        }
        self.control();
    }

    /// Code 0: the error is gone.
    fn emergency(&mut self, code: u16, now_ns: u64) {
        let register = u8::from(code != 0);
        self.dictionary.set(0x1001, 0, &[register]);
        if code != 0 {
            self.dictionary.set(0x1003, 0, &[1]);
            self.dictionary.set(0x1003, 1, &u32::from(code).to_le_bytes());
        }
        let [low, high] = code.to_le_bytes();
        let id = self.dictionary.number(0x1014, 0) & 0x7FF;
        self.send(now_ns, frame(id, &[low, high, register, 0, 0, 0, 0, 0]));
    }

    /// Takes a frame from the bus.
    pub fn hear(&mut self, heard: &Frame, now_ns: u64) {
        if heard.id().is_extended() {
            return;
        }
        let (id, node, at_ns) = (heard.id().raw(), self.node(), now_ns + THINKS_NS);
        if heard.is_remote() {
            // Node guarding, if there is no heartbeat.
            if id == 0x700 + node && self.state != State::Silent && self.beat_period_ns() == 0 {
                let state = self.state.code() | u8::from(self.toggle) << 7;
                self.toggle = !self.toggle;
                self.send(at_ns, frame(id, &[state]));
            }
            return;
        }
        let data = heard.data();
        if id == lss::REQUEST.raw() {
            let was_none = self.slave.node() == NO_NODE;
            if let Some(bytes) = self.slave.take(data) {
                self.send(at_ns, frame(lss::RESPONSE.raw(), &bytes));
            }
            if was_none && self.slave.node() != NO_NODE {
                self.load();
                self.boots_ns = Some(now_ns + BOOT_NS);
            }
            return;
        }
        if self.slave.node() == NO_NODE || self.boots_ns.is_some() {
            return;
        }
        match id {
            0 => {
                if let &[command, to] = data
                    && (to == 0 || u32::from(to) == node)
                {
                    self.manage(command, now_ns);
                }
            }
            SYNC if self.state == State::Operational => self.synchronise(now_ns),
            _ if id == 0x600 + node && matches!(self.state, State::PreOperational | State::Operational) => {
                let Ok(bytes) = data.try_into() else { return };
                self.drive(now_ns);
                let reply = self.server.take(bytes, &mut self.dictionary, now_ns);
                let mut at_ns = at_ns;
                for bytes in reply.frames {
                    self.send(at_ns, frame(0x580 + node, &bytes));
                    at_ns += SEGMENT_GAP_NS;
                }
                if let Some(object) = reply.written {
                    self.written(object, now_ns);
                }
            }
            _ if self.state == State::Operational
                && self.dictionary.number(0x1400, 1) & 0x8000_07FF == id =>
            {
                self.take_pdo(data, now_ns);
            }
            _ => {}
        }
    }

    fn manage(&mut self, command: u8, now_ns: u64) {
        match command {
            1 => self.enter(State::Operational, now_ns),
            2 => self.enter(State::Stopped, now_ns),
            0x80 => self.enter(State::PreOperational, now_ns),
            0x81 | 0x82 => {
                self.slave.reset();
                self.load();
                (self.state, self.toggle) = (State::Silent, false);
                self.boots_ns = (self.slave.node() != NO_NODE).then_some(now_ns + BOOT_NS);
            }
            _ => {}
        }
    }

    fn synchronise(&mut self, now_ns: u64) {
        self.drive(now_ns);
        for place in 0..self.syncs.len() {
            let every = self.dictionary.number(0x1800 + place as u16, 2) as u8;
            if !(1..=240).contains(&every) {
                continue;
            }
            self.syncs[place] += 1;
            if self.syncs[place] >= every {
                self.syncs[place] = 0;
                self.send_pdo(place, now_ns + THINKS_NS);
            }
        }
    }

    /// Reacts to an object that a client has written.
    fn written(&mut self, object: SdoObject, now_ns: u64) {
        match (object.index, object.sub) {
            (0x1003, 0) => self.dictionary.set(0x1003, 1, &[0; 4]),
            (0x1017, 0) => self.beat_ns = now_ns + self.beat_period_ns(),
            (0x1800 | 0x1801, 5) => self.timers_ns = [now_ns; 2],
            (0x2003, 0) => self.emergency(self.dictionary.number(0x2003, 0) as u16, now_ns),
            (0x2004, 0) => self.server.loses = self.dictionary.number(0x2004, 0) as u8,
            (0x6040, 0) => self.control(),
            _ => {}
        }
    }
}
