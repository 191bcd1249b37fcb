//! The interface of every protocol.

use cantap_can::ErrorState;
use cantap_trace::TraceEvent;
use cantap_trace::TraceRecord;

use crate::{Event, Party, Protocol};

/// Turns the records of a trace into events of one protocol.
///
/// Its memory is bounded, whatever the records; anything abandoned because of that also becomes an event.
pub trait Assembler {
    /// Takes the next record and appends what it completes. Pass losses and states as well as frames: they say where frames may
    /// be missing.
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>);

    /// The trace has ended: appends whatever was in progress, as unfinished.
    fn finish(&mut self, events: &mut Vec<Event>);

    /// Appends the transfers in progress.
    fn under_way(&self, _: &mut Vec<UnderWay>) {}
}

/// A transfer of several frames that is in progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UnderWay {
    /// The channel, from 1.
    pub channel: u8,
    /// The protocol.
    pub protocol: Protocol,
    /// The sender.
    pub from: Party,
    /// The receiver.
    pub to: Party,
    /// The stamp of its first frame, in nanoseconds.
    pub start_ns: i64,
    /// Bytes received so far.
    pub received: u32,
    /// Total number of bytes, if known.
    pub length: Option<u32>,
}

/// Whether frames of the record's channel may be missing here: lost, or not received by a controller that was bus-off.
pub fn is_gap(event: &TraceEvent) -> bool {
    matches!(event, TraceEvent::Lost { .. } | TraceEvent::State { state: ErrorState::BusOff, .. })
}
