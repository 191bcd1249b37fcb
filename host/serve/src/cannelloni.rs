//! A channel in a cannelloni tunnel over UDP (over TCP: [`crate::cannelloni_tcp`]): datagrams to and from one peer, named when the tunnel is opened.
//!
//! Nothing in a datagram shows who sent it, so the socket is connected: the system takes datagrams from the peer's address and port only, and
//! whatever arrives, datagrams go nowhere else. What is sent is what is on the bus, never an answer. The bus is only listened to until the peer
//! sends, as with socketcand. Losses and errors are error frames.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap::{TraceEvent, TraceFrame, TraceRecord};
use cantap_codecs::cannelloni::{NoDatagram, Order, Sequence, Writer, datagram, item, receive};
use cantap_trace::counted;
use cantap_wire::Channel;
use cantap_wire::message::Role;

use crate::connect::SOCKET_TIMEOUT;
use crate::door::role_at;
use crate::feed::{self, Feed, Losses, Source};
use crate::left_out::LOST;
use crate::listen::Listening;
use crate::lock::lock;
use crate::open_bus::OpenBus;
use crate::tunnel_bus::{self, Sorted, Told, TunnelBus};
use crate::{Board, News};

pub use cantap_codecs::cannelloni::PORT;

/// Longest datagram that is read: what a network with large packets carries in one piece. With it, the frames of one are sent within seconds.
const MOST_BYTES: usize = 9000;
/// Datagrams that came to the other computer, which said that nobody is there.
const NOBODY: &str = "datagrams that nobody listened for";
/// Time from a failure to the next try.
const RETRY_AFTER: Duration = Duration::from_millis(500);

/// A channel and where its tunnel ends.
pub struct Tunnel {
    /// The board.
    pub board: Arc<Board>,
    /// The board's channel.
    pub channel: Channel,
    /// The address here, with the port chosen by the system if it is 0.
    pub local: SocketAddr,
    /// The peer's.
    pub peer: SocketAddr,
    /// What the peer may do. At an address that is not this machine's own (loopback), it may only listen.
    pub role: Role,
}

/// Opens a tunnel, which begins as soon as the board is there.
pub fn open(tunnel: Tunnel) -> io::Result<Listening> {
    let Tunnel { board, channel, local, peer, role } = tunnel;
    let role = role_at(peer, role_at(local, role));
    let socket = UdpSocket::bind(local)?;
    socket.connect(peer)?;
    socket.set_read_timeout(Some(SOCKET_TIMEOUT))?;
    let (local, peer) = (socket.local_addr()?, socket.peer_addr()?);
    let name = format!("cannelloni peer {peer}");
    let mut end = End {
        far: Arc::new(Far { socket, bus: TunnelBus::default() }),
        board,
        channel,
        peer,
        name,
        role,
        session: None,
        tried_at: None,
        failed: None,
        sequence: Sequence::default(),
        buffer: vec![0; MOST_BYTES + 1],
    };
    Listening::start("cantap-cannelloni", Some(local), move || end.step())
}

/// The far end, and what is known of it.
struct Far {
    socket: UdpSocket,
    bus: TunnelBus,
}

/// This end of a tunnel.
struct End {
    far: Arc<Far>,
    board: Arc<Board>,
    channel: Channel,
    peer: SocketAddr,
    name: String,
    role: Role,
    session: Option<Session>,
    tried_at: Option<Instant>,
    /// Why there is no session, as last reported.
    failed: Option<String>,
    sequence: Sequence,
    buffer: Vec<u8>,
}

/// A session with the board.
struct Session {
    bus: OpenBus,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Session {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl End {
    /// Waits for a datagram for a short time, and carries out what is in it.
    fn step(&mut self) -> io::Result<()> {
        if self.session.as_ref().is_some_and(|session| session.is_over.load(Ordering::Relaxed)) {
            // The board has gone.
            self.session = None;
        }
        if self.session.is_none() && self.tried_at.is_none_or(|at| at.elapsed() >= RETRY_AFTER) {
            self.tried_at = Some(Instant::now());
            match self.begin() {
                Ok(session) => {
                    self.failed = None;
                    self.session = Some(session);
                }
                Err(reason) => {
                    if self.failed.as_ref() != Some(&reason) {
                        self.board.tell(News::Refused { client: self.name.clone(), reason: reason.clone() });
                        self.failed = Some(reason);
                    }
                }
            }
        }
        match receive(&self.far.socket, self.peer, &mut self.buffer) {
            Ok(Some(len)) => self.take(len),
            Ok(None) => {}
            Err(error) if is_idle(&error) => {}
            // Nobody listens at the other end yet.
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {
                lock(&self.far.bus.left_out).count(NOBODY, 1);
            }
            Err(error) => return Err(error),
        }
        self.listen_again();
        Ok(())
    }

    fn begin(&self) -> Result<Session, String> {
        let (bus, source) = tunnel_bus::open(&self.board, self.channel, &self.name, self.role)?;
        let is_over = Arc::new(AtomicBool::new(false));
        let feed = TunnelFeed {
            far: Arc::clone(&self.far),
            board: Arc::clone(&self.board),
            name: self.name.clone(),
            channel: self.channel,
            is_over: Arc::clone(&is_over),
            writer: Writer::default(),
        };
        let thread = std::thread::Builder::new().name("cantap-cannelloni-hears".to_owned());
        let thread = thread.spawn(move || feed.run(source));
        let thread = Some(thread.map_err(|error| error.to_string())?);
        Ok(Session { bus, is_over, thread })
    }

    /// Takes a datagram.
    fn take(&mut self, len: usize) {
        match self.frames(len) {
            Ok(frames) => {
                let bus = self.session.as_mut().map(|session| &mut session.bus);
                if let Err(reason) = self.far.bus.send(bus, &frames) {
                    self.not_done(reason);
                }
            }
            Err(reason) => self.not_done(reason.to_owned()),
        }
    }

    /// The frames in a datagram. What is left out of it, or missing before it, is reported.
    fn frames(&mut self, len: usize) -> Result<Vec<TraceFrame>, &'static str> {
        if len > MOST_BYTES {
            return Err("it sent a datagram that is too long");
        }
        let bytes = &self.buffer[..len];
        let (header, mut rest) = match datagram(bytes) {
            Ok(datagram) => datagram,
            Err(NoDatagram::TooShort) => return Err("it sent a datagram that is too short"),
            Err(NoDatagram::Other) => return Err("it sent a datagram of another version or operation"),
        };
        let mut faults = match self.sequence.take(header.sequence, bytes) {
            Order::Next => Vec::new(),
            Order::Missing(1) => vec!["1 datagram before this one is missing".to_owned()],
            Order::Missing(missing) => vec![format!("{missing} datagrams before this one are missing")],
            Order::Late => vec!["a datagram came late".to_owned()],
            Order::Anew => {
                vec![
                    "its numbers begin anew, or an unknown number of datagrams before this one is missing"
                        .to_owned(),
                ]
            }
            Order::Repeated => return Err("a datagram came twice; what it holds was not sent again"),
        };
        let sends_fd = self.session.as_ref().is_none_or(|session| session.bus.device.hello().sends_fd());
        let mut sorted = Sorted::default();
        for done in 0..header.count {
            let Some((item, after)) = item(rest) else {
                faults.push(format!(
                    "it sent a datagram that ends before {} of its frames",
                    header.count - done
                ));
                rest = &[];
                break;
            };
            rest = after;
            sorted.push(item, sends_fd);
        }
        if !rest.is_empty() {
            faults.push(format!(
                "{} behind the frames that a datagram says it has",
                counted(rest.len(), "byte")
            ));
        }
        faults.extend(sorted.left_out());
        if !faults.is_empty() {
            self.not_done(faults.join("; "));
        }
        Ok(sorted.frames)
    }

    fn listen_again(&mut self) {
        let Some(session) = &mut self.session else { return };
        let far = &self.far;
        match session.bus.listen_again(|| far.bus.missed()) {
            Ok(None) => {}
            Ok(Some(after)) => {
                let (client, channel) = (self.name.clone(), self.channel);
                self.board.tell(News::Idle { client, channel, after });
            }
            Err(reason) => {
                self.not_done(reason);
                self.session = None;
            }
        }
    }

    fn not_done(&self, reason: String) {
        self.board.tell(News::NotDone { client: self.name.clone(), reason });
    }
}

/// What the far end receives in a session.
struct TunnelFeed {
    far: Arc<Far>,
    board: Arc<Board>,
    name: String,
    channel: Channel,
    is_over: Arc<AtomicBool>,
    writer: Writer,
}

impl TunnelFeed {
    /// Sends it what is on the bus, until the session is over.
    fn run(mut self, source: Source) {
        let untold = feed::run(&mut [source], &mut self);
        lock(&self.far.bus.left_out).count(LOST, untold);
        self.report_left_out(true);
        self.is_over.store(true, Ordering::Relaxed);
    }

    fn report_left_out(&self, is_end: bool) {
        lock(&self.far.bus.left_out).report(is_end, &self.board, &self.name);
    }

    fn put(&mut self, event: &TraceEvent) {
        if !self.writer.has_room() {
            self.flush();
        }
        match self.far.bus.told(event) {
            Some(Told::Frame(TraceFrame::Classic(frame))) => self.writer.push(frame),
            Some(Told::Frame(TraceFrame::Fd(frame))) => self.writer.push_fd(frame),
            Some(Told::Error(id, data)) => self.writer.push_error(id, data),
            None => {}
        }
    }

    /// Sends a datagram. That UDP loses some, their numbers show to the other end; what this computer does not send is counted here, too.
    fn flush(&mut self) {
        let count = u64::from(self.writer.count());
        let Some(bytes) = self.writer.take() else { return };
        let sent = self.far.socket.send(&bytes).or_else(|error| match error.kind() {
            // That is about an earlier datagram, and this one was not sent.
            io::ErrorKind::ConnectionRefused => {
                lock(&self.far.bus.left_out).count(NOBODY, 1);
                self.far.socket.send(&bytes)
            }
            _ => Err(error),
        });
        if sent.is_err() {
            lock(&self.far.bus.left_out).count("frames that could not be sent", count);
        }
    }
}

impl Feed for TunnelFeed {
    fn is_over(&mut self) -> bool {
        self.report_left_out(false);
        self.is_over.load(Ordering::Relaxed)
    }

    fn take(&mut self, _: usize, records: &[TraceRecord]) -> Losses {
        let channel = self.channel.number();
        for record in records.iter().filter(|record| record.channel == channel) {
            if self.far.bus.take_gap() {
                self.put(&TraceEvent::GAP);
            }
            self.put(&record.event);
        }
        Losses::ToldByWriting
    }

    fn is_empty(&self) -> bool {
        self.writer.is_empty()
    }

    fn write(&mut self) -> io::Result<()> {
        self.flush();
        Ok(())
    }
}
