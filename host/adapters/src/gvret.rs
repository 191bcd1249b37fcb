//! GVRET adapters: ESP32RET, M2RET and Macchina's boards, on a serial port or TCP.
//!
//! The protocol knows neither remote frames nor errors nor losses, and the adapter stamps a frame when it leaves it. It keeps what it was last
//! set to: until it is opened here, it may acknowledge frames.
//!
//! A bus with CAN FD has a message of its own, which has no flags and which ESP32RET uses there for classical frames, too. It is read only if the address says
//! at which data bit rate its bus runs: what is received so is then a CAN FD frame that switches to it. None is sent: for ESP32RET the bytes of such a command
//! are other commands.

use std::time::{Duration, Instant};

use cantap_codecs::gvret::{Bus, Command, Message, message};
use cantap_wire::record::LossStage;
use cantap_wire::{Channel, FdFrame, Frame, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;

pub(crate) use cantap_codecs::gvret::PORT;
/// The speed of a serial line if the address gives none (ESP32RET, `Serial.begin`).
pub(crate) const DEFAULT_BAUD: u32 = 1_000_000;
/// Time limit for an answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(700);

/// The driver.
pub(crate) struct Gvret {
    line: Line,
    bytes: Vec<u8>,
    channels: u8,
    build: u16,
    buses: [Bus; 2],
    /// Whether messages of buses with CAN FD are read.
    reads_fd: bool,
    clock: AdapterClock,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl Gvret {
    /// Finds out what is at the other end of a line, and switches its buses off.
    pub fn over(line: Line, reads_fd: bool, address: &str) -> Result<Self, OpenError> {
        let mut gvret = Self {
            line,
            bytes: Vec::new(),
            channels: 1,
            build: 0,
            buses: [Bus::default(); 2],
            reads_fd,
            clock: AdapterClock::new(1_000, 1 << 32),
            backlog: Vec::new(),
            oddities: Oddities::default(),
        };
        let foreign =
            |_: String| OpenError::Foreign { address: address.to_owned(), expected: "a GVRET adapter" };
        gvret.greet().map_err(foreign)?;
        gvret.backlog.clear();
        Ok(gvret)
    }

    fn greet(&mut self) -> Result<(), String> {
        self.write(&[Command::Binary, Command::Binary, Command::KeepAlive]);
        self.answer(|message| (*message == Message::Alive).then_some(()))?.ok_or("no answer")?;
        self.write(&[Command::GetNumber]);
        let number = self.answer(|message| match message {
            Message::Number(number) => Some(*number),
            _ => None,
        })?;
        // An older one does not know the question, and has two.
        self.channels = number.unwrap_or(2).clamp(1, 2);
        self.write(&[Command::GetInfo]);
        let build = self.answer(|message| match message {
            Message::Info { build } => Some(*build),
            _ => None,
        })?;
        self.build = build.unwrap_or(0);
        self.set();
        Ok(())
    }

    /// Waits for a message; what else comes is kept.
    fn answer<R>(&mut self, mut is_it: impl FnMut(&Message) -> Option<R>) -> Result<Option<R>, String> {
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            // Also while it says other things without an end.
            if left.is_zero() {
                return Ok(None);
            }
            let Some(piece) = self.line.next(left)? else { continue };
            let mut found = None;
            self.read(&piece.content, piece.at, |message| {
                if found.is_none() {
                    found = is_it(message);
                }
            });
            if found.is_some() {
                return Ok(found);
            }
        }
    }

    fn read(&mut self, bytes: &[u8], arrival: Instant, mut see: impl FnMut(&Message)) {
        self.bytes.extend_from_slice(bytes);
        let mut used = 0;
        while let Some((message, len)) = message(&self.bytes[used..]) {
            used += len;
            see(&message);
            self.take(&message, arrival);
        }
        self.bytes.drain(..used);
    }

    fn take(&mut self, message: &Message, arrival: Instant) {
        match *message {
            Message::Frame { stamp_us, bus, frame } => {
                let Some(channel) = Channel::from_number(bus + 1) else {
                    return self.oddities.count("frames of a third or higher bus");
                };
                let at = self.clock.place(stamp_us.into(), arrival, &mut self.oddities);
                self.backlog.push(Incoming::Received { channel, frame: frame.into(), at });
            }
            Message::Fd { stamp_us, bus, frame } => self.take_fd(stamp_us, bus, frame, arrival),
            Message::Garbage => {
                self.oddities.count("bytes that are no message");
                let (channel, stage, at) = (Channel::Can1, LossStage::Link, At::arrival(arrival));
                // A row of them is one gap.
                if !matches!(self.backlog.last(), Some(Incoming::Lost { .. })) {
                    self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
                }
            }
            Message::Buses(_)
            | Message::Info { .. }
            | Message::Alive
            | Message::Time(_)
            | Message::Number(_)
            | Message::Other => {}
        }
    }

    fn take_fd(&mut self, stamp_us: u32, bus: u8, frame: Option<FdFrame>, arrival: Instant) {
        let Some(channel) = Channel::from_number(bus.saturating_add(1)) else {
            return self.oddities.count("frames of a third or higher bus");
        };
        let frame = match frame {
            Some(frame) if self.reads_fd => FdFrame::new(frame.id(), true, false, frame.data()),
            Some(_) => {
                self.oddities
                    .count("messages of a bus with CAN FD, which are read with ?data-bitrate in the address");
                None
            }
            None => {
                self.oddities.count("CAN FD frames that cannot be");
                None
            }
        };
        let Some(frame) = frame else {
            let (stage, at) = (LossStage::Link, At::arrival(arrival));
            return self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: false, at });
        };
        let at = self.clock.place(stamp_us.into(), arrival, &mut self.oddities);
        self.backlog.push(Incoming::Received { channel, frame: frame.into(), at });
    }

    /// Tells the adapter both buses' settings.
    fn set(&mut self) {
        self.write(&[Command::SetBuses(self.buses.map(|bus| (bus, Some(bus.only_listens))))]);
    }

    fn write(&mut self, commands: &[Command]) {
        let mut bytes = Vec::new();
        for command in commands {
            command.put(&mut bytes);
        }
        self.line.write(&bytes);
    }
}

impl Bytes for Gvret {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.line.next(wait)
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        self.read(bytes, arrival, |_| {});
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for Gvret {
    fn row(&self) -> &'static Row {
        row(if self.reads_fd { "gvret-fd" } else { "gvret" }).unwrap_or(&crate::ROWS[0])
    }

    fn channels(&self) -> u8 {
        self.channels
    }

    fn version(&self) -> [u16; 3] {
        [self.build, 0, 0]
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let before = self.buses;
        let wanted = Bus { is_on: true, only_listens: opening.listen_only, bitrate_bps: opening.bitrate_bps };
        self.buses[channel.index()] = wanted;
        self.set();
        self.write(&[Command::GetBuses]);
        let buses = self.answer(|message| match message {
            Message::Buses(buses) => Some(*buses),
            _ => None,
        });
        match buses {
            Ok(Some(buses)) if buses[channel.index()] == wanted => Ok(()),
            other => {
                // Left as it is, it might acknowledge frames, or destroy them.
                self.buses = before;
                self.set();
                Err(if matches!(other, Ok(Some(_))) { Refusal::Unsupported } else { Refusal::Hardware })
            }
        }
    }

    fn close(&mut self, channel: Channel) {
        self.buses[channel.index()] = Bus::default();
        self.set();
        self.write(&[Command::KeepAlive]);
        // Its answer comes after everything received before.
        let _ = self.answer(|message| (*message == Message::Alive).then_some(()));
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let at = At::arrival(Instant::now());
        if frame.is_remote() {
            self.oddities.count("remote frames, which cannot be sent");
            self.backlog.push(Incoming::NotSent { channel, mailbox, at });
            return true;
        }
        self.write(&[Command::Frame { bus: channel.index() as u8, frame: *frame }]);
        self.backlog.push(Incoming::Sent { channel, mailbox, at });
        true
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        poll_bytes(self, wait, reports)
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
