//! A connection of a master with its slave, from commands and their answers to events.

use std::borrow::Cow;
use std::sync::Arc;

use cantap_trace::{Id, TraceRecord};

use super::codec::{self, command};
use super::signs::SessionFinder;
use crate::a2l::Description;
use crate::calibration::Connection;
use crate::calibration::connection::{MasterSlave, Waiting, no_response, slave_event, unasked};
use crate::calibration::known::Known;
use crate::calibration::lists::{ListEntry, Lists};
use crate::calibration::parts::{ByteOrder, push_parts};
use crate::{Bytes, Event, EventKind, Field, Protocol, Trouble};

/// How long an answer may take: the standard's 25 ms are rarely kept, and checksums and programming take longer.
const RESPONSE_NS: i64 = 2_000_000_000;
const LONG_RESPONSE_NS: i64 = 30_000_000_000;

/// A slave, as far as its connection was heard.
#[derive(Clone, Debug)]
pub struct CcpConnection {
    parties: MasterSlave,
    description: Option<Arc<Description>>,
    mta: Option<(u8, u32)>,
    lists: Lists,
    waiting: Option<Waiting>,
    /// An identifier of its own that data packets of this slave were given.
    daq_id: Option<Id>,
}

impl Connection for CcpConnection {
    type Finder = SessionFinder;

    fn new(parties: MasterSlave, description: Option<Arc<Description>>) -> Self {
        let lists = Lists::default();
        Self { parties, description, mta: None, lists, waiting: None, daq_id: None }
    }

    fn known(known: &Known) -> Vec<MasterSlave> {
        let described = known.descriptions.iter().flat_map(|all| all.ccp_parties());
        known.ccp.iter().copied().chain(described).collect()
    }

    fn hear_master(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
        if data.len() < 2 {
            return;
        }
        if let Some(before) = self.waiting.replace(Waiting::new(record, data)) {
            events.push(self.unanswered(&before, record.channel, Trouble::Overlapped));
        }
    }

    fn hear_slave(&mut self, record: &TraceRecord, data: &[u8], events: &mut Vec<Event>) {
        match *data {
            [codec::COMMAND_RETURN, code, counter, ref rest @ ..] => {
                self.answer(record, code, counter, rest, events);
            }
            [codec::EVENT, code, ..] => {
                let title = codec::return_name(code).unwrap_or("event");
                let mut event =
                    slave_event(Protocol::Ccp, record, self.parties, EventKind::Notification, title);
                event.fields.push(Field::hex("event", code, 2));
                events.push(event);
            }
            [] => {}
            _ => events.push(self.packet(record, data)),
        }
    }

    fn take_daq_id(&mut self) -> Option<Id> {
        self.daq_id.take()
    }

    fn sweep(&mut self, now_ns: i64, channel: u8, events: &mut Vec<Event>) {
        let limit = |waiting: &Waiting| match waiting.command[0] {
            0x0E | 0x10 | 0x18 | 0x19 | 0x20..=0x22 => LONG_RESPONSE_NS,
            _ => RESPONSE_NS,
        };
        let is_late = |waiting: &mut Waiting| now_ns.saturating_sub(waiting.time_ns) > limit(waiting);
        if let Some(mut waiting) = self.waiting.take_if(is_late) {
            let limit_ns = limit(&waiting);
            waiting.time_ns += limit_ns;
            let after_ms = (limit_ns / 1_000_000) as u32;
            events.push(self.unanswered(&waiting, channel, Trouble::Timeout { after_ms }));
        }
    }

    fn gap(&mut self, is_short: bool, _channel: u8, _events: &mut Vec<Event>) {
        self.lists.gap(is_short);
        self.mta = None;
        if let Some(waiting) = &mut self.waiting {
            waiting.frames_lost = true;
        }
    }

    fn finish(&mut self, channel: u8, events: &mut Vec<Event>) {
        if let Some(waiting) = self.waiting.take() {
            events.push(self.unanswered(&waiting, channel, Trouble::Unfinished));
        }
    }
}

impl CcpConnection {
    /// The order of the ECU's bytes, if a description has it. Without one, addresses are shown as they are sent.
    fn order(&self) -> Option<ByteOrder> {
        self.description.as_ref().and_then(|description| description.ccp_order())
    }

    /// The number of an address: in the ECU's order, or as its bytes are sent.
    fn address(&self, bytes: &[u8]) -> u32 {
        self.order().unwrap_or(ByteOrder::Big).number(bytes) as u32
    }

    fn answer(&mut self, record: &TraceRecord, code: u8, counter: u8, rest: &[u8], events: &mut Vec<Event>) {
        let error = Field::hex("error", code, 2).meaning(codec::return_name(code));
        let Some(mut waiting) = self.waiting.take_if(|waiting| waiting.command[1] == counter) else {
            let mut event = slave_event(Protocol::Ccp, record, self.parties, EventKind::Response, "CRM");
            event.fields.push(Field::number("counter", counter));
            event.fields.push(error);
            events.push(unasked(event, rest));
            return;
        };
        (waiting.answered_ns, waiting.time_ns) = (Some(record.time_ns), record.time_ns);
        waiting.frames += 1;
        if code != 0 {
            let mut event = self.event(&waiting, record.channel, EventKind::Refusal);
            event.fields.push(error);
            events.push(event);
            return;
        }
        let mut event = self.event(&waiting, record.channel, EventKind::Exchange);
        self.push_result(&waiting.command, rest, &mut event);
        self.apply(&waiting.command, rest);
        event.data = Bytes::from_slice(rest);
        events.push(event);
    }

    fn event(&self, waiting: &Waiting, channel: u8, kind: EventKind) -> Event {
        let code = waiting.command[0];
        let known = codec::find(code);
        let title: Cow<'static, str> =
            known.map_or_else(|| format!("command {code:02X}").into(), |known| known.name.into());
        let mut event = waiting.event(Protocol::Ccp, channel, self.parties, kind, title);
        event.fields.push(Field::hex("command", code, 2));
        event.fields.push(Field::number("counter", waiting.command[1]));
        let data = &waiting.command[2..];
        match known {
            Some(known) => {
                // A station's address is in Intel's order whatever the ECU's is; what else is unknown is shown as it is sent.
                let is_station = matches!(code, command::CONNECT | command::DISCONNECT | 0x05);
                let order =
                    if is_station { ByteOrder::Little } else { self.order().unwrap_or(ByteOrder::Big) };
                push_parts(&mut event.fields, known.request, data, Some(order));
            }
            None => event.fields.push(Field::bytes("parameters", data)),
        }
        if matches!(code, command::UPLOAD | command::DNLOAD | command::DNLOAD_6)
            && let Some((extension, address)) = self.mta
        {
            event.fields.push(Field::number("extension", extension));
            event.fields.push(Field::hex("address", address, 8));
        }
        event
    }

    fn push_result(&self, asked: &[u8], rest: &[u8], event: &mut Event) {
        let count = asked.get(2).map_or(0, |count| usize::from(*count));
        let (at, bytes) = match asked[0] {
            command::UPLOAD => (self.mta, rest.get(..count)),
            command::SHORT_UP => (self.address_in(asked, 3), rest.get(..count)),
            command::DNLOAD => (self.mta, asked.get(3..3 + count)),
            command::DNLOAD_6 => (self.mta, asked.get(2..8)),
            code => {
                let response = codec::find(code).map_or(&[][..], |known| known.response);
                let order = self.order().unwrap_or(ByteOrder::Big);
                push_parts(&mut event.fields, response, rest, Some(order));
                return;
            }
        };
        let Some(bytes) = bytes else {
            event.trouble = Some(Trouble::Malformed("more elements than a message has room for"));
            return;
        };
        event.fields.push(Field::bytes("value", bytes));
        if let (Some(description), Some((extension, address))) = (&self.description, at) {
            event.fields.extend(description.fields(extension, address, bytes, self.order()));
        }
    }

    fn address_in(&self, asked: &[u8], at: usize) -> Option<(u8, u32)> {
        let (&extension, address) = asked.get(at..at + 5)?.split_first()?;
        Some((extension, self.address(address)))
    }

    /// What a command has changed, now that the slave has agreed.
    fn apply(&mut self, asked: &[u8], rest: &[u8]) {
        let byte = |at: usize| asked.get(at).copied().unwrap_or_default();
        let daq = u16::from(byte(2));
        match asked[0] {
            command::SET_MTA if byte(2) == 0 => self.mta = self.address_in(asked, 3),
            command::UPLOAD | command::DNLOAD => self.advance(byte(2)),
            command::DNLOAD_6 => self.advance(6),
            command::CONNECT | 0x0E | 0x18 | 0x19 | 0x22 | 0x20 | 0x21 | command::EXCHANGE_ID => {
                self.mta = None;
            }
            command::DISCONNECT => {
                self.mta = None;
                // A session that ends takes its lists with it.
                if byte(2) == 1 {
                    self.lists.clear();
                }
            }
            command::GET_DAQ_SIZE => {
                // It also empties the list.
                self.lists.clear_list(daq);
                if let (Some(list), [_, first_pid, ..]) = (self.lists.list(daq), rest) {
                    (list.first_pid, list.mode) = (Some(*first_pid), Some(0));
                }
                if let Some(id) = asked.get(4..8).map(|bytes| self.address(bytes)) {
                    let is_extended = id >> 31 != 0 || id > 0x7FF;
                    self.daq_id = match (id, is_extended) {
                        (0, _) => None,
                        (_, false) => Some(Id::standard_truncated(id)),
                        (_, true) => Some(Id::extended_truncated(id)),
                    };
                }
            }
            command::SET_DAQ_PTR => self.lists.point_to(daq, byte(3), byte(4)),
            command::WRITE_DAQ => {
                if let Some((extension, address)) = self.address_in(asked, 3) {
                    self.lists.write(ListEntry { extension, address, size: usize::from(byte(2)), bit: None });
                }
            }
            command::START_STOP => {
                if let Some(list) = self.lists.list(u16::from(byte(3))) {
                    list.event = Some(byte(5).into());
                    match byte(2) {
                        0 => list.is_running = false,
                        1 => list.is_running = true,
                        _ => list.is_selected = true,
                    }
                }
            }
            command::START_STOP_ALL => {
                for (_, list) in self.lists.all() {
                    list.is_running = byte(2) == 1 && (list.is_selected || list.is_running);
                    list.is_selected = false;
                }
            }
            _ => {}
        }
    }

    const fn advance(&mut self, count: u8) {
        if let Some((extension, address)) = self.mta {
            self.mta = Some((extension, address.wrapping_add(count as u32)));
        }
    }

    fn packet(&self, record: &TraceRecord, data: &[u8]) -> Event {
        let mut event = slave_event(Protocol::Ccp, record, self.parties, EventKind::Periodic, "DAQ");
        let found = self.lists.of_pid(data[0]);
        let packet = found.and_then(|(daq, odt, list)| Some((daq, odt, list.packet(odt)?)));
        let used =
            |packet: &[Option<ListEntry>]| packet.iter().flatten().map(|entry| entry.size).sum::<usize>();
        let Some((daq, odt, packet)) = packet.filter(|(_, _, packet)| used(packet) < data.len()) else {
            event.fields.push(Field::hex("pid", data[0], 2));
            event.fields.push(Field::bytes("data", &data[1..]));
            event.fields.push(Field::text("list", "not heard set up"));
            return event;
        };
        event.fields.push(Field::number("daq", daq));
        event.fields.push(Field::number("odt", odt));
        let mut rest = &data[1..];
        for entry in packet.iter().flatten() {
            let (bytes, after) = rest.split_at(entry.size);
            rest = after;
            let description = self.description.as_deref();
            crate::a2l::push_entry(&mut event.fields, description, *entry, bytes, self.order());
        }
        event
    }

    fn unanswered(&self, waiting: &Waiting, channel: u8, trouble: Trouble) -> Event {
        no_response(self.event(waiting, channel, EventKind::NoResponse), trouble)
    }
}
