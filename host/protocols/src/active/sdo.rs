//! Reads and writes a CANopen node's objects as the client: expedited, in segments, or in blocks (CiA 301, 7.2.4.3).

pub use super::sdo_job::{SdoError, SdoIds, SdoJob};

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::Machine;
use crate::canopen::codec::sdo::{
    BlockEnd, BlockSegment, Content, MOST_BLOCK_FRAMES, SEGMENT_BYTES, SdoObject, SdoRequest, SdoResponse,
    Segment, abort, crc_of,
};

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
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    New,
    /// The first request was sent.
    Initiated,
    /// A segment was requested or sent with this toggle bit.
    Segment {
        toggle: bool,
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
    object: SdoObject,
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
        Self {
            ids,
            object: SdoObject { index, sub },
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

    fn queue(&mut self, frame: [u8; 8]) {
        self.until_ns = None;
        self.out.push_back(frame);
    }

    fn request(&mut self, request: SdoRequest) {
        self.queue(request.encode());
    }

    fn abort(&mut self, code: u32, error: SdoError) {
        self.out.clear();
        self.request(SdoRequest::Abort(self.object, code));
        self.step = Step::Closing;
        self.end = Some(Err(error));
    }

    /// Aborts because of what the node has sent.
    fn reject(&mut self, code: u32) {
        let done = self.done();
        self.abort(code, SdoError::Wrong { code, done });
    }

    fn finished(&mut self) {
        self.until_ns = None;
        self.end = Some(Ok(()));
    }

    fn begin(&mut self) {
        self.step = Step::Initiated;
        let object = self.object;
        let request = match (&self.job, self.by_blocks) {
            (SdoJob::Read, false) => SdoRequest::Upload(object),
            (SdoJob::Read, true) => {
                SdoRequest::BlockUpload { object, crc: true, block_size: MOST_BLOCK_FRAMES, threshold: 0 }
            }
            (SdoJob::Write(data), true) => {
                SdoRequest::BlockDownload { object, crc: true, size: Some(data.len() as u32) }
            }
            (SdoJob::Write(data), false) => {
                let content = Content::expedited(data);
                SdoRequest::Download(object, content.unwrap_or(Content::Segmented(Some(data.len() as u32))))
            }
        };
        self.request(request);
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
        self.abort(abort::TIMEOUT, SdoError::NoAnswer { after_ms, done });
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
            self.abort(abort::TIMEOUT, SdoError::TooSlow { after_s: self.patience_ns / 1_000_000_000, done });
        } else if now_ns >= self.grown.0.saturating_add(stalled_ns) {
            self.abort(abort::TIMEOUT, SdoError::Stalled { after_ms: stalled_ns / 1_000_000, done });
        }
    }

    /// Ends a received block: the frames up to this number were understood.
    fn acknowledge(&mut self, up_to: u8, is_last: bool) {
        if !is_last {
            self.retries += 1;
        }
        self.step = if is_last { Step::BlockInEnd } else { Step::BlockIn { next: 1, is_gap: false } };
        self.request(SdoRequest::BlockUploadAcknowledge { taken: up_to, block_size: MOST_BLOCK_FRAMES });
    }

    /// Appends received bytes; false if there are more than announced. Only the end of a block transfer says how many of its last
    /// seven count.
    fn append(&mut self, bytes: &[u8]) -> bool {
        self.data.extend_from_slice(bytes);
        self.data.len() <= self.size.map_or(MOST_BYTES, |size| size + 6)
    }

    /// The reason for too many bytes.
    const fn too_many(&self) -> u32 {
        if self.size.is_some() { abort::LENGTH } else { abort::MEMORY }
    }

    fn read_begins(&mut self, response: Option<SdoResponse>) {
        match response {
            Some(SdoResponse::Upload(_, Content::Expedited { bytes, length })) => {
                self.data = bytes[..usize::from(length.unwrap_or(4))].to_vec();
                self.finished();
            }
            Some(SdoResponse::Upload(_, Content::Segmented(size))) => {
                self.size = size.map(|size| size as usize);
                self.step = Step::Segment { toggle: false };
                self.request(SdoRequest::UploadSegment { toggle: false });
            }
            Some(SdoResponse::BlockUpload { crc, size, .. }) if self.by_blocks => {
                self.size = size.map(|size| size as usize);
                self.has_crc = crc;
                self.step = Step::BlockIn { next: 1, is_gap: false };
                self.request(SdoRequest::BlockUploadStart);
            }
            _ => return self.reject(abort::COMMAND),
        }
        if self.size.is_some_and(|size| size > MOST_BYTES) {
            self.reject(abort::MEMORY);
        }
    }

    fn segment_came(&mut self, toggle: bool, response: Option<SdoResponse>) {
        let Some(SdoResponse::UploadSegment(segment)) = response else { return self.reject(abort::COMMAND) };
        if segment.toggle != toggle {
            return self.reject(abort::TOGGLE);
        }
        // A node that keeps sending empty segments would never end.
        if segment.data().is_empty() && !segment.is_last {
            return self.reject(abort::LENGTH);
        }
        if !self.append(segment.data()) {
            return self.reject(self.too_many());
        }
        if !segment.is_last {
            self.step = Step::Segment { toggle: !toggle };
            return self.request(SdoRequest::UploadSegment { toggle: !toggle });
        }
        if self.size.is_some_and(|size| size != self.data.len()) {
            return self.reject(abort::LENGTH);
        }
        self.finished();
    }

    fn block_frame_came(&mut self, next: u8, is_gap: bool, segment: BlockSegment) {
        let BlockSegment { number, is_last, bytes } = segment;
        if number == 0 {
            return self.reject(abort::SEQUENCE);
        }
        let follows = number == next && !is_gap;
        if follows && !self.append(&bytes) {
            return self.reject(self.too_many());
        }
        let next = if follows { next + 1 } else { next };
        let is_gap = !follows && number >= next || is_gap;
        if number == MOST_BLOCK_FRAMES || is_last {
            if is_gap && self.retries >= MOST_RETRIES {
                return self.reject(abort::SEQUENCE);
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

    fn blocks_end(&mut self, response: Option<SdoResponse>) {
        let Some(SdoResponse::BlockUploadEnd(end)) = response else { return self.reject(abort::COMMAND) };
        let Some(length) = self.data.len().checked_sub(end.unused.into()) else {
            return self.reject(abort::LENGTH);
        };
        self.data.truncate(length);
        if self.has_crc && crc_of(&self.data) != end.crc {
            return self.reject(abort::CRC);
        }
        if self.size.is_some_and(|size| size != length) {
            return self.reject(abort::LENGTH);
        }
        self.step = Step::Closing;
        self.request(SdoRequest::BlockUploadEnd);
        self.end = Some(Ok(()));
    }

    /// Sends the next segment.
    fn write_segment(&mut self, toggle: bool) {
        let SdoJob::Write(data) = &self.job else { return };
        let end = data.len().min(self.at + SEGMENT_BYTES);
        let segment = Segment::new(toggle, end == data.len(), &data[self.at..end]);
        self.at = end;
        self.step = Step::Segment { toggle };
        self.request(SdoRequest::DownloadSegment(segment));
    }

    /// Sends the next block, of at most this many frames.
    fn write_block(&mut self, most: u8) {
        let SdoJob::Write(data) = &self.job else { return };
        let mut frames = Vec::new();
        let mut at = self.at;
        for number in 1..=most {
            let end = data.len().min(at + SEGMENT_BYTES);
            frames.push(BlockSegment::new(number, end == data.len(), &data[at..end]).encode());
            at = end;
            if end == data.len() {
                break;
            }
        }
        self.step = Step::BlockOut { frames: frames.len() as u8 };
        for frame in frames {
            self.queue(frame);
        }
    }

    fn block_acknowledged(&mut self, frames: u8, response: Option<SdoResponse>) {
        let SdoJob::Write(bytes) = &self.job else { return };
        let length = bytes.len();
        let Some(SdoResponse::BlockDownloadAcknowledge { taken, block_size }) = response else {
            return self.reject(abort::COMMAND);
        };
        if taken > frames || !(1..=MOST_BLOCK_FRAMES).contains(&block_size) {
            return self.reject(abort::SEQUENCE);
        }
        self.at = length.min(self.at + SEGMENT_BYTES * usize::from(taken));
        if taken < frames {
            self.retries += 1;
            if self.retries > MOST_RETRIES {
                return self.reject(abort::SEQUENCE);
            }
        }
        if self.at < length || taken == 0 {
            return self.write_block(block_size);
        }
        let SdoJob::Write(bytes) = &self.job else { return };
        let crc = if self.has_crc { crc_of(bytes) } else { 0 };
        self.step = Step::BlockOutEnd;
        self.request(SdoRequest::BlockDownloadEnd(BlockEnd::of(length, crc)));
    }

    fn write_goes_on(&mut self, response: Option<SdoResponse>) {
        let SdoJob::Write(bytes) = &self.job else { return };
        let length = bytes.len();
        match (self.step, response) {
            (Step::Initiated, Some(SdoResponse::BlockDownload { crc, block_size, .. }))
                if self.by_blocks && (1..=MOST_BLOCK_FRAMES).contains(&block_size) =>
            {
                self.has_crc = crc;
                self.write_block(block_size);
            }
            (Step::Initiated, Some(SdoResponse::Download(_))) if !self.by_blocks => {
                if (1..=4).contains(&length) {
                    self.at = length;
                    self.finished();
                } else {
                    self.write_segment(false);
                }
            }
            (Step::Segment { toggle: expected }, Some(SdoResponse::DownloadSegment { toggle })) => {
                if toggle != expected {
                    self.reject(abort::TOGGLE);
                } else if self.at == length {
                    self.finished();
                } else {
                    self.write_segment(!expected);
                }
            }
            (Step::BlockOut { frames }, response) => self.block_acknowledged(frames, response),
            (Step::BlockOutEnd, Some(SdoResponse::BlockDownloadEnd)) => self.finished(),
            _ => self.reject(abort::COMMAND),
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
        let Ok(data) = <[u8; 8]>::try_from(data) else { return self.reject(abort::LENGTH) };
        let response = SdoResponse::decode(data);
        if let Some(SdoResponse::Abort(_, code)) = response {
            self.out.clear();
            self.until_ns = None;
            self.end = Some(Err(SdoError::Aborted { code }));
            return;
        }
        // An answer to an earlier question does not count here.
        if self.step == Step::Initiated && SdoObject::decode(data) != self.object {
            return;
        }
        if self.until_ns.is_some() {
            self.until_ns = Some(now_ns + self.timeout_ns);
        }
        match (&self.job, self.step) {
            (SdoJob::Read, Step::Initiated) => self.read_begins(response),
            (SdoJob::Read, Step::Segment { toggle }) => self.segment_came(toggle, response),
            (SdoJob::Read, Step::BlockIn { next, is_gap }) => {
                self.block_frame_came(next, is_gap, BlockSegment::decode(data));
            }
            (SdoJob::Read, Step::BlockInEnd) => self.blocks_end(response),
            _ => self.write_goes_on(response),
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        // Frames of a block have numbers, each of which occurs only once in it, and the data have a CRC.
        let numbered = matches!(self.step, Step::BlockIn { .. });
        if self.end.is_none() && self.step != Step::New && !numbered && self.until_ns.is_some() {
            self.abort(abort::GENERAL, SdoError::FramesLost);
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
        let frame = SdoRequest::Abort(self.object, abort::GENERAL).encode();
        Some(Frame::from_bus(self.ids.request, false, 8, frame))
    }
}

#[cfg(test)]
#[path = "sdo_tests.rs"]
mod tests;
