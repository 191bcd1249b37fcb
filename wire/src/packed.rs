//! Frames inside commands and events. Each is marked `#[serde(with = "crate::packed")]`, since the protocol decides how a
//! frame crosses USB, not the frame.

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use cantap_can::frame::first;

use crate::varint::{put_u32, take_u32};
use crate::{Frame, Id, Refusal};

/// Writes a frame as [`Packed`].
pub(crate) fn serialize<S: Serializer>(frame: &Frame, serializer: S) -> Result<S::Ok, S::Error> {
    Packed::from(*frame).serialize(serializer)
}

/// Reads a frame from [`Packed`].
pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Frame, D::Error> {
    let packed = Packed::deserialize(deserializer)?;
    packed.frame().map_err(|_| D::Error::custom("identifier or length out of range"))
}

/// The first `len` bytes (at most 8) padded with zeros, and the bytes that follow.
#[inline]
pub(crate) fn take_data(len: usize, bytes: &[u8]) -> Option<([u8; 8], &[u8])> {
    let (data, rest) = bytes.split_at_checked(len.min(8))?;
    if let Some(eight) = bytes.first_chunk::<8>() {
        // More follows than just the data: eight bytes are read at once, and those that are not the frame's are dropped.
        return Some((first(len, *eight), rest));
    }
    let mut padded = [0; 8];
    padded[..data.len()].copy_from_slice(data);
    Some((padded, rest))
}

/// A frame inside a command or event: postcard's ordinary encoding of these three fields.
#[derive(Serialize, Deserialize)]
pub(crate) struct Packed {
    /// Bit 31: extended. Bit 30: remote. Bits 28..0: the identifier.
    id: u32,
    dlc: u8,
    data: heapless::Vec<u8, 8>,
}

const EXTENDED: u32 = 1 << 31;
const PACKED_REMOTE: u32 = 1 << 30;

impl From<Frame> for Packed {
    fn from(frame: Frame) -> Self {
        let mut data = heapless::Vec::new();
        // Cannot fail: a frame carries at most eight bytes.
        let _ = data.extend_from_slice(frame.data());
        Packed { id: packed_id(&frame), dlc: frame.dlc(), data }
    }
}

/// [`Packed`]'s identifier with its flags.
#[inline]
fn packed_id(frame: &Frame) -> u32 {
    let id = frame.id();
    let extended = if id.is_extended() { EXTENDED } else { 0 };
    let remote = if frame.is_remote() { PACKED_REMOTE } else { 0 };
    id.raw() | extended | remote
}

/// Bytes of the longest frame.
const MAX_PACKED: usize = 5 + 1 + 1 + 8;

/// Writes a frame in [`Packed`]'s encoding, without serde, and returns its length: a device confirms thousands a second.
#[inline]
pub(crate) fn put_packed(frame: &Frame, out: &mut [u8; MAX_PACKED]) -> usize {
    let len = put_u32(packed_id(frame), out);
    let data_len = frame.data_len();
    out[len] = frame.dlc();
    out[len + 1] = data_len as u8;
    // The bytes after the data are padding, which what follows overwrites.
    out[len + 2..len + 10].copy_from_slice(&frame.padded_data());
    len + 2 + data_len
}

impl Packed {
    /// The frame, or why it is not one.
    pub(crate) fn frame(&self) -> Result<Frame, Refusal> {
        let mut data = [0; 8];
        data[..self.data.len()].copy_from_slice(&self.data);
        unpack(self.id, self.dlc, self.data.len(), data)
    }
}

/// The frame with [`Packed`]'s fields, or why they do not make one.
#[inline]
fn unpack(id: u32, dlc: u8, len: usize, data: [u8; 8]) -> Result<Frame, Refusal> {
    let raw = id & !(EXTENDED | PACKED_REMOTE);
    let remote = id & PACKED_REMOTE != 0;
    let id = if id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) }.ok_or(Refusal::BadId)?;
    let frame = Frame::from_bus(id, remote, dlc & 15, data);
    let is_right = dlc <= 15 && frame.data_len() == len;
    if is_right { Ok(frame) } else { Err(Refusal::BadDlc) }
}

/// Reads a frame in [`Packed`]'s encoding, without serde, and returns it with the bytes that follow: a streaming host sends
/// thousands a second. `None` if it is not a frame.
pub(crate) fn take_packed(bytes: &[u8]) -> Option<(Frame, &[u8])> {
    let (id, rest) = take_u32(bytes)?;
    let (&[dlc, len], rest) = rest.split_first_chunk()?;
    let len = usize::from(len);
    let (data, rest) = take_data(len, rest).filter(|_| len <= 8)?;
    Some((unpack(id, dlc, len, data).ok()?, rest))
}
