//! The socketcand protocol (<https://github.com/linux-can/socketcand>, doc/protocol.md), for SavvyCAN, Kayak, python-can and
//! other clients: raw, BCM and control mode, and the beacon. ISO-TP mode is not supported.
//!
//! The protocol page leaves some things open, and clients differ: `messages` defines how frames are written, `command` how they are read. The
//! bus is only listened to until a client that may send does so; its frames are then passed on to the others, but not to itself. Frames
//! sent repeatedly (`add`) are sent by the board, timed by its own clock.

mod command;
mod hearing;
mod messages;
mod subscriptions;

use std::collections::HashMap;
use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap::device::{channel_number, is_idle, write_patiently};
use cantap::{Device, DeviceError};
use cantap_trace::Interface;
use cantap_wire::message::{ChannelConfig, Mode, Periodic, Role, TxFrame};
use cantap_wire::{Channel, Frame, Id};

use crate::foreign;
use crate::lines::device_of;
use crate::listen::{Listening, accept, bind, patience};
use crate::places::{Place, Places, ends};
use crate::writer::took_nothing;
use crate::{Board, News};
use command::{BadCommand, Command, Finder};
use hearing::{Hearing, Hears};
use subscriptions::{MOST, Wanted};

/// The port of the original server.
pub const PORT: u16 = 29_536;
/// The port for beacons.
const BEACON_PORT: u16 = 42_000;
/// The page requires one at least every three seconds.
const BEACON_EVERY: Duration = Duration::from_secs(2);
/// Clients compare the result of one read with one answer, so two are not sent together.
const BETWEEN_ANSWERS: Duration = Duration::from_millis(20);
/// For the same reason, no frame right after the answer to `rawmode`.
const BEFORE_FRAMES: Duration = Duration::from_millis(100);
/// SavvyCAN reconnects after ten seconds without receiving anything, which loses what is on the bus meanwhile.
const KEEP_ALIVE_EVERY: Duration = Duration::from_secs(7);
/// What is then sent to the client: the protocol's own word for "still here". SavvyCAN and Kayak ignore it; so does python-can, with
/// a warning in its log. No client identifies itself, and a frame that SavvyCAN misses is worse than a warning.
const KEEP_ALIVE: &str = "< echo >";
/// A client that has not opened a bus by this time is dropped.
const OPEN_TIMEOUT: Duration = Duration::from_secs(30);
/// Limit for connections at a time, including those that have not opened a bus.
const MOST_CONNECTIONS: usize = 32;

/// Admits clients. The buses are the boards' channels, `can0` being the first board's first, as in every trace. The protocol has no
/// authentication: at an address that is not this machine's own (loopback), clients may only listen.
pub fn listen(boards: &[Arc<Board>], address: SocketAddr, role: Role) -> io::Result<Listening> {
    let role = if address.ip().is_loopback() { role } else { Role::Listen };
    let (listener, address) = bind(address)?;
    let buses: Arc<[Bus]> = boards
        .iter()
        .enumerate()
        .flat_map(|(number, board)| {
            Channel::ALL.map(|channel| Bus {
                name: Interface(channel_number(number, channel)).to_string(),
                board: Arc::clone(board),
                channel,
            })
        })
        .collect();
    let beacon = Beacon::new(address, &buses)?;
    let mut sent: Option<Instant> = None;
    let places = Places::new(MOST_CONNECTIONS);
    Listening::start("cantap-socketcand", Some(address), move || {
        if sent.is_none_or(|sent| sent.elapsed() >= BEACON_EVERY) {
            beacon.send();
            sent = Some(Instant::now());
        }
        let (stream, peer) = accept(&listener, role)?;
        let name = format!("socketcand client {peer}");
        let place = match places.enter(Some(peer.ip()), ends(&stream)?) {
            Ok(place) => place,
            Err(full) => {
                let _ = (&stream).write(format!("< error {full} >").as_bytes());
                buses[0].board.tell(News::Refused { client: name, reason: full.to_string() });
                return Ok(());
            }
        };
        let buses = Arc::clone(&buses);
        std::thread::Builder::new().name("cantap-socketcand-client".to_owned()).spawn(move || {
            if let Ok(connection) = Connection::new(stream, name, buses, role) {
                // An error means that the connection is gone.
                let _ = connection.serve(&place);
            }
            drop(place);
        })?;
        Ok(())
    })
}

/// A channel that can be opened.
struct Bus {
    name: String,
    board: Arc<Board>,
    channel: Channel,
}

/// Announces where the server is.
struct Beacon {
    socket: UdpSocket,
    to: SocketAddr,
    text: String,
}

impl Beacon {
    fn new(address: SocketAddr, buses: &[Bus]) -> io::Result<Self> {
        let is_local = address.ip().is_loopback();
        let (from, to) = if is_local {
            (Ipv4Addr::LOCALHOST, Ipv4Addr::LOCALHOST)
        } else {
            (Ipv4Addr::UNSPECIFIED, Ipv4Addr::BROADCAST)
        };
        let socket = UdpSocket::bind((from, 0))?;
        socket.set_broadcast(!is_local)?;
        let buses: Vec<String> = buses.iter().map(|bus| format!("<Bus name=\"{}\"/>", bus.name)).collect();
        let buses = buses.concat();
        let text = format!(
            "<CANBeacon name=\"cantap\" type=\"adapter\" description=\"cantap CAN analyser\"><URL>can://{address}</URL>{buses}</CANBeacon>"
        );
        Ok(Self { socket, to: (to, BEACON_PORT).into(), text })
    }

    fn send(&self) {
        // Nobody may be listening.
        let _ = self.socket.send_to(self.text.as_bytes(), self.to);
    }
}

/// One client.
struct Connection {
    input: Mutex<TcpStream>,
    output: Mutex<TcpStream>,
    name: String,
    buses: Arc<[Bus]>,
    role: Role,
    hearing: Mutex<Hearing>,
    /// When something was last sent to it.
    told_at: Mutex<Instant>,
    is_over: AtomicBool,
}

/// What a client receives after a command that changes that, on an open bus.
const fn mode(command: &Command, is_open: bool) -> Option<Hears> {
    match command {
        _ if !is_open => None,
        Command::RawMode => Some(Hears::All),
        Command::BcmMode => Some(Hears::Subscribed),
        Command::StatisticsMode => Some(Hears::Nothing),
        _ => None,
    }
}

/// A client's choices before it opens a bus.
#[derive(Default)]
struct Setup {
    bitrates_bps: HashMap<String, u32>,
    listen_only: bool,
    loopback: bool,
}

/// An open bus.
struct Opened {
    device: Arc<Device>,
    channel: Channel,
    config: ChannelConfig,
    /// The mode for sending, if it may send.
    sends_in: Option<Mode>,
    next_tag: u32,
    /// When it last had something sent.
    sent_at: Instant,
    /// After sending nothing for this long, it only listens again.
    idle_after: Option<Duration>,
    /// Frames sent repeatedly, by entry.
    periodic: HashMap<Id, (u8, u64)>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Connection {
    fn new(stream: TcpStream, name: String, buses: Arc<[Bus]>, role: Role) -> io::Result<Arc<Self>> {
        let output = Mutex::new(stream.try_clone()?);
        Ok(Arc::new(Self {
            input: Mutex::new(stream),
            output,
            name,
            buses,
            role,
            hearing: Mutex::default(),
            told_at: Mutex::new(Instant::now()),
            is_over: AtomicBool::new(false),
        }))
    }

    /// Carries out the client's commands until either side ends. It has its place for itself once it has said what it wants to receive or
    /// send.
    fn serve(self: &Arc<Self>, place: &Place) -> io::Result<()> {
        self.write("< hi >")?;
        let mut finder = Finder::default();
        let (mut setup, mut opened) = (Setup::default(), None);
        let mut answered_at = Instant::now();
        let came = Instant::now();
        let mut bytes = [0; 4096];
        let mut result = Ok(());
        let mut has_spoken = false;
        while result.is_ok() && !self.is_over.load(Ordering::Relaxed) {
            let len = match lock(&self.input).read(&mut bytes) {
                Ok(0) => break,
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(error) => {
                    result = Err(error);
                    break;
                }
            };
            let bytes = &bytes[..len];
            let is_socketcand = finder.push(bytes, |text| {
                if result.is_err() || self.is_over.load(Ordering::Relaxed) {
                    return;
                }
                let command = command::parse(text);
                let hears = command.as_ref().ok().and_then(|command| mode(command, opened.is_some()));
                if hears.is_some() {
                    lock(&self.hearing).hold();
                }
                let answer = match command {
                    Ok(command) => {
                        has_spoken = true;
                        self.perform(command, &mut setup, &mut opened)
                    }
                    Err(bad) => {
                        // Nothing is skipped in search of the first command.
                        self.is_over.fetch_or(!has_spoken, Ordering::Relaxed);
                        Some(self.misunderstood(&bad, text))
                    }
                };
                if let Some(answer) = answer {
                    std::thread::sleep(BETWEEN_ANSWERS.saturating_sub(answered_at.elapsed()));
                    result = self.write(&answer);
                    answered_at = Instant::now();
                }
                // Only when the answer is on its way may anything else follow.
                match hears {
                    Some(Hears::All) => lock(&self.hearing).begin(Hears::All, answered_at + BEFORE_FRAMES),
                    Some(hears) => lock(&self.hearing).begin(hears, answered_at),
                    None => {}
                }
            });
            if !is_socketcand {
                self.refused(&foreign::reason(bytes));
                break;
            }
            if has_spoken {
                place.spoke();
            }
            if lock(&self.hearing).has_chosen {
                place.is_served();
            }
            match &mut opened {
                None if came.elapsed() > OPEN_TIMEOUT => break,
                None => {}
                Some(bus) => {
                    if let Err(reason) = self.listen_again(bus) {
                        self.refused(&reason);
                        break;
                    }
                }
            }
        }
        self.is_over.store(true, Ordering::Relaxed);
        result
    }

    /// What is answered to a text that is no command.
    fn misunderstood(&self, bad: &BadCommand, text: &str) -> String {
        match bad {
            BadCommand::Unknown => {
                self.refused(&format!("there is no command '{}'", plain(text.trim())));
                "< error unknown command >".to_owned()
            }
            BadCommand::Syntax(what) => {
                let reason = format!("{what} is wrong in '{}'", plain(text.trim()));
                self.refused(&reason);
                self.refusal(&reason)
            }
        }
    }

    /// A reason as the client reads it: in raw mode, clients read nothing but frames.
    fn refusal(&self, reason: &str) -> String {
        if lock(&self.hearing).hears == Hears::All {
            return messages::not_sent();
        }
        format!("< error {} >", plain(reason))
    }

    fn write(&self, text: &str) -> io::Result<()> {
        if text.is_empty() {
            return Ok(());
        }
        *lock(&self.told_at) = Instant::now();
        let patience = patience(self.role);
        let written = write_patiently(&mut *lock(&self.output), text.as_bytes(), patience);
        if written.as_ref().is_err_and(is_idle) && !self.is_over.swap(true, Ordering::Relaxed) {
            let (client, reason) = (self.name.clone(), Some(took_nothing(patience)));
            self.buses[0].board.tell(News::ClientLeft { client, reason });
        }
        written
    }

    /// Carries out one command. Returns what to answer.
    fn perform(
        self: &Arc<Self>,
        command: Command,
        setup: &mut Setup,
        opened: &mut Option<Opened>,
    ) -> Option<String> {
        let ok = || Some("< ok >".to_owned());
        let Some(bus) = opened else {
            return match command {
                Command::Open(name) => match self.open(&name, setup) {
                    Ok(bus) => {
                        *opened = Some(bus);
                        ok()
                    }
                    Err(reason) => {
                        self.refused(&reason);
                        // As the page defines it, the connection ends.
                        self.is_over.store(true, Ordering::Relaxed);
                        Some("< error could not open bus >".to_owned())
                    }
                },
                Command::Bitrate(name, rate) => {
                    setup.bitrates_bps.insert(name, rate);
                    ok()
                }
                Command::ControlMode { triple: true, .. } => {
                    Some("< error this controller samples each bit once >".to_owned())
                }
                Command::ControlMode { listen_only, loopback, .. } => {
                    (setup.listen_only, setup.loopback) = (listen_only, loopback);
                    ok()
                }
                Command::Echo => Some("< echo >".to_owned()),
                _ => Some("< error open a bus first >".to_owned()),
            };
        };
        let chooses = !matches!(
            command,
            Command::Open(_)
                | Command::Bitrate(..)
                | Command::ControlMode { .. }
                | Command::Echo
                | Command::RawMode
                | Command::BcmMode
                | Command::StatisticsMode
        );
        if chooses {
            lock(&self.hearing).has_chosen = true;
        }
        let done = match command {
            Command::Open(_) | Command::Bitrate(..) | Command::ControlMode { .. } => {
                return Some("< error a bus is open already >".to_owned());
            }
            // The mode changes when the client has the answer.
            Command::RawMode | Command::BcmMode | Command::StatisticsMode => return ok(),
            Command::Echo => return Some("< echo >".to_owned()),
            Command::Statistics(ms) => {
                lock(&self.hearing).statistics_every(Duration::from_millis(ms));
                return None;
            }
            Command::Subscribe(us, id) => self.subscribe(id, Wanted::All, us),
            Command::Filter(us, id, mask) => self.subscribe(
                id,
                Wanted::Changes(std::array::from_fn(|at| mask.get(at).copied().unwrap_or(0))),
                us,
            ),
            Command::MuxFilter(us, id, mut tuples) => {
                let selector = tuples.remove(0);
                self.subscribe(id, Wanted::Multiplexed(selector, tuples), us)
            }
            Command::Unsubscribe(id) => {
                lock(&self.hearing).subscriptions.remove(id);
                Ok(())
            }
            Command::Send(frame) => self.send(bus, frame),
            Command::Add(us, frame) => self.add(bus, us, frame),
            Command::Update(frame) => match bus.periodic.get(&frame.id()) {
                Some((_, us)) => {
                    let us = *us;
                    self.add(bus, us, frame)
                }
                None => Err(format!("nothing is sent periodically as {}", frame.id())),
            },
            Command::Delete(id) => match bus.periodic.remove(&id) {
                Some((slot, _)) => {
                    lock(&self.hearing).own_entries.remove(&id);
                    bus.sent_at = Instant::now();
                    bus.device.set_periodic(bus.channel, slot, None).map_err(|error| error.to_string())
                }
                None => Err(format!("nothing is sent periodically as {id}")),
            },
        };
        let reason = done.err()?;
        self.refused(&reason);
        Some(self.refusal(&reason))
    }

    fn refused(&self, reason: &str) {
        self.buses[0].board.tell(News::Refused { client: self.name.clone(), reason: reason.to_owned() });
    }

    fn open(self: &Arc<Self>, name: &str, setup: &Setup) -> Result<Opened, String> {
        let bus = self
            .buses
            .iter()
            .find(|bus| bus.name == name)
            .ok_or_else(|| format!("there is no bus '{}'", plain(name)))?;
        let device = device_of(&bus.board, &self.name, self.role)?;
        let channel = bus.channel;
        let config = match setup.bitrates_bps.get(name) {
            Some(rate) => device.listen(channel, *rate),
            None => device.open_channel(channel, None),
        };
        let config = config.map_err(|error| error.to_string())?;
        let sends_in = match (setup.listen_only, setup.loopback) {
            (true, _) => None,
            (false, true) => Some(Mode::Loopback),
            (false, false) => Some(Mode::Normal),
        };
        let device = Arc::new(device);
        let (connection, heard) = (Arc::clone(self), Arc::clone(&device));
        std::thread::Builder::new()
            .name("cantap-socketcand-hears".to_owned())
            .spawn(move || connection.hear(&heard))
            .map_err(|error| error.to_string())?;
        Ok(Opened {
            device,
            channel,
            config,
            sends_in,
            next_tag: 0,
            sent_at: Instant::now(),
            idle_after: bus.board.idle_sender(),
            periodic: HashMap::new(),
        })
    }

    /// Sends the client what is received, until either side ends.
    fn hear(&self, device: &Device) {
        let mut records = device.records();
        let mut out = String::new();
        while !self.is_over.load(Ordering::Relaxed) {
            // The board or the server is gone, so the connection is, too.
            let Ok(Some(batch)) = records.next_batch(Duration::from_millis(20)) else { break };
            loop {
                let mut hearing = lock(&self.hearing);
                let Some(wait) = hearing.wait() else {
                    hearing.take(&batch, &mut out);
                    break;
                };
                drop(hearing);
                std::thread::sleep(wait);
            }
            records.recycle(batch);
            if out.is_empty() && self.needs_keep_alive() {
                out.push_str(KEEP_ALIVE);
            }
            if self.write(&out).is_err() {
                break;
            }
            out.clear();
        }
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Whether nothing has been sent for too long to a client that reads only frames.
    fn needs_keep_alive(&self) -> bool {
        lock(&self.told_at).elapsed() >= KEEP_ALIVE_EVERY && lock(&self.hearing).hears == Hears::All
    }

    fn subscribe(&self, id: Id, wanted: Wanted, interval_us: u64) -> Result<(), String> {
        if lock(&self.hearing).subscriptions.add(id, wanted, interval_us) {
            Ok(())
        } else {
            Err(format!("{MOST} identifiers are subscribed to, which is the most"))
        }
    }

    /// Opens the bus for sending, when a client sends.
    fn may_send(&self, bus: &mut Opened) -> Result<(), String> {
        let Some(mode) = bus.sends_in else { return Err("the bus was opened to listen only".to_owned()) };
        bus.sent_at = Instant::now();
        if bus.config.mode == mode { Ok(()) } else { self.change_mode(bus, mode) }
    }

    /// Only listens again, if nothing was sent for long enough: a client need not say anything, and one that has been stopped would keep
    /// the board acknowledging for ever.
    fn listen_again(&self, bus: &mut Opened) -> Result<(), String> {
        let Some(after) = bus.idle_after else { return Ok(()) };
        let sends = bus.config.mode != Mode::ListenOnly;
        if !sends || !bus.periodic.is_empty() || bus.sent_at.elapsed() < after {
            return Ok(());
        }
        self.change_mode(bus, Mode::ListenOnly)?;
        let (client, channel) = (self.name.clone(), bus.channel);
        self.buses[0].board.tell(News::Idle { client, channel, after });
        Ok(())
    }

    fn change_mode(&self, bus: &mut Opened, mode: Mode) -> Result<(), String> {
        let said = |error: DeviceError| error.to_string();
        let config = ChannelConfig { mode, ..bus.config };
        bus.device.close_channel(bus.channel).map_err(said)?;
        let opened = bus.device.open_channel(bus.channel, Some(config));
        if opened.is_err() {
            bus.device.open_channel(bus.channel, Some(bus.config)).map_err(said)?;
        }
        // The client has missed what was on the bus meanwhile.
        lock(&self.hearing).has_gap = true;
        bus.config = opened.map_err(said)?;
        Ok(())
    }

    fn send(&self, bus: &mut Opened, frame: Frame) -> Result<(), String> {
        self.may_send(bus)?;
        let tag = bus.next_tag;
        bus.next_tag = (tag + 1) % (1 << 24);
        lock(&self.hearing).own_frames.insert(tag, frame);
        let sent = bus.device.send(bus.channel, &[TxFrame { tag, frame, at_ticks: None }]);
        if let Err(error) = sent {
            lock(&self.hearing).own_frames.remove(&tag);
            return Err(error.to_string());
        }
        Ok(())
    }

    /// Has the board send a frame repeatedly; one with the same identifier is replaced.
    fn add(&self, bus: &mut Opened, us: u64, frame: Frame) -> Result<(), String> {
        self.may_send(bus)?;
        let hello = bus.device.hello();
        let ticks = u128::from(us) * u128::from(hello.tick_hz) / 1_000_000;
        let period_ticks = u32::try_from(ticks).map_err(|_| {
            format!(
                "the board's longest period is {} s",
                u64::from(u32::MAX) / u64::from(hello.tick_hz.max(1))
            )
        })?;
        let slot = match bus.periodic.get(&frame.id()) {
            Some((slot, _)) => *slot,
            None => (0..hello.periodic_slots)
                .find(|slot| bus.periodic.values().all(|(taken, _)| taken != slot))
                .ok_or_else(|| {
                    format!("the board sends at most {} frames periodically", hello.periodic_slots)
                })?,
        };
        let entry = Periodic { frame, period_ticks, count: 0, modifiers: heapless::Vec::new() };
        let before = lock(&self.hearing).own_entries.insert(frame.id(), frame);
        if let Err(error) = bus.device.set_periodic(bus.channel, slot, Some(entry)) {
            let entries = &mut lock(&self.hearing).own_entries;
            match before {
                Some(before) => entries.insert(frame.id(), before),
                None => entries.remove(&frame.id()),
            };
            return Err(error.to_string());
        }
        bus.periodic.insert(frame.id(), (slot, us));
        Ok(())
    }
}

/// Removes what a client could mistake for the end of an answer.
fn plain(text: &str) -> String {
    let is_plain = |letter: &char| !matches!(letter, '<' | '>') && !cantap_trace::clean::is_harmful(*letter);
    text.chars().filter(is_plain).take(200).collect()
}
