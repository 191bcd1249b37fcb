//! Records as text, and bytes as text.

use std::fmt::Write as _;

use cantap::{TraceEvent, TraceRecord};
use cantap_trace::{BusErrorKind, LossStage};

use super::times::seconds;

use cantap_work::terms::failure_text;

/// The text for a record that is not a frame.
pub fn event_text(event: &TraceEvent) -> String {
    let counters = |counters: Option<(u8, u8)>| {
        counters.map_or(String::new(), |(tec, rec)| format!(", counters {tec} / {rec}"))
    };
    match *event {
        TraceEvent::Frame { .. } => String::new(),
        TraceEvent::BusError { kind, counters: at } => {
            format!("E bus error: {}{}", kind.map_or("unknown", BusErrorKind::name), counters(at))
        }
        TraceEvent::ErrorsSuppressed { count } => format!("E {count} more bus errors"),
        TraceEvent::State { state, counters: at } => format!("S controller {}{}", state.name(), counters(at)),
        TraceEvent::Lost { stage, count, at_least } => {
            let stage = stage.map_or("unknown", LossStage::name);
            format!("L {} frames lost ({stage})", lost(count, at_least))
        }
        TraceEvent::TransmitFailed { tag, reason } => {
            format!("F frame {tag} not sent: {}", failure_text(reason))
        }
    }
}

/// The number of missing frames.
pub fn lost(count: u32, at_least: bool) -> String {
    match (count, at_least) {
        // For example while a device was gone.
        (0, true) => "an unknown number of".to_owned(),
        (count, true) => format!("at least {count}"),
        (count, false) => count.to_string(),
    }
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
