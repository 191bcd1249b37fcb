//! A connection of a master with its slave, from commands and responses to events.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use cantap_trace::{Id, TraceRecord};

use super::codec::{self, EV_CMD_PENDING, EV_SESSION_TERMINATED, LEAST_COMMAND, command};
use super::signs::ConnectFinder;
use super::state::State;
use crate::a2l::Description;
use crate::calibration::Connection;
use crate::calibration::connection::{MasterSlave, Waiting, no_response, slave_event, unasked};
use crate::calibration::known::Known;
use crate::calibration::parts::{ByteOrder, CommandDefinition, push_parts};
use crate::{Event, EventKind, Field, Protocol, Trouble};

/// How long an answer may take: the time-outs are the slave's own, and rarely more than this.
const RESPONSE_NS: i64 = 2_000_000_000;
/// For commands that erase, program, or read all of the memory.
const LONG_RESPONSE_NS: i64 = 30_000_000_000;
/// How many commands may wait for their answers (interleaved mode).
const MOST_WAITING: usize = 16;

/// A slave, as far as its connection was heard.
#[derive(Clone, Debug)]
pub struct XcpConnection {
    parties: MasterSlave,
    description: Option<Arc<Description>>,
    state: State,
    waiting: VecDeque<Waiting>,
}

/// How many bytes a command's elements have in the response, if it returns memory.
const fn returns_memory(code: u8) -> bool {
    matches!(code, command::UPLOAD | command::SHORT_UPLOAD)
}

/// Whether a command may be the first of several frames with data.
const fn continues(code: u8) -> Option<u8> {
    match code {
        command::DOWNLOAD => Some(command::DOWNLOAD_NEXT),
        command::PROGRAM => Some(command::PROGRAM_NEXT),
        _ => None,
    }
}

impl Connection for XcpConnection {
    type Finder = ConnectFinder;

    fn new(parties: MasterSlave, description: Option<Arc<Description>>) -> Self {
        Self { parties, description, state: State::default(), waiting: VecDeque::new() }
    }

    fn known(known: &Known) -> Vec<MasterSlave> {
        let described = known.descriptions.iter().flat_map(|all| all.xcp_parties());
        known.xcp.iter().copied().chain(described).collect()
    }

    fn hear_master(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
        let Some(&code) = data.first() else { return };
        if code < LEAST_COMMAND {
            let mut event = Event::new(Protocol::Xcp, record, EventKind::Request, "STIM");
            (event.from, event.to) = (self.parties.master.into(), self.parties.slave.into());
            event.fields.push(Field::hex("pid", code, 2));
            event.fields.push(Field::bytes("data", &data[1..]));
            events.push(event);
            return;
        }
        if let Some(waiting) = self.waiting.back_mut()
            && continues(waiting.command[0]) == Some(code)
            && waiting.gathered.len() < self.state.granularity * usize::from(waiting.command[1])
        {
            let at = self.state.granularity.max(2);
            waiting.gathered.extend_from_slice(data.get(at..).unwrap_or_default());
            waiting.frames += 1;
            (waiting.asked_ns, waiting.time_ns) = (record.time_ns, record.time_ns);
            return;
        }
        if !self.state.is_interleaved || self.waiting.len() >= MOST_WAITING {
            while let Some(before) = self.waiting.pop_front() {
                events.push(self.unanswered(&before, record.channel, Trouble::Overlapped));
            }
        }
        let mut waiting = Waiting::new(record, data);
        if continues(code).is_some() {
            if data.len() < 2 {
                waiting.command.resize(2, 0);
            }
            waiting.gathered.extend_from_slice(data.get(self.state.granularity.max(2)..).unwrap_or_default());
        }
        self.waiting.push_back(waiting);
    }

    fn hear_slave(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
        match data {
            [] => {}
            [codec::RES, ..] => self.response(record, data, events),
            [codec::ERR, rest @ ..] => {
                let code = rest.first().copied().unwrap_or_default();
                let error = Field::hex("error", code, 2).meaning(codec::error_name(code));
                let Some(waiting) = self.answered(record) else {
                    let mut event =
                        slave_event(Protocol::Xcp, record, self.parties, EventKind::Response, "ERR");
                    event.fields.push(error);
                    events.push(unasked(event, rest.get(1..).unwrap_or_default()));
                    return;
                };
                // This is how SYNCH is answered.
                let is_synch = waiting.command[0] == command::SYNCH && code == codec::error::CMD_SYNCH;
                let kind = if is_synch { EventKind::Exchange } else { EventKind::Refusal };
                let mut event = self.event(&waiting, record.channel, kind);
                event.fields.push(error);
                if rest.len() > 1 && rest[1..].iter().any(|byte| *byte != 0) {
                    event.fields.push(Field::bytes("error_details", &rest[1..]));
                }
                events.push(event);
            }
            [codec::EV, rest @ ..] => self.slave_event(record, rest, events),
            [codec::SERV, rest @ ..] => {
                let code = rest.first().copied().unwrap_or_default();
                let title = codec::service_name(code).unwrap_or("SERV");
                let mut event =
                    slave_event(Protocol::Xcp, record, self.parties, EventKind::Notification, title);
                event.fields.push(Field::hex("service", code, 2));
                match (code, rest.get(1..)) {
                    (1, Some(text)) => {
                        let text = String::from_utf8_lossy(text);
                        event.fields.push(Field::text("text", text.trim_end_matches('\0').to_owned()));
                    }
                    (_, Some(data @ [_, ..])) => event.fields.push(Field::bytes("data", data)),
                    _ => {}
                }
                events.push(event);
            }
            _ => events.push(self.packet(record, data)),
        }
    }

    fn take_daq_id(&mut self) -> Option<Id> {
        self.state.daq_id.take()
    }

    fn sweep(&mut self, now_ns: i64, channel: u8, events: &mut Vec<Event>) {
        while let Some(waiting) = self.waiting.front() {
            let limit_ns = match waiting.command[0] {
                command::BUILD_CHECKSUM | 0xC8..=0xD2 => LONG_RESPONSE_NS,
                _ => RESPONSE_NS,
            };
            if now_ns.saturating_sub(waiting.time_ns) <= limit_ns {
                return;
            }
            let Some(mut waiting) = self.waiting.pop_front() else { return };
            waiting.time_ns += limit_ns;
            let after_ms = (limit_ns / 1_000_000) as u32;
            events.push(self.unanswered(&waiting, channel, Trouble::Timeout { after_ms }));
        }
    }

    fn gap(&mut self, is_short: bool, channel: u8, events: &mut Vec<Event>) {
        self.state.lists.gap(is_short);
        self.state.mta = None;
        // What is gathered from several frames may lack one in the middle.
        for mut waiting in std::mem::take(&mut self.waiting) {
            waiting.frames_lost = true;
            if waiting.gathered.is_empty() {
                self.waiting.push_back(waiting);
                continue;
            }
            let mut event = self.event(&waiting, channel, EventKind::Broken);
            event.fields.push(Field::bytes("received", &waiting.gathered));
            events.push(event);
        }
    }

    fn finish(&mut self, channel: u8, events: &mut Vec<Event>) {
        while let Some(waiting) = self.waiting.pop_front() {
            events.push(self.unanswered(&waiting, channel, Trouble::Unfinished));
        }
    }
}

impl XcpConnection {
    fn slave_event(&mut self, record: &TraceRecord, rest: &[u8], events: &mut Vec<Event>) {
        let code = rest.first().copied().unwrap_or_default();
        if code == EV_CMD_PENDING
            && let Some(waiting) = self.waiting.front_mut()
        {
            waiting.time_ns = record.time_ns;
            waiting.frames += 1;
        }
        if code == EV_SESSION_TERMINATED {
            self.state.lists.clear();
            self.state.mta = None;
        }
        let title = codec::event_name(code).unwrap_or("EV");
        let mut event = slave_event(Protocol::Xcp, record, self.parties, EventKind::Notification, title);
        event.fields.push(Field::hex("event", code, 2));
        if let Some(data @ [_, ..]) = rest.get(1..)
            && data.iter().any(|byte| *byte != 0)
        {
            event.fields.push(Field::bytes("data", data));
        }
        events.push(event);
    }

    /// The command that is answered now.
    fn answered(&mut self, record: &TraceRecord) -> Option<Waiting> {
        let mut waiting = self.waiting.pop_front()?;
        waiting.answered_ns.get_or_insert(record.time_ns);
        waiting.time_ns = record.time_ns;
        waiting.frames += 1;
        Some(waiting)
    }

    fn response(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
        let Some(mut waiting) = self.answered(record) else {
            let event = slave_event(Protocol::Xcp, record, self.parties, EventKind::Response, "RES");
            events.push(unasked(event, &data[1..]));
            return;
        };
        if returns_memory(waiting.command[0]) {
            let count = waiting.command.get(1).copied().unwrap_or_default();
            let expected = usize::from(count) * self.state.granularity;
            let part = data.get(self.state.granularity..).unwrap_or_default();
            let room = expected.saturating_sub(waiting.gathered.len());
            waiting.gathered.extend_from_slice(&part[..part.len().min(room)]);
            // A block: the rest comes in further responses.
            if !part.is_empty() && waiting.gathered.len() < expected {
                self.waiting.push_front(waiting);
                return;
            }
        }
        let mut event = self.event(&waiting, record.channel, EventKind::Exchange);
        self.push_result(&waiting, data, &mut event);
        self.state.apply(&waiting.command, data);
        if waiting.command[0] == command::CONNECT {
            // Only now is the order of its bytes known.
            let parts = codec::find(command::CONNECT).map_or(&[][..], |command| command.response);
            push_parts(&mut event.fields, parts, &data[1..], self.state.order);
        }
        event.data =
            crate::Bytes::from_slice(if waiting.gathered.is_empty() { data } else { &waiting.gathered });
        events.push(event);
    }

    /// An event about a command, with its parts.
    fn event(&self, waiting: &Waiting, channel: u8, kind: EventKind) -> Event {
        let code = waiting.command[0];
        let known = codec::find(code);
        let title: Cow<'static, str> =
            known.map_or_else(|| format!("command {code:02X}").into(), |known| known.name.into());
        let mut event = waiting.event(Protocol::Xcp, channel, self.parties, kind, title);
        event.fields.push(Field::hex("command", code, 2));
        let data = &waiting.command[1..];
        match known {
            Some(CommandDefinition { request, .. }) => {
                push_parts(&mut event.fields, request, data, self.state.order);
            }
            None if data.is_empty() => {}
            None => event.fields.push(Field::bytes("parameters", data)),
        }
        match code {
            command::WRITE_DAQ_MULTIPLE => {
                for entry in self.state.entries_of(&waiting.command) {
                    event.fields.push(Field::number("size", entry.size as u32));
                    event.fields.push(Field::hex("address", entry.address, 8));
                }
            }
            command::UPLOAD | command::DOWNLOAD | command::DOWNLOAD_MAX => {
                if let Some((extension, address)) = self.state.mta {
                    event.fields.push(Field::number("extension", extension));
                    event.fields.push(Field::hex("address", address, 8));
                }
            }
            _ => {}
        }
        event
    }

    /// Appends what a positive response says; CONNECT's is appended by whom knows its order.
    fn push_result(&self, waiting: &Waiting, data: &[u8], event: &mut Event) {
        let code = waiting.command[0];
        let (at, written): (_, &[u8]) = match code {
            command::CONNECT => return,
            command::UPLOAD => (self.state.mta, &waiting.gathered),
            command::SHORT_UPLOAD => (self.state.address_in(&waiting.command, 3), &waiting.gathered),
            command::DOWNLOAD => {
                let count = waiting.command.get(1).copied().unwrap_or_default();
                let length = usize::from(count) * self.state.granularity;
                (self.state.mta, &waiting.gathered[..waiting.gathered.len().min(length)])
            }
            command::DOWNLOAD_MAX => {
                (self.state.mta, waiting.command.get(self.state.granularity..).unwrap_or_default())
            }
            command::SHORT_DOWNLOAD => {
                let count = waiting.command.get(1).copied().unwrap_or_default();
                let value = waiting.command.get(8..).unwrap_or_default();
                let length = usize::from(count) * self.state.granularity;
                (self.state.address_in(&waiting.command, 3), &value[..value.len().min(length)])
            }
            _ => {
                let response = codec::find(code).map_or(&[][..], |command| command.response);
                push_parts(&mut event.fields, response, &data[1..], self.state.order);
                return;
            }
        };
        let is_printable = |byte: &u8| matches!(byte, b' '..=b'~');
        if code == command::UPLOAD && self.state.is_text && written.iter().all(is_printable) {
            event.fields.push(Field::text("text", String::from_utf8_lossy(written).into_owned()));
            return;
        }
        self.push_memory(at, written, &mut event.fields);
    }

    /// Appends bytes of the memory, and what is in them.
    fn push_memory(&self, at: Option<(u8, u32)>, bytes: &[u8], fields: &mut Vec<Field>) {
        fields.push(Field::bytes("value", bytes));
        if let (Some(description), Some((extension, address))) = (self.described(), at) {
            fields.extend(description.fields(extension, address, bytes, self.state.order));
        }
    }

    /// The description, if its addresses count in the same units as the slave's.
    fn described(&self) -> Option<&Description> {
        let description = self.description.as_deref()?;
        (usize::from(description.granularity()) == self.state.granularity).then_some(description)
    }

    fn packet(&self, record: &TraceRecord, data: &[u8]) -> Event {
        let mut event = slave_event(Protocol::Xcp, record, self.parties, EventKind::Periodic, "DAQ");
        let order = self.state.order.unwrap_or(ByteOrder::Little);
        let packet = match self.state.layout.read(data, &self.state.lists, order) {
            Ok(packet) if self.state.order.is_some() => packet,
            read => {
                event.fields.push(Field::hex("pid", data[0], 2));
                event.fields.push(Field::bytes("data", &data[1..]));
                event.fields.push(Field::text("list", read.err().unwrap_or("not heard set up")));
                return event;
            }
        };
        event.fields.push(Field::number("daq", packet.daq));
        event.fields.push(Field::number("odt", packet.odt));
        if packet.has_overload {
            event.fields.push(Field::text("overload", "data were lost before it"));
        }
        if let Some(stamp) = packet.stamp.filter(|stamp| !stamp.is_empty()) {
            event.fields.push(self.state.layout.stamp_field(stamp, order));
        }
        for (entry, bytes) in packet.entries {
            crate::a2l::push_entry(&mut event.fields, self.described(), entry, bytes, self.state.order);
        }
        event
    }

    fn unanswered(&self, waiting: &Waiting, channel: u8, trouble: Trouble) -> Event {
        no_response(self.event(waiting, channel, EventKind::NoResponse), trouble)
    }
}
