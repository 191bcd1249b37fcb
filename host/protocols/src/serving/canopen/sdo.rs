//! The SDO server: expedited, in segments and in blocks, in both directions (CiA 301, 7.2.4.3).

use crate::canopen::codec::sdo::{
    BlockEnd, BlockSegment, Content, MOST_BLOCK_FRAMES, SEGMENT_BYTES, SdoObject, SdoRequest, SdoResponse,
    Segment, abort, crc_of,
};

use super::dictionary::{MOST_OBJECT_BYTES, ObjectDictionary};

/// Frames in a block that is written: few, so that a short transfer has several blocks.
const BLOCK: u8 = 16;
/// After this silence of the client, a transfer ends.
const PATIENCE_NS: u64 = 3_000_000_000;

/// The current transfer.
#[derive(Debug)]
enum State {
    Idle,
    Read {
        data: Vec<u8>,
        at: usize,
        toggle: bool,
    },
    Write {
        data: Vec<u8>,
        size: Option<usize>,
        toggle: bool,
    },
    /// A block is about to be sent or was sent: where it starts, how many frames it has, and how many of them
    /// were sent.
    ReadBlocks {
        data: Vec<u8>,
        at: usize,
        block: u8,
        sent: u8,
        ends: bool,
    },
    /// `next`: the number of the next segment; `ended`: the last one has come.
    WriteBlocks {
        data: Vec<u8>,
        size: Option<usize>,
        next: u8,
        with_crc: bool,
        ended: bool,
    },
}

/// A node's server, for one client at a time.
#[derive(Debug)]
pub struct SdoServer {
    state: State,
    object: SdoObject,
    until_ns: u64,
    /// The segment of the next block to lose on purpose; 0 for none.
    pub loses: u8,
}

/// Frames to send, and what was written.
#[derive(Debug, Default)]
pub struct SdoReply {
    /// The answers, in this order.
    pub frames: Vec<[u8; 8]>,
    /// The object that has a new value.
    pub written: Option<SdoObject>,
}

impl SdoReply {
    fn push(&mut self, response: SdoResponse) {
        self.frames.push(response.encode());
    }
}

impl Default for SdoServer {
    fn default() -> Self {
        Self { state: State::Idle, object: SdoObject::default(), until_ns: 0, loses: 0 }
    }
}

impl SdoServer {
    /// When silence of the client ends the current transfer.
    pub fn due(&self) -> Option<u64> {
        (!matches!(self.state, State::Idle)).then_some(self.until_ns)
    }

    /// The client has been silent for too long.
    pub fn give_up(&mut self) -> [u8; 8] {
        self.abort(abort::TIMEOUT)
    }

    fn abort(&mut self, code: u32) -> [u8; 8] {
        self.state = State::Idle;
        SdoResponse::Abort(self.object, code).encode()
    }

    /// Takes a frame from the client.
    pub fn take(&mut self, bytes: [u8; 8], dictionary: &mut ObjectDictionary, now_ns: u64) -> SdoReply {
        self.until_ns = now_ns + PATIENCE_NS;
        let mut reply = SdoReply::default();
        if let Err(code) = self.frame(bytes, dictionary, &mut reply) {
            reply.frames = vec![self.abort(code)];
            reply.written = None;
        }
        reply
    }

    fn frame(
        &mut self,
        bytes: [u8; 8],
        dictionary: &mut ObjectDictionary,
        reply: &mut SdoReply,
    ) -> Result<(), u32> {
        let request = SdoRequest::decode(bytes);
        if let Some(SdoRequest::Abort(..)) = request {
            self.state = State::Idle;
            return Ok(());
        }
        if let State::WriteBlocks { ended: false, .. } = self.state {
            return self.block_segment(BlockSegment::decode(bytes), reply);
        }
        self.request(request.ok_or(abort::COMMAND)?, dictionary, reply)
    }

    fn request(
        &mut self,
        request: SdoRequest,
        dictionary: &mut ObjectDictionary,
        reply: &mut SdoReply,
    ) -> Result<(), u32> {
        if request.begins() {
            self.state = State::Idle;
        }
        match request {
            SdoRequest::Download(object, content) => {
                self.object = object;
                match content {
                    Content::Expedited { bytes, length } => {
                        self.write(&bytes[..usize::from(length.unwrap_or(4))], dictionary, reply)?;
                    }
                    Content::Segmented(size) => {
                        let size = size.map(|size| size as usize);
                        dictionary.may_write(object, size)?;
                        self.state = State::Write { data: Vec::new(), size, toggle: false };
                    }
                }
                reply.push(SdoResponse::Download(object));
                Ok(())
            }
            SdoRequest::DownloadSegment(segment) => self.written_segment(segment, dictionary, reply),
            SdoRequest::Upload(object) => {
                self.object = object;
                let data = dictionary.read(object)?.to_vec();
                self.begin_reading(data, reply);
                Ok(())
            }
            SdoRequest::UploadSegment { toggle } => self.read_segment(toggle, reply),
            SdoRequest::BlockUpload { object, block_size, threshold, .. } => {
                self.object = object;
                let data = dictionary.read(object)?.to_vec();
                if !(1..=MOST_BLOCK_FRAMES).contains(&block_size) {
                    return Err(abort::BLOCK_SIZE);
                }
                // So short that the client wants it without blocks.
                if data.len() <= usize::from(threshold) {
                    self.begin_reading(data, reply);
                    return Ok(());
                }
                reply.push(SdoResponse::BlockUpload { object, crc: true, size: Some(data.len() as u32) });
                self.state = State::ReadBlocks { data, at: 0, block: block_size, sent: 0, ends: false };
                Ok(())
            }
            SdoRequest::BlockUploadStart => {
                self.send_block(reply);
                Ok(())
            }
            SdoRequest::BlockUploadAcknowledge { taken, block_size } => {
                self.block_confirmed(taken, block_size, reply)
            }
            SdoRequest::BlockUploadEnd | SdoRequest::Abort(..) => {
                self.state = State::Idle;
                Ok(())
            }
            SdoRequest::BlockDownload { object, crc, size } => {
                self.object = object;
                let size = size.map(|size| size as usize);
                dictionary.may_write(object, size)?;
                self.state =
                    State::WriteBlocks { data: Vec::new(), size, next: 1, with_crc: crc, ended: false };
                reply.push(SdoResponse::BlockDownload { object, crc: true, block_size: BLOCK });
                Ok(())
            }
            SdoRequest::BlockDownloadEnd(end) => self.end_of_blocks(end, dictionary, reply),
        }
    }

    fn write(
        &self,
        value: &[u8],
        dictionary: &mut ObjectDictionary,
        reply: &mut SdoReply,
    ) -> Result<(), u32> {
        dictionary.write(self.object, value)?;
        reply.written = Some(self.object);
        Ok(())
    }

    fn begin_reading(&mut self, data: Vec<u8>, reply: &mut SdoReply) {
        let content = Content::expedited(&data).unwrap_or(Content::Segmented(Some(data.len() as u32)));
        reply.push(SdoResponse::Upload(self.object, content));
        if let Content::Segmented(_) = content {
            self.state = State::Read { data, at: 0, toggle: false };
        }
    }

    fn read_segment(&mut self, asked: bool, reply: &mut SdoReply) -> Result<(), u32> {
        let State::Read { data, at, toggle } = &mut self.state else { return Err(abort::COMMAND) };
        if asked != *toggle {
            return Err(abort::TOGGLE);
        }
        let part = &data[*at..data.len().min(*at + SEGMENT_BYTES)];
        let is_last = *at + part.len() == data.len();
        reply.push(SdoResponse::UploadSegment(Segment::new(asked, is_last, part)));
        (*at, *toggle) = (*at + part.len(), !*toggle);
        if is_last {
            self.state = State::Idle;
        }
        Ok(())
    }

    fn written_segment(
        &mut self,
        segment: Segment,
        dictionary: &mut ObjectDictionary,
        reply: &mut SdoReply,
    ) -> Result<(), u32> {
        let State::Write { data, size, toggle } = &mut self.state else { return Err(abort::COMMAND) };
        if segment.toggle != *toggle {
            return Err(abort::TOGGLE);
        }
        data.extend_from_slice(segment.data());
        if data.len() > MOST_OBJECT_BYTES {
            return Err(abort::MEMORY);
        }
        *toggle = !*toggle;
        if segment.is_last {
            if size.is_some_and(|size| size != data.len()) {
                return Err(abort::LENGTH);
            }
            let data = std::mem::take(data);
            self.state = State::Idle;
            self.write(&data, dictionary, reply)?;
        }
        reply.push(SdoResponse::DownloadSegment { toggle: segment.toggle });
        Ok(())
    }

    /// Sends a block, from where the last one was confirmed.
    fn send_block(&mut self, reply: &mut SdoReply) {
        let loses = std::mem::take(&mut self.loses);
        let State::ReadBlocks { data, at, block, sent, ends } = &mut self.state else { return };
        (*sent, *ends) = (0, false);
        while *sent < *block && !*ends {
            let from = *at + usize::from(*sent) * SEGMENT_BYTES;
            let part = &data[from.min(data.len())..data.len().min(from + SEGMENT_BYTES)];
            *ends = from + SEGMENT_BYTES >= data.len();
            *sent += 1;
            if *sent != loses {
                reply.frames.push(BlockSegment::new(*sent, *ends, part).encode());
            }
        }
    }

    fn block_confirmed(&mut self, taken: u8, next: u8, reply: &mut SdoReply) -> Result<(), u32> {
        let State::ReadBlocks { data, at, block, sent, ends } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        if taken > *sent {
            return Err(abort::SEQUENCE);
        }
        if *ends && taken == *sent {
            reply.push(SdoResponse::BlockUploadEnd(BlockEnd::of(data.len(), crc_of(data))));
            return Ok(());
        }
        if !(1..=MOST_BLOCK_FRAMES).contains(&next) {
            return Err(abort::BLOCK_SIZE);
        }
        (*at, *block) = (*at + usize::from(taken) * SEGMENT_BYTES, next);
        self.send_block(reply);
        Ok(())
    }

    fn block_segment(&mut self, segment: BlockSegment, reply: &mut SdoReply) -> Result<(), u32> {
        let State::WriteBlocks { data, next, ended, .. } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        let BlockSegment { number, is_last, bytes } = segment;
        if number == 0 || number > BLOCK {
            return Err(abort::SEQUENCE);
        }
        if number == self.loses {
            self.loses = 0;
        } else if number == *next {
            data.extend_from_slice(&bytes);
            *next += 1;
            *ended = is_last;
        }
        if data.len() > MOST_OBJECT_BYTES + SEGMENT_BYTES {
            return Err(abort::MEMORY);
        }
        if number == BLOCK || is_last {
            reply.push(SdoResponse::BlockDownloadAcknowledge { taken: *next - 1, block_size: BLOCK });
            *next = 1;
        }
        Ok(())
    }

    fn end_of_blocks(
        &mut self,
        end: BlockEnd,
        dictionary: &mut ObjectDictionary,
        reply: &mut SdoReply,
    ) -> Result<(), u32> {
        let State::WriteBlocks { data, size, with_crc, .. } = &mut self.state else {
            return Err(abort::COMMAND);
        };
        data.truncate(data.len().saturating_sub(end.unused.into()));
        if *with_crc && crc_of(data) != end.crc {
            return Err(abort::CRC);
        }
        if size.is_some_and(|size| size != data.len()) {
            return Err(abort::LENGTH);
        }
        let data = std::mem::take(data);
        self.state = State::Idle;
        self.write(&data, dictionary, reply)?;
        reply.push(SdoResponse::BlockDownloadEnd);
        Ok(())
    }
}
