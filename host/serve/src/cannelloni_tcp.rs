//! A channel in cannelloni's tunnels over TCP: clients connect (`cannelloni -C c -R HOST`), and each has what is on the bus.
//!
//! A client greets first, and until it has, it is sent nothing. The bus is only listened to until a client sends, as with UDP; losses and errors are error
//! frames. A frame that cannot be ends the connection: what comes behind it could be data that look like a frame, and would be sent.

use std::io;
use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use cantap::device::{is_idle, write_patiently};
use cantap::{TraceEvent, TraceFrame, TraceRecord};
use cantap_codecs::cannelloni::{BadStream, GREETING, Stream, put, put_error, put_fd};
use cantap_wire::Channel;
use cantap_wire::message::Role;

use crate::door::{AdmittedClient, Door};
use crate::feed::{self, Feed, Losses, Source};
use crate::foreign;
use crate::left_out::LOST;
use crate::listen::{Listening, patience};
use crate::lock::lock;
use crate::open_bus::OpenBus;
use crate::places::NoPlace;
use crate::tunnel_bus::{self, Sorted, Told, TunnelBus};
use crate::writer::took_nothing;
use crate::{Board, News};

/// Admits clients to a board's channel. The protocol has no authentication: at an address that is not this machine's own (loopback), they may only listen.
pub fn listen(
    board: &Arc<Board>,
    channel: Channel,
    address: SocketAddr,
    role: Role,
) -> io::Result<Listening> {
    let door = Door::open("cannelloni client", address, role, board.most_clients())?;
    let board = Arc::clone(board);
    Listening::start("cantap-cannelloni", Some(door.address), move || {
        let (role, of_client) = (door.role, Arc::clone(&board));
        let turn_away = |_: &mut TcpStream, client: String, full: NoPlace| {
            board.tell(News::Refused { client, reason: full.to_string() });
        };
        door.admit(turn_away, move |visitor| {
            let Ok(output) = visitor.stream.try_clone() else { return };
            let connection = Connection {
                output: Mutex::new(output),
                name: visitor.name.clone(),
                board: of_client,
                channel,
                role,
                bus: TunnelBus::default(),
                is_over: AtomicBool::new(false),
            };
            Arc::new(connection).serve(visitor);
        })
    })
}

/// One client.
struct Connection {
    output: Mutex<TcpStream>,
    name: String,
    board: Arc<Board>,
    channel: Channel,
    role: Role,
    bus: TunnelBus,
    is_over: AtomicBool,
}

/// What a client has once it has greeted.
struct Session {
    bus: OpenBus,
    thread: JoinHandle<()>,
}

impl Connection {
    /// Sends what the client sends until either side ends.
    fn serve(self: &Arc<Self>, mut visitor: AdmittedClient) {
        let (mut stream, mut session, mut first) = (Stream::default(), None, Vec::new());
        let mut bytes = [0; 4096];
        while !self.is_over() {
            let Some(len) = visitor.read(&mut bytes) else { break };
            if len > 0 {
                visitor.place.spoke();
            }
            stream.push(&bytes[..len]);
            if session.is_none() {
                first.extend_from_slice(&bytes[..len]);
                match stream.is_greeted() {
                    Ok(true) => match self.begin() {
                        Ok(begun) => session = Some(begun),
                        Err(reason) => {
                            self.refused(reason);
                            break;
                        }
                    },
                    Ok(false) if visitor.is_late() => break,
                    Ok(false) => continue,
                    Err(_) => {
                        self.refused(foreign::reason(&first));
                        break;
                    }
                }
            }
            let Some(session) = &mut session else { continue };
            visitor.place.is_served();
            if let Err(BadStream::NoFrame | BadStream::NoGreeting) = self.take(&mut stream, &mut session.bus)
            {
                self.refused("it sent what is no frame".to_owned());
                break;
            }
            if let Err(reason) = self.listen_again(&mut session.bus) {
                self.refused(reason);
                break;
            }
        }
        self.end();
        if let Some(Session { thread, bus }) = session {
            let _ = thread.join();
            drop(bus);
        }
        lock(&self.bus.left_out).report(true, &self.board, &self.name);
    }

    fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }

    fn end(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    fn begin(self: &Arc<Self>) -> Result<Session, String> {
        let (bus, source) = tunnel_bus::open(&self.board, self.channel, &self.name, self.role)?;
        self.write(GREETING).map_err(|error| error.to_string())?;
        let feed = ClientFeed { connection: Arc::clone(self), out: Vec::new() };
        let thread = std::thread::Builder::new().name("cantap-cannelloni-hears".to_owned());
        let thread = thread.spawn(move || feed.run(source)).map_err(|error| error.to_string())?;
        Ok(Session { bus, thread })
    }

    /// Has the frames sent that are whole.
    fn take(&self, stream: &mut Stream, bus: &mut OpenBus) -> Result<(), BadStream> {
        let sends_fd = bus.device.hello().sends_fd();
        let mut sorted = Sorted::default();
        let read = stream.frames(|item| sorted.push(item, sends_fd));
        let left_out: Vec<String> = sorted.left_out().collect();
        if !left_out.is_empty() {
            self.not_done(left_out.join("; "));
        }
        if let Err(reason) = self.bus.send(Some(bus), &sorted.frames) {
            self.not_done(reason);
        }
        read
    }

    fn listen_again(&self, bus: &mut OpenBus) -> Result<(), String> {
        if let Some(after) = bus.listen_again(|| self.bus.missed())? {
            let (client, channel) = (self.name.clone(), self.channel);
            self.board.tell(News::Idle { client, channel, after });
        }
        Ok(())
    }

    fn write(&self, bytes: &[u8]) -> io::Result<()> {
        let patience = patience(self.role);
        let written = write_patiently(&mut *lock(&self.output), bytes, patience);
        if written.as_ref().is_err_and(is_idle) && !self.is_over.swap(true, Ordering::Relaxed) {
            let (client, reason) = (self.name.clone(), Some(took_nothing(patience)));
            self.board.tell(News::ClientLeft { client, reason });
        }
        written
    }

    /// The connection ends for this reason.
    fn refused(&self, reason: String) {
        self.board.tell(News::Refused { client: self.name.clone(), reason });
    }

    /// Something was not sent, for which the protocol has no answer.
    fn not_done(&self, reason: String) {
        self.board.tell(News::NotDone { client: self.name.clone(), reason });
    }
}

/// What a client receives.
struct ClientFeed {
    connection: Arc<Connection>,
    out: Vec<u8>,
}

impl ClientFeed {
    /// Sends the client what is on the bus, until either side ends.
    fn run(mut self, source: Source) {
        let untold = feed::run(&mut [source], &mut self);
        lock(&self.connection.bus.left_out).count(LOST, untold);
        self.connection.end();
    }

    fn put(&mut self, event: &TraceEvent) {
        match self.connection.bus.told(event) {
            Some(Told::Frame(TraceFrame::Classic(frame))) => put(frame, &mut self.out),
            Some(Told::Frame(TraceFrame::Fd(frame))) => put_fd(frame, &mut self.out),
            Some(Told::Error(id, data)) => put_error(id, data, &mut self.out),
            None => {}
        }
    }
}

impl Feed for ClientFeed {
    fn is_over(&mut self) -> bool {
        let connection = &self.connection;
        lock(&connection.bus.left_out).report(false, &connection.board, &connection.name);
        connection.is_over()
    }

    fn take(&mut self, _: usize, records: &[TraceRecord]) -> Losses {
        let channel = self.connection.channel.number();
        for record in records.iter().filter(|record| record.channel == channel) {
            if self.connection.bus.take_gap() {
                self.put(&TraceEvent::GAP);
            }
            self.put(&record.event);
        }
        Losses::ToldByWriting
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
