//! A frame of a trace: a classical one or an FD one.

use std::fmt;
use std::str::FromStr;

use cantap_can::frame::ParseFrameError;
use cantap_can::{Frame, Id};

use crate::fd::{FLAG_BRS, FLAG_ESI, FLAG_FDF, FdFrame};

/// A frame of a trace. Its methods give what both kinds have; for the rest use [`Self::classic`] or [`Self::fd`].
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub enum TraceFrame {
    /// A classical frame: data or remote.
    Classic(Frame),
    /// A CAN FD frame.
    Fd(FdFrame),
}

impl TraceFrame {
    /// The identifier.
    #[inline]
    pub const fn id(&self) -> Id {
        match self {
            Self::Classic(frame) => frame.id(),
            Self::Fd(frame) => frame.id(),
        }
    }

    /// Whether it is a remote frame, which FD does not have.
    #[inline]
    pub const fn is_remote(&self) -> bool {
        match self {
            Self::Classic(frame) => frame.is_remote(),
            Self::Fd(_) => false,
        }
    }

    /// Whether it is an FD frame.
    #[inline]
    pub const fn is_fd(&self) -> bool {
        matches!(self, Self::Fd(_))
    }

    /// The data length code as on the bus, 0 to 15. Above 8 it means 8 bytes in a classical frame, and up to 64 in an FD one.
    #[inline]
    pub const fn dlc(&self) -> u8 {
        match self {
            Self::Classic(frame) => frame.dlc(),
            Self::Fd(frame) => frame.dlc(),
        }
    }

    /// The data bytes: up to 8, or up to 64 in an FD frame; none in a remote frame.
    #[inline]
    pub fn data(&self) -> &[u8] {
        match self {
            Self::Classic(frame) => frame.data(),
            Self::Fd(frame) => frame.data(),
        }
    }

    /// The number of data bytes in the frame.
    #[inline]
    pub const fn data_len(&self) -> usize {
        match self {
            Self::Classic(frame) => frame.data_len(),
            Self::Fd(frame) => frame.data_len(),
        }
    }

    /// The classical frame, if it is one: the only kind that cantap's devices can send.
    #[inline]
    pub const fn classic(&self) -> Option<&Frame> {
        match self {
            Self::Classic(frame) => Some(frame),
            Self::Fd(_) => None,
        }
    }

    /// The FD frame, if it is one.
    #[inline]
    pub const fn fd(&self) -> Option<&FdFrame> {
        match self {
            Self::Classic(_) => None,
            Self::Fd(frame) => Some(frame),
        }
    }
}

impl From<Frame> for TraceFrame {
    #[inline]
    fn from(frame: Frame) -> Self {
        Self::Classic(frame)
    }
}

impl From<FdFrame> for TraceFrame {
    #[inline]
    fn from(frame: FdFrame) -> Self {
        Self::Fd(frame)
    }
}

impl PartialEq<Frame> for TraceFrame {
    fn eq(&self, other: &Frame) -> bool {
        self.classic() == Some(other)
    }
}

impl fmt::Display for TraceFrame {
    /// As can-utils writes it: `123#DEADBEEF`, `123#R3`; an FD frame as `123##1DEADBEEF`, where the digit has its
    /// flags.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Classic(frame) => frame.fmt(f),
            Self::Fd(frame) => frame.fmt(f),
        }
    }
}

impl fmt::Debug for TraceFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Classic(frame) => frame.fmt(f),
            Self::Fd(frame) => fmt::Debug::fmt(frame, f),
        }
    }
}

/// Why a text is not a frame of a trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ParseTraceFrameError {
    /// It is not a classical frame either.
    #[error(transparent)]
    Classic(#[from] ParseFrameError),
    /// What follows `##` is not a digit of flags.
    #[error(
        "the digit behind '##' has the flags: 1 for a switched bit rate, 2 for an error passive sender, 4 for FD"
    )]
    BadFlags,
    /// FD has no length code for this number of bytes.
    #[error("a CAN FD frame carries 0 to 8, 12, 16, 20, 24, 32, 48 or 64 data bytes")]
    BadLength,
}

impl FromStr for TraceFrame {
    type Err = ParseTraceFrameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let Some((id, rest)) = text.split_once("##") else {
            return Ok(Self::Classic(text.parse()?));
        };
        let id: Id = id.parse()?;
        let mut characters = rest.chars();
        let flags = characters.next().and_then(|digit| digit.to_digit(16)).unwrap_or(u32::MAX);
        let known = u32::from(FLAG_BRS | FLAG_ESI | FLAG_FDF);
        if flags & !known != 0 {
            return Err(ParseTraceFrameError::BadFlags);
        }
        let mut bytes = Vec::with_capacity(crate::fd::FD_MAX_BYTES);
        let mut digits = characters.as_str();
        while !digits.is_empty() {
            if !bytes.is_empty() {
                digits = digits.strip_prefix('.').unwrap_or(digits);
            }
            let pair = digits.get(..2).filter(|pair| pair.bytes().all(|digit| digit.is_ascii_hexdigit()));
            let byte = pair.and_then(|pair| u8::from_str_radix(pair, 16).ok());
            bytes.push(byte.ok_or(ParseFrameError::BadData)?);
            digits = &digits[2..];
        }
        let has = |flag: u8| flags & u32::from(flag) != 0;
        FdFrame::new(id, has(FLAG_BRS), has(FLAG_ESI), &bytes)
            .map(Self::Fd)
            .ok_or(ParseTraceFrameError::BadLength)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_forms_round_trip() {
        for text in
            ["123#DEADBEEF", "123#R3", "00000001##0", "7FF##3000102030405060708090A0B", "18DAF110##1AA"]
        {
            assert_eq!(text.parse::<TraceFrame>().unwrap().to_string(), text);
        }
        // Newer kernels also flag FD; dots may separate bytes.
        assert_eq!("123##511.22".parse::<TraceFrame>().unwrap().to_string(), "123##11122");
    }

    #[test]
    fn bad_texts_name_their_fault() {
        for (text, fault) in [
            ("123", ParseTraceFrameError::Classic(ParseFrameError::MissingHash)),
            ("123##", ParseTraceFrameError::BadFlags),
            ("123##8", ParseTraceFrameError::BadFlags),
            ("123##1000102030405060708", ParseTraceFrameError::BadLength),
            ("123##11", ParseTraceFrameError::Classic(ParseFrameError::BadData)),
            ("123##1+1", ParseTraceFrameError::Classic(ParseFrameError::BadData)),
            ("123##1é1", ParseTraceFrameError::Classic(ParseFrameError::BadData)),
            ("900##1", ParseTraceFrameError::Classic(ParseFrameError::BadId)),
        ] {
            assert_eq!(text.parse::<TraceFrame>(), Err(fault), "{text}");
        }
    }

    #[test]
    fn a_trace_s_frame_is_the_classical_one_that_it_was_made_of_and_no_other() {
        let classic: Frame = "123#11".parse().unwrap();
        let frame = TraceFrame::from(classic);
        assert!(frame == classic && frame != "123#12".parse::<Frame>().unwrap());
        assert_eq!((frame.classic(), frame.fd()), (Some(&classic), None));
        let fd: TraceFrame = "123##011".parse().unwrap();
        assert!(fd != classic && fd.classic().is_none() && fd.fd().is_some());
        assert_eq!(format!("{frame:?} {fd:?}"), "Frame(123#11) FdFrame(123##011)");
    }
}
