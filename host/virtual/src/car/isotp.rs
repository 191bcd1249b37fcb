//! ISO 15765-2 at an ECU's end: requests and answers of one frame or several, with flow control in both
//! directions.

use std::collections::VecDeque;

use cantap_wire::{Frame, Id};

/// Longest request that is accepted, in bytes. For longer ones, flow control reports an overflow.
const MAX_REQUEST: usize = 512;
/// A transfer ends after this much silence from the other side (N_Bs, N_Cr).
const PATIENCE_NS: u64 = 1_000_000_000;
/// How long an ECU takes to answer.
const THINKS_NS: u64 = 4_000_000;
/// The time until the next frame of an answer, if allowed.
const NEXT_NS: u64 = 400_000;
const MS_NS: u64 = 1_000_000;
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

    fn frame(&self, bytes: &[u8]) -> Frame {
        let mut data = [PADDING; 8];
        data[..bytes.len()].copy_from_slice(bytes);
        Frame::from_bus(self.answers_with, false, 8, data)
    }

    /// Takes a frame to this ECU. Returns a complete request. Only single frames are sent to all ECUs at
    /// once.
    pub fn hear(&mut self, frame: &Frame, to_all: bool, now_ns: u64) -> Option<Vec<u8>> {
        let data = frame.data();
        let (&first, rest) = data.split_first()?;
        match first >> 4 {
            0 => {
                let length = usize::from(first & 15);
                let request = rest.get(..length).filter(|request| !request.is_empty())?;
                self.receiving = None;
                Some(request.to_vec())
            }
            1 if !to_all => {
                let length = usize::from(first & 15) << 8 | usize::from(*rest.first()?);
                // It would have fitted in a single frame.
                if length < 8 || data.len() < 8 {
                    return None;
                }
                let takes = length <= MAX_REQUEST;
                let go_on = self.frame(&[if takes { 0x30 } else { 0x32 }, 0, 0]);
                self.ready.push_back((now_ns + NEXT_NS, go_on));
                self.receiving = takes.then(|| Receiving {
                    data: data[2..].to_vec(),
                    length,
                    number: 1,
                    until_ns: now_ns + PATIENCE_NS,
                });
                None
            }
            2 if !to_all => self.take_consecutive(first & 15, rest, now_ns),
            3 if !to_all => {
                self.take_flow_control(first & 15, rest, now_ns);
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

    fn take_flow_control(&mut self, status: u8, rest: &[u8], now_ns: u64) {
        let Some(sending) = self.sending.as_mut().filter(|sending| sending.waits) else { return };
        let (Some(&block), Some(&gap)) = (rest.first(), rest.get(1)) else { return };
        match status {
            0 => {
                sending.waits = false;
                sending.block = (block > 0).then_some(block);
                // Reserved values mean the longest (ISO 15765-2:2016, 9.6.5.5).
                sending.gap_ns = match gap {
                    0..=0x7F => u64::from(gap) * MS_NS,
                    0xF1..=0xF9 => u64::from(gap & 15) * 100_000,
                    _ => 127 * MS_NS,
                };
                sending.next_ns = now_ns + NEXT_NS;
            }
            1 => sending.until_ns = now_ns + PATIENCE_NS,
            _ => self.sending = None,
        }
    }

    /// Sends an answer. An unfinished earlier one is abandoned.
    pub fn answer(&mut self, data: Vec<u8>, now_ns: u64) {
        self.sending = None;
        self.ready.clear();
        let at_ns = now_ns + THINKS_NS;
        if data.len() < 8 {
            let single = [&[data.len() as u8][..], &data].concat();
            self.ready.push_back((at_ns, self.frame(&single)));
            return;
        }
        let head = [0x10 | (data.len() >> 8) as u8, data.len() as u8];
        self.ready.push_back((at_ns, self.frame(&[&head, &data[..6]].concat())));
        self.sending = Some(Sending {
            data,
            at: 6,
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
        sending.at += 7;
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
        let end = sending.data.len().min(sending.at + 7);
        Some(self.frame(&[&[0x20 | sending.number][..], &sending.data[sending.at..end]].concat()))
    }
}
