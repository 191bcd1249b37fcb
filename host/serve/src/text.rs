//! Records as text, and what else the foreign protocols have in common.

use std::fmt::{self, Write};

use cantap::{TraceEvent, TraceRecord};
use cantap_trace::Interface;
use cantap_trace::socketcan::{ERROR_FLAG, ErrorFrame};

/// A time as can-utils writes it: seconds and microseconds.
pub struct Seconds(pub i64);

impl fmt::Display for Seconds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let us = self.0.div_euclid(1000);
        write!(f, "{}.{:06}", us.div_euclid(1_000_000), us.rem_euclid(1_000_000))
    }
}

/// The computer's time, in UTC nanoseconds since the Unix epoch.
pub fn now_ns() -> i64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |since| since.as_nanos() as i64)
}

/// The identifier of an error frame, including its flag, and its data.
pub fn error_frame(event: &TraceEvent) -> Option<(u32, [u8; 8])> {
    ErrorFrame::of(event).map(|frame| (ERROR_FLAG | frame.classes, frame.data))
}

/// Adds a line as `candump -L` writes it; errors and losses as SocketCAN error frames. `number` is the channel's, from 1.
pub fn put_line(out: &mut String, number: u8, record: &TraceRecord) {
    let (time, interface) = (Seconds(record.time_ns), Interface(number));
    // Writing to memory cannot fail.
    let _ = match &record.event {
        TraceEvent::Frame { frame, .. } => writeln!(out, "({time}) {interface} {frame}"),
        event => match error_frame(event) {
            Some((id, data)) => {
                let _ = write!(out, "({time}) {interface} {id:08X}#");
                put_bytes(out, &data, "");
                writeln!(out)
            }
            None => Ok(()),
        },
    };
}

/// Adds bytes in hexadecimal, each followed by `behind`.
pub fn put_bytes(out: &mut String, bytes: &[u8], behind: &str) {
    for byte in bytes {
        let _ = write!(out, "{byte:02X}{behind}");
    }
}
