//! DroneCAN (UAVCAN v0) and Cyphal (UAVCAN v1): transfers of one frame and of many, messages with their values by their data types,
//! requests with their responses, and whether nodes are still there.
//!
//! Memory: 1024 identifiers with transfers in progress, each of at most 64 KiB, 256 waiting requests, and 128 nodes on each channel.

mod header;
mod message;
mod nodes;
mod registers;
mod signs;
#[cfg(test)]
mod tests;
mod transfers;

use std::collections::VecDeque;
use std::sync::Arc;

use cantap_trace::TraceRecord;

use self::header::{Header, Purpose, Tail};
use self::nodes::Nodes;
use self::registers::Registers;
use self::transfers::{Part, Transfer, Transfers};
use crate::dsdl::{DataTypes, Generation};
use crate::{Assembler, Event, EventKind, Field, Party, Protocol, Trouble, UnderWay, is_gap};

pub(crate) use self::nodes::{node_name, parameter, state};
pub(crate) use self::signs::UavcanSigns;

/// How long a response may take; the implementations of both projects wait as long by default.
const RESPONSE_NS: i64 = 1_000_000_000;
const MOST_REQUESTS: usize = 256;
/// How often to look for what did not come.
const SWEEP_NS: i64 = 100_000_000;

/// Decodes a bus of one of the two.
pub(crate) struct Uavcan {
    generation: Generation,
    types: Arc<DataTypes>,
    transfers: Transfers,
    /// In the order in which they ended.
    requests: VecDeque<Request>,
    nodes: Nodes,
    registers: Registers,
    sweep_ns: i64,
    done: Vec<Transfer>,
}

/// A request that waits for its response.
struct Request {
    transfer: Transfer,
    title: String,
    fields: Vec<Field>,
}

impl Uavcan {
    /// With these data types.
    pub fn new(generation: Generation, types: Arc<DataTypes>) -> Self {
        Self {
            generation,
            types,
            transfers: Transfers::new(generation),
            requests: VecDeque::new(),
            nodes: Nodes::new(generation),
            registers: Registers::default(),
            sweep_ns: i64::MIN,
            done: Vec::new(),
        }
    }

    const fn protocol(&self) -> Protocol {
        match self.generation {
            Generation::DroneCan => Protocol::DroneCan,
            Generation::Cyphal => Protocol::Cyphal,
        }
    }

    /// An event of a transfer.
    fn event(&self, transfer: &Transfer, kind: EventKind, title: String, fields: Vec<Field>) -> Event {
        let (from, to) = transfer.parties();
        Event {
            time_ns: transfer.time_ns,
            start_ns: transfer.start_ns,
            channel: transfer.channel,
            protocol: self.protocol(),
            from,
            to,
            kind,
            title: title.into(),
            fields,
            data: transfer.payload.clone(),
            response_ns: None,
            frames: transfer.frames,
            trouble: transfer.trouble,
            frames_lost: transfer.frames_lost,
        }
    }

    fn ended(&mut self, mut transfer: Transfer, events: &mut Vec<Event>) {
        let mut fields = Vec::new();
        let learned = self.registers.type_of(transfer.channel, transfer.header, &self.types);
        let title = message::describe(self.generation, &self.types, learned, &mut transfer, &mut fields);
        if !message::is_whole(transfer.trouble) {
            events.push(self.event(&transfer, EventKind::Broken, title, fields));
            return;
        }
        match transfer.header.purpose {
            Purpose::Message => {
                let mut event = self.event(&transfer, EventKind::Message, title, fields);
                let back = self.nodes.take(&transfer, &mut event);
                events.push(event);
                events.extend(back);
            }
            Purpose::Request => self.request(Request { transfer, title, fields }, events),
            Purpose::Response => {
                let event = self.response(&transfer, title, fields);
                self.registers.take(&event);
                events.push(event);
            }
        }
    }

    fn request(&mut self, request: Request, events: &mut Vec<Event>) {
        let again = self.requests.iter().position(|waiting| waiting.is_asked_by(&request.transfer));
        let again = again.and_then(|at| self.requests.remove(at));
        events.extend(again.map(|before| self.unanswered(before, Trouble::Overlapped)));
        if self.requests.len() == MOST_REQUESTS
            && let Some(oldest) = self.requests.pop_front()
        {
            events.push(self.unanswered(oldest, Trouble::GivenUp));
        }
        self.requests.push_back(request);
    }

    fn response(&mut self, transfer: &Transfer, title: String, fields: Vec<Field>) -> Event {
        let asked = self.requests.iter().position(|waiting| waiting.is_answered_by(transfer));
        let Some(request) = asked.and_then(|at| self.requests.remove(at)) else {
            let mut event = self.event(transfer, EventKind::Response, title, fields);
            event.fields.push(Field::text("request", "not heard"));
            return event;
        };
        let asked = request.transfer;
        // What the request had, then what only the response has.
        let mut all = request.fields;
        all.extend(fields.into_iter().skip(message::COMMON_FIELDS));
        let mut event = self.event(transfer, EventKind::Exchange, title, all);
        (event.from, event.to) = asked.parties();
        event.start_ns = asked.start_ns;
        event.frames += asked.frames;
        event.frames_lost |= asked.frames_lost;
        event.trouble = asked.trouble.or(event.trouble);
        event.response_ns = Some(transfer.start_ns.saturating_sub(asked.time_ns));
        event
    }

    fn unanswered(&self, mut request: Request, trouble: Trouble) -> Event {
        request.transfer.trouble = Some(trouble);
        let mut event = self.event(&request.transfer, EventKind::NoResponse, request.title, request.fields);
        event.fields.push(Field::text("response", "none"));
        event
    }

    fn sweep(&mut self, now_ns: i64, events: &mut Vec<Event>) {
        self.sweep_ns = now_ns.saturating_add(SWEEP_NS);
        let from = events.len();
        let mut late = Vec::new();
        self.transfers.sweep(now_ns, &mut late);
        for transfer in late {
            self.ended(transfer, events);
        }
        while let Some(oldest) = self.requests.front()
            && now_ns.saturating_sub(oldest.transfer.time_ns) > RESPONSE_NS
            && let Some(mut oldest) = self.requests.pop_front()
        {
            oldest.transfer.time_ns = oldest.transfer.time_ns.saturating_add(RESPONSE_NS);
            let after_ms = (RESPONSE_NS / 1_000_000) as u32;
            events.push(self.unanswered(oldest, Trouble::Timeout { after_ms }));
        }
        let protocol = self.protocol();
        self.nodes.sweep(now_ns, protocol, events);
        events[from..].sort_by_key(|event| (event.time_ns, event.channel));
    }
}

impl Request {
    /// The same number from the same client to the same server.
    fn is_asked_by(&self, other: &Transfer) -> bool {
        let (own, of) = (&self.transfer.header, &other.header);
        (self.transfer.channel, self.transfer.id, own.port) == (other.channel, other.id, of.port)
            && (own.source, own.destination) == (of.source, of.destination)
    }

    fn is_answered_by(&self, other: &Transfer) -> bool {
        let (own, of) = (&self.transfer.header, &other.header);
        (self.transfer.channel, self.transfer.id, own.port) == (other.channel, other.id, of.port)
            && (own.source, own.destination) == (of.destination, of.source)
    }
}

impl Assembler for Uavcan {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if record.time_ns >= self.sweep_ns {
            self.sweep(record.time_ns, events);
        }
        let Some(frame) = record.frame() else {
            if is_gap(&record.event) {
                self.transfers.gap(record.channel);
                self.nodes.gap(record.channel, record.time_ns);
                let waiting = self.requests.iter_mut();
                for request in waiting.filter(|request| request.transfer.channel == record.channel) {
                    request.transfer.frames_lost = true;
                }
            }
            return;
        };
        let Some(header) = Header::of(frame.id(), self.generation) else { return };
        let Some((tail, payload)) = Tail::of(frame.data()) else { return };
        let part = Part {
            channel: record.channel,
            time_ns: record.time_ns,
            id: frame.id().raw(),
            header,
            tail,
            payload,
            is_fd: frame.is_fd(),
        };
        let mut done = std::mem::take(&mut self.done);
        self.transfers.take(part, &mut |transfer| done.push(transfer));
        for transfer in done.drain(..) {
            self.ended(transfer, events);
        }
        self.done = done;
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        let from = events.len();
        let mut open = Vec::new();
        self.transfers.finish(&mut open);
        for transfer in open {
            self.ended(transfer, events);
        }
        for request in std::mem::take(&mut self.requests) {
            events.push(self.unanswered(request, Trouble::Unfinished));
        }
        events[from..].sort_by_key(|event| (event.time_ns, event.channel));
    }

    fn under_way(&self, under_way: &mut Vec<UnderWay>) {
        under_way.extend(self.transfers.open().map(|open| {
            let (from, to): (Party, Party) = open.parties();
            UnderWay {
                channel: open.channel,
                protocol: self.protocol(),
                from,
                to,
                start_ns: open.start_ns,
                received: open.payload.len() as u32,
                length: None,
            }
        }));
    }
}
