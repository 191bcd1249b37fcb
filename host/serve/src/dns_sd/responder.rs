//! What is said of services on a link, and when (RFC 6762): their names are tried before they are used, changed if somebody else has them, and
//! answered for. It knows no sockets and no clock.
//!
//! Whatever is asked, and however often, what is answered is one packet for each service, at most once a second. So a flood of questions makes
//! no flood of answers, and takes no memory.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use super::message::{MOST_LABEL, Message, Name, Record, kind, up_to_bytes};
use super::random;

/// For how long others may believe a record with a host in it, and any other one, in seconds (RFC 6762 §10).
const HOST_TTL_S: u32 = 120;
const OTHER_TTL_S: u32 = 4500;
/// In an answer to somebody who asks once (§6.7).
const LEGACY_TTL_S: u32 = 10;
/// How often names are tried, and how long each time is waited for somebody who has one (§8.1).
const PROBES: u32 = 3;
const BETWEEN_PROBES: Duration = Duration::from_millis(250);
/// How often they are announced (§8.3).
const ANNOUNCEMENTS: u32 = 2;
const BETWEEN_ANNOUNCEMENTS: Duration = Duration::from_secs(1);
/// How long whoever wants the same name at the same time, and has less to say for it, leaves the other alone (§8.2).
const GIVE_WAY: Duration = Duration::from_secs(1);
/// No record is sent to everybody more often, except to whoever is about to take its name (§6).
const LEAST_BETWEEN: Duration = Duration::from_secs(1);
const LEAST_BETWEEN_DEFENCES: Duration = Duration::from_millis(250);
/// Others may have the same answer, so that each waits a moment, in milliseconds (§6).
const SHARED_DELAY_MS: std::ops::Range<u64> = 20..120;
/// After so many conflicts within this time, each further try waits (§8.1).
const MOST_CONFLICTS: usize = 15;
const CONFLICTS_WITHIN: Duration = Duration::from_secs(10);
const AFTER_CONFLICTS: Duration = Duration::from_secs(5);
/// Answers to those who ask once, a second: their addresses can be forged.
const MOST_LEGACY: u32 = 100;

/// A service that is announced.
#[derive(Clone, Debug)]
pub struct Service {
    /// The first part of its name, unless somebody else has it.
    pub label: String,
    pub port: u16,
}

/// A name of its own, and the number that it has because others had it before.
#[derive(Clone, Debug)]
struct Own {
    base: String,
    number: u32,
}

impl Own {
    fn new(base: &str) -> Self {
        Self { base: base.to_owned(), number: 1 }
    }

    /// With what stands before and behind the number.
    fn label(&self, before: &str, behind: &str) -> String {
        if self.number == 1 {
            return up_to_bytes(&self.base, MOST_LABEL).to_owned();
        }
        let end = format!("{before}{}{behind}", self.number);
        format!("{}{end}", up_to_bytes(&self.base, MOST_LABEL - end.len()))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// So many questions were asked whether somebody has the names.
    Probing(u32),
    /// So many announcements were made.
    Announcing(u32),
    Announced,
}

/// When a packet was last sent to everybody, and when it is due.
#[derive(Clone, Copy, Debug, Default)]
struct Sending {
    sent_at: Option<Instant>,
    due: Option<Instant>,
}

/// The services of one address.
pub struct Responder {
    kind: Name,
    ip: IpAddr,
    host: Own,
    services: Vec<(Own, u16)>,
    text: Vec<u8>,
    phase: Phase,
    /// When the phase goes on.
    next: Instant,
    /// For each service, and last the list of kinds of services.
    sending: Vec<Sending>,
    host_sent_at: Option<Instant>,
    conflicts: VecDeque<Instant>,
    /// Since when, and how many, answers to those who ask once were given.
    legacy: (Instant, u32),
}

/// What is asked for to learn which kinds of services there are (RFC 6763 §9).
fn kinds() -> Name {
    Name::of(&["_services", "_dns-sd", "_udp", "local"])
}

impl Responder {
    pub fn new(
        kind: Name,
        ip: IpAddr,
        host: &str,
        services: &[Service],
        text: Vec<u8>,
        now: Instant,
    ) -> Self {
        Self {
            kind,
            ip,
            host: Own::new(host),
            services: services.iter().map(|service| (Own::new(&service.label), service.port)).collect(),
            text,
            phase: Phase::Probing(0),
            next: now + first_wait(),
            sending: vec![Sending::default(); services.len() + 1],
            host_sent_at: None,
            conflicts: VecDeque::new(),
            legacy: (now, 0),
        }
    }

    fn host(&self) -> Name {
        Name::of(&[&self.host.label("-", ""), "local"])
    }

    fn name(&self, service: usize) -> Name {
        let label = self.services[service].0.label(" (", ")");
        self.kind.with_first(&label)
    }

    fn pointer(&self, service: usize) -> Record {
        Record::pointer(self.kind.clone(), OTHER_TTL_S, &self.name(service))
    }

    /// What nobody else may say of a service's name.
    fn of_service(&self, service: usize) -> [Record; 2] {
        let name = self.name(service);
        [
            Record::place(name.clone(), HOST_TTL_S, self.services[service].1, &self.host()),
            Record::new(name, kind::TXT, OTHER_TTL_S, self.text.clone()),
        ]
    }

    /// The same of the host's name.
    fn of_host(&self) -> Record {
        Record::address(self.host(), HOST_TTL_S, self.ip)
    }

    /// Everything about a service. `sending` counts those and then the list of kinds.
    fn packet(&self, number: usize, with_host: bool) -> Message {
        if number == self.services.len() {
            return Message::answer(vec![Record::pointer(kinds(), OTHER_TTL_S, &self.kind)]);
        }
        let mut answers = vec![self.pointer(number)];
        answers.extend(self.of_service(number));
        let mut additional = vec![Record::only_these(self.name(number), HOST_TTL_S, &[kind::TXT, kind::SRV])];
        if with_host {
            let address = self.of_host();
            additional.push(Record::only_these(self.host(), HOST_TTL_S, &[address.kind]));
            answers.push(address);
        }
        Message { additional, ..Message::answer(answers) }
    }

    /// Sends a packet to everybody.
    fn send(&mut self, number: usize, now: Instant) -> Message {
        let is_fresh = |at: &Instant| now.saturating_duration_since(*at) < LEAST_BETWEEN;
        let with_host = self.host_sent_at.as_ref().is_none_or(|at| !is_fresh(at));
        if with_host && number < self.services.len() {
            self.host_sent_at = Some(now);
        }
        self.sending[number] = Sending { sent_at: Some(now), due: None };
        self.packet(number, with_host)
    }

    /// When [`Self::go_on`] has something to do.
    pub fn due(&self) -> Option<Instant> {
        let phase = (self.phase != Phase::Announced).then_some(self.next);
        self.sending.iter().filter_map(|sending| sending.due).chain(phase).min()
    }

    /// What is to be sent to everybody by now.
    pub fn go_on(&mut self, now: Instant) -> Vec<Message> {
        let mut out = Vec::new();
        if self.phase != Phase::Announced && now >= self.next {
            self.phase = match self.phase {
                Phase::Probing(PROBES) => Phase::Announcing(0),
                other => other,
            };
            match self.phase {
                Phase::Probing(sent) => {
                    out.extend((0..self.services.len()).map(|service| self.probe(service)));
                    self.phase = Phase::Probing(sent + 1);
                    self.next = now + BETWEEN_PROBES;
                }
                Phase::Announcing(sent) => {
                    for number in 0..self.services.len() {
                        out.push(self.send(number, now));
                    }
                    let is_last = sent + 1 >= ANNOUNCEMENTS;
                    self.phase = if is_last { Phase::Announced } else { Phase::Announcing(sent + 1) };
                    self.next = now + BETWEEN_ANNOUNCEMENTS;
                }
                Phase::Announced => {}
            }
        }
        for number in 0..self.sending.len() {
            if self.sending[number].due.is_some_and(|due| now >= due) {
                out.push(self.send(number, now));
            }
        }
        out
    }

    /// Asks whether somebody has a service's name, or the host's.
    fn probe(&self, service: usize) -> Message {
        let mut message = Message::question(self.name(service), kind::ANY);
        message.questions.extend(Message::question(self.host(), kind::ANY).questions);
        message.proposed.extend(self.of_service(service));
        message.proposed.push(self.of_host());
        message
    }

    /// Takes what somebody on the link said. Returns what is answered to them alone: those who ask once, from a port of their own.
    pub fn take(&mut self, message: &Message, asks_once: bool, now: Instant) -> Vec<Message> {
        if message.is_answer {
            self.take_answer(message, now);
            return Vec::new();
        }
        if let Phase::Probing(_) = self.phase {
            if self.gives_way(message) {
                self.probe_again(now + GIVE_WAY);
            }
            return Vec::new();
        }
        let wanted = self.wanted(message);
        if asks_once {
            return wanted.into_iter().filter_map(|number| self.answer_once(number, message, now)).collect();
        }
        let is_defence = !message.proposed.is_empty();
        for number in wanted {
            let least = if is_defence { LEAST_BETWEEN_DEFENCES } else { LEAST_BETWEEN };
            let wait =
                if is_defence { Duration::ZERO } else { Duration::from_millis(random(SHARED_DELAY_MS)) };
            let sending = &mut self.sending[number];
            let earliest = sending.sent_at.map_or(now, |sent_at| sent_at + least);
            let due = earliest.max(now + wait);
            sending.due = Some(sending.due.map_or(due, |before| before.min(due)));
        }
        Vec::new()
    }

    /// The packets that answer a question, unless whoever asks has said that it knows them.
    fn wanted(&self, message: &Message) -> Vec<usize> {
        let is_known = |record: &Record| {
            message.answers.iter().any(|known| known.is_same(record) && known.ttl_s >= record.ttl_s / 2)
        };
        let asks = |record: &Record| {
            !is_known(record)
                && message.questions.iter().any(|question| question.asks(&record.name, record.kind))
        };
        // A type that a name does not have is answered as well, by saying so.
        let names = |name: &Name| {
            let has = |question: &super::message::Question| {
                question.name == *name
                    && ![kind::TXT, kind::SRV, kind::ANY, self.of_host().kind].contains(&question.kind)
            };
            message.questions.iter().any(has)
        };
        let host = asks(&self.of_host()) || names(&self.host());
        let service = |number: usize| {
            asks(&self.pointer(number))
                || self.of_service(number).iter().any(asks)
                || names(&self.name(number))
                || host && number == 0
        };
        let list = asks(&Record::pointer(kinds(), OTHER_TTL_S, &self.kind));
        let all = (0..self.services.len()).filter(|number| service(*number));
        all.chain(list.then_some(self.services.len())).collect()
    }

    fn answer_once(&mut self, number: usize, question: &Message, now: Instant) -> Option<Message> {
        let (since, count) = &mut self.legacy;
        if now.saturating_duration_since(*since) >= Duration::from_secs(1) {
            (*since, *count) = (now, 0);
        }
        *count += 1;
        if *count > MOST_LEGACY {
            return None;
        }
        let mut answer = self.packet(number, true);
        (answer.id, answer.questions) = (question.id, question.questions.clone());
        for record in answer.answers.iter_mut().chain(&mut answer.additional) {
            (record.ttl_s, record.is_only) = (record.ttl_s.min(LEGACY_TTL_S), false);
        }
        Some(answer)
    }

    /// Somebody wants one of the names at the same time, and what they would say under it is greater.
    fn gives_way(&self, message: &Message) -> bool {
        let services = (0..self.services.len()).flat_map(|number| self.of_service(number));
        let own: Vec<Record> = services.chain([self.of_host()]).collect();
        let under = |records: &[Record], name: &Name| {
            let same = records.iter().filter(|record| record.name == *name);
            let mut said: Vec<_> =
                same.map(|record| (record.class, record.kind, record.data.clone())).collect();
            said.sort_unstable();
            said
        };
        // Nothing is smaller than anything.
        own.iter().any(|record| under(&message.proposed, &record.name) > under(&own, &record.name))
    }

    fn probe_again(&mut self, at: Instant) {
        self.phase = Phase::Probing(0);
        self.next = at;
        self.sending.iter_mut().for_each(|sending| sending.due = None);
    }

    /// Looks whether somebody else has one of the names. While they are tried, another one is taken; later, they are tried again first (§9).
    fn take_answer(&mut self, message: &Message, now: Instant) {
        let contradicts = |name: &Name, own: &[Record]| {
            let is_other = |record: &Record| {
                record.name == *name
                    && record.ttl_s > 0
                    && record.kind != kind::NSEC
                    && !own.iter().any(|own| own.is_same(record))
            };
            message.answers.iter().chain(&message.additional).any(is_other)
        };
        let host = contradicts(&self.host(), &[self.of_host()]);
        let services: Vec<usize> = (0..self.services.len())
            .filter(|number| contradicts(&self.name(*number), &self.of_service(*number)))
            .collect();
        if !host && services.is_empty() {
            return;
        }
        if let Phase::Probing(_) = self.phase {
            self.host.number += u32::from(host);
            for number in services {
                self.services[number].0.number += 1;
            }
        }
        self.conflicts.push_back(now);
        while self.conflicts.len() > MOST_CONFLICTS {
            self.conflicts.pop_front();
        }
        let is_much = self.conflicts.len() == MOST_CONFLICTS
            && self
                .conflicts
                .front()
                .is_some_and(|first| now.saturating_duration_since(*first) < CONFLICTS_WITHIN);
        self.probe_again(now + if is_much { AFTER_CONFLICTS } else { first_wait() });
    }

    /// Begins as at first: the link may be another one.
    pub fn begin_anew(&mut self, now: Instant) {
        self.probe_again(now + first_wait());
    }

    /// What tells others that the services have gone; nothing, if they know of none.
    pub fn goodbye(&self) -> Vec<Message> {
        if let Phase::Probing(_) = self.phase {
            return Vec::new();
        }
        let gone = |number| {
            let mut message = self.packet(number, false);
            message.additional.clear();
            message.answers.iter_mut().for_each(|record| record.ttl_s = 0);
            message
        };
        (0..self.services.len()).map(gone).collect()
    }
}

/// Many computers may have been switched on at once (§8.1).
fn first_wait() -> Duration {
    Duration::from_millis(random(0..250))
}

#[cfg(test)]
mod tests;
