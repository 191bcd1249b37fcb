//! A CAN FD frame. cantap's boards are classical only, but other makers' adapters and traces from other tools have FD frames.

use core::fmt;

use crate::{Frame, Id};

/// The data length of each length code in an FD frame (ISO 11898-1:2015, table 5).
pub const FD_LENGTHS: [u8; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

/// The largest number of data bytes in an FD frame.
pub const FD_MAX_BYTES: usize = 64;

/// A CAN FD data frame; FD has no remote frames.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct FdFrame {
    id: Id,
    dlc: u8,
    brs: bool,
    esi: bool,
    data: [u8; FD_MAX_BYTES],
}

impl FdFrame {
    /// A frame with these bytes; `None` if FD has no length code for their number ([`FD_LENGTHS`]).
    ///
    /// `brs`: the data phase has its own bit rate. `esi`: the sender is error passive.
    pub fn new(id: Id, brs: bool, esi: bool, bytes: &[u8]) -> Option<Self> {
        let dlc = FD_LENGTHS.iter().position(|len| usize::from(*len) == bytes.len())? as u8;
        let mut data = [0; FD_MAX_BYTES];
        data[..bytes.len()].copy_from_slice(bytes);
        Some(Self { id, dlc, brs, esi, data })
    }

    /// The same with zeros after the bytes, up to the next length that FD has; `None` above 64.
    pub fn padded(id: Id, brs: bool, esi: bool, bytes: &[u8]) -> Option<Self> {
        let len = FD_LENGTHS.iter().find(|len| usize::from(**len) >= bytes.len())?;
        let mut data = [0; FD_MAX_BYTES];
        data[..bytes.len()].copy_from_slice(bytes);
        Self::new(id, brs, esi, &data[..usize::from(*len)])
    }

    /// The identifier.
    pub const fn id(&self) -> Id {
        self.id
    }

    /// Whether the data phase has its own bit rate.
    pub const fn brs(&self) -> bool {
        self.brs
    }

    /// Whether the sender is error passive.
    pub const fn esi(&self) -> bool {
        self.esi
    }

    /// The data length code as on the bus, 0 to 15.
    pub const fn dlc(&self) -> u8 {
        self.dlc
    }

    /// The data bytes, 0 to 64.
    pub fn data(&self) -> &[u8] {
        &self.data[..self.data_len()]
    }

    /// A classical data frame of this identifier, without data: filters, which look at nothing else, treat both alike.
    pub fn identifier_frame(&self) -> Frame {
        Frame::from_bus(self.id, false, 0, [0; 8])
    }

    /// The number of data bytes.
    pub const fn data_len(&self) -> usize {
        FD_LENGTHS[(self.dlc & 15) as usize] as usize
    }
}

/// Flag in the text form's single digit, as in Linux's `canfd_frame`: the bit rate is switched.
pub const FLAG_BRS: u8 = 1;
/// The sender is error passive.
pub const FLAG_ESI: u8 = 2;
/// Flag for an FD frame, which it is anyway; kernels differ in whether they set it.
pub const FLAG_FDF: u8 = 4;

impl FdFrame {
    /// [`FLAG_BRS`] and [`FLAG_ESI`].
    pub const fn flags(&self) -> u8 {
        (if self.brs { FLAG_BRS } else { 0 }) | (if self.esi { FLAG_ESI } else { 0 })
    }
}

impl fmt::Display for FdFrame {
    /// `123##1DEADBEEF`: the digit after `##` has the flags.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}##{:X}", self.id, self.flags())?;
        self.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))
    }
}

impl fmt::Debug for FdFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FdFrame({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_lengths_that_the_bus_has_a_code_for_make_a_frame() {
        let id = Id::standard(1).unwrap();
        for len in 0..=70 {
            let frame = FdFrame::new(id, true, false, &[7; 70][..len]);
            let known = FD_LENGTHS.iter().any(|known| usize::from(*known) == len);
            assert_eq!(frame.is_some(), known, "{len}");
            assert!(frame.is_none_or(|frame| frame.data() == &[7; 70][..len]));
            let padded = FdFrame::padded(id, false, true, &[7; 70][..len]);
            assert_eq!(padded.is_some(), len <= 64);
            assert!(padded.is_none_or(|frame| {
                let (data, padding) = frame.data().split_at(len);
                data == &[7; 70][..len] && padding.iter().all(|byte| *byte == 0) && padding.len() < 16
            }));
        }
    }

    #[test]
    fn a_frame_has_the_parts_that_it_was_made_of_and_shows_them() {
        let id = Id::standard(0x123).unwrap();
        for (brs, esi, text) in [
            (false, false, "123##0DEADBEEF"),
            (true, false, "123##1DEADBEEF"),
            (false, true, "123##2DEADBEEF"),
            (true, true, "123##3DEADBEEF"),
        ] {
            let frame = FdFrame::new(id, brs, esi, &[0xDE, 0xAD, 0xBE, 0xEF]).unwrap();
            assert_eq!((frame.id(), frame.brs(), frame.esi(), frame.dlc()), (id, brs, esi, 4));
            assert_eq!(
                (frame.to_string().as_str(), format!("{frame:?}")),
                (text, format!("FdFrame({text})"))
            );
            assert_eq!(frame.identifier_frame(), "123#".parse().unwrap());
        }
        let long = FdFrame::new(Id::extended(0x123).unwrap(), false, false, &[0; 64]).unwrap();
        assert_eq!(
            (long.dlc(), long.data_len(), long.identifier_frame()),
            (15, 64, "00000123#".parse().unwrap())
        );
    }
}
