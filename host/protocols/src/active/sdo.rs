//! Reads and writes a CANopen node's objects as the client: expedited, in segments, or in blocks (CiA 301, 7.2.4.3).

pub use super::sdo_job::{SdoError, SdoIds, SdoJob};

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;
use crate::canopen::crc_of;

/// The longest object that is accepted, in bytes.
const MOST_BYTES: usize = 1 << 24;
/// How many frames of a block may wait in the sender's queue at a time.
const MOST_UNDER_WAY: usize = 16;
/// How often in a transfer frames of a block are requested or sent again.
const MOST_RETRIES: u32 = 20;
/// For how many answers' time a node may send without continuing the object.
const MOST_STALLED: u64 = 5;
/// How long a transfer may take altogether, unless said otherwise.
const PATIENCE_NS: u64 = 600_000_000_000;
/// Frames in a block: the maximum.
const BLOCK: u8 = 127;
const TIMED_OUT: u32 = 0x0504_0000;
const BAD_COMMAND: u32 = 0x0504_0001;
const BAD_TOGGLE: u32 = 0x0503_0000;
const BAD_CRC: u32 = 0x0504_0004;
const BAD_SEQUENCE: u32 = 0x0504_0003;
const OUT_OF_MEMORY: u32 = 0x0504_0005;
const BAD_LENGTH: u32 = 0x0607_0010;
const GENERAL: u32 = 0x0800_0000;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    New,
    /// The first request was sent.
    Initiated,
    /// A segment was requested or sent with this toggle bit.
    Segment {
        toggle: u8,
    },
    /// The node sends a block: the next sequence number.
    BlockIn {
        next: u8,
        is_gap: bool,
    },
    /// The node should end its block transfer.
    BlockInEnd,
    /// A block was sent: the number of frames in it.
    BlockOut {
        frames: u8,
    },
    /// All blocks were sent.
    BlockOutEnd,
    /// Our last frame.
    Closing,
}

/// Reads or writes one object.
#[derive(Clone, Debug)]
pub struct SdoClient {
    ids: SdoIds,
    object: [u8; 3],
    job: SdoJob,
    by_blocks: bool,
    timeout_ns: u64,
    step: Step,
    out: VecDeque<[u8; 8]>,
    under_way: usize,
    until_ns: Option<u64>,
    data: Vec<u8>,
    at: usize,
    size: Option<usize>,
    has_crc: bool,
    retries: u32,
    patience_ns: u64,
    begun_ns: Option<u64>,
    /// When received bytes last continued the object, and how many there were.
    grown: (u64, usize),
    end: Option<Result<(), SdoError>>,
}

impl SdoClient {
    /// For one object of a node. `by_blocks` requests a block transfer, which not every node supports. `timeout_ns` applies to
    /// each answer.
    pub const fn new(
        ids: SdoIds,
        index: u16,
        sub: u8,
        job: SdoJob,
        by_blocks: bool,
        timeout_ns: u64,
    ) -> Self {
        let [low, high] = index.to_le_bytes();
        Self {
            ids,
            object: [low, high, sub],
            job,
            by_blocks,
            timeout_ns,
            step: Step::New,
            out: VecDeque::new(),
            under_way: 0,
            until_ns: None,
            data: Vec::new(),
            at: 0,
            size: None,
            has_crc: false,
            retries: 0,
            patience_ns: PATIENCE_NS,
            begun_ns: None,
            grown: (0, 0),
            end: None,
        }
    }

    /// How long it may take altogether, however well it gets on; without this, ten minutes.
    pub const fn set_patience(&mut self, patience_ns: u64) {
        self.patience_ns = patience_ns;
    }

    /// The bytes read; empty for a write. Call it when the transfer is done.
    pub fn finish(self) -> Result<Vec<u8>, SdoError> {
        match self.end {
            Some(Err(error)) => Err(error),
            _ => Ok(self.data),
        }
    }

    fn done(&self) -> usize {
        if matches!(self.job, SdoJob::Read) { self.data.len() } else { self.at }
    }

    fn say(&mut self, frame: [u8; 8]) {
        self.until_ns = None;
        self.out.push_back(frame);
    }

    /// A command with the object's index.
    fn command(&self, command: u8, rest: [u8; 4]) -> [u8; 8] {
        let [low, high, sub] = self.object;
        [command, low, high, sub, rest[0], rest[1], rest[2], rest[3]]
    }

    fn abort(&mut self, code: u32, error: SdoError) {
        self.out.clear();
        let frame = self.command(0x80, code.to_le_bytes());
        self.say(frame);
        self.step = Step::Closing;
        self.end = Some(Err(error));
    }

    fn wrong(&mut self, code: u32) {
        let done = self.done();
        self.abort(code, SdoError::Wrong { code, done });
    }

    fn finished(&mut self) {
        self.until_ns = None;
        self.end = Some(Ok(()));
    }

    fn begin(&mut self) {
        self.step = Step::Initiated;
        let frame = match (&self.job, self.by_blocks) {
            (SdoJob::Read, false) => self.command(0x40, [0; 4]),
            (SdoJob::Read, true) => self.command(0xA4, [BLOCK, 0, 0, 0]),
            (SdoJob::Write(data), true) => self.command(0xC6, (data.len() as u32).to_le_bytes()),
            (SdoJob::Write(data), false) if (1..=4).contains(&data.len()) => {
                let mut rest = [0; 4];
                rest[..data.len()].copy_from_slice(data);
                self.command(0x23 | (4 - data.len() as u8) << 2, rest)
            }
            (SdoJob::Write(data), false) => self.command(0x21, (data.len() as u32).to_le_bytes()),
        };
        self.say(frame);
    }

    fn time_out(&mut self) {
        // The end of a block may be what is missing: the node is told the last frame understood.
        if let Step::BlockIn { next, .. } = self.step
            && next > 1
            && self.retries < MOST_RETRIES
        {
            self.acknowledge(next - 1, false);
            return;
        }
        let (after_ms, done) = (self.timeout_ns / 1_000_000, self.done());
        self.abort(TIMED_OUT, SdoError::NoAnswer { after_ms, done });
    }

    /// Ends what takes too long although answers come.
    fn hurry(&mut self, now_ns: u64) {
        if self.end.is_some() {
            return;
        }
        let begun_ns = *self.begun_ns.get_or_insert(now_ns);
        let done = self.done();
        let is_receiving = matches!(self.step, Step::BlockIn { .. });
        if self.data.len() != self.grown.1 || !is_receiving {
            self.grown = (now_ns, self.data.len());
        }
        let stalled_ns = self.timeout_ns.saturating_mul(MOST_STALLED);
        if now_ns >= begun_ns.saturating_add(self.patience_ns) {
            self.abort(TIMED_OUT, SdoError::TooSlow { after_s: self.patience_ns / 1_000_000_000, done });
        } else if now_ns >= self.grown.0.saturating_add(stalled_ns) {
            self.abort(TIMED_OUT, SdoError::Stalled { after_ms: stalled_ns / 1_000_000, done });
        }
    }

    /// Ends a received block: the frames up to this number were understood.
    fn acknowledge(&mut self, up_to: u8, is_last: bool) {
        if !is_last {
            self.retries += 1;
        }
        self.step = if is_last { Step::BlockInEnd } else { Step::BlockIn { next: 1, is_gap: false } };
        self.say([0xA2, up_to, BLOCK, 0, 0, 0, 0, 0]);
    }

    /// Appends received bytes; false if there are more than announced. Only the end of a block transfer says how many of its last
    /// seven count.
    fn append(&mut self, bytes: &[u8]) -> bool {
        self.data.extend_from_slice(bytes);
        self.data.len() <= self.size.map_or(MOST_BYTES, |size| size + 6)
    }

    /// The reason for too many bytes.
    const fn too_many(&self) -> u32 {
        if self.size.is_some() { BAD_LENGTH } else { OUT_OF_MEMORY }
    }

    fn read_begins(&mut self, data: [u8; 8]) {
        let command = data[0];
        let size = u32::from_le_bytes([data[4], data[5], data[6], data[7]]) as usize;
        match (command >> 5, self.by_blocks) {
            (2, _) if command & 2 != 0 => {
                let unused = if command & 1 != 0 { usize::from(command >> 2 & 3) } else { 0 };
                self.data = data[4..8 - unused].to_vec();
                self.finished();
            }
            (2, _) => {
                self.size = (command & 1 != 0).then_some(size);
                self.step = Step::Segment { toggle: 0 };
                self.say([0x60, 0, 0, 0, 0, 0, 0, 0]);
            }
            (6, true) if command & 1 == 0 => {
                self.size = (command & 2 != 0).then_some(size);
                self.has_crc = command & 4 != 0;
                self.step = Step::BlockIn { next: 1, is_gap: false };
                self.say([0xA3, 0, 0, 0, 0, 0, 0, 0]);
            }
            _ => return self.wrong(BAD_COMMAND),
        }
        if self.size.is_some_and(|size| size > MOST_BYTES) {
            self.wrong(OUT_OF_MEMORY);
        }
    }

    fn segment_came(&mut self, toggle: u8, data: [u8; 8]) {
        let command = data[0];
        if command >> 5 != 0 {
            return self.wrong(BAD_COMMAND);
        }
        if command >> 4 & 1 != toggle {
            return self.wrong(BAD_TOGGLE);
        }
        let used = 7 - usize::from(command >> 1 & 7);
        let is_last = command & 1 != 0;
        // A node that keeps sending empty segments would never end.
        if used == 0 && !is_last {
            return self.wrong(BAD_LENGTH);
        }
        if !self.append(&data[1..=used]) {
            return self.wrong(self.too_many());
        }
        if !is_last {
            let toggle = toggle ^ 1;
            self.step = Step::Segment { toggle };
            return self.say([0x60 | toggle << 4, 0, 0, 0, 0, 0, 0, 0]);
        }
        if self.size.is_some_and(|size| size != self.data.len()) {
            return self.wrong(BAD_LENGTH);
        }
        self.finished();
    }

    fn block_frame_came(&mut self, next: u8, is_gap: bool, data: [u8; 8]) {
        let (number, is_last) = (data[0] & 0x7F, data[0] & 0x80 != 0);
        if number == 0 {
            return self.wrong(BAD_SEQUENCE);
        }
        let follows = number == next && !is_gap;
        if follows && !self.append(&data[1..8]) {
            return self.wrong(self.too_many());
        }
        let next = if follows { next + 1 } else { next };
        let is_gap = !follows && number >= next || is_gap;
        if number == BLOCK || is_last {
            if is_gap && self.retries >= MOST_RETRIES {
                return self.wrong(BAD_SEQUENCE);
            }
            let is_whole = is_last && !is_gap;
            let retries = self.retries;
            self.acknowledge(next - 1, is_whole);
            if !is_gap {
                self.retries = retries;
            }
            return;
        }
        self.step = Step::BlockIn { next, is_gap };
    }

    fn blocks_end(&mut self, data: [u8; 8]) {
        let command = data[0];
        if command >> 5 != 6 || command & 3 != 1 {
            return self.wrong(BAD_COMMAND);
        }
        let unused = usize::from(command >> 2 & 7);
        let Some(length) = self.data.len().checked_sub(unused) else { return self.wrong(BAD_LENGTH) };
        self.data.truncate(length);
        if self.has_crc && crc_of(&self.data) != u16::from_le_bytes([data[1], data[2]]) {
            return self.wrong(BAD_CRC);
        }
        if self.size.is_some_and(|size| size != length) {
            return self.wrong(BAD_LENGTH);
        }
        self.step = Step::Closing;
        self.say([0xA1, 0, 0, 0, 0, 0, 0, 0]);
        self.end = Some(Ok(()));
    }

    /// Sends the next segment.
    fn write_segment(&mut self, toggle: u8) {
        let SdoJob::Write(data) = &self.job else { return };
        let end = data.len().min(self.at + 7);
        let bytes = &data[self.at..end];
        let mut frame = [0; 8];
        frame[0] = toggle << 4 | (7 - bytes.len() as u8) << 1 | u8::from(end == data.len());
        frame[1..=bytes.len()].copy_from_slice(bytes);
        self.at = end;
        self.step = Step::Segment { toggle };
        self.say(frame);
    }

    /// Sends the next block, of at most this many frames.
    fn write_block(&mut self, most: u8) {
        let SdoJob::Write(data) = &self.job else { return };
        let mut frames = Vec::new();
        let mut at = self.at;
        for number in 1..=most {
            let end = data.len().min(at + 7);
            let mut frame = [0; 8];
            frame[0] = number | u8::from(end == data.len()) << 7;
            frame[1..=end - at].copy_from_slice(&data[at..end]);
            frames.push(frame);
            at = end;
            if end == data.len() {
                break;
            }
        }
        self.step = Step::BlockOut { frames: frames.len() as u8 };
        for frame in frames {
            self.say(frame);
        }
    }

    fn block_acknowledged(&mut self, frames: u8, data: [u8; 8]) {
        let (up_to, next_most) = (data[1], data[2]);
        let SdoJob::Write(bytes) = &self.job else { return };
        let length = bytes.len();
        if data[0] >> 5 != 5 || data[0] & 3 != 2 {
            return self.wrong(BAD_COMMAND);
        }
        if up_to > frames || next_most == 0 || next_most > BLOCK {
            return self.wrong(BAD_SEQUENCE);
        }
        self.at = length.min(self.at + 7 * usize::from(up_to));
        if up_to < frames {
            self.retries += 1;
            if self.retries > MOST_RETRIES {
                return self.wrong(BAD_SEQUENCE);
            }
        }
        if self.at < length || up_to == 0 {
            return self.write_block(next_most);
        }
        let SdoJob::Write(bytes) = &self.job else { return };
        let [low, high] = if self.has_crc { crc_of(bytes).to_le_bytes() } else { [0; 2] };
        let unused = ((7 - length % 7) % 7) as u8;
        // An object without bytes also takes one frame, with no content.
        let unused = if length == 0 { 7 } else { unused };
        self.step = Step::BlockOutEnd;
        self.say([0xC1 | unused << 2, low, high, 0, 0, 0, 0, 0]);
    }

    fn write_goes_on(&mut self, data: [u8; 8]) {
        let SdoJob::Write(bytes) = &self.job else { return };
        let length = bytes.len();
        match self.step {
            Step::Initiated if self.by_blocks => {
                let most = data[4];
                if data[0] >> 5 != 5 || data[0] & 3 != 0 || most == 0 || most > BLOCK {
                    return self.wrong(BAD_COMMAND);
                }
                self.has_crc = data[0] & 4 != 0;
                self.write_block(most);
            }
            Step::Initiated if data[0] >> 5 != 3 => self.wrong(BAD_COMMAND),
            Step::Initiated if (1..=4).contains(&length) => {
                self.at = length;
                self.finished();
            }
            Step::Initiated => self.write_segment(0),
            Step::Segment { .. } if data[0] >> 5 != 1 => self.wrong(BAD_COMMAND),
            Step::Segment { toggle } if data[0] >> 4 & 1 != toggle => self.wrong(BAD_TOGGLE),
            Step::Segment { .. } if self.at == length => self.finished(),
            Step::Segment { toggle } => self.write_segment(toggle ^ 1),
            Step::BlockOut { frames } => self.block_acknowledged(frames, data),
            Step::BlockOutEnd if data[0] == 0xA1 => self.finished(),
            _ => self.wrong(BAD_COMMAND),
        }
    }
}

impl Machine for SdoClient {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if self.step == Step::New {
            self.begin();
        }
        if self.until_ns.is_some_and(|until_ns| now_ns >= until_ns) && self.end.is_none() {
            self.until_ns = None;
            self.time_out();
        }
        self.hurry(now_ns);
        if self.under_way >= MOST_UNDER_WAY {
            return None;
        }
        let bytes = self.out.pop_front()?;
        self.under_way += 1;
        Some(Frame::from_bus(self.ids.request, false, 8, bytes))
    }

    fn sent(&mut self, now_ns: u64) {
        self.under_way = self.under_way.saturating_sub(1);
        if self.under_way == 0 && self.out.is_empty() && self.end.is_none() {
            self.until_ns = Some(now_ns + self.timeout_ns);
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if self.end.is_some() || self.step == Step::New {
            return;
        }
        // Only one client may use a channel (CiA 301), and ours was confirmed by name.
        if id == self.ids.request {
            self.out.clear();
            self.until_ns = None;
            self.end = Some(Err(SdoError::OtherClient { done: self.done() }));
            return;
        }
        if id != self.ids.response {
            return;
        }
        let Ok(data) = <[u8; 8]>::try_from(data) else { return self.wrong(BAD_LENGTH) };
        if data[0] == 0x80 {
            self.out.clear();
            self.until_ns = None;
            let code = u32::from_le_bytes([data[4], data[5], data[6], data[7]]);
            self.end = Some(Err(SdoError::Aborted { code }));
            return;
        }
        // An answer to an earlier question does not count here.
        if self.step == Step::Initiated && data[1..4] != self.object {
            return;
        }
        if self.until_ns.is_some() {
            self.until_ns = Some(now_ns + self.timeout_ns);
        }
        match (&self.job, self.step) {
            (SdoJob::Read, Step::Initiated) => self.read_begins(data),
            (SdoJob::Read, Step::Segment { toggle }) => self.segment_came(toggle, data),
            (SdoJob::Read, Step::BlockIn { next, is_gap }) => self.block_frame_came(next, is_gap, data),
            (SdoJob::Read, Step::BlockInEnd) => self.blocks_end(data),
            _ => self.write_goes_on(data),
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // Frames of a block have numbers, each of which occurs only once in it, and the data have a CRC.
        let numbered = matches!(self.step, Step::BlockIn { .. });
        if self.end.is_none() && self.step != Step::New && !numbered && self.until_ns.is_some() {
            self.abort(GENERAL, SdoError::FramesLost);
        }
    }

    fn due_ns(&self) -> Option<u64> {
        self.until_ns
    }

    fn is_done(&self) -> bool {
        self.end.is_some() && self.out.is_empty()
    }

    fn cancel(&mut self) -> Option<Frame> {
        if self.step == Step::New || self.end.is_some() {
            return None;
        }
        self.out.clear();
        let done = self.done();
        self.end = Some(Err(SdoError::Cancelled { done }));
        Some(Frame::from_bus(self.ids.request, false, 8, self.command(0x80, GENERAL.to_le_bytes())))
    }
}

#[cfg(test)]
#[path = "sdo_tests.rs"]
mod tests;
