//! How long a frame of a trace is on the bus.

use cantap_can::bits_on_bus;

#[cfg(doc)]
use crate::FdBits;
use crate::TraceFrame;
use crate::fd_bits::Length;

/// Bits that a frame takes on the bus, with stuff bits and intermission, by the rate they are sent at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BusBits {
    /// At the nominal rate: all of a classical frame.
    pub nominal: u32,
    /// At the rate of an FD frame's data phase; see [`FdBits::data`].
    pub data: u32,
}

impl BusBits {
    /// Both.
    #[inline]
    pub const fn total(self) -> u32 {
        self.nominal + self.data
    }
}

impl TraceFrame {
    /// How many bits the frame takes on the bus.
    #[inline]
    pub fn bus_bits(&self) -> BusBits {
        match self {
            Self::Classic(frame) => BusBits { nominal: bits_on_bus(frame), data: 0 },
            Self::Fd(frame) => {
                let Length { nominal, data, .. } = Length::of(frame);
                BusBits { nominal, data }
            }
        }
    }
}
