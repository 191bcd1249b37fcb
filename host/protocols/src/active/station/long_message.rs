//! Messages of many frames, incoming and outgoing (J1939-21, 5.10).

use cantap_can::Frame;

use super::parts::{CONTROL, DATA, GLOBAL, MOST_BYTES, MS, StationError, frame, three};
use crate::j1939::Header;

/// Time between the frames of a message to all: 50 to 200 ms.
const BROADCAST_GAP_NS: u64 = 50 * MS;
/// Timeout for the next frame of a message (T1).
const NEXT_NS: u64 = 750 * MS;
/// Timeout for the first frame after clear to send (T2), and for clear to send after the last frame (T3).
const PEER_NS: u64 = 1250 * MS;
/// Timeout while the receiver holds the connection open (T4).
const HOLD_NS: u64 = 1050 * MS;
/// Frames per clear to send.
const BLOCK: u8 = 16;
/// How often frames of one message may be requested again.
const MOST_RETRIES: u32 = 5;
/// How often in a row a receiver may ask to wait.
const MOST_HOLDS: u32 = 60;

fn frames_of(length: usize) -> u8 {
    length.div_ceil(7).min(255) as u8
}

/// Ends a connection.
pub(crate) fn abort(from: u8, to: u8, pgn: u32, reason: u8) -> Frame {
    let [a, b, c] = three(pgn);
    frame(7, CONTROL, from, to, &[255, reason, 255, 255, 255, a, b, c])
}

/// An incoming message.
#[derive(Debug)]
pub(crate) struct Incoming {
    header: Header,
    pgn: u32,
    length: usize,
    total: u8,
    /// The most frames per clear to send.
    most: u8,
    data: Vec<u8>,
    next: u8,
    /// The last frame that was requested.
    asked: u8,
    is_asked: bool,
    until_ns: u64,
    retries: u32,
}

impl Incoming {
    fn new(now_ns: u64, header: Header, data: [u8; 8], most: u8) -> Option<Self> {
        let length = usize::from(u16::from_le_bytes([data[1], data[2]]));
        let total = frames_of(length);
        let is_right = (9..=MOST_BYTES).contains(&length) && data[3] == total;
        is_right.then(|| Self {
            header,
            pgn: u32::from_le_bytes([data[5], data[6], data[7], 0]) & 0x3_FFFF,
            length,
            total,
            most: most.clamp(1, BLOCK),
            data: Vec::new(),
            next: 1,
            asked: 0,
            is_asked: false,
            until_ns: now_ns + NEXT_NS,
            retries: 0,
        })
    }

    /// From a request to send.
    pub fn connection(now_ns: u64, header: Header, data: [u8; 8]) -> Option<Self> {
        Self::new(now_ns, header, data, if data[4] == 0 { 255 } else { data[4] })
    }

    /// From an announcement to all.
    pub fn broadcast(now_ns: u64, header: Header, data: [u8; 8]) -> Option<Self> {
        Self::new(now_ns, header, data, 255).map(|incoming| Self { is_asked: true, asked: 255, ..incoming })
    }

    const fn to_all(&self) -> bool {
        self.header.destination == GLOBAL
    }

    pub const fn is_of(&self, from: u8, to_all: bool) -> bool {
        self.header.source == from && self.to_all() == to_all
    }

    pub const fn pgn(&self) -> u32 {
        self.pgn
    }

    pub const fn from(&self) -> u8 {
        self.header.source
    }

    /// The sender and the group, if it is waiting for us.
    pub fn open_connection(&self) -> Option<(u8, u32)> {
        (!self.to_all()).then_some((self.from(), self.pgn))
    }

    pub fn into_data(mut self) -> Vec<u8> {
        self.data.truncate(self.length);
        self.data
    }

    /// Immediately if clear to send must be sent.
    pub const fn due_ns(&self) -> u64 {
        if self.is_asked { self.until_ns } else { 0 }
    }

    /// Requests the next frames, or gives up, with a final frame for the sender.
    pub fn next(&mut self, now_ns: u64, own: u8) -> Result<Option<Frame>, (StationError, Option<Frame>)> {
        if self.is_asked && now_ns >= self.until_ns {
            let after_ms = (if self.next == 1 && !self.to_all() { PEER_NS } else { NEXT_NS }) / MS;
            let error =
                StationError::Silent { from: self.from(), after_ms, done: self.next - 1, total: self.total };
            if self.to_all() {
                return Err((error, None));
            }
            if self.retries >= MOST_RETRIES {
                return Err((error, Some(abort(own, self.from(), self.pgn, 3))));
            }
            self.retries += 1;
            self.is_asked = false;
        }
        if self.is_asked {
            return Ok(None);
        }
        let count = self.most.min(self.total - (self.next - 1));
        (self.asked, self.is_asked) = (self.next - 1 + count, true);
        self.until_ns = now_ns + PEER_NS;
        let [a, b, c] = three(self.pgn);
        Ok(Some(frame(7, CONTROL, own, self.from(), &[17, count, self.next, 255, 255, a, b, c])))
    }

    /// Takes a frame; returns whether the message is complete.
    pub fn take(&mut self, now_ns: u64, data: [u8; 8]) -> bool {
        if !self.is_asked {
            return false;
        }
        // Missing frames are requested again after the timeout, or when the last of those requested has arrived.
        if data[0] == self.next {
            self.data.extend_from_slice(&data[1..]);
            self.until_ns = now_ns + NEXT_NS;
            if self.next == self.total {
                return true;
            }
            self.next += 1;
            if self.next > self.asked {
                self.is_asked = false;
            }
        } else if data[0] == self.asked && !self.to_all() {
            self.until_ns = now_ns;
        }
        false
    }

    /// The final frame to the sender of a complete message.
    pub fn last_word(&self, own: u8) -> Option<Frame> {
        let [low, high] = (self.length as u16).to_le_bytes();
        let [a, b, c] = three(self.pgn);
        (!self.to_all())
            .then(|| frame(7, CONTROL, own, self.from(), &[19, low, high, self.total, 255, a, b, c]))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    New,
    /// Announced to all, or frames sent: when the next may follow.
    Gap {
        next_ns: Option<u64>,
    },
    /// Waiting for the receiver, since the last confirmation.
    Awaits {
        timeout_ns: u64,
        until_ns: Option<u64>,
    },
    /// Frames up to this one were requested.
    Sends {
        up_to: u8,
    },
    Done,
}

/// An outgoing message.
#[derive(Debug)]
pub(crate) struct Outgoing {
    own: u8,
    to: u8,
    pgn: u32,
    data: Vec<u8>,
    next: u8,
    /// The highest sequence number sent.
    reached: u8,
    state: State,
    under_way: u32,
    holds: u32,
    retries: u32,
}

impl Outgoing {
    pub const fn new(own: u8, to: u8, pgn: u32, data: Vec<u8>) -> Self {
        Self {
            own,
            to,
            pgn,
            data,
            next: 1,
            reached: 0,
            state: State::New,
            under_way: 0,
            holds: 0,
            retries: 0,
        }
    }

    pub fn is_done(&self) -> bool {
        self.state == State::Done
    }

    /// The receiver and the group, if it is waiting for us.
    pub fn connection(&self) -> Option<(u8, u32)> {
        (self.to != GLOBAL && self.state != State::New && !self.is_done()).then_some((self.to, self.pgn))
    }

    pub const fn is_with(&self, from: u8, pgn: u32) -> bool {
        self.to == from && self.pgn == pgn
    }

    pub const fn due_ns(&self) -> Option<u64> {
        match self.state {
            State::Gap { next_ns } => next_ns,
            State::Awaits { until_ns, .. } => until_ns,
            _ => None,
        }
    }

    fn data_frame(&mut self) -> Frame {
        let from = usize::from(self.next - 1) * 7;
        let end = self.data.len().min(from + 7);
        let mut bytes = [0xFF; 8];
        bytes[0] = self.next;
        bytes[1..=end - from].copy_from_slice(&self.data[from..end]);
        self.reached = self.reached.max(self.next);
        self.next = self.next.saturating_add(1);
        frame(7, DATA, self.own, self.to, &bytes)
    }

    /// The next frame to send now. The error includes a final frame to the receiver.
    pub fn next(&mut self, now_ns: u64) -> Result<Option<Frame>, (StationError, Frame)> {
        let total = frames_of(self.data.len());
        let [low, high] = (self.data.len() as u16).to_le_bytes();
        let [a, b, c] = three(self.pgn);
        let frame = match self.state {
            State::New if self.to == GLOBAL => {
                self.state = State::Gap { next_ns: None };
                frame(7, CONTROL, self.own, GLOBAL, &[32, low, high, total, 255, a, b, c])
            }
            State::New => {
                self.state = State::Awaits { timeout_ns: PEER_NS, until_ns: None };
                frame(7, CONTROL, self.own, self.to, &[16, low, high, total, 255, a, b, c])
            }
            State::Gap { next_ns: Some(next_ns) } if now_ns >= next_ns => {
                self.state = State::Gap { next_ns: None };
                self.data_frame()
            }
            State::Sends { up_to } if self.next <= up_to => {
                let frame = self.data_frame();
                if self.reached == 255 && self.next == 255 || self.next > up_to {
                    self.state = State::Awaits { timeout_ns: PEER_NS, until_ns: None };
                }
                frame
            }
            State::Awaits { timeout_ns, until_ns: Some(until_ns) } if now_ns >= until_ns => {
                let error = StationError::Silent {
                    from: self.to,
                    after_ms: timeout_ns / MS,
                    done: self.reached,
                    total,
                };
                return Err((error, abort(self.own, self.to, self.pgn, 3)));
            }
            _ => return Ok(None),
        };
        self.under_way += 1;
        Ok(Some(frame))
    }

    pub fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        let total = frames_of(self.data.len());
        match &mut self.state {
            State::Gap { .. } if self.reached == total => self.state = State::Done,
            State::Gap { next_ns } => *next_ns = Some(now_ns + BROADCAST_GAP_NS),
            State::Awaits { timeout_ns, until_ns } if self.under_way == 0 => {
                *until_ns = Some(now_ns + *timeout_ns);
            }
            _ => {}
        }
    }

    /// Takes a control frame from the receiver.
    pub fn control(&mut self, now_ns: u64, data: [u8; 8]) -> Result<(), StationError> {
        let total = frames_of(self.data.len());
        match data[0] {
            255 => return Err(StationError::Aborted { from: self.to, reason: data[1] }),
            19 if self.reached == total => self.state = State::Done,
            17 if data[1] == 0 => {
                self.holds += 1;
                if self.holds > MOST_HOLDS {
                    return Err(StationError::Endless { from: self.to, times: self.holds });
                }
                self.state = State::Awaits { timeout_ns: HOLD_NS, until_ns: Some(now_ns + HOLD_NS) };
            }
            // Clear to send is not allowed while frames are in flight (J1939-21); they will be confirmed
            // soon.
            17 => {
                let (count, next) = (data[1], data[2]);
                let is_again = next <= self.reached;
                self.retries += u32::from(is_again);
                if next == 0 || next > total || self.retries > MOST_RETRIES * 4 {
                    return Err(StationError::Endless { from: self.to, times: self.retries });
                }
                self.holds = 0;
                self.next = next;
                self.state = State::Sends { up_to: total.min((next - 1).saturating_add(count)) };
            }
            _ => {}
        }
        Ok(())
    }
}
