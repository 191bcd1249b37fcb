//! What the operating system does with a device: enumerates it in the order that Linux does (a first
//! look at 64 bytes, a second reset, the address, descriptors, strings), then drives it as a CDC-ACM
//! serial port. It only chooses transactions and judges answers; the bus is `mod.rs`'s.

use std::collections::VecDeque;

use super::control::{Outcome, Request, Step, Transfer};
use super::counters::Counters;
use super::descriptors::{CdcAcm, Device};
use super::enumeration_error::EnumerationError;
use super::host_driver::{HostDriver, Token};
use crate::otg::{InReply, OutReply};

mod enumeration;
mod purpose;

use purpose::Purpose;

/// Bytes that the driver buffers for an application that does not read; then it stops requesting more.
const INPUT_LIMIT: usize = 64 * 1024;

/// The line coding that the driver sets: 115200 8N1, which the device only needs to remember.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineCoding(pub [u8; 7]);

impl Default for LineCoding {
    fn default() -> Self {
        let [a, b, c, d] = 115_200_u32.to_le_bytes();
        Self([a, b, c, d, 0, 0, 8])
    }
}

/// What a device reported about itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The device descriptor.
    pub device: Device,
    /// The CDC-ACM function.
    pub acm: CdcAcm,
    /// Manufacturer, product and serial number.
    pub strings: [String; 3],
}

#[derive(Debug)]
struct Pending {
    purpose: Purpose,
    transfer: Transfer,
    request: Request,
    started: Option<u64>,
}

/// The driver's state.
#[derive(Debug)]
pub struct Driver {
    address: u8,
    last_address: u8,
    ep0_packet: usize,
    resets: u32,
    second_wanted: bool,
    pending: Option<Pending>,
    device: Option<Device>,
    configuration_length: u16,
    usb_version: u16,
    acm: Option<CdcAcm>,
    language: u16,
    strings: [String; 3],
    configured: bool,
    identity: Option<Identity>,
    failure: Option<EnumerationError>,
    reset_request: bool,
    pause: Option<u64>,
    port_wanted: bool,
    /// The state of DTR in the request under way.
    lines_sent: bool,
    coding_set: bool,
    port_open: bool,
    /// A new configuration leaves the port to the program that has it open, without notice.
    pub(super) keeps_port: bool,
    /// The device is configured, and the driver has its interfaces.
    bound: bool,
    /// A bulk pipe that was found halted, by its address.
    stalled: Option<u8>,
    in_data1: bool,
    out_data1: bool,
    notify_data1: bool,
    notify_in: u32,
    /// Pipes that answered NAK in this round: control, bulk IN, bulk OUT.
    deferred: [bool; 3],
    out_turn: bool,
    partial: Vec<u8>,
    user: VecDeque<Request>,
    pub(super) input: Vec<u8>,
    pub(super) output: VecDeque<u8>,
    pub(super) reading: bool,
    pub(super) outcomes: VecDeque<Outcome>,
    pub(super) enumerations: u64,
}

impl Driver {
    /// Without a device.
    #[allow(clippy::new_without_default, reason = "a driver belongs to a port, which makes it")]
    pub fn new() -> Self {
        Self {
            address: 0,
            last_address: 0,
            ep0_packet: 64,
            resets: 0,
            second_wanted: true,
            pending: None,
            device: None,
            configuration_length: 0,
            usb_version: 0,
            acm: None,
            language: 0,
            strings: Default::default(),
            configured: false,
            identity: None,
            failure: None,
            reset_request: false,
            pause: None,
            port_wanted: false,
            lines_sent: false,
            coding_set: false,
            port_open: false,
            keeps_port: false,
            bound: false,
            stalled: None,
            in_data1: false,
            out_data1: false,
            notify_data1: false,
            notify_in: 0,
            deferred: [false; 3],
            out_turn: false,
            partial: Vec::new(),
            user: VecDeque::new(),
            input: Vec::new(),
            output: VecDeque::new(),
            reading: true,
            outcomes: VecDeque::new(),
            enumerations: 0,
        }
    }

    pub(super) fn ready(&self) -> bool {
        self.configured
    }

    pub(super) fn port_ready(&self) -> bool {
        self.configured && self.port_wanted && self.port_open
    }

    pub(super) fn failure(&self) -> Option<&EnumerationError> {
        self.failure.as_ref()
    }

    pub(super) fn identity(&self) -> Option<&Identity> {
        self.identity.as_ref()
    }

    pub(super) fn open_port(&mut self) {
        self.port_wanted = true;
    }

    pub(super) fn close_port(&mut self) {
        self.port_wanted = false;
        self.partial.clear();
        self.output.clear();
    }

    pub(super) fn control(&mut self, request: Request) {
        self.user.push_back(request);
    }

    /// Begins the control transfer that is due on a configured device, if any.
    fn begin_next(&mut self) {
        if !self.configured || self.pending.is_some() {
            return;
        }
        if let Some(address) = self.stalled.take() {
            self.begin(Purpose::ClearHalt(address));
        } else if self.bound && self.port_wanted != self.port_open {
            let coding_first = self.port_wanted && !self.coding_set;
            self.begin(if coding_first { Purpose::PutCoding } else { Purpose::Lines });
        } else if !self.user.is_empty() {
            self.begin(Purpose::User);
        }
    }
}

impl HostDriver for Driver {
    fn detach(&mut self) {
        *self = Self {
            last_address: self.last_address,
            identity: self.identity.take(),
            input: std::mem::take(&mut self.input),
            reading: self.reading,
            keeps_port: self.keeps_port,
            outcomes: std::mem::take(&mut self.outcomes),
            enumerations: self.enumerations,
            ..Self::new()
        };
    }

    fn address(&self) -> u8 {
        self.address
    }

    fn take_reset_request(&mut self) -> bool {
        std::mem::take(&mut self.reset_request)
    }

    fn take_pause(&mut self) -> Option<u64> {
        self.pause.take()
    }

    /// The port's reset is over: what follows is the first look, or, after the second reset, the rest.
    fn after_reset(&mut self, second_wanted: bool) {
        self.resets += 1;
        self.second_wanted = second_wanted;
        self.address = 0;
        self.begin(if self.resets == 1 { Purpose::FirstLook } else { Purpose::Address });
    }

    fn start_frame(&mut self) {
        self.notify_in = self.notify_in.saturating_sub(1);
    }

    fn restart_clock(&mut self) {
        if let Some(pending) = &mut self.pending {
            pending.started = None;
        }
    }

    fn check_time(&mut self, now: u64, limit: u64) {
        if let Some(pending) = &mut self.pending {
            let started = *pending.started.get_or_insert(now);
            if now - started > limit {
                self.ended(Outcome::Failed("answered with NAK for too long"));
            }
        }
    }

    fn choose(&mut self, room: bool) -> Option<Token> {
        self.begin_next();
        if let Some(pending) = self.pending.as_ref().filter(|_| !self.deferred[0]) {
            return Some(match pending.transfer.step(self.ep0_packet) {
                Step::Setup(packet) => Token::Setup(packet),
                Step::In => Token::In { endpoint: 0, bulk: false },
                Step::Out { data1, bytes } => Token::Out { endpoint: 0, data1, bytes },
            });
        }
        if self.stalled.is_some()
            || self.pending.as_ref().is_some_and(|pending| pending.request.restarts_pipes())
        {
            // Nothing is under way on a pipe whose toggles are about to be reset.
            return None;
        }
        let acm = self.acm.filter(|_| self.bound && self.configured && self.port_open)?;
        if self.notify_in == 0 {
            self.notify_in = u32::from(acm.notification.interval);
            return Some(Token::In { endpoint: acm.notification.number, bulk: false });
        }
        if !room {
            return None;
        }
        let input = self.reading && self.port_wanted && self.input.len() < INPUT_LIMIT && !self.deferred[1];
        let output = !self.output.is_empty() && !self.deferred[2];
        self.out_turn = output && (self.out_turn || !input);
        if self.out_turn {
            let bytes = self.output.iter().take(usize::from(acm.output.packet)).copied().collect();
            self.out_turn = false;
            return Some(Token::Out { endpoint: acm.output.number, data1: self.out_data1, bytes });
        }
        self.out_turn = true;
        input.then_some(Token::In { endpoint: acm.input.number, bulk: true })
    }

    fn defer(&mut self, endpoint: u8, input: bool) {
        let pipe = match (endpoint, input) {
            (0, _) => 0,
            (_, true) => 1,
            (_, false) => 2,
        };
        let notification = input && self.acm.is_some_and(|acm| acm.notification.number == endpoint);
        if !notification {
            self.deferred[pipe] = true;
        }
    }

    fn any_deferred(&self) -> bool {
        self.deferred.contains(&true)
    }

    fn clear_deferred(&mut self) {
        self.deferred = [false; 3];
    }

    fn answered_out(&mut self, pipe: Option<usize>, reply: OutReply, counters: &mut Counters) {
        let Some(length) = pipe else {
            let packet = self.ep0_packet;
            let outcome = self.pending.as_mut().and_then(|pending| pending.transfer.on_out(reply, packet));
            return outcome.into_iter().for_each(|outcome| self.ended(outcome));
        };
        match reply {
            OutReply::Ack => {
                self.output.drain(..length.min(self.output.len()));
                self.out_data1 = !self.out_data1;
                counters.out_packets += 1;
            }
            OutReply::Nak => {}
            OutReply::Silence => counters.silences += 1,
            OutReply::Stall => {
                counters.stalls += 1;
                self.stalled = self.acm.map(|acm| acm.output.number);
            }
        }
    }

    fn answered_in(
        &mut self,
        endpoint: u8,
        bulk: bool,
        reply: InReply,
        read_bytes: usize,
        counters: &mut Counters,
    ) {
        if endpoint == 0 {
            let packet = self.ep0_packet;
            let outcome = self.pending.as_mut().and_then(|pending| pending.transfer.on_in(reply, packet));
            return outcome.into_iter().for_each(|outcome| self.ended(outcome));
        }
        let (data1, bytes) = match reply {
            InReply::Data { data1, bytes } => (data1, bytes),
            InReply::Nak => return,
            InReply::Silence => return counters.silences += 1,
            InReply::Stall => {
                counters.stalls += 1;
                self.stalled = Some(endpoint | 0x80);
                return;
            }
        };
        let expected = if bulk { &mut self.in_data1 } else { &mut self.notify_data1 };
        if data1 != *expected {
            counters.repeated += 1;
            return;
        }
        *expected = !data1;
        if !bulk {
            counters.notifications += 1;
            return;
        }
        counters.in_packets += 1;
        counters.in_bytes += bytes.len() as u64;
        let full = self.acm.is_some_and(|acm| usize::from(acm.input.packet) == bytes.len());
        self.partial.extend_from_slice(&bytes);
        if !full || self.partial.len() >= read_bytes {
            self.input.append(&mut self.partial);
        }
    }
}
