//! How events of this protocol begin.

use std::borrow::Cow;

use cantap_trace::{TraceEvent, TraceRecord};

use crate::{Event, EventKind, Field, Protocol, Trouble};

/// A record without a frame, for events that no frame causes.
pub const fn nothing(channel: u8) -> TraceRecord {
    TraceRecord { time_ns: 0, device_ns: None, channel, event: TraceEvent::GAP }
}

pub fn event(record: &TraceRecord, kind: EventKind, title: impl Into<Cow<'static, str>>) -> Event {
    Event::new(Protocol::CanOpen, record, kind, title)
}

/// An event for something that violates the protocol.
pub fn malformed(record: &TraceRecord, kind: EventKind, title: &'static str, fault: &'static str) -> Event {
    let mut event = event(record, kind, title);
    event.fields.push(Field::bytes("data", &event.data));
    event.trouble = Some(Trouble::Malformed(fault));
    event
}
