//! A J1939 node that claims an address, requests parameter groups, and sends messages of any length (J1939-21 and J1939-81).
//!
//! The address is defended as long as the station runs. A message of many frames is received and sent by RTS/CTS, and to all by
//! BAM.

mod job;
pub(crate) mod long_message;
pub(crate) mod parts;

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

pub use self::job::{GroupAnswer, StationJob, StationTiming};
use self::long_message::{Incoming, Outgoing};
pub use self::parts::StationError;
use self::parts::{CONTROL, DATA, GLOBAL, MS, frame, three};
use super::{Machine, earlier};
use crate::j1939::{Header, fast_frames};

/// After this time, nobody may object to a claim any more (J1939-81).
const CLAIM_NS: u64 = 250 * MS;
/// The longest duration of a message to all that began in time: 255 frames, 50 ms each.
const LONGEST_NS: u64 = 15_000 * MS;
const NULL: u8 = 254;
const REQUEST: u32 = 0xEA00;
const ACKNOWLEDGE: u32 = 0xE800;
const CLAIM: u32 = 0xEE00;
/// Addresses that any node may use (J1939-81).
const FREE: std::ops::RangeInclusive<u8> = 128..=247;
/// Why a connection is aborted that is ended from outside: "resources were needed for another task" (J1939-21, 5.10.2.3).
const RESOURCES_NEEDED: u8 = 2;
/// Why one is aborted that takes too long: "a timeout occurred".
const TIMED_OUT: u8 = 3;
/// The NAME's bit for "arbitrary address capable".
const TAKES_ANY: u64 = 1 << 63;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    New,
    /// The claim was sent; after its confirmation, it is settled at this time.
    Claims {
        until_ns: Option<u64>,
    },
    /// The address is ours; the job has not begun.
    Begins,
    /// Waits for answers.
    Waits {
        until_ns: Option<u64>,
    },
    /// Sends a message of one frame, or gives up its address.
    Closing,
    /// Sends a message of many frames.
    Sends,
    /// Its message is due again at this time.
    Pauses {
        until_ns: u64,
    },
    Done,
}

/// One node.
#[derive(Debug)]
pub struct Station {
    name: u64,
    address: u8,
    job: StationJob,
    phase: Phase,
    /// Frames to send, before those of a long message.
    out: VecDeque<Frame>,
    under_way: VecDeque<bool>,
    taken: [bool; 256],
    incoming: Vec<Incoming>,
    outgoing: Option<Outgoing>,
    answers: Vec<GroupAnswer>,
    timing: StationTiming,
    /// When the job was begun first.
    begun_ns: Option<u64>,
    /// Frames that another node sent from our address.
    imposters: u32,
    /// Tells one fast packet from the next.
    counter: u8,
    end: Option<Result<(), StationError>>,
}

impl Station {
    /// A node with this NAME that would like this address, 0 to 253.
    pub const fn new(name: u64, address: u8, job: StationJob) -> Self {
        Self {
            name,
            address,
            job,
            phase: Phase::New,
            out: VecDeque::new(),
            under_way: VecDeque::new(),
            taken: [false; 256],
            incoming: Vec::new(),
            outgoing: None,
            answers: Vec::new(),
            timing: StationTiming { answer_ns: 1250 * MS, patience_ns: 60_000 * MS },
            begun_ns: None,
            imposters: 0,
            counter: 0,
            end: None,
        }
    }

    /// A node that has already claimed its address.
    pub fn with_address(name: u64, address: u8, job: StationJob) -> Self {
        Self { phase: Phase::Begins, ..Self::new(name, address, job) }
    }

    /// Uses these times.
    pub const fn set_timing(&mut self, timing: StationTiming) {
        self.timing = timing;
    }

    /// How many frames another node has sent from our address: what it is answered is not for us.
    pub const fn imposters(&self) -> u32 {
        self.imposters
    }

    /// The address that it has or tries to get.
    pub const fn address(&self) -> u8 {
        self.address
    }

    /// Sends its message again this long after it began to send it, or at once if that time is over. Call it when it is done; until then the
    /// address is defended.
    pub fn send_again(&mut self, period_ns: u64) {
        if self.end == Some(Ok(())) {
            let begun_ns = self.begun_ns.take().unwrap_or(0);
            (self.phase, self.end) = (Phase::Pauses { until_ns: begun_ns.saturating_add(period_ns) }, None);
        }
    }

    /// The answers. Call it when it is done.
    pub fn finish(self) -> Result<Vec<GroupAnswer>, StationError> {
        self.end.unwrap_or(Ok(())).map(|()| self.answers)
    }

    fn fail(&mut self, error: StationError) {
        self.end.get_or_insert(Err(error));
        self.phase = Phase::Done;
    }

    fn done(&mut self) {
        self.end.get_or_insert(Ok(()));
        self.phase = Phase::Done;
    }

    fn claim(&mut self) {
        self.out.push_back(frame(6, CLAIM, self.address, GLOBAL, &self.name.to_le_bytes()));
    }

    /// Another node claims an address.
    fn claimed(&mut self, by: u8, name: u64) {
        self.taken[usize::from(by)] = true;
        if by != self.address || matches!(self.phase, Phase::New | Phase::Done | Phase::Closing) {
            return;
        }
        // The lower NAME wins (J1939-81).
        if self.name < name {
            return self.claim();
        }
        let next = if self.name & TAKES_ANY == 0 {
            None
        } else {
            FREE.into_iter().find(|free| !self.taken[usize::from(*free)])
        };
        self.out.clear();
        if let Some(next) = next {
            // Whatever was begun with the old address cannot be answered any more.
            self.incoming.clear();
            self.address = next;
            self.claim();
            self.phase = Phase::Claims { until_ns: None };
        } else {
            self.end = Some(Err(StationError::AddressTaken { address: self.address, name }));
            self.address = NULL;
            self.claim();
            self.phase = Phase::Closing;
        }
    }

    fn begin(&mut self) {
        match self.job.clone() {
            StationJob::Claim => self.done(),
            StationJob::Request { pgn, to } => {
                self.out.push_back(frame(6, REQUEST, self.address, to, &three(pgn)));
                self.phase = Phase::Waits { until_ns: None };
            }
            StationJob::Send { pgn, to, priority, data } if data.len() <= 8 => {
                self.out.push_back(frame(priority, pgn, self.address, to, &data));
                self.phase = Phase::Closing;
            }
            StationJob::SendFast { pgn, to, priority, data } => {
                let header = Header { priority, pgn, source: self.address, destination: to };
                self.out.extend(fast_frames(header, self.counter, &data));
                self.counter = self.counter.wrapping_add(1);
                self.phase = Phase::Closing;
            }
            StationJob::Send { pgn, to, data, .. } => {
                self.outgoing = Some(Outgoing::new(self.address, to, pgn, data));
                self.phase = Phase::Sends;
            }
        }
    }

    /// A complete message from another node.
    fn message(&mut self, header: Header, data: Vec<u8>) {
        let Phase::Waits { .. } = self.phase else { return };
        let StationJob::Request { pgn, to } = self.job else { return };
        if to != GLOBAL && header.source != to {
            return;
        }
        if header.pgn == ACKNOWLEDGE {
            let is_ours = data.len() >= 8 && data[5..8] == three(pgn) && data[0] > 0;
            // Acknowledgements go to all; the fifth byte says whom they are for, if it is used.
            if is_ours && to != GLOBAL && (data[4] == self.address || data[4] == 0xFF) {
                self.fail(StationError::NotAcknowledged { from: header.source, control: data[0] });
            }
            return;
        }
        if header.pgn != pgn {
            return;
        }
        self.answers.push(GroupAnswer { from: header.source, data });
        // If all were asked, everyone who answers in time; many send it repeatedly without being asked.
        if to != GLOBAL {
            self.done();
        }
    }

    /// A frame of a connection that another node began, or of ours.
    fn control(&mut self, now_ns: u64, header: Header, data: [u8; 8]) {
        let pgn = u32::from_le_bytes([data[5], data[6], data[7], 0]);
        let from = header.source;
        if header.destination == self.address
            && let Some(outgoing) = self.outgoing.as_mut().filter(|outgoing| outgoing.is_with(from, pgn))
            && matches!(data[0], 17 | 19 | 255)
        {
            if let Err(error) = outgoing.control(now_ns, data) {
                self.fail(error);
            } else if self.outgoing.as_ref().is_some_and(Outgoing::is_done) {
                self.done();
            }
            return;
        }
        let to_all = header.destination == GLOBAL;
        match data[0] {
            16 if header.destination == self.address => {
                self.incoming.retain(|incoming| !incoming.is_of(from, false));
                match Incoming::connection(now_ns, header, data) {
                    Some(incoming) => self.incoming.push(incoming),
                    None => self.out.push_back(long_message::abort(self.address, from, pgn, 9)),
                }
            }
            32 if to_all && self.wants(pgn, from) => {
                self.incoming.retain(|incoming| !incoming.is_of(from, true));
                self.incoming.extend(Incoming::broadcast(now_ns, header, data));
            }
            255 if header.destination == self.address => {
                self.incoming.retain(|incoming| !(incoming.is_of(from, false) && incoming.pgn() == pgn));
                if self.wants(pgn, from) {
                    self.fail(StationError::Aborted { from, reason: data[1] });
                }
            }
            _ => {}
        }
    }

    /// Whether a message answers the request.
    fn wants(&self, pgn: u32, from: u8) -> bool {
        matches!(self.phase, Phase::Waits { .. })
            && matches!(self.job, StationJob::Request { pgn: asked, to } if asked == pgn && (to == GLOBAL || to == from))
    }

    fn data(&mut self, now_ns: u64, header: Header, data: [u8; 8]) {
        let to_all = header.destination == GLOBAL;
        if !to_all && header.destination != self.address {
            return;
        }
        let Some(place) = self.incoming.iter().position(|incoming| incoming.is_of(header.source, to_all))
        else {
            return;
        };
        if self.incoming[place].take(now_ns, data) {
            let incoming = self.incoming.remove(place);
            self.out.extend(incoming.last_word(self.address));
            let header = Header { pgn: incoming.pgn(), ..header };
            self.message(header, incoming.into_data());
        }
    }

    /// Whether it has taken too long altogether.
    fn is_late(&self, now_ns: u64) -> bool {
        self.begun_ns.is_some_and(|begun_ns| now_ns >= begun_ns.saturating_add(self.timing.patience_ns))
    }

    /// Ends what takes too long, and tells the other side.
    fn give_up(&mut self) {
        let open = self.open_connection();
        self.out.clear();
        self.out.extend(open.map(|(with, pgn)| long_message::abort(self.address, with, pgn, TIMED_OUT)));
        let has_some = !self.answers.is_empty();
        if has_some {
            self.done();
        } else {
            self.fail(StationError::TooSlow { after_ms: self.timing.patience_ns / MS });
        }
    }

    /// The node and the group of a message of many frames that is under way.
    fn open_connection(&self) -> Option<(u8, u32)> {
        let sending =
            self.outgoing.as_ref().filter(|_| self.phase == Phase::Sends).and_then(Outgoing::connection);
        sending.or_else(|| self.incoming.iter().find_map(Incoming::open_connection))
    }

    /// Handles timeouts of incoming messages.
    fn sweep(&mut self, now_ns: u64) {
        let mut at = 0;
        while at < self.incoming.len() {
            match self.incoming[at].next(now_ns, self.address) {
                Ok(frames) => {
                    self.out.extend(frames);
                    at += 1;
                }
                Err((error, last)) => {
                    let incoming = self.incoming.remove(at);
                    self.out.extend(last);
                    if self.wants(incoming.pgn(), incoming.from())
                        && !matches!(self.job, StationJob::Request { to: GLOBAL, .. })
                    {
                        self.fail(error);
                    }
                }
            }
        }
    }
}

impl Machine for Station {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if !self.is_done() {
            self.sweep(now_ns);
        }
        match self.phase {
            Phase::New => {
                self.claim();
                self.phase = Phase::Claims { until_ns: None };
            }
            Phase::Claims { until_ns: Some(until_ns) } if now_ns >= until_ns => self.phase = Phase::Begins,
            Phase::Pauses { until_ns } if now_ns >= until_ns => self.phase = Phase::Begins,
            Phase::Waits { .. } | Phase::Sends if self.is_late(now_ns) => self.give_up(),
            Phase::Waits { until_ns: Some(until_ns) }
                if now_ns >= until_ns && (self.incoming.is_empty() || now_ns >= until_ns + LONGEST_NS) =>
            {
                if self.answers.is_empty() {
                    self.fail(StationError::NoAnswer { after_ms: self.timing.answer_ns / MS });
                } else {
                    self.done();
                }
            }
            _ => {}
        }
        if self.phase == Phase::Begins {
            self.begun_ns.get_or_insert(now_ns);
            self.begin();
        }
        if let Some(frame) = self.out.pop_front() {
            self.under_way.push_back(false);
            return Some(frame);
        }
        if self.phase != Phase::Sends {
            return None;
        }
        let next = self.outgoing.as_mut()?.next(now_ns);
        match next {
            Ok(Some(frame)) => {
                self.under_way.push_back(true);
                Some(frame)
            }
            Ok(None) => None,
            Err((error, last)) => {
                self.fail(error);
                self.under_way.push_back(false);
                Some(last)
            }
        }
    }

    fn sent(&mut self, now_ns: u64) {
        if self.under_way.pop_front() == Some(true) {
            if let Some(outgoing) = &mut self.outgoing {
                outgoing.sent(now_ns);
                if outgoing.is_done() {
                    self.done();
                }
            }
            return;
        }
        match &mut self.phase {
            // A claim that is defended is not begun again: who objects for ever must not hold us up for ever.
            Phase::Claims { until_ns: until_ns @ None } if self.out.is_empty() => {
                *until_ns = Some(now_ns + CLAIM_NS);
            }
            Phase::Waits { until_ns: until_ns @ None } => {
                *until_ns = Some(now_ns.saturating_add(self.timing.answer_ns));
            }
            Phase::Closing if self.out.is_empty() && self.under_way.is_empty() => self.done(),
            _ => {}
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        let Some(header) = Header::of(id) else { return };
        if self.is_done() {
            return;
        }
        // Our own frames do not come here.
        let is_ours = matches!(
            self.phase,
            Phase::Begins | Phase::Waits { .. } | Phase::Sends | Phase::Closing | Phase::Pauses { .. }
        );
        if is_ours && header.source == self.address && header.pgn != CLAIM {
            self.imposters += 1;
            // A node that uses an address without having claimed it is told whose it is (J1939-81).
            if self.imposters == 1 && self.phase != Phase::Closing {
                self.claim();
            }
            return;
        }
        match (header.pgn, <[u8; 8]>::try_from(data)) {
            (CLAIM, Ok(name)) => {
                self.claimed(header.source, u64::from_le_bytes(name));
                self.message(header, data.to_vec());
            }
            (REQUEST, _) if data.get(..3) == Some(&three(CLAIM)) => {
                let asks_us = header.destination == GLOBAL || header.destination == self.address;
                if asks_us && !matches!(self.phase, Phase::New | Phase::Closing) {
                    self.claim();
                }
            }
            (CONTROL, Ok(data)) => self.control(now_ns, header, data),
            (DATA, Ok(data)) => self.data(now_ns, header, data),
            (ACKNOWLEDGE, _) => self.message(header, data.to_vec()),
            _ if header.destination == GLOBAL || header.destination == self.address => {
                self.message(header, data.to_vec());
            }
            _ => {}
        }
    }

    fn gap(&mut self, now_ns: u64) {
        // A message's frames are numbered from 1 to 255 without wrapping, so a missing one is noticed and requested
        // again.
        let _ = now_ns;
    }

    fn due_ns(&self) -> Option<u64> {
        if !self.under_way.is_empty() {
            return self.incoming.iter().map(Incoming::due_ns).min();
        }
        let own = match self.phase {
            Phase::Claims { until_ns } => until_ns,
            Phase::Pauses { until_ns } => Some(until_ns),
            Phase::Waits { until_ns } if self.incoming.is_empty() => until_ns,
            Phase::Sends => self.outgoing.as_ref().and_then(Outgoing::due_ns),
            _ => None,
        };
        let late = self.begun_ns.map(|begun_ns| begun_ns.saturating_add(self.timing.patience_ns));
        let own = earlier(own, late.filter(|_| matches!(self.phase, Phase::Waits { .. } | Phase::Sends)));
        earlier(own, self.incoming.iter().map(Incoming::due_ns).min())
    }

    fn is_done(&self) -> bool {
        self.phase == Phase::Done && self.out.is_empty()
    }

    fn cancel(&mut self) -> Option<Frame> {
        if self.is_done() {
            return None;
        }
        let sending =
            self.outgoing.as_ref().filter(|_| self.phase == Phase::Sends).and_then(Outgoing::connection);
        let receiving = || self.incoming.iter().find_map(Incoming::open_connection);
        let (with, pgn) = sending.or_else(receiving)?;
        self.out.clear();
        self.fail(StationError::Cancelled);
        Some(long_message::abort(self.address, with, pgn, RESOURCES_NEEDED))
    }
}

#[cfg(test)]
mod tests;
