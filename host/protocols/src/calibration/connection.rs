//! What is common to the connections of XCP and CCP: the identifiers of a master and its slave, commands that wait for their answers.

use std::fmt;
use std::str::FromStr;

use cantap_can::Id;
use cantap_trace::{TraceEvent, TraceRecord};

use crate::iso_tp::Pair;
use crate::{Bytes, Event, EventKind, Field, Party, Protocol, Trouble, is_gap};

/// The identifiers of a master and its slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MasterSlave {
    /// Of what the master sends: commands, stimulation.
    pub master: Id,
    /// Of what the slave sends: responses, measured data.
    pub slave: Id,
}

/// A text that does not name a master and its slave.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is not a master and its slave; write the identifiers of what each sends, as 7F0:7F1")]
pub struct BadMasterSlave(String);

impl FromStr for MasterSlave {
    type Err = BadMasterSlave;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.parse() {
            Ok(Pair { a, b }) if a.address.is_none() && b.address.is_none() => {
                Ok(Self { master: a.id, slave: b.id })
            }
            _ => Err(BadMasterSlave(text.to_owned())),
        }
    }
}

impl fmt::Display for MasterSlave {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", Party::Id(self.master), Party::Id(self.slave))
    }
}

/// A command that waits for its answer.
#[derive(Clone, Debug)]
pub struct Waiting {
    /// The stamp of its first frame.
    pub start_ns: i64,
    /// The stamp of the last frame that belongs to it.
    pub time_ns: i64,
    /// Of the last frame of the request.
    pub asked_ns: i64,
    /// Of the first frame of the answer.
    pub answered_ns: Option<i64>,
    /// The command's bytes.
    pub command: Bytes,
    /// Data in several frames, as far as they came: of the request or of the answer.
    pub gathered: Bytes,
    /// Frames so far.
    pub frames: u32,
    /// Frames were lost meanwhile.
    pub frames_lost: bool,
}

impl Waiting {
    /// For a command that is complete, or begins, with this record.
    pub fn new(record: &TraceRecord, command: &[u8]) -> Self {
        let time_ns = record.time_ns;
        Self {
            start_ns: time_ns,
            time_ns,
            asked_ns: time_ns,
            answered_ns: None,
            command: Bytes::from_slice(command),
            gathered: Bytes::new(),
            frames: 1,
            frames_lost: false,
        }
    }

    /// An event about it, without fields.
    pub fn event(
        &self,
        protocol: Protocol,
        channel: u8,
        parties: MasterSlave,
        kind: EventKind,
        title: impl Into<std::borrow::Cow<'static, str>>,
    ) -> Event {
        Event {
            time_ns: self.time_ns,
            start_ns: self.start_ns,
            channel,
            protocol,
            from: parties.master.into(),
            to: parties.slave.into(),
            kind,
            title: title.into(),
            fields: Vec::new(),
            data: self.command.clone(),
            response_ns: self.answered_ns.map(|at_ns| at_ns.saturating_sub(self.asked_ns)),
            frames: self.frames,
            trouble: None,
            frames_lost: self.frames_lost,
        }
    }
}

/// Of a loss: whether fewer frames were lost than setting up a list anew takes; `None` if the record is no loss. Stopping, pointing, writing
/// and starting are four commands, each with its response.
pub fn is_short_gap(record: &TraceRecord) -> Option<bool> {
    is_gap(&record.event)
        .then_some(matches!(record.event, TraceEvent::Lost { count: 0..8, at_least: false, .. }))
}

/// An event about a frame of a slave.
pub fn slave_event(
    protocol: Protocol,
    record: &TraceRecord,
    parties: MasterSlave,
    kind: EventKind,
    title: &'static str,
) -> Event {
    let mut event = Event::new(protocol, record, kind, title);
    (event.from, event.to) = (parties.slave.into(), parties.master.into());
    event
}

/// A positive or negative answer without its command.
pub fn unasked(mut event: Event, data: &[u8]) -> Event {
    if !data.is_empty() {
        event.fields.push(Field::bytes("value", data));
    }
    event.fields.push(Field::text("request", "not heard"));
    event
}

/// The words for a command that was not answered.
pub fn no_response(mut event: Event, trouble: Trouble) -> Event {
    event.kind = EventKind::NoResponse;
    event.trouble = Some(trouble);
    event
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_master_and_its_slave_are_written_as_two_identifiers() {
        let pair: MasterSlave = "18FF0001:18FF0002".parse().unwrap();
        assert_eq!(pair.to_string(), "18FF0001:18FF0002");
        assert!(pair.master.is_extended());
        assert!("6F1/12:612".parse::<MasterSlave>().is_err());
    }
}
