//! A frame that a client has the board send: classical, or of CAN FD where what is shared sends such frames.

use cantap_wire::message::{MAX_SEND, TxFdFrame, TxFrame};
use cantap_wire::{Channel, Command, Id};

/// Either kind.
#[derive(Clone, Copy, Debug)]
pub enum ToSend {
    Classic(TxFrame),
    Fd(TxFdFrame),
}

/// As many as one request has.
pub type Batch = heapless::Vec<ToSend, MAX_SEND>;

impl ToSend {
    pub const fn tag(&self) -> u32 {
        match self {
            Self::Classic(frame) => frame.tag,
            Self::Fd(frame) => frame.tag,
        }
    }

    pub const fn id(&self) -> Id {
        match self {
            Self::Classic(frame) => frame.frame.id(),
            Self::Fd(frame) => frame.frame.id(),
        }
    }

    /// The same frame under another tag.
    pub const fn tagged(self, tag: u32) -> Self {
        match self {
            Self::Classic(frame) => Self::Classic(TxFrame { tag, ..frame }),
            Self::Fd(frame) => Self::Fd(TxFdFrame { tag, ..frame }),
        }
    }
}

/// The request to send frames of one kind.
pub fn command(channel: Channel, frames: &[ToSend]) -> Command {
    let fd = |frame: &ToSend| if let ToSend::Fd(frame) = frame { Some(*frame) } else { None };
    let classic = |frame: &ToSend| if let ToSend::Classic(frame) = frame { Some(*frame) } else { None };
    if let Some(ToSend::Fd(_)) = frames.first() {
        Command::SendFd { channel, frames: frames.iter().filter_map(fd).collect() }
    } else {
        Command::Send { channel, frames: frames.iter().filter_map(classic).collect() }
    }
}
