//! The output of an assembler.

use std::borrow::Cow;
use std::fmt;

use cantap_trace::{Id, TraceRecord};

use crate::Protocol;

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
    /// The kind of event within its protocol, such as `exchange`.
    pub kind: &'static str,
    /// The service, message or parameter group.
    pub title: Cow<'static, str>,
    /// The content, in order.
    pub fields: Vec<Field>,
    /// The underlying bytes, as far as they are known.
    pub data: Vec<u8>,
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
    Bytes(Vec<u8>),
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
        Self::new(name, Value::Bytes(value.to_vec()))
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
        kind: &'static str,
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
            data: record.frame().map_or_else(Vec::new, |frame| frame.data().to_vec()),
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

impl fmt::Display for Party {
    /// `7E0`, `6F1/12`, `5`, `all`; `?` if unknown.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unknown => f.write_str("?"),
            Self::Everyone => f.write_str("all"),
            Self::Id(id) => write!(f, "{id}"),
            Self::Addressed(id, address) => write!(f, "{id}/{address:02X}"),
            Self::Node(node) => write!(f, "{node}"),
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(value) => write!(f, "{value}"),
            Self::Hex(value, digits) => write!(f, "0x{value:0width$X}", width = usize::from(*digits)),
            Self::Real(value) => write_real(f, *value),
            Self::Text(text) => write!(f, "\"{}\"", text.escape_debug()),
            Self::Bytes(bytes) if bytes.is_empty() => f.write_str("nothing"),
            Self::Bytes(bytes) => f.write_str(&hex(bytes)),
            Self::Missing => f.write_str("not available"),
        }
    }
}

/// `62 F1 90`.
pub(crate) fn hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789ABCDEF";
    let mut text = String::with_capacity(bytes.len() * 3);
    for (at, byte) in bytes.iter().enumerate() {
        if at > 0 {
            text.push(' ');
        }
        text.push(char::from(DIGITS[usize::from(byte >> 4)]));
        text.push(char::from(DIGITS[usize::from(byte & 15)]));
    }
    text
}

/// At most seven decimals, as positions have, without trailing zeros.
fn write_real(f: &mut fmt::Formatter<'_>, value: f64) -> fmt::Result {
    if value.abs() >= 1e15 {
        return write!(f, "{value:e}");
    }
    let text = format!("{value:.7}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text.trim_start_matches('-') == "0" && value != 0.0 {
        return write!(f, "{value:e}");
    }
    f.write_str(if text == "-0" { "0" } else { text })
}

impl fmt::Display for Field {
    /// `did 0xF190 (VIN)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.name, self.value)?;
        if !self.unit.is_empty() && self.value != Value::Missing {
            write!(f, " {}", self.unit)?;
        }
        self.text.as_ref().map_or(Ok(()), |text| write!(f, " ({text})"))
    }
}

impl fmt::Display for Event {
    /// Without time and channel: `uds 7E0 > 7E8 ReadDataByIdentifier: did 0xF190 (VIN), value "…"`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.protocol, self.from)?;
        if self.to != Party::Unknown {
            write!(f, " > {}", self.to)?;
        }
        write!(f, " {}", self.title)?;
        for (at, field) in self.fields.iter().enumerate() {
            write!(f, "{} {field}", if at == 0 { ":" } else { "," })?;
        }
        if let Some(response_ns) = self.response_ns {
            f.write_str(if self.fields.is_empty() { ": after " } else { ", after " })?;
            write_real(f, response_ns as f64 / 1e6)?;
            f.write_str(" ms")?;
        }
        if let Some(trouble) = &self.trouble {
            write!(f, "; {trouble}")?;
        }
        if self.frames_lost { f.write_str("; frames were lost meanwhile") } else { Ok(()) }
    }
}
