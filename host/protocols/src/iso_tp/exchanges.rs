//! Finds pairs by what they say in single frames: a request of diagnostics, and an answer of its service from another identifier in
//! time.
//!
//! Most requests and many answers fit into one frame, so a pair may talk for hours without a message of many frames. Frames that may be
//! theirs are kept, so that nothing of a conversation is missing when it has been recognised.
//!
//! False claims are prevented by four things. A message must have exactly the length that it says, with equal bytes behind it; a
//! sender that sends anything else in between is forgotten; an answer has to repeat of its request what its service repeats; and how
//! much of that there is decides how often it must happen ([`CONVINCING`]).
//!
//! Memory: [`MOST_SENDERS`] senders, with [`MOST_HELD`] frames each, and [`MOST_REQUESTS`] requests.

use std::collections::VecDeque;
use std::ops::RangeInclusive;

use cantap_trace::{Id, TraceRecord};
use smallvec::SmallVec;

use super::makers::{self, Rule};
use super::marks::Marks;
use super::pairs::Endpoint;
use super::pci::{self, Pci};
use crate::diagnostics::echo::repeats_its_request;
use crate::diagnostics::names;

/// How long an answer may take, in nanoseconds: P2 of ISO 14229-2 is 50 ms, and networks between the tester and the server as much
/// again; twice of that for stamps that were made late.
const ANSWER_NS: i64 = 200_000_000;
/// The same after the server has said that its answer is pending: P2* is 5 s.
const PENDING_NS: i64 = 5_000_000_000;
/// After so long, a request of a known tester has no answer.
const SILENCE_NS: i64 = 2_000_000_000;
/// How often to look for those.
const LOOK_EVERY_NS: i64 = 500_000_000;
/// How much evidence makes a pair, see [`evidence`].
const CONVINCING: u8 = 3;
/// The same for addresses that are in no table and do not fit their identifiers: any frame has a byte that may be an address.
const CONVINCING_WITH_ADDRESS: u8 = 6;
/// What it counts that a maker's table or the rule of addresses has this pair.
const EXPECTED: u8 = 2;
pub(super) const MOST_SENDERS: usize = 128;
const MOST_HELD: usize = 32;
const MOST_REQUESTS: usize = 32;
/// Bytes of a request that are kept to compare with its answer.
const MOST_ASKED: usize = 8;

/// A pair that has been recognised, or a request to all (without a server).
pub(super) struct Found {
    pub channel: u8,
    pub client: Endpoint,
    pub server: Option<Endpoint>,
    /// Frames of them that have not been read, in order.
    pub held: Vec<Held>,
}

/// A frame that has not been read.
#[derive(Clone, Debug)]
pub(super) struct Held {
    pub record: TraceRecord,
    /// Frames of the channel were lost between this one and the sender's last.
    pub after_loss: bool,
    /// Its number among all that were held: stamps may be equal.
    number: u64,
}

/// Somebody who may be one side of a pair.
#[derive(Clone, Debug)]
struct Sender {
    channel: u8,
    from: Endpoint,
    held: VecDeque<Held>,
    seen_ns: i64,
    /// Frames of the channel were lost after the last one that is held.
    has_gap: bool,
    /// Since when its request has not been answered.
    unanswered_ns: Option<i64>,
    /// Whose requests it seems to answer.
    links: SmallVec<[Link; 2]>,
}

/// Somebody's requests that a sender has answered.
#[derive(Clone, Debug)]
struct Link {
    client: Endpoint,
    evidence: u8,
    /// The last request and its answer.
    last: [SmallVec<[u8; MOST_ASKED]>; 2],
    /// When that was asked; `None` if its answer was that it is pending.
    answered_ns: Option<i64>,
}

/// The last request of somebody.
#[derive(Clone, Debug)]
struct Request {
    channel: u8,
    from: Endpoint,
    time_ns: i64,
    until_ns: i64,
    data: SmallVec<[u8; MOST_ASKED]>,
    client: Client,
    /// Whom it asks, if that is known and one.
    server: Option<Endpoint>,
}

/// What is known about the sender of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Client {
    /// Nothing.
    Unknown,
    /// It was found, or asks several: others may answer it, too.
    Open,
    /// It has its server.
    Closed,
}

/// Requests and answers of identifiers that belong to no pair.
#[derive(Clone, Debug, Default)]
pub(super) struct Exchanges {
    senders: Vec<Sender>,
    marks: Marks,
    requests: VecDeque<Request>,
    /// No request may still be answered after this.
    until_ns: i64,
    /// Number of frames that were held so far.
    count: u64,
    look_ns: i64,
    /// Rules of makers whose pairs need no evidence.
    given: Vec<&'static Rule>,
}

/// The role of a message.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    Request,
    Answer,
}

impl Exchanges {
    /// With a maker's rules that hold without evidence.
    pub fn give(&mut self, rules: impl Iterator<Item = &'static Rule>) {
        self.given.extend(rules);
    }

    /// Takes a frame whose sender is not known, with so many bytes of address before its control information.
    pub fn take(
        &mut self,
        record: &TraceRecord,
        id: Id,
        bytes: &[u8],
        readings: RangeInclusive<usize>,
    ) -> Option<Found> {
        if self.marks.may_have(id) {
            self.contradict(record.channel, id, bytes);
        }
        for offset in readings {
            let Some((role, message, is_whole)) = message(bytes, offset) else { continue };
            let from = Endpoint { id, address: (offset == 1).then(|| bytes[0]) };
            if !self.given.is_empty()
                && let Some(found) = self.by_rule(record, from, role)
            {
                return Some(found);
            }
            match role {
                Role::Request if is_whole => {
                    self.ask(record, from, message, Client::Unknown, None);
                    let sender = self.hold(record, from);
                    sender.unanswered_ns.get_or_insert(record.time_ns);
                }
                Role::Request => {}
                Role::Answer => {
                    let found = self.answer(record, from, message, is_whole);
                    if found.is_some() {
                        return found;
                    }
                    if is_whole {
                        self.hold(record, from);
                    }
                }
            }
        }
        None
    }

    /// Takes a message of a sender that is known; returns whose request it answers, if nobody knew them. `asks` says what is known
    /// about the sender, and whom it asks.
    pub fn take_known(
        &mut self,
        record: &TraceRecord,
        from: Endpoint,
        bytes: &[u8],
        asks: impl FnOnce() -> (Client, Option<Endpoint>),
    ) -> Option<Found> {
        let offset = usize::from(from.address.is_some());
        let (role, message, is_whole) = message(bytes, offset)?;
        match role {
            Role::Request if is_whole => {
                let (client, server) = asks();
                self.ask(record, from, message, client, server);
            }
            Role::Answer if record.time_ns <= self.until_ns => {
                // One that is known to ask this server may have asked the same.
                let is_others = |place: usize| {
                    let Request { client, server, .. } = &self.requests[place];
                    *client == Client::Unknown || server.is_some_and(|server| server != from)
                };
                if self.fitting(record, from, message).all(is_others)
                    && let Some(place) = self.asked(record, from, message, &[Client::Unknown])
                {
                    return Some(self.found(record.channel, self.requests[place].from, Some(from)));
                }
            }
            _ => {}
        }
        None
    }

    /// Requests of testers who are known to talk to others, and that nobody has answered, one at a time; `server` says whom a
    /// tester asks, if it is known to be one.
    pub fn unanswered(
        &mut self,
        now_ns: i64,
        server: impl Fn(u8, Endpoint) -> Option<Option<Endpoint>>,
    ) -> Option<Found> {
        if self.senders.is_empty() || now_ns < self.look_ns {
            return None;
        }
        let silent = self.senders.iter().find_map(|sender| {
            let is_silent =
                sender.unanswered_ns.is_some_and(|since| now_ns.saturating_sub(since) > SILENCE_NS);
            let server = is_silent.then(|| server(sender.channel, sender.from))??;
            Some((sender.channel, sender.from, server))
        });
        let Some((channel, client, server)) = silent else {
            self.look_ns = now_ns.saturating_add(LOOK_EVERY_NS);
            return None;
        };
        Some(self.found(channel, client, server))
    }

    /// Frames on the channel are missing.
    pub fn interrupt(&mut self, channel: u8) {
        for sender in self.senders.iter_mut().filter(|sender| sender.channel == channel) {
            sender.has_gap = true;
        }
    }

    /// What is held of both, from now on somebody else's.
    pub fn found(&mut self, channel: u8, client: Endpoint, server: Option<Endpoint>) -> Found {
        let is_one = |sender: &Sender| {
            sender.channel == channel && (sender.from == client || Some(sender.from) == server)
        };
        let mut held: Vec<_> =
            self.senders.extract_if(.., |sender| is_one(sender)).flat_map(|sender| sender.held).collect();
        held.sort_by_key(|held| held.number);
        self.mark();
        for request in self.requests.iter_mut().filter(|request| request.channel == channel) {
            if request.client == Client::Unknown && (request.from == client || Some(request.from) == server) {
                request.client = Client::Open;
                request.server = server;
            }
        }
        Found { channel, client, server, held }
    }

    /// A pair by a rule that was given.
    fn by_rule(&mut self, record: &TraceRecord, from: Endpoint, role: Role) -> Option<Found> {
        let pair = self.given.iter().find_map(|rule| match role {
            Role::Request if rule.is_to_all(from) => Some((from, None)),
            Role::Request => rule.server(from).map(|server| (from, Some(server))),
            Role::Answer => rule.client(from).map(|client| (client, Some(from))),
        });
        let (client, server) = pair?;
        let after_loss = self.sender(record.channel, from).is_some_and(|sender| sender.has_gap);
        let mut found = self.found(record.channel, client, server);
        found.held.push(Held { record: *record, after_loss, number: self.count });
        Some(found)
    }

    /// Senders with this identifier that would not have sent this.
    fn contradict(&mut self, channel: u8, id: Id, bytes: &[u8]) {
        let before = self.senders.len();
        self.senders.retain(|sender| {
            let offset = usize::from(sender.from.address.is_some());
            (sender.channel, sender.from.id) != (channel, id)
                || matches!(pci::parse(bytes, offset), Ok(Some(_)))
        });
        if self.senders.len() < before {
            let senders = &self.senders;
            let is_there = |request: &Request| {
                senders.iter().any(|sender| (sender.channel, sender.from) == (request.channel, request.from))
            };
            self.requests.retain(|request| request.client != Client::Unknown || is_there(request));
            self.mark();
        }
    }

    fn ask(
        &mut self,
        record: &TraceRecord,
        from: Endpoint,
        message: &[u8],
        client: Client,
        server: Option<Endpoint>,
    ) {
        let (channel, time_ns) = (record.channel, record.time_ns);
        self.requests.retain(|request| (request.channel, request.from) != (channel, from));
        if self.requests.len() == MOST_REQUESTS {
            self.requests.pop_front();
        }
        let until_ns = time_ns.saturating_add(ANSWER_NS);
        self.until_ns = self.until_ns.max(until_ns);
        let data = kept(message);
        self.requests.push_back(Request { channel, from, time_ns, until_ns, data, client, server });
    }

    /// The requests that a message may answer.
    fn fitting(&self, record: &TraceRecord, from: Endpoint, message: &[u8]) -> impl Iterator<Item = usize> {
        let fits = move |request: &Request| {
            request.channel == record.channel
                && record.time_ns <= request.until_ns
                && request.from.id != from.id
                && request.from.id.is_extended() == from.id.is_extended()
                && (request.from.address.is_some() == from.address.is_some()
                    || makers::is_to_all(request.from))
                && answers(&request.data, message)
        };
        (0..self.requests.len()).filter(move |place| fits(&self.requests[*place]))
    }

    /// The request of such clients that a message answers: the last one, or one that it is expected to answer.
    fn asked(&self, record: &TraceRecord, from: Endpoint, message: &[u8], of: &[Client]) -> Option<usize> {
        let fitting = self.fitting(record, from, message);
        let open = fitting.filter(|place| of.contains(&self.requests[*place].client));
        open.max_by_key(|place| (is_expected(self.requests[*place].from, from), *place))
    }

    fn answer(
        &mut self,
        record: &TraceRecord,
        from: Endpoint,
        message: &[u8],
        is_whole: bool,
    ) -> Option<Found> {
        let channel = record.channel;
        let Some(place) = self
            .asked(record, from, message, &[Client::Unknown, Client::Open])
            .filter(|_| record.time_ns <= self.until_ns)
        else {
            // Whoever answers is silent unless asked.
            if let Some(sender) = self.sender(channel, from) {
                sender.links.clear();
            }
            return None;
        };
        let request = &mut self.requests[place];
        let (is_pending, asked_ns) = (matches!(message, [0x7F, _, 0x78, ..]), request.time_ns);
        if is_pending {
            request.until_ns = record.time_ns.saturating_add(PENDING_NS);
            self.until_ns = self.until_ns.max(request.until_ns);
        }
        let (client, data, is_known) = (request.from, request.data.clone(), request.client == Client::Open);
        if let Some(asking) = self.sender(channel, client) {
            asking.unanswered_ns = None;
        }
        let last = [data, kept(message)];
        let mut weight = evidence(&last[0], message);
        let is_expected = is_known || is_expected(client, from);
        if !is_whole && weight < CONVINCING && !is_expected {
            // Its flow control and the next frame will show it.
            return None;
        }
        let links = self.sender(channel, from).map(|sender| std::mem::take(&mut sender.links));
        let mut links = links.unwrap_or_default();
        let place = links.iter().position(|link| link.client == client);
        let link = if let Some(place) = place {
            &mut links[place]
        } else {
            let evidence = if is_expected { EXPECTED } else { 0 };
            links.truncate(3);
            links.insert(0, Link { client, evidence, last: Default::default(), answered_ns: None });
            &mut links[0]
        };
        if link.answered_ns == Some(asked_ns) {
            // Nobody answers twice; all of its links are gone with this.
            return None;
        }
        link.answered_ns = Some(asked_ns).filter(|_| !is_pending);
        if link.last == last && !matches!(message, [0x7E, ..]) {
            weight = 0;
        } else if link.last[0] == last[0] {
            weight = weight.min(1);
        }
        link.evidence = link.evidence.saturating_add(weight);
        link.last = last;
        let convincing = match from.address {
            Some(_) if !is_expected => CONVINCING_WITH_ADDRESS,
            _ => CONVINCING,
        };
        if link.evidence < convincing {
            self.sender_or_new(channel, from, record.time_ns).links = links;
            return None;
        }
        let has_gap = self.sender(channel, from).is_some_and(|sender| sender.has_gap);
        let mut found = self.found(channel, client, Some(from));
        found.held.push(Held { record: *record, after_loss: has_gap, number: self.count });
        Some(found)
    }

    fn hold(&mut self, record: &TraceRecord, from: Endpoint) -> &mut Sender {
        let number = self.count;
        self.count += 1;
        let sender = self.sender_or_new(record.channel, from, record.time_ns);
        if sender.held.len() == MOST_HELD {
            sender.held.pop_front();
        }
        sender.seen_ns = record.time_ns;
        let after_loss = std::mem::take(&mut sender.has_gap);
        sender.held.push_back(Held { record: *record, after_loss, number });
        sender
    }

    fn sender(&mut self, channel: u8, from: Endpoint) -> Option<&mut Sender> {
        self.senders.iter_mut().find(|sender| (sender.channel, sender.from) == (channel, from))
    }

    fn sender_or_new(&mut self, channel: u8, from: Endpoint, seen_ns: i64) -> &mut Sender {
        let place = self.senders.iter().position(|sender| (sender.channel, sender.from) == (channel, from));
        let place = place.unwrap_or_else(|| {
            if self.senders.len() == MOST_SENDERS {
                // Of those with the least evidence, the one that has been silent for longest.
                let worth = |sender: &Sender| {
                    (sender.links.iter().map(|link| link.evidence).max().unwrap_or(0), sender.seen_ns)
                };
                let least = (0..MOST_SENDERS).min_by_key(|place| worth(&self.senders[*place]));
                self.senders.swap_remove(least.unwrap_or(0));
                self.mark();
            }
            self.marks.set(from.id);
            self.senders.push(Sender {
                channel,
                from,
                held: VecDeque::new(),
                seen_ns,
                has_gap: false,
                unanswered_ns: None,
                links: SmallVec::new(),
            });
            self.senders.len() - 1
        });
        &mut self.senders[place]
    }

    /// Sets the marks of the remaining senders.
    fn mark(&mut self) {
        self.marks = Marks::default();
        self.senders.iter().for_each(|sender| self.marks.set(sender.from.id));
    }
}

/// Whether a maker's table has this pair, or its addresses are those of its identifiers.
pub(super) fn is_expected(client: Endpoint, server: Endpoint) -> bool {
    let by_address = client.address == Some(server.id.raw() as u8)
        && server.address == Some(client.id.raw() as u8)
        && !client.id.is_extended();
    by_address || makers::rules().iter().any(|rule| rule.server(client) == Some(server))
}

/// The message of a frame, or the beginning of a long answer, if it may be one of diagnostics.
fn message(bytes: &[u8], offset: usize) -> Option<(Role, &[u8], bool)> {
    let (&control, rest) = bytes.get(offset..)?.split_first()?;
    let sid = match control >> 4 {
        0 if bytes.len() <= 8 => *rest.first()?,
        0 | 1 => *rest.get(1)?,
        _ => return None,
    };
    let role = ROLES[usize::from(sid)]?;
    match pci::parse(bytes, offset) {
        Ok(Some(Pci::Single(data))) => {
            let head = if bytes.len() > 8 && control.trailing_zeros() >= 4 { 2 } else { 1 };
            let is_padded = is_padded(&bytes[offset + head + data.len()..]);
            (is_padded && has_length(role, data)).then_some((role, data, true))
        }
        Ok(Some(Pci::First { data, length })) if length <= 4095 || bytes.len() > 8 => {
            Some((role, data, false))
        }
        _ => None,
    }
}

/// Padding consists of equal bytes.
pub(super) fn is_padded(rest: &[u8]) -> bool {
    rest.windows(2).all(|two| two[0] == two[1])
}

/// What a message is by its first byte. Services of OBD-II are not looked for: their identifiers are known, and low numbers are
/// common.
static ROLES: std::sync::LazyLock<[Option<Role>; 256]> = std::sync::LazyLock::new(|| {
    let is_service = |sid: u8| names::uds_service(sid).or_else(|| names::kwp_only_service(sid)).is_some();
    std::array::from_fn(|number| {
        let sid = number as u8;
        if sid == 0x7F || sid & 0x40 != 0 && is_service(sid & !0x40) {
            Some(Role::Answer)
        } else {
            (sid >= 0x10 && sid & 0x40 == 0 && is_service(sid)).then_some(Role::Request)
        }
    })
});

/// Whether a message of this service can have this length.
fn has_length(role: Role, data: &[u8]) -> bool {
    match (role, data[0], data.len()) {
        (Role::Answer, 0x7F, length) => length == 3 && ROLES[usize::from(data[1])] == Some(Role::Request),
        (Role::Request, 0x10 | 0x11, length) => length == 2,
        (Role::Request, 0x3E, length) => length <= 2,
        (Role::Request, 0x22, length) => length >= 3 && length % 2 == 1,
        (Role::Request, 0x19 | 0x21 | 0x1A | 0x27 | 0x28 | 0x2A | 0x31 | 0x85, length) => length >= 2,
        (Role::Request, 0x14 | 0x2E | 0x2F, length) => length >= 3,
        _ => true,
    }
}

/// As much of a message as is compared.
fn kept(message: &[u8]) -> SmallVec<[u8; MOST_ASKED]> {
    SmallVec::from_slice(&message[..message.len().min(MOST_ASKED)])
}

/// Whether a message answers a request, as far as it shows.
fn answers(request: &[u8], message: &[u8]) -> bool {
    let (Some(&sid), Some(&first)) = (request.first(), message.first()) else { return false };
    if first == 0x7F {
        return message.get(1) == Some(&sid);
    }
    first == sid | 0x40
        && [false, true].iter().any(|is_kwp| repeats_its_request(*is_kwp, request, message) == Some(true))
}

/// How much an answer shows that it is one to the request: 3 if it repeats an identifier; 2 if it repeats something shorter, or is a
/// refusal with a reason that there is; 1 if it says nothing else; 0 if it has contents that may be anything.
fn evidence(request: &[u8], message: &[u8]) -> u8 {
    if let [0x7F, _, nrc, ..] = *message {
        return if names::is_reason(nrc) { 2 } else { 0 };
    }
    let repeated = request.iter().zip(message).skip(1).take_while(|(asked, answered)| asked == answered);
    match repeated.filter(|(byte, _)| !matches!(byte, 0 | 0xFF)).count() {
        0 => u8::from(message.len() <= 2),
        1 => 2,
        _ => 3,
    }
}
