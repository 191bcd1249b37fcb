//! The computer at the other end of the cable: a full-speed root port with its bus timing (this
//! file), an operating system's enumeration and CDC-ACM driver on top (`driver.rs`), and every way in
//! which a host can misbehave, at any instant.
//!
//! Time is core cycles; one transaction is one event. A data packet takes the bus time that USB 2.0
//! specifies (5.8.4: 19 packets of 64 bytes fit into a frame), and a pipe that was answered with NAK is
//! tried again after [`Timing::retry`].

pub mod control;
mod counters;
mod descriptors;
mod driver;
mod enumeration_error;
mod host_driver;
mod timing;

pub use control::{Outcome, Request, Step, Transfer};
pub use counters::Counters;
pub use descriptors::{CdcAcm, Device, Pipe};
pub use driver::{Driver as CdcDriver, Identity, LineCoding};
pub use enumeration_error::EnumerationError;
pub use host_driver::{HostDriver, Token};
pub use timing::Timing;

use crate::otg::{InReply, Otg, OutReply};

/// The bits of a frame number in a SOF token (USB 2.0, 8.4.3).
const FRAME_NUMBER: u32 = 0x7FF;
/// Bytes of bus time that a transaction takes in addition to its data (USB 2.0, 5.8.4, full-speed bulk).
const OVERHEAD_BYTES: u64 = 13;
/// Bytes of bus time of a token answered with NAK: token, handshake, two turnarounds.
const NAK_BYTES: u64 = 6;
/// Silence after which a device must suspend (USB 2.0, 7.1.7.6).
const IDLE_MS: u64 = 3;

/// What the port is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bus {
    /// No cable, no power, or a dead host; the bus is idle.
    Off,
    /// Waiting for a pull-up.
    Empty,
    /// A pull-up was detected.
    Debounce { until: u64 },
    /// Driving reset.
    Reset { until: u64 },
    /// Frames and transactions.
    Running,
    /// Told to be silent.
    Suspended,
    /// Driving resume.
    Resuming { until: u64 },
}

/// How far the host has got with the device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Status {
    /// There is nothing on the port, or the port is off.
    NoDevice,
    /// Reset and enumeration are under way.
    Enumerating,
    /// Configured, with a driver.
    Ready,
    /// Configured, suspended by the host.
    Suspended,
    /// It did not enumerate.
    Failed(EnumerationError),
}

/// A transaction on the bus, decided when it ends.
#[derive(Debug)]
struct Flight {
    token: Token,
    begun: u64,
    until: u64,
}

/// The host.
#[derive(Debug)]
pub struct UsbHost<D = CdcDriver> {
    timing: Timing,
    bus: Bus,
    /// The cable is in, and the host has power.
    plugged: bool,
    powered: bool,
    /// When the device will have seen 3 ms of silence.
    idle_at: Option<u64>,
    frame_at: u64,
    /// The number of the frame that starts then.
    frame: u64,
    /// When the last frame started; cleared when read.
    sof: Option<u64>,
    packets_this_frame: u32,
    flight: Option<Flight>,
    next_transaction: u64,
    driver: D,
    /// The handshake of every n-th IN packet is lost.
    drop_handshake_every: Option<u64>,
    counters: Counters,
    now: u64,
}

impl<D: HostDriver> UsbHost<D> {
    /// A host without a device: the cable is out.
    pub fn new(timing: Timing, driver: D) -> Self {
        Self {
            timing,
            bus: Bus::Off,
            plugged: false,
            powered: true,
            idle_at: Some(timing.clock.ms(IDLE_MS)),
            frame_at: 0,
            frame: 0,
            sof: None,
            packets_this_frame: 0,
            flight: None,
            next_transaction: 0,
            driver,
            drop_handshake_every: None,
            counters: Counters::default(),
            now: 0,
        }
    }

    /// Its timing, which may be changed at any time.
    pub fn timing_mut(&mut self) -> &mut Timing {
        &mut self.timing
    }

    /// Puts the cable in.
    pub fn plug(&mut self) {
        self.plugged = true;
        self.rest();
    }

    /// Pulls the cable out.
    pub fn unplug(&mut self) {
        self.plugged = false;
        self.rest();
    }

    /// The host dies: no more frames, nothing read. The cable and its 5 V stay.
    pub fn die(&mut self) {
        self.powered = false;
        self.rest();
    }

    /// The host boots: it resets and enumerates what it finds.
    pub fn boot(&mut self) {
        self.powered = true;
        self.rest();
    }

    /// Everything under way ends; the bus is silent from now on.
    fn rest(&mut self) {
        self.driver.detach();
        self.flight = None;
        self.bus = if self.plugged && self.powered { Bus::Empty } else { Bus::Off };
        self.idle_at = Some(self.now + self.timing.clock.ms(IDLE_MS));
        self.next_transaction = self.now;
    }

    /// Resets the device and enumerates it again, as a host does after an error.
    pub fn reset(&mut self, otg: &mut Otg) {
        if matches!(self.bus, Bus::Off | Bus::Empty | Bus::Debounce { .. }) {
            return;
        }
        self.driver.detach();
        self.begin_reset(otg);
    }

    fn begin_reset(&mut self, otg: &mut Otg) {
        self.flight = None;
        self.idle_at = None;
        self.bus = Bus::Reset { until: self.now + self.timing.reset };
        otg.bus_reset();
    }

    /// Stops all traffic. The device suspends 3 ms later.
    pub fn suspend(&mut self) {
        if self.bus == Bus::Running {
            self.flight = None;
            self.bus = Bus::Suspended;
            self.idle_at = Some(self.now + self.timing.clock.ms(IDLE_MS));
        }
    }

    /// Wakes the device; traffic continues where it stopped.
    pub fn resume(&mut self, otg: &mut Otg) {
        if self.bus == Bus::Suspended {
            self.idle_at = None;
            self.bus = Bus::Resuming { until: self.now + self.timing.resume };
            otg.resume();
        }
    }

    /// Drops the handshake of every `n`-th bulk IN packet, so that the device sends it again.
    pub fn drop_handshake_every(&mut self, n: Option<u64>) {
        self.drop_handshake_every = n;
    }

    /// The driver, which chooses the transactions.
    pub fn driver(&mut self) -> &mut D {
        &mut self.driver
    }

    /// Withdraws the transaction on the bus, as if it had never begun.
    pub fn abandon_transaction(&mut self) {
        self.flight = None;
    }

    /// Whether there are frames on the bus.
    pub fn is_running(&self) -> bool {
        self.bus == Bus::Running
    }
}

impl UsbHost {
    /// An application opens the serial port: line coding, then DTR and RTS. Nothing is read before.
    pub fn open_port(&mut self) {
        self.driver.open_port();
    }

    /// The application closes the port, or is killed: the driver stops reading and drops DTR.
    pub fn close_port(&mut self) {
        self.driver.close_port();
    }

    /// Sets whether the application reads. If it does not, the driver leaves the pipe alone.
    pub fn read(&mut self, reading: bool) {
        self.driver.reading = reading;
    }

    /// Sets whether a new configuration leaves the port to the program that has it open, without notice. Otherwise the driver opens
    /// it again.
    pub fn keep_port(&mut self, keep: bool) {
        self.driver.keeps_port = keep;
    }

    /// Queues bytes for the device.
    pub fn send(&mut self, bytes: &[u8]) {
        self.driver.output.extend(bytes);
    }

    /// Bytes queued but not sent yet.
    pub fn unsent(&self) -> usize {
        self.driver.output.len()
    }

    /// Takes the bytes that the device sent and the driver's reads have delivered.
    pub fn receive(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.driver.input)
    }

    /// Bytes waiting for [`Self::receive`].
    pub fn received(&self) -> usize {
        self.driver.input.len()
    }

    /// Sends a request to endpoint 0 once the device is configured; [`Self::control_outcome`]
    /// returns how it ended.
    pub fn control(&mut self, request: Request) {
        self.driver.control(request);
    }

    /// How the oldest request of [`Self::control`] ended.
    pub fn control_outcome(&mut self) -> Option<Outcome> {
        self.driver.outcomes.pop_front()
    }

    /// How far the host has got with the device.
    pub fn status(&self) -> Status {
        match (self.bus, self.driver.failure()) {
            (Bus::Off | Bus::Empty, _) => Status::NoDevice,
            (_, Some(error)) => Status::Failed(error.clone()),
            (Bus::Suspended | Bus::Resuming { .. }, None) => Status::Suspended,
            (Bus::Running, None) if self.driver.ready() => Status::Ready,
            _ => Status::Enumerating,
        }
    }

    /// Whether the port is open and the device knows it.
    pub fn port_ready(&self) -> bool {
        self.bus == Bus::Running && self.driver.port_ready()
    }

    /// What the device reported about itself at its last enumeration.
    pub fn identity(&self) -> Option<&Identity> {
        self.driver.identity()
    }

    /// What was counted.
    pub fn counters(&self) -> Counters {
        Counters { enumerations: self.driver.enumerations, ..self.counters }
    }
}

impl<D: HostDriver> UsbHost<D> {
    /// What the bus counted.
    pub fn bus_counters(&self) -> Counters {
        self.counters
    }

    /// When [`Self::advance`] must be called next.
    pub fn next_event(&self, otg: &Otg) -> Option<u64> {
        let bus = match self.bus {
            Bus::Off | Bus::Suspended => None,
            Bus::Empty => otg.pulled_up(true).then_some(self.now),
            Bus::Debounce { until } | Bus::Reset { until } | Bus::Resuming { until } => Some(until),
            Bus::Running => {
                let transaction = match &self.flight {
                    Some(flight) => flight.until,
                    None => self.next_transaction.max(self.now),
                };
                Some(transaction.min(self.frame_at))
            }
        };
        [bus, self.idle_at].into_iter().flatten().min()
    }

    /// Processes everything that is due at or before `now`.
    pub fn advance(&mut self, otg: &mut Otg, now: u64) {
        while let Some(at) = self.next_event(otg).filter(|at| *at <= now) {
            self.now = self.now.max(at);
            otg.settle(self.now);
            self.step(otg);
        }
        self.now = self.now.max(now);
    }

    fn step(&mut self, otg: &mut Otg) {
        if self.idle_at.is_some_and(|at| at <= self.now) {
            self.idle_at = None;
            otg.bus_idle();
            return;
        }
        match self.bus {
            Bus::Off | Bus::Suspended => {}
            Bus::Empty => self.bus = Bus::Debounce { until: self.now + self.timing.debounce },
            Bus::Debounce { .. } if !otg.pulled_up(true) => self.bus = Bus::Empty,
            Bus::Debounce { .. } => self.begin_reset(otg),
            Bus::Reset { .. } if !otg.pulled_up(true) => self.rest(),
            Bus::Reset { .. } => {
                otg.enumeration_done();
                self.driver.after_reset(self.timing.second_reset);
                self.run(self.timing.recovery);
            }
            Bus::Resuming { .. } => self.run(self.timing.recovery),
            Bus::Running => {
                if self.frame_at <= self.now {
                    self.start_frame(otg);
                } else if self.flight.as_ref().is_some_and(|flight| flight.until <= self.now) {
                    self.land(otg);
                } else {
                    self.take_off(otg);
                }
            }
        }
    }

    /// Frames from now on, transactions after `quiet` cycles.
    fn run(&mut self, quiet: u64) {
        self.bus = Bus::Running;
        self.driver.restart_clock();
        self.frame = self.timing.frame_after(self.now);
        self.frame_at = self.timing.frame_start(self.frame).max(self.now);
        self.next_transaction = self.now + quiet;
    }

    fn start_frame(&mut self, otg: &mut Otg) {
        if !otg.pulled_up(true) {
            // The device went away on its own (reset, bootloader): the port sees a disconnection.
            self.rest();
            return;
        }
        otg.start_of_frame(self.frame as u32 & FRAME_NUMBER);
        self.sof = Some(self.now);
        self.frame += 1;
        self.frame_at = self.timing.frame_start(self.frame);
        self.packets_this_frame = 0;
        self.driver.start_frame();
    }

    /// When the last frame started, if one has since the last call.
    pub fn take_sof(&mut self) -> Option<u64> {
        self.sof.take()
    }

    /// Chooses a transaction and puts it on the bus, if it ends within the frame.
    fn take_off(&mut self, otg: &mut Otg) {
        let budget_left = self.packets_this_frame < self.timing.packets_per_frame;
        let Some(token) = self.driver.choose(budget_left) else {
            if self.obey_driver(otg) {
                return;
            }
            // Pipes that answered NAK are tried again soon; without any, there is nothing to do in
            // this frame.
            let retry = budget_left && self.driver.any_deferred();
            self.driver.clear_deferred();
            self.next_transaction =
                if retry { (self.now + self.timing.retry).min(self.frame_at) } else { self.frame_at };
            return;
        };
        // The outcome of an IN token is decided now, that of an OUT packet when it has arrived.
        let bytes = match &token {
            Token::In { endpoint, .. } => match otg.in_token(self.driver.address(), *endpoint, false) {
                InReply::Data { bytes, .. } => OVERHEAD_BYTES + bytes.len() as u64,
                _ => NAK_BYTES,
            },
            Token::Setup(_) => OVERHEAD_BYTES + 8,
            Token::Out { bytes, .. } => OVERHEAD_BYTES + bytes.len() as u64,
        };
        let until = self.now + bytes * 8 * self.timing.clock.usb_bit();
        if until >= self.frame_at {
            self.next_transaction = self.frame_at;
            return;
        }
        self.flight = Some(Flight { token, begun: self.now, until });
    }

    /// The transaction on the bus ends.
    fn land(&mut self, otg: &mut Otg) {
        let Some(Flight { token, begun, .. }) = self.flight.take() else {
            return;
        };
        let address = self.driver.address();
        let periodic = matches!(token, Token::In { endpoint, bulk: false } if endpoint != 0);
        self.next_transaction = if periodic { self.now } else { self.now.max(begun + self.timing.split) };
        match token {
            Token::Setup(packet) => {
                let reply = otg.setup(address, packet);
                self.driver.answered_out(None, reply, &mut self.counters);
            }
            Token::Out { endpoint, data1, bytes } => {
                let before = otg.thrown_away();
                let reply = otg.out(address, endpoint, data1, &bytes);
                self.counters.thrown_away += otg.thrown_away() - before;
                self.packets_this_frame += 1;
                self.back_off(endpoint, false, reply == OutReply::Nak);
                let pipe = (endpoint != 0).then_some(bytes.len());
                self.driver.answered_out(pipe, reply, &mut self.counters);
            }
            Token::In { endpoint, bulk } => {
                let nth = self.counters.in_packets + self.counters.dropped_handshakes + 1;
                let lost = bulk && self.drop_handshake_every.is_some_and(|n| nth.is_multiple_of(n));
                // The host has received the packet; only its handshake gets lost.
                let reply = otg.in_token(address, endpoint, !lost);
                let data = matches!(reply, InReply::Data { .. });
                self.packets_this_frame += u32::from(data);
                self.back_off(endpoint, true, reply == InReply::Nak);
                self.counters.dropped_handshakes += u64::from(lost && data);
                self.driver.answered_in(endpoint, bulk, reply, self.timing.read_bytes, &mut self.counters);
            }
        }
        self.obey_driver(otg);
        self.driver.check_time(self.now, self.timing.control_timeout);
    }

    /// Resets the device or stays silent for a while, if the driver requests it; returns whether it did.
    fn obey_driver(&mut self, otg: &mut Otg) -> bool {
        if self.driver.take_reset_request() {
            self.begin_reset(otg);
        } else if let Some(pause) = self.driver.take_pause() {
            self.next_transaction = self.now + self.timing.clock.ms(pause);
        } else {
            return false;
        }
        true
    }

    /// A pipe that answered NAK waits until the others have had their turn.
    fn back_off(&mut self, endpoint: u8, input: bool, nak: bool) {
        if nak {
            self.driver.defer(endpoint, input);
        } else {
            self.driver.clear_deferred();
        }
    }
}
