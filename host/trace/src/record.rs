//! One entry of a trace, wherever it comes from: a live device, a file, a simulated bus.

use std::fmt;

use cantap_can::{BusErrorKind, ErrorState, LossStage, TransmitFailure};

use crate::device_time::{DeviceNs, Moment};
use crate::{Interface, LinFrame, TraceFrame};

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
    /// Nanoseconds since the Unix epoch (UTC), or since the trace's start if the date is unknown. For a frame
    /// it is the end of the frame.
    pub time_ns: i64,
    /// The same moment by the clock of the device that stamped it, corrected by nothing, if that is known. Two of them are as far apart as
    /// the device measured; `time_ns` is corrected towards UTC, which changes an interval by up to 100 parts per million.
    pub device_ns: Option<DeviceNs>,
    /// The channel, counted from 1. Devices have two; files may have more.
    pub channel: u8,
    /// What happened.
    pub event: TraceEvent,
}

/// The content of a trace entry.
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
    /// The controller detected an error on the bus. Kind and counters are known from a device, and from
    /// formats that carry them.
    BusError {
        /// The kind of error, if known.
        kind: Option<BusErrorKind>,
        /// Transmit and receive error counters after it, if known.
        counters: Option<(u8, u8)>,
    },
    /// Bus errors that were counted but not reported one by one.
    ErrorsSuppressed {
        /// Number of errors.
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
        /// Number of frames.
        count: u32,
        /// Whether there may have been more.
        at_least: bool,
    },
    /// The device did not send a frame that it was asked to send.
    TransmitFailed {
        /// The request's tag.
        tag: u32,
        /// The reason.
        reason: TransmitFailure,
    },
    /// The device drove the bus dominant on purpose, as asked. The record's time is when that began, or was to begin.
    Disturbed {
        /// For how many nanoseconds; 0 if it came to nothing, because the device was busy at that moment.
        length_ns: u32,
    },
    /// A frame of a LIN bus, in a trace of several buses. The record's channel is the number among the LIN buses: LIN 1 is
    /// another bus than CAN channel 1.
    Lin {
        /// The frame.
        frame: LinFrame,
        /// Whether the logger answered the header itself.
        direction: Direction,
    },
}

impl TraceEvent {
    /// Nothing is known from here to the next record: the device was not there. The number of missing frames is unknown.
    pub const GAP: Self = Self::Lost { stage: Some(LossStage::Link), count: 0, at_least: true };
    /// A channel starts here on a device that does not count its losses: from here on, frames may be missing without another record.
    pub const UNCOUNTED: Self = Self::Lost { stage: None, count: 0, at_least: true };
}

impl TraceRecord {
    /// The frame, if this is one.
    pub fn frame(&self) -> Option<&TraceFrame> {
        match &self.event {
            TraceEvent::Frame { frame, .. } => Some(frame),
            _ => None,
        }
    }

    /// The LIN frame, if this is one.
    pub const fn lin(&self) -> Option<&LinFrame> {
        match &self.event {
            TraceEvent::Lin { frame, .. } => Some(frame),
            _ => None,
        }
    }

    /// The name of its bus as programs print it: `can0` for channel 1, `lin0` for LIN 1.
    pub fn interface(&self) -> impl fmt::Display {
        let (lin, number) = (self.lin().is_some(), self.channel);
        fmt::from_fn(move |f| match number.checked_sub(1).filter(|_| lin) {
            Some(number) => write!(f, "lin{number}"),
            None => write!(f, "{}", Interface(number)),
        })
    }

    /// When it happened, by both clocks.
    #[inline]
    pub const fn moment(&self) -> Moment {
        Moment { time_ns: self.time_ns, device_ns: self.device_ns }
    }
}
