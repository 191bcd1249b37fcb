//! The other end of a cannelloni tunnel: `cannelloni://HOST:PORT[?listen=PORT]` over UDP.
//!
//! As its README describes the datagrams: version 2, operation 0, a sequence number of eight bits, a count of frames; each frame an identifier
//! as Linux has it, a length, the data unless it is remote. There is no time in it, and UDP may lose or reorder.

use std::io;
use std::net::UdpSocket;
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Frame, Id, Refusal};

use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::rows::{Row, row};
use crate::source::{Piece, Source};

/// cannelloni's usual port.
pub(crate) const PORT: u16 = 20_000;
const VERSION: u8 = 2;
const DATA: u8 = 0;
const HEADER: usize = 5;
const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// Largest datagram.
const MAX_DATAGRAM: usize = 65_536;

const EXTENDED: u32 = 1 << 31;
const REMOTE: u32 = 1 << 30;
const ERROR: u32 = 1 << 29;
/// In the length: a CAN FD frame, with a byte of flags after it.
const FD: u8 = 0x80;

/// The driver.
pub(crate) struct Cannelloni {
    socket: UdpSocket,
    source: Source<Vec<u8>>,
    /// The next datagram's number.
    expected: Option<u8>,
    sequence: u8,
    is_open: bool,
    backlog: Vec<Incoming>,
    oddities: Oddities,
    failed: Option<String>,
}

impl Cannelloni {
    /// A tunnel to `HOST:PORT`, whose other end sends to `listen` here.
    pub fn connect(place: &str, listen: u16, address: &str) -> Result<Self, OpenError> {
        Self::try_connect(place, listen)
            .map_err(|source| OpenError::Unreachable { address: address.to_owned(), source })
    }

    fn try_connect(place: &str, listen: u16) -> io::Result<Self> {
        let socket = UdpSocket::bind(("0.0.0.0", listen))?;
        // Only this peer is heard.
        socket.connect(place)?;
        socket.set_read_timeout(Some(READ_TIMEOUT))?;
        let receiver = socket.try_clone()?;
        let mut buffer = vec![0; MAX_DATAGRAM];
        let source = Source::start(true, move || match receiver.recv(&mut buffer) {
            Ok(len) => Ok(Some(buffer[..len].to_vec())),
            // Nobody listens at the other end yet.
            Err(error) if is_idle(&error) || error.kind() == io::ErrorKind::ConnectionRefused => Ok(None),
            Err(error) => Err(error.to_string()),
        })?;
        Ok(Self {
            socket,
            source,
            expected: None,
            sequence: 0,
            is_open: false,
            backlog: Vec::new(),
            oddities: Oddities::default(),
            failed: None,
        })
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
        let Some((&[version, operation, sequence, high, low], mut rest)) =
            bytes.split_first_chunk::<HEADER>()
        else {
            return self.oddities.count("datagrams that are too short");
        };
        if (version, operation) != (VERSION, DATA) {
            return self.oddities.count("datagrams of another version or operation");
        }
        let expected = self.expected.replace(sequence.wrapping_add(1));
        match sequence.wrapping_sub(expected.unwrap_or(sequence)) {
            0 => {}
            missing @ 1..0x80 => {
                self.oddities.count("gaps between datagrams");
                // Each had at least a frame.
                self.lost(missing.into(), true, at);
            }
            _ => self.oddities.count("datagrams out of order"),
        }
        let count = u32::from(u16::from_be_bytes([high, low]));
        for done in 0..count {
            let Some((parsed, after)) = frame(rest) else {
                self.oddities.count("datagrams that end too early");
                return self.lost(count - done, false, at);
            };
            rest = after;
            match parsed {
                Parsed::Frame(frame) => {
                    self.backlog.push(Incoming::Received { channel: Channel::Can1, frame, at });
                }
                Parsed::Error => {
                    self.backlog.push(Incoming::BusErrors { channel: Channel::Can1, count: 1, at });
                }
                Parsed::Fd => {
                    self.oddities.count("CAN FD frames, which do not fit the device's protocol");
                    self.lost(1, false, at);
                }
                Parsed::Impossible => {
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

/// A frame of a datagram.
enum Parsed {
    Frame(Frame),
    Error,
    Fd,
    Impossible,
}

/// The first frame, and what follows it; `None` if it is not whole.
fn frame(bytes: &[u8]) -> Option<(Parsed, &[u8])> {
    let (raw, rest) = bytes.split_first_chunk()?;
    let raw = u32::from_be_bytes(*raw);
    let (&length, rest) = rest.split_first()?;
    let (is_fd, len) = (length & FD != 0, usize::from(length & !FD));
    let rest = if is_fd { rest.get(1..)? } else { rest };
    if raw & REMOTE != 0 {
        return Some((
            id_of(raw)
                .and_then(|id| Frame::remote_frame(id, len as u8))
                .map_or(Parsed::Impossible, Parsed::Frame),
            rest,
        ));
    }
    let (data, rest) = rest.split_at_checked(len)?;
    let parsed = match id_of(raw) {
        _ if raw & ERROR != 0 => Parsed::Error,
        _ if is_fd => Parsed::Fd,
        id => id.and_then(|id| Frame::data_frame(id, data)).map_or(Parsed::Impossible, Parsed::Frame),
    };
    Some((parsed, rest))
}

fn id_of(raw: u32) -> Option<Id> {
    let id = raw & !(EXTENDED | REMOTE | ERROR);
    if raw & EXTENDED != 0 { Id::extended(id) } else { Id::standard(id) }
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
        self.expected = None;
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        self.is_open = false;
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let id = frame.id();
        let raw = id.raw() | u32::from(id.is_extended()) << 31 | u32::from(frame.is_remote()) << 30;
        let mut datagram = vec![VERSION, DATA, self.sequence, 0, 1];
        self.sequence = self.sequence.wrapping_add(1);
        datagram.extend_from_slice(&raw.to_be_bytes());
        datagram.push(frame.dlc().min(8));
        datagram.extend_from_slice(frame.data());
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

#[cfg(test)]
mod tests {
    use super::*;

    proptest::proptest! {
        #[test]
        fn any_bytes_are_a_frame_or_not_whole(bytes: Vec<u8>) {
            if let Some((_, rest)) = frame(&bytes) {
                proptest::prop_assert!(rest.len() < bytes.len());
            }
        }
    }
}
