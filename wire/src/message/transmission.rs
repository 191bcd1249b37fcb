//! Frames to be sent: once, periodically, or in reply.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use super::Filter;
use crate::{FdFrame, Frame};

pub use cantap_can::DEVICE_TAG;

/// Most modifiers of one periodic frame.
pub const MAX_MODIFIERS: usize = 4;
/// What the tags from [`DEVICE_TAG`] up say: a periodic entry's slot; from this one up, a trigger's; from
/// [`super::GATEWAY_TAG`] up, a gateway rule's.
pub const TRIGGER_TAG: u32 = 0xFFFF_8000;

/// Never from a device: the tag of frames that another client of a shared board has sent.
pub const OTHERS_TAG: u32 = u32::MAX;

/// A frame to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct TxFrame {
    /// Returned in [`crate::Event::Transmitted`] or [`crate::Event::TransmitFailed`]. Below [`DEVICE_TAG`].
    pub tag: u32,
    /// The frame.
    #[serde(with = "crate::packed")]
    pub frame: Frame,
    /// Device time, in ticks, before which it is not sent. The queue keeps its order: a later frame
    /// waits for an earlier one.
    pub at_ticks: Option<u64>,
}

/// A CAN FD frame to be sent: as [`TxFrame`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct TxFdFrame {
    /// Returned in [`crate::TransmittedFd`] or [`crate::Event::TransmitFailed`]. Below [`DEVICE_TAG`].
    pub tag: u32,
    /// The frame.
    #[serde(with = "crate::packed_fd")]
    pub frame: FdFrame,
    /// Device time, in ticks, before which it is not sent.
    pub at_ticks: Option<u64>,
}

/// A frame that the device sends periodically.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Periodic {
    /// The frame, before modifiers.
    #[serde(with = "crate::packed")]
    pub frame: Frame,
    /// Ticks between two transmissions' due times. No drift: due times are multiples.
    pub period_ticks: u32,
    /// How many times; 0 means for ever.
    pub count: u32,
    /// Applied in this order before each transmission.
    pub modifiers: Vec<Modifier, MAX_MODIFIERS>,
}

/// Changes a periodic frame's data before each transmission.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Modifier {
    /// Counts up by one, in `bits` bits of byte `byte` from bit `low_bit` up, and wraps.
    Counter {
        /// Byte of the data, from 0.
        byte: u8,
        /// Lowest bit, 0 to 7.
        low_bit: u8,
        /// Width, 1 to 8 - `low_bit`.
        bits: u8,
    },
    /// A checksum over all other data bytes.
    Checksum {
        /// Byte of the data that holds it, from 0.
        byte: u8,
        /// How it is computed.
        algorithm: Checksum,
    },
    /// A new random value.
    Random {
        /// Byte of the data, from 0.
        byte: u8,
    },
}

impl Modifier {
    /// Whether it is inside the data of a frame with `len` bytes.
    pub fn fits(&self, len: usize) -> bool {
        match *self {
            Self::Counter { byte, low_bit, bits } => {
                usize::from(byte) < len && low_bit < 8 && (1..=8 - low_bit).contains(&bits)
            }
            Self::Checksum { byte, .. } | Self::Random { byte } => usize::from(byte) < len,
        }
    }
}

/// A checksum over data bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Checksum {
    /// Exclusive or.
    Xor,
    /// Sum modulo 256.
    Sum,
    /// CRC-8 SAE-J1850: polynomial 0x1D, initial value and final exclusive-or 0xFF.
    Crc8J1850,
}

/// A frame that is sent when a matching one is received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Trigger {
    /// What starts it.
    pub filter: Filter,
    /// What is sent.
    #[serde(with = "crate::packed")]
    pub reply: Frame,
    /// How many times; 0 means for ever.
    pub count: u32,
}
