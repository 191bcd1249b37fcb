//! What a format's reader finds in a file.

use super::issue::{Fault, Place};
use cantap_trace::{TraceEvent, TraceRecord};

/// What a format's reader returns next.
pub(crate) enum Found {
    /// A record.
    Record(TraceRecord),
    /// Something wrong; reading continues after it.
    Issue(Place, Fault),
    /// Nothing wrong, but something that the user should know, to be counted.
    Note(&'static str),
    /// Something well-formed that a CAN trace does not hold, such as a LIN frame: left out, and counted by kind.
    LeftOut(&'static str),
    /// The end.
    End,
}

/// The content of a row: a record, and possibly a second event at the same time.
pub(crate) type Row = Option<(TraceRecord, Option<TraceEvent>)>;
