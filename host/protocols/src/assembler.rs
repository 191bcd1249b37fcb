//! What every protocol is made of.

use cantap_trace::TraceEvent;
use cantap_trace::TraceRecord;
use cantap_wire::record::ErrorState;

use crate::{Event, Party, Protocol};

/// Makes events of one protocol from the records of a trace.
///
/// Its memory is bounded, whatever the records are; what is given up for that becomes an event as well.
pub trait Assembler {
    /// Takes the next record and appends what it completes. Losses and states are to be handed in as frames are: they say where
    /// frames may be missing.
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>);

    /// The trace has ended: appends what was under way, as unfinished.
    fn finish(&mut self, events: &mut Vec<Event>);

    /// Appends the transfers that have begun and have not ended so far.
    fn under_way(&self, _: &mut Vec<UnderWay>) {}
}

/// A transfer of several frames that has not ended so far.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UnderWay {
    /// The channel, from 1.
    pub channel: u8,
    /// The protocol that carries it.
    pub protocol: Protocol,
    /// Who sends it.
    pub from: Party,
    /// To whom.
    pub to: Party,
    /// The stamp of its first frame, in nanoseconds.
    pub start_ns: i64,
    /// Bytes that have arrived.
    pub received: u32,
    /// Bytes of the whole, where that was said.
    pub length: Option<u32>,
}

/// Whether frames of the record's channel may be missing here: lost, or not heard by a controller that was off the bus.
pub fn is_gap(event: &TraceEvent) -> bool {
    matches!(event, TraceEvent::Lost { .. } | TraceEvent::State { state: ErrorState::BusOff, .. })
}
