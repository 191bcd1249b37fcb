//! How long a gateway takes: the frames of one channel found again on another.
//!
//! A frame on the first channel is expected on the second within a window, as it is or as a map says; it is recognised by its identifier
//! and data. A stamp is the end of a frame, so a delay contains the time that the second bus takes for the frame, and waiting for it.
//!
//! **Frames that are alike** cannot be told apart. One on the second channel is taken for the nearest before it that is still waiting, so that a
//! lost frame does not shift all that follow; if several were waiting and none of them stays missing, they are paired in order. If one does,
//! or a pair had to be changed afterwards, it is not known which is whose, and those paired meanwhile are counted as [`Figures::ambiguous`], without a delay. What no pairing can show is a gateway that
//! always takes longer than equal frames are apart: its delays appear shorter by that, with one frame missing where such a row begins and one extra
//! where it ends. [`Figures::repeated`] and [`Figures::shortest_repeat_ns`] say where that limit is.
//!
//! **Nothing is missing that cannot be known to be**: what the trace's beginning or end or a loss recorded in it may explain is counted apart
//! ([`Undecided`]). Memory grows with the window and the number of identifiers, not with the trace.

mod figures;
mod matching;
mod run;
#[cfg(test)]
mod tests;

use cantap_trace::{FdFrame, Frame, Id, TraceFrame};

pub use figures::{Delays, Figures, STEPS_NS, Undecided};
pub use matching::Matching;

/// Which frames to find again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DelayOptions {
    /// The channel, from 1, whose frames are expected on the other.
    pub from: u8,
    /// That channel.
    pub to: u8,
    /// Nanoseconds after which a frame counts as missing, 1 at least.
    pub within_ns: i64,
}

/// What is expected on the second channel for a frame of the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Expected {
    /// The frame.
    pub frame: TraceFrame,
    /// The data bits that can have any value: those of a counter, for example. Only for classical frames.
    pub unknown: [u8; 8],
    /// Which rule expects it; frames of one rule replace each other within [`Self::period_ns`].
    pub rule: usize,
    /// A newer frame of this rule may replace this one within so many nanoseconds; 0: never.
    pub period_ns: i64,
    /// Nanoseconds that the gateway holds it back on purpose; they are part of its delay.
    pub held_ns: i64,
}

impl Expected {
    /// The same frame, without a rule.
    pub const fn unchanged(frame: TraceFrame) -> Self {
        Self { frame, unknown: [0; 8], rule: 0, period_ns: 0, held_ns: 0 }
    }
}

/// All that the analysis knows at the end.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// Of all identifiers together.
    pub total: Figures,
    /// By identifier, in order: of frames that came from the first channel by theirs, extra ones by that on the second.
    pub ids: Vec<(Id, Figures)>,
    /// Frames of the first channel that are not expected on the second.
    pub not_expected: u64,
    /// Frames of identifiers beyond [`MOST_IDS`], which are only in [`Self::total`].
    pub beyond: u64,
    /// The step of all stamps in nanoseconds, if it is a microsecond or more: no delay is more exact.
    pub step_ns: Option<u64>,
    /// Whether a device recorded one of the channels that does not count its losses: a frame may be missing in the trace alone.
    pub uncounted: bool,
    /// How often the clock was set back: nothing is expected across that.
    pub breaks: u64,
}

/// How many identifiers have a row of their own.
pub const MOST_IDS: usize = 4096;

/// What makes two frames the same: FD's error state indicator is its sender's.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    frame: TraceFrame,
    unknown: [u8; 8],
}

impl Key {
    fn new(frame: &TraceFrame, unknown: [u8; 8]) -> Self {
        let frame = match frame {
            TraceFrame::Classic(classic) => {
                let mut data = classic.padded_data();
                data.iter_mut().zip(unknown).for_each(|(byte, any)| *byte &= !any);
                Frame::from_bus(classic.id(), classic.is_remote(), classic.dlc(), data).into()
            }
            TraceFrame::Fd(fd) => {
                FdFrame::new(fd.id(), fd.brs(), false, fd.data()).map_or(*frame, TraceFrame::Fd)
            }
        };
        Self { frame, unknown }
    }
}
