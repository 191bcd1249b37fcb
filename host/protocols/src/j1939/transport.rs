//! Messages of many frames: SAE J1939-21's transport protocol, and ISO 11783-3's extended one.
//!
//! Memory: at most 256 in progress, each of at most 64 KiB.

use std::collections::BTreeMap;

use rustc_hash::FxHashMap;
use smallvec::SmallVec;

use super::header::{GLOBAL, Header, pgn};
use crate::{Bytes, Trouble};

/// TP.CM, TP.DT, ETP.CM, ETP.DT.
pub const CONTROL: u32 = 0xEC00;
pub const DATA: u32 = 0xEB00;
pub const EXTENDED_CONTROL: u32 = 0xC800;
pub const EXTENDED_DATA: u32 = 0xC700;

/// Maximum time between two frames of a broadcast: T1 (J1939-21, 5.10.2.4).
const BROADCAST_NS: i64 = 750_000_000;
/// Maximum time that one side waits for the other: T2 and T3.
const PEER_NS: i64 = 1_250_000_000;
const SWEEP_NS: i64 = 100_000_000;
const MOST_OPEN: usize = 256;
const MOST_BYTES: usize = 1 << 16;
/// Bytes of the message in one frame.
const FRAME_BYTES: usize = 7;
/// The most frames that a receiver can clear at a time: of those that came before an earlier one, no more are kept.
const MOST_AHEAD: u32 = 255;

/// How a message of many frames was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// To all, without an answer.
    Broadcast,
    /// To one receiver, which says when to send.
    Connection,
    /// The same for more than 1785 bytes.
    Extended,
    /// NMEA 2000's fast packets.
    FastPacket,
}

impl Way {
    /// The name for display.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Broadcast => "BAM",
            Self::Connection => "RTS/CTS",
            Self::Extended => "ETP",
            Self::FastPacket => "fast packet",
        }
    }
}

/// A message, complete or as far as it got.
#[derive(Clone, Debug)]
pub struct Assembled {
    pub time_ns: i64,
    pub start_ns: i64,
    pub channel: u8,
    /// The header of the message itself.
    pub header: Header,
    pub way: Way,
    pub data: Bytes,
    /// The expected number of bytes.
    pub size: u32,
    pub frames: u32,
    /// Time from the request to send to the first clear to send, in nanoseconds.
    pub cleared_ns: Option<i64>,
    pub trouble: Option<Trouble>,
    pub frames_lost: bool,
}

/// A message in progress.
#[derive(Clone, Debug)]
pub(super) struct Open {
    /// The message; its data end where the first frame is missing.
    pub message: Assembled,
    /// The first frame that has not come, from 1 (of the whole message).
    pub next: u32,
    /// Frames that came before it.
    ahead: BTreeMap<u32, SmallVec<[u8; FRAME_BYTES]>>,
    /// Number of frames before the window of an extended transfer.
    offset: u32,
    /// Why a frame is missing, until it has come after all.
    gap: Option<Trouble>,
}

impl Open {
    const fn new(message: Assembled) -> Self {
        Self { message, next: 1, ahead: BTreeMap::new(), offset: 0, gap: None }
    }

    /// Number of frames of the whole message.
    fn count(&self) -> u32 {
        self.message.size.div_ceil(FRAME_BYTES as u32)
    }

    /// Takes the bytes of a frame, numbered from 1, in whatever order the receiver asks for them; some may come again. The error says
    /// what is missing because of it.
    fn put(&mut self, number: u32, bytes: &[u8]) -> Result<(), Trouble> {
        let place = (number as usize).wrapping_sub(1).wrapping_mul(FRAME_BYTES);
        let Some(missing) = (self.message.size as usize).checked_sub(place).filter(|left| *left > 0) else {
            return Err(Trouble::Sequence { expected: self.next, got: number });
        };
        let Some(bytes) = bytes.get(..missing.min(FRAME_BYTES)) else {
            return Err(Trouble::Malformed("a frame was shorter than its place"));
        };
        if number < self.next {
            if let Some(before) = self.message.data.get_mut(place..place + bytes.len()) {
                before.copy_from_slice(bytes);
            }
            return Ok(());
        }
        if number > self.next {
            if number - self.next <= MOST_AHEAD {
                self.ahead.insert(number, SmallVec::from_slice(bytes));
            }
            return Err(Trouble::Sequence { expected: self.next, got: number });
        }
        self.append(bytes);
        while let Some(next) = self.ahead.remove(&self.next) {
            self.append(&next);
        }
        if self.ahead.is_empty() {
            self.gap = None;
        }
        Ok(())
    }

    /// The next frame's bytes.
    fn append(&mut self, bytes: &[u8]) {
        let room = MOST_BYTES.saturating_sub(self.message.data.len());
        self.message.data.extend_from_slice(&bytes[..bytes.len().min(room)]);
        self.next += 1;
    }
}

/// Reassembles messages.
#[derive(Clone, Debug, Default)]
pub struct LongMessages {
    open: FxHashMap<(u8, u8, u8, bool), Open>,
    /// Messages that ended early, or whose beginning was not observed: the last frame of each, so that the rest is reported
    /// once.
    headless: FxHashMap<(u8, u8, u8, bool), u8>,
    /// Connections whose last frame was received but that the receiver has not acknowledged: it may request frames again that we
    /// have.
    delivered: FxHashMap<(u8, u8, u8, bool), i64>,
    sweep_ns: i64,
}

/// Why a connection was aborted (J1939-21, table 7).
fn reason(code: u8) -> &'static str {
    match code {
        1 => "the receiver has as many connections as it can",
        2 => "resources are needed for another task",
        3 => "timeout",
        4 => "clear to send while data was being sent",
        5 => "too many retransmissions",
        6 => "unexpected data frame",
        7 => "bad sequence number",
        8 => "sequence number twice",
        9 => "too long for the receiver",
        10 => "unexpected offset of an extended transfer",
        11 => "offset of another parameter group",
        12 => "more frames in an offset than were cleared",
        13 => "bad offset of an extended transfer",
        15 => "clear to send of another parameter group",
        16 => "more was asked for than the message has",
        250 => "another reason",
        _ => "unknown reason",
    }
}

impl LongMessages {
    /// Frames on the channel are missing.
    pub fn interrupt(&mut self, channel: u8) {
        for open in self.open.values_mut().filter(|open| open.message.channel == channel) {
            open.message.frames_lost = true;
        }
    }

    /// Those in progress.
    pub fn open(&self) -> impl Iterator<Item = &Assembled> {
        self.open.values().map(|open| &open.message)
    }

    /// Ends whatever has timed out.
    pub fn advance(&mut self, now_ns: i64, out: &mut impl FnMut(Assembled)) {
        if self.open.is_empty() || now_ns < self.sweep_ns {
            return;
        }
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let patience = |open: &Open| match open.message.way {
            Way::Broadcast => BROADCAST_NS,
            _ => PEER_NS,
        };
        let over = |open: &Open| now_ns.saturating_sub(open.message.time_ns) > patience(open);
        let mut late: Vec<_> = self.open.extract_if(|_, open| over(open)).map(|(_, open)| open).collect();
        late.sort_by_key(|open| open.message.time_ns);
        for mut open in late {
            let patience = patience(&open);
            open.message.time_ns = open.message.time_ns.saturating_add(patience);
            end(open, Trouble::Timeout { after_ms: (patience / 1_000_000) as u32 }, out);
        }
    }

    /// The trace has ended.
    pub fn finish(&mut self, out: &mut impl FnMut(Assembled)) {
        let mut open: Vec<_> = self.open.drain().map(|(_, open)| open).collect();
        open.sort_by_key(|open| open.message.start_ns);
        for open in open {
            end(open, Trouble::Unfinished, out);
        }
    }

    fn begin(&mut self, key: (u8, u8, u8, bool), open: Open, out: &mut impl FnMut(Assembled)) {
        self.headless.remove(&key);
        self.delivered.remove(&key);
        if let Some(before) = self.open.remove(&key) {
            end(before, Trouble::Overlapped, out);
        }
        if self.open.len() >= MOST_OPEN
            && let Some(oldest) =
                self.open.iter().min_by_key(|(_, open)| open.message.time_ns).map(|(key, _)| *key)
            && let Some(oldest) = self.open.remove(&oldest)
        {
            end(oldest, Trouble::GivenUp, out);
        }
        if self.open.is_empty() {
            self.sweep_ns = open.message.time_ns.saturating_add(SWEEP_NS);
        }
        self.open.insert(key, open);
    }

    /// Takes a frame of connection management.
    pub fn control(
        &mut self,
        channel: u8,
        time_ns: i64,
        header: Header,
        data: &[u8],
        out: &mut impl FnMut(Assembled),
    ) -> Result<(), &'static str> {
        let extended = header.pgn == EXTENDED_CONTROL;
        let &[control, a, b, c, d, e, f, g] = data else {
            return Err("connection management has 8 bytes");
        };
        let (source, destination) = (header.source, header.destination);
        let of = Header { pgn: pgn([e, f, g]), ..header };
        // A message from the receiver is about the transfer in the other direction.
        let back = (channel, destination, source, extended);
        let message = Assembled {
            time_ns,
            start_ns: time_ns,
            channel,
            header: of,
            way: Way::Connection,
            data: Bytes::new(),
            size: u32::from(u16::from_le_bytes([a, b])),
            frames: 1,
            cleared_ns: None,
            trouble: None,
            frames_lost: false,
        };
        match (control, extended) {
            (16 | 32, false) => {
                if message.size == 0 || u32::from(c) != message.size.div_ceil(7) {
                    return Err("the number of frames does not suit the number of bytes");
                }
                let way = if control == 32 { Way::Broadcast } else { Way::Connection };
                let destination = if control == 32 { GLOBAL } else { destination };
                self.begin(
                    (channel, source, destination, false),
                    Open::new(Assembled { way, ..message }),
                    out,
                );
            }
            (20, true) => {
                let size = u32::from_le_bytes([a, b, c, d]);
                let message = Assembled { way: Way::Extended, size, ..message };
                self.begin((channel, source, destination, true), Open::new(message), out);
            }
            (17 | 21, _) => {
                let Some(open) = self.open.get_mut(&back) else { return Ok(()) };
                let message = &mut open.message;
                (message.time_ns, message.frames) = (time_ns, message.frames + 1);
                message.cleared_ns.get_or_insert(time_ns.saturating_sub(message.start_ns));
            }
            (22, true) => {
                let forward = (channel, source, destination, true);
                let Some(open) = self.open.get_mut(&forward) else { return Ok(()) };
                open.offset = u32::from_le_bytes([b, c, d, 0]);
                open.message.frames += 1;
                open.message.time_ns = time_ns;
            }
            (19 | 23, _) => {
                self.delivered.remove(&back);
                // Everything received completely was passed on with its last frame; what is still here is
                // incomplete.
                if let Some(mut open) = self.open.remove(&back) {
                    open.message.time_ns = time_ns;
                    let got = open.count().saturating_add(1);
                    let trouble = open.gap.unwrap_or(Trouble::Sequence { expected: open.next, got });
                    end(open, trouble, out);
                }
            }
            (255, _) => {
                let forward = (channel, source, destination, extended);
                // Both may send to each other at the same time: the group shows which message is meant.
                let means = |key| self.open.get(key).is_some_and(|open| open.message.header.pgn == of.pgn);
                let key = if means(&forward) && !means(&back) { forward } else { back };
                self.delivered.remove(&back);
                let found = self.open.remove(&key).or_else(|| self.open.remove(&forward));
                if let Some(mut open) = found {
                    open.message.time_ns = time_ns;
                    open.message.frames += 1;
                    end(open, Trouble::Aborted(reason(a)), out);
                } else {
                    out(Assembled { trouble: Some(Trouble::Aborted(reason(a))), size: 0, ..message });
                }
            }
            _ => return Err("connection management of unknown kind"),
        }
        Ok(())
    }

    /// Takes a data frame; false if it is the first of those that belong to nothing in progress.
    pub fn data(
        &mut self,
        channel: u8,
        time_ns: i64,
        header: Header,
        data: &[u8],
        out: &mut impl FnMut(Assembled),
    ) -> bool {
        let key = (channel, header.source, header.destination, header.pgn == EXTENDED_DATA);
        let Some((&sequence, bytes)) = data.split_first() else { return true };
        let Some(open) = self.open.get_mut(&key) else {
            // Sent again for a receiver that missed what was received here.
            if let Some(last_ns) = self.delivered.get_mut(&key) {
                let age_ns = time_ns.saturating_sub(*last_ns);
                *last_ns = time_ns;
                if age_ns <= PEER_NS {
                    return true;
                }
                self.delivered.remove(&key);
            }
            if self.headless.len() >= MOST_OPEN {
                self.headless.clear();
            }
            let before = self.headless.insert(key, sequence);
            return before.is_some_and(|before| before.wrapping_add(1) == sequence);
        };
        let message = &mut open.message;
        (message.time_ns, message.frames) = (time_ns, message.frames + 1);
        let number = open.offset.saturating_add(sequence.into());
        if let Err(trouble) = open.put(number, bytes) {
            if open.message.way == Way::Broadcast {
                if let Some(open) = self.open.remove(&key) {
                    self.headless.insert(key, sequence);
                    end(open, trouble, out);
                }
            } else {
                // A receiver that also misses it requests it again.
                open.gap.get_or_insert(trouble);
            }
            return true;
        }
        if open.next > open.count()
            && let Some(open) = self.open.remove(&key)
        {
            if open.message.size as usize > MOST_BYTES {
                end(open, Trouble::Cut, out);
                return true;
            }
            if open.message.way != Way::Broadcast {
                if self.delivered.len() >= MOST_OPEN {
                    self.delivered.clear();
                }
                self.delivered.insert(key, time_ns);
            }
            out(open.message);
        }
        true
    }
}

fn end(open: Open, trouble: Trouble, out: &mut impl FnMut(Assembled)) {
    out(Assembled { trouble: Some(trouble), ..open.message });
}
