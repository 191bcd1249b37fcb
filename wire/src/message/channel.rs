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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mode_has_a_name_of_its_own_and_all_but_listening_send() {
        assert!(Mode::ALL.iter().all(|mode| Mode::from_name(mode.name()) == Some(*mode)));
        assert_eq!(Mode::ALL.map(Mode::name), ["listen-only", "normal", "loopback", "silent-loopback"]);
        assert_eq!(Mode::ALL.map(Mode::transmits), [false, true, true, true]);
        assert_eq!(Mode::from_name("listen"), None);
    }

    #[test]
    fn a_filter_passes_frames_of_its_kind_whose_masked_bits_agree() {
        let frame = |text: &str| text.parse::<Frame>().unwrap();
        let passes =
            |extended, kind, id, mask, text| Filter { extended, kind, id, mask }.matches(&frame(text));
        assert!(
            passes(false, FrameKind::Any, 0x120, 0x7F0, "123#11")
                && passes(false, FrameKind::Any, 0x120, 0x7F0, "12F#R")
        );
        assert!(
            !passes(false, FrameKind::Any, 0x120, 0x7F0, "133#11")
                && !passes(false, FrameKind::Any, 0x120, 0x7FF, "123#11")
        );
        // Bits that the mask leaves out may be anything, in the filter too.
        assert!(passes(false, FrameKind::Any, 0x123, 0x7F0, "120#"));
        assert!(
            passes(true, FrameKind::Any, 0x123, 0x1FFF_FFFF, "00000123#")
                && !passes(true, FrameKind::Any, 0x123, 0x7FF, "123#")
        );
        assert!(!passes(false, FrameKind::Any, 0x123, 0x7FF, "00000123#"));
        for (kind, data, remote) in
            [(FrameKind::Data, true, false), (FrameKind::Remote, false, true), (FrameKind::Any, true, true)]
        {
            assert_eq!(
                (passes(false, kind, 0, 0, "123#11"), passes(false, kind, 0, 0, "123#R")),
                (data, remote),
                "{kind:?}"
            );
        }
    }

    #[test]
    fn a_filter_has_no_bits_that_no_identifier_has() {
        let valid = |extended, id, mask| Filter { extended, kind: FrameKind::Any, id, mask }.is_valid();
        assert!(valid(false, 0x7FF, 0x7FF) && valid(true, 0x1FFF_FFFF, 0x1FFF_FFFF));
        assert!(!valid(false, 0x800, 0x7FF) && !valid(false, 0x7FF, 0x800));
        assert!(!valid(true, 0x2000_0000, 0) && !valid(true, 0, 0x2000_0000));
    }
}
