//! What the lines of an ASC file can be.

use cantap_trace::{TraceEvent, TraceRecord};

/// What a line is.
pub(super) enum Content {
    Record(TraceRecord),
    /// A request to send: if it gets through, a Tx line follows.
    Request,
    /// A known thing that is no part of a trace of CAN, by kind.
    LeftOut(&'static str),
    /// Part of the file's frame, which nobody misses.
    Other,
}

/// What a line on a channel of CAN is.
pub(super) enum OnChannel {
    Event(TraceEvent),
    /// A request to send: if it gets through, a Tx line follows.
    Request,
    /// A known thing that is no part of a trace, by kind.
    LeftOut(&'static str),
}

impl OnChannel {
    /// The same, of a line at this time on this channel.
    pub(super) fn on(self, time_ns: i64, channel: u8) -> Content {
        match self {
            Self::Event(event) => Content::Record(TraceRecord { time_ns, channel, event }),
            Self::Request => Content::Request,
            Self::LeftOut(what) => Content::LeftOut(what),
        }
    }
}
