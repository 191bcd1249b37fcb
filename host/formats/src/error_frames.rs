//! SocketCAN's error frames, for the formats that write them as frames: one can be two records, and say more than they keep.

use std::collections::VecDeque;

use super::found::Found;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};
use cantap_trace::{TraceEvent, TraceRecord};

const DETAILS_LEFT_OUT: &str =
    "error frames say more than their kind, the state and the counters, which is left out";

/// What is still to be said of what was read.
#[derive(Default)]
pub(super) struct ErrorFrames {
    records: VecDeque<TraceRecord>,
    /// Frames whose details are left out, to be reported.
    untold: u64,
}

impl ErrorFrames {
    /// What an error frame says: one event, or two of the same time.
    pub(super) fn read(&mut self, id: u32, data: [u8; 8]) -> (TraceEvent, Option<TraceEvent>) {
        let frame = ErrorFrame { classes: id & (ERROR_FLAG - 1), data };
        self.untold += u64::from(!frame.is_told_whole());
        frame.events()
    }

    /// Keeps records that follow the one that is returned now.
    pub(super) fn keep(&mut self, records: impl IntoIterator<Item = TraceRecord>) {
        self.records.extend(records);
    }

    /// Whether no record is kept.
    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// What comes before anything else is read.
    pub(super) fn next(&mut self) -> Option<Found> {
        if let Some(record) = self.records.pop_front() {
            return Some(Found::Record(record));
        }
        self.note().map(Found::Note)
    }

    /// What is to be reported of the frames that were read.
    pub(super) fn note(&mut self) -> Option<&'static str> {
        self.untold = self.untold.checked_sub(1)?;
        Some(DETAILS_LEFT_OUT)
    }
}
