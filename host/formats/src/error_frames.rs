//! SocketCAN's error frames, for the formats that write them as frames: one can become two records, and may contain more
//! than they keep.

use std::collections::VecDeque;

use super::found::Found;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_trace::{TraceEvent, TraceRecord};

const DETAILS_LEFT_OUT: &str =
    "error frames say more than their kind, the state and the counters, which is left out";

/// What remains to be returned of the frames read so far.
#[derive(Default)]
pub(super) struct ErrorFrames {
    records: VecDeque<TraceRecord>,
    /// Number of frames whose details were left out, to be reported.
    untold: u64,
}

impl ErrorFrames {
    /// The meaning of an error frame: one event, or two at the same time.
    pub(super) fn read(&mut self, id: u32, data: [u8; 8]) -> (TraceEvent, Option<TraceEvent>) {
        let frame = ErrorFrame { classes: id & (ERROR_FLAG - 1), data };
        self.untold += u64::from(!frame.is_told_whole());
        frame.events()
    }

    /// Queues records that follow the one being returned.
    pub(super) fn keep(&mut self, records: impl IntoIterator<Item = TraceRecord>) {
        self.records.extend(records);
    }

    /// Whether no record is queued.
    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// Whether there is nothing left to return or report.
    pub(super) fn is_over(&self) -> bool {
        self.is_empty() && self.untold == 0
    }

    /// What to return before anything else is read.
    pub(super) fn next(&mut self) -> Option<Found> {
        if let Some(record) = self.records.pop_front() {
            return Some(Found::Record(record));
        }
        self.note().map(Found::Note)
    }

    /// What to report about the frames that were read.
    pub(super) fn note(&mut self) -> Option<&'static str> {
        self.untold = self.untold.checked_sub(1)?;
        Some(DETAILS_LEFT_OUT)
    }
}
