//! Records as text, and bytes as text.

use std::fmt::Write as _;

use cantap::{TraceEvent, TraceRecord};
pub use cantap_trace::event_text::lost;

use super::times::seconds;

/// The text for a record that is not a frame.
pub fn event_text(event: &TraceEvent) -> String {
    let letter = match event {
        TraceEvent::Frame { .. } => return String::new(),
        TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. } => 'E',
        TraceEvent::State { .. } => 'S',
        TraceEvent::Lost { .. } => 'L',
        TraceEvent::TransmitFailed { .. } => 'F',
        TraceEvent::Disturbed { .. } => 'D',
        // It says so itself.
        TraceEvent::Lin { .. } => return event.to_string(),
    };
    format!("{letter} {event}")
}

/// A frame as candump writes it.
pub fn candump_line(record: &TraceRecord) -> Option<String> {
    let frame = record.frame()?;
    Some(format!("({}) {} {frame}", seconds(record.time_ns), cantap_trace::Interface(record.channel)))
}

/// Bytes as pairs of digits.
pub fn hex(data: &[u8]) -> String {
    let mut text = String::with_capacity(24);
    for (index, byte) in data.iter().enumerate() {
        // Writing to a String cannot fail.
        let _ = write!(text, "{}{byte:02X}", if index == 0 { "" } else { " " });
    }
    text
}

/// Bytes as characters, with dots for unprintable ones.
pub fn printable(data: &[u8]) -> String {
    data.iter().map(|byte| if (0x20..0x7F).contains(byte) { *byte as char } else { '.' }).collect()
}
