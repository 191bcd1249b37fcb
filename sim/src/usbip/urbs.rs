//! A kernel's transfers as transactions: the part of a host controller that USB/IP leaves to this side. It keeps a queue and
//! toggles for each endpoint, and endpoint 0's transfers in order.
//!
//! The kernel's virtual controller keeps resets of the port and SET_ADDRESS to itself. A reset of the port shows in the
//! beginning of its enumeration, a request for 64 bytes of the device descriptor: this side drives a reset before it, and
//! another, with an address, before what comes next, as on a port that the kernel drives itself.

use std::collections::VecDeque;

use super::exported::Endpoint;
use super::urb::{Completion, Urb};
use cantap_emu::otg::{InReply, OutReply};
use cantap_emu::usb_host::{Counters, HostDriver, Outcome, Request, Step, Token, Transfer};

// Linux's error numbers, which USB/IP carries.
/// The endpoint is halted, or the request was refused.
pub const EPIPE: i32 = -32;
/// No answer, or a broken protocol.
const EPROTO: i32 = -71;
/// More arrived than was requested.
pub const EOVERFLOW: i32 = -75;

const GET_DESCRIPTOR: (u8, u8) = (0x80, 6);
const SET_ADDRESS: (u8, u8) = (0x00, 5);
const SET_CONFIGURATION: (u8, u8) = (0x00, 9);
const SET_INTERFACE: (u8, u8) = (0x01, 11);
const CLEAR_ENDPOINT_FEATURE: (u8, u8) = (0x02, 1);
const SET_CONTROL_LINE_STATE: (u8, u8) = (0x21, 0x22);
const DEVICE_DESCRIPTOR: u16 = 0x0100;
/// What Linux asks for first, before it knows the size of endpoint 0's packets.
const FIRST_LOOK_BYTES: u16 = 64;
/// Endpoint 0's packets, until the device has said how large they are.
const LARGEST_PACKET: usize = 64;
/// The time a device has to adopt its address, in ms (USB 2.0, 9.2.6.3).
const ADDRESS_PAUSE_MS: u64 = 2;
/// Attempts at a transaction that gets no answer (USB 2.0, 10.2.6).
const ATTEMPTS: u32 = 3;

/// Who requested a control transfer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Owner {
    Kernel(u32),
    /// The server's own.
    Server,
    /// SET_ADDRESS, which the kernel keeps to itself.
    Address(u8),
}

#[derive(Debug)]
enum Job {
    Reset { first_look: bool },
    Transfer(Owner, Transfer),
}

/// An endpoint's queue.
#[derive(Debug)]
struct Pipe {
    endpoint: Endpoint,
    interrupt: bool,
    data1: bool,
    deferred: bool,
    /// Frames until an interrupt endpoint is due.
    due_in: u32,
    queue: VecDeque<Urb>,
}

/// The driver.
#[derive(Debug)]
pub struct Urbs {
    address: u8,
    addresses_given: u8,
    /// A reset has ended since the cable was plugged in, and the device is still there.
    present: bool,
    /// The kernel assumes that the device has an address, but so far it has only been reset.
    unaddressed: bool,
    ep0_packet: usize,
    ep0_deferred: bool,
    jobs: VecDeque<Job>,
    reset_request: bool,
    pause: Option<u64>,
    endpoints: Vec<Endpoint>,
    pipes: Vec<Pipe>,
    /// The pipe of the last chosen token; `None` is endpoint 0.
    chosen: Option<usize>,
    turn: usize,
    completed: Vec<Completion>,
    answers: Vec<Outcome>,
    /// The kernel has taken what it requested and requests no more.
    starved: bool,
    resets: u64,
}

impl Urbs {
    /// Without a device.
    pub fn new() -> Self {
        Self {
            address: 0,
            addresses_given: 0,
            present: false,
            unaddressed: true,
            ep0_packet: LARGEST_PACKET,
            ep0_deferred: false,
            jobs: VecDeque::new(),
            reset_request: false,
            pause: None,
            endpoints: Vec::new(),
            pipes: Vec::new(),
            chosen: None,
            turn: 0,
            completed: Vec::new(),
            answers: Vec::new(),
            starved: false,
            resets: 0,
        }
    }

    /// Sets which endpoints there are, once the descriptors are known.
    pub fn set_endpoints(&mut self, endpoints: &[Endpoint]) {
        self.endpoints = endpoints.to_vec();
    }

    /// Whether there is a device that has been reset.
    pub fn is_present(&self) -> bool {
        self.present
    }

    /// Whether the next packet of bulk IN, and that of bulk OUT, is DATA1.
    pub fn next_data1(&self) -> [bool; 2] {
        let next = |input: bool| {
            let is_it = |pipe: &&Pipe| !pipe.interrupt && (pipe.endpoint.address & 0x80 != 0) == input;
            self.pipes.iter().find(is_it).is_some_and(|pipe| pipe.data1)
        };
        [next(true), next(false)]
    }

    /// Resets of the bus so far.
    pub fn resets(&self) -> u64 {
        self.resets
    }

    /// Whether the kernel owes reads of an open port.
    pub fn is_starved(&self) -> bool {
        self.starved
    }

    /// Whether something is waiting that would wait for ever if time stood still.
    pub fn waits_for_time(&self) -> bool {
        let waits = |pipe: &Pipe| pipe.endpoint.address & 0x80 == 0 && !pipe.queue.is_empty();
        !self.jobs.is_empty() || self.pipes.iter().any(waits)
    }

    /// The transfers that have ended since the last call.
    pub fn take_completed(&mut self) -> Vec<Completion> {
        std::mem::take(&mut self.completed)
    }

    /// The kernel resets the port. The reset is driven, and an address set, before what comes next.
    pub fn reset(&mut self) {
        self.unaddressed = true;
    }

    /// A request from the server itself; [`Self::take_answers`] returns how it ended.
    pub fn ask(&mut self, request: Request) {
        self.jobs.push_back(Job::Transfer(Owner::Server, Transfer::new(request)));
    }

    /// How the server's own requests ended, once there are `count`.
    pub fn take_answers(&mut self, count: usize) -> Option<Vec<Outcome>> {
        (self.answers.len() >= count).then(|| std::mem::take(&mut self.answers))
    }

    /// Takes a transfer from the kernel.
    pub fn submit(&mut self, urb: Urb) {
        if !self.present {
            // The kernel learns it from the end of the connection: an answer now would make its driver submit again
            // while its controller shuts down, and Linux 6.1 never gets out of that.
            return;
        }
        if urb.is_control() {
            return self.submit_control(urb);
        }
        let interrupt = urb.interval > 0;
        let found = self.pipes.iter().position(|pipe| pipe.endpoint.address == urb.endpoint);
        let n = found.unwrap_or_else(|| {
            let known = self.endpoints.iter().find(|endpoint| endpoint.address == urb.endpoint);
            let unknown = Endpoint {
                address: urb.endpoint,
                packet: LARGEST_PACKET,
                interface: 0,
                kind: 0,
                interval: 0,
            };
            let endpoint = *known.unwrap_or(&unknown);
            let queue = VecDeque::new();
            self.pipes.push(Pipe { endpoint, interrupt, data1: false, deferred: false, due_in: 0, queue });
            self.pipes.len() - 1
        });
        self.starved &= !urb.is_input() || interrupt;
        self.pipes[n].queue.push_back(urb);
    }

    fn submit_control(&mut self, urb: Urb) {
        let request = Request::from_setup(urb.setup, urb.data);
        let what = (request.kind, request.request);
        let first_look =
            (what, request.value, request.length) == (GET_DESCRIPTOR, DEVICE_DESCRIPTOR, FIRST_LOOK_BYTES);
        if first_look {
            self.jobs.push_back(Job::Reset { first_look });
            self.unaddressed = true;
        } else if self.unaddressed {
            self.addresses_given = self.addresses_given % 127 + 1;
            let address = self.addresses_given;
            let give = Request::new(SET_ADDRESS.0, SET_ADDRESS.1, address.into(), 0, 0);
            self.jobs.push_back(Job::Reset { first_look });
            self.jobs.push_back(Job::Transfer(Owner::Address(address), Transfer::new(give)));
            self.unaddressed = false;
        }
        if what == SET_CONTROL_LINE_STATE && request.value & 1 == 0 {
            // Nobody reads a closed port.
            self.starved = false;
        }
        self.jobs.push_back(Job::Transfer(Owner::Kernel(urb.seq), Transfer::new(request)));
    }

    /// Withdraws a transfer; returns whether it was still pending.
    pub fn unlink(&mut self, seq: u32) -> bool {
        self.starved = false;
        let before = self.pending();
        self.jobs.retain(|job| !matches!(job, Job::Transfer(owner, _) if *owner == Owner::Kernel(seq)));
        self.pipes.iter_mut().for_each(|pipe| pipe.queue.retain(|urb| urb.seq != seq));
        self.pending() < before
    }

    fn pending(&self) -> usize {
        self.jobs.len() + self.pipes.iter().map(|pipe| pipe.queue.len()).sum::<usize>()
    }

    /// The control transfer at the head of the queue has ended.
    fn control_ended(&mut self, outcome: Outcome) {
        let Some(Job::Transfer(owner, transfer)) = self.jobs.pop_front() else { return };
        let request = transfer.request();
        let what = (request.kind, request.request);
        if let (GET_DESCRIPTOR, DEVICE_DESCRIPTOR, Outcome::Done(bytes)) = (what, request.value, &outcome) {
            self.ep0_packet = bytes.get(7).map_or(self.ep0_packet, |packet| (*packet).into());
        }
        let done = matches!(outcome, Outcome::Done(_));
        match owner {
            Owner::Server => self.answers.push(outcome),
            Owner::Address(address) => {
                self.address = if done { address } else { 0 };
                self.pause = Some(ADDRESS_PAUSE_MS);
            }
            Owner::Kernel(seq) => {
                if done {
                    self.follow_toggles(what, request.value, request.index as u8);
                }
                let out = request.data.len();
                let (status, data) = match outcome {
                    Outcome::Done(data) => (0, data),
                    Outcome::Stalled => (EPIPE, Vec::new()),
                    Outcome::Failed(_) => (EPROTO, Vec::new()),
                };
                let actual = if done { out.max(data.len()) } else { 0 };
                self.completed.push(Completion { seq, status, actual, data });
            }
        }
    }

    /// Toggles begin with DATA0 after these requests (USB 2.0, 9.1.1.5, 9.4.5 and 9.4.10).
    fn follow_toggles(&mut self, what: (u8, u8), value: u16, index: u8) {
        for pipe in &mut self.pipes {
            let begins = match what {
                SET_CONFIGURATION => true,
                SET_INTERFACE => pipe.endpoint.interface == index,
                CLEAR_ENDPOINT_FEATURE => value == 0 && pipe.endpoint.address == index,
                _ => false,
            };
            pipe.data1 &= !begins;
        }
    }

    /// The transfer at the head of a pipe's queue has ended.
    fn finish(&mut self, n: usize, status: i32) {
        let pipe = &mut self.pipes[n];
        let Some(urb) = pipe.queue.pop_front() else { return };
        let input = urb.is_input();
        self.starved |= input && !pipe.interrupt && pipe.queue.is_empty();
        let (actual, data) = if input { (urb.data.len(), urb.data) } else { (urb.sent, Vec::new()) };
        self.completed.push(Completion { seq: urb.seq, status, actual, data });
    }

    fn silence(&mut self, n: usize) {
        let Some(urb) = self.pipes[n].queue.front_mut() else { return };
        urb.silences += 1;
        if urb.silences >= ATTEMPTS {
            self.finish(n, EPROTO);
        }
    }

    fn token(&mut self, n: usize) -> Option<Token> {
        self.chosen = Some(n);
        let Pipe { endpoint, interrupt, data1, queue, .. } = &self.pipes[n];
        let number = endpoint.address & 15;
        let urb = queue.front()?;
        if urb.is_input() {
            return Some(Token::In { endpoint: number, bulk: !interrupt });
        }
        let rest = &urb.data[urb.sent..];
        let bytes = rest[..rest.len().min(endpoint.packet)].to_vec();
        Some(Token::Out { endpoint: number, data1: *data1, bytes })
    }
}

impl HostDriver for Urbs {
    fn detach(&mut self) {
        let (addresses_given, resets) = (self.addresses_given, self.resets);
        let endpoints = std::mem::take(&mut self.endpoints);
        *self = Self { addresses_given, endpoints, resets, ..Self::new() };
    }

    fn address(&self) -> u8 {
        self.address
    }

    fn after_reset(&mut self, _second_wanted: bool) {
        self.present = true;
        self.address = 0;
        self.resets += 1;
        self.pipes.iter_mut().for_each(|pipe| pipe.data1 = false);
    }

    fn start_frame(&mut self) {
        self.pipes.iter_mut().for_each(|pipe| pipe.due_in = pipe.due_in.saturating_sub(1));
    }

    fn choose(&mut self, room: bool) -> Option<Token> {
        let due = |pipe: &Pipe| pipe.interrupt && pipe.due_in == 0 && !pipe.queue.is_empty();
        if let Some(n) = self.pipes.iter().position(due) {
            self.pipes[n].due_in = self.pipes[n].queue.front().map_or(1, |urb| urb.interval);
            return self.token(n);
        }
        self.chosen = None;
        match self.jobs.front().filter(|_| !self.ep0_deferred) {
            Some(Job::Transfer(_, transfer)) => {
                return Some(match transfer.step(self.ep0_packet) {
                    Step::Setup(packet) => Token::Setup(packet),
                    Step::In => Token::In { endpoint: 0, bulk: false },
                    Step::Out { data1, bytes } => Token::Out { endpoint: 0, data1, bytes },
                });
            }
            Some(Job::Reset { first_look }) => {
                self.ep0_packet = if *first_look { LARGEST_PACKET } else { self.ep0_packet };
                self.jobs.pop_front();
                self.reset_request = true;
                return None;
            }
            None => {}
        }
        let ready = |pipe: &Pipe| !pipe.interrupt && !pipe.deferred && !pipe.queue.is_empty();
        let count = self.pipes.len();
        let next = (0..count).map(|i| (self.turn + i) % count).find(|n| room && ready(&self.pipes[*n]))?;
        self.turn = next + 1;
        self.token(next)
    }

    fn defer(&mut self, _endpoint: u8, _input: bool) {
        match self.chosen {
            None => self.ep0_deferred = true,
            Some(n) => self.pipes[n].deferred = !self.pipes[n].interrupt,
        }
    }

    fn any_deferred(&self) -> bool {
        self.ep0_deferred || self.pipes.iter().any(|pipe| pipe.deferred)
    }

    fn clear_deferred(&mut self) {
        self.ep0_deferred = false;
        self.pipes.iter_mut().for_each(|pipe| pipe.deferred = false);
    }

    fn answered_out(&mut self, pipe: Option<usize>, reply: OutReply, counters: &mut Counters) {
        let (Some(n), Some(length)) = (self.chosen, pipe) else {
            let packet = self.ep0_packet;
            let Some(Job::Transfer(_, transfer)) = self.jobs.front_mut() else { return };
            let outcome = transfer.on_out(reply, packet);
            return outcome.into_iter().for_each(|outcome| self.control_ended(outcome));
        };
        match reply {
            OutReply::Nak => {}
            OutReply::Silence => {
                counters.silences += 1;
                self.silence(n);
            }
            OutReply::Stall => {
                counters.stalls += 1;
                self.finish(n, EPIPE);
            }
            OutReply::Ack => {
                counters.out_packets += 1;
                let pipe = &mut self.pipes[n];
                pipe.data1 = !pipe.data1;
                let Some(urb) = pipe.queue.front_mut() else { return };
                (urb.sent, urb.silences) = (urb.sent + length, 0);
                let full = length == pipe.endpoint.packet;
                if urb.sent == urb.data.len() && !(urb.zero_packet && full) {
                    self.finish(n, 0);
                }
            }
        }
    }

    fn answered_in(
        &mut self,
        _endpoint: u8,
        bulk: bool,
        reply: InReply,
        _read_bytes: usize,
        counters: &mut Counters,
    ) {
        let Some(n) = self.chosen else {
            let packet = self.ep0_packet;
            let Some(Job::Transfer(_, transfer)) = self.jobs.front_mut() else { return };
            let outcome = transfer.on_in(reply, packet);
            return outcome.into_iter().for_each(|outcome| self.control_ended(outcome));
        };
        let (data1, bytes) = match reply {
            InReply::Data { data1, bytes } => (data1, bytes),
            InReply::Nak => return,
            InReply::Silence => {
                counters.silences += 1;
                return self.silence(n);
            }
            InReply::Stall => {
                counters.stalls += 1;
                return self.finish(n, EPIPE);
            }
        };
        let pipe = &mut self.pipes[n];
        if data1 != pipe.data1 {
            counters.repeated += 1;
            return;
        }
        pipe.data1 = !data1;
        if bulk {
            counters.in_packets += 1;
            counters.in_bytes += bytes.len() as u64;
        } else {
            counters.notifications += 1;
        }
        let packet = pipe.endpoint.packet;
        let Some(urb) = pipe.queue.front_mut() else { return };
        urb.silences = 0;
        urb.data.extend_from_slice(&bytes);
        if urb.data.len() > urb.length {
            urb.data.truncate(urb.length);
            self.finish(n, EOVERFLOW);
        } else if bytes.len() < packet || urb.data.len() == urb.length {
            self.finish(n, 0);
        }
    }

    fn take_reset_request(&mut self) -> bool {
        std::mem::take(&mut self.reset_request)
    }

    fn take_pause(&mut self) -> Option<u64> {
        self.pause.take()
    }
}
