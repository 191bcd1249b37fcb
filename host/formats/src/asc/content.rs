//! What the lines of an ASC file can be.

use cantap_trace::{Direction, TraceEvent, TraceRecord};

/// What a line is.
pub(super) enum Content {
    Record(TraceRecord),
    /// A request to send: if it gets through, a Tx line follows.
    Request,
    /// Something known that is not part of a CAN trace, by kind.
    LeftOut(&'static str),
    /// Part of the file's structure, with something that the user should know.
    Note(&'static str),
    /// Part of the file's structure, with nothing to report.
    Other,
}

/// What a line on a CAN channel is.
pub(super) enum OnChannel {
    Event(TraceEvent),
    /// A request to send: if it gets through, a Tx line follows.
    Request,
    /// Something known that is not part of a trace, by kind.
    LeftOut(&'static str),
}

impl OnChannel {
    /// The same for a line at this time on this channel.
    pub(super) fn on(self, time_ns: i64, channel: u8) -> Content {
        match self {
            Self::Event(event) => Content::Record(TraceRecord { time_ns, device_ns: None, channel, event }),
            Self::Request => Content::Request,
            Self::LeftOut(what) => Content::LeftOut(what),
        }
    }
}

/// Vector writes `Rx` and `Tx`; other programs write `RX` and `TX`, too.
#[inline]
pub(super) fn direction(word: &[u8]) -> Option<Direction> {
    match word {
        b"Rx" | b"RX" | b"rx" => Some(Direction::Rx),
        b"Tx" | b"TX" | b"tx" => Some(Direction::Tx),
        _ => None,
    }
}
