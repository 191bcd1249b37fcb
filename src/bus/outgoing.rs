//! A frame to be sent: classical, and where the controllers are other makers' adapters, of CAN FD too.

#[cfg(not(target_os = "none"))]
use cantap_wire::FdFrame;
use cantap_wire::Frame;

use crate::ports::Traffic;

/// On a board, whose memory and time have no room for what its controllers cannot send, this is a classical frame and nothing else.
#[derive(Clone, Copy)]
pub(crate) enum Outgoing {
    Classic(Frame),
    #[cfg(not(target_os = "none"))]
    Fd(FdFrame),
}

impl Outgoing {
    /// Writes it to a free mailbox: see [`Traffic::prepare`].
    #[inline]
    pub fn prepare(&self, traffic: &mut impl Traffic) -> Option<u8> {
        match self {
            Self::Classic(frame) => traffic.prepare(frame),
            #[cfg(not(target_os = "none"))]
            Self::Fd(frame) => traffic.prepare_fd(frame),
        }
    }
}

impl From<Frame> for Outgoing {
    fn from(frame: Frame) -> Self {
        Self::Classic(frame)
    }
}
