//! What crosses an interface: a frame of either kind, as Linux lays it out.

use cantap_adapters::raw_can::{RawFdFrame, RawFrame, fd_frame_of, frame_of, raw_fd_frame, raw_frame};
use cantap_trace::TraceFrame;

/// `struct can_frame`, which may be an error frame, or `struct canfd_frame`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Raw {
    Classic(RawFrame),
    Fd(RawFdFrame),
}

impl Raw {
    /// A message of the kernel's; `None` for one of another length.
    pub fn of(bytes: &[u8]) -> Option<Self> {
        let classic = RawFrame::try_from(bytes).map(Self::Classic);
        classic.or_else(|_| RawFdFrame::try_from(bytes).map(Self::Fd)).ok()
    }

    /// A frame for programs.
    pub fn of_frame(frame: &TraceFrame) -> Self {
        match frame {
            TraceFrame::Classic(frame) => Self::Classic(raw_frame(frame)),
            TraceFrame::Fd(frame) => Self::Fd(raw_fd_frame(frame)),
        }
    }

    /// What the kernel is given.
    pub fn bytes(&self) -> &[u8] {
        match self {
            Self::Classic(raw) => raw,
            Self::Fd(raw) => raw,
        }
    }

    /// The frame; `None` if no bus can carry it.
    pub fn frame(&self) -> Option<TraceFrame> {
        match self {
            Self::Classic(raw) => frame_of(raw).map(TraceFrame::Classic),
            Self::Fd(raw) => fd_frame_of(raw).map(TraceFrame::Fd),
        }
    }
}
