//! The output of an assembler.

use std::borrow::Cow;

use cantap_trace::{Id, TraceRecord};
use smallvec::SmallVec;

use crate::{EventKind, Protocol};

/// Bytes of a message; those of one frame, which most are, without an allocation of their own.
pub type Bytes = SmallVec<[u8; 16]>;

/// Something said on a bus: a message, an exchange, or a failed one.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// When it was complete: the stamp of its last frame, or when it was abandoned. Nanoseconds, as in
    /// records.
    pub time_ns: i64,
    /// The stamp of its first frame.
    pub start_ns: i64,
    /// The channel, from 1.
    pub channel: u8,
    /// The protocol.
    pub protocol: Protocol,
    /// The sender.
    pub from: Party,
    /// The receiver.
    pub to: Party,
    /// What kind of event it is within its protocol.
    pub kind: EventKind,
    /// The service, message or parameter group.
    pub title: Cow<'static, str>,
    /// The content, in order.
    pub fields: Vec<Field>,
    /// The underlying bytes, as far as they are known.
    pub data: Bytes,
    /// From the end of a request to the first frame of its response, in nanoseconds.
    pub response_ns: Option<i64>,
    /// Number of frames.
    pub frames: u32,
    /// What went wrong.
    pub trouble: Option<Trouble>,
    /// Frames of this channel were lost while it was in progress, so it may differ from what was sent.
    pub frames_lost: bool,
}

/// A sender or receiver.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Party {
    /// Unknown, or nobody in particular.
    Unknown,
    /// All listeners.
    Everyone,
    /// The user of this identifier.
    Id(Id),
    /// The user of this identifier with this address in the first data byte.
    Addressed(Id, u8),
    /// A node by its number or address.
    Node(u8),
}

/// One named value of an event.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Its name.
    pub name: Cow<'static, str>,
    /// Its value.
    pub value: Value,
    /// The value's unit; empty without one.
    pub unit: Cow<'static, str>,
    /// The meaning of the value.
    pub text: Option<Cow<'static, str>>,
}

/// A field's value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// An integer usually written in decimal.
    Number(i64),
    /// A number usually written in hexadecimal, with at least this many digits.
    Hex(u64, u8),
    /// A physical value.
    Real(f64),
    /// A text.
    Text(Cow<'static, str>),
    /// Bytes whose meaning is unknown.
    Bytes(Bytes),
    /// There is no value: not available, or unreadable.
    Missing,
}

/// What is wrong with an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Trouble {
    /// Frames are missing or out of order.
    #[error("frame {got} came instead of {expected}")]
    Sequence {
        /// The expected sequence number.
        expected: u32,
        /// The one received.
        got: u32,
    },
    /// The other side, or the next frame, did not come in time.
    #[error("nothing came for {after_ms} ms")]
    Timeout {
        /// How long we waited, in milliseconds.
        after_ms: u32,
    },
    /// Before it was complete, the same sender began a new one.
    #[error("the next one began before it was complete")]
    Overlapped,
    /// The receiver has no room for it.
    #[error("refused by the receiver: too long for it")]
    Overflow,
    /// One side aborted it.
    #[error("aborted: {0}")]
    Aborted(&'static str),
    /// The trace ended.
    #[error("the trace ends here")]
    Unfinished,
    /// More transfers were in progress than are kept in memory.
    #[error("given up: too many were under way")]
    GivenUp,
    /// It is longer than the limit kept in memory.
    #[error("too long to be kept: the first bytes only")]
    Cut,
    /// It violates the protocol.
    #[error("malformed: {0}")]
    Malformed(&'static str),
    /// Its beginning was not observed.
    #[error("its beginning is missing")]
    Headless,
}

impl Trouble {
    /// A word for programs.
    pub const fn code(&self) -> &'static str {
        match self {
            Self::Sequence { .. } => "sequence",
            Self::Timeout { .. } => "timeout",
            Self::Overlapped => "overlapped",
            Self::Overflow => "overflow",
            Self::Aborted(_) => "aborted",
            Self::Unfinished => "unfinished",
            Self::GivenUp => "given_up",
            Self::Cut => "cut",
            Self::Malformed(_) => "malformed",
            Self::Headless => "headless",
        }
    }
}

impl Field {
    fn new(name: impl Into<Cow<'static, str>>, value: Value) -> Self {
        Self { name: name.into(), value, unit: Cow::Borrowed(""), text: None }
    }

    /// An integer usually written in decimal.
    pub fn number(name: impl Into<Cow<'static, str>>, value: impl Into<i64>) -> Self {
        Self::new(name, Value::Number(value.into()))
    }

    /// A number usually written in hexadecimal.
    pub fn hex(name: impl Into<Cow<'static, str>>, value: impl Into<u64>, digits: u8) -> Self {
        Self::new(name, Value::Hex(value.into(), digits))
    }

    /// A physical value.
    pub fn real(name: impl Into<Cow<'static, str>>, value: f64, unit: impl Into<Cow<'static, str>>) -> Self {
        Self { unit: unit.into(), ..Self::new(name, Value::Real(value)) }
    }

    /// A text.
    pub fn text(name: impl Into<Cow<'static, str>>, value: impl Into<Cow<'static, str>>) -> Self {
        Self::new(name, Value::Text(value.into()))
    }

    /// Bytes whose meaning is unknown.
    pub fn bytes(name: impl Into<Cow<'static, str>>, value: &[u8]) -> Self {
        Self::new(name, Value::Bytes(Bytes::from_slice(value)))
    }

    /// Without a value.
    pub fn missing(name: impl Into<Cow<'static, str>>) -> Self {
        Self::new(name, Value::Missing)
    }

    /// Adds the meaning of the value.
    #[must_use]
    pub fn meaning(mut self, text: Option<impl Into<Cow<'static, str>>>) -> Self {
        self.text = text.map(Into::into);
        self
    }

    /// Adds a unit.
    #[must_use]
    pub fn unit(mut self, unit: impl Into<Cow<'static, str>>) -> Self {
        self.unit = unit.into();
        self
    }
}

impl Value {
    /// As a number, if it is one.
    pub fn as_number(&self) -> Option<f64> {
        match self {
            Self::Number(value) => Some(*value as f64),
            Self::Hex(value, _) => Some(*value as f64),
            Self::Real(value) => Some(*value),
            _ => None,
        }
    }
}

impl Event {
    /// An event without fields, for one frame.
    pub fn new(
        protocol: Protocol,
        record: &TraceRecord,
        kind: EventKind,
        title: impl Into<Cow<'static, str>>,
    ) -> Self {
        Self {
            time_ns: record.time_ns,
            start_ns: record.time_ns,
            channel: record.channel,
            protocol,
            from: Party::Unknown,
            to: Party::Unknown,
            kind,
            title: title.into(),
            fields: Vec::new(),
            data: record.frame().map_or_else(Bytes::new, |frame| Bytes::from_slice(frame.data())),
            response_ns: None,
            frames: 1,
            trouble: None,
            frames_lost: false,
        }
    }

    /// The field with this name.
    pub fn field(&self, name: &str) -> Option<&Field> {
        self.fields.iter().find(|field| field.name == name)
    }
}

impl From<Id> for Party {
    fn from(id: Id) -> Self {
        Self::Id(id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A table has one column for both: neither hides the other.
    #[test]
    fn a_text_that_stands_for_something_stays_beside_it() {
        let text = |field: Field| field.text_for_tables().map(Cow::into_owned);
        let code = Field::text("dtc", "P0133");
        assert_eq!(text(code.clone()).as_deref(), Some("P0133"));
        assert_eq!(text(code.meaning(Some("slow sensor"))).as_deref(), Some("P0133 (slow sensor)"));
        assert_eq!(text(Field::number("nrc", 0x33)), None);
        let refused = Field::number("nrc", 0x33).meaning(Some("securityAccessDenied"));
        assert_eq!(text(refused).as_deref(), Some("securityAccessDenied"));
        assert_eq!(text(Field::bytes("data", &[0x0A, 0xF1])).as_deref(), Some("0A F1"));
        assert_eq!(text(Field::missing("level")).as_deref(), Some("not available"));
    }
}
