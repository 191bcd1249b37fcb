//! A diagnostic request and its answers: UDS (ISO 14229), KWP2000 and OBD-II, over ISO 15765-2.
//!
//! One server is addressed by its own identifier, all of them by a functional one. A server that needs longer says so repeatedly
//! (response pending); how long that may go on is limited.

use std::collections::VecDeque;

use cantap_can::Frame;
use cantap_trace::Id;

use super::answer::{NEGATIVE, is_answer};
use super::rivals::Rivals;
use super::transfer::{TransferError, TransferReceiver, TransferSender, TransferSettings};
use super::{Machine, earlier};
use crate::diagnostics::is_response_suppressed;
use crate::iso_tp::{Endpoint, Pci, parse};

const RESPONSE_PENDING: u8 = 0x78;

/// How long servers may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResponseTiming {
    /// From the end of the request to the beginning of the answer (P2, plus the network's delay).
    pub p2_ns: u64,
    /// The same after the server has said that the answer is pending (P2*).
    pub p2_star_ns: u64,
    /// From the end of the request to the last answer, however often it was pending; and before that, for sending the request, however
    /// often the server asks to wait.
    pub patience_ns: u64,
}

impl Default for ResponseTiming {
    /// One second, because servers have 50 ms and gateways add to that; five seconds; one minute.
    fn default() -> Self {
        Self { p2_ns: 1_000_000_000, p2_star_ns: 5_000_000_000, patience_ns: 60_000_000_000 }
    }
}

/// Who should answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answerer {
    /// A single server. Flow control goes to the identifier of the request or, for a functional request, to the
    /// server's own.
    One {
        /// Where its answer comes from.
        from: Endpoint,
        /// Where flow control goes.
        flow_to: Endpoint,
    },
    /// Anyone who answers with 7E8 to 7EF (ISO 15765-4).
    Any11Bit,
    /// Anyone who answers this tester with 18DA (ISO 15765-4).
    Any29Bit {
        /// The tester's address, usually F1.
        tester: u8,
    },
}

impl Answerer {
    /// Where flow control for this sender goes, if it is one that should answer.
    fn flow_to(self, id: Id, data: &[u8]) -> Option<(Endpoint, Endpoint)> {
        let plain = |id| Endpoint { id, address: None };
        match self {
            Self::One { from, flow_to } => {
                let is_it =
                    id == from.id && from.address.is_none_or(|address| data.first() == Some(&address));
                is_it.then_some((from, flow_to))
            }
            Self::Any11Bit => {
                let is_one = !id.is_extended() && (0x7E8..=0x7EF).contains(&id.raw());
                is_one.then(|| (plain(id), plain(Id::standard_truncated(id.raw() - 8))))
            }
            Self::Any29Bit { tester } => {
                let server = id.raw() & 0xFF;
                let is_one = id.is_extended() && id.raw() & 0x3FF_FF00 == 0x0DA_0000 | u32::from(tester) << 8;
                let back = 0x18DA_0000 | server << 8 | u32::from(tester);
                is_one.then(|| (plain(id), plain(Id::extended_truncated(back))))
            }
        }
    }

    /// Whether there can be several answers.
    pub const fn is_many(self) -> bool {
        !matches!(self, Self::One { .. })
    }
}

/// One server's answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerAnswer {
    /// The server.
    pub from: Endpoint,
    /// The answer; its first byte is the service plus 40 (hexadecimal), or 7F.
    pub data: Vec<u8>,
    /// How often it said beforehand that the answer is pending.
    pub pending: u32,
}

impl ServerAnswer {
    /// The code of a negative response.
    pub fn refusal(&self) -> Option<u8> {
        match self.data[..] {
            [NEGATIVE, _, code, ..] => Some(code),
            _ => None,
        }
    }
}

/// Answers, and the senders whose answers broke off.
pub type Answers = (Vec<ServerAnswer>, Vec<(Endpoint, TransferError)>);

/// Why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ExchangeError {
    /// The request could not be sent completely.
    #[error("the request broke off: {0}")]
    Request(TransferError),
    /// The request could not be sent completely in time, since the server took its frames too slowly.
    #[error("the request was not taken completely within {after_ms} ms")]
    RequestTooSlow {
        /// How long we tried.
        after_ms: u64,
    },
    /// No answer came.
    #[error("no answer within {after_ms} ms")]
    NoAnswer {
        /// How long we waited.
        after_ms: u64,
        /// Other messages from the addressed servers.
        others: u32,
    },
    /// The server said that the answer is pending, and then nothing more.
    #[error("the server said {times} times that its answer is pending, and then nothing for {after_ms} ms")]
    NothingAfterPending {
        /// How often.
        times: u32,
        /// How long we waited.
        after_ms: u64,
    },
    /// The server keeps saying that its answer is pending.
    #[error("the server has said for {after_ms} ms that its answer is pending ({times} times)")]
    EndlessPending {
        /// How often.
        times: u32,
        /// For how long.
        after_ms: u64,
    },
    /// An answer began, and was not complete in time.
    #[error("the answer was not complete within {after_ms} ms")]
    TooSlow {
        /// How long we waited.
        after_ms: u64,
    },
    /// The answer broke off.
    #[error("the answer of {from} broke off: {error}")]
    Answer {
        /// The sender.
        from: Endpoint,
        /// The reason.
        error: TransferError,
    },
}

/// A server that answers, or has begun to.
#[derive(Debug)]
struct Server {
    from: Endpoint,
    receiver: TransferReceiver,
    pending: u32,
    /// An answer that is pending is awaited until this time.
    pending_until_ns: Option<u64>,
}

/// One request to one server or to many.
#[derive(Debug)]
pub struct Exchange {
    request: Vec<u8>,
    sender: TransferSender,
    answerer: Answerer,
    settings: TransferSettings,
    timing: ResponseTiming,
    /// Servers whose first flow control frame the device sends on its own.
    flow_by_device: Vec<Endpoint>,
    most_answers: Option<usize>,
    servers: Vec<Server>,
    answers: Vec<ServerAnswer>,
    broken: Vec<(Endpoint, TransferError)>,
    /// Frames handed over that have not been on the bus yet; true for those of the request.
    under_way: VecDeque<bool>,
    /// When the request was begun.
    begun_ns: Option<u64>,
    /// When the request was complete on the bus.
    asked_ns: Option<u64>,
    others: u32,
    to: Endpoint,
    rivals: Rivals,
    end: Option<Result<(), ExchangeError>>,
}

impl Exchange {
    /// A request of at least one byte.
    pub fn new(
        to: Endpoint,
        answerer: Answerer,
        request: Vec<u8>,
        settings: TransferSettings,
        timing: ResponseTiming,
    ) -> Self {
        Self {
            sender: TransferSender::new(to, request.clone(), settings),
            request,
            answerer,
            settings,
            timing,
            flow_by_device: Vec::new(),
            most_answers: None,
            servers: Vec::new(),
            answers: Vec::new(),
            broken: Vec::new(),
            under_way: VecDeque::new(),
            begun_ns: None,
            asked_ns: None,
            others: 0,
            to,
            rivals: Rivals::default(),
            end: None,
        }
    }

    /// Ends as soon as this many servers have answered, if many are addressed.
    pub const fn expect(&mut self, servers: usize) {
        self.most_answers = Some(servers);
    }

    /// Whether a positive answer is too long for one frame of classical CAN by the standards, whatever the server: the vehicle and
    /// engine numbers, calibrations and names of SAE J1979's service 09, the VIN of ISO 14229-1, or three data identifiers.
    pub fn has_long_answer(&self) -> bool {
        match self.request[..] {
            [0x09, 0x02 | 0x04 | 0x0A | 0x0D] => true,
            [0x22, ref dids @ ..] => dids.len() >= 6 || dids == [0xF1, 0x90],
            _ => false,
        }
    }

    /// The device sends the first flow control frame to this server on its own: see [`TransferReceiver::new`].
    pub fn flow_by_device(&mut self, from: Endpoint) {
        self.flow_by_device.push(from);
    }

    /// The replies to configure in the device for that: for the addressed server or, if many are addressed, for those of `servers` that
    /// should answer.
    pub fn device_replies(&self, servers: &[Endpoint]) -> Vec<(Endpoint, Frame)> {
        let reply = |(from, flow_to)| (from, TransferReceiver::go_on(flow_to, &self.settings));
        match self.answerer {
            Answerer::One { from, flow_to } => vec![reply((from, flow_to))],
            many => servers.iter().filter_map(|server| many.flow_to(server.id, &[])).map(reply).collect(),
        }
    }

    /// The answers, and those that broke off, if at least one did not. Call it when the exchange is done.
    pub fn finish(self) -> Result<Answers, ExchangeError> {
        match self.end {
            Some(Err(error)) => Err(error),
            _ => Ok((self.answers, self.broken)),
        }
    }

    /// How many requests of other testers to the same servers were heard meanwhile.
    pub const fn rivals(&self) -> u32 {
        self.rivals.count()
    }

    /// How many of the answers may be to another tester's request.
    pub const fn doubtful(&self) -> u32 {
        self.rivals.doubtful()
    }

    fn end(&mut self, result: Result<(), ExchangeError>) {
        self.end.get_or_insert(result);
    }

    /// A server has sent a complete message.
    fn answered(&mut self, now_ns: u64, place: usize, data: Vec<u8>) {
        if !is_answer(&self.request, &data) {
            self.others += 1;
            return;
        }
        let server = &mut self.servers[place];
        if matches!(data[..], [NEGATIVE, _, RESPONSE_PENDING, ..]) {
            server.pending += 1;
            server.pending_until_ns = Some(now_ns + self.timing.p2_star_ns);
            return;
        }
        server.pending_until_ns = None;
        self.rivals.judge(&self.request, &data);
        self.answers.push(ServerAnswer { from: server.from, data, pending: server.pending });
        if !self.answerer.is_many() || self.most_answers.is_some_and(|most| self.answers.len() >= most) {
            self.end(Ok(()));
        }
    }

    fn broke(&mut self, place: usize, error: TransferError) {
        let server = &mut self.servers[place];
        server.pending_until_ns = None;
        let from = server.from;
        self.broken.push((from, error));
        if !self.answerer.is_many() {
            self.end(Err(ExchangeError::Answer { from, error }));
        }
    }

    /// Handles timeouts.
    fn expire(&mut self, now_ns: u64) {
        let after_ms = self.timing.patience_ns / 1_000_000;
        let Some(asked_ns) = self.asked_ns else {
            if self
                .begun_ns
                .is_some_and(|begun_ns| now_ns >= begun_ns.saturating_add(self.timing.patience_ns))
            {
                self.end(Err(ExchangeError::RequestTooSlow { after_ms }));
            }
            return;
        };
        let pending: u32 = self.servers.iter().map(|server| server.pending).sum();
        let is_receiving = self.servers.iter().any(|server| server.receiver.is_receiving());
        if now_ns >= asked_ns + self.timing.patience_ns {
            self.end(match (self.answers.is_empty(), is_receiving, pending) {
                (false, ..) => Ok(()),
                (true, false, times @ 1..) => Err(ExchangeError::EndlessPending { times, after_ms }),
                (true, false, 0) => Err(ExchangeError::NoAnswer { after_ms, others: self.others }),
                (true, true, _) => Err(ExchangeError::TooSlow { after_ms }),
            });
            return;
        }
        if is_receiving {
            return;
        }
        // A pending answer that did not come.
        let p2_star_ms = self.timing.p2_star_ns / 1_000_000;
        let silent =
            |server: &&mut Server| server.pending_until_ns.is_some_and(|until_ns| now_ns >= until_ns);
        for server in self.servers.iter_mut().filter(silent) {
            server.pending_until_ns = None;
        }
        let waits = self.servers.iter().any(|server| server.pending_until_ns.is_some());
        if waits || now_ns < asked_ns + self.timing.p2_ns {
            return;
        }
        let is_answered = !self.answers.is_empty() || pending == 0 && is_response_suppressed(&self.request);
        self.end(match (is_answered, pending, self.broken.first()) {
            (true, ..) => Ok(()),
            (false, _, Some(&(from, error))) => Err(ExchangeError::Answer { from, error }),
            (false, 0, None) => {
                let after_ms = self.timing.p2_ns / 1_000_000;
                Err(ExchangeError::NoAnswer { after_ms, others: self.others })
            }
            (false, times, None) => Err(ExchangeError::NothingAfterPending { times, after_ms: p2_star_ms }),
        });
    }
}

impl Machine for Exchange {
    fn next(&mut self, now_ns: u64) -> Option<Frame> {
        for place in 0..self.servers.len() {
            match self.servers[place].receiver.next(now_ns) {
                Ok(Some(flow)) => {
                    self.under_way.push_back(false);
                    return Some(flow);
                }
                Ok(None) => {}
                Err(error) => self.broke(place, error),
            }
        }
        if self.is_done() {
            return None;
        }
        self.begun_ns.get_or_insert(now_ns);
        // A server that takes frame after frame slowly must not be sent more after the end of our patience.
        self.expire(now_ns);
        if self.is_done() {
            return None;
        }
        match self.sender.next(now_ns) {
            Ok(Some(frame)) => {
                self.under_way.push_back(true);
                return Some(frame);
            }
            Ok(None) => {}
            Err(error) => self.end(Err(ExchangeError::Request(error))),
        }
        None
    }

    fn sent(&mut self, now_ns: u64) {
        if self.under_way.pop_front() == Some(true) {
            self.sender.sent(now_ns);
            if self.sender.is_done() {
                self.asked_ns.get_or_insert(now_ns);
            }
        }
    }

    fn hear(&mut self, now_ns: u64, id: Id, data: &[u8]) {
        if self.begun_ns.is_some() && !self.is_done() && self.rivals.hear(self.to, id, data) {
            return;
        }
        let Some((from, flow_to)) = self.answerer.flow_to(id, data) else { return };
        // Nothing sent before the request was complete can answer it.
        if self.is_done()
            || self.under_way.is_empty() && self.asked_ns.is_none() && self.sender.due_ns().is_none()
        {
            return;
        }
        let pci = match parse(data, usize::from(from.address.is_some())) {
            Ok(Some(pci)) => pci,
            Ok(None) => return,
            Err(fault) => {
                let error = TransferError::Malformed(fault);
                self.broken.push((from, error));
                if !self.answerer.is_many() {
                    self.end(Err(ExchangeError::Answer { from, error }));
                }
                return;
            }
        };
        if let Pci::Flow { status, block_size, separation_us } = pci {
            if let Err(error) = self.sender.flow(now_ns, status, block_size, separation_us) {
                self.end(Err(ExchangeError::Request(error)));
            }
            return;
        }
        let place = self.servers.iter().position(|server| server.from == from).unwrap_or_else(|| {
            let receiver = TransferReceiver::new(flow_to, self.settings, self.flow_by_device.contains(&from));
            self.servers.push(Server { from, receiver, pending: 0, pending_until_ns: None });
            self.servers.len() - 1
        });
        match self.servers[place].receiver.take(now_ns, pci) {
            Ok(Some(data)) => self.answered(now_ns, place, data),
            Ok(None) => {}
            Err(error) => self.broke(place, error),
        }
    }

    fn gap(&mut self, _now_ns: u64) {
        for place in 0..self.servers.len() {
            if let Err(error) = self.servers[place].receiver.gap() {
                self.broke(place, error);
            }
        }
    }

    fn due_ns(&self) -> Option<u64> {
        let receivers = self.servers.iter().filter_map(|server| server.receiver.due_ns());
        let due = earlier(self.sender.due_ns(), receivers.min());
        let Some(asked_ns) = self.asked_ns else {
            let patience = |begun_ns: u64| begun_ns.saturating_add(self.timing.patience_ns);
            return if self.under_way.is_empty() { earlier(due, self.begun_ns.map(patience)) } else { due };
        };
        let (p2, patience) = (asked_ns + self.timing.p2_ns, asked_ns + self.timing.patience_ns);
        // Answers that have begun have their own deadlines.
        if self.servers.iter().any(|server| server.receiver.is_receiving()) {
            return earlier(due, Some(patience));
        }
        let pending = self.servers.iter().filter_map(|server| server.pending_until_ns).max();
        let waits = pending.map_or(p2, |pending| pending.max(p2)).min(patience);
        earlier(due, Some(waits))
    }

    fn is_done(&self) -> bool {
        self.end.is_some()
    }
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
