//! How a channel takes part in a bus, and what it lets pass.

use serde::{Deserialize, Serialize};

use crate::{BitTiming, Frame, Id};

/// How a channel takes part in its bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Mode {
    /// Sends nothing at all, not even acknowledgements.
    ListenOnly,
    /// Acknowledges, transmits.
    Normal,
    /// Sends and receives its own frames; hears nothing from the bus.
    Loopback,
    /// Like [`Mode::Loopback`], but nothing reaches the bus.
    SilentLoopback,
}

impl Mode {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::ListenOnly, Self::Normal, Self::Loopback, Self::SilentLoopback];

    /// Its name in texts and JSON, and on command lines.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ListenOnly => "listen-only",
            Self::Normal => "normal",
            Self::Loopback => "loopback",
            Self::SilentLoopback => "silent-loopback",
        }
    }

    /// The mode of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|mode| mode.name() == name)
    }

    /// Whether frames can be sent in this mode.
    pub const fn transmits(self) -> bool {
        !matches!(self, Mode::ListenOnly)
    }
}

/// What [`super::Command::Open`] applies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ChannelConfig {
    /// Bit timing.
    pub timing: BitTiming,
    /// Mode.
    pub mode: Mode,
    /// No automatic retransmission.
    pub one_shot: bool,
    /// Leave bus-off only on [`super::Command::Recover`].
    pub manual_recovery: bool,
    /// Leave received frames' data bytes out of the stream.
    pub omit_data: bool,
    /// Leave received frames' stamps out of the stream.
    pub omit_stamps: bool,
}

impl ChannelConfig {
    /// Listen-only with this timing and nothing left out.
    pub const fn listen_only(timing: BitTiming) -> Self {
        Self {
            timing,
            mode: Mode::ListenOnly,
            one_shot: false,
            manual_recovery: false,
            omit_data: false,
            omit_stamps: false,
        }
    }
}

/// Which frames a filter lets through, apart from the identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum FrameKind {
    /// Data frames.
    Data,
    /// Remote frames.
    Remote,
    /// Both.
    Any,
}

/// A frame passes if its identifier has the same length and agrees with `id` in every bit of `mask`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Filter {
    /// 29-bit identifiers rather than 11-bit ones.
    pub extended: bool,
    /// Data frames, remote frames or both.
    pub kind: FrameKind,
    /// Identifier.
    pub id: u32,
    /// Bits that count.
    pub mask: u32,
}

impl Filter {
    /// Whether identifier and mask have no more bits than identifiers of this length.
    pub const fn is_valid(&self) -> bool {
        let widest = if self.extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        self.id <= widest && self.mask <= widest
    }

    /// Whether this filter lets `frame` pass.
    pub fn matches(&self, frame: &Frame) -> bool {
        let kind = match self.kind {
            FrameKind::Data => !frame.is_remote(),
            FrameKind::Remote => frame.is_remote(),
            FrameKind::Any => true,
        };
        kind && frame.id().is_extended() == self.extended && (frame.id().raw() ^ self.id) & self.mask == 0
    }
}
