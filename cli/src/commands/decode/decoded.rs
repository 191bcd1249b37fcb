//! A decoded frame, and the form of its time and values.

use cantap::{TraceFrame, TraceRecord};
use cantap_signals::{Message, MessageRef, SignalValue};

/// A decoded frame, for the outputs.
pub struct Decoded<'a> {
    pub record: &'a TraceRecord,
    pub frame: &'a TraceFrame,
    pub reference: MessageRef,
    pub message: &'a Message,
    pub values: &'a [SignalValue],
}
