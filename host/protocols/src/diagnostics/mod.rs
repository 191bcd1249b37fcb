//! Diagnostics: UDS (ISO 14229), KWP2000 services (ISO 14230-3) and OBD-II (SAE J1979), over ISO 15765-2.
//!
//! A request and its response are one event. Unanswered requests, unrequested responses and broken transfers are separate
//! events.
//!
//! A positive response repeats parts of its request. One that repeats something else is not the response, and is shown as one
//! whose request was not heard; the request goes on waiting, as its sender does.
//!
//! A message of a service that no standard names may be anything, and is shown as a transfer. If it is refused, as in a scan of all
//! services, it was a request.
//!
//! Memory: that of [`crate::iso_tp`], 256 requests waiting for their responses, 64 that no longer do, and 64 messages that may have
//! been requests.

mod authentication;
mod cursor;
mod described;
mod dialect;
mod dtc;
pub(crate) mod echo;
mod events;
mod files;
mod meanings;
mod monitors;
pub(crate) mod names;
mod obd;
mod obd_identifiers;
mod parameters;
mod periodic;
mod reports;
mod scaling;
#[cfg(test)]
mod tests;
mod uds;
mod unnamed;
mod values;

pub use dtc::Dtc;
pub(crate) use echo::repeats_its_request;
pub use names::{reason, uds_service};
pub use obd_identifiers::data_identifier;
pub use parameters::name as parameter_name;
pub(crate) use uds::is_response_suppressed;

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use cantap_trace::TraceRecord;

use self::described::{Parts, describe};
use self::dialect::Dialects;
use self::periodic::Periodic;
use self::unnamed::Unnamed;
use crate::iso_tp::{Endpoint, KnownPairs, Transfer, Transport};
use crate::odx::Descriptions;
use crate::{Assembler, Event, EventKind, Field, Party, Protocol, Trouble, UnderWay, is_gap};

/// How many requests may wait for a response at a time.
const MOST_WAITING: usize = 256;
/// How long to wait for a response. ISO 14229-2 has 50 ms for the server, plus the same again for the network, as far as a client
/// allows; no client waits longer than this.
const RESPONSE_NS: i64 = 2_000_000_000;
/// The same after the server has said that the response is pending: P2* is 5 s by default.
const PENDING_NS: i64 = 10_000_000_000;
const RESPONSE_PENDING: u8 = 0x78;
/// How many requests that were given up are kept, and how long, in case that their responses come after all.
const MOST_LATE: usize = 64;
const LATE_NS: i64 = 60_000_000_000;
/// How many requests that had their answer are kept.
const MOST_ANSWERED: usize = 8;
/// How long after its last frame a response may still be under way: longer than [`crate::iso_tp`] waits for the next frame.
const UNDER_WAY_NS: i64 = 1_200_000_000;
/// How many servers may have said, for one request, that their response is pending.
const MOST_PENDING: usize = 64;

/// A waiting request.
#[derive(Clone, Debug)]
struct Waiting {
    request: Transfer,
    /// A positive response was requested. If not, negative responses and pending ones still come.
    is_wanted: bool,
    /// The servers that said that the response is pending and have not answered since, and how often.
    pending: Vec<(Endpoint, u32)>,
    until_ns: i64,
    /// Number of responses so far; a request to all may have several.
    answers: u32,
    frames_lost: bool,
}

/// A request's state when this response came.
struct Answered {
    request: Transfer,
    pending: u32,
    frames_lost: bool,
}

/// Combines transfers into requests with their responses.
#[derive(Clone, Debug, Default)]
pub struct Diagnostics {
    transport: Transport,
    waiting: VecDeque<Waiting>,
    /// Requests that were given up.
    late: VecDeque<Transfer>,
    /// The last requests that had their answer, in case that others answer them as well.
    answered: VecDeque<Transfer>,
    unnamed: Unnamed,
    periodic: Periodic,
    /// No request times out before this time.
    due_ns: i64,
    dialects: Dialects,
    transfers: Vec<Transfer>,
    descriptions: Option<Arc<Descriptions>>,
}

impl Diagnostics {
    /// With pairs that are known on all channels; `finds` enables the search for others.
    pub fn new(pairs: &[KnownPairs], finds: bool) -> Self {
        Self { transport: Transport::new(pairs, finds), ..Self::default() }
    }

    /// With descriptions of ECUs, from which names and values of their services come.
    #[must_use]
    pub fn with_descriptions(mut self, descriptions: Option<Arc<Descriptions>>) -> Self {
        self.descriptions = descriptions;
        self
    }

    /// Takes a transfer, which may have been heard before the last record.
    fn take_transfer(&mut self, transfer: Transfer, events: &mut Vec<Event>) {
        if self.due_ns < transfer.start_ns {
            self.expire(transfer.start_ns, events);
        }
        if let Some(server) = self.transport.server_of_tp20(transfer.channel, transfer.from) {
            self.dialects.assume_kwp(transfer.channel, server);
        }
        if transfer.after_loss {
            let sides = [Some(transfer.from), transfer.to];
            for waiting in &mut self.waiting {
                let is_its = waiting.request.channel == transfer.channel
                    && (sides.contains(&Some(waiting.request.from)) || sides.contains(&waiting.request.to));
                waiting.frames_lost |= is_its;
            }
        }
        self.transfer(transfer, events);
    }

    fn transfer(&mut self, transfer: Transfer, events: &mut Vec<Event>) {
        let Some(&sid) = transfer.data.first().filter(|_| transfer.is_whole()) else {
            events.push(transfer.into());
            return;
        };
        if let Some((did, data)) = self.periodic.data(&transfer)
            && (sid & 0x40 == 0 || self.asked(&transfer, sid & !0x40).is_none())
            && (sid != 0x7F || transfer.data.len() != 3)
        {
            events.push(periodic_event(&transfer, did, data));
        } else if sid == 0x7F && transfer.data.len() >= 3 {
            self.refusal(&transfer, events);
        } else if sid & 0x40 == 0 && self.service(&transfer, sid).is_some() {
            self.request(transfer, events);
        } else if sid & 0x40 != 0
            && (self.service(&transfer, sid & !0x40).is_some()
                || self.asked(&transfer, sid & !0x40).is_some())
        {
            self.response(&transfer, events);
        } else {
            if sid & 0x40 == 0 {
                let to = transfer.to.or_else(|| self.transport.partner(transfer.channel, transfer.from));
                self.unnamed.keep(Transfer { to, ..transfer.clone() });
            }
            events.push(transfer.into());
        }
    }

    /// The protocol and name of a service for the pair of this transfer.
    fn service(&self, transfer: &Transfer, sid: u8) -> Option<(Protocol, Cow<'static, str>)> {
        service(self.is_kwp(transfer), sid)
    }

    /// Whether the server of this transfer, its sender or its receiver, speaks KWP2000.
    fn is_kwp(&self, transfer: &Transfer) -> bool {
        self.dialects.is_kwp(transfer.channel, transfer.from, transfer.to)
    }

    fn request(&mut self, mut transfer: Transfer, events: &mut Vec<Event>) {
        let sid = transfer.data[0];
        transfer.to = transfer.to.or_else(|| self.transport.partner(transfer.channel, transfer.from));
        let is_uds = self.service(&transfer, sid).is_some_and(|(protocol, _)| protocol == Protocol::Uds);
        // KWP2000 has a separate value for it (ISO 14230-3, 6.4).
        let is_wanted =
            !(is_uds && uds::is_response_suppressed(&transfer.data) || transfer.data[..] == [0x3E, 0x02]);
        if !is_wanted {
            let mut event = self.event(&transfer, None, EventKind::Request);
            event.fields.push(Field::text("response", "not wanted"));
            events.push(event);
        }
        // A client that asks again no longer waits for the first answer. Requests that want no response may come
        // in between.
        let same = |waiting: &Waiting| {
            let before = &waiting.request;
            (before.channel, before.from, before.to) == (transfer.channel, transfer.from, transfer.to)
                && (waiting.is_wanted == is_wanted)
                && (is_wanted || before.data.first() == Some(&sid))
        };
        if let Some(place) = self.waiting.iter().position(same) {
            self.give_up(place, Trouble::Overlapped, events);
        }
        self.wait_for(transfer, is_wanted, events);
    }

    fn wait_for(&mut self, request: Transfer, is_wanted: bool, events: &mut Vec<Event>) {
        if self.waiting.len() == MOST_WAITING {
            self.give_up(0, Trouble::GivenUp, events);
        }
        let until_ns = request.time_ns.saturating_add(RESPONSE_NS);
        self.due_ns = self.due_ns.min(until_ns);
        let frames_lost = request.frames_lost;
        let pending = Vec::new();
        self.waiting.push_back(Waiting { request, is_wanted, pending, until_ns, answers: 0, frames_lost });
    }

    /// The message of an unnamed service that is refused here, from now on among those that wait.
    fn refused_unnamed(&mut self, response: &Transfer, sid: u8, events: &mut Vec<Event>) -> Option<usize> {
        let request = self.unnamed.take(response, sid, RESPONSE_NS)?;
        self.wait_for(request, true, events);
        self.waiting.len().checked_sub(1)
    }

    /// A request that had an answer from the only server that was known to have it, until another one answered it: it was to all, and
    /// waits again.
    fn asked_of_others_too(
        &mut self,
        response: &Transfer,
        sid: u8,
        events: &mut Vec<Event>,
    ) -> Option<usize> {
        let place = self.answered.iter().rposition(|request| {
            response.start_ns.saturating_sub(request.time_ns) <= RESPONSE_NS
                && request.to.is_some_and(|to| to != response.from)
                && self.is_answer(request, response, sid)
                && self.transport.is_to_all(request.channel, request.from)
        })?;
        let request = Transfer { to: None, ..self.answered.remove(place)? };
        self.wait_for(request, true, events);
        if let Some(waiting) = self.waiting.back_mut() {
            waiting.answers = 1;
        }
        self.waiting.len().checked_sub(1)
    }

    /// The request that a response to `sid` belongs to.
    fn asked(&self, response: &Transfer, sid: u8) -> Option<usize> {
        let of_channel = |waiting: &Waiting| self.is_answer(&waiting.request, response, sid);
        let physical = |waiting: &Waiting| of_channel(waiting) && waiting.request.to == Some(response.from);
        let functional = |waiting: &Waiting| {
            of_channel(waiting)
                && waiting.request.to.is_none()
                && waiting.request.from.id.is_extended() == response.from.id.is_extended()
        };
        // The last one of its kind: an earlier one that wanted no response may still be there.
        self.waiting.iter().rposition(physical).or_else(|| self.waiting.iter().rposition(functional))
    }

    /// Whether a response to `sid` may be one to this request, by service and content.
    fn is_answer(&self, request: &Transfer, response: &Transfer, sid: u8) -> bool {
        request.channel == response.channel
            && request.data.first() == Some(&sid)
            && (response.data[0] == 0x7F || {
                let is_kwp = self.dialects.is_kwp(request.channel, response.from, None);
                repeats_its_request(is_kwp, &request.data, &response.data) != Some(false)
            })
    }

    fn response(&mut self, transfer: &Transfer, events: &mut Vec<Event>) {
        let sid = transfer.data[0] & !0x40;
        let asked = self.asked(transfer, sid);
        let Some(place) = asked.or_else(|| self.asked_of_others_too(transfer, sid, events)) else {
            let event = self.unasked(transfer, sid);
            events.push(event);
            return;
        };
        let answered = self.answered(place, transfer.from);
        self.dialects.learn(transfer.channel, transfer.from, &answered.request.data, &transfer.data);
        self.periodic.learn(transfer.channel, transfer.from, &answered.request.data);
        events.push(self.event(&answered.request, Some((transfer, &answered)), EventKind::Exchange));
    }

    /// The request's state until now; one to a single server stops waiting.
    fn answered(&mut self, place: usize, by: Endpoint) -> Answered {
        let waiting = &mut self.waiting[place];
        waiting.answers += 1;
        let said = waiting.pending.iter().position(|(server, _)| *server == by);
        let pending = said.map_or(0, |place| waiting.pending.swap_remove(place).1);
        let frames_lost = waiting.frames_lost;
        if waiting.request.to.is_some()
            && let Some(waiting) = self.waiting.remove(place)
        {
            if self.answered.len() == MOST_ANSWERED {
                self.answered.pop_front();
            }
            self.answered.push_back(waiting.request.clone());
            return Answered { request: waiting.request, pending, frames_lost };
        }
        Answered { request: self.waiting[place].request.clone(), pending, frames_lost }
    }

    fn refusal(&mut self, transfer: &Transfer, events: &mut Vec<Event>) {
        let (sid, nrc) = (transfer.data[1], transfer.data[2]);
        let asked = self.asked(transfer, sid);
        let asked = asked.or_else(|| self.asked_of_others_too(transfer, sid, events));
        let Some(place) = asked.or_else(|| self.refused_unnamed(transfer, sid, events)) else {
            let event = self.unasked(transfer, sid);
            events.push(event);
            return;
        };
        if nrc == RESPONSE_PENDING {
            let waiting = &mut self.waiting[place];
            match waiting.pending.iter().position(|(server, _)| *server == transfer.from) {
                Some(place) => waiting.pending[place].1 += 1,
                None if waiting.pending.len() < MOST_PENDING => waiting.pending.push((transfer.from, 1)),
                None => {}
            }
            waiting.until_ns = transfer.time_ns.saturating_add(PENDING_NS);
            return;
        }
        let answered = self.answered(place, transfer.from);
        let mut event = self.event(&answered.request, Some((transfer, &answered)), EventKind::Exchange);
        event.kind = EventKind::Refusal;
        events.push(event);
        self.dialects.learn(transfer.channel, transfer.from, &answered.request.data, &transfer.data);
    }

    /// A response whose request was not observed, or no longer waits for it.
    fn unasked(&mut self, transfer: &Transfer, sid: u8) -> Event {
        let mut event = self.event(transfer, None, EventKind::Response);
        let late = self.late.iter().position(|request| {
            transfer.start_ns.saturating_sub(request.time_ns) <= LATE_NS
                && request.to.is_none_or(|to| to == transfer.from)
                && request.from.id.is_extended() == transfer.from.id.is_extended()
                && self.is_answer(request, transfer, sid)
        });
        // Several may answer a request to all.
        if let Some(place) = late.filter(|place| self.late[*place].to.is_some()) {
            self.late.remove(place);
        }
        let heard = if late.is_some() { "given up before" } else { "not heard" };
        event.fields.push(Field::text("request", heard));
        event
    }

    /// One transfer, or a request with its response, as an event.
    fn event(&self, first: &Transfer, response: Option<(&Transfer, &Answered)>, kind: EventKind) -> Event {
        let refused = |data: &[u8]| data[0] == 0x7F && data.len() >= 3;
        let sid = if refused(&first.data) { first.data[1] } else { first.data[0] & !0x40 };
        let is_kwp = self.is_kwp(first) || response.is_some_and(|(response, _)| self.is_kwp(response));
        let (protocol, title) =
            service(is_kwp, sid).unwrap_or_else(|| (Protocol::Uds, format!("service {sid:02X}").into()));
        let mut fields = vec![Field::hex("sid", sid, 2)];
        let before = fields.len();
        let is_request = first.data[0] & 0x40 == 0;
        if is_request {
            // Parts of the request that an OBD response repeats are shown once.
            let positive = response.is_some_and(|(response, _)| !refused(&response.data));
            match protocol {
                Protocol::Obd if positive && matches!(sid, 1 | 2 | 6 | 9) => {}
                Protocol::Obd => obd::request(sid, &first.data[1..], &mut fields),
                Protocol::Kwp2000 => uds::kwp_request(&first.data, &mut fields),
                _ => uds::request(&first.data, &mut fields),
            }
        }
        let parts = Parts { before, request_end: fields.len() };
        let answer = response.map(|(response, _)| response).or((!is_request).then_some(first));
        if let Some(answer) = answer {
            let data = &answer.data;
            if refused(data) {
                fields.push(Field::hex("nrc", data[2], 2).meaning(Some(reason(data[2]))));
            } else {
                match protocol {
                    Protocol::Obd => obd::response(sid, &data[1..], &mut fields),
                    Protocol::Kwp2000 => uds::kwp_response(is_request, data, &mut fields),
                    _ => uds::response(is_request.then_some(&first.data), data, &mut fields),
                }
            }
        }
        let mut event = Event {
            time_ns: first.time_ns,
            start_ns: first.start_ns,
            channel: first.channel,
            protocol,
            from: first.from.into(),
            to: first.to.map_or(Party::Everyone, Party::from),
            kind,
            title,
            fields,
            data: first.data.clone(),
            response_ns: None,
            frames: first.frames,
            trouble: None,
            frames_lost: first.frames_lost,
        };
        if !is_request && first.to.is_none() {
            event.to = Party::Unknown;
        }
        if let Some(descriptions) = &self.descriptions {
            describe(descriptions, is_request.then_some(first), answer, &parts, &mut event);
        }
        if let Some((response, answered)) = response {
            if answered.pending > 0 {
                event.fields.push(Field::number("pending", answered.pending).unit("times"));
            }
            // To all: the important party is the one that answered.
            if first.to.is_none() {
                event.to = response.from.into();
                event.fields.push(Field::text("asked", "all"));
            }
            event.time_ns = response.time_ns;
            event.response_ns = Some(response.start_ns.saturating_sub(first.time_ns));
            event.frames += response.frames;
            event.frames_lost |= answered.frames_lost || response.frames_lost;
            event.data.clone_from(&response.data);
        }
        event
    }

    /// The request at this index remains unanswered.
    fn give_up(&mut self, place: usize, trouble: Trouble, events: &mut Vec<Event>) {
        let Some(mut waiting) = self.waiting.remove(place) else { return };
        if waiting.is_wanted && matches!(trouble, Trouble::Timeout { .. } | Trouble::Overlapped) {
            if self.late.len() == MOST_LATE {
                self.late.pop_front();
            }
            self.late.push_back(waiting.request.clone());
        }
        // A server that said that the response is pending owes one, whatever others have answered.
        let mut silent: Vec<_> = waiting.pending.drain(..).map(|(by, times)| (Some(by), times)).collect();
        if silent.is_empty() && waiting.is_wanted && waiting.answers == 0 {
            silent.push((None, 0));
        }
        for (by, pending) in silent {
            let mut event = self.event(&waiting.request, None, EventKind::NoResponse);
            event.fields.push(Field::text("response", "none"));
            if pending > 0 {
                event.fields.push(Field::number("pending", pending).unit("times"));
            }
            if let (None, Some(by)) = (waiting.request.to, by) {
                event.to = by.into();
                event.fields.push(Field::text("asked", "all"));
            }
            if let Trouble::Timeout { .. } = trouble {
                event.time_ns = waiting.until_ns;
            }
            event.trouble = Some(trouble);
            event.frames_lost |= waiting.frames_lost;
            events.push(event);
        }
    }

    /// Whether a message that began in time is on its way from whom the request was to.
    fn is_being_answered(&self, waiting: &Waiting) -> bool {
        let Waiting { request, until_ns, .. } = waiting;
        self.transport.has_begun(request.channel, request.time_ns..=*until_ns, |from| match request.to {
            Some(to) => to == from,
            None => request.from.id.is_extended() == from.id.is_extended() && request.from != from,
        })
    }

    fn expire(&mut self, now_ns: i64, events: &mut Vec<Event>) {
        while let Some(place) = self.waiting.iter().position(|waiting| waiting.until_ns < now_ns) {
            let waiting = &self.waiting[place];
            if self.is_being_answered(waiting) {
                self.waiting[place].until_ns = now_ns.saturating_add(UNDER_WAY_NS);
                continue;
            }
            let waited = if waiting.pending.is_empty() { RESPONSE_NS } else { PENDING_NS };
            self.give_up(place, Trouble::Timeout { after_ms: (waited / 1_000_000) as u32 }, events);
        }
        self.due_ns = self.waiting.iter().map(|waiting| waiting.until_ns).min().unwrap_or(i64::MAX);
    }
}

/// The protocol and name of a service.
fn service(is_kwp: bool, sid: u8) -> Option<(Protocol, Cow<'static, str>)> {
    if names::obd_service(sid).is_some() {
        return Some((Protocol::Obd, obd::title(sid).into()));
    }
    if let Some(name) = names::kwp_only_service(sid) {
        return Some((Protocol::Kwp2000, name.into()));
    }
    if is_kwp {
        return names::kwp_service(sid).map(|name| (Protocol::Kwp2000, name.into()));
    }
    names::uds_service(sid).map(|name| (Protocol::Uds, name.into()))
}

/// Data that a server sends by itself.
fn periodic_event(transfer: &Transfer, did: u16, data: &[u8]) -> Event {
    let mut event = Event::from(transfer.clone());
    event.protocol = Protocol::Uds;
    event.kind = EventKind::Periodic;
    event.title = "periodic data".into();
    event.fields = vec![Field::hex("did", did, 4).meaning(data_identifier(did))];
    if !data.is_empty() {
        event.fields.push(Field::bytes("value", data));
    }
    event
}

impl Assembler for Diagnostics {
    fn take(&mut self, record: &TraceRecord, events: &mut Vec<Event>) {
        if self.due_ns < record.time_ns {
            self.expire(record.time_ns, events);
        }
        if is_gap(&record.event) {
            for waiting in self.waiting.iter_mut().filter(|waiting| waiting.request.channel == record.channel)
            {
                waiting.frames_lost = true;
            }
            self.unnamed.frames_lost(record.channel);
        }
        let mut transfers = std::mem::take(&mut self.transfers);
        self.transport.take(record, &mut |transfer| transfers.push(transfer));
        for transfer in transfers.drain(..) {
            self.take_transfer(transfer, events);
        }
        self.transfers = transfers;
    }

    fn finish(&mut self, events: &mut Vec<Event>) {
        let mut transfers = std::mem::take(&mut self.transfers);
        self.transport.finish(&mut |transfer| transfers.push(transfer));
        for transfer in transfers {
            self.take_transfer(transfer, events);
        }
        while !self.waiting.is_empty() {
            self.give_up(0, Trouble::Unfinished, events);
        }
    }

    fn under_way(&self, out: &mut Vec<UnderWay>) {
        self.transport.under_way(out);
    }
}
