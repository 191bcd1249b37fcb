//! CAN FD frames inside commands. Each is marked `#[serde(with = "crate::packed_fd")]`.

use cantap_can::fd::FD_MAX_BYTES;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::{FdFrame, Id, Refusal};

/// Writes a frame as [`PackedFd`].
pub(crate) fn serialize<S: Serializer>(frame: &FdFrame, serializer: S) -> Result<S::Ok, S::Error> {
    PackedFd::from(*frame).serialize(serializer)
}

/// Reads a frame from [`PackedFd`].
pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<FdFrame, D::Error> {
    let packed = PackedFd::deserialize(deserializer)?;
    packed.frame().map_err(|_| D::Error::custom("identifier or length out of range"))
}

/// A CAN FD frame inside a command: postcard's ordinary encoding of these two fields. The number of bytes gives the length code.
#[derive(Serialize, Deserialize)]
pub(crate) struct PackedFd {
    /// Bit 31: extended. Bit 30: the bit rate is switched. Bit 29: the sender is error passive. Bits 28..0: the identifier.
    id: u32,
    data: heapless::Vec<u8, FD_MAX_BYTES>,
}

const EXTENDED: u32 = 1 << 31;
const BRS: u32 = 1 << 30;
const ESI: u32 = 1 << 29;

impl From<FdFrame> for PackedFd {
    fn from(frame: FdFrame) -> Self {
        let flag = |is: bool, bit: u32| if is { bit } else { 0 };
        let id = frame.id();
        let flags = flag(id.is_extended(), EXTENDED) | flag(frame.brs(), BRS) | flag(frame.esi(), ESI);
        let mut data = heapless::Vec::new();
        // Cannot fail: a frame carries at most 64 bytes.
        let _ = data.extend_from_slice(frame.data());
        Self { id: id.raw() | flags, data }
    }
}

impl PackedFd {
    /// The frame, or why it is not one.
    pub(crate) fn frame(&self) -> Result<FdFrame, Refusal> {
        let raw = self.id & !(EXTENDED | BRS | ESI);
        let id = if self.id & EXTENDED != 0 { Id::extended(raw) } else { Id::standard(raw) };
        let id = id.ok_or(Refusal::BadId)?;
        FdFrame::new(id, self.id & BRS != 0, self.id & ESI != 0, &self.data).ok_or(Refusal::BadDlc)
    }
}
