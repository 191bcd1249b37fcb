//! The length of a trace's frame on the bus.

use cantap_can::bits_on_bus;

#[cfg(doc)]
use crate::FdBits;
use crate::TraceFrame;
use crate::fd_bits::Length;

/// The bits of a frame on the bus, with stuff bits and intermission, by the rate at which they are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BusBits {
    /// At the nominal rate: all of a classical frame.
    pub nominal: u32,
    /// At the rate of an FD frame's data phase; see [`FdBits::data`].
    pub data: u32,
}

impl BusBits {
    /// All bits.
    #[inline]
    pub const fn total(self) -> u32 {
        self.nominal + self.data
    }
}

impl TraceFrame {
    /// The number of bits of the frame on the bus.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_bits_of_an_fd_frame_are_those_at_both_rates() {
        let bits = |text: &str| text.parse::<TraceFrame>().unwrap().bus_bits();
        let switched = bits("123##1AABB");
        assert!(
            switched.nominal > 0
                && switched.data > 16
                && switched.total() == switched.nominal + switched.data
        );
        assert_eq!((bits("123#AABB").data, bits("123#AABB").total()), (0, bits("123#AABB").nominal));
    }
}
