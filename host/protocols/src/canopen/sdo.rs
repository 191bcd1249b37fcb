//! SDO transfers: expedited, in segments, or in blocks (CiA 301, 7.2.4.3).
//!
//! Memory: one transfer for each of 127 nodes on each channel, of at most 64 KiB.

use super::codec::sdo::{
    BlockEnd, BlockSegment, Content, MOST_BLOCK_FRAMES, SEGMENT_BYTES, SdoObject, SdoRequest, SdoResponse,
    crc_of,
};
use crate::{Bytes, Trouble};

/// How long either side may take. CiA 301 gives no time; masters use 0.3 to 2 s.
pub const TIMEOUT_NS: i64 = 2_000_000_000;
const MOST_BYTES: usize = 1 << 16;

/// How the bytes were sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// In the first frame.
    Expedited,
    /// Frame by frame, each confirmed.
    Segmented,
    /// Up to 127 frames per confirmation.
    Block,
}

impl Mode {
    /// The name for display.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Expedited => "expedited",
            Self::Segmented => "segmented",
            Self::Block => "block",
        }
    }
}

/// A transfer, complete or as far as it got.
#[derive(Clone, Debug)]
pub struct SdoTransfer {
    pub start_ns: i64,
    pub time_ns: i64,
    pub index: u16,
    pub sub: u8,
    pub is_write: bool,
    pub mode: Mode,
    pub data: Bytes,
    /// The expected number of bytes, if known.
    pub size: Option<u32>,
    pub frames: u32,
    /// From the request to the first answer, in nanoseconds.
    pub response_ns: Option<i64>,
    pub abort: Option<u32>,
    pub trouble: Option<Trouble>,
    pub frames_lost: bool,
}

/// The meaning of the bytes in the current frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Commands.
    Command,
    /// Segments of a block from the client.
    FromClient,
    /// Segments of a block from the server.
    FromServer,
}

/// One node's server.
#[derive(Clone, Debug)]
pub struct Sdo {
    pub open: Option<SdoTransfer>,
    phase: Phase,
    toggle: bool,
    /// Number of bytes before the current block, number of its frames received in order, and whether one was
    /// out of order.
    block_start: usize,
    block_next: u8,
    last_segment: bool,
    /// What follows belongs to a transfer that has ended or was not observed, which was reported.
    is_orphan: bool,
    /// Whether each side supports a CRC.
    crc: [bool; 2],
}

impl Default for Sdo {
    fn default() -> Self {
        Self {
            open: None,
            phase: Phase::Command,
            toggle: false,
            block_start: 0,
            block_next: 1,
            last_segment: false,
            is_orphan: false,
            crc: [false; 2],
        }
    }
}

impl Sdo {
    /// Takes a frame from the client or the server; returns what it ends: an abandoned transfer, and a completed one.
    pub fn take(&mut self, time_ns: i64, from_client: bool, data: &[u8]) -> [Option<SdoTransfer>; 2] {
        let short = Trouble::Malformed("an SDO frame has 8 bytes");
        let Some(bytes) = self.padded(from_client, data) else {
            return [None, Some(headless(time_ns, data, short))];
        };
        let mut ended = self.take_whole(time_ns, from_client, bytes);
        if data.len() < bytes.len()
            && let Some(transfer) = ended[1].as_mut().or(self.open.as_mut())
        {
            transfer.trouble.get_or_insert(short);
        }
        ended
    }

    /// With the unused bytes, which some devices leave out. `None` if others are missing, or there are too many.
    fn padded(&self, from_client: bool, data: &[u8]) -> Option<[u8; 8]> {
        let mut bytes = [0; 8];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        let used = match (self.phase, from_client) {
            (Phase::FromClient, true) | (Phase::FromServer, false) => 8,
            (_, true) => SdoRequest::used_bytes(bytes[0]),
            (_, false) => SdoResponse::used_bytes(bytes[0]),
        };
        (!data.is_empty() && data.len() >= used).then_some(bytes)
    }

    fn take_whole(&mut self, time_ns: i64, from_client: bool, bytes: [u8; 8]) -> [Option<SdoTransfer>; 2] {
        if from_client {
            self.take_request(time_ns, bytes)
        } else {
            [None, self.take_response(time_ns, bytes)]
        }
    }

    fn take_request(&mut self, time_ns: i64, bytes: [u8; 8]) -> [Option<SdoTransfer>; 2] {
        let request = SdoRequest::decode(bytes);
        let mut behind = None;
        // If the client starts a new transfer while a block comes from the server, it has abandoned the
        // block.
        if self.phase != Phase::FromClient && request.is_some_and(|request| request.begins()) {
            behind = self.end(Trouble::Overlapped);
            self.phase = Phase::Command;
            self.is_orphan = false;
        }
        if let Some(open) = &mut self.open {
            open.time_ns = time_ns;
            open.frames += 1;
        }
        let done = match request {
            Some(SdoRequest::Abort(object, code)) if self.is_abort(object) => {
                Some(self.abort(time_ns, object, code))
            }
            _ if self.phase == Phase::FromClient => self.block_segment(BlockSegment::decode(bytes)),
            Some(request) => self.apply_request(time_ns, request, bytes),
            None => None,
        };
        [behind, done]
    }

    fn take_response(&mut self, time_ns: i64, bytes: [u8; 8]) -> Option<SdoTransfer> {
        let response = SdoResponse::decode(bytes);
        // The first answer names the object. One that names another is not to this request.
        if self.phase == Phase::Command
            && self.open.is_some()
            && let Some(named) = response.and_then(|response| response.names())
            && !self.is_of(named)
        {
            return Some(unasked(time_ns, bytes));
        }
        if let Some(open) = &mut self.open {
            open.time_ns = time_ns;
            open.frames += 1;
            if open.response_ns.is_none() {
                open.response_ns = Some(time_ns.saturating_sub(open.start_ns));
            }
        }
        match response {
            Some(SdoResponse::Abort(object, code)) if self.is_abort(object) => {
                Some(self.abort(time_ns, object, code))
            }
            _ if self.phase == Phase::FromServer => self.block_segment(BlockSegment::decode(bytes)),
            response => self.apply_response(time_ns, response, bytes),
        }
    }

    /// Whether a frame that begins like an abort is one: within a block, only if it names the object.
    fn is_abort(&self, object: SdoObject) -> bool {
        self.phase == Phase::Command || self.is_of(object)
    }

    fn is_of(&self, object: SdoObject) -> bool {
        self.open.as_ref().is_some_and(|open| open.object() == object)
    }

    /// Ends the current transfer.
    pub fn end(&mut self, trouble: Trouble) -> Option<SdoTransfer> {
        let open = self.open.take()?;
        self.phase = Phase::Command;
        // Whatever still arrives of it has been reported with it.
        self.is_orphan = true;
        Some(SdoTransfer { trouble: open.trouble.or(Some(trouble)), ..open })
    }

    fn abort(&mut self, time_ns: i64, object: SdoObject, code: u32) -> SdoTransfer {
        self.phase = Phase::Command;
        let open = self.open.take().unwrap_or_else(|| fresh(time_ns, object, false, Mode::Expedited));
        SdoTransfer { abort: Some(code), trouble: Some(Trouble::Aborted(super::names::abort(code))), ..open }
    }

    fn done(&mut self) -> Option<SdoTransfer> {
        let mut open = self.open.take()?;
        self.phase = Phase::Command;
        let short = open.size.is_some_and(|size| size as usize != open.data.len());
        if short && open.trouble.is_none() {
            open.trouble = Some(Trouble::Malformed("the number of bytes is another than was said"));
        }
        Some(open)
    }

    fn apply_request(&mut self, time_ns: i64, request: SdoRequest, bytes: [u8; 8]) -> Option<SdoTransfer> {
        match request {
            SdoRequest::Download(object, content) => {
                let mut transfer = fresh(time_ns, object, true, Mode::of(content));
                transfer.begin(content);
                (self.toggle, self.open) = (false, Some(transfer));
                None
            }
            SdoRequest::DownloadSegment(segment) => {
                // It is completed by its confirmation.
                let Some(open) =
                    self.open.as_mut().filter(|open| open.is_write && open.mode == Mode::Segmented)
                else {
                    return self.orphan(headless(time_ns, &bytes, Trouble::Headless));
                };
                if segment.toggle != self.toggle {
                    return self.end(toggle_error(self.toggle));
                }
                append(open, segment.data());
                self.last_segment = segment.is_last;
                None
            }
            SdoRequest::Upload(object) => {
                (self.toggle, self.open) = (false, Some(fresh(time_ns, object, false, Mode::Expedited)));
                None
            }
            SdoRequest::UploadSegment { toggle } => {
                self.open.as_ref()?;
                if toggle == self.toggle { None } else { self.end(toggle_error(self.toggle)) }
            }
            SdoRequest::BlockUpload { object, crc, .. } => {
                self.open = Some(fresh(time_ns, object, false, Mode::Block));
                self.crc = [crc, false];
                None
            }
            SdoRequest::BlockUploadEnd => self.done(),
            SdoRequest::BlockUploadAcknowledge { taken, .. } => {
                self.confirm_block(taken);
                if !self.last_segment {
                    self.phase = Phase::FromServer;
                }
                None
            }
            SdoRequest::BlockUploadStart => {
                self.begin_block();
                self.phase = Phase::FromServer;
                None
            }
            SdoRequest::BlockDownload { object, crc, size } => {
                let transfer = SdoTransfer { size, ..fresh(time_ns, object, true, Mode::Block) };
                (self.open, self.crc) = (Some(transfer), [crc, false]);
                None
            }
            SdoRequest::BlockDownloadEnd(end) => {
                self.end_block(end);
                None
            }
            // Not of this transfer.
            SdoRequest::Abort(..) => None,
        }
    }

    fn apply_response(
        &mut self,
        time_ns: i64,
        response: Option<SdoResponse>,
        bytes: [u8; 8],
    ) -> Option<SdoTransfer> {
        let Some(open) = &mut self.open else {
            // An answer to an unobserved request.
            let transfer = unasked(time_ns, bytes);
            // Segments and their confirmations do not name an object.
            let is_segment =
                matches!(response, Some(SdoResponse::UploadSegment(_) | SdoResponse::DownloadSegment { .. }));
            return if is_segment { self.orphan(transfer) } else { Some(transfer) };
        };
        match response? {
            SdoResponse::Download(_) => (open.mode == Mode::Expedited).then(|| self.done()).flatten(),
            SdoResponse::Upload(_, content) => {
                // Also in answer to a request for blocks, which a server need not support.
                open.mode = Mode::of(content);
                open.begin(content);
                self.toggle = false;
                if open.mode == Mode::Expedited { self.done() } else { None }
            }
            SdoResponse::DownloadSegment { toggle } => {
                if toggle != self.toggle {
                    return self.end(toggle_error(self.toggle));
                }
                self.toggle = !self.toggle;
                if std::mem::take(&mut self.last_segment) { self.done() } else { None }
            }
            SdoResponse::UploadSegment(segment) => {
                if segment.toggle != self.toggle {
                    return self.end(toggle_error(self.toggle));
                }
                self.toggle = !self.toggle;
                append(open, segment.data());
                if segment.is_last { self.done() } else { None }
            }
            SdoResponse::BlockDownload { crc, .. } => {
                self.crc[1] = crc;
                self.begin_block();
                self.phase = Phase::FromClient;
                None
            }
            SdoResponse::BlockDownloadAcknowledge { taken, .. } => {
                self.confirm_block(taken);
                if !self.last_segment {
                    self.phase = Phase::FromClient;
                }
                None
            }
            SdoResponse::BlockDownloadEnd => self.done(),
            SdoResponse::BlockUpload { crc, size, .. } => {
                open.size = size;
                self.crc[1] = crc;
                None
            }
            SdoResponse::BlockUploadEnd(end) => {
                self.end_block(end);
                None
            }
            // Not of this transfer.
            SdoResponse::Abort(..) => None,
        }
    }

    /// Segments of a transfer that is not in progress are reported once.
    fn orphan(&mut self, transfer: SdoTransfer) -> Option<SdoTransfer> {
        (!std::mem::replace(&mut self.is_orphan, true)).then_some(transfer)
    }

    fn begin_block(&mut self) {
        self.block_start = self.open.as_ref().map_or(0, |open| open.data.len());
        (self.block_next, self.last_segment) = (1, false);
    }

    fn block_segment(&mut self, segment: BlockSegment) -> Option<SdoTransfer> {
        let open = self.open.as_mut()?;
        // The receiver also rejects frames that are out of order, and requests them again.
        if segment.number == self.block_next {
            self.block_next += 1;
            append(open, &segment.bytes);
            self.last_segment = segment.is_last;
        } else if segment.is_last {
            self.last_segment = true;
        }
        if segment.is_last || segment.number == MOST_BLOCK_FRAMES {
            self.phase = Phase::Command;
        }
        None
    }

    /// The receiver has accepted this many frames of the block.
    fn confirm_block(&mut self, taken: u8) {
        self.phase = Phase::Command;
        let ours = self.block_next - 1;
        if let Some(open) = &mut self.open {
            if taken > ours {
                open.trouble
                    .get_or_insert(Trouble::Sequence { expected: self.block_next.into(), got: taken.into() });
            } else if taken < ours {
                open.data.truncate(self.block_start + usize::from(taken) * SEGMENT_BYTES);
                self.last_segment = false;
            }
        }
        let last = self.last_segment;
        self.begin_block();
        self.last_segment = last;
    }

    fn end_block(&mut self, end: BlockEnd) {
        let Some(open) = &mut self.open else { return };
        open.data.truncate(open.data.len().saturating_sub(end.unused.into()));
        if self.crc == [true; 2]
            && open.trouble.is_none()
            && open.data.len() < MOST_BYTES
            && crc_of(&open.data) != end.crc
        {
            open.trouble = Some(Trouble::Malformed("the CRC is wrong"));
        }
    }
}

impl Mode {
    const fn of(content: Content) -> Self {
        match content {
            Content::Expedited { .. } => Self::Expedited,
            Content::Segmented(_) => Self::Segmented,
        }
    }
}

impl SdoTransfer {
    const fn object(&self) -> SdoObject {
        SdoObject { index: self.index, sub: self.sub }
    }

    /// Takes what the frame that begins it says of the bytes.
    fn begin(&mut self, content: Content) {
        match content {
            Content::Expedited { bytes, length } => {
                self.data = Bytes::from_slice(&bytes[..usize::from(length.unwrap_or(4))]);
            }
            Content::Segmented(Some(size)) => self.size = Some(size),
            Content::Segmented(None) => {}
        }
    }
}

fn headless(time_ns: i64, data: &[u8], trouble: Trouble) -> SdoTransfer {
    SdoTransfer {
        data: Bytes::from_slice(data),
        trouble: Some(trouble),
        ..fresh(time_ns, SdoObject::default(), false, Mode::Expedited)
    }
}

/// A server's answer to a request that was not observed.
fn unasked(time_ns: i64, bytes: [u8; 8]) -> SdoTransfer {
    let response = SdoResponse::decode(bytes);
    let is_write = matches!(response, Some(SdoResponse::Download(_)));
    let mut transfer = fresh(time_ns, SdoObject::decode(bytes), is_write, Mode::Expedited);
    if let Some(SdoResponse::Upload(_, content @ Content::Expedited { .. })) = response {
        transfer.begin(content);
    }
    SdoTransfer { trouble: Some(Trouble::Headless), ..transfer }
}

fn toggle_error(expected: bool) -> Trouble {
    Trouble::Sequence { expected: expected.into(), got: (!expected).into() }
}

fn append(open: &mut SdoTransfer, bytes: &[u8]) {
    let room = MOST_BYTES.saturating_sub(open.data.len());
    if bytes.len() > room {
        open.trouble.get_or_insert(Trouble::Cut);
    }
    open.data.extend_from_slice(&bytes[..bytes.len().min(room)]);
}

fn fresh(time_ns: i64, object: SdoObject, is_write: bool, mode: Mode) -> SdoTransfer {
    SdoTransfer {
        start_ns: time_ns,
        time_ns,
        index: object.index,
        sub: object.sub,
        is_write,
        mode,
        data: Bytes::new(),
        size: None,
        frames: 1,
        response_ns: None,
        abort: None,
        trouble: None,
        frames_lost: false,
    }
}
