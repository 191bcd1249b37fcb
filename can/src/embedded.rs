//! embedded-can's traits, so that drivers and protocol stacks built on them accept our frames.
//!
//! embedded-can's frames have no DLC above 8, which on the bus still means eight bytes: such a frame keeps its
//! DLC here and reports 8 there.

use embedded_can as can;

use crate::{BusErrorKind, Frame, Id};

impl From<can::Id> for Id {
    fn from(id: can::Id) -> Self {
        match id {
            can::Id::Standard(id) => Self::standard_truncated(id.as_raw().into()),
            can::Id::Extended(id) => Self::extended_truncated(id.as_raw()),
        }
    }
}

impl From<Id> for can::Id {
    fn from(id: Id) -> Self {
        if id.is_extended() {
            can::ExtendedId::new(id.raw()).unwrap_or(can::ExtendedId::MAX).into()
        } else {
            // Eleven bits fit both; neither fallback can happen.
            u16::try_from(id.raw()).ok().and_then(can::StandardId::new).unwrap_or(can::StandardId::MAX).into()
        }
    }
}

impl can::Frame for Frame {
    fn new(id: impl Into<can::Id>, data: &[u8]) -> Option<Self> {
        Self::data_frame(id.into().into(), data)
    }

    fn new_remote(id: impl Into<can::Id>, dlc: usize) -> Option<Self> {
        let dlc = u8::try_from(dlc).ok().filter(|dlc| *dlc <= 8)?;
        Self::remote_frame(id.into().into(), dlc)
    }

    fn is_extended(&self) -> bool {
        Frame::id(self).is_extended()
    }

    fn is_remote_frame(&self) -> bool {
        self.is_remote()
    }

    fn id(&self) -> can::Id {
        Frame::id(self).into()
    }

    fn dlc(&self) -> usize {
        usize::from(Frame::dlc(self).min(8))
    }

    fn data(&self) -> &[u8] {
        Frame::data(self)
    }
}

impl can::Error for BusErrorKind {
    fn kind(&self) -> can::ErrorKind {
        match self {
            Self::Stuff => can::ErrorKind::Stuff,
            Self::Form => can::ErrorKind::Form,
            Self::Acknowledgment => can::ErrorKind::Acknowledge,
            Self::BitRecessive | Self::BitDominant => can::ErrorKind::Bit,
            Self::Crc => can::ErrorKind::Crc,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn any_frame_with_a_plain_length_survives_the_traits(
            extended: bool, raw: u32, remote: bool, dlc in 0..=8_u8, data: [u8; 8],
        ) {
            let id = if extended { Id::extended_truncated(raw) } else { Id::standard_truncated(raw) };
            let frame = Frame::from_bus(id, remote, dlc, data);
            let id = can::Frame::id(&frame);
            let again: Option<Frame> = if can::Frame::is_remote_frame(&frame) {
                can::Frame::new_remote(id, can::Frame::dlc(&frame))
            } else {
                can::Frame::new(id, can::Frame::data(&frame))
            };
            prop_assert_eq!(again, Some(frame));
            prop_assert_eq!(can::Frame::is_standard(&frame), !extended);
        }
    }

    #[test]
    fn what_no_classical_frame_has_is_refused() {
        let id = can::StandardId::ZERO;
        assert!(<Frame as can::Frame>::new(id, &[0; 9]).is_none());
        assert!(<Frame as can::Frame>::new_remote(id, 9).is_none());
        let long = Frame::from_bus(Id::standard_truncated(1), false, 15, [7; 8]);
        assert_eq!((can::Frame::dlc(&long), can::Frame::data(&long)), (8, &[7; 8][..]));
    }

    #[test]
    fn every_error_of_the_bus_has_its_kind_there() {
        use can::{
            Error,
            ErrorKind::{Acknowledge, Bit, Crc, Form, Stuff},
        };
        assert_eq!(BusErrorKind::ALL.map(|kind| kind.kind()), [Stuff, Form, Acknowledge, Bit, Bit, Crc]);
    }

    #[test]
    fn a_remote_frame_asks_for_up_to_eight_bytes() {
        let lengths =
            [0, 8, 9, 256, 264].map(|dlc| <Frame as can::Frame>::new_remote(can::StandardId::ZERO, dlc));
        assert_eq!(lengths.map(|frame| frame.map(|frame| frame.dlc())), [Some(0), Some(8), None, None, None]);
    }
}
