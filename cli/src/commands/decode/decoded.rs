//! A decoded frame, and the form of its time and values.

use std::borrow::Cow;

use cantap::{TraceFrame, TraceRecord};
use cantap_signals::{Message, MessageRef, Number, Signal, SignalValue};

/// A decoded frame, for the outputs.
pub struct Decoded<'a> {
    pub record: &'a TraceRecord,
    pub frame: &'a TraceFrame,
    pub reference: MessageRef,
    pub message: &'a Message,
    pub values: &'a [SignalValue],
}

/// One signal of a frame.
pub struct Reading<'a> {
    pub signal: &'a Signal,
    /// Its name in this message.
    pub label: Cow<'a, str>,
    /// Its value; `None` if the bits mean that there is none.
    pub number: Option<Number>,
    /// What J1939 says instead of a value.
    pub indicator: Option<&'static str>,
    /// The value table's text.
    pub text: Option<&'a str>,
}

impl<'a> Reading<'a> {
    pub fn of(message: &'a Message, value: &SignalValue) -> Self {
        let signal = &message.signals[value.signal as usize];
        let indicator = message.indicator(signal, value.raw).map(cantap_signals::Indicator::name);
        let number = signal.number(value.raw);
        Self {
            signal,
            label: signal.label(),
            number: indicator.is_none().then_some(number),
            indicator,
            text: signal.text(value.raw),
        }
    }

    /// The value table's text, or what replaces a value.
    pub fn text(&self) -> Option<&'a str> {
        self.text.or(self.indicator)
    }
}

/// Seconds with six decimals, or nine if the trace has them.
pub struct Seconds(pub i64);

impl std::fmt::Display for Seconds {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let (seconds, ns) = (self.0.unsigned_abs() / 1_000_000_000, self.0.unsigned_abs() % 1_000_000_000);
        if ns % 1000 == 0 {
            write!(f, "{sign}{seconds}.{:06}", ns / 1000)
        } else {
            write!(f, "{sign}{seconds}.{ns:09}")
        }
    }
}
