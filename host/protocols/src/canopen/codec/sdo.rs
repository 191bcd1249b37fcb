//! Frames of SDO transfers: expedited, in segments and in blocks (CiA 301, 7.2.4.3).
//!
//! Inside a block, frames are [`BlockSegment`]s instead, in the direction of the data. Nothing in a frame says so: only the transfer
//! does.

/// The most frames in a block.
pub const MOST_BLOCK_FRAMES: u8 = 127;
/// Bytes of an object in a segment.
pub const SEGMENT_BYTES: usize = 7;

const ABORT: u8 = 0x80;

/// Why a client or a server aborts a transfer (CiA 301, table 22).
pub mod abort {
    /// The toggle bit did not alternate.
    pub const TOGGLE: u32 = 0x0503_0000;
    /// The other side was silent for too long.
    pub const TIMEOUT: u32 = 0x0504_0000;
    /// The command is unknown, or not one of this transfer.
    pub const COMMAND: u32 = 0x0504_0001;
    /// A block of no frame or of more than 127.
    pub const BLOCK_SIZE: u32 = 0x0504_0002;
    /// A sequence number that is none.
    pub const SEQUENCE: u32 = 0x0504_0003;
    /// The CRC does not agree.
    pub const CRC: u32 = 0x0504_0004;
    /// The object is too long.
    pub const MEMORY: u32 = 0x0504_0005;
    /// The object can only be written.
    pub const WRITE_ONLY: u32 = 0x0601_0001;
    /// The object can only be read.
    pub const READ_ONLY: u32 = 0x0601_0002;
    /// There is no such object.
    pub const NO_OBJECT: u32 = 0x0602_0000;
    /// The object cannot be mapped to a PDO.
    pub const NOT_MAPPABLE: u32 = 0x0604_0041;
    /// The mapped objects are longer than a PDO.
    pub const PDO_LENGTH: u32 = 0x0604_0042;
    /// The number of bytes is not the announced or not the object's.
    pub const LENGTH: u32 = 0x0607_0010;
    /// The object has no such sub-index.
    pub const NO_ENTRY: u32 = 0x0609_0011;
    /// The value is not allowed.
    pub const VALUE: u32 = 0x0609_0030;
    /// Any other reason.
    pub const GENERAL: u32 = 0x0800_0000;
    /// Not in the device's present state.
    pub const STATE: u32 = 0x0800_0022;
}

/// The object that a frame names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SdoObject {
    /// The index.
    pub index: u16,
    /// The sub-index.
    pub sub: u8,
}

/// What the frame that begins a transfer says of the object's bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// They are in the frame: the first `length` of these, or an unknown number.
    Expedited {
        /// The bytes, with zeros after the last one.
        bytes: [u8; 4],
        /// 1 to 4, where the frame has it.
        length: Option<u8>,
    },
    /// They follow in segments: this many, where the frame has it.
    Segmented(Option<u32>),
}

/// Up to seven bytes of an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Alternates, and begins with 0.
    pub toggle: bool,
    /// No segment follows.
    pub is_last: bool,
    length: u8,
    bytes: [u8; SEGMENT_BYTES],
}

/// A frame of a block: seven bytes of an object. How many of the last one's count is in the frame that ends the transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockSegment {
    /// From 1 in each block, up to 127; 0 is not allowed.
    pub number: u8,
    /// The object ends with it.
    pub is_last: bool,
    /// The bytes.
    pub bytes: [u8; SEGMENT_BYTES],
}

/// The end of a transfer by blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockEnd {
    /// How many of the last segment's seven bytes do not count, 0 to 7.
    pub unused: u8,
    /// Of all the object's bytes, if both sides have agreed on it.
    pub crc: u16,
}

/// A frame from the client. A download writes the object, an upload reads it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoRequest {
    /// Begins to write.
    Download(SdoObject, Content),
    /// Goes on.
    DownloadSegment(Segment),
    /// Begins to read.
    Upload(SdoObject),
    /// Asks for the next segment.
    UploadSegment {
        /// As in the segment that is asked for.
        toggle: bool,
    },
    /// Begins to read by blocks.
    BlockUpload {
        /// What to read.
        object: SdoObject,
        /// The client can check a CRC.
        crc: bool,
        /// Frames in the first block, 1 to 127.
        block_size: u8,
        /// The server may answer without blocks up to this many bytes; 0: never.
        threshold: u8,
    },
    /// The server should send its first block.
    BlockUploadStart,
    /// What came of the server's block.
    BlockUploadAcknowledge {
        /// The last number in order.
        taken: u8,
        /// Frames in the next block, 1 to 127.
        block_size: u8,
    },
    /// The object was read.
    BlockUploadEnd,
    /// Begins to write by blocks.
    BlockDownload {
        /// What to write.
        object: SdoObject,
        /// The client can make a CRC.
        crc: bool,
        /// How many bytes, where the frame has it.
        size: Option<u32>,
    },
    /// All bytes were sent.
    BlockDownloadEnd(BlockEnd),
    /// Ends the transfer.
    Abort(SdoObject, u32),
}

/// A frame from the server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SdoResponse {
    /// Reading begins.
    Upload(SdoObject, Content),
    /// The segment that was asked for.
    UploadSegment(Segment),
    /// Writing has begun or, if expedited, is complete.
    Download(SdoObject),
    /// The segment was taken.
    DownloadSegment {
        /// As in the segment.
        toggle: bool,
    },
    /// Reading by blocks begins.
    BlockUpload {
        /// What is read.
        object: SdoObject,
        /// The server can make a CRC.
        crc: bool,
        /// How many bytes, where the frame has it.
        size: Option<u32>,
    },
    /// All bytes were sent.
    BlockUploadEnd(BlockEnd),
    /// Writing by blocks begins.
    BlockDownload {
        /// What is written.
        object: SdoObject,
        /// The server can check a CRC.
        crc: bool,
        /// Frames in the first block, 1 to 127.
        block_size: u8,
    },
    /// What came of the client's block.
    BlockDownloadAcknowledge {
        /// The last number in order.
        taken: u8,
        /// Frames in the next block, 1 to 127.
        block_size: u8,
    },
    /// The object was written.
    BlockDownloadEnd,
    /// Ends the transfer.
    Abort(SdoObject, u32),
}

impl SdoObject {
    /// From the frame that begins a transfer, or the answer to it; other frames name none.
    pub fn decode(bytes: [u8; 8]) -> Self {
        Self { index: u16::from_le_bytes([bytes[1], bytes[2]]), sub: bytes[3] }
    }

    fn frame(self, command: u8, last: [u8; 4]) -> [u8; 8] {
        let ([low, high], [a, b, c, d]) = (self.index.to_le_bytes(), last);
        [command, low, high, self.sub, a, b, c, d]
    }
}

impl Content {
    /// One to four bytes in the frame itself; `None` for any other number.
    pub fn expedited(data: &[u8]) -> Option<Self> {
        let mut bytes = [0; 4];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        (!data.is_empty()).then_some(Self::Expedited { bytes, length: Some(data.len() as u8) })
    }

    /// The command's low bits, and the last four bytes of the frame.
    fn encode(self) -> (u8, [u8; 4]) {
        match self {
            Self::Expedited { bytes, length: Some(length) } => (3 | (4 - length.clamp(1, 4)) << 2, bytes),
            Self::Expedited { bytes, length: None } => (2, bytes),
            Self::Segmented(Some(size)) => (1, size.to_le_bytes()),
            Self::Segmented(None) => (0, [0; 4]),
        }
    }

    fn decode(bytes: [u8; 8]) -> Self {
        let [command, _, _, _, last @ ..] = bytes;
        let has_size = command & 1 != 0;
        if command & 2 == 0 {
            return Self::Segmented(has_size.then(|| u32::from_le_bytes(last)));
        }
        Self::Expedited { bytes: last, length: has_size.then_some(4 - (command >> 2 & 3)) }
    }
}

impl Segment {
    /// With at most seven bytes; those beyond are left out.
    pub fn new(toggle: bool, is_last: bool, data: &[u8]) -> Self {
        let length = data.len().min(SEGMENT_BYTES);
        let mut bytes = [0; SEGMENT_BYTES];
        bytes[..length].copy_from_slice(&data[..length]);
        Self { toggle, is_last, length: length as u8, bytes }
    }

    /// The object's bytes in it.
    pub fn data(&self) -> &[u8] {
        &self.bytes[..usize::from(self.length)]
    }

    fn encode(self) -> [u8; 8] {
        let unused = SEGMENT_BYTES as u8 - self.length;
        with_command(u8::from(self.toggle) << 4 | unused << 1 | u8::from(self.is_last), self.bytes)
    }

    fn decode(bytes: [u8; 8]) -> Self {
        let [command, bytes @ ..] = bytes;
        let length = SEGMENT_BYTES as u8 - (command >> 1 & 7);
        Self { toggle: command & 0x10 != 0, is_last: command & 1 != 0, length, bytes }
    }
}

impl BlockSegment {
    /// With at most seven bytes; those beyond are left out.
    pub fn new(number: u8, is_last: bool, data: &[u8]) -> Self {
        let mut bytes = [0; SEGMENT_BYTES];
        let length = data.len().min(SEGMENT_BYTES);
        bytes[..length].copy_from_slice(&data[..length]);
        Self { number, is_last, bytes }
    }

    /// The frame.
    pub const fn encode(self) -> [u8; 8] {
        with_command((self.is_last as u8) << 7 | self.number & 0x7F, self.bytes)
    }

    /// From a frame.
    pub const fn decode(bytes: [u8; 8]) -> Self {
        let [first, bytes @ ..] = bytes;
        Self { number: first & 0x7F, is_last: first & 0x80 != 0, bytes }
    }
}

impl BlockEnd {
    /// For an object of this many bytes. One without bytes also takes one frame, with no content.
    pub fn of(length: usize, crc: u16) -> Self {
        let used = if length == 0 { 0 } else { (length - 1) % SEGMENT_BYTES + 1 };
        Self { unused: (SEGMENT_BYTES - used) as u8, crc }
    }

    fn encode(self) -> [u8; 8] {
        let [low, high] = self.crc.to_le_bytes();
        [0xC1 | (self.unused & 7) << 2, low, high, 0, 0, 0, 0, 0]
    }

    fn decode(bytes: [u8; 8]) -> Self {
        Self { unused: bytes[0] >> 2 & 7, crc: u16::from_le_bytes([bytes[1], bytes[2]]) }
    }
}

impl SdoRequest {
    /// The frame. Unused bytes are 0.
    pub fn encode(self) -> [u8; 8] {
        match self {
            Self::Download(object, content) => {
                let (bits, last) = content.encode();
                object.frame(0x20 | bits, last)
            }
            Self::DownloadSegment(segment) => segment.encode(),
            Self::Upload(object) => object.frame(0x40, [0; 4]),
            Self::UploadSegment { toggle } => [0x60 | u8::from(toggle) << 4, 0, 0, 0, 0, 0, 0, 0],
            Self::BlockUpload { object, crc, block_size, threshold } => {
                object.frame(0xA0 | u8::from(crc) << 2, [block_size, threshold, 0, 0])
            }
            Self::BlockUploadStart => [0xA3, 0, 0, 0, 0, 0, 0, 0],
            Self::BlockUploadAcknowledge { taken, block_size } => acknowledge(taken, block_size),
            Self::BlockUploadEnd => [0xA1, 0, 0, 0, 0, 0, 0, 0],
            Self::BlockDownload { object, crc, size } => block_begin(object, crc, size),
            Self::BlockDownloadEnd(end) => end.encode(),
            Self::Abort(object, code) => object.frame(ABORT, code.to_le_bytes()),
        }
    }

    /// From a frame; `None` if its command is none.
    pub fn decode(bytes: [u8; 8]) -> Option<Self> {
        let [command, second, third, ..] = bytes;
        Some(match (command >> 5, command & 3) {
            (0, _) => Self::DownloadSegment(Segment::decode(bytes)),
            (1, _) => Self::Download(SdoObject::decode(bytes), Content::decode(bytes)),
            (2, _) => Self::Upload(SdoObject::decode(bytes)),
            (3, _) => Self::UploadSegment { toggle: command & 0x10 != 0 },
            (4, _) if command == ABORT => Self::Abort(SdoObject::decode(bytes), last_word(bytes)),
            (5, 0) => Self::BlockUpload {
                object: SdoObject::decode(bytes),
                crc: command & 4 != 0,
                block_size: bytes[4],
                threshold: bytes[5],
            },
            (5, 1) => Self::BlockUploadEnd,
            (5, 2) => Self::BlockUploadAcknowledge { taken: second, block_size: third },
            (5, _) => Self::BlockUploadStart,
            (6, 0 | 2) => Self::BlockDownload {
                object: SdoObject::decode(bytes),
                crc: command & 4 != 0,
                size: block_size(bytes),
            },
            (6, _) => Self::BlockDownloadEnd(BlockEnd::decode(bytes)),
            _ => return None,
        })
    }

    /// Whether a transfer begins with it.
    pub const fn begins(&self) -> bool {
        matches!(
            self,
            Self::Download(..) | Self::Upload(_) | Self::BlockUpload { .. } | Self::BlockDownload { .. }
        )
    }

    /// How many bytes of a frame with this command count. Some devices leave out the others.
    pub const fn used_bytes(command: u8) -> usize {
        match command >> 5 {
            0 => segment_bytes(command),
            1 => begin_bytes(command),
            2 => 4,
            3 => 1,
            _ => 8,
        }
    }
}

impl SdoResponse {
    /// The frame. Unused bytes are 0.
    pub fn encode(self) -> [u8; 8] {
        match self {
            Self::Upload(object, content) => {
                let (bits, last) = content.encode();
                object.frame(0x40 | bits, last)
            }
            Self::UploadSegment(segment) => segment.encode(),
            Self::Download(object) => object.frame(0x60, [0; 4]),
            Self::DownloadSegment { toggle } => [0x20 | u8::from(toggle) << 4, 0, 0, 0, 0, 0, 0, 0],
            Self::BlockUpload { object, crc, size } => block_begin(object, crc, size),
            Self::BlockUploadEnd(end) => end.encode(),
            Self::BlockDownload { object, crc, block_size } => {
                object.frame(0xA0 | u8::from(crc) << 2, [block_size, 0, 0, 0])
            }
            Self::BlockDownloadAcknowledge { taken, block_size } => acknowledge(taken, block_size),
            Self::BlockDownloadEnd => [0xA1, 0, 0, 0, 0, 0, 0, 0],
            Self::Abort(object, code) => object.frame(ABORT, code.to_le_bytes()),
        }
    }

    /// From a frame; `None` if its command is none.
    pub fn decode(bytes: [u8; 8]) -> Option<Self> {
        let [command, second, third, ..] = bytes;
        Some(match (command >> 5, command & 3) {
            (0, _) => Self::UploadSegment(Segment::decode(bytes)),
            (1, _) => Self::DownloadSegment { toggle: command & 0x10 != 0 },
            (2, _) => Self::Upload(SdoObject::decode(bytes), Content::decode(bytes)),
            (3, _) => Self::Download(SdoObject::decode(bytes)),
            (4, _) if command == ABORT => Self::Abort(SdoObject::decode(bytes), last_word(bytes)),
            (5, 0) => Self::BlockDownload {
                object: SdoObject::decode(bytes),
                crc: command & 4 != 0,
                block_size: bytes[4],
            },
            (5, 1) => Self::BlockDownloadEnd,
            (5, 2) => Self::BlockDownloadAcknowledge { taken: second, block_size: third },
            (6, 0 | 2) => Self::BlockUpload {
                object: SdoObject::decode(bytes),
                crc: command & 4 != 0,
                size: block_size(bytes),
            },
            (6, _) => Self::BlockUploadEnd(BlockEnd::decode(bytes)),
            _ => return None,
        })
    }

    /// The object that it names, if it is the first answer of a transfer.
    pub const fn names(&self) -> Option<SdoObject> {
        match *self {
            Self::Upload(object, _)
            | Self::Download(object)
            | Self::BlockUpload { object, .. }
            | Self::BlockDownload { object, .. } => Some(object),
            _ => None,
        }
    }

    /// How many bytes of a frame with this command count. Some devices leave out the others.
    pub const fn used_bytes(command: u8) -> usize {
        match command >> 5 {
            0 => segment_bytes(command),
            1 => 1,
            2 => begin_bytes(command),
            3 => 4,
            _ => 8,
        }
    }
}

const fn with_command(command: u8, rest: [u8; SEGMENT_BYTES]) -> [u8; 8] {
    let [a, b, c, d, e, f, g] = rest;
    [command, a, b, c, d, e, f, g]
}

const fn acknowledge(taken: u8, block_size: u8) -> [u8; 8] {
    [0xA2, taken, block_size, 0, 0, 0, 0, 0]
}

/// Whoever sends the blocks begins with this.
fn block_begin(object: SdoObject, crc: bool, size: Option<u32>) -> [u8; 8] {
    let bits = u8::from(crc) << 2 | u8::from(size.is_some()) << 1;
    object.frame(0xC0 | bits, size.unwrap_or(0).to_le_bytes())
}

fn block_size(bytes: [u8; 8]) -> Option<u32> {
    (bytes[0] & 2 != 0).then(|| last_word(bytes))
}

fn last_word(bytes: [u8; 8]) -> u32 {
    let [.., a, b, c, d] = bytes;
    u32::from_le_bytes([a, b, c, d])
}

const fn segment_bytes(command: u8) -> usize {
    8 - (command >> 1 & 7) as usize
}

/// The beginning of a transfer, with its bytes or how many they are.
const fn begin_bytes(command: u8) -> usize {
    match command & 3 {
        0 => 4,
        3 => 8 - (command >> 2 & 3) as usize,
        _ => 8,
    }
}

/// CRC-16 with the polynomial 1021, from 0 (CiA 301, 7.2.4.3.16).
pub fn crc_of(bytes: &[u8]) -> u16 {
    crate::crc::crc16(0, bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const OBJECT: SdoObject = SdoObject { index: 0x1018, sub: 1 };

    #[test]
    fn the_crc_is_the_standards() {
        assert_eq!(crc_of(b"123456789"), 0x31C3);
    }

    /// The bytes of CiA 301, figures 23 to 36, for one object.
    #[test]
    fn each_frame_has_its_bytes() {
        let content = |data: &[u8]| Content::expedited(data).unwrap();
        for (request, bytes) in [
            (SdoRequest::Download(OBJECT, content(&[1, 2])), [0x2B, 0x18, 0x10, 1, 1, 2, 0, 0]),
            (
                SdoRequest::Download(OBJECT, Content::Segmented(Some(300))),
                [0x21, 0x18, 0x10, 1, 0x2C, 1, 0, 0],
            ),
            (SdoRequest::DownloadSegment(Segment::new(true, true, &[9, 8])), [0x1B, 9, 8, 0, 0, 0, 0, 0]),
            (SdoRequest::Upload(OBJECT), [0x40, 0x18, 0x10, 1, 0, 0, 0, 0]),
            (SdoRequest::UploadSegment { toggle: true }, [0x70, 0, 0, 0, 0, 0, 0, 0]),
            (
                SdoRequest::BlockUpload { object: OBJECT, crc: true, block_size: 127, threshold: 7 },
                [0xA4, 0x18, 0x10, 1, 127, 7, 0, 0],
            ),
            (SdoRequest::BlockUploadStart, [0xA3, 0, 0, 0, 0, 0, 0, 0]),
            (SdoRequest::BlockUploadAcknowledge { taken: 3, block_size: 9 }, [0xA2, 3, 9, 0, 0, 0, 0, 0]),
            (SdoRequest::BlockUploadEnd, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
            (
                SdoRequest::BlockDownload { object: OBJECT, crc: true, size: Some(1) },
                [0xC6, 0x18, 0x10, 1, 1, 0, 0, 0],
            ),
            (SdoRequest::BlockDownloadEnd(BlockEnd::of(15, 0x1234)), [0xD9, 0x34, 0x12, 0, 0, 0, 0, 0]),
            (SdoRequest::Abort(OBJECT, abort::CRC), [0x80, 0x18, 0x10, 1, 4, 0, 4, 5]),
        ] {
            assert_eq!(request.encode(), bytes);
            assert_eq!(SdoRequest::decode(bytes), Some(request));
        }
        for (response, bytes) in [
            (SdoResponse::Upload(OBJECT, content(&[1, 2, 3, 4])), [0x43, 0x18, 0x10, 1, 1, 2, 3, 4]),
            (SdoResponse::Upload(OBJECT, Content::Segmented(None)), [0x40, 0x18, 0x10, 1, 0, 0, 0, 0]),
            (SdoResponse::UploadSegment(Segment::new(false, false, &[7; 7])), [0, 7, 7, 7, 7, 7, 7, 7]),
            (SdoResponse::Download(OBJECT), [0x60, 0x18, 0x10, 1, 0, 0, 0, 0]),
            (SdoResponse::DownloadSegment { toggle: true }, [0x30, 0, 0, 0, 0, 0, 0, 0]),
            (
                SdoResponse::BlockUpload { object: OBJECT, crc: false, size: Some(2) },
                [0xC2, 0x18, 0x10, 1, 2, 0, 0, 0],
            ),
            (SdoResponse::BlockUploadEnd(BlockEnd::of(0, 0)), [0xDD, 0, 0, 0, 0, 0, 0, 0]),
            (
                SdoResponse::BlockDownload { object: OBJECT, crc: true, block_size: 16 },
                [0xA4, 0x18, 0x10, 1, 16, 0, 0, 0],
            ),
            (
                SdoResponse::BlockDownloadAcknowledge { taken: 1, block_size: 16 },
                [0xA2, 1, 16, 0, 0, 0, 0, 0],
            ),
            (SdoResponse::BlockDownloadEnd, [0xA1, 0, 0, 0, 0, 0, 0, 0]),
            (SdoResponse::Abort(OBJECT, abort::GENERAL), [0x80, 0x18, 0x10, 1, 0, 0, 0, 8]),
        ] {
            assert_eq!(response.encode(), bytes);
            assert_eq!(SdoResponse::decode(bytes), Some(response));
        }
        assert_eq!(BlockSegment::new(2, true, &[1]).encode(), [0x82, 1, 0, 0, 0, 0, 0, 0]);
        assert_eq!([BlockEnd::of(7, 0).unused, BlockEnd::of(8, 0).unused], [0, 6]);
        assert_eq!((Content::expedited(&[]), Content::expedited(&[0; 5])), (None, None));
        assert_eq!((SdoRequest::decode([0x81; 8]), SdoRequest::decode([0xE0; 8])), (None, None));
        assert_eq!((SdoResponse::decode([0xA3; 8]), SdoResponse::decode([0xFF; 8])), (None, None));
    }

    proptest! {
        /// What is decoded is what is encoded, whatever the bytes that mean nothing are.
        #[test]
        fn what_was_decoded_is_encoded_with_the_same_meaning(bytes: [u8; 8]) {
            if let Some(request) = SdoRequest::decode(bytes) {
                prop_assert_eq!(SdoRequest::decode(request.encode()), Some(request));
            }
            if let Some(response) = SdoResponse::decode(bytes) {
                prop_assert_eq!(SdoResponse::decode(response.encode()), Some(response));
            }
            prop_assert_eq!(BlockSegment::decode(bytes).encode(), bytes);
        }
    }
}
