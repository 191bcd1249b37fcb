//! A J1939 node, or one of NMEA 2000: it claims and defends its address, takes requests, and sends messages of any length (J1939-21, J1939-81).
//!
//! It keeps to one message to all, and one to a single node, at a time; those after them wait. It does not obey a commanded address.

use std::collections::{BTreeMap, VecDeque};

use cantap_can::Frame;
use cantap_trace::Id;

use super::push_bounded;
use crate::active::station::StationError;
use crate::active::station::long_message::{Incoming, Outgoing, abort};
use crate::active::station::parts::{CONTROL, DATA, GLOBAL, MOST_BYTES, MS, frame, three};
use crate::active::{Machine, earlier};
use crate::j1939::{Header, MOST_FAST_BYTES, fast_frames};

/// Nobody may object to a claim after this time.
const CLAIM_NS: u64 = 250 * MS;
const NULL: u8 = 254;
const REQUEST: u32 = 0xEA00;
const ACKNOWLEDGE: u32 = 0xE800;
const COMMANDED_ADDRESS: u32 = 0xFED8;
/// The control bytes of an acknowledgement.
const POSITIVE: u8 = 0;
const NEGATIVE: u8 = 1;
const CLAIM: u32 = 0xEE00;
/// Addresses that any node may use, and for which the claim must be waited out.
const FREE: std::ops::RangeInclusive<u8> = 128..=247;
/// The NAME's bit for "arbitrary address capable".
const TAKES_ANY: u64 = 1 << 63;

/// Another node wants a parameter group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GroupRequest {
    /// The group, 18 bits.
    pub pgn: u32,
    /// Who asks.
    pub from: u8,
    /// Whether all were asked.
    pub to_all: bool,
}

/// A message of any length from another node, to this one or to all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GroupMessage {
    /// The group, 18 bits.
    pub pgn: u32,
    /// The sender.
    pub from: u8,
    /// Its bytes.
    pub data: Vec<u8>,
}

/// Why a message is not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NotSent {
    /// It would be too long.
    #[error("{length} bytes; a message has at most {most}")]
    TooLong {
        /// Its length in bytes.
        length: usize,
        /// What there is room for.
        most: usize,
    },
    /// The bus takes them more slowly than they come.
    #[error("too many messages wait to be sent; send them less often")]
    TooMany,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Claim {
    New,
    /// Sent; after its confirmation it is settled at this time.
    Sent {
        until_ns: Option<u64>,
    },
    Owned,
    Lost,
}

/// Whose frame is on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Of {
    Claim,
    Short,
    ToAll,
    ToOne,
}

/// A node.
#[derive(Debug)]
pub struct J1939Node {
    name: u64,
    address: u8,
    claim: Claim,
    taken: [bool; 256],
    out: VecDeque<(Of, Frame)>,
    under_way: VecDeque<Of>,
    to_all: VecDeque<Outgoing>,
    to_one: VecDeque<Outgoing>,
    incoming: Vec<Incoming>,
    requests: VecDeque<GroupRequest>,
    messages: VecDeque<GroupMessage>,
    /// The counter of each group's fast packets.
    counters: BTreeMap<u32, u8>,
    trouble: Option<StationError>,
}

impl J1939Node {
    /// A node with this NAME that wants this address, 0 to 253.
    pub const fn new(name: u64, address: u8) -> Self {
        Self {
            name,
            address,
            claim: Claim::New,
            taken: [false; 256],
            out: VecDeque::new(),
            under_way: VecDeque::new(),
            to_all: VecDeque::new(),
            to_one: VecDeque::new(),
            incoming: Vec::new(),
            requests: VecDeque::new(),
            messages: VecDeque::new(),
            counters: BTreeMap::new(),
            trouble: None,
        }
    }

    /// Its address, once nobody can object to it any more; [`None`] before, and if it has lost it.
    pub fn address(&self) -> Option<u8> {
        (self.claim == Claim::Owned).then_some(self.address)
    }

    /// The next request that nobody has taken.
    pub fn take_request(&mut self) -> Option<GroupRequest> {
        self.requests.pop_front()
    }

    /// The next message that nobody has taken.
    pub fn take_message(&mut self) -> Option<GroupMessage> {
        self.messages.pop_front()
    }

    /// What went wrong last, if nobody has asked yet.
    pub fn take_trouble(&mut self) -> Option<StationError> {
        self.trouble.take()
    }

    /// Sends a message to one node, or to all (255); more than 8 bytes by BAM or RTS/CTS. Without an address nothing is sent.
    ///
    /// # Errors
    /// If it is longer than 1785 bytes, or too many wait.
    pub fn send(&mut self, pgn: u32, to: u8, priority: u8, data: Vec<u8>) -> Result<(), NotSent> {
        let length = data.len();
        if length > MOST_BYTES {
            return Err(NotSent::TooLong { length, most: MOST_BYTES });
        }
        let Some(own) = self.address() else { return Ok(()) };
        if length <= 8 {
            return self.push([frame(priority, pgn, own, to, &data)]);
        }
        let queue = if to == GLOBAL { &mut self.to_all } else { &mut self.to_one };
        if queue.len() >= super::MOST_WAITING {
            return Err(NotSent::TooMany);
        }
        queue.push_back(Outgoing::new(own, to, pgn, data));
        Ok(())
    }

    /// Sends a message to all by NMEA 2000's fast packet.
    ///
    /// # Errors
    /// If it is longer than 223 bytes, or too many wait.
    pub fn send_fast(&mut self, pgn: u32, priority: u8, data: &[u8]) -> Result<(), NotSent> {
        if data.len() > MOST_FAST_BYTES {
            return Err(NotSent::TooLong { length: data.len(), most: MOST_FAST_BYTES });
        }
        let Some(source) = self.address() else { return Ok(()) };
        let counter = self.counters.entry(pgn).or_default();
        let header = Header { priority, pgn, source, destination: GLOBAL };
        let frames = fast_frames(header, *counter, data);
        *counter = (*counter + 1) & 7;
        self.push(frames)
    }

    /// Refuses a request: the node does not have the group. Requests to all are not refused (J1939-21, 5.4.2).
    pub fn refuse(&mut self, request: GroupRequest) {
        self.reply(NEGATIVE, request);
    }

    /// Acknowledges a request that is answered by no data, such as one for DM11. Requests to all are not acknowledged.
    pub fn acknowledge(&mut self, request: GroupRequest) {
        self.reply(POSITIVE, request);
    }

    /// An acknowledgement goes to all, and its fifth byte says for whom it is (J1939-21, 5.4.4).
    fn reply(&mut self, control: u8, request: GroupRequest) {
        let Some(own) = self.address() else { return };
        if !request.to_all {
            let [a, b, c] = three(request.pgn);
            let data = [control, 0xFF, 0xFF, 0xFF, request.from, a, b, c];
            let _ = self.push([frame(6, ACKNOWLEDGE, own, GLOBAL, &data)]);
        }
    }

    fn push(&mut self, frames: impl IntoIterator<Item = Frame>) -> Result<(), NotSent> {
        // A fast packet has 32 frames.
        if self.out.len() >= 32 * super::MOST_WAITING {
            return Err(NotSent::TooMany);
        }
        self.out.extend(frames.into_iter().map(|frame| (Of::Short, frame)));
        Ok(())
    }

    fn send_claim(&mut self) {
        self.out.push_back((Of::Claim, frame(6, CLAIM, self.address, GLOBAL, &self.name.to_le_bytes())));
    }

    /// Another node claims an address: of two with the same one, the lower NAME keeps it.
    fn claimed(&mut self, by: u8, name: u64) {
        self.taken[usize::from(by)] = true;
        if by != self.address || matches!(self.claim, Claim::New | Claim::Lost) {
            return;
        }
        if self.name < name {
            return self.send_claim();
        }
        let next = if self.name & TAKES_ANY == 0 {
            None
        } else {
            FREE.into_iter().find(|free| !self.taken[usize::from(*free)])
        };
        self.leave_address();
        if let Some(next) = next {
            (self.address, self.claim) = (next, Claim::Sent { until_ns: None });
        } else {
            self.trouble = Some(StationError::AddressTaken { address: self.address, name });
            (self.address, self.claim) = (NULL, Claim::Lost);
        }
        self.send_claim();
    }

    /// Whatever was begun with the old address is over.
    fn leave_address(&mut self) {
        self.out.clear();
        self.to_all.clear();
        self.to_one.clear();
        self.incoming.clear();
        self.disown(Of::ToAll);
        self.disown(Of::ToOne);
    }

    /// Somebody gives addresses: the node of that NAME claims the new one (J1939-81, 4.2.3; NMEA 2000 asks for it of every node). It goes
    /// to all, so that a node that has lost its address does not hear it.
    fn commanded(&mut self, data: &[u8]) {
        let Some((&address, name)) = data.split_last() else { return };
        if name != self.name.to_le_bytes() || address >= NULL {
            return;
        }
        self.leave_address();
        (self.address, self.claim) = (address, Claim::Sent { until_ns: None });
        self.send_claim();
    }

    /// Frames of a message that is over are nobody's when they have been on the bus.
    fn disown(&mut self, over: Of) {
        self.under_way.iter_mut().filter(|of| **of == over).for_each(|of| *of = Of::Short);
    }

    fn control(&mut self, now_ns: u64, own: u8, header: Header, data: [u8; 8]) {
        let pgn = u32::from_le_bytes([data[5], data[6], data[7], 0]);
        let from = header.source;
        if header.destination == own
            && matches!(data[0], 17 | 19 | 255)
            && let Some(outgoing) = self.to_one.front_mut().filter(|outgoing| outgoing.is_with(from, pgn))
        {
            if let Err(error) = outgoing.control(now_ns, data) {
                self.trouble = Some(error);
                self.to_one.pop_front();
                self.disown(Of::ToOne);
            }
            return;
        }
        match data[0] {
            16 if header.destination == own => {
                self.incoming.retain(|incoming| !incoming.is_of(from, false));
                match Incoming::connection(now_ns, header, data) {
                    Some(incoming) => self.incoming.push(incoming),
                    None => self.out.push_back((Of::Short, abort(own, from, pgn, 9))),
                }
            }
            32 if header.destination == GLOBAL => {
                self.incoming.retain(|incoming| !incoming.is_of(from, true));
                self.incoming.extend(Incoming::broadcast(now_ns, header, data));
            }
            255 if header.destination == own => {
                self.incoming.retain(|incoming| !(incoming.is_of(from, false) && incoming.pgn() == pgn));
            }
            _ => {}
        }
    }

    fn data(&mut self, now_ns: u64, own: u8, header: Header, data: [u8; 8]) {
        let to_all = header.destination == GLOBAL;
        let is_ours = |incoming: &Incoming| incoming.is_of(header.source, to_all);
        let Some(place) = self.incoming.iter().position(is_ours) else { return };
        if self.incoming[place].take(now_ns, data) {
            let incoming = self.incoming.remove(place);
            self.out.extend(incoming.last_word(own).map(|frame| (Of::Short, frame)));
            let (pgn, from) = (incoming.pgn(), incoming.from());
            if pgn == COMMANDED_ADDRESS {
                return self.commanded(&incoming.into_data());
            }
            push_bounded(&mut self.messages, GroupMessage { pgn, from, data: incoming.into_data() });
        }
    }

    /// Timeouts of incoming messages, and clear to send for them.
    fn sweep(&mut self, now_ns: u64) {
        let Some(own) = self.address() else { return };
        let mut at = 0;
        while at < self.incoming.len() {
            match self.incoming[at].next(now_ns, own) {
                Ok(frames) => {
                    self.out.extend(frames.map(|frame| (Of::Short, frame)));
                    at += 1;
                }
                Err((error, last)) => {
                    self.incoming.remove(at);
                    self.out.extend(last.map(|frame| (Of::Short, frame)));
                    self.trouble = Some(error);
                }
            }
        }
    }

    /// The next frame of the first message in a queue; one that fails is left out.
    fn next_of(&mut self, now_ns: u64, of: Of) -> Option<Frame> {
        let queue = if of == Of::ToAll { &mut self.to_all } else { &mut self.to_one };
        queue.pop_front_if(|outgoing| outgoing.is_done());
        match queue.front_mut()?.next(now_ns) {
            Ok(frame) => {
                self.under_way.extend(frame.map(|_| of));
                frame
            }
            Err((error, last)) => {
                queue.pop_front();
                self.trouble = Some(error);
                self.under_way.push_back(Of::Short);
                Some(last)
            }
        }
    }
}

impl Machine for J1939Node {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        match self.claim {
            Claim::New => {
                self.claim = Claim::Sent { until_ns: None };
                self.send_claim();
            }
            Claim::Sent { until_ns: Some(until_ns) } if now_ns >= until_ns => self.claim = Claim::Owned,
            _ => {}
        }
        self.sweep(now_ns);
        if let Some((of, frame)) = self.out.pop_front() {
            self.under_way.push_back(of);
            return Some(frame);
        }
        self.next_of(now_ns, Of::ToAll).or_else(|| self.next_of(now_ns, Of::ToOne))
    }

    fn sent(&mut self, now_ns: u64) {
        let of = self.under_way.pop_front();
        match of {
            Some(Of::Claim) => {
                // Other addresses may be used at once (J1939-81, 4.4.3).
                let settles_ns = if FREE.contains(&self.address) { CLAIM_NS } else { 0 };
                if let Claim::Sent { until_ns: until_ns @ None } = &mut self.claim {
                    *until_ns = Some(now_ns + settles_ns);
                }
            }
            Some(Of::ToAll | Of::ToOne) => {
                let queue = if of == Some(Of::ToAll) { &mut self.to_all } else { &mut self.to_one };
                if let Some(outgoing) = queue.front_mut() {
                    outgoing.sent(now_ns);
                }
            }
            Some(Of::Short) | None => {}
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        let Some(header) = Header::of(id) else { return };
        let eight = <[u8; 8]>::try_from(data);
        if let (CLAIM, Ok(name)) = (header.pgn, eight) {
            return self.claimed(header.source, u64::from_le_bytes(name));
        }
        let asks_for = data.get(..3).map(|pgn| u32::from_le_bytes([pgn[0], pgn[1], pgn[2], 0]) & 0x3_FFFF);
        let to_all = header.destination == GLOBAL;
        if header.pgn == REQUEST && asks_for == Some(CLAIM) {
            // Who has lost its address says so, too.
            if (to_all || header.destination == self.address) && self.claim != Claim::New {
                self.send_claim();
            }
            return;
        }
        let Some(own) = self.address() else { return };
        if header.source == own {
            // Whoever uses the address without having claimed it is told whose it is.
            return self.send_claim();
        }
        if !to_all && header.destination != own {
            return;
        }
        match (header.pgn, eight) {
            (REQUEST, _) => {
                if let Some(pgn) = asks_for {
                    push_bounded(&mut self.requests, GroupRequest { pgn, from: header.source, to_all });
                }
            }
            (CONTROL, Ok(data)) => self.control(now_ns, own, header, data),
            (DATA, Ok(data)) => self.data(now_ns, own, header, data),
            (CONTROL | DATA, Err(_)) => {}
            (pgn, _) => {
                let message = GroupMessage { pgn, from: header.source, data: data.to_vec() };
                push_bounded(&mut self.messages, message);
            }
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // A long message's frames are numbered without wrapping: a missing one is noticed and requested again.
    }

    fn due_ns(&self) -> Option<u64> {
        let claim_ns = match self.claim {
            Claim::Sent { until_ns } => until_ns,
            _ => None,
        };
        let outgoing = [&self.to_all, &self.to_one].into_iter().filter_map(|queue| queue.front()?.due_ns());
        let incoming = self.incoming.iter().map(Incoming::due_ns);
        earlier(claim_ns, outgoing.chain(incoming).min())
    }

    fn is_done(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests;
