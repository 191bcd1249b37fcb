//! A row of the trace for the page.

use std::fmt::Write as _;

use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};
use serde::Serialize;

use crate::databases::Databases;
use crate::index::Place;
use crate::interval::IntervalAnswer;
use crate::trace::Content;

/// `Row` in `api.ts`.
#[derive(Serialize)]
pub struct Row {
    index: usize,
    time: f64,
    /// Since the row above.
    above: Option<IntervalAnswer>,
    late: bool,
    channel: Option<u8>,
    kind: &'static str,
    id: Option<u32>,
    extended: bool,
    dlc: Option<u8>,
    data: String,
    sent: bool,
    text: String,
    message: Option<String>,
}

impl Row {
    /// The row of a record, below that of the record `above`.
    pub fn of(
        index: usize,
        above: Option<usize>,
        record: &TraceRecord,
        content: &Content,
        databases: &Databases,
    ) -> Self {
        let mut row = Self {
            index: content.forgotten() + index,
            time: content.seconds(record.time_ns),
            above: above.map(|above| content.store.interval(above, index).into()),
            late: false,
            channel: Some(record.channel),
            kind: kind(&record.event),
            id: None,
            extended: false,
            dlc: None,
            data: String::new(),
            sent: false,
            text: String::new(),
            message: None,
        };
        if let TraceEvent::Frame { frame, direction, late } = &record.event {
            let id = frame.id();
            row.late = *late;
            row.id = Some(id.raw());
            row.extended = id.is_extended();
            row.dlc = Some(frame.dlc());
            row.data = hex(frame.data());
            row.sent = *direction == Direction::Tx;
            let message = databases.message(Place { channel: record.channel, id });
            row.message = message.map(|message| message.name.clone());
        } else {
            row.text = record.event.to_string();
        }
        row
    }
}

fn kind(event: &TraceEvent) -> &'static str {
    match event {
        TraceEvent::Frame { frame: TraceFrame::Fd(_), .. } => "fd",
        TraceEvent::Frame { frame, .. } if frame.is_remote() => "remote",
        TraceEvent::Frame { .. } => "data",
        TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. } => "error",
        TraceEvent::State { .. } => "state",
        TraceEvent::Lost { .. } => "lost",
        TraceEvent::TransmitFailed { .. } | TraceEvent::Disturbed { .. } | TraceEvent::Lin { .. } => "other",
    }
}

/// Bytes as upper-case hexadecimal digits without spaces.
pub fn hex(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(2 * bytes.len());
    for byte in bytes {
        // Writing to a String cannot fail.
        let _ = write!(text, "{byte:02X}");
    }
    text
}
