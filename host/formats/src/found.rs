//! What a format's reader finds in a file.

use super::issue::{Fault, Place};
use cantap_trace::{TraceEvent, TraceRecord};

/// What a format's reader finds next.
pub(crate) enum Found {
    /// A record.
    Record(TraceRecord),
    /// Something wrong; reading goes on behind it.
    Issue(Place, Fault),
    /// Nothing wrong, but something that the user should know, to be counted.
    Note(&'static str),
    /// Something well-formed that a trace of CAN does not hold, such as a LIN frame: left out, and counted by its kind.
    LeftOut(&'static str),
    /// The end.
    End,
}

/// What a row says: a record, and a second event at the same time.
pub(crate) type Row = Option<(TraceRecord, Option<TraceEvent>)>;
