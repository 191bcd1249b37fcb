//! USB-CAN-A: the adapters of Waveshare, Seeed Studio ("USB-CAN Analyzer") and others with a CH340 and messages that begin with `AA`.
//!
//! After Waveshare's definition of the protocol, kobolt/usb-can (`canusb.c`) and python-can (`seeedstudio.py`). The adapter confirms nothing: neither its
//! settings nor a frame. It has no command to leave its bus and keeps what it was last set to, so it is set to be silent before and after a channel is
//! open. A message has no checksum: where bytes are lost on the line, two halves may look like a frame, which the byte at its end and the one after that
//! make unlikely.

mod wire;

use std::time::{Duration, Instant};

use cantap_wire::record::{ErrorState, LossStage};
use cantap_wire::{Channel, Frame, Refusal};

use self::wire::{Message, Settings, message};
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::error_frames::ErrorFrames;
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;

/// The speed of the line if the address gives none: that of adapters as they are sold.
pub(crate) const DEFAULT_BAUD: u32 = 2_000_000;
/// The bit rate before a channel is open: silent, it disturbs no other.
const IDLE_BPS: u32 = 500_000;
/// How long a line must be quiet to be empty.
const QUIET: Duration = Duration::from_millis(60);
/// Time limit for an answer. Some adapters give none.
const ANSWER_WITHIN: Duration = Duration::from_millis(700);
/// How often the state is asked for.
const ASK_EVERY: Duration = Duration::from_secs(1);
/// A message of which so much time has passed since its last byte has lost its end. At 9600 baud a whole one takes 21 ms.
const CUT_AFTER: Duration = Duration::from_secs(1);

/// The driver.
pub(crate) struct UsbCanA {
    line: Line,
    extended: bool,
    bytes: Vec<u8>,
    /// When the last bytes arrived.
    arrived: Instant,
    is_open: bool,
    errors: ErrorFrames,
    /// When the state was last asked for.
    asked: Instant,
    /// It has answered when it was asked.
    tells_state: bool,
    /// The last bytes were no message, which is one loss.
    in_garbage: bool,
    ended: Option<String>,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl UsbCanA {
    /// Finds out, as far as that is possible, what is at the other end of a line, and silences it.
    pub fn over(line: Line, extended: bool, address: &str) -> Result<Self, OpenError> {
        let mut adapter = Self {
            line,
            extended,
            bytes: Vec::new(),
            arrived: Instant::now(),
            is_open: false,
            errors: ErrorFrames::default(),
            asked: Instant::now(),
            tells_state: false,
            in_garbage: false,
            ended: None,
            backlog: Vec::new(),
            oddities: Oddities::default(),
        };
        let is_one = adapter.greet().unwrap_or(false);
        if let Some(reason) = adapter.ended.take() {
            return Err(OpenError::Channel { address: address.to_owned(), reason });
        }
        if !is_one {
            return Err(OpenError::Foreign { address: address.to_owned(), expected: "a USB-CAN-A adapter" });
        }
        if !adapter.tells_state {
            adapter.oddities.count("questions not answered: whether an adapter is there is not known");
        }
        adapter.forget();
        Ok(adapter)
    }

    /// Returns whether this may be such an adapter: it has answered, or said nothing that one does not say.
    fn greet(&mut self) -> Result<bool, String> {
        self.set(IDLE_BPS, true);
        self.line.discard(QUIET)?;
        // Once more: an earlier program may have left half a message, whose end the first were.
        self.set(IDLE_BPS, true);
        self.ask_state();
        let deadline = Instant::now() + ANSWER_WITHIN;
        let (mut messages, mut garbage) = (0, 0);
        while !self.tells_state && self.ended.is_none() {
            let left = deadline.saturating_duration_since(Instant::now());
            // Also while it says other things without an end.
            if left.is_zero() {
                break;
            }
            let Some(piece) = self.line.next(left)? else { continue };
            let mut is_echo = false;
            self.read(&piece.content, piece.at, |message| match message {
                Message::Garbage => garbage += 1,
                Message::Settings => is_echo = true,
                _ => messages += 1,
            });
            if is_echo {
                self.ended = None;
                return Ok(false);
            }
        }
        Ok(self.tells_state || messages > 0 || garbage == 0 && self.bytes.is_empty())
    }

    /// Leaves nothing of what was received before, but for a message whose end is still to come.
    fn forget(&mut self) {
        self.backlog.clear();
        self.errors = ErrorFrames::default();
    }

    fn set(&mut self, bitrate_bps: u32, silent: bool) -> bool {
        let Some(rate) = wire::rate(bitrate_bps) else { return false };
        self.line.write(&wire::settings(Settings { rate, extended: self.extended, silent }));
        true
    }

    fn ask_state(&mut self) {
        self.asked = Instant::now();
        self.line.write(&wire::ask_state());
    }

    fn read(&mut self, bytes: &[u8], arrival: Instant, mut see: impl FnMut(Message)) {
        self.arrived = arrival;
        self.bytes.extend_from_slice(bytes);
        let mut used = 0;
        while let Some((message, len)) = message(&self.bytes[used..]) {
            used += len;
            see(message);
            self.take(message, At::arrival(arrival));
        }
        self.bytes.drain(..used);
    }

    fn take(&mut self, message: Message, at: At) {
        let channel = Channel::Can1;
        let was_garbage = std::mem::replace(&mut self.in_garbage, message == Message::Garbage);
        match message {
            Message::Frame(frame) => {
                self.backlog.push(Incoming::Received { channel, frame: frame.into(), at });
            }
            Message::State { transmit, receive } => {
                self.tells_state = true;
                // Nothing says whether it is off the bus.
                let state = ErrorState::of_counters(transmit, receive);
                self.errors.set(state, Some((transmit, receive)), channel, at, &mut self.backlog);
            }
            Message::FixedFrame => self.end(
                "it sends frames in packets of fixed length, so it has not taken its settings, and whether it only listens is not known; \
                 choose \"variable length\" in its maker's program",
            ),
            Message::Settings => self.end("it returns what it is sent, and is no adapter"),
            Message::Other => self.oddities.count("packets of unknown kind"),
            Message::Garbage => {
                self.oddities.count("bytes that are no message");
                if !was_garbage {
                    self.lost(at);
                }
            }
        }
    }

    /// Something came that cannot be read: at least one frame may be missing.
    fn lost(&mut self, at: At) {
        let (channel, stage) = (Channel::Can1, LossStage::Link);
        self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
    }

    fn end(&mut self, reason: &str) {
        self.ended.get_or_insert_with(|| reason.to_owned());
    }

    /// Gives up a message whose end does not come.
    fn give_up_cut_message(&mut self) {
        if !self.bytes.is_empty() && self.arrived.elapsed() >= CUT_AFTER {
            self.bytes.clear();
            self.oddities.count("messages without an end");
            self.lost(At::arrival(Instant::now()));
            // Its end, should it come, is the same loss.
            self.in_garbage = true;
        }
    }
}

impl Bytes for UsbCanA {
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

impl Driver for UsbCanA {
    fn row(&self) -> &'static Row {
        row(if self.extended { "usb-can-a-extended" } else { "usb-can-a" }).unwrap_or(&crate::ROWS[0])
    }

    fn open(&mut self, _channel: Channel, opening: Opening) -> Result<(), Refusal> {
        self.forget();
        if !self.set(opening.bitrate_bps, opening.listen_only) {
            return Err(Refusal::BadTiming);
        }
        self.is_open = true;
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {
        self.is_open = false;
        self.set(IDLE_BPS, true);
        // It goes on telling what it hears: what arrived before this is taken.
        let closed = Instant::now();
        while let Ok(Some(piece)) = self.line.next(Duration::ZERO)
            && piece.at <= closed
        {
            self.push(&piece.content, piece.at);
        }
    }

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        self.line.write(&wire::frame(frame));
        self.backlog.push(Incoming::Sent { channel, mailbox, at: At::arrival(Instant::now()) });
        true
    }

    fn poll(&mut self, wait: Duration, reports: &mut Vec<Incoming>) -> Result<(), String> {
        if self.is_open && self.tells_state && self.asked.elapsed() >= ASK_EVERY {
            self.ask_state();
        }
        let before = self.arrived;
        let polled = poll_bytes(self, wait, reports);
        if self.arrived == before {
            self.give_up_cut_message();
        }
        match self.ended.clone() {
            Some(reason) => Err(reason),
            None => polled,
        }
    }

    fn oddities(&self) -> (u32, String) {
        self.oddities.summary()
    }
}
