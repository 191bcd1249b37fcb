//! Finds diagnostic servers: asks each address in turn whether anybody is there, by "tester present", which every server of UDS has to know
//! (ISO 14229-1:2020 §10.6) and which changes no state.
//!
//! It listens first, and leaves out every identifier that another node sends with: two nodes with one identifier destroy each other's frames.
//! One question is on the bus at a time.

use std::collections::BTreeMap;

use cantap_can::Frame;
use cantap_trace::Id;
use rustc_hash::{FxHashMap, FxHashSet};

use super::Machine;
use crate::iso_tp::{Endpoint, Maker, Pair};

/// "Tester present", with an answer.
const QUESTION: [u8; 2] = [0x3E, 0x00];
const POSITIVE: u8 = QUESTION[0] + 0x40;
const NEGATIVE: u8 = 0x7F;
const PADDING: u8 = 0xCC;
/// So many servers are kept; a vehicle has about a hundred.
const MOST_FOUND: usize = 512;
/// The most addresses of one range that are asked: the largest has 65,536, of which no vehicle uses more than the first few.
const MOST_OF_RANGE: usize = 256;

/// An address to ask.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Question {
    /// What the question is sent with.
    pub request: Endpoint,
    /// Who may answer; empty if anybody may.
    pub servers: Vec<Endpoint>,
}

/// The addresses to ask, each once.
#[derive(Clone, Debug, Default)]
pub struct Questions {
    all: Vec<Question>,
    places: FxHashMap<Endpoint, usize>,
    left_out: usize,
}

impl Questions {
    /// Those that ISO 15765-4 and ISO 15765-2 reserve: to all with 7DF and 18DB33F1, then 7E0 to 7E7, and 18DAxxF1 for every xx.
    pub fn standard() -> Self {
        let mut questions = Self::default();
        let plain = |id| Endpoint { id, address: None };
        questions.add(plain(Id::standard_truncated(0x7DF)), None);
        questions.add(plain(Id::extended_truncated(0x18DB_33F1)), None);
        for id in 0x7E0..=0x7E7 {
            let [request, server] = [id, id + 8].map(|id| plain(Id::standard_truncated(id)));
            questions.add(request, Some(server));
        }
        for address in (0..=0xFF).filter(|address| *address != TESTER) {
            let [request, server] = [address << 8 | TESTER, TESTER << 8 | address]
                .map(|addresses| plain(Id::extended_truncated(0x18DA_0000 | addresses)));
            questions.add(request, Some(server));
        }
        questions
    }

    /// Also those of a maker.
    pub fn add_maker(&mut self, maker: Maker) {
        for range in maker.ranges() {
            for request in range.to_all {
                self.add(request, None);
            }
            self.left_out += range.requests.len().saturating_sub(MOST_OF_RANGE);
            for (request, server) in range.requests.into_iter().take(MOST_OF_RANGE) {
                self.add(request, Some(server));
            }
        }
    }

    /// Also the request of a pair.
    pub fn add_pair(&mut self, pair: Pair) {
        self.add(pair.a, Some(pair.b));
    }

    /// Leaves out those that only one server may answer.
    pub fn only_to_all(&mut self) {
        self.all.retain(|question| question.servers.is_empty());
        self.places = self.all.iter().enumerate().map(|(at, question)| (question.request, at)).collect();
    }

    /// Several may answer with different identifiers; nobody is anybody.
    fn add(&mut self, request: Endpoint, server: Option<Endpoint>) {
        let place = *self.places.entry(request).or_insert_with(|| {
            self.all.push(Question { request, servers: Vec::new() });
            self.all.len() - 1
        });
        let question = &mut self.all[place];
        if let Some(server) = server.filter(|server| !question.servers.contains(server)) {
            question.servers.push(server);
        }
    }

    /// All of them.
    pub fn all(&self) -> &[Question] {
        &self.all
    }

    /// How many addresses of large ranges are not among them.
    pub const fn left_out(&self) -> usize {
        self.left_out
    }
}

/// The address of a tester outside the vehicle (ISO 15765-4:2021 §8.4).
const TESTER: u32 = 0xF1;

/// What a server answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ServerReply {
    /// It is there.
    Positive,
    /// It is there, and refuses with this code.
    Refusal(u8),
}

/// A server that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundServer {
    /// What it answers with.
    pub server: Endpoint,
    /// What it is asked with; `None` if it has only answered questions to all.
    pub request: Option<Endpoint>,
    /// Whether it answered a question to all.
    pub functional: bool,
    /// Its last answer.
    pub reply: ServerReply,
    /// The time between the question and its first answer.
    pub after_ns: u64,
    /// How many answers it sent: usually one to each question.
    pub answers: u64,
}

/// The times of a scan.
#[derive(Clone, Copy, Debug)]
pub struct ScanTimes {
    /// Listening before the first question.
    pub listen_ns: u64,
    /// The least time between two questions.
    pub pace_ns: u64,
    /// How late an answer may be.
    pub wait_ns: u64,
}

impl ScanTimes {
    /// How long these questions take if nothing has to be asked twice.
    pub fn longest_ns(&self, questions: &Questions) -> u64 {
        let to_all = questions.all.iter().filter(|question| question.servers.is_empty()).count() as u64;
        let others = questions.all.len() as u64 - to_all;
        self.listen_ns + to_all * self.wait_ns + others * self.pace_ns + self.wait_ns
    }
}

/// Asks, and listens.
#[derive(Debug)]
pub struct ServerScan {
    questions: Vec<Question>,
    /// When each was asked last.
    asked_ns: Vec<Option<u64>>,
    /// Which questions an endpoint may answer.
    by_server: FxHashMap<Endpoint, Vec<usize>>,
    request_ids: FxHashSet<Id>,
    times: ScanTimes,
    state: State,
    /// The question asked last, the one after it in their order, and when that may be asked.
    place: usize,
    next: usize,
    next_ns: u64,
    under_way: bool,
    /// Identifiers of questions with which others send.
    busy: FxHashSet<Id>,
    not_asked: Vec<Endpoint>,
    found: BTreeMap<Key, Candidate>,
    too_many: u64,
    /// Answers to no question, by the endpoint that sent them before it was asked anything.
    unasked: FxHashSet<Endpoint>,
}

/// The order in which servers are shown.
type Key = (bool, u32, Option<u8>);

fn key(endpoint: Endpoint) -> Key {
    (endpoint.id.is_extended(), endpoint.id.raw(), endpoint.address)
}

#[derive(Debug)]
struct Candidate {
    found: FoundServer,
    /// Questions whose answer the first may be, the latest first. With more than one, they are asked again alone.
    requests: Vec<usize>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Begin,
    /// The questions, in their order.
    Ask,
    /// What was asked last may still be answered.
    Wait(u64),
    /// Questions of which it is not clear who answered which: the server, and which of its questions is being asked.
    Confirm {
        server: Key,
        which: usize,
        until_ns: u64,
    },
    Done,
}

impl ServerScan {
    /// Asks these questions.
    pub fn new(questions: &Questions, times: ScanTimes) -> Self {
        let questions = questions.all.clone();
        let mut by_server: FxHashMap<Endpoint, Vec<usize>> = FxHashMap::default();
        for (at, question) in questions.iter().enumerate() {
            for server in &question.servers {
                by_server.entry(*server).or_default().push(at);
            }
        }
        Self {
            asked_ns: vec![None; questions.len()],
            by_server,
            request_ids: questions.iter().map(|question| question.request.id).collect(),
            questions,
            times,
            state: State::Begin,
            place: 0,
            next: 0,
            next_ns: 0,
            under_way: false,
            busy: FxHashSet::default(),
            not_asked: Vec::new(),
            found: BTreeMap::new(),
            too_many: 0,
            unasked: FxHashSet::default(),
        }
    }

    /// The servers found, by identifier.
    pub fn found(&self) -> impl Iterator<Item = &FoundServer> {
        self.found.values().map(|candidate| &candidate.found)
    }

    /// The addresses that were not asked, because another node sends with their identifiers.
    pub fn not_asked(&self) -> &[Endpoint] {
        &self.not_asked
    }

    /// Answers of more servers than are kept.
    pub const fn too_many(&self) -> u64 {
        self.too_many
    }

    /// Who sent what looks like an answer before anything was asked: no sign of a server, or of one that another tester asks.
    pub fn unasked(&self) -> impl Iterator<Item = Endpoint> {
        self.unasked.iter().copied()
    }

    /// Takes a question that may be asked.
    fn ask(&mut self, place: usize) -> Option<Frame> {
        let request = self.questions[place].request;
        if self.busy.contains(&request.id) {
            self.not_asked.push(request);
            return None;
        }
        self.under_way = true;
        self.asked_ns[place] = None;
        self.place = place;
        Some(frame(request))
    }

    /// The next server whose question is not clear, after this one.
    fn unclear_after(&self, after: Option<Key>) -> Option<Key> {
        let is_unclear = |candidate: &Candidate| candidate.requests.len() > 1;
        let mut all = self.found.iter().filter(|(key, _)| after.is_none_or(|after| **key > after));
        all.find(|(_, candidate)| is_unclear(candidate)).map(|(key, _)| *key)
    }

    /// Goes on with the first unclear question after this server, or ends.
    fn confirm_after(&mut self, after: Option<Key>) {
        self.state = match self.unclear_after(after) {
            Some(server) => State::Confirm { server, which: 0, until_ns: 0 },
            None => State::Done,
        };
    }

    /// The next question of those that are asked again.
    fn confirm(&mut self, now_ns: u64) -> Option<Frame> {
        let State::Confirm { server, which, until_ns } = self.state else { return None };
        if now_ns < until_ns {
            return None;
        }
        let requests = self.found.get(&server).map_or(&[][..], |candidate| candidate.requests.as_slice());
        let Some(place) = requests.get(which).copied() else {
            // None of them was answered again: which one it was stays unknown.
            if let Some(candidate) = self.found.get_mut(&server) {
                candidate.requests.clear();
                candidate.found.request = None;
            }
            self.confirm_after(Some(server));
            return None;
        };
        self.state = State::Confirm { server, which: which + 1, until_ns: u64::MAX };
        let question = self.ask(place);
        if question.is_none() {
            self.state = State::Confirm { server, which: which + 1, until_ns: now_ns };
        }
        question
    }

    fn take_answer(&mut self, now_ns: u64, server: Endpoint, reply: ServerReply) {
        let asked =
            |place: &usize| self.asked_ns[*place].filter(|at_ns| now_ns - at_ns <= self.times.wait_ns);
        // The latest question that it may be the answer to, and all others.
        let mut own: Vec<_> = self.by_server.get(&server).map_or(&[][..], Vec::as_slice).to_vec();
        own.retain(|place| asked(place).is_some());
        own.sort_by_key(|place| std::cmp::Reverse(asked(place)));
        let to_all = (0..self.questions.len()).filter(|place| self.questions[*place].servers.is_empty());
        let to_all = to_all.filter_map(|place| asked(&place)).max();
        let since_ns = own.first().and_then(asked).or(to_all);
        let key = key(server);
        let Some(since_ns) = since_ns else {
            match self.found.get_mut(&key) {
                Some(candidate) => candidate.found.answers += 1,
                None if self.unasked.len() < MOST_FOUND => {
                    self.unasked.insert(server);
                }
                None => self.too_many += 1,
            }
            return;
        };
        // Whoever says so all the time says nothing to us, unless it was asked by name.
        if own.is_empty() && self.unasked.contains(&server) {
            return;
        }
        // Those that nobody's rules know must not take the places of the others.
        let most = if self.by_server.contains_key(&server) { MOST_FOUND } else { MOST_FOUND / 2 };
        if self.found.len() >= most && !self.found.contains_key(&key) {
            self.too_many += 1;
            return;
        }
        let candidate = self.found.entry(key).or_insert_with(|| Candidate {
            found: FoundServer {
                server,
                request: None,
                functional: false,
                reply,
                after_ns: now_ns - since_ns,
                answers: 0,
            },
            requests: Vec::new(),
        });
        candidate.found.reply = reply;
        candidate.found.answers += 1;
        if own.is_empty() {
            candidate.found.functional = true;
        } else if let State::Confirm { server, which, .. } = self.state {
            // Asked alone, so that it is the answer to this.
            if server == key && own.first() == Some(&self.place) && which > 0 {
                candidate.found.request = Some(self.questions[self.place].request);
                candidate.requests = vec![self.place];
                self.confirm_after(Some(server));
            }
        } else if candidate.requests.is_empty() {
            candidate.found.request = Some(self.questions[own[0]].request);
            candidate.found.after_ns = now_ns - since_ns;
            candidate.requests = own;
        }
    }
}

fn frame(request: Endpoint) -> Frame {
    let mut data = [PADDING; 8];
    let at = usize::from(request.address.is_some());
    data[0] = request.address.unwrap_or_default();
    data[at] = QUESTION.len() as u8;
    data[at + 1..at + 3].copy_from_slice(&QUESTION);
    Frame::from_bus(request.id, false, 8, data)
}

/// An answer to the question in a single frame.
fn reply(single: &[u8]) -> Option<ServerReply> {
    let (len, rest) = single.split_first()?;
    match rest.get(..usize::from(*len))? {
        // KWP2000 answers without the sub-function.
        [POSITIVE] | [POSITIVE, 0] => Some(ServerReply::Positive),
        [NEGATIVE, service, code] if *service == QUESTION[0] => Some(ServerReply::Refusal(*code)),
        _ => None,
    }
}

impl Machine for ServerScan {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        if self.state == State::Begin {
            self.state = State::Ask;
            self.next_ns = now_ns + self.times.listen_ns;
        }
        if self.under_way {
            return None;
        }
        if self.state == State::Ask && now_ns >= self.next_ns {
            while self.next < self.questions.len() {
                self.next += 1;
                if let Some(frame) = self.ask(self.next - 1) {
                    return Some(frame);
                }
            }
            self.state = State::Wait(now_ns + self.times.wait_ns);
        }
        if let State::Wait(until_ns) = self.state
            && now_ns >= until_ns
        {
            self.confirm_after(None);
        }
        while matches!(self.state, State::Confirm { until_ns, .. } if now_ns >= until_ns) {
            if let Some(frame) = self.confirm(now_ns) {
                return Some(frame);
            }
        }
        None
    }

    fn sent(&mut self, now_ns: u64) {
        self.under_way = false;
        self.asked_ns[self.place] = Some(now_ns);
        // Of those that all may answer, the answers must not be taken for answers to the next question.
        let is_to_all = self.questions[self.place].servers.is_empty();
        self.next_ns = now_ns + if is_to_all { self.times.wait_ns } else { self.times.pace_ns };
        if let State::Confirm { until_ns, .. } = &mut self.state {
            *until_ns = now_ns + self.times.wait_ns;
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if self.request_ids.contains(&id) {
            self.busy.insert(id);
        }
        let plain = Endpoint { id, address: None };
        if let Some(reply) = reply(data) {
            self.take_answer(now_ns, plain, reply);
        } else if let Some((address, single)) = data.split_first()
            && let Some(reply) = reply(single)
        {
            self.take_answer(now_ns, Endpoint { id, address: Some(*address) }, reply);
        }
    }

    fn gap(&mut self, _now_ns: u64) {}

    fn due_ns(&self) -> Option<u64> {
        if self.under_way {
            return None;
        }
        match self.state {
            State::Begin => Some(0),
            State::Ask => Some(self.next_ns),
            State::Wait(until_ns) | State::Confirm { until_ns, .. } => Some(until_ns),
            State::Done => None,
        }
    }

    fn is_done(&self) -> bool {
        self.state == State::Done && !self.under_way
    }
}

#[cfg(test)]
mod tests;
