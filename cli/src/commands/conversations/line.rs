//! An event as a line of text or of JSON.

use std::fmt::Write as _;
use std::io::Write;

use cantap_protocols::Event;
use cantap_trace::{Interface, Seconds};

/// Writes an event as a line.
pub fn write(out: &mut impl Write, event: &Event, json: bool) -> std::io::Result<()> {
    let mut line = String::new();
    push(&mut line, event, json);
    out.write_all(line.as_bytes())
}

/// Appends an event as a line, of text or of JSON.
pub(super) fn push(out: &mut String, event: &Event, json: bool) {
    if json {
        event.push_json(out);
        out.push('\n');
        return;
    }
    // Writing to a String cannot fail.
    let _ = write!(out, "({}) {} ", Seconds(event.time_ns), Interface(event.channel));
    event.push_to(out);
    out.push('\n');
}
