//! A board of fakes: controllers, clock and port that a test drives by hand.
#![allow(dead_code, reason = "each test file uses its part")]

use std::cell::Cell;
use std::collections::VecDeque;

use cantap_firmware::TICKS_PER_US;
use cantap_firmware::bus::capture::Capture;
use cantap_firmware::bus::filters::Layout;
use cantap_firmware::bus::queue::RecordQueue;
use cantap_firmware::bus::sof::SofReading;
use cantap_firmware::port::board::Board;
use cantap_firmware::port::command::Identity;
use cantap_firmware::port::session::Session;
use cantap_firmware::ports::{
    Chip, Clock, Control, EdgeMeter, ErrorStatus, FilterBanks, Outcome, PACKET, PinEdge, Port, PortHistory,
    Traffic,
};
use cantap_wire::framing::{self, CRC_LEN, MAX_ENCODED, MAX_MESSAGE};
use cantap_wire::message::{ChannelConfig, EndReason, Failures, Mode, RegisterSet};
use cantap_wire::record::{BusErrorKind, ErrorState};
use cantap_wire::{
    BitTiming, CHANNELS, Channel, Command, Decoded, Decoder, Event, Frame, Id, PROTOCOL_VERSION, Record,
    Refusal, Reply, Request, Response,
};

/// The record queue of the tests: small, so that it overflows soon.
pub const SMALL_QUEUE: usize = 16 * 1024;

#[derive(Default)]
pub struct FakeClock {
    pub now: Cell<u32>,
    /// How far time moves with each reading.
    pub step: Cell<u32>,
    pub alarm: Cell<Option<u32>>,
}

impl Clock for FakeClock {
    const ALARM_EARLY_TICKS: u32 = 10 * TICKS_PER_US;

    fn wait_until(&self, at: u32) {
        let ahead = at.wrapping_sub(self.now.get());
        assert!(ahead <= Self::ALARM_EARLY_TICKS * 3 / 2 || ahead > u32::MAX / 2, "waits {ahead} ticks");
        if ahead <= u32::MAX / 2 {
            self.now.set(at);
        }
    }

    fn now(&self) -> u32 {
        self.now.replace(self.now.get().wrapping_add(self.step.get()))
    }

    fn set_alarm(&self, at: Option<u32>) {
        self.alarm.set(at);
    }
}

/// A controller's traffic side: a FIFO three deep that keeps the oldest frames, and three
/// mailboxes.
#[derive(Default)]
pub struct FakeTraffic {
    pub fifo: VecDeque<Frame>,
    /// The FIFO does not release its frames, or shows the same frame again and again.
    pub stubborn: Option<Stubborn>,
    /// The frame in front has been taken and is being released.
    pub releasing: bool,
    /// Frames taken from the FIFO.
    pub received: usize,
    /// A mailbox that says for ever that it has finished.
    pub never_emptied: Option<u8>,
    /// The controller shows no free mailbox.
    pub blocked: bool,
    /// How often the transmit interrupt was let in again.
    pub awaited: usize,
    pub overrun: bool,
    pub mailboxes: [Option<Frame>; 3],
    pub prepared: Option<Frame>,
    /// The order in which mailboxes were requested.
    pub order: VecDeque<u8>,
    pub finished: VecDeque<(u8, Outcome)>,
    pub aborts: usize,
    pub error: Option<BusErrorKind>,
    pub state: Option<ErrorState>,
    pub counters: (u8, u8),
}

/// How a FIFO misbehaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stubborn {
    /// RFOM is never cleared: the first frame is not released.
    Keeps,
    /// RFOM is cleared, but the frame stays.
    Repeats,
    /// A frame that was taken stays in the way until [`FakeTraffic::release`].
    Slow,
}

/// More calls than any single interrupt makes: a loop that makes them has no end.
const ENDLESS: usize = 100_000;

impl FakeTraffic {
    /// A frame comes off the bus.
    pub fn arrive(&mut self, frame: Frame) {
        if self.fifo.len() < 3 { self.fifo.push_back(frame) } else { self.overrun = true }
    }

    /// A slow FIFO releases the frame that was taken.
    pub fn release(&mut self) {
        if std::mem::take(&mut self.releasing) {
            self.fifo.pop_front();
        }
    }

    /// The bus takes the oldest mailbox's frame.
    pub fn send_one(&mut self) -> Option<Frame> {
        let mailbox = self.order.pop_front()?;
        let frame = self.mailboxes[mailbox as usize].take()?;
        self.finished.push_back((mailbox, Outcome::Sent));
        Some(frame)
    }
}

impl Traffic for FakeTraffic {
    fn pending(&self) -> u8 {
        self.fifo.len() as u8 - u8::from(self.releasing)
    }

    fn look(&mut self) -> (u8, bool) {
        (self.fifo.len() as u8, self.take_overrun())
    }

    fn front(&self) -> Option<Frame> {
        self.fifo.front().copied().filter(|_| !self.releasing)
    }

    fn receive(&mut self) -> Option<Frame> {
        self.received += 1;
        assert!(self.received < ENDLESS, "the drain does not end");
        match self.stubborn {
            None => self.fifo.pop_front(),
            Some(Stubborn::Keeps) => None,
            Some(Stubborn::Repeats) => self.fifo.front().copied(),
            Some(Stubborn::Slow) if self.releasing => None,
            Some(Stubborn::Slow) => {
                self.releasing = !self.fifo.is_empty();
                self.fifo.front().copied()
            }
        }
    }

    fn take_overrun(&mut self) -> bool {
        std::mem::take(&mut self.overrun)
    }

    fn prepare(&mut self, frame: &Frame) -> Option<u8> {
        if self.blocked {
            return None;
        }
        let free = self.mailboxes.iter().position(Option::is_none)?;
        // As on the chip, a mailbox is free for the next frame only once its outcome was taken.
        if self.finished.iter().any(|(mailbox, _)| *mailbox as usize == free) {
            return None;
        }
        self.prepared = Some(*frame);
        Some(free as u8)
    }

    fn request(&mut self, mailbox: u8) {
        self.mailboxes[mailbox as usize] = self.prepared.take();
        self.order.push_back(mailbox);
    }

    fn await_finished(&mut self) {
        self.awaited += 1;
    }

    fn take_finished(&mut self) -> Option<(u8, Outcome)> {
        if let Some(mailbox) = self.never_emptied {
            self.received += 1;
            assert!(self.received < ENDLESS, "the mailboxes are collected for ever");
            return Some((mailbox, Outcome::Sent));
        }
        self.finished.pop_front()
    }

    fn abort(&mut self) {
        self.aborts += 1;
        while let Some(mailbox) = self.order.pop_front() {
            self.mailboxes[mailbox as usize] = None;
            self.finished.push_back((mailbox, Outcome::Aborted));
        }
    }

    fn take_errors(&mut self) -> ErrorStatus {
        ErrorStatus {
            kind: self.error.take(),
            state: self.state.unwrap_or(ErrorState::Active),
            tec: self.counters.0,
            rec: self.counters.1,
        }
    }

    fn registers(&self) -> RegisterSet {
        RegisterSet {
            esr: u32::from(self.counters.0) << 16 | u32::from(self.counters.1) << 24,
            ..Default::default()
        }
    }
}

#[derive(Default)]
pub struct FakeControl {
    pub running: bool,
    /// The bus is stuck: the controller does not leave on its own.
    pub stuck: bool,
    /// How many calls of `halt` it takes to leave.
    pub halts_needed: usize,
    pub halts: usize,
    pub started: Vec<ChannelConfig>,
    pub resumed: usize,
}

impl Control for FakeControl {
    fn stop(&mut self) {
        self.running &= self.stuck;
    }

    fn halt(&mut self) {
        self.halts += 1;
        self.running &= self.halts < self.halts_needed;
    }

    fn is_stopped(&self) -> bool {
        !self.running
    }

    fn start(&mut self, config: &ChannelConfig) {
        assert!(!self.running, "a running controller must not be configured");
        self.running = true;
        self.started.push(*config);
    }

    fn resume(&mut self) {
        self.running = true;
        self.resumed += 1;
    }
}

#[derive(Default)]
pub struct FakeFilters {
    /// Whatever was written, changed or not.
    pub written: Vec<Layout>,
    /// How often that changed something; the banks let everything pass at first.
    pub changes: usize,
    /// A controller's reset has cleared the banks.
    pub cleared: bool,
}

impl FilterBanks for FakeFilters {
    fn write(&mut self, layout: &Layout) -> bool {
        let was = self.written.last().cloned().unwrap_or_else(Layout::open);
        let differed = std::mem::take(&mut self.cleared) || was != *layout;
        self.changes += usize::from(differed);
        self.written.push(layout.clone());
        differed
    }
}

#[derive(Default)]
pub struct FakeChip {
    pub saved: Vec<u8>,
    pub identified: Vec<u8>,
    pub resets: usize,
    pub bootloaders: usize,
}

impl Chip for FakeChip {
    fn temperature_decicelsius(&mut self) -> Option<i16> {
        Some(312)
    }

    fn supply_millivolts(&mut self) -> Option<u16> {
        Some(3301)
    }

    fn failures(&mut self) -> Failures {
        Failures { count: 2, last: "a panic".try_into().unwrap() }
    }

    fn identify(&mut self, seconds: u8) {
        self.identified.push(seconds);
    }

    fn reset(&mut self) {
        self.resets += 1;
    }

    fn bootloader(&mut self) -> bool {
        self.bootloaders += 1;
        true
    }

    fn save(&mut self, bytes: &[u8]) -> bool {
        self.saved = bytes.to_vec();
        true
    }

    fn load(&mut self, out: &mut [u8]) -> usize {
        let len = self.saved.len().min(out.len());
        out[..len].copy_from_slice(&self.saved[..len]);
        len
    }
}

/// A port whose host takes a number of transfers and then no more.
#[derive(Default)]
pub struct FakePort {
    pub open: bool,
    pub suspended: bool,
    pub history: PortHistory,
    pub to_device: VecDeque<Vec<u8>>,
    pub from_device: Vec<u8>,
    pub packets: Vec<usize>,
    /// The host was made to wait.
    pub held: bool,
    /// How many more transfers the host takes.
    pub takes: usize,
}

impl Port for FakePort {
    fn is_open(&self) -> bool {
        self.open
    }

    fn is_suspended(&self) -> bool {
        self.suspended
    }

    fn history(&self) -> PortHistory {
        self.history
    }

    fn write(&mut self, bytes: &[u8]) -> Option<usize> {
        if self.takes == 0 {
            return None;
        }
        // A transfer has at most five packets.
        let len = bytes.len().min(5 * PACKET);
        self.takes -= 1;
        self.packets.extend(bytes[..len].chunks(PACKET).map(<[u8]>::len));
        self.packets.extend((len == 0).then_some(0));
        self.from_device.extend_from_slice(&bytes[..len]);
        Some(len)
    }

    fn read(&mut self, packet: &mut [u8; PACKET]) -> Option<usize> {
        let bytes = if self.held { None } else { self.to_device.pop_front() }?;
        packet[..bytes.len()].copy_from_slice(&bytes);
        Some(bytes.len())
    }

    fn hold(&mut self, hold: bool) {
        self.held = hold;
    }
}

/// A meter whose edges are supplied by a test.
#[derive(Default)]
pub struct FakeMeter {
    /// What it was asked to watch, in order.
    pub watched: Vec<Option<Channel>>,
    pub edges: VecDeque<PinEdge>,
    pub dominant: bool,
}

impl EdgeMeter for FakeMeter {
    fn watch(&mut self, channel: Option<Channel>) {
        self.watched.push(channel);
        self.edges.clear();
    }

    fn next(&mut self) -> Option<PinEdge> {
        self.edges.pop_front()
    }

    fn is_dominant(&self) -> bool {
        self.dominant
    }
}

pub struct FakeBoard<'q, const N: usize> {
    pub capture: Capture<'q, N>,
    pub traffic: [FakeTraffic; CHANNELS],
    pub control: [FakeControl; CHANNELS],
    pub clock: FakeClock,
    pub filters: FakeFilters,
    pub chip: FakeChip,
    /// What the next reading of the SOF latch finds.
    pub sof: Option<SofReading>,
    pub meter: FakeMeter,
    /// A controller's reset ends its FIFO's stubbornness.
    pub reset_empties: bool,
    /// The frame that is on CAN1's bus when its controller is asked to leave. It is received, and cannot be released any more.
    pub last_frame: Option<Frame>,
}

impl<'q, const N: usize> Board<'q, N> for FakeBoard<'q, N> {
    type Traffic = FakeTraffic;
    type Control = FakeControl;
    type Clock = FakeClock;
    type Filters = FakeFilters;
    type Chip = FakeChip;
    type Meter = FakeMeter;

    fn with_capture<R>(
        &mut self,
        act: impl FnOnce(&mut Capture<'q, N>, &mut [FakeTraffic; CHANNELS], &FakeClock) -> R,
    ) -> R {
        act(&mut self.capture, &mut self.traffic, &self.clock)
    }

    fn now(&self) -> u32 {
        self.clock.now()
    }

    fn take_sof(&mut self) -> Option<SofReading> {
        self.sof.take()
    }

    fn control(&mut self, channel: Channel) -> &mut FakeControl {
        if !self.control[0].running
            && let Some(frame) = self.last_frame.take()
        {
            self.traffic[0].arrive(frame);
            self.traffic[0].stubborn = Some(Stubborn::Repeats);
        }
        if self.reset_empties && self.control[channel.index()].halts > 0 {
            let traffic = &mut self.traffic[channel.index()];
            traffic.stubborn = None;
            traffic.fifo.clear();
        }
        &mut self.control[channel.index()]
    }

    fn filters(&mut self) -> &mut FakeFilters {
        &mut self.filters
    }

    fn chip(&mut self) -> &mut FakeChip {
        &mut self.chip
    }

    fn meter(&mut self) -> &mut FakeMeter {
        &mut self.meter
    }
}

/// A device made of fakes, with a host at its port.
pub struct Bench<'q, const N: usize> {
    pub board: FakeBoard<'q, N>,
    pub session: Session<'q, N>,
    pub port: FakePort,
    pub decoder: Decoder,
    pub records: Vec<(u64, Record)>,
    pub responses: Vec<Response>,
    /// When the device ended a session on its own, and why.
    pub ends: Vec<(u64, EndReason)>,
    /// Anything else that the decoder reported.
    pub complaints: Vec<String>,
    decoded: usize,
    next_id: u16,
}

impl<'q, const N: usize> Bench<'q, N> {
    /// A device whose port is open and being read.
    pub fn new(queue: &'q RecordQueue<N>) -> Self {
        let (producer, consumer) = queue.split();
        let identity = Identity { board: "fake", serial: "0123456789ABCDEF".try_into().unwrap() };
        Bench {
            board: FakeBoard {
                capture: Capture::new(producer, Box::leak(Box::default()), Box::leak(Box::default())),
                traffic: Default::default(),
                control: Default::default(),
                clock: FakeClock::default(),
                filters: FakeFilters::default(),
                chip: FakeChip::default(),
                sof: None,
                meter: FakeMeter::default(),
                reset_empties: false,
                last_frame: None,
            },
            session: Session::new(consumer, identity, Box::leak(Box::default())),
            port: FakePort { open: true, takes: usize::MAX, ..Default::default() },
            decoder: Decoder::new(),
            records: Vec::new(),
            responses: Vec::new(),
            ends: Vec::new(),
            complaints: Vec::new(),
            decoded: 0,
            next_id: 1,
        }
    }

    /// A device with a session and both channels open as `mode`.
    pub fn opened(queue: &'q RecordQueue<N>, mode: Mode) -> Self {
        let mut bench = Self::new(queue);
        bench.greet();
        for channel in Channel::ALL {
            bench.ask(Command::Open { channel, config: Some(config(mode)) }).unwrap();
        }
        bench.millisecond();
        bench.millisecond();
        bench.records.clear();
        bench
    }

    /// Starts a session.
    pub fn greet(&mut self) {
        self.say(&[0]);
        self.ask(Command::Hello { protocol: PROTOCOL_VERSION }).unwrap();
    }

    /// The host puts the bus to sleep with the port open, or wakes it.
    pub fn sleep(&mut self, asleep: bool) {
        self.port.suspended = asleep;
        self.port.open = !asleep;
    }

    /// Bytes from the host, in packets.
    pub fn say(&mut self, bytes: &[u8]) {
        self.port.to_device.extend(bytes.chunks(PACKET).map(<[u8]>::to_vec));
        self.poll();
    }

    /// A request and its response.
    pub fn ask(&mut self, command: Command) -> Result<Reply, Refusal> {
        let id = self.next_id;
        self.next_id += 1;
        self.say(&encode(&Request { id, command }));
        for _ in 0..500 {
            if let Some(at) = self.responses.iter().position(|response| response.id == id) {
                return self.responses.remove(at).result;
            }
            self.millisecond();
        }
        panic!("no response to request {id}");
    }

    /// Polls the session once and decodes what it sent.
    pub fn poll(&mut self) {
        self.session.poll(&mut self.port, &mut self.board);
        let Self { decoder, records, responses, ends, complaints, .. } = self;
        let bytes = &self.port.from_device[self.decoded..];
        decoder.push(bytes, |decoded| match decoded {
            Decoded::Record { ticks, record } => records.push((ticks, record)),
            Decoded::Response(response) => responses.push(response.clone()),
            Decoded::Ended { ticks, reason } => ends.push((ticks, reason)),
            other => complaints.push(format!("{other:?}")),
        });
        self.decoded = self.port.from_device.len();
    }

    /// The transmit interrupt.
    pub fn transmit_interrupt(&mut self, channel: Channel) {
        let entered = self.board.clock.now();
        self.board.capture.on_transmit(channel, &mut self.board.traffic, &self.board.clock, Some(entered));
    }

    /// A millisecond passes. Aborted mailboxes report that meanwhile.
    pub fn millisecond(&mut self) {
        self.pass(cantap_firmware::TICKS_PER_MS);
        for channel in Channel::ALL {
            if !self.board.traffic[channel.index()].finished.is_empty() {
                self.transmit_interrupt(channel);
            }
        }
        self.board.capture.on_tick(&mut self.board.traffic, &self.board.clock);
        self.session.tick(&mut self.board);
        self.poll();
    }

    /// Time passes.
    pub fn pass(&mut self, ticks: u32) {
        self.board.clock.now.set(self.board.clock.now.get().wrapping_add(ticks));
    }

    /// A frame comes off the bus, and the interrupt takes it.
    pub fn receive(&mut self, channel: Channel, frame: Frame) {
        self.board.traffic[channel.index()].arrive(frame);
        self.interrupt(channel);
    }

    /// The receive interrupt.
    pub fn interrupt(&mut self, channel: Channel) {
        let entered = self.board.clock.now();
        let traffic = &mut self.board.traffic;
        self.board.capture.on_receive(channel, traffic, &self.board.clock, entered);
    }

    /// The bus takes one frame, and the interrupt confirms it.
    pub fn send_one(&mut self, channel: Channel) -> Option<Frame> {
        let sent = self.board.traffic[channel.index()].send_one();
        self.transmit_interrupt(channel);
        sent
    }

    /// The alarm, if it is due.
    pub fn alarm(&mut self) {
        let now = self.board.clock.now();
        if self.board.clock.alarm.get().is_some_and(|at| now.wrapping_sub(at) < u32::MAX / 2) {
            self.board.capture.on_alarm(&mut self.board.traffic, &self.board.clock);
        }
    }

    /// Received frames of a channel among the records.
    pub fn frames(&self, channel: Channel) -> Vec<Frame> {
        self.records
            .iter()
            .filter_map(|(_, record)| match record {
                Record::Received(received) if received.channel == channel => Some(received.frame),
                _ => None,
            })
            .collect()
    }

    /// Events among the records.
    pub fn events(&self) -> Vec<Event> {
        self.records
            .iter()
            .filter_map(|(_, record)| match record {
                Record::Event(event) => Some(*event),
                Record::Received(_) | Record::ReceivedFd(_) | Record::TransmittedFd(_) => None,
            })
            .collect()
    }
}

/// A request on the wire.
pub fn encode(request: &Request) -> Vec<u8> {
    let mut message = [0; MAX_MESSAGE + CRC_LEN];
    let mut out = [0; MAX_ENCODED];
    let len = framing::encode(request, &mut message, &mut out).unwrap();
    out[..len].to_vec()
}

/// 500 kbit/s in this mode.
pub fn config(mode: Mode) -> ChannelConfig {
    let timing = BitTiming::choose(cantap_firmware::CAN_CLOCK_HZ, 500_000, None).unwrap();
    ChannelConfig { mode, ..ChannelConfig::listen_only(timing) }
}

/// A standard frame whose data are its number.
pub fn numbered(number: u32) -> Frame {
    Frame::data_frame(Id::standard(number & 0x7FF).unwrap(), &number.to_be_bytes()).unwrap()
}
