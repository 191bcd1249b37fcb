//! One entry of a trace, wherever it comes from: a live device, a file, a simulated bus.

use cantap_wire::record::{BusErrorKind, ErrorState, LossStage, TransmitFailure};

use crate::TraceFrame;

/// Whether a frame was received or sent by the device that wrote the trace.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Direction {
    /// Received, or unknown.
    #[default]
    Rx,
    /// Sent.
    Tx,
}

/// One entry of a trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TraceRecord {
    /// Nanoseconds since the Unix epoch (UTC); since the trace's start where no date is known. For a frame it
    /// is the end of the frame.
    pub time_ns: i64,
    /// The channel as users count, from 1. Devices have two; files may name more.
    pub channel: u8,
    /// What happened.
    pub event: TraceEvent,
}

/// What a trace entry says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TraceEvent {
    /// A frame was received or sent.
    Frame {
        /// The frame.
        frame: TraceFrame,
        /// Received or sent.
        direction: Direction,
        /// Its time is only an upper bound: the frame ended then or earlier.
        late: bool,
    },
    /// The controller saw an error on the bus. Kind and counters are known from a device, and from
    /// those formats that carry them.
    BusError {
        /// What, if known.
        kind: Option<BusErrorKind>,
        /// Transmit and receive error counters after it, if known.
        counters: Option<(u8, u8)>,
    },
    /// Bus errors that were counted but not reported one by one.
    ErrorsSuppressed {
        /// How many.
        count: u32,
    },
    /// The controller's fault confinement changed.
    State {
        /// The new state.
        state: ErrorState,
        /// Transmit and receive error counters, if known.
        counters: Option<(u8, u8)>,
    },
    /// Frames are missing here.
    Lost {
        /// The stage that lost them, if known.
        stage: Option<LossStage>,
        /// How many.
        count: u32,
        /// Whether there may have been more.
        at_least: bool,
    },
    /// The device was asked to send a frame and did not.
    TransmitFailed {
        /// The request's tag.
        tag: u32,
        /// Why.
        reason: TransmitFailure,
    },
}

impl TraceEvent {
    /// From here to the next record nothing is known: the device was not there. How many frames are missing nobody can tell.
    pub const GAP: Self = Self::Lost { stage: Some(LossStage::Link), count: 0, at_least: true };
}

impl TraceRecord {
    /// The frame, if this is one.
    pub fn frame(&self) -> Option<&TraceFrame> {
        match &self.event {
            TraceEvent::Frame { frame, .. } => Some(frame),
            _ => None,
        }
    }
}
