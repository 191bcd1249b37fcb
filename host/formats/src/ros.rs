//! CAN frames in the recordings of robots: `can_msgs/Frame` and `ros2_socketcan_msgs/FdFrame`, in MCAP files, in the bags of ROS 1, in
//! those of ROS 2 that are SQLite databases, and as text.
//!
//! Source: the messages' definitions in ros_canopen and ros2_socketcan, ROS 1's serialization, and OMG's CDR as ROS 2 uses it.

pub(crate) mod bag;
pub(crate) mod container;
#[cfg(feature = "sqlite")]
pub(crate) mod database;
pub(crate) mod echo;
mod fields;
pub(crate) mod folder;
pub(crate) mod mcap;
mod nested;
mod topics;

use std::io::{Cursor, Read as _};

use super::compression::Compression;
use super::error_frames::ErrorFrames;
use super::frame_fields::{FdFields, FrameFields, Payload, identifier};
use super::issue::Fault;
use cantap_trace::counted;
use cantap_trace::{Direction, TraceEvent};
use fields::Fields;
pub(crate) use fields::{Encoding, time_ns};
pub(crate) use topics::{Topic, Topics};

/// What messages of other types are counted as.
pub(crate) const OTHER_MESSAGES: &str = "messages of ROS other than CAN frames";
/// What frames of topics such as `to_can_bus` are reported as.
pub(crate) const SENT_TOPIC: &str =
    "frames are of a topic of requests to send (sent_messages, to_can_bus) and count as sent";

/// No message with a frame is longer.
const MAX_MESSAGE_BYTES: u64 = 4096;

/// The types that are frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Frame,
    FdFrame,
}

impl Kind {
    /// By a type's name, as ROS 1 or 2 writes it.
    pub(crate) fn of_type(name: &[u8]) -> Option<Self> {
        match name {
            b"can_msgs/Frame" | b"can_msgs/msg/Frame" => Some(Self::Frame),
            b"ros2_socketcan_msgs/FdFrame" | b"ros2_socketcan_msgs/msg/FdFrame" => Some(Self::FdFrame),
            _ => None,
        }
    }
}

/// What a message contains.
pub(crate) struct Content {
    /// When the frame was received, in nanoseconds since 1970; `None` if the message does not say.
    pub time_ns: Option<i64>,
    pub event: TraceEvent,
    /// A second event at the same time.
    pub second: Option<TraceEvent>,
}

/// Reads a message.
pub(crate) fn content(
    kind: Kind,
    encoding: Encoding,
    direction: Direction,
    bytes: &[u8],
    errors: &mut ErrorFrames,
) -> Result<Content, Fault> {
    // With `--compression-mode message`; none of a CAN frame begins so.
    if encoding == Encoding::Cdr && Compression::of_content(bytes) == Some(Compression::Zstd) {
        let mut plain = Vec::new();
        let unpacked = Compression::Zstd.unpack(Cursor::new(bytes.to_vec()));
        let read = unpacked.and_then(|source| source.take(MAX_MESSAGE_BYTES).read_to_end(&mut plain));
        return match read {
            Ok(_) if Compression::of_content(&plain).is_none() => {
                content(kind, encoding, direction, &plain, errors)
            }
            _ => Err(Fault::malformed("a message with a CAN frame", b"damaged compressed data")),
        };
    }
    let short = || Fault::malformed("a message with a CAN frame", counted(bytes.len(), "byte").as_bytes());
    let mut fields = Fields::new(encoding, bytes).ok_or_else(short)?;
    let read = match kind {
        Kind::Frame => Message::classic(&mut fields),
        Kind::FdFrame => Message::flexible(&mut fields),
    };
    read.ok_or_else(short)?.content(direction, errors)
}

/// The fields of a message.
struct Message<'a> {
    time_ns: i64,
    id: u32,
    remote: bool,
    extended: bool,
    error: bool,
    len: u8,
    data: &'a [u8],
    is_fd: bool,
}

impl<'a> Message<'a> {
    fn classic(fields: &mut Fields<'a>) -> Option<Self> {
        let time_ns = fields.header()?;
        let id = fields.u32()?;
        let [remote, extended, error] = [fields.bool()?, fields.bool()?, fields.bool()?];
        let len = fields.u8()?;
        let data = fields.bytes(8)?;
        Some(Self { time_ns, id, remote, extended, error, len, data, is_fd: false })
    }

    fn flexible(fields: &mut Fields<'a>) -> Option<Self> {
        let time_ns = fields.header()?;
        let id = fields.u32()?;
        let [extended, error] = [fields.bool()?, fields.bool()?];
        let len = fields.u8()?;
        let there = fields.u32()?;
        let data = fields.bytes(there as usize)?;
        Some(Self { time_ns, id, remote: false, extended, error, len, data, is_fd: true })
    }

    fn content(self, direction: Direction, errors: &mut ErrorFrames) -> Result<Content, Fault> {
        // Programs that fill messages themselves leave the time at zero.
        let time_ns = (self.time_ns != 0).then_some(self.time_ns);
        if self.error {
            let mut data = [0; 8];
            data.iter_mut().zip(self.data).for_each(|(byte, there)| *byte = *there);
            let (event, second) = errors.read(self.id, data);
            return Ok(Content { time_ns, event, second });
        }
        let id = identifier(self.id, self.extended, format!("{:X}", self.id).as_bytes())?;
        let wrong = || Fault::malformed("a frame's length", self.len.to_string().as_bytes());
        if !self.is_fd && self.len > 15 {
            return Err(wrong());
        }
        let bytes = if self.is_fd { self.data.get(..usize::from(self.len)) } else { Some(self.data) };
        let payload = bytes.and_then(Payload::of).ok_or_else(wrong)?;
        let fd = self.is_fd.then(FdFields::default);
        let fields = FrameFields { id, remote: self.remote, direction, len: self.len, fd };
        Ok(Content { time_ns, event: fields.event(&payload)?, second: None })
    }
}
