//! An event as a line of text or of JSON.

use std::fmt;
use std::io::Write;

use cantap_protocols::Event;
use cantap_trace::Interface;

use super::super::decode::Seconds;
use super::json;

/// Writes an event as a line.
pub fn write(out: &mut impl Write, event: &Event, json: bool) -> std::io::Result<()> {
    if json { json::write(out, event) } else { writeln!(out, "{}", Line(event)) }
}

/// An event as a line of text, without its end.
pub(super) struct Line<'a>(pub(super) &'a Event);

impl fmt::Display for Line<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(event) = self;
        write!(f, "({}) {} {event}", Seconds(event.time_ns), Interface(event.channel))
    }
}
