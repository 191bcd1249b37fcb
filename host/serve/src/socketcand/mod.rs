//! The socketcand protocol (<https://github.com/linux-can/socketcand>, doc/protocol.md), for SavvyCAN, Kayak, python-can and
//! other clients: raw, BCM and control mode, and the beacon. ISO-TP mode is not supported.
//!
//! The protocol page leaves some things open, and clients differ: `messages` defines how frames are written, `command` how they are read. The
//! bus is only listened to until a client that may send does so; its frames are then passed on to the others, but not to itself. Frames
//! sent repeatedly (`add`) are sent by the board, timed by its own clock.

mod bus_feed;
mod command;
mod connection;
mod hearing;
mod messages;
mod opened;
mod subscriptions;

use std::collections::HashMap;
use std::io::{self, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use cantap::device::channel_number;
use cantap_trace::Interface;
use cantap_wire::message::{Mode, Role};
use cantap_wire::{Channel, Id};

use crate::beacon::{self, Beacon};
use crate::door::{AdmittedClient, Door};
use crate::feed::Source;
use crate::foreign;
use crate::lines::device_of;
use crate::listen::Listening;
use crate::lock::lock;
use crate::open_bus::OpenBus;
use crate::places::NoPlace;
use crate::{Board, News};
use bus_feed::BusFeed;
use command::{BadCommand, Command, Finder};
use connection::{Bus, Connection};
use hearing::Hears;
use opened::Opened;
use subscriptions::{MOST, Wanted};

/// The port of the original server.
pub const PORT: u16 = 29_536;
/// Clients compare the result of one read with one answer, so two are not sent together.
const BETWEEN_ANSWERS: Duration = Duration::from_millis(20);
/// For the same reason, no frame right after the answer to `rawmode`.
const BEFORE_FRAMES: Duration = Duration::from_millis(100);
/// A client that has not opened a bus by this time is dropped.
const OPEN_TIMEOUT: Duration = Duration::from_secs(30);
/// Limit for connections at a time, including those that have not opened a bus.
const MOST_CONNECTIONS: usize = 32;

/// Admits clients. The buses are the boards' channels, `can0` being the first board's first, as in every trace. The protocol has no
/// authentication: at an address that is not this machine's own (loopback), clients may only listen.
pub fn listen(boards: &[Arc<Board>], address: SocketAddr, role: Role) -> io::Result<Listening> {
    let door = Door::open("socketcand client", address, role, MOST_CONNECTIONS)?;
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
    let names: Vec<&str> = buses.iter().map(|bus| bus.name.as_str()).collect();
    let beacon = Beacon::new(door.address, boards, &names)?;
    let mut sent: Option<Instant> = None;
    Listening::start("cantap-socketcand", Some(door.address), move || {
        if sent.is_none_or(|sent| sent.elapsed() >= beacon::EVERY) {
            beacon.send();
            sent = Some(Instant::now());
        }
        let (role, of_client) = (door.role, Arc::clone(&buses));
        let turn_away = |stream: &mut TcpStream, client: String, full: NoPlace| {
            let _ = stream.write(format!("< error {full} >").as_bytes());
            buses[0].board.tell(News::Refused { client, reason: full.to_string() });
        };
        door.admit(turn_away, move |visitor| {
            if let Ok(output) = visitor.stream.try_clone() {
                // An error means that the connection is gone.
                let _ = Connection::new(output, visitor.name.clone(), of_client, role).serve(visitor);
            }
        })
    })
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

impl Connection {
    /// Carries out the client's commands until either side ends. It has its place for itself once it has said what it wants to receive or
    /// send.
    fn serve(self: &Arc<Self>, mut visitor: AdmittedClient) -> io::Result<()> {
        self.write("< hi >")?;
        let mut finder = Finder::default();
        let (mut setup, mut opened) = (Setup::default(), None);
        let mut answered_at = Instant::now();
        let mut bytes = [0; 4096];
        let mut result = Ok(());
        let mut has_spoken = false;
        while result.is_ok() && !self.is_over.load(Ordering::Relaxed) {
            let Some(len) = visitor.read(&mut bytes) else { break };
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
                        Some(self.misunderstood(&bad, text, has_spoken))
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
                visitor.place.spoke();
            }
            if lock(&self.hearing).has_chosen {
                visitor.place.is_served();
            }
            match &mut opened {
                None if visitor.has_been_for(OPEN_TIMEOUT) => break,
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

    /// What is answered to a text that is no command; if it is the first, the connection ends.
    fn misunderstood(&self, bad: &BadCommand, text: &str, has_spoken: bool) -> String {
        let (reason, answer) = match bad {
            BadCommand::Unknown => (
                format!("there is no command '{}'", plain(text.trim())),
                Some("< error unknown command >".to_owned()),
            ),
            BadCommand::Fd => {
                ("the protocol has no message for CAN FD frames, and none was sent".to_owned(), None)
            }
            BadCommand::Syntax(what) => (format!("{what} is wrong in '{}'", plain(text.trim())), None),
        };
        if has_spoken {
            self.not_done(&reason);
        } else {
            self.refused(&reason);
        }
        answer.unwrap_or_else(|| self.refusal(&reason))
    }

    /// A reason as the client reads it: in raw mode, clients read nothing but frames.
    fn refusal(&self, reason: &str) -> String {
        if lock(&self.hearing).hears == Hears::All {
            return messages::not_sent();
        }
        format!("< error {} >", plain(reason))
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
            Command::Send(frame) => self.send(&mut bus.bus, frame),
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
                    lock(&self.hearing).own.repeats(id, None);
                    let bus = &mut bus.bus;
                    bus.has_ended_sending();
                    bus.device.set_periodic(bus.channel, slot, None).map_err(|error| error.to_string())
                }
                None => Err(format!("nothing is sent periodically as {id}")),
            },
        };
        let reason = done.err()?;
        self.not_done(&reason);
        Some(self.refusal(&reason))
    }

    /// A command was not carried out.
    fn not_done(&self, reason: &str) {
        self.buses[0].board.tell(News::NotDone { client: self.name.clone(), reason: reason.to_owned() });
    }

    /// The connection ends for this reason.
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
        let (feed, source) = (BusFeed::new(self), Source::new(&bus.board, &device));
        std::thread::Builder::new()
            .name("cantap-socketcand-hears".to_owned())
            .spawn(move || feed.run(source))
            .map_err(|error| error.to_string())?;
        Ok(Opened::new(OpenBus::new(device, channel, config, sends_in, bus.board.idle_sender())))
    }

    fn subscribe(&self, id: Id, wanted: Wanted, interval_us: u64) -> Result<(), String> {
        if lock(&self.hearing).subscriptions.add(id, wanted, interval_us) {
            Ok(())
        } else {
            Err(format!("{MOST} identifiers are subscribed to, which is the most"))
        }
    }
}

/// Removes what a client could mistake for the end of an answer.
fn plain(text: &str) -> String {
    let is_plain = |letter: &char| !matches!(letter, '<' | '>') && !cantap_trace::clean::is_harmful(*letter);
    text.chars().filter(is_plain).take(200).collect()
}
