//! A frame to be sent: classical, and where the controllers are other makers' adapters, of CAN FD too.

#[cfg(not(target_os = "none"))]
use cantap_wire::FdFrame;
use cantap_wire::{Channel, Event, Frame};

use crate::bus::recorder::Recorder;
use crate::ports::Traffic;

/// On a board, whose memory and time have no room for what its controllers cannot send, this is a classical frame and nothing else.
#[derive(Clone, Copy)]
#[cfg_attr(not(target_os = "none"), expect(clippy::large_enum_variant, reason = "no allocation"))]
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

    /// Writes its confirmation, and returns whether there was room.
    #[inline]
    pub fn confirm<const N: usize>(
        &self,
        channel: Channel,
        tag: u32,
        at: u64,
        recorder: &mut Recorder<'_, N>,
    ) -> bool {
        match *self {
            Self::Classic(frame) => recorder.event(&Event::Transmitted { channel, tag, frame }, at),
            #[cfg(not(target_os = "none"))]
            Self::Fd(frame) => {
                recorder.fd_confirmation(&cantap_wire::TransmittedFd { channel, tag, frame }, at)
            }
        }
    }
}

impl From<Frame> for Outgoing {
    fn from(frame: Frame) -> Self {
        Self::Classic(frame)
    }
}
