//! DeviceNet: message groups, explicit messages with their fragmentation, I/O of the predefined master/slave connections, the check
//! for duplicate MAC IDs.
//!
//! An explicit request and its response are one event. Identifiers are those of the predefined connection set; connections that
//! nodes negotiate (UCMM) are decoded as explicit messages of group 3.
//!
//! Memory: for each channel and each of 64 nodes, one message of at most 4 KiB in each direction, and one waiting
//! request.

pub mod codec;
mod identifiers;
mod names;
mod signs;
#[cfg(test)]
mod tests;

use self::codec::{ERROR_RESPONSE, ExplicitHeader, Fragment};
use self::identifiers::{Use, use_of};
pub(crate) use self::signs::DeviceNetSigns;

use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;

use crate::{Assembler, Bytes, Event, EventKind, Field, Party, Protocol, Trouble, is_gap};

/// How long a response may take; the default of a connection's expected packet rate is 2.5 s.
const RESPONSE_NS: i64 = 2_500_000_000;
const SWEEP_NS: i64 = 100_000_000;
const MOST_BYTES: usize = 4096;

/// A message being reassembled.
#[derive(Clone, Debug)]
struct Message {
    start_ns: i64,
    time_ns: i64,
    /// The other side's MAC ID, from the header.
    other: u8,
    /// The service and what follows it.
    body: Bytes,
    next: u8,
    frames: u32,
    trouble: Option<Trouble>,
    frames_lost: bool,
}

/// A node's explicit messages.
#[derive(Default)]
struct Node {
    /// Messages in progress to and from it.
    open: [Option<Message>; 2],
    waiting: Option<Message>,
}

/// Decodes a DeviceNet bus.
#[derive(Default)]
pub struct DeviceNet {
    nodes: FxHashMap<(u8, u8), Node>,
    sweep_ns: i64,
}

impl DeviceNet {
    /// Nothing has been heard yet.
    pub fn new() -> Self {
        Self::default()
    }

    fn frame(&mut self, record: &TraceRecord, id: u16, data: &[u8], events: &mut Vec<Event>) {
        match use_of(id) {
            Some(Use::Io(node, title, from_slave)) => {
                let mut event = event(record, EventKind::Io, title);
                if from_slave {
                    event.from = Party::Node(node);
                } else if title == "bit-strobe command" {
                    (event.from, event.to) = (Party::Node(node), Party::Everyone);
                } else {
                    event.to = Party::Node(node);
                }
                event.fields.push(Field::bytes("data", data));
                events.push(event);
            }
            Some(Use::Request(node)) => self.explicit(record, node, None, false, data, events),
            Some(Use::Response(node)) => self.explicit(record, node, None, true, data, events),
            Some(Use::Peer(node)) => {
                // The identifier names the sender; the service's highest bit says whether it asks or answers.
                let Some(&header) = data.first() else { return };
                let service = if header & 0x80 == 0 { data.get(1) } else { data.get(2) };
                let other = header & 0x3F;
                let answers = service.is_some_and(|service| service & 0x80 != 0);
                let server = if answers { node } else { other };
                self.explicit(
                    record,
                    server,
                    Some(if answers { other } else { node }),
                    answers,
                    data,
                    events,
                );
            }
            Some(Use::DuplicateCheck(node)) => {
                let mut event = event(record, EventKind::DuplicateCheck, "duplicate MAC ID check");
                event.from = Party::Node(node);
                if let &[port, v0, v1, s0, s1, s2, s3] = data {
                    event.fields.push(Field::number("physical_port", port & 0x7F));
                    event.fields.push(Field::hex("vendor", u16::from_le_bytes([v0, v1]), 4));
                    event.fields.push(Field::hex("serial_number", u32::from_le_bytes([s0, s1, s2, s3]), 8));
                    if port & 0x80 != 0 {
                        event.title = "the MAC ID is in use".into();
                        event.kind = EventKind::Duplicate;
                    }
                } else {
                    event.trouble = Some(Trouble::Malformed("a duplicate MAC ID check has 7 bytes"));
                }
                events.push(event);
            }
            Some(Use::Offline(message)) => {
                let title = [
                    "communication faulted response",
                    "communication faulted request",
                    "offline ownership response",
                    "offline ownership request",
                ];
                let mut event = event(record, EventKind::Offline, title[usize::from(message & 3)]);
                event.fields.push(Field::bytes("data", data));
                events.push(event);
            }
            None => {}
        }
    }

    /// A frame of an explicit message, to or from a node that is a server.
    fn explicit(
        &mut self,
        record: &TraceRecord,
        server: u8,
        client: Option<u8>,
        answers: bool,
        data: &[u8],
        events: &mut Vec<Event>,
    ) {
        let &[header, second, ref rest @ ..] = data else {
            let mut event = event(record, EventKind::Broken, "explicit message");
            event.trouble = Some(Trouble::Malformed("an explicit message has at least 2 bytes"));
            events.push(event);
            return;
        };
        let time_ns = record.time_ns;
        let header = ExplicitHeader::decode(header);
        let other = client.unwrap_or(header.mac);
        let fresh = |body: Bytes| Message {
            start_ns: time_ns,
            time_ns,
            other,
            body,
            next: 1,
            frames: 1,
            trouble: None,
            frames_lost: false,
        };
        let place = usize::from(answers);
        let node = self.nodes.entry((record.channel, server)).or_default();
        if !header.fragmented {
            let before = node.open[place].take();
            let body = std::iter::once(second).chain(rest.iter().copied()).collect();
            self.broken(record, server, answers, before.map(|before| (before, Trouble::Overlapped)), events);
            self.message(record, server, answers, fresh(body), events);
            return;
        }
        let fragment = Fragment::decode(second);
        if let Fragment::Acknowledge(_) = fragment {
            // The receiver acknowledges each fragment on its own connection; only a rejection is reported.
            if rest.first().is_some_and(|status| *status != 0) {
                let refused = node.open[1 - place].take().map(|open| (open, Trouble::Overflow));
                self.broken(record, server, !answers, refused, events);
            }
            return;
        }
        let (Fragment::Middle(count) | Fragment::Last(count)) = fragment else {
            let before = node.open[place].replace(fresh(Bytes::from_slice(rest)));
            self.broken(record, server, answers, before.map(|before| (before, Trouble::Overlapped)), events);
            return;
        };
        let Some(open) = &mut node.open[place] else {
            let headless = (fresh(Bytes::from_slice(rest)), Trouble::Headless);
            self.broken(record, server, answers, Some(headless), events);
            return;
        };
        open.time_ns = time_ns;
        open.frames += 1;
        // A fragment is sent again if its acknowledgement did not come.
        if count == open.next.wrapping_sub(1) & 0x3F {
            return;
        }
        if count != open.next {
            let trouble = Trouble::Sequence { expected: open.next.into(), got: count.into() };
            let broken = node.open[place].take().map(|open| (open, trouble));
            self.broken(record, server, answers, broken, events);
            return;
        }
        open.next = (open.next + 1) & 0x3F;
        let room = MOST_BYTES.saturating_sub(open.body.len());
        if rest.len() > room {
            open.trouble = Some(Trouble::Cut);
        }
        open.body.extend_from_slice(&rest[..rest.len().min(room)]);
        if matches!(fragment, Fragment::Last(_))
            && let Some(done) = node.open[place].take()
        {
            self.message(record, server, answers, done, events);
        }
    }

    /// A message that remained incomplete.
    #[expect(clippy::unused_self, reason = "beside its siblings")]
    fn broken(
        &self,
        record: &TraceRecord,
        server: u8,
        answers: bool,
        broken: Option<(Message, Trouble)>,
        events: &mut Vec<Event>,
    ) {
        let Some((message, trouble)) = broken else { return };
        let mut event = event(record, EventKind::Broken, "explicit message");
        (event.start_ns, event.time_ns) = (message.start_ns, message.time_ns);
        (event.from, event.to) = parties(server, message.other, answers);
        event.fields.push(Field::bytes("received", &message.body));
        event.frames = message.frames;
        event.frames_lost = message.frames_lost;
        event.trouble = Some(trouble);
        event.data = message.body;
        events.push(event);
    }

    fn message(
        &mut self,
        record: &TraceRecord,
        server: u8,
        answers: bool,
        message: Message,
        events: &mut Vec<Event>,
    ) {
        let Some(&service) = message.body.first() else { return };
        let node = self.nodes.entry((record.channel, server)).or_default();
        if !answers {
            if let Some(before) = node.waiting.replace(message) {
                events.push(unanswered(record.channel, server, before, Trouble::Overlapped));
            }
            return;
        }
        let code = service & 0x7F;
        let asked = node.waiting.take_if(|asked| {
            code == ERROR_RESPONSE || asked.body.first().is_some_and(|asked| asked & 0x7F == code)
        });
        let request = asked.as_ref().map(|asked| &asked.body[..]);
        let kind = match (code, &asked) {
            (ERROR_RESPONSE, _) => EventKind::Refusal,
            (_, Some(_)) => EventKind::Exchange,
            _ => EventKind::Response,
        };
        let mut event = service_event(record, kind, request.unwrap_or(&message.body), request.is_some());
        (event.from, event.to) = parties(server, message.other, asked.is_none());
        event.start_ns = asked.as_ref().map_or(message.start_ns, |asked| asked.start_ns);
        event.time_ns = message.time_ns;
        event.frames = message.frames + asked.as_ref().map_or(0, |asked| asked.frames);
        event.frames_lost = message.frames_lost || asked.as_ref().is_some_and(|asked| asked.frames_lost);
        event.trouble = message.trouble;
        event.response_ns = asked.as_ref().map(|asked| message.start_ns.saturating_sub(asked.time_ns));
        match (code, &message.body[1..]) {
            (ERROR_RESPONSE, [error, more, ..]) => {
                event.fields.push(Field::hex("error", *error, 2).meaning(Some(names::error(*error))));
                event.fields.push(Field::hex("additional", *more, 2));
            }
            (_, []) => {}
            (_, value) => event.fields.push(Field::bytes("value", value)),
        }
        if asked.is_none() {
            event.fields.push(Field::text("request", "not heard"));
        }
        event.data = message.body;
        events.push(event);
    }

    fn sweep(&mut self, now_ns: i64, events: &mut Vec<Event>) {
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let from = events.len();
        for (&(channel, server), node) in &mut self.nodes {
            let late = |message: &mut Message| now_ns.saturating_sub(message.time_ns) > RESPONSE_NS;
            if let Some(mut asked) = node.waiting.take_if(late) {
                asked.time_ns += RESPONSE_NS;
                let after_ms = (RESPONSE_NS / 1_000_000) as u32;
                events.push(unanswered(channel, server, asked, Trouble::Timeout { after_ms }));
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.to.node()));
    }
}

fn parties(server: u8, client: u8, from_server: bool) -> (Party, Party) {
    let (server, client) = (Party::Node(server), Party::Node(client));
    if from_server { (server, client) } else { (client, server) }
}

fn event(record: &TraceRecord, kind: EventKind, title: &'static str) -> Event {
    Event::new(Protocol::DeviceNet, record, kind, title)
}

/// A service; a request names its object by 8-bit class and instance, as slaves of the predefined set use.
fn service_event(record: &TraceRecord, kind: EventKind, body: &[u8], is_request: bool) -> Event {
    let service = body.first().copied().unwrap_or_default() & 0x7F;
    let class = if is_request { body.get(1).map(|class| u16::from(*class)) } else { None };
    let title =
        names::service(service, class).or_else(|| names::service(service, Some(3)).filter(|_| !is_request));
    let title = title.map_or_else(|| format!("service {service:02X}").into(), std::borrow::Cow::Borrowed);
    let mut event = Event::new(Protocol::DeviceNet, record, kind, title);
    event.fields.push(Field::hex("service", service, 2));
    if let (true, [_, class, instance, parameters @ ..]) = (is_request, body) {
        event.fields.push(Field::hex("class", *class, 2).meaning(names::class((*class).into())));
        event.fields.push(Field::number("instance", *instance));
        match (service, parameters) {
            (0x0E | 0x10, [attribute, value @ ..]) => {
                event.fields.push(Field::number("attribute", *attribute));
                if !value.is_empty() {
                    event.fields.push(Field::bytes("set_to", value));
                }
            }
            (0x4B, [choice, master, ..]) if *class == 3 => {
                event.fields.push(Field::hex("allocation", *choice, 2).meaning(Some(allocation(*choice))));
                event.fields.push(Field::number("master", *master));
            }
            (0x4C, [choice, ..]) if *class == 3 => {
                event.fields.push(Field::hex("allocation", *choice, 2).meaning(Some(allocation(*choice))));
            }
            (_, []) => {}
            (_, parameters) => event.fields.push(Field::bytes("parameters", parameters)),
        }
    }
    event
}

/// The connections that a master allocates in a slave.
fn allocation(choice: u8) -> String {
    const BITS: [&str; 7] = [
        "explicit",
        "polled",
        "bit-strobed",
        "multicast polled",
        "change of state",
        "cyclic",
        "acknowledgement suppressed",
    ];
    let set = BITS.iter().enumerate().filter(|(bit, _)| choice >> bit & 1 == 1).map(|(_, name)| *name);
    set.collect::<Vec<_>>().join(", ")
}

fn unanswered(channel: u8, server: u8, asked: Message, trouble: Trouble) -> Event {
    let record = TraceRecord {
        time_ns: asked.time_ns,
        device_ns: None,
        channel,
        event: cantap_trace::TraceEvent::GAP,
    };
    let mut event = service_event(&record, EventKind::NoResponse, &asked.body, true);
    (event.from, event.to) = parties(server, asked.other, false);
    event.start_ns = asked.start_ns;
    event.frames = asked.frames;
    event.fields.push(Field::text("response", "none"));
    event.trouble = Some(trouble);
    event.frames_lost = asked.frames_lost;
    event.data = asked.body;
    event
}

impl Assembler for DeviceNet {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if record.time_ns >= self.sweep_ns {
            self.sweep(record.time_ns, events);
        }
        let Some(frame) = record.frame() else {
            if is_gap(&record.event) {
                for (_, node) in self.nodes.iter_mut().filter(|((channel, _), _)| *channel == record.channel)
                {
                    let open = node.open.iter_mut().flatten().chain(&mut node.waiting);
                    open.for_each(|message| message.frames_lost = true);
                }
            }
            return;
        };
        if !frame.id().is_extended() && !frame.is_remote() {
            self.frame(record, frame.id().raw() as u16, frame.data(), events);
        }
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        let from = events.len();
        for (&(channel, server), node) in &mut self.nodes {
            if let Some(asked) = node.waiting.take() {
                events.push(unanswered(channel, server, asked, Trouble::Unfinished));
            }
            for (place, open) in node.open.iter_mut().enumerate() {
                if let Some(message) = open.take() {
                    let record = TraceRecord {
                        time_ns: message.time_ns,
                        device_ns: None,
                        channel,
                        event: cantap_trace::TraceEvent::GAP,
                    };
                    let mut event = event(&record, EventKind::Broken, "explicit message");
                    (event.from, event.to) = parties(server, message.other, place == 1);
                    (event.start_ns, event.frames) = (message.start_ns, message.frames);
                    event.fields.push(Field::bytes("received", &message.body));
                    event.frames_lost = message.frames_lost;
                    event.trouble = Some(Trouble::Unfinished);
                    events.push(event);
                }
            }
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel, event.to.node()));
    }
}
