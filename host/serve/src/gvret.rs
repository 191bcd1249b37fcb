//! GVRET over TCP, for SavvyCAN and other programs that know an ESP32RET: the boards' channels are its buses.
//!
//! Frames come once the client has given its first command. A bus is only listened to until the client sends, as with socketcand. The protocol
//! knows neither errors nor losses nor remote frames: they are counted, and the server says how many it left out.

use std::io;
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use cantap::device::{channel_number, is_idle, write_patiently};
use cantap::{Device, DeviceError, Direction, TraceEvent, TraceFrame, TraceRecord};
use cantap_codecs::gvret::{Bus, Command, Message, command};
use cantap_wire::message::{ChannelConfig, Mode, Role};
use cantap_wire::{CHANNELS, Channel, Refusal};

use crate::door::{AdmittedClient, Door};
use crate::feed::{self, Feed, Losses, Source};
use crate::foreign;
use crate::left_out::{LOST, LeftOut};
use crate::lines::device_of;
use crate::listen::{Listening, patience};
use crate::lock::lock;
use crate::open_bus::OpenBus;
use crate::own_frames::OwnFrames;
use crate::places::NoPlace;
use crate::text::now_ns;
use crate::writer::took_nothing;
use crate::{Board, News};

pub use cantap_codecs::gvret::PORT;

/// What clients are told that the adapter's firmware is: the first one with all of the commands.
const BUILD: u16 = 618;
/// Boards whose channels have a place in the protocol's two bits for a bus.
pub const MOST_BOARDS: usize = 2;

/// Admits clients. The buses are the channels of the first two boards. The protocol has no authentication: at an address that is not this
/// machine's own (loopback), clients may only listen.
pub fn listen(boards: &[Arc<Board>], address: SocketAddr, role: Role) -> io::Result<Listening> {
    let most = boards.first().map_or(0, |board| board.most_clients());
    let door = Door::open("GVRET client", address, role, most)?;
    let boards: Arc<[Arc<Board>]> = boards.iter().take(MOST_BOARDS).cloned().collect();
    Listening::start("cantap-gvret", Some(door.address), move || {
        let (role, of_client) = (door.role, Arc::clone(&boards));
        let turn_away = |_: &mut TcpStream, client: String, full: NoPlace| {
            boards[0].tell(News::Refused { client, reason: full.to_string() });
        };
        door.admit(turn_away, move |visitor| {
            if let Ok(output) = visitor.stream.try_clone() {
                Arc::new(Connection::new(output, visitor.name.clone(), of_client, role)).serve(visitor);
            }
        })
    })
}

/// One client.
struct Connection {
    output: Mutex<TcpStream>,
    name: String,
    boards: Arc<[Arc<Board>]>,
    role: Role,
    /// What it sent, by bus.
    own: Vec<Mutex<OwnFrames>>,
    left_out: Mutex<LeftOut>,
    is_over: AtomicBool,
}

/// What a client has once it has greeted: by number, the buses that are open.
struct Session {
    devices: Vec<Arc<Device>>,
    buses: Vec<Option<OpenBus>>,
    threads: Vec<JoinHandle<()>>,
}

impl Connection {
    fn new(output: TcpStream, name: String, boards: Arc<[Arc<Board>]>, role: Role) -> Self {
        let own = (0..boards.len() * CHANNELS).map(|_| Mutex::default()).collect();
        let (output, left_out) = (Mutex::new(output), Mutex::default());
        Self { output, name, boards, role, own, left_out, is_over: AtomicBool::new(false) }
    }

    /// Carries out the client's commands until either side ends.
    fn serve(self: &Arc<Self>, mut visitor: AdmittedClient) {
        let mut session = None;
        let mut pending = Vec::new();
        let mut bytes = [0; 4096];
        while !self.is_over() {
            let Some(len) = visitor.read(&mut bytes) else { break };
            if len > 0 {
                visitor.place.spoke();
            }
            pending.extend_from_slice(&bytes[..len]);
            let mut used = 0;
            while !self.is_over()
                && let Some((command, len)) = command(&pending[used..])
            {
                if let Err(reason) = self.take(command, &pending[used..], &mut session) {
                    self.refused(reason);
                    self.end();
                }
                used += len;
            }
            pending.drain(..used);
            match &mut session {
                None if visitor.is_late() => break,
                None => {}
                Some(session) => {
                    visitor.place.is_served();
                    self.listen_again(session);
                }
            }
        }
        self.end();
        for thread in session.into_iter().flat_map(|session: Session| session.threads) {
            let _ = thread.join();
        }
        self.report_left_out(true);
    }

    fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    fn end(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Takes a command, with the bytes from it on. An error is the reason why the connection ends: nothing is skipped, because what comes behind
    /// bytes that are no command may be data that look like one.
    fn take(
        self: &Arc<Self>,
        command: Command,
        bytes: &[u8],
        session: &mut Option<Session>,
    ) -> Result<(), String> {
        match (command, &session) {
            (Command::Garbage | Command::Padding, None) => return Err(foreign::reason(bytes)),
            (Command::Garbage, Some(_)) => return Err("it sent bytes that are no command".to_owned()),
            (Command::Binary | Command::Padding, _) => return Ok(()),
            _ => {}
        }
        let session = match session {
            Some(session) => session,
            None => session.insert(self.begin()?),
        };
        let answer = match command {
            Command::GetNumber => Message::Number(session.buses.len() as u8),
            Command::GetBuses => Message::Buses([0, 1].map(|number| self.bus(session, number))),
            Command::GetInfo => Message::Info { build: BUILD },
            Command::GetFurtherBuses => Message::Other,
            Command::KeepAlive => Message::Alive,
            Command::Time => Message::Time(stamp_us(now_ns())),
            Command::SetBuses(buses) => {
                for (number, (bus, only_listens)) in buses.into_iter().enumerate() {
                    if let Err(reason) = self.set(session, number, bus, only_listens) {
                        self.not_done(format!("bus {number} stays as it is: {reason}"));
                    }
                }
                return Ok(());
            }
            Command::Frame { bus, frame } => {
                if let Err(reason) = self.send(session, bus.into(), frame.into()) {
                    self.not_done(reason);
                }
                return Ok(());
            }
            Command::Fd { bus, frame } => {
                if let Err(reason) = self.send(session, bus.into(), frame.into()) {
                    self.not_done(reason);
                }
                return Ok(());
            }
            Command::NoFrame { .. } => {
                self.not_done(
                    "it sent a frame that is none: a length that no frame has, or an identifier that is too large"
                        .to_owned(),
                );
                return Ok(());
            }
            Command::Other(number) => {
                self.not_done(format!("the command {number} is for what this server does not have"));
                return Ok(());
            }
            Command::Binary | Command::Padding | Command::Garbage => return Ok(()),
        };
        let mut out = Vec::new();
        answer.put(&mut out);
        self.write(&out).map_err(|error| error.to_string())
    }

    /// Opens every channel whose bit rate is known, to listen.
    fn begin(self: &Arc<Self>) -> Result<Session, String> {
        let mut session = Session { devices: Vec::new(), buses: Vec::new(), threads: Vec::new() };
        let mut sources = Vec::new();
        for board in self.boards.iter() {
            let device = Arc::new(device_of(board, &self.name, self.role)?);
            let sends_in = (self.role >= Role::Send).then_some(Mode::Normal);
            for channel in Channel::ALL {
                let bus = match device.open_channel(channel, None) {
                    Ok(config) => Some(open_bus(board, &device, channel, config, sends_in)),
                    // The bit rate of its bus is unknown.
                    Err(DeviceError::Refused { refusal: Refusal::NothingSaved }) => None,
                    Err(error) => return Err(error.to_string()),
                };
                session.buses.push(bus);
            }
            sources.push(Source::new(board, &device));
            session.devices.push(device);
        }
        for (board, source) in sources.into_iter().enumerate() {
            let feed = BoardFeed { connection: Arc::clone(self), board, out: Vec::new() };
            let thread = std::thread::Builder::new().name("cantap-gvret-hears".to_owned());
            let thread = thread.spawn(move || feed.run(source));
            session.threads.push(thread.map_err(|error| error.to_string())?);
        }
        Ok(session)
    }

    /// A bus as the client is told of it. It only listens if the client cannot send there.
    fn bus(&self, session: &Session, number: usize) -> Bus {
        let open = session.buses.get(number).and_then(Option::as_ref);
        let known = self.boards[number / CHANNELS].bitrates_bps()[number % CHANNELS];
        let bitrate_bps =
            open.and_then(|bus| bus.config.timing.known_bitrate_bps(bus.device.hello().can_clock_hz));
        Bus {
            is_on: open.is_some(),
            only_listens: open.is_some_and(|bus| bus.sends_in.is_none()),
            bitrate_bps: bitrate_bps.or(known).unwrap_or(0),
        }
    }

    /// Opens or closes a bus, as far as the client may.
    fn set(
        &self,
        session: &mut Session,
        number: usize,
        wanted: Bus,
        only_listens: Option<bool>,
    ) -> Result<(), String> {
        let reason = |error: DeviceError| error.to_string();
        let (board, channel) = (number / CHANNELS, Channel::ALL[number % CHANNELS]);
        let (board, device) = (&self.boards[board], &session.devices[board]);
        let bus = &mut session.buses[number];
        if !wanted.is_on {
            return match bus.take() {
                Some(_) => device.close_channel(channel).map_err(reason),
                None => Ok(()),
            };
        }
        let clock_hz = device.hello().can_clock_hz;
        let bitrate_bps = (wanted.bitrate_bps > 0).then_some(wanted.bitrate_bps);
        let is_other = |config: &ChannelConfig| {
            bitrate_bps.is_some_and(|rate| rate != config.timing.bitrate_bps(clock_hz))
        };
        let open = || match bitrate_bps {
            Some(rate) => device.listen(channel, rate),
            None => device.open_channel(channel, None),
        };
        let may_send = self.role >= Role::Send;
        let sends_in = (may_send && only_listens != Some(true)).then_some(Mode::Normal);
        match bus {
            None => *bus = Some(open_bus(board, device, channel, open().map_err(reason)?, sends_in)),
            Some(there) if is_other(&there.config) => {
                let before = there.config;
                device.close_channel(channel).map_err(reason)?;
                self.missed();
                match open() {
                    Ok(config) => *bus = Some(open_bus(board, device, channel, config, sends_in)),
                    Err(error) => {
                        there.config = device.open_channel(channel, Some(before)).map_err(reason)?;
                        return Err(reason(error));
                    }
                }
            }
            Some(there) => {
                if sends_in.is_none() && there.config.mode != Mode::ListenOnly {
                    there.change_mode(Mode::ListenOnly, || self.missed())?;
                }
                there.sends_in = sends_in;
            }
        }
        if only_listens == Some(false) && !may_send {
            return Err("clients here may only listen; --allow gvret:send lets every program of this computer send there".to_owned());
        }
        Ok(())
    }

    fn send(&self, session: &mut Session, number: usize, frame: TraceFrame) -> Result<(), String> {
        let none = || format!("bus {number} is not open");
        let bus = session.buses.get_mut(number).and_then(Option::as_mut).ok_or_else(none)?;
        if frame.classic().is_none() && !bus.device.hello().sends_fd() {
            return Err("it sent a CAN FD frame, which the board cannot send".to_owned());
        }
        bus.may_send(|| self.missed())?;
        let tag = bus.next_tag();
        lock(&self.own[number]).sends(tag, frame);
        bus.send(tag, frame).inspect_err(|_| lock(&self.own[number]).failed(tag))
    }

    fn listen_again(&self, session: &mut Session) {
        for (number, bus) in session.buses.iter_mut().enumerate() {
            let Some(bus) = bus else { continue };
            match bus.listen_again(|| self.missed()) {
                Ok(None) => {}
                Ok(Some(after)) => {
                    let (client, channel) = (self.name.clone(), bus.channel);
                    self.boards[number / CHANNELS].tell(News::Idle { client, channel, after });
                }
                Err(reason) => {
                    self.refused(reason);
                    self.end();
                }
            }
        }
    }

    fn put(&self, board: usize, record: &TraceRecord, out: &mut Vec<u8>) {
        let Some(channel) = Channel::from_number(record.channel) else { return };
        let number = usize::from(channel_number(board, channel)) - 1;
        lock(&self.own[number]).event(&record.event);
        match &record.event {
            TraceEvent::Frame { frame, direction, .. } => {
                if *direction == Direction::Tx && lock(&self.own[number]).take(*frame) {
                    return;
                }
                // SavvyCAN would take the bytes of such a message one place too late, and 64 of them for none.
                let Some(frame) = frame.classic() else {
                    return lock(&self.left_out).count("CAN FD frames", 1);
                };
                if frame.is_remote() {
                    return lock(&self.left_out).count("remote frames", 1);
                }
                let stamp_us = stamp_us(record.time_ns);
                Message::Frame { stamp_us, bus: number as u8, frame: *frame }.put(out);
            }
            TraceEvent::TransmitFailed { .. } => {
                lock(&self.left_out).count("failed transmissions", 1);
            }
            event if *event == TraceEvent::UNCOUNTED => {
                lock(&self.left_out).count("that losses are not counted", 1);
            }
            TraceEvent::Lost { count, .. } => {
                lock(&self.left_out).count(LOST, (*count).max(1).into());
            }
            TraceEvent::ErrorsSuppressed { count } => {
                lock(&self.left_out).count("bus errors", (*count).into());
            }
            TraceEvent::BusError { .. } => lock(&self.left_out).count("bus errors", 1),
            TraceEvent::State { .. } => lock(&self.left_out).count("changes of state", 1),
            TraceEvent::Disturbed { .. } => lock(&self.left_out).count("disturbances", 1),
            TraceEvent::Lin { .. } => lock(&self.left_out).count("LIN frames", 1),
        }
    }

    /// It was off the bus for a moment.
    fn missed(&self) {
        lock(&self.left_out).count("moments off the bus", 1);
    }

    fn report_left_out(&self, is_end: bool) {
        lock(&self.left_out).report(is_end, &self.boards[0], &self.name);
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        if bytes.is_empty() {
            return Ok(());
        }
        let patience = patience(self.role);
        let written = write_patiently(&mut *lock(&self.output), bytes, patience);
        if written.as_ref().is_err_and(is_idle) && !self.is_over.swap(true, Ordering::Relaxed) {
            let (client, reason) = (self.name.clone(), Some(took_nothing(patience)));
            self.boards[0].tell(News::ClientLeft { client, reason });
        }
        written
    }

    /// The connection ends for this reason.
    fn refused(&self, reason: String) {
        self.boards[0].tell(News::Refused { client: self.name.clone(), reason });
    }

    /// A command was not carried out, for which the protocol has no answer.
    fn not_done(&self, reason: String) {
        self.boards[0].tell(News::NotDone { client: self.name.clone(), reason });
    }
}

/// What a client receives of one board.
struct BoardFeed {
    connection: Arc<Connection>,
    board: usize,
    out: Vec<u8>,
}

impl BoardFeed {
    /// Sends the client what is received, until either side ends.
    fn run(mut self, source: Source) {
        let untold = feed::run(&mut [source], &mut self);
        lock(&self.connection.left_out).count(LOST, untold);
        self.connection.end();
    }
}

impl Feed for BoardFeed {
    fn is_over(&mut self) -> bool {
        self.connection.report_left_out(false);
        self.connection.is_over()
    }

    fn take(&mut self, _: usize, records: &[TraceRecord]) -> Losses {
        for record in records {
            self.connection.put(self.board, record, &mut self.out);
        }
        Losses::LeftOut
    }

    fn is_empty(&self) -> bool {
        self.out.is_empty()
    }

    fn write(&mut self) -> io::Result<()> {
        self.connection.write(&self.out)?;
        self.out.clear();
        Ok(())
    }
}

fn open_bus(
    board: &Board,
    device: &Arc<Device>,
    channel: Channel,
    config: ChannelConfig,
    sends_in: Option<Mode>,
) -> OpenBus {
    OpenBus::new(Arc::clone(device), channel, config, sends_in, board.idle_sender())
}

/// A time as the protocol has it.
const fn stamp_us(time_ns: i64) -> u32 {
    time_ns.div_euclid(1000) as u32
}
