//! LIN frames: loggers of several buses write them beside those of CAN. They are kept and shown, and not decoded.

use std::fmt;

/// Most data bytes of a frame.
const MOST_BYTES: usize = 8;

/// A frame on a LIN bus: a header of the commander, and what was answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct LinFrame {
    id: u8,
    len: u8,
    data: [u8; MOST_BYTES],
    /// The byte behind the data, if the logger says it.
    pub checksum: Option<u8>,
    /// What was wrong, if anything.
    pub fault: Option<LinFault>,
}

/// What was wrong with a LIN frame, in a logger's words.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum LinFault {
    /// The checksum does not fit the data.
    Checksum,
    /// Nobody answered the header.
    NoResponse,
    /// The answer was cut short, or its bytes were none.
    Response,
}

impl LinFault {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Checksum, Self::NoResponse, Self::Response];

    /// Its name in files and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Checksum => "checksum",
            Self::NoResponse => "no-response",
            Self::Response => "response",
        }
    }

    /// The fault of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|fault| fault.name() == name)
    }
}

impl LinFrame {
    /// The highest identifier, without its parity bits.
    pub const MAX_ID: u8 = 0x3F;

    /// A frame; `None` for an identifier above [`Self::MAX_ID`], or more than eight bytes.
    pub fn new(id: u8, data: &[u8]) -> Option<Self> {
        let mut bytes = [0; MOST_BYTES];
        bytes.get_mut(..data.len())?.copy_from_slice(data);
        let frame = Self { id, len: data.len() as u8, data: bytes, checksum: None, fault: None };
        (id <= Self::MAX_ID).then_some(frame)
    }

    /// The same with a checksum and a fault.
    #[must_use]
    pub const fn with(self, checksum: Option<u8>, fault: Option<LinFault>) -> Self {
        Self { checksum, fault, ..self }
    }

    /// The identifier, 0 to [`Self::MAX_ID`], without its parity bits.
    pub const fn id(&self) -> u8 {
        self.id
    }

    /// The data, up to eight bytes; none if nobody answered.
    pub fn data(&self) -> &[u8] {
        &self.data[..usize::from(self.len)]
    }
}

impl fmt::Display for LinFrame {
    /// `LIN frame 3C: 01 02, checksum FC`; `LIN frame 3C: no response`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LIN frame {:02X}", self.id)?;
        for (at, byte) in self.data().iter().enumerate() {
            write!(f, "{} {byte:02X}", if at == 0 { ":" } else { "" })?;
        }
        let mark = if self.len == 0 { ": " } else { ", " };
        match (self.fault, self.checksum) {
            (Some(LinFault::NoResponse), _) => write!(f, "{mark}no response"),
            (Some(LinFault::Response), _) => write!(f, "{mark}wrong response"),
            (Some(LinFault::Checksum), Some(byte)) => write!(f, "{mark}wrong checksum {byte:02X}"),
            (Some(LinFault::Checksum), None) => write!(f, "{mark}wrong checksum"),
            (None, Some(byte)) => write!(f, "{mark}checksum {byte:02X}"),
            (None, None) => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_lin_frame_is_none() {
        assert!(LinFrame::new(0x3F, &[0; 8]).is_some());
        assert!(LinFrame::new(0x40, &[]).is_none() && LinFrame::new(1, &[0; 9]).is_none());
    }

    #[test]
    fn a_line_says_what_was_answered() {
        let frame = LinFrame::new(0x0A, &[1, 0xFF]).unwrap();
        for (frame, text) in [
            (frame, "LIN frame 0A: 01 FF"),
            (LinFrame { checksum: Some(0xFE), ..frame }, "LIN frame 0A: 01 FF, checksum FE"),
            (
                LinFrame { checksum: Some(0xFE), fault: Some(LinFault::Checksum), ..frame },
                "LIN frame 0A: 01 FF, wrong checksum FE",
            ),
            (LinFrame { fault: Some(LinFault::Response), ..frame }, "LIN frame 0A: 01 FF, wrong response"),
            (
                LinFrame { fault: Some(LinFault::NoResponse), ..LinFrame::new(0x0A, &[]).unwrap() },
                "LIN frame 0A: no response",
            ),
        ] {
            assert_eq!(frame.to_string(), text);
        }
    }
}
