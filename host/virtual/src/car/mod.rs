//! `virtual:car`: a vehicle on the simulated buses, with its own database.
//!
//! Channel 1 is the drive train (500 kbit/s) with a J1939 part and two ECUs that answer testers, channel 2 the body (125 kbit/s).
//! Each ECU sends by its own clock, with a little jitter, and retries when its frame is destroyed. An ECU whose frames are
//! destroyed again and again goes bus-off for a while.
//!
//! The messages are those of [`DATABASE`], the only place with layouts and cycles. `values.rs` maps the car's state to signals, and
//! `vehicle.rs` moves the car.

mod diagnostics;
mod isotp;
mod messages;
#[cfg(test)]
mod tests;
mod values;
mod vehicle;

use std::collections::VecDeque;

use cantap_signals::{Database, DatabaseError, dbc};
use cantap_wire::{Frame, Id};

use self::diagnostics::{Diagnostics, Who};
use self::isotp::IsoTp;
use self::messages::Layout;
use self::values::{Context, J1939_VIN_PACKETS};
use self::vehicle::Vehicle;
use crate::simbus::{Senders, arbitration_field};

/// The car's database, a DBC file.
pub const DATABASE: &str = include_str!("car.dbc");
/// The database's name where a file name is expected.
pub const DATABASE_NAME: &str = "virtual:car";
/// The device's board name, by which programs that see it on a serial port know whose signals it has.
pub const BOARD: &str = "virtual-car";
/// The buses' bit rates: drive train, body.
pub const BITRATES_BPS: [u32; 2] = [500_000, 125_000];

/// The messages of these ECUs are on the second bus.
const BODY: [&str; 4] = ["BCM", "GW", "HVAC", "TPM"];
/// Sent immediately when something in them changes.
const ON_CHANGE: [&str; 4] = ["BCM_Doors", "BCM_Lights", "BCM_Key", "SWM_Buttons"];
const CYLINDERS: u8 = 4;
/// Time between the packets of the long message (SAE J1939-21: 50 to 200 ms).
const PACKET_GAP_NS: u64 = 60 * MS_NS;
/// When the car begins to send, after its ECUs have started.
const START_NS: u64 = 120 * MS_NS;
const MS_NS: u64 = 1_000_000;
/// How far an ECU's times are off, as a part of a cycle, limited to [`MAX_JITTER_NS`].
const JITTER_PER_MILLE: u64 = 15;
const MAX_JITTER_NS: u64 = 900_000;
/// Error counts (ISO 11898-1:2015, 12.1.4), and how long an ECU stays away when it is bus-off.
const ERROR_COUNT: u16 = 8;
const BUS_OFF: u16 = 256;
const BUS_OFF_NS: u64 = 250 * MS_NS;
/// "Never", for due times.
const NEVER: u64 = u64::MAX;

/// Identifiers of ISO 15765-4: to all, and to each ECU with its answers'.
const TO_ALL: u32 = 0x7DF;
const TESTED: [(Who, &str, u32, u32); 2] =
    [(Who::Engine, "ECM", 0x7E0, 0x7E8), (Who::Transmission, "TCM", 0x7E1, 0x7E9)];

/// The database, parsed.
pub fn database() -> Result<Database, DatabaseError> {
    dbc::parse(DATABASE_NAME, DATABASE.as_bytes())
}

/// A message's next transmission.
#[derive(Debug)]
struct Entry {
    layout: Layout,
    ecu: usize,
    /// `None` if it is sent only when something changes.
    period_ns: Option<u64>,
    phase_ns: u64,
    due_ns: u64,
    on_change: bool,
    /// The data seen last, for messages that are sent when they change.
    shown: Vec<u8>,
    sent: u32,
    part: u8,
    parts: u8,
}

/// An ECU's fault confinement.
#[derive(Clone, Copy, Debug, Default)]
struct Health {
    errors: u16,
    away_until_ns: u64,
}

#[derive(Debug)]
struct Ecu {
    name: String,
    health: Health,
}

/// An ECU that testers talk to.
#[derive(Debug)]
struct Tested {
    ecu: usize,
    asked_with: u32,
    connection: IsoTp,
    memory: Diagnostics,
}

/// The source of the next frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Origin {
    Again,
    Entry(usize),
    Tested(usize),
}

/// One of the car's buses: every node on it except the analyser.
#[derive(Debug)]
pub struct CarBus {
    car: Vehicle,
    seed: u64,
    ecus: Vec<Ecu>,
    entries: Vec<Entry>,
    tested: Vec<Tested>,
    /// Frames that were destroyed, with their ECU.
    again: VecDeque<(usize, Frame)>,
    /// The ECU whose frame is on the bus.
    sending: usize,
}

impl CarBus {
    /// Bus 0 is the drive train, 1 the body.
    pub fn new(bus: usize, seed: u64) -> Self {
        // This cannot fail: a test parses it.
        let database = database().unwrap_or_default();
        let mut made = Self {
            car: Vehicle::new(seed),
            seed,
            ecus: vec![],
            entries: vec![],
            tested: vec![],
            again: VecDeque::new(),
            sending: 0,
        };
        for message in &database.messages {
            let sender = message.name.split('_').next().unwrap_or_default();
            if sender == "DIAG" || BODY.contains(&sender) != (bus == 1) {
                continue;
            }
            let ecu = made.ecu(sender);
            let packets = if message.name == "BBM_TPDT" { J1939_VIN_PACKETS } else { 1 };
            for packet in 0..packets {
                let period_ns = message.cycle_ms.filter(|ms| *ms > 0).map(|ms| u64::from(ms) * MS_NS);
                let number = made.entries.len() as u64;
                // Spread out, so that not everything is due at the same time; a long message's packets follow its
                // announcement.
                let phase_ns = match message.name.as_str() {
                    "BBM_TPCM" => START_NS + 2000 * MS_NS,
                    "BBM_TPDT" => START_NS + 2000 * MS_NS + PACKET_GAP_NS * (u64::from(packet) + 1),
                    _ => START_NS + number * 730_000 % period_ns.unwrap_or(MS_NS),
                };
                made.entries.push(Entry {
                    layout: Layout::new(message),
                    ecu,
                    period_ns,
                    phase_ns,
                    due_ns: if period_ns.is_some() { phase_ns } else { NEVER },
                    on_change: ON_CHANGE.contains(&message.name.as_str()),
                    shown: Vec::new(),
                    sent: 0,
                    part: packet,
                    parts: if message.name == "ECM_Cylinder" { CYLINDERS } else { 1 },
                });
            }
        }
        if bus == 0 {
            for (who, sender, asked_with, answers_with) in TESTED {
                let ecu = made.ecu(sender);
                let connection = IsoTp::new(Id::standard_truncated(answers_with));
                made.tested.push(Tested { ecu, asked_with, connection, memory: Diagnostics::new(who) });
            }
        }
        made.look();
        made
    }

    fn ecu(&mut self, name: &str) -> usize {
        self.ecus.iter().position(|ecu| ecu.name == name).unwrap_or_else(|| {
            self.ecus.push(Ecu { name: name.to_owned(), health: Health::default() });
            self.ecus.len() - 1
        })
    }

    fn context(&self, entry: &Entry) -> Context {
        let faulty = self.tested.iter().any(|tested| tested.memory.faulty);
        Context { sent: entry.sent, part: entry.part, faulty }
    }

    /// Checks what has changed; returns the messages that show it.
    fn look(&mut self) -> Vec<usize> {
        let mut changed = Vec::new();
        for at in 0..self.entries.len() {
            if self.entries[at].on_change {
                // Without the counter.
                let context = Context { sent: 0, ..self.context(&self.entries[at]) };
                let shows = self.entries[at].layout.data(&self.car, context);
                if shows != self.entries[at].shown {
                    self.entries[at].shown = shows;
                    changed.push(at);
                }
            }
        }
        changed
    }

    /// Moves the car forward.
    fn advance(&mut self, now_ns: u64) {
        if !self.car.advance(now_ns) {
            return;
        }
        for at in self.look() {
            self.entries[at].due_ns = self.entries[at].due_ns.min(now_ns.max(START_NS));
        }
    }

    fn away_until(&self, ecu: usize) -> u64 {
        self.ecus[ecu].health.away_until_ns
    }

    /// Passes everything waiting to be sent, with its earliest time.
    fn each_bid(&mut self, now_ns: u64, mut show: impl FnMut(&Self, u64, Origin)) {
        if !self.again.is_empty() {
            show(self, 0, Origin::Again);
        }
        for at in 0..self.tested.len() {
            let tested = &mut self.tested[at];
            let ecu = tested.ecu;
            if let Some(due_ns) = tested.connection.due(now_ns) {
                show(self, due_ns.max(self.away_until(ecu)), Origin::Tested(at));
            }
        }
        for (at, entry) in self.entries.iter().enumerate().filter(|(_, entry)| entry.due_ns != NEVER) {
            show(self, entry.due_ns.max(self.away_until(entry.ecu)), Origin::Entry(at));
        }
    }

    fn frame_of(&self, origin: Origin) -> Option<Frame> {
        match origin {
            Origin::Again => self.again.front().map(|(_, frame)| *frame),
            Origin::Entry(at) => {
                let entry = &self.entries[at];
                Some(entry.layout.frame(&self.car, self.context(entry)))
            }
            Origin::Tested(at) => self.tested[at].connection.peek(),
        }
    }

    /// The value that arbitration compares for a frame.
    fn rank(&self, origin: Origin) -> u32 {
        match origin {
            Origin::Entry(at) => arbitration_field(self.entries[at].layout.message().id, false),
            Origin::Again | Origin::Tested(_) => {
                self.frame_of(origin).map_or(u32::MAX, |frame| arbitration_field(frame.id(), false))
            }
        }
    }

    /// Of those that are due, the one with the lowest identifier, and since when it has been due.
    fn first(&mut self, now_ns: u64) -> Option<(u64, Origin)> {
        self.advance(now_ns);
        let mut first: Option<(u32, u64, Origin)> = None;
        self.each_bid(now_ns, |bus, due_ns, origin| {
            if due_ns <= now_ns {
                let rank = bus.rank(origin);
                if first.is_none_or(|(lowest, ..)| rank < lowest) {
                    first = Some((rank, due_ns, origin));
                }
            }
        });
        first.map(|(_, due_ns, origin)| (due_ns, origin))
    }
}

impl Senders for CarBus {
    fn due(&mut self, now_ns: u64) -> Option<u64> {
        self.advance(now_ns);
        let mut next = None;
        self.each_bid(now_ns, |_, due_ns, _| next = Some(next.unwrap_or(NEVER).min(due_ns)));
        next
    }

    fn bid(&mut self, now_ns: u64) -> Option<Frame> {
        let (_, origin) = self.first(now_ns)?;
        self.frame_of(origin)
    }

    fn take(&mut self, now_ns: u64) {
        match self.first(now_ns).map(|(_, origin)| origin) {
            Some(Origin::Again) => {
                if let Some((ecu, _)) = self.again.pop_front() {
                    self.sending = ecu;
                }
            }
            Some(Origin::Entry(at)) => {
                let seed = self.seed;
                let entry = &mut self.entries[at];
                self.sending = entry.ecu;
                entry.sent = entry.sent.wrapping_add(1);
                entry.part = if entry.parts > 1 { (entry.part + 1) % entry.parts } else { entry.part };
                entry.plan(at as u64, seed, now_ns);
            }
            Some(Origin::Tested(at)) => {
                self.sending = self.tested[at].ecu;
                self.tested[at].connection.take(now_ns);
            }
            None => {}
        }
    }

    fn delivered(&mut self) {
        let health = &mut self.ecus[self.sending].health;
        health.errors = health.errors.saturating_sub(1);
    }

    fn destroyed(&mut self, frame: &Frame, now_ns: u64) {
        let ecu = self.sending;
        let health = &mut self.ecus[ecu].health;
        health.errors += ERROR_COUNT;
        if health.errors < BUS_OFF {
            self.again.push_back((ecu, *frame));
        } else {
            *health = Health { errors: 0, away_until_ns: now_ns + BUS_OFF_NS };
        }
    }

    fn hear(&mut self, frame: &Frame, now_ns: u64) {
        if frame.id().is_extended() || frame.is_remote() {
            return;
        }
        self.advance(now_ns);
        let to_all = frame.id().raw() == TO_ALL;
        for tested in &mut self.tested {
            if !to_all && frame.id().raw() != tested.asked_with {
                continue;
            }
            let Some(request) = tested.connection.hear(frame, to_all, now_ns) else { continue };
            if let Some(answer) = tested.memory.answer(&request, to_all, &self.car) {
                tested.connection.answer(answer, now_ns);
            }
        }
    }
}

impl Entry {
    /// Plans the next transmission after one that begins now. Cycles that have been missed are left out.
    fn plan(&mut self, number: u64, seed: u64, now_ns: u64) {
        let Some(period_ns) = self.period_ns else {
            self.due_ns = NEVER;
            return;
        };
        let mut cycle = now_ns.saturating_sub(self.phase_ns) / period_ns;
        loop {
            cycle += 1;
            let most = (period_ns * JITTER_PER_MILLE / 1000).min(MAX_JITTER_NS);
            let jitter = hash(seed ^ number << 48 ^ cycle) % (most + 1);
            self.due_ns = self.phase_ns + cycle * period_ns + jitter;
            // If it was just sent because of a change, or late, it is not sent again immediately.
            if self.due_ns > now_ns + period_ns / 4 {
                return;
            }
        }
    }
}

/// SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", 2014).
const fn hash(seed: u64) -> u64 {
    let z = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ z >> 31
}
