//! ISO 15765-2 at an ECU's end: requests and answers of one frame or several, with flow control in both
//! directions.

use std::collections::VecDeque;

use cantap_protocols::iso_tp::{FlowStatus, Pci, parse};
use cantap_wire::{Frame, Id};

/// Longest request that is accepted, in bytes. For longer ones, flow control reports an overflow.
const MAX_REQUEST: u32 = 512;
/// A transfer ends after this much silence from the other side (N_Bs, N_Cr).
const PATIENCE_NS: u64 = 1_000_000_000;
/// How long an ECU takes to answer.
const THINKS_NS: u64 = 4_000_000;
/// The time until the next frame of an answer, if allowed.
const NEXT_NS: u64 = 400_000;
/// Fills frames to eight bytes.
const PADDING: u8 = 0xAA;

/// An answer of several frames.
#[derive(Debug)]
struct Sending {
    data: Vec<u8>,
    at: usize,
    number: u8,
    /// Consecutive frames until the next flow control; `None` if there will be none.
    block: Option<u8>,
    gap_ns: u64,
    /// Waits for flow control until this time.
    waits: bool,
    until_ns: u64,
    next_ns: u64,
}

/// A request of several frames.
#[derive(Debug)]
struct Receiving {
    data: Vec<u8>,
    length: usize,
    number: u8,
    until_ns: u64,
}

/// One ECU's connection with testers.
#[derive(Debug)]
pub struct IsoTp {
    answers_with: Id,
    ready: VecDeque<(u64, Frame)>,
    sending: Option<Sending>,
    receiving: Option<Receiving>,
}

impl IsoTp {
    /// A connection whose answers have this identifier.
    pub const fn new(answers_with: Id) -> Self {
        Self { answers_with, ready: VecDeque::new(), sending: None, receiving: None }
    }

    fn frame(&self, pci: Pci<'_>) -> Frame {
        let (bytes, length) = pci.encode(None, Some(PADDING));
        Frame::from_bus(self.answers_with, false, length, bytes)
    }

    /// Takes a frame to this ECU. Returns a complete request. Only single frames are sent to all ECUs at
    /// once.
    pub fn hear(&mut self, frame: &Frame, to_all: bool, now_ns: u64) -> Option<Vec<u8>> {
        let Ok(pci) = parse(frame.data(), 0) else {
            // Flow control of a reserved status ends an answer (N_INVALID_FS in ISO 15765-2); other faults change nothing.
            if !to_all && frame.data().first().is_some_and(|first| first >> 4 == 3) {
                self.sending = self.sending.take().filter(|sending| !sending.waits);
            }
            return None;
        };
        match pci? {
            Pci::Single(request) => {
                self.receiving = None;
                Some(request.to_vec())
            }
            // One byte less would have fitted in a single frame.
            Pci::First { length, data } if !to_all && length >= 8 => {
                let takes = length <= MAX_REQUEST;
                let status = if takes { FlowStatus::Go } else { FlowStatus::Overflow };
                let flow = self.frame(Pci::Flow { status, block_size: 0, separation_us: 0 });
                self.ready.push_back((now_ns + NEXT_NS, flow));
                self.receiving = takes.then(|| Receiving {
                    data: data.to_vec(),
                    length: length as usize,
                    number: 1,
                    until_ns: now_ns + PATIENCE_NS,
                });
                None
            }
            Pci::Consecutive { number, data } if !to_all => self.take_consecutive(number, data, now_ns),
            Pci::Flow { status, block_size, separation_us } if !to_all => {
                self.take_flow_control(status, block_size, separation_us, now_ns);
                None
            }
            _ => None,
        }
    }

    fn take_consecutive(&mut self, number: u8, rest: &[u8], now_ns: u64) -> Option<Vec<u8>> {
        let mut receiving = self.receiving.take().filter(|receiving| now_ns <= receiving.until_ns)?;
        if number != receiving.number {
            return None;
        }
        receiving.data.extend_from_slice(rest);
        receiving.number = (number + 1) & 15;
        receiving.until_ns = now_ns + PATIENCE_NS;
        if receiving.data.len() < receiving.length {
            self.receiving = Some(receiving);
            return None;
        }
        receiving.data.truncate(receiving.length);
        Some(receiving.data)
    }

    fn take_flow_control(&mut self, status: FlowStatus, block_size: u8, separation_us: u32, now_ns: u64) {
        let Some(sending) = self.sending.as_mut().filter(|sending| sending.waits) else { return };
        match status {
            FlowStatus::Go => {
                sending.waits = false;
                sending.block = (block_size > 0).then_some(block_size);
                sending.gap_ns = u64::from(separation_us) * 1000;
                sending.next_ns = now_ns + NEXT_NS;
            }
            FlowStatus::Wait => sending.until_ns = now_ns + PATIENCE_NS,
            FlowStatus::Overflow => self.sending = None,
        }
    }

    /// Sends an answer. An unfinished earlier one is abandoned.
    pub fn answer(&mut self, data: Vec<u8>, now_ns: u64) {
        self.sending = None;
        self.ready.clear();
        let at_ns = now_ns + THINKS_NS;
        let single = Pci::Single(&data);
        if data.len() <= single.room(None) {
            self.ready.push_back((at_ns, self.frame(single)));
            return;
        }
        let first = Pci::First { length: data.len() as u32, data: &data };
        let at = first.room(None);
        self.ready.push_back((at_ns, self.frame(first)));
        self.sending = Some(Sending {
            data,
            at,
            number: 1,
            block: None,
            gap_ns: 0,
            waits: true,
            until_ns: at_ns + PATIENCE_NS,
            next_ns: 0,
        });
    }

    /// When the next frame is due.
    pub fn due(&mut self, now_ns: u64) -> Option<u64> {
        if self.sending.as_ref().is_some_and(|sending| sending.waits && now_ns > sending.until_ns) {
            self.sending = None;
        }
        let ready = self.ready.front().map(|(at_ns, _)| *at_ns);
        let next = self.sending.as_ref().filter(|sending| !sending.waits).map(|sending| sending.next_ns);
        ready.or(next)
    }

    /// Takes the frame that is due, which is now on the bus.
    pub fn take(&mut self, now_ns: u64) -> Option<Frame> {
        if let Some((_, frame)) = self.ready.pop_front() {
            return Some(frame);
        }
        let frame = self.peek()?;
        let sending = self.sending.as_mut()?;
        sending.at += Pci::Consecutive { number: 0, data: &[] }.room(None);
        sending.number = (sending.number + 1) & 15;
        sending.next_ns = now_ns + sending.gap_ns.max(NEXT_NS);
        if let Some(block) = &mut sending.block {
            *block -= 1;
            sending.waits = *block == 0;
            sending.until_ns = now_ns + PATIENCE_NS;
        }
        if sending.at >= sending.data.len() {
            self.sending = None;
        }
        Some(frame)
    }

    /// The frame that is due.
    pub fn peek(&self) -> Option<Frame> {
        if let Some((_, frame)) = self.ready.front() {
            return Some(*frame);
        }
        let sending = self.sending.as_ref()?;
        let data = &sending.data[sending.at.min(sending.data.len())..];
        Some(self.frame(Pci::Consecutive { number: sending.number, data }))
    }
}
