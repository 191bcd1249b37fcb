//! The other end of a cannelloni tunnel: `cannelloni://HOST:PORT[?listen=PORT]` over UDP.
//!
//! There is no time in its datagrams, and UDP may lose or reorder them.

use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs as _, UdpSocket};
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_codecs::cannelloni::{Item, NoDatagram, Order, Sequence, Writer, datagram, item, receive};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, FdFrame, Frame, Refusal};

use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::rows::{Row, row};
use crate::source::{Piece, Source};

pub(crate) use cantap_codecs::cannelloni::PORT;

const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// Largest datagram.
const MAX_DATAGRAM: usize = 65_536;

/// The driver.
pub(crate) struct Cannelloni {
    socket: UdpSocket,
    source: Source<Vec<u8>>,
    sequence: Sequence,
    writer: Writer,
    is_open: bool,
    backlog: Vec<Incoming>,
    oddities: Oddities,
    failed: Option<String>,
}

impl Cannelloni {
    /// A tunnel to `HOST:PORT`, whose other end sends to `listen` here.
    pub fn connect(place: &str, listen: u16, address: &str) -> Result<Self, OpenError> {
        Self::try_connect(place, listen).map_err(|source| {
            let address = address.to_owned();
            if source.kind() == io::ErrorKind::AddrInUse {
                let reason = format!(
                    "another program has UDP port {listen} of this computer; end it, or have the other end send to another port and give that as ?listen=PORT"
                );
                return OpenError::Channel { address, reason };
            }
            OpenError::Unreachable { address, source }
        })
    }

    fn try_connect(place: &str, listen: u16) -> io::Result<Self> {
        let socket = tunnel(place, listen)?;
        socket.set_read_timeout(Some(READ_TIMEOUT))?;
        let peer = socket.peer_addr()?;
        let receiver = socket.try_clone()?;
        let mut buffer = vec![0; MAX_DATAGRAM];
        let source = Source::start(true, move || match receive(&receiver, peer, &mut buffer) {
            Ok(len) => Ok(len.map(|len| buffer[..len].to_vec())),
            // Nobody listens at the other end yet.
            Err(error) if is_idle(&error) || error.kind() == io::ErrorKind::ConnectionRefused => Ok(None),
            Err(error) => Err(error.to_string()),
        })?;
        Ok(Self {
            socket,
            source,
            sequence: Sequence::default(),
            writer: Writer::default(),
            is_open: false,
            backlog: Vec::new(),
            oddities: Oddities::default(),
            failed: None,
        })
    }

    /// Sends a datagram with what was written.
    fn hand_over(&mut self, channel: Channel, mailbox: u8) -> bool {
        let datagram = self.writer.take().unwrap_or_default();
        match self.socket.send(&datagram) {
            Ok(_) => {}
            // Nobody listens at the other end: as with a lost datagram, nobody knows.
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => {
                self.oddities.count("frames sent to nobody");
            }
            Err(error) => self.failed = Some(error.to_string()),
        }
        self.backlog.push(Incoming::Sent { channel, mailbox, at: At::arrival(Instant::now()) });
        true
    }

    fn lost(&mut self, count: u32, at_least: bool, at: At) {
        self.backlog.push(Incoming::Lost {
            channel: Channel::Can1,
            stage: LossStage::Link,
            count,
            at_least,
            at,
        });
    }

    fn datagram(&mut self, bytes: &[u8], arrival: Instant) {
        let at = At::arrival(arrival);
        let (header, mut rest) = match datagram(bytes) {
            Ok(datagram) => datagram,
            Err(NoDatagram::TooShort) => return self.oddities.count("datagrams that are too short"),
            Err(NoDatagram::Other) => {
                return self.oddities.count("datagrams of another version or operation");
            }
        };
        match self.sequence.take(header.sequence, bytes) {
            Order::Next => {}
            // How many are missing, if any, nobody knows.
            Order::Anew => {
                self.oddities.count("long gaps between datagrams, or new beginnings of the other end");
                self.lost(0, true, at);
            }
            Order::Missing(missing) => {
                self.oddities.count("gaps between datagrams");
                // Each had at least a frame.
                self.lost(missing.into(), true, at);
            }
            Order::Late => self.oddities.count("datagrams out of order"),
            // What it holds was received once.
            Order::Repeated => return self.oddities.count("datagrams that came twice"),
        }
        let count = u32::from(header.count);
        for done in 0..count {
            let Some((parsed, after)) = item(rest) else {
                self.oddities.count("datagrams that end too early");
                return self.lost(count - done, false, at);
            };
            rest = after;
            match parsed {
                Item::Frame(frame) => {
                    self.backlog.push(Incoming::Received { channel: Channel::Can1, frame: frame.into(), at });
                }
                Item::Error => {
                    self.backlog.push(Incoming::BusErrors { channel: Channel::Can1, count: 1, at });
                }
                Item::Fd(frame) => {
                    self.backlog.push(Incoming::Received { channel: Channel::Can1, frame: frame.into(), at });
                }
                Item::Impossible => {
                    self.oddities.count("frames that cannot be");
                    self.lost(1, false, at);
                }
            }
        }
        if !rest.is_empty() {
            self.oddities.count("datagrams with bytes after their frames");
        }
    }
}

/// A socket that hears only the peer: of its kind of address, and of the first of a name's that can be reached, those of IPv4 before others.
fn tunnel(place: &str, listen: u16) -> io::Result<UdpSocket> {
    let mut peers: Vec<SocketAddr> = place.to_socket_addrs()?.collect();
    peers.sort_by_key(SocketAddr::is_ipv6);
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name has no address");
    for peer in peers {
        let here: IpAddr =
            if peer.is_ipv6() { Ipv6Addr::UNSPECIFIED.into() } else { Ipv4Addr::UNSPECIFIED.into() };
        let socket = UdpSocket::bind((here, listen));
        match socket.and_then(|socket| socket.connect(peer).map(|()| socket)) {
            Ok(socket) => return Ok(socket),
            Err(error) => last = error,
        }
    }
    Err(last)
}

impl Bytes for Cannelloni {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.source.next(wait)
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        self.datagram(bytes, arrival);
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for Cannelloni {
    fn row(&self) -> &'static Row {
        row("cannelloni").unwrap_or(&crate::ROWS[0])
    }

    fn open(&mut self, _channel: Channel, _opening: Opening) -> Result<(), Refusal> {
        self.is_open = true;
        self.sequence = Sequence::default();
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        self.is_open = false;
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        self.writer.push(frame);
        self.hand_over(channel, mailbox)
    }

    fn sends_fd(&self) -> bool {
        true
    }

    fn send_fd(&mut self, channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        self.writer.push_fd(frame);
        self.hand_over(channel, mailbox)
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        if let Some(reason) = &self.failed {
            return Err(reason.clone());
        }
        poll_bytes(self, wait, reports)
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
