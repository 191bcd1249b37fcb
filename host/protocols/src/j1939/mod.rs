//! SAE J1939: parameter groups, messages of many frames, address claims, requests, trouble codes; and values of the groups
//! that most vehicles send, or those of a database.
//!
//! Memory: 256 messages of many frames in progress, each of at most 64 KiB, 64 waiting requests, and a NAME for each of 254 addresses on each
//! channel.

mod charging;
mod diagnostics;
mod fast_packet;
mod header;
mod isobus;
mod name;
mod names;
mod parameters;
mod rv_c;
#[cfg(test)]
mod tests;
pub(crate) mod transport;
mod trouble_codes;

pub use fast_packet::{MOST_FAST_BYTES, fast_frames};
pub use header::Header;
pub use name::J1939Name;
pub(crate) use rv_c::name as rv_c_name;

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use cantap_signals::Decoder;
use cantap_trace::{TraceFrame, TraceRecord};
use rustc_hash::FxHashMap;

use self::fast_packet::FastPackets;
use self::header::{GLOBAL, NULL, party};
use self::transport::{Assembled, LongMessages};
use crate::nmea2000;
use crate::{Assembler, Bytes, Event, EventKind, Field, Party, Protocol, Trouble, UnderWay, is_gap};

const REQUEST: u32 = 0xEA00;
const ACKNOWLEDGEMENT: u32 = 0xE800;
const ADDRESS_CLAIMED: u32 = 0xEE00;
const COMMANDED_ADDRESS: u32 = 0xFED8;

/// How long an answer to a request may take: T3 (J1939-21, 5.10.2.4).
const ANSWER_NS: i64 = 1_250_000_000;
const MOST_REQUESTS: usize = 64;

/// A request for a parameter group.
#[derive(Clone, Copy, Debug)]
struct Request {
    channel: u8,
    time_ns: i64,
    from: u8,
    to: u8,
    pgn: u32,
    frames_lost: bool,
    answered: bool,
}

/// Whose parameter groups a channel has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Groups {
    /// J1939's.
    #[default]
    Vehicle,
    /// NMEA 2000's.
    Boat,
    /// Both: groups defined only by NMEA 2000 belong to it, the rest to J1939.
    Both,
}

/// Decodes a J1939 bus, or an NMEA 2000 bus, which is J1939 plus fast packets and its own parameter groups.
#[derive(Default)]
pub struct J1939 {
    /// Those of all channels, unless each has its own.
    groups: Groups,
    of_channel: Vec<Groups>,
    /// Channels that have RV-C's groups besides.
    caravans: Vec<u8>,
    /// The part for NMEA 2000.
    marine: FastPackets,
    transport: LongMessages,
    requests: VecDeque<Request>,
    names: FxHashMap<(u8, u8), u64>,
    decoder: Option<Arc<Decoder>>,
    messages: Vec<Assembled>,
}

impl J1939 {
    /// With a database's signals, if any.
    pub fn new(decoder: Option<Arc<Decoder>>) -> Self {
        Self { decoder, ..Self::default() }
    }

    /// For NMEA 2000. A database's signals take precedence over built-in ones.
    pub fn nmea2000(decoder: Option<Arc<Decoder>>) -> Self {
        Self { groups: Groups::Boat, ..Self::new(decoder) }
    }

    /// For a bus that has both.
    pub fn with_nmea2000(decoder: Option<Arc<Decoder>>) -> Self {
        Self { groups: Groups::Both, ..Self::new(decoder) }
    }

    /// From now on, the channel has these groups. What is under way goes on.
    pub(crate) fn assign(&mut self, channel: u8, groups: Groups) {
        if self.of_channel.is_empty() {
            self.of_channel.resize(256, self.groups);
        }
        self.of_channel[usize::from(channel)] = groups;
    }

    /// From now on, the channel has RV-C's groups on the second page.
    pub(crate) fn assign_rv_c(&mut self, channel: u8) {
        self.caravans.push(channel);
    }

    /// The group's name in RV-C, if it is one of a channel that has it.
    fn rv_c(&self, channel: u8, pgn: u32) -> Option<&'static str> {
        (pgn > 0xFFFF && self.caravans.contains(&channel)).then(|| rv_c::name(pgn)).flatten()
    }

    fn groups(&self, channel: u8) -> Groups {
        self.of_channel.get(usize::from(channel)).copied().unwrap_or(self.groups)
    }

    fn protocol(&self, channel: u8, pgn: u32) -> Protocol {
        match self.groups(channel) {
            Groups::Vehicle => Protocol::J1939,
            Groups::Both if !nmea2000::is_own(pgn) => Protocol::J1939,
            Groups::Both | Groups::Boat => Protocol::Nmea2000,
        }
    }

    fn is_marine(&self, channel: u8) -> bool {
        self.groups(channel) != Groups::Vehicle
    }

    /// A group's name.
    fn group(&self, channel: u8, pgn: u32) -> Option<&'static str> {
        self.rv_c(channel, pgn)
            .or_else(|| names::group(pgn))
            .or_else(|| self.is_marine(channel).then(|| nmea2000::name(pgn)).flatten())
    }

    fn frame(&mut self, record: &TraceRecord, header: Header, data: &[u8], events: &mut Vec<Event>) {
        let (channel, time_ns) = (record.channel, record.time_ns);
        let mut messages = std::mem::take(&mut self.messages);
        let mut out = |message| messages.push(message);
        let taken = match header.pgn {
            transport::CONTROL | transport::EXTENDED_CONTROL => {
                self.transport.control(channel, time_ns, header, data, &mut out)
            }
            transport::DATA | transport::EXTENDED_DATA => {
                if self.transport.data(channel, time_ns, header, data, &mut out) {
                    Ok(())
                } else {
                    // Reported once for each message: the rest of it adds nothing.
                    let mut event = self.event(record, header, EventKind::Broken);
                    event.trouble = Some(Trouble::Headless);
                    events.push(event);
                    Ok(())
                }
            }
            _ => {
                if self.is_marine(channel) && nmea2000::is_fast(header.pgn) {
                    self.marine.take(channel, time_ns, header, data, &mut out);
                } else {
                    self.message(record, header, data, None, events);
                }
                Ok(())
            }
        };
        if let Err(fault) = taken {
            let mut event = self.event(record, header, EventKind::Broken);
            event.trouble = Some(Trouble::Malformed(fault));
            events.push(event);
        }
        for message in messages.drain(..) {
            self.assembled(record, message, events);
        }
        self.messages = messages;
    }

    /// A message of many frames has ended.
    fn assembled(&mut self, record: &TraceRecord, mut message: Assembled, events: &mut Vec<Event>) {
        let data = std::mem::take(&mut message.data);
        let record = TraceRecord { time_ns: message.time_ns, channel: message.channel, ..*record };
        self.message(&record, message.header, &data, Some(&message), events);
    }

    fn event(&self, record: &TraceRecord, header: Header, kind: EventKind) -> Event {
        let name = self.rv_c(record.channel, header.pgn).or_else(|| names::message(header));
        let title = name.map_or_else(|| format!("PGN {}", header.pgn).into(), Cow::Borrowed);
        let mut event = Event::new(self.protocol(record.channel, header.pgn), record, kind, title);
        (event.from, event.to) = (party(header.source), party(header.destination));
        event.fields.reserve(4);
        event.fields.push(Field::number("pgn", header.pgn));
        event.fields.push(Field::number("priority", header.priority));
        event
    }

    fn message(
        &mut self,
        record: &TraceRecord,
        header: Header,
        data: &[u8],
        long: Option<&Assembled>,
        events: &mut Vec<Event>,
    ) {
        let mut event = self.event(record, header, EventKind::Message);
        let mut asked = None;
        if let Some(long) = long {
            event.start_ns = long.start_ns;
            event.frames = long.frames;
            event.frames_lost = long.frames_lost;
            event.trouble = long.trouble;
            event.data = Bytes::from_slice(data);
            event.fields.push(Field::text("transport", long.way.name()));
            event.fields.push(Field::number("length", long.size).unit("bytes"));
            if let Some(cleared_ns) = long.cleared_ns {
                event.fields.push(Field::real("rts_to_cts_ms", cleared_ns as f64 / 1e6, "ms"));
            }
            if long.trouble.is_some() {
                event.kind = EventKind::Broken;
                if let Some(name) = names::message(header).or_else(|| self.group(record.channel, header.pgn))
                {
                    event.title = name.into();
                }
                event.fields.push(Field::number("received", data.len() as i64).unit("bytes"));
                events.push(event);
                return;
            }
        }
        match (header.pgn, data) {
            (REQUEST, [a, b, c, ..]) => {
                let pgn = header::pgn([*a, *b, *c]);
                event.kind = EventKind::Request;
                event.fields.push(Field::number("requested", pgn).meaning(self.group(record.channel, pgn)));
                self.ask(record, header, pgn, events);
            }
            (ACKNOWLEDGEMENT, [control, function, _, _, address, a, b, c]) => {
                let pgn = header::pgn([*a, *b, *c]);
                event.kind = EventKind::Acknowledgement;
                let said = ["yes", "no", "access denied", "cannot respond now"];
                let said = said.get(usize::from(*control)).copied();
                event.fields.push(Field::number("control", *control).meaning(said));
                event.fields.push(Field::number("group_function", *function));
                event.fields.push(Field::number("requested", pgn).meaning(self.group(record.channel, pgn)));
                if *address < NULL {
                    event.fields.push(Field::number("of", *address));
                }
                asked = Some(pgn);
            }
            (ADDRESS_CLAIMED, data) if data.len() == 8 => {
                self.claim(record.channel, header, u64_of(data), &mut event);
            }
            (COMMANDED_ADDRESS, [name @ .., address]) if name.len() == 8 => {
                event.kind = EventKind::AddressCommand;
                event.fields.push(Field::number("address", *address));
                name::fields(u64_of(name), &mut event.fields);
            }
            (pgn, data) if trouble_codes::carries(pgn) => {
                event.kind = EventKind::TroubleCodes;
                trouble_codes::fields(data, &mut event.fields);
            }
            (0xFEDA | 0xFEEB | 0xFEEC, data) => {
                let name = if header.pgn == 0xFEEC { "vin" } else { "text" };
                let text = data
                    .iter()
                    .take_while(|byte| **byte != 0 && **byte != 0xFF)
                    .map(|byte| char::from(*byte));
                let text: String = text.filter(|letter| !cantap_trace::clean::is_harmful(*letter)).collect();
                event.fields.push(Field::text(name, text.trim_end_matches('*').to_owned()));
            }
            (_, data) => {
                if !self.signals(record.channel, header, data, &mut event)
                    && !charging::fields(header, data, &mut event.fields)
                    && !self.rv_c_fields(record.channel, header.pgn, data, &mut event.fields)
                    && !isobus::fields(header, data, &mut event)
                    && !diagnostics::fields(header.pgn, data, &mut event.fields)
                    && !parameters::fields(header.pgn, data, &mut event.fields)
                    && !self.marine_fields(record.channel, header, data, &mut event)
                {
                    event.fields.push(Field::bytes("data", data));
                }
            }
        }
        self.answer(record.channel, header, asked.unwrap_or(header.pgn), &mut event);
        events.push(event);
    }

    /// Adds a database's signals; false if it does not have the group.
    fn signals(&self, channel: u8, header: Header, data: &[u8], event: &mut Event) -> bool {
        let Some(decoder) = &self.decoder else { return false };
        let Some(reference) = decoder.find(channel, header.id()) else { return false };
        let message = decoder.message(reference);
        let mut values = Vec::new();
        decoder.decode_data(reference, data, &mut values);
        event.title = message.name.clone().into();
        for value in &values {
            let signal = &message.signals[value.signal as usize];
            let name: Cow<'static, str> = signal.label().into_owned().into();
            event.fields.push(match message.indicator(signal, value.raw) {
                Some(indicator) => Field::missing(name).meaning(Some(indicator.name())),
                None => Field::real(name, value.value, signal.unit.clone())
                    .meaning(signal.text(value.raw).map(str::to_owned)),
            });
        }
        true
    }

    /// Adds the values of a group of RV-C; false if it is none.
    fn rv_c_fields(&self, channel: u8, pgn: u32, data: &[u8], fields: &mut Vec<Field>) -> bool {
        self.rv_c(channel, pgn).is_some() && rv_c::fields(pgn, data, fields)
    }

    /// Adds the fields from NMEA 2000; false if it does not have the group.
    fn marine_fields(&self, channel: u8, header: Header, data: &[u8], event: &mut Event) -> bool {
        if !self.is_marine(channel) {
            return false;
        }
        let before = event.fields.len();
        if let Some(title) = nmea2000::describe(header.pgn, data, &mut event.fields) {
            event.title = title;
        }
        event.fields.len() > before
    }

    fn claim(&mut self, channel: u8, header: Header, name: u64, event: &mut Event) {
        event.kind = EventKind::AddressClaim;
        if header.source == NULL {
            event.title = "cannot claim an address".into();
        }
        name::fields(name, &mut event.fields);
        if header.source >= NULL {
            return;
        }
        let known = self.names.entry((channel, header.source)).or_insert(name);
        if *known != name {
            // The lower NAME has priority (J1939-81, 4.4.3.3).
            let (winner, loser) = if name < *known { (name, *known) } else { (*known, name) };
            *known = winner;
            event.fields.push(Field::hex("address_lost_by", loser, 16));
        }
    }

    fn ask(&mut self, record: &TraceRecord, header: Header, pgn: u32, events: &mut Vec<Event>) {
        if self.requests.len() == MOST_REQUESTS
            && let Some(oldest) = self.requests.pop_front()
        {
            self.unanswered(oldest, Trouble::GivenUp, record, events);
        }
        self.requests.push_back(Request {
            channel: record.channel,
            time_ns: record.time_ns,
            from: header.source,
            to: header.destination,
            pgn,
            frames_lost: false,
            answered: false,
        });
    }

    /// Whether the message answers a request, and how long ago that was.
    fn answer(&mut self, channel: u8, header: Header, pgn: u32, event: &mut Event) {
        if self.requests.is_empty() {
            return;
        }
        // One that was already on its way when it was asked for; a single frame's stamp may be out of order.
        let (is_long, start_ns) = (event.frames > 1, event.start_ns);
        let asked = self.requests.iter_mut().find(|request| {
            request.channel == channel
                && request.pgn == pgn
                && !(is_long && start_ns < request.time_ns)
                && request.from != header.source
                && (request.to == header.source || request.to == GLOBAL)
                && (header.destination == GLOBAL || header.destination == request.from)
        });
        if let Some(request) = asked {
            event.response_ns = Some(event.start_ns.saturating_sub(request.time_ns));
            event.frames_lost |= request.frames_lost;
            request.answered = true;
            if request.to != GLOBAL {
                let to = request.to;
                self.requests.retain(|request| !(request.answered && request.to == to));
            }
        }
    }

    /// A request to all need not be answered.
    fn unanswered(&self, request: Request, trouble: Trouble, record: &TraceRecord, events: &mut Vec<Event>) {
        if request.answered || request.to == GLOBAL {
            return;
        }
        let header = Header { priority: 6, pgn: REQUEST, source: request.from, destination: request.to };
        let record = &TraceRecord { channel: request.channel, ..*record };
        let mut event = self.event(record, header, EventKind::NoResponse);
        event.fields.pop();
        event.start_ns = request.time_ns;
        if let Trouble::Timeout { .. } = trouble {
            event.time_ns = request.time_ns.saturating_add(ANSWER_NS);
        }
        event.data.clear();
        event
            .fields
            .push(Field::number("requested", request.pgn).meaning(self.group(request.channel, request.pgn)));
        event.fields.push(Field::text("response", "none"));
        event.trouble = Some(trouble);
        event.frames_lost = request.frames_lost;
        events.push(event);
    }
}

/// Whether a frame with this group and length indicates J1939: the group is J1939's, and diagnostics over ISO 15765 do not use it.
pub(crate) fn is_known(pgn: u32, length: usize) -> bool {
    // Frames are filled up to eight bytes; a request has three. The first two groups, which have the number 0 for a
    // format, are what other makers' 29-bit identifiers look like, and never alone on a bus.
    let fits = if pgn == REQUEST { length == 3 || length == 8 } else { length == 8 };
    fits && !matches!(pgn, 0 | 0x100 | 0xDA00 | 0xDB00) && pgn < 0xFF00 && names::group(pgn).is_some()
}

fn u64_of(bytes: &[u8]) -> u64 {
    bytes.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte))
}

impl Assembler for J1939 {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        while let Some(request) = self.requests.front()
            && record.time_ns.saturating_sub(request.time_ns) > ANSWER_NS
        {
            if let Some(request) = self.requests.pop_front() {
                let after_ms = (ANSWER_NS / 1_000_000) as u32;
                self.unanswered(request, Trouble::Timeout { after_ms }, record, events);
            }
        }
        let mut messages = std::mem::take(&mut self.messages);
        self.transport.advance(record.time_ns, &mut |message| messages.push(message));
        self.marine.advance(record.time_ns, &mut |message| messages.push(message));
        for message in messages.drain(..) {
            self.assembled(record, message, events);
        }
        self.messages = messages;
        if is_gap(&record.event) {
            self.transport.interrupt(record.channel);
            self.marine.interrupt(record.channel);
            for request in self.requests.iter_mut().filter(|request| request.channel == record.channel) {
                request.frames_lost = true;
            }
        }
        let Some(frame) = record.frame().filter(|frame| !frame.is_remote()) else { return };
        let Some(header) = Header::of(TraceFrame::id(frame)) else { return };
        self.frame(record, header, frame.data(), events);
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        let mut messages = Vec::new();
        self.transport.finish(&mut |message| messages.push(message));
        self.marine.finish(&mut |message| messages.push(message));
        let record =
            TraceRecord { time_ns: 0, device_ns: None, channel: 1, event: cantap_trace::TraceEvent::GAP };
        for message in messages {
            self.assembled(&record, message, events);
        }
        for request in std::mem::take(&mut self.requests) {
            let record = TraceRecord { time_ns: request.time_ns, ..record };
            self.unanswered(request, Trouble::Unfinished, &record, events);
        }
    }

    fn under_way(&self, out: &mut Vec<UnderWay>) {
        let messages = self.transport.open().chain(self.marine.open());
        out.extend(messages.map(|message| UnderWay {
            channel: message.channel,
            protocol: self.protocol(message.channel, message.header.pgn),
            from: party(message.header.source),
            to: party(message.header.destination),
            start_ns: message.start_ns,
            received: message.data.len() as u32,
            length: Some(message.size),
        }));
    }
}

impl Party {
    /// The node's address, if it has one.
    pub const fn node(self) -> Option<u8> {
        match self {
            Self::Node(node) => Some(node),
            _ => None,
        }
    }
}
