//! GVRET: the binary protocol of ESP32RET, M2RET and Macchina's boards, on a serial port or TCP port 23.
//!
//! As ESP32RET reads and writes it (`src/gvret_comm.cpp`, `src/commbuffer.cpp`). It knows neither remote frames nor errors nor losses, and
//! stamps a frame when it leaves the adapter. The adapter keeps what it was last set to: until it is opened here, it may acknowledge frames.

use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Frame, Id, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;

/// The TCP port that the adapters listen on.
pub(crate) const PORT: u16 = 23;
/// The speed of a serial line if the address gives none (ESP32RET, `Serial.begin`).
pub(crate) const DEFAULT_BAUD: u32 = 1_000_000;
/// Time limit for an answer.
const ANSWER_WITHIN: Duration = Duration::from_millis(700);

/// Begins every command and every message.
const START: u8 = 0xF1;
const FRAME: u8 = 0;
const SET_BUSES: u8 = 5;
const GET_BUSES: u8 = 6;
const GET_INFO: u8 = 7;
const KEEP_ALIVE: u8 = 9;
const GET_NUMBER: u8 = 12;
const FD_FRAME: u8 = 20;

/// Bits of a bus's setting: the others are valid, it is on, it only listens.
const SET_STATE: u32 = 1 << 31;
const ENABLED: u32 = 1 << 30;
const LISTENS: u32 = 1 << 29;

/// A message from the adapter.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Message {
    Frame {
        stamp_us: u32,
        bus: u8,
        frame: Frame,
    },
    /// A CAN FD frame on this bus.
    Fd {
        bus: u8,
    },
    /// Two buses: whether each is on, only listens, and its bit rate in bit/s.
    Buses([(bool, bool, u32); 2]),
    /// Its firmware's build number.
    Info {
        build: u16,
    },
    Alive,
    Number(u8),
    Other,
    /// Bytes that are no message.
    Garbage,
}

/// The first message in the bytes, and its length; `None` if it is not complete.
fn message(bytes: &[u8]) -> Option<(Message, usize)> {
    let (&start, rest) = bytes.split_first()?;
    if start != START {
        let len = bytes.iter().position(|byte| *byte == START).unwrap_or(bytes.len());
        return Some((Message::Garbage, len));
    }
    let (&kind, content) = rest.split_first()?;
    let u32_at = |at: usize| content.get(at..)?.first_chunk().map(|bytes| u32::from_le_bytes(*bytes));
    Some(match kind {
        FRAME => {
            let (stamp_us, raw) = (u32_at(0)?, u32_at(4)?);
            let lengths = *content.get(8)?;
            let (len, bus) = (usize::from(lengths & 0xF), lengths >> 4);
            let id = id_of(raw);
            // A length that no frame has, or an impossible identifier: the start was data.
            let Some(id) = id.filter(|_| len <= 8) else { return Some((Message::Garbage, 1)) };
            let data = content.get(9..9 + len)?;
            content.get(9 + len)?;
            let frame = Frame::data_frame(id, data)?;
            (Message::Frame { stamp_us, bus, frame }, 2 + 9 + len + 1)
        }
        FD_FRAME => {
            let (len, bus) = (usize::from(*content.get(8)?), *content.get(9)?);
            if len > 64 {
                return Some((Message::Garbage, 1));
            }
            content.get(10 + len)?;
            (Message::Fd { bus }, 2 + 10 + len + 1)
        }
        GET_BUSES => {
            let bus = |at: usize| {
                let state = *content.get(at)?;
                Some((state & 0xF != 0, state >> 4 != 0, u32_at(at + 1)?))
            };
            (Message::Buses([bus(0)?, bus(5)?]), 2 + 10)
        }
        GET_INFO => {
            content.get(5)?;
            let build = u16::from_le_bytes(*content.first_chunk()?);
            (Message::Info { build }, 2 + 6)
        }
        KEEP_ALIVE => match content.first_chunk::<2>()? {
            [0xDE, 0xAD] => (Message::Alive, 2 + 2),
            _ => (Message::Garbage, 1),
        },
        GET_NUMBER => (Message::Number(*content.first()?), 2 + 1),
        // Time, digital and analogue inputs, further buses.
        1 | 2 | 3 | 13 => {
            let len = match kind {
                1 => 4,
                2 => 2,
                _ => 15,
            };
            content.get(len - 1)?;
            (Message::Other, 2 + len)
        }
        _ => (Message::Garbage, 1),
    })
}

fn id_of(raw: u32) -> Option<Id> {
    const EXTENDED: u32 = 1 << 31;
    if raw & EXTENDED != 0 { Id::extended(raw & !EXTENDED) } else { Id::standard(raw) }
}

/// The driver.
pub(crate) struct Gvret {
    line: Line,
    bytes: Vec<u8>,
    channels: u8,
    build: u16,
    settings: [u32; 2],
    clock: AdapterClock,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl Gvret {
    /// Finds out what is at the other end of a line, and switches its buses off.
    pub fn over(line: Line, address: &str) -> Result<Self, OpenError> {
        let mut gvret = Self {
            line,
            bytes: Vec::new(),
            channels: 1,
            build: 0,
            settings: [SET_STATE; 2],
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
        self.line.write(&[0xE7, 0xE7, START, KEEP_ALIVE]);
        self.answer(|message| (*message == Message::Alive).then_some(()))?.ok_or("no answer")?;
        self.line.write(&[START, GET_NUMBER]);
        let number = self.answer(|message| match message {
            Message::Number(number) => Some(*number),
            _ => None,
        })?;
        // An older one does not know the question, and has two.
        self.channels = number.unwrap_or(2).clamp(1, 2);
        self.line.write(&[START, GET_INFO]);
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
                let at = self.clock.place(stamp_us.into(), arrival);
                self.backlog.push(Incoming::Received { channel, frame, at });
            }
            Message::Fd { bus } => {
                self.oddities.count("CAN FD frames, which do not fit the device's protocol");
                if let Some(channel) = Channel::from_number(bus.saturating_add(1)) {
                    let (stage, at) = (LossStage::Link, At::arrival(arrival));
                    self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: false, at });
                }
            }
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
            | Message::Number(_)
            | Message::Other => {}
        }
    }

    /// Tells the adapter both buses' settings.
    fn set(&mut self) {
        let mut command = vec![START, SET_BUSES];
        for setting in self.settings {
            command.extend_from_slice(&setting.to_le_bytes());
        }
        self.line.write(&command);
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
        row("gvret").unwrap_or(&crate::ROWS[0])
    }

    fn channels(&self) -> u8 {
        self.channels
    }

    fn version(&self) -> [u16; 3] {
        [self.build, 0, 0]
    }

    fn open(&mut self, channel: Channel, opening: Opening) -> Result<(), Refusal> {
        let before = self.settings;
        let listens = if opening.listen_only { LISTENS } else { 0 };
        self.settings[channel.index()] = SET_STATE | ENABLED | listens | opening.bitrate_bps;
        self.set();
        self.line.write(&[START, GET_BUSES]);
        let buses = self.answer(|message| match message {
            Message::Buses(buses) => Some(*buses),
            _ => None,
        });
        let wanted = (true, opening.listen_only, opening.bitrate_bps);
        match buses {
            Ok(Some(buses)) if buses[channel.index()] == wanted => Ok(()),
            other => {
                // Left as it is, it might acknowledge frames, or destroy them.
                self.settings = before;
                self.set();
                Err(if matches!(other, Ok(Some(_))) { Refusal::Unsupported } else { Refusal::Hardware })
            }
        }
    }

    fn close(&mut self, channel: Channel) {
        self.settings[channel.index()] = SET_STATE;
        self.set();
        self.line.write(&[START, KEEP_ALIVE]);
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
        let id = frame.id();
        let raw = id.raw() | u32::from(id.is_extended()) << 31;
        let mut command = vec![START, FRAME];
        command.extend_from_slice(&raw.to_le_bytes());
        command.extend_from_slice(&[channel.index() as u8, frame.data_len() as u8]);
        command.extend_from_slice(frame.data());
        // Where a checksum was meant to be, which nobody checks.
        command.push(0);
        self.line.write(&command);
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

#[cfg(test)]
mod tests {
    use super::*;

    proptest::proptest! {
        #[test]
        fn whatever_arrives_is_used_up_or_waited_for(bytes: Vec<u8>) {
            if let Some((_, len)) = message(&bytes) {
                proptest::prop_assert!((1..=bytes.len()).contains(&len));
            } else {
                // No message is longer than a CAN FD frame.
                proptest::prop_assert!(bytes.len() < 80);
            }
        }
    }

    #[test]
    fn a_frame_in_data_that_lies_about_its_length_is_not_one() {
        // A length nibble of 15.
        let lie = [START, FRAME, 1, 0, 0, 0, 0x23, 1, 0, 0, 0x0F, 0, 0, 0, 0, 0, 0, 0, 0];
        assert_eq!(message(&lie), Some((Message::Garbage, 1)));
        let whole = [START, FRAME, 4, 3, 2, 1, 0x23, 1, 0, 0, 0x12, 0xAA, 0xBB, 0];
        let frame = "123#AABB".parse().ok();
        let read = match message(&whole) {
            Some((Message::Frame { stamp_us: 0x0102_0304, bus: 1, frame }, 14)) => Some(frame),
            _ => None,
        };
        assert_eq!(read, frame);
        for cut in 0..whole.len() {
            assert_eq!(message(&whole[..cut]), None, "{cut}");
        }
    }
}
