//! A bench with everything on it: the board with its firmware, two CAN buses, a USB host, the capture
//! host and the books. A run is a sequence of calls; time is emulated and stands still between them.

use std::sync::{Arc, Mutex, PoisonError};

use crate::board::CLOCK;
use cantap_wire::message::{ChannelConfig, EndReason, Hello, Status};
use cantap_wire::{BitTiming, CHANNELS, Channel, Command, Event, Record, Refusal, Reply, Response};

use crate::capture::{Ledger, Session, SessionEvent};
use crate::{CYCLES_PER_SECOND, CYCLES_PER_US};
use cantap_emu::bus::{BitTime, BusFrame, Node, Source, Wire};
use cantap_emu::elf::Image;
use cantap_emu::machine::{Machine, Setup};
use cantap_emu::memory_map as map;
use cantap_emu::otg::Otg;
use cantap_emu::soc::rcc::Crystal;
use cantap_emu::stop::Stopped;
use cantap_emu::usb::UsbPort;
use cantap_emu::usb_host::{self, EnumerationError, Timing, UsbHost};

/// Core cycles of a millisecond.
pub const MS: u64 = 1000 * CYCLES_PER_US;
/// How long a device may take from plugging in to a configured port.
const ENUMERATION_TIMEOUT: u64 = 3 * CYCLES_PER_SECOND;
/// How long a request may take, unless [`Rig::be_patient_for`] says otherwise.
const REQUEST_TIMEOUT: u64 = CYCLES_PER_SECOND;
/// A stream that has been silent for this long has ended.
const SILENCE: u64 = 20 * MS;

/// What went wrong on the bench, apart from wrong frames, which the ledger reports.
#[derive(Debug, thiserror::Error)]
pub enum RigError {
    /// The firmware ended.
    #[error("{0}")]
    Stopped(#[from] Stopped),
    /// The device did not enumerate.
    #[error("the device did not enumerate: {0}")]
    Enumeration(EnumerationError),
    /// It did not come up at all.
    #[error("no configured device {0} ms after plugging in")]
    NoDevice(u64),
    /// A request was not answered.
    #[error("no answer to {command} within {millis} ms; the last bytes came {silent_ms} ms ago")]
    NoAnswer {
        /// The request.
        command: String,
        /// How long the rig waited.
        millis: u64,
        /// How long the device had been silent.
        silent_ms: u64,
    },
    /// A request was refused that must be accepted.
    #[error("{command} was refused: {refusal:?}")]
    Refused {
        /// The request.
        command: String,
        /// The reason.
        refusal: Refusal,
    },
    /// A request was answered with the wrong kind of value.
    #[error("{command} was answered with {reply}")]
    WrongReply {
        /// The request.
        command: String,
        /// The value.
        reply: String,
    },
    /// There is no bit timing for a bit rate.
    #[error("{bitrate_bps} bit/s cannot be made from the controllers' clock")]
    BitRate {
        /// The rate.
        bitrate_bps: u32,
    },
}

/// The bench.
pub struct Rig {
    /// The board.
    pub machine: Machine,
    /// What the device sent.
    pub session: Session,
    /// The books that check it.
    pub ledger: Ledger,
    usb: Arc<Mutex<UsbPort>>,
    /// Channels whose frames are in the books.
    booked: [bool; CHANNELS],
    /// From a cut to the next greeting, records are remains of the previous session.
    between_sessions: bool,
    events: Vec<(u64, Event)>,
    /// When and why the device ended the session on its own.
    ended: Option<(u64, EndReason)>,
    last_bytes_at: u64,
    /// Places in each channel's transmit queue, once the device has reported them.
    tx_queue: usize,
    periodic_slots: usize,
    /// What crossed the buses, if it is being kept.
    watched: Option<[Vec<BusFrame>; CHANNELS]>,
    /// Bits of frames on each bus, with intermission, while it was booked.
    bus_bits: [u64; CHANNELS],
    recording: Option<Vec<u8>>,
    /// How long a request may take.
    patience: u64,
}

impl Rig {
    /// A board with `image` and the cable out.
    pub fn new(image: Image, setup: Setup, timing: Timing) -> Self {
        Self::on(Machine::new(image, setup), setup, timing)
    }

    /// The same with a machine that was made with this `setup`.
    pub fn on(mut machine: Machine, setup: Setup, timing: Timing) -> Self {
        let mut usb = UsbPort::new(timing);
        if let Some(hostile) = &setup.hostile {
            usb.otg_mut().set_hostile(hostile, CLOCK);
        }
        let usb = Arc::new(Mutex::new(usb));
        machine.attach(map::OTG_FS, map::OTG_FS_IRQ, Arc::clone(&usb) as _);
        Self {
            machine,
            session: Session::new(),
            ledger: Ledger::new(),
            usb,
            booked: [false; CHANNELS],
            between_sessions: false,
            events: Vec::new(),
            ended: None,
            last_bytes_at: 0,
            tx_queue: 0,
            periodic_slots: 0,
            watched: None,
            bus_bits: [0; CHANNELS],
            recording: None,
            patience: REQUEST_TIMEOUT,
        }
    }

    /// Core cycles since power-on.
    pub fn now(&self) -> u64 {
        self.machine.now()
    }

    /// Runs `action` on the USB host, at the present time.
    pub fn with_host<R>(&mut self, action: impl FnOnce(&mut UsbHost, &mut Otg) -> R) -> R {
        let now = self.machine.now();
        // If a thread panicked while it held the lock, the port's state is as good as any other.
        let mut usb = self.usb.lock().unwrap_or_else(PoisonError::into_inner);
        let (host, otg) = usb.host(now);
        action(host, otg)
    }

    /// Ends what `Setup::hostile` began: from now on the chip is prompt and true.
    pub fn calm(&mut self) {
        self.machine.board().calm();
        self.with_host(|_, otg| otg.calm());
    }

    /// The board's crystal stops, or starts again: see [`Machine::set_crystal`].
    pub fn set_crystal(&mut self, crystal: Crystal) {
        if self.machine.set_crystal(crystal) {
            self.with_host(|_, otg| otg.die());
        }
    }

    /// Waits for answers to requests for at most `cycles` from now on.
    pub fn be_patient_for(&mut self, cycles: u64) {
        self.patience = cycles;
    }

    /// Runs for `cycles`, and collects what the buses carried and the device sent.
    pub fn run_for(&mut self, cycles: u64) -> Result<(), RigError> {
        let until = self.now() + cycles;
        while self.now() < until {
            let slice = until.min(self.now() + MS);
            self.machine.run_until(slice)?;
            self.exchange();
        }
        Ok(())
    }

    /// Runs for `cycles` for another program's host: returns what the device sent and keeps no books.
    pub fn run_unbooked(&mut self, cycles: u64) -> Result<Vec<u8>, RigError> {
        self.run_watched(cycles).map(|(bytes, _)| bytes)
    }

    /// The same, with what crossed each bus.
    pub fn run_watched(&mut self, cycles: u64) -> Result<(Vec<u8>, [Vec<BusFrame>; CHANNELS]), RigError> {
        self.machine.run_until(self.now() + cycles)?;
        let crossed = self.machine.board().wires.each_mut().map(Wire::take_history);
        Ok((self.with_host(|host, _| host.receive()), crossed))
    }

    /// Runs while `goes_on` returns true, checked once a millisecond; returns whether it ended before `limit` cycles were
    /// over.
    pub fn run_while(
        &mut self,
        limit: u64,
        mut goes_on: impl FnMut(&mut Self) -> bool,
    ) -> Result<bool, RigError> {
        let until = self.now() + limit;
        while goes_on(self) {
            if self.now() >= until {
                return Ok(false);
            }
            self.run_for(MS)?;
        }
        Ok(true)
    }

    /// Moves the buses' histories into the books and the host's bytes into the session.
    fn exchange(&mut self) {
        let mut board = self.machine.board();
        for (number, wire) in board.wires.iter_mut().enumerate() {
            let history = wire.take_history();
            if let Some(watched) = &mut self.watched {
                watched[number].extend(&history);
            }
            for crossed in history {
                let bits = u64::from(cantap_emu::bus::bits::bus_bits(&crossed.frame));
                for channel in Channel::ALL {
                    let n = channel.index();
                    if self.booked[n] && crossed.taken_by >> n & 1 != 0 {
                        self.ledger.on_bus(channel, crossed.frame, crossed.valid);
                        self.bus_bits[n] += bits;
                    }
                }
            }
        }
        drop(board);
        let bytes = self.with_host(|host, _| host.receive());
        if bytes.is_empty() {
            return;
        }
        self.last_bytes_at = self.now();
        if let Some(recording) = &mut self.recording {
            recording.extend_from_slice(&bytes);
        }
        let Self { session, ledger, events, ended, between_sessions, .. } = self;
        session.take(&bytes, |event| {
            if *between_sessions {
                return;
            }
            match &event {
                SessionEvent::Record(ticks, Record::Event(event)) => events.push((*ticks, *event)),
                SessionEvent::Ended(ticks, reason) => *ended = Some((*ticks, *reason)),
                SessionEvent::Record(..) | SessionEvent::BatchesLost(_) => {}
            }
            ledger.take(&event);
        });
    }

    /// Puts the cable in, waits for the enumeration and opens the port.
    pub fn plug_in(&mut self) -> Result<(), RigError> {
        self.with_host(|host, _| host.plug());
        self.wait_for_port()
    }

    /// Waits until the device is configured, opens the port and waits until the device knows it.
    pub fn wait_for_port(&mut self) -> Result<(), RigError> {
        let mut failure = None;
        let up = self.run_while(ENUMERATION_TIMEOUT, |rig| {
            rig.with_host(|host, _| match host.status() {
                usb_host::Status::Ready => {
                    host.open_port();
                    !host.port_ready()
                }
                usb_host::Status::Failed(error) => {
                    failure = Some(error);
                    false
                }
                _ => true,
            })
        })?;
        match failure {
            Some(error) => Err(RigError::Enumeration(error)),
            None if up => Ok(()),
            None => Err(RigError::NoDevice(ENUMERATION_TIMEOUT / MS)),
        }
    }

    /// Begins a session.
    pub fn greet(&mut self) -> Result<Hello, RigError> {
        self.session.restart();
        let reply = self.ask(Command::Hello { protocol: cantap_wire::PROTOCOL_VERSION })?;
        let Reply::Hello(hello) = reply else {
            return Err(wrong_reply("Hello", &reply));
        };
        self.between_sessions = false;
        self.ended = None;
        self.tx_queue = hello.tx_queue.into();
        self.periodic_slots = hello.periodic_slots.into();
        self.follow_clock(hello.tick_hz);
        Ok(hello)
    }

    /// Plugs in, opens the port and begins a session.
    pub fn connect(&mut self) -> Result<Hello, RigError> {
        self.plug_in()?;
        self.greet()
    }

    /// Sets the ledger's idea of the device's clock, taken from the stamp timer itself.
    fn follow_clock(&mut self, tick_hz: u32) {
        let origin = self.clock_origin();
        self.ledger.set_clock(origin, CYCLES_PER_SECOND / u64::from(tick_hz));
    }

    /// Sends a request and waits for its answer.
    pub fn request(&mut self, command: Command) -> Result<Response, RigError> {
        let name = name_of(&command);
        let (id, bytes) = self.session.request(command);
        self.with_host(|host, _| host.send(&bytes));
        let mut response = None;
        self.run_while(self.patience, |rig| {
            response = rig.session.response(id);
            response.is_none()
        })?;
        response.ok_or_else(|| RigError::NoAnswer {
            command: name,
            millis: self.patience / MS,
            silent_ms: (self.now() - self.last_bytes_at) / MS,
        })
    }

    /// Sends a request that must not be refused.
    pub fn ask(&mut self, command: Command) -> Result<Reply, RigError> {
        let name = name_of(&command);
        let response = self.request(command)?;
        response.result.map_err(|refusal| RigError::Refused { command: name, refusal })
    }

    /// Opens a channel with a configuration and begins its books.
    pub fn open(&mut self, channel: Channel, config: ChannelConfig) -> Result<(), RigError> {
        self.booked[channel.index()] = true;
        self.ask(Command::Open { channel, config: Some(config) })?;
        Ok(())
    }

    /// Opens a channel that only listens.
    pub fn listen(&mut self, channel: Channel, bitrate_bps: u32) -> Result<(), RigError> {
        self.open(channel, ChannelConfig::listen_only(timing(bitrate_bps)?))
    }

    /// Waits until the device has nothing more to send, for at most `limit` cycles.
    pub fn drain(&mut self, limit: u64) -> Result<bool, RigError> {
        let from = self.now();
        self.run_while(limit, |rig| rig.now() - from.max(rig.last_bytes_at) < SILENCE)
    }

    /// Closes a channel, waits until it has delivered everything, and closes its books.
    pub fn close(&mut self, channel: Channel) -> Result<(), RigError> {
        let stopped = |event: &(u64, Event)| event.1 == Event::Stopped { channel };
        let before = self.events.iter().filter(|event| stopped(event)).count();
        self.ask(Command::Close { channel })?;
        let limit = 3 * CYCLES_PER_SECOND;
        let whole =
            self.run_while(limit, |rig| rig.events.iter().filter(|event| stopped(event)).count() == before)?;
        self.booked[channel.index()] = false;
        self.ledger.close(channel, whole);
        Ok(())
    }

    /// The session was cut (unplugged, reset, suspended): what has not arrived will not. What is left in the device's
    /// endpoint or the host's driver may still arrive when the port is opened again; like every host, this one ignores it
    /// until it has greeted the device again.
    pub fn cut(&mut self) {
        self.exchange();
        self.between_sessions = true;
        for channel in Channel::ALL {
            self.booked[channel.index()] = false;
            self.ledger.close(channel, false);
        }
    }

    /// Closes the books of a session that the device ended on its own: it has delivered everything.
    pub fn follow_session_end(&mut self) {
        for channel in Channel::ALL {
            if std::mem::take(&mut self.booked[channel.index()]) {
                self.ledger.close(channel, true);
            }
        }
    }

    /// The device's status.
    pub fn status(&mut self) -> Result<Status, RigError> {
        match self.ask(Command::Status)? {
            Reply::Status(status) => Ok(status),
            reply => Err(wrong_reply("Status", &reply)),
        }
    }

    /// Puts a sender on a channel's bus, and a second node that acknowledges.
    pub fn add_traffic(&mut self, channel: Channel, bitrate_bps: u32, source: impl Source + 'static) {
        let bit = BitTime::of_rate(bitrate_bps, CLOCK);
        let wire = &mut self.machine.board().wires[channel.index()];
        wire.add(Node::new(bit).with_source(source));
        wire.add(Node::new(bit));
    }

    /// Gives the two nodes of [`Self::add_traffic`] another bit time and different frames.
    pub fn change_traffic(&mut self, channel: Channel, bit: BitTime, source: Option<Box<dyn Source>>) {
        let wire = &mut self.machine.board().wires[channel.index()];
        wire.node(0).restart(bit, source);
        wire.node(1).restart(bit, None);
    }

    /// Core cycles per bit on a channel that takes part in its bus.
    pub fn bit_cycles(&self, channel: Channel) -> Option<u64> {
        let controller = &self.machine.board().can.controllers[channel.index()];
        controller.listens().then(|| controller.timing().bit())
    }

    /// Whether the firmware watches the edges of a channel's receive pin.
    pub fn watches(&self, channel: Channel) -> bool {
        self.machine.board().watches(channel.index())
    }

    /// Whether a channel's controller takes part in its bus, if only as a listener.
    pub fn takes_part(&self, channel: Channel) -> bool {
        self.machine.board().can.controllers[channel.index()].listens()
    }

    /// Bits that a channel's controller has driven dominant since power-on.
    pub fn dominant_bits(&self, channel: Channel) -> u64 {
        self.machine.board().can.controllers[channel.index()].dominant_bits()
    }

    /// Bits of the frames in a channel's books, with intermission.
    pub fn bus_bits(&self, channel: Channel) -> u64 {
        self.bus_bits[channel.index()]
    }

    /// Events that the device reported, with their device times.
    pub fn events(&self) -> &[(u64, Event)] {
        &self.events
    }

    /// Takes the events reported so far.
    pub fn take_events(&mut self) -> Vec<(u64, Event)> {
        std::mem::take(&mut self.events)
    }

    /// When, by its own clock, the device ended the session on its own, and why.
    pub fn session_end(&self) -> Option<(u64, EndReason)> {
        self.ended
    }

    /// Keeps the bytes that the device sends from now on.
    pub fn record_bytes(&mut self) {
        self.recording = Some(Vec::new());
    }

    /// Keeps what crosses the buses from now on.
    pub fn watch(&mut self) {
        self.watched = Some(Default::default());
    }

    /// Returns what crossed each bus since [`Self::watch`], and stops watching.
    pub fn take_watched(&mut self) -> [Vec<BusFrame>; CHANNELS] {
        self.watched.take().unwrap_or_default()
    }

    /// Places in each channel's transmit queue.
    pub fn tx_queue(&self) -> usize {
        self.tx_queue
    }

    /// Periodic entries of each channel.
    pub fn periodic_slots(&self) -> usize {
        self.periodic_slots
    }

    /// The core cycle of the device's tick 0.
    pub fn clock_origin(&mut self) -> u64 {
        let now = self.now();
        self.machine.board().tim2_origin(now)
    }

    /// The bytes kept so far.
    pub fn recorded_bytes(&self) -> &[u8] {
        self.recording.as_deref().unwrap_or_default()
    }
}

/// The bit timing for a bit rate, with the clock of the product's boards.
pub fn timing(bitrate_bps: u32) -> Result<BitTiming, RigError> {
    /// APB1 at 36 MHz.
    const CAN_CLOCK_HZ: u32 = (CYCLES_PER_SECOND / 4) as u32;
    BitTiming::choose(CAN_CLOCK_HZ, bitrate_bps, None).map_err(|_| RigError::BitRate { bitrate_bps })
}

/// The command's name for messages.
fn name_of(command: &Command) -> String {
    let debug = format!("{command:?}");
    debug.split([' ', '{', '(']).next().unwrap_or_default().to_owned()
}

fn wrong_reply(command: &str, reply: &Reply) -> RigError {
    RigError::WrongReply { command: command.to_owned(), reply: format!("{reply:?}") }
}
