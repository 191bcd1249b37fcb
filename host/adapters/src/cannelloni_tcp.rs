//! The other end of a cannelloni tunnel over TCP, which waits for connections (`cannelloni -C s`): `cannelloni:tcp://HOST[:PORT]`.
//!
//! TCP loses nothing on the way, and there is no time in it. A frame that cannot be ends the connection: where the next one begins, nobody knows, and what
//! is read there could be frames that never were.

use std::time::{Duration, Instant};

use cantap_codecs::cannelloni::{BadStream, GREETING, Item, Stream, put, put_fd};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, FdFrame, Frame, Refusal};

use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;

/// Time limit for the greeting. cannelloni looks for new connections every two seconds.
const GREETED_WITHIN: Duration = Duration::from_secs(5);

/// The driver.
pub(crate) struct CannelloniTcp {
    line: Line,
    stream: Stream,
    backlog: Vec<Incoming>,
    oddities: Oddities,
    failed: Option<String>,
}

impl CannelloniTcp {
    /// Connects to `HOST:PORT`, and waits for the greeting.
    pub fn connect(place: &str, address: &str) -> Result<Self, OpenError> {
        Self::over(Line::tcp(place)?, address, GREETED_WITHIN)
    }

    fn over(line: Line, address: &str, within: Duration) -> Result<Self, OpenError> {
        let mut tunnel = Self {
            line,
            stream: Stream::default(),
            backlog: Vec::new(),
            oddities: Oddities::default(),
            failed: None,
        };
        let foreign =
            || OpenError::Foreign { address: address.to_owned(), expected: "cannelloni over TCP (-C s)" };
        tunnel.line.write(GREETING);
        let deadline = Instant::now() + within;
        loop {
            if tunnel.stream.is_greeted().map_err(|_| foreign())? {
                // What came along with it is taken now, not with the time of what comes next.
                tunnel.push(&[], Instant::now());
                return Ok(tunnel);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(foreign());
            }
            if let Some(piece) = tunnel.line.next(left).map_err(|_| foreign())? {
                tunnel.stream.push(&piece.content);
            }
        }
    }

    fn lost(&mut self, at: At) {
        let (channel, stage) = (Channel::Can1, LossStage::Link);
        self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
    }

    fn hand_over(&mut self, bytes: &[u8], channel: Channel, mailbox: u8) -> bool {
        self.line.write(bytes);
        self.backlog.push(Incoming::Sent { channel, mailbox, at: At::arrival(Instant::now()) });
        true
    }
}

impl Bytes for CannelloniTcp {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        let next = self.line.next(wait);
        if next.is_err() && self.stream.is_amid_frame() {
            // It ends in the middle of one.
            self.stream = Stream::default();
            self.oddities.count("frames that were not whole at the end");
            self.lost(At::arrival(Instant::now()));
        }
        next
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        let (channel, at) = (Channel::Can1, At::arrival(arrival));
        self.stream.push(bytes);
        let backlog = &mut self.backlog;
        let read = self.stream.frames(|item| match item {
            Item::Frame(frame) => backlog.push(Incoming::Received { channel, frame: frame.into(), at }),
            Item::Fd(frame) => backlog.push(Incoming::Received { channel, frame: frame.into(), at }),
            Item::Error => backlog.push(Incoming::BusErrors { channel, count: 1, at }),
            Item::Impossible => {}
        });
        if let Err(BadStream::NoFrame | BadStream::NoGreeting) = read {
            self.oddities.count("frames that cannot be");
            self.lost(at);
            self.failed =
                Some("it sends what is no frame of cannelloni's: look what is at the other end".to_owned());
        }
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for CannelloniTcp {
    fn row(&self) -> &'static Row {
        row("cannelloni-tcp").unwrap_or(&crate::ROWS[0])
    }

    fn open(&mut self, _channel: Channel, _opening: Opening) -> Result<(), Refusal> {
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {}

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let mut bytes = Vec::new();
        put(frame, &mut bytes);
        self.hand_over(&bytes, channel, mailbox)
    }

    fn sends_fd(&self) -> bool {
        true
    }

    fn send_fd(&mut self, channel: Channel, mailbox: u8, frame: &FdFrame) -> bool {
        let mut bytes = Vec::new();
        put_fd(frame, &mut bytes);
        self.hand_over(&bytes, channel, mailbox)
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        match &self.failed {
            Some(reason) => Err(reason.clone()),
            None => poll_bytes(self, wait, reports),
        }
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
