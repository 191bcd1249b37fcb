//! The shared board: the session with it, which starts again whenever the board is there, and requests to it.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::DeviceError;
use cantap::device::{
    Link, Next, PIECE_BYTES, SessionOver, SilenceWatch, encode, is_idle, pipe, write_patiently,
};
use cantap_wire::message::{ChannelConfig, EndReason, Role};
use cantap_wire::record::{LossStage, Record};
use cantap_wire::{
    BitTiming, CHANNELS, Channel, Command, Corruption, Decoded, Decoder, Event, Hello, PROTOCOL_VERSION,
    Refusal, Reply, Request, Response,
};

use crate::client::{self, Guest};
use crate::modes;
use crate::news::News;
use crate::outbox::Item;
use crate::shared::{Refused, Settings, Shared, WRITE_PATIENCE, lock};
use crate::state::{Asked, State, Then};
use crate::stream::Entry;

/// Connects to the board: the one with this serial number, if one was there before and can be found by it.
pub type Connect = Box<dyn FnMut(Option<&str>) -> Result<Link, ConnectError> + Send>;
/// Why connecting failed.
pub type ConnectError = Box<dyn std::error::Error + Send + Sync>;

/// Why a board cannot be shared.
#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    /// It is there, but something is wrong with it.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// It cannot be reached.
    #[error(transparent)]
    Connect(ConnectError),
}

/// Time from a failure to the next try.
const RETRY_AFTER: Duration = Duration::from_millis(500);
/// How often `Hello` is tried, since a board may have half a line from another program in its input.
const HELLO_TRIES: u32 = 3;
/// Time limit for each try, and for every other request before there are clients.
const HELLO_TIMEOUT: Duration = Duration::from_millis(700);
/// How long a server that is ending waits for its clients to take its last messages.
const LAST_WORDS: Duration = Duration::from_millis(1500);
/// Bytes read at a time.
const READ_BYTES: usize = 64 * 1024;
/// Bytes on their way to a client in this process, and from it.
const PIPE_BYTES: usize = 64 * 1024;

/// A shared board. Dropping it ends every session, and the board leaves its buses.
pub struct Board {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl Board {
    /// Begins a session with a board, which must be there now and may go and come back later; messages call it `name`. `news` is
    /// called with what happens, from any thread, and must not block.
    pub fn start(
        name: &str,
        connect: Connect,
        settings: Settings,
        news: impl Fn(News) + Send + Sync + 'static,
    ) -> Result<Self, BoardError> {
        let shared = Arc::new(Shared {
            name: name.to_owned(),
            settings,
            port: Mutex::new(None),
            state: Mutex::default(),
            changed: Condvar::new(),
            setup: Mutex::default(),
            quit: AtomicBool::new(false),
            next_client: AtomicU64::new(1),
            news: Box::new(news),
        });
        let (first, began) = std::sync::mpsc::channel();
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("cantap-board".to_owned())
            .spawn(move || run(&for_thread, connect, first))
            .map_err(DeviceError::Thread)?;
        let mut board = Self { shared, threads: vec![thread] };
        match began.recv() {
            Ok(Ok(())) => {
                let shared = Arc::clone(&board.shared);
                let modes = std::thread::Builder::new().name("cantap-modes".to_owned());
                board.threads.push(modes.spawn(move || modes::run(&shared)).map_err(DeviceError::Thread)?);
                Ok(board)
            }
            Ok(Err(error)) => Err(error),
            Err(_) => Err(DeviceError::WrongReply.into()),
        }
    }

    /// The board's description of itself, while it is there.
    pub fn hello(&self) -> Option<Hello> {
        self.shared.state().hello.clone()
    }

    /// Its name in messages.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// The bit rate of each channel for clients that choose none, in bit/s.
    pub fn bitrates_bps(&self) -> [Option<u32>; CHANNELS] {
        let state = self.shared.state();
        let clock_hz = state.hello.as_ref().map_or(1, |hello| hello.can_clock_hz);
        state.base.map(|config| config.map(|config| config.timing.bitrate_bps(clock_hz)))
    }

    /// The number of clients.
    pub fn clients(&self) -> usize {
        self.shared.state().clients.len()
    }

    pub(crate) fn tell(&self, news: News) {
        self.shared.tell(news);
    }

    /// Admits a client that talks through a stream; messages call it `name`. Reading from `input` must return within a fraction of a
    /// second, as with a [`Link`]'s reader. Returns once the client is admitted; separate threads serve it.
    pub fn admit(
        &self,
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        name: &str,
        role: Role,
    ) -> Result<(), Refused> {
        let guest = Guest { name: name.to_owned(), role, place: None, is_counted: true, is_remote: false };
        self.admit_guest(input, output, guest)
    }

    /// Admits a client at the other end of a line that can break without notice, for which the dead-man time applies
    /// ([`Settings::dead_man`]).
    pub fn admit_remote(
        &self,
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        name: &str,
        role: Role,
    ) -> Result<(), Refused> {
        let guest = Guest { name: name.to_owned(), role, place: None, is_counted: true, is_remote: true };
        self.admit_guest(input, output, guest)
    }

    pub(crate) fn admit_guest(
        &self,
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        guest: Guest,
    ) -> Result<(), Refused> {
        client::admit(&self.shared, Box::new(input), Box::new(output), guest)
    }

    /// Admits a client in this process, which makes a device from this link.
    pub fn link(&self, name: &str, role: Role) -> Result<Link, Refused> {
        self.link_of(Guest { name: name.to_owned(), role, place: None, is_counted: true, is_remote: false })
    }

    /// The same for a client that has its place at a listener already.
    pub(crate) fn link_placed(&self, name: &str, role: Role) -> Result<Link, Refused> {
        self.link_of(Guest { name: name.to_owned(), role, place: None, is_counted: false, is_remote: false })
    }

    fn link_of(&self, guest: Guest) -> Result<Link, Refused> {
        let (reader, output) = pipe(PIPE_BYTES);
        let (input, writer) = pipe(PIPE_BYTES);
        self.admit_guest(input, output, guest)?;
        Ok(Link::new(reader, writer))
    }

    /// Limit for clients at one listener.
    pub(crate) fn most_clients(&self) -> usize {
        self.shared.settings.most_clients
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        self.shared.quit.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        // Clients that are still reading learn that it is over.
        self.shared.wait_for(LAST_WORDS, |state| state.writers == 0);
    }
}

/// The thread's body: one session with the board after another.
fn run(shared: &Arc<Shared>, mut connect: Connect, first: Sender<Result<(), BoardError>>) {
    let mut first = Some(first);
    let mut serial: Option<String> = None;
    let mut told: Option<String> = None;
    while !shared.quit.load(Ordering::Relaxed) {
        let connected = connect(serial.as_deref()).map_err(|source| match source.downcast::<DeviceError>() {
            Ok(error) => BoardError::Device(*error),
            Err(source) => BoardError::Connect(source),
        });
        let session = connected.and_then(|link| Ok(Session::begin(shared, link)?));
        match session {
            Ok(mut session) => {
                serial = Some(session.hello.serial.as_str().to_owned());
                told = None;
                session.publish(shared);
                match first.take() {
                    // If whoever started it has gone meanwhile, `quit` is set.
                    Some(first) => drop(first.send(Ok(()))),
                    None => shared.tell(News::BoardBack { board: shared.name.clone() }),
                }
                let over = session.run(shared);
                let end = if over.is_some() { EndReason::BoardLost } else { EndReason::ServerEnded };
                end_sessions(shared, end);
                if let Some(error) = over {
                    shared.tell(News::BoardLost { board: shared.name.clone(), reason: error.to_string() });
                }
            }
            Err(error) => {
                if let Some(first) = first.take() {
                    let _ = first.send(Err(error));
                    return;
                }
                let reason = error.to_string();
                if told.as_ref() != Some(&reason) {
                    shared.tell(News::BoardLost { board: shared.name.clone(), reason: reason.clone() });
                    told = Some(reason);
                }
            }
        }
        let retry_at = Instant::now() + RETRY_AFTER;
        while Instant::now() < retry_at && !shared.quit.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
    let mut state = shared.state();
    state.is_over = true;
    state.clients.values().for_each(|member| member.outbox.close());
}

/// Tells every client that its session is over, after everything sent to it before.
fn end_sessions(shared: &Shared, reason: EndReason) {
    *lock(&shared.port) = None;
    let mut state = shared.state();
    let ticks = state.latest_ticks;
    for member in state.clients.values_mut().filter(|member| member.in_session) {
        member.in_session = false;
        member.views.iter_mut().for_each(|view| view.config = None);
        member.outbox.push(Item::Ended(reason, ticks));
    }
    state.forget_board();
    drop(state);
    shared.changed.notify_all();
}

/// A session with the board.
struct Session {
    link: Link,
    decoder: Box<Decoder>,
    hello: Hello,
    base: [Option<ChannelConfig>; CHANNELS],
    /// Device time at its beginning.
    ticks: u64,
}

impl Session {
    /// Greets the board, and finds out what must be known before the first request.
    fn begin(shared: &Shared, link: Link) -> Result<Self, DeviceError> {
        let Link { mut reader, mut writer, keep_alive } = link;
        let mut decoder = Box::new(Decoder::new());
        let mut exchange = |id: u16, command: Command| {
            exchange(&mut *reader, &mut *writer, &mut decoder, &Request { id, command }, &shared.name)
        };
        let not_cantap = || DeviceError::NotCantap { address: shared.name.clone() };
        // Answers to an earlier host must not be mistaken for ours, so begin at an arbitrary number.
        let start = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let mut id = start.map_or(1, |since| (since.as_micros() >> 4) as u16);
        let mut hello = None;
        for _ in 0..HELLO_TRIES {
            id = id.wrapping_add(1);
            hello = exchange(id, Command::Hello { protocol: PROTOCOL_VERSION })?;
            if hello.is_some() {
                break;
            }
        }
        let hello = match hello.ok_or_else(not_cantap)? {
            Ok(Reply::Hello(mut hello)) => {
                cantap::device::clean(&mut hello);
                hello
            }
            Ok(_) => return Err(DeviceError::WrongReply),
            Err(Refusal::Protocol { device }) => return Err(DeviceError::Protocol { device }),
            Err(refusal) => return Err(DeviceError::Refused { refusal }),
        };
        let mut base = [None; CHANNELS];
        for channel in Channel::ALL.into_iter().take(usize::from(hello.channels)) {
            id = id.wrapping_add(1);
            base[channel.index()] = match shared.settings.bitrates_bps[channel.index()] {
                Some(bitrate_bps) => {
                    let timing = BitTiming::choose(hello.can_clock_hz, bitrate_bps, None)
                        .map_err(|reason| DeviceError::BitRate { bitrate_bps, reason })?;
                    Some(ChannelConfig::listen_only(timing))
                }
                None => match exchange(id, Command::Defaults { channel })?.ok_or_else(not_cantap)? {
                    Ok(Reply::Defaults(saved)) => Some(ChannelConfig::listen_only(saved.config.timing)),
                    _ => None,
                },
            };
        }
        let time = exchange(id.wrapping_add(1), Command::Time)?.ok_or_else(not_cantap)?;
        let Ok(Reply::Time(ticks)) = time else { return Err(DeviceError::WrongReply) };
        Ok(Self { link: Link { reader, writer, keep_alive }, decoder, hello, base, ticks })
    }

    /// From now on, clients may send requests.
    fn publish(&mut self, shared: &Shared) {
        // First of all: a request that finds the board and no way to it would end the session.
        let writer = std::mem::replace(&mut self.link.writer, Box::new(std::io::sink()));
        *lock(&shared.port) = Some(writer);
        let mut state = shared.state();
        state.base = self.base;
        state.latest_ticks = self.ticks;
        state.hello = Some(self.hello.clone());
    }

    /// Reads until the board is gone. Returns the reason, or `None` if the server should end.
    fn run(self, shared: &Arc<Shared>) -> Option<DeviceError> {
        let Link { mut reader, writer: _, keep_alive } = self.link;
        let mut decoder = self.decoder;
        let name = || shared.name.clone();
        let vanished = |reason: String| Some(DeviceError::Vanished { address: name(), reason });
        let mut bytes = vec![0; READ_BYTES];
        let mut watch = SilenceWatch::default();
        let mut passed_at = Instant::now();
        let over = loop {
            let len = match reader.read(&mut bytes) {
                Ok(0) => break vanished("the connection was closed".to_owned()),
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(error) => break vanished(error.to_string()),
            };
            if shared.quit.load(Ordering::Relaxed) {
                leave_buses(shared, &mut *reader);
                break None;
            }
            let mut heard = Heard::default();
            for piece in bytes[..len].chunks(PIECE_BYTES) {
                let mut state = shared.state();
                take(&mut state, &mut decoder, piece, &mut heard);
                let again = std::mem::take(&mut state.again);
                drop(state);
                for (channel, frame) in again {
                    let frames = heapless::Vec::from_iter([frame]);
                    shared.send_unattended(Command::Send { channel, frames }, Then::SentAgain(frame.tag));
                }
            }
            if len > 0 {
                shared.changed.notify_all();
            }
            if shared.state().must_end {
                break vanished("it does not take requests any more".to_owned());
            }
            if let Some(reason) = heard.end {
                break Some(DeviceError::SessionEnded { address: name(), reason });
            }
            let now = Instant::now();
            let passed = now.duration_since(std::mem::replace(&mut passed_at, now));
            match watch.pass(passed, heard.answered) {
                Next::Listen => {}
                Next::Ask => shared.send_unattended(Command::Time, Then::Nothing),
                Next::GiveUp(silent) => {
                    break Some(DeviceError::Silent { address: name(), seconds: silent.as_secs_f32() });
                }
            }
        };
        *lock(&shared.port) = None;
        drop(reader);
        drop(keep_alive);
        over
    }
}

/// Leaves the buses. A board does that by itself when the port closes, but a request is quicker.
fn leave_buses(shared: &Shared, reader: &mut dyn Read) {
    for channel in Channel::ALL {
        shared.send_unattended(Command::Close { channel }, Then::Nothing);
    }
    // Closing the port immediately may discard what is still to be written.
    let _ = reader.read(&mut [0; 4096]);
}

/// The content of one read, besides records.
#[derive(Default)]
struct Heard {
    answered: bool,
    end: Option<SessionOver>,
}

/// Takes bytes from the board: records go to the clients, answers to the client that sent the request.
fn take(state: &mut State, decoder: &mut Decoder, piece: &[u8], heard: &mut Heard) {
    let mut chunk: Vec<Entry> = Vec::new();
    decoder.push(piece, |decoded| match decoded {
        Decoded::Record { ticks, record: Record::Event(Event::Stopped { channel }) } => {
            state.deliver(&mut chunk);
            state.stopped(channel, ticks);
        }
        Decoded::Record { ticks, record } => chunk.extend(state.take(ticks, record)),
        Decoded::BatchesLost { frames, .. } => {
            for (channel, count) in Channel::ALL.into_iter().zip(frames).filter(|(_, count)| *count > 0) {
                let event = Event::Lost { channel, stage: LossStage::Link, count, at_least: false };
                chunk.push(Entry::event(state.latest_ticks, event));
            }
        }
        Decoded::Response(Response { id, result }) => {
            heard.answered = true;
            if let Err(Refusal::NoSession) = result {
                heard.end = heard.end.or(Some(SessionOver::Refused));
            }
            let Some(Asked { answer, then }) = state.asked.remove(id) else {
                if matches!(result, Ok(Reply::Hello(_))) {
                    heard.end = Some(SessionOver::Greeted);
                }
                return;
            };
            // What came before the answer belongs to the time before it.
            state.deliver(&mut chunk);
            match (then, result) {
                (Then::Opened { client, channel }, Ok(Reply::Opened(config))) => {
                    state.opened(channel, *config);
                    if let Some((client, config)) = client {
                        state.attach(client, channel, config);
                    }
                }
                (Then::SentAgain(tag), Err(_)) => chunk.extend(state.give_up(tag)),
                _ => {}
            }
            // There is room for one; it does not matter if nobody waits any more.
            let _ = answer.try_send(result.clone());
        }
        Decoded::Ended { reason, .. } => {
            heard.end = Some(reason.into());
        }
        Decoded::Corrupt(Corruption::OutOfOrder { .. }) => heard.end = Some(SessionOver::StreamWentBack),
        Decoded::Corrupt(_) | Decoded::OtherProtocol(_) => {}
    });
    state.deliver(&mut chunk);
}

/// Sends a request and waits for the answer, before the thread for that exists. `None` if there is no answer
/// in time.
fn exchange(
    reader: &mut dyn Read,
    writer: &mut dyn Write,
    decoder: &mut Decoder,
    request: &Request,
    name: &str,
) -> Result<Option<Result<Reply, Refusal>>, DeviceError> {
    let vanished = |reason: String| DeviceError::Vanished { address: name.to_owned(), reason };
    // The zero ends anything left in the board's input and selects our protocol over slcan.
    let bytes = [vec![0], encode(request)?].concat();
    write_patiently(writer, &bytes, WRITE_PATIENCE)
        .and_then(|()| writer.flush())
        .map_err(|error| vanished(error.to_string()))?;
    let deadline = Instant::now() + HELLO_TIMEOUT;
    let mut bytes = [0; 4096];
    while Instant::now() < deadline {
        let len = match reader.read(&mut bytes) {
            Ok(0) => return Err(vanished("the connection was closed".to_owned())),
            Ok(len) => len,
            Err(error) if is_idle(&error) => continue,
            Err(error) => return Err(vanished(error.to_string())),
        };
        let mut answer = None;
        decoder.push(&bytes[..len], |decoded| match decoded {
            Decoded::Response(response) if response.id == request.id => {
                answer = Some(response.result.clone());
            }
            Decoded::OtherProtocol(device) => answer = Some(Err(Refusal::Protocol { device })),
            _ => {}
        });
        if answer.is_some() {
            return Ok(answer);
        }
    }
    Ok(None)
}
