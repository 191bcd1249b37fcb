//! An interface of a socketcand server: `socketcand://HOST[:PORT]/can0`.
//!
//! socketcand's `doc/protocol.md`, raw mode. Its server takes an identifier of eight digits as extended; it never tells losses or what became of
//! frames sent, and only our server tells remote frames. The bit rate and the mode of the interface belong to the server's owner.

use std::fmt::Write;
use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{Channel, Frame, Id, Refusal};

use crate::adapter_clock::AdapterClock;
use crate::driver::{At, Bytes, Driver, Incoming, Oddities, OpenError, Opening, poll_bytes};
use crate::line::Line;
use crate::rows::{Row, row};
use crate::source::Piece;

/// socketcand's TCP port.
pub(crate) const PORT: u16 = 29_536;
/// Time limit for an answer.
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// The longest message: a frame with 64 bytes is shorter.
const MAX_MESSAGE: usize = 512;

/// The driver.
pub(crate) struct Socketcand {
    line: Line,
    /// The message that is arriving, from its `<` on.
    partial: Vec<u8>,
    /// What arrives is outside of messages, and is counted.
    is_outside: bool,
    interface: String,
    clock: AdapterClock,
    backlog: Vec<Incoming>,
    oddities: Oddities,
}

impl Socketcand {
    /// Opens an interface of the server at `HOST:PORT`.
    pub fn connect(place: &str, interface: &str, address: &str) -> Result<Self, OpenError> {
        Self::over(Line::tcp(place)?, interface, address)
    }

    fn over(line: Line, interface: &str, address: &str) -> Result<Self, OpenError> {
        let mut server = Self {
            line,
            partial: Vec::new(),
            is_outside: false,
            interface: interface.to_owned(),
            // Microseconds of the server's clock, which never start again.
            clock: AdapterClock::new(1_000, 1 << 53),
            backlog: Vec::new(),
            oddities: Oddities::default(),
        };
        let foreign =
            |_: String| OpenError::Foreign { address: address.to_owned(), expected: "a socketcand server" };
        let greeting = server.answer().map_err(foreign)?;
        if greeting.as_deref() != Some("hi") {
            return Err(foreign(String::new()));
        }
        for command in [format!("< open {interface} >"), "< rawmode >".to_owned()] {
            server.line.write(command.as_bytes());
            match server.answer().map_err(foreign)?.as_deref() {
                Some("ok") => {}
                Some(_) => return Err(OpenError::Refused { address: address.to_owned() }),
                // It refuses with an error, which is read as one of the bus's; silence is no refusal.
                None if !server.backlog.is_empty() => {
                    return Err(OpenError::Refused { address: address.to_owned() });
                }
                None => return Err(foreign(String::new())),
            }
        }
        server.backlog.clear();
        Ok(server)
    }

    /// The next message that is neither a frame nor an error.
    fn answer(&mut self) -> Result<Option<String>, String> {
        let deadline = Instant::now() + ANSWER_WITHIN;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            // Also while it says other things without an end.
            if left.is_zero() {
                return Ok(None);
            }
            let Some(piece) = self.line.next(left)? else { continue };
            let mut answer = None;
            for message in self.split(&piece.content, piece.at) {
                if message.starts_with("frame ") || message.starts_with("error ") {
                    self.take(&message, piece.at);
                } else {
                    answer.get_or_insert(message);
                }
            }
            if answer.is_some() {
                return Ok(answer);
            }
        }
    }

    /// The whole messages, without their brackets.
    fn split(&mut self, bytes: &[u8], arrival: Instant) -> Vec<String> {
        let mut messages = Vec::new();
        for &byte in bytes {
            match byte {
                b'<' => {
                    // One that has no end: the next begins.
                    if !self.partial.is_empty() {
                        self.damaged("messages without an end", arrival);
                    }
                    self.is_outside = false;
                    self.partial = vec![byte];
                }
                b'>' if !self.partial.is_empty() => {
                    let text = String::from_utf8_lossy(&self.partial[1..]).trim().to_owned();
                    self.partial.clear();
                    messages.push(text);
                }
                _ if self.partial.is_empty() => {
                    if !self.is_outside && !byte.is_ascii_whitespace() {
                        self.is_outside = true;
                        self.damaged("bytes outside of messages", arrival);
                    }
                }
                _ if self.partial.len() == MAX_MESSAGE => {
                    self.partial.clear();
                    self.is_outside = true;
                    self.damaged("messages longer than any", arrival);
                }
                _ => self.partial.push(byte),
            }
        }
        messages
    }

    fn damaged(&mut self, kind: &'static str, arrival: Instant) {
        self.oddities.count(kind);
        let (channel, stage, at) = (Channel::Can1, LossStage::Link, At::arrival(arrival));
        self.backlog.push(Incoming::Lost { channel, stage, count: 1, at_least: true, at });
    }

    fn take(&mut self, message: &str, arrival: Instant) {
        let mut fields = message.split_ascii_whitespace();
        match fields.next() {
            Some(kind @ ("frame" | "rtr")) => match frame(fields, kind == "rtr") {
                Some((frame, time_us)) => {
                    let at = self.clock.place(time_us, arrival, &mut self.oddities);
                    self.backlog.push(Incoming::Received { channel: Channel::Can1, frame: frame.into(), at });
                }
                None => self.damaged("frames that cannot be read", arrival),
            },
            Some("error") => {
                let at = At::arrival(arrival);
                self.backlog.push(Incoming::BusErrors { channel: Channel::Can1, count: 1, at });
            }
            _ => self.oddities.count("messages of unknown meaning"),
        }
    }
}

/// A frame from its identifier, its time and its data, or the length that a remote frame asks for; with the time in microseconds. The original server
/// tells no remote frames, ours does.
fn frame<'a>(mut fields: impl Iterator<Item = &'a str>, is_remote: bool) -> Option<(Frame, u64)> {
    let (id, time) = (fields.next()?, fields.next()?);
    let raw = u32::from_str_radix(id, 16).ok()?;
    let id = if id.len() > 3 || raw > Id::MAX_STANDARD { Id::extended(raw) } else { Id::standard(raw) }?;
    let (seconds, fraction) = time.split_once('.').unwrap_or((time, "0"));
    let seconds: u64 = seconds.parse().ok()?;
    let fraction: u64 = format!("{fraction:0<6}").get(..6)?.parse().ok()?;
    let time_us =
        seconds.checked_mul(1_000_000)?.checked_add(fraction).filter(|time_us| *time_us < 1 << 53)?;
    let digits: String = fields.collect();
    if is_remote {
        return Some((Frame::remote_frame(id, digits.parse().ok()?)?, time_us));
    }
    if !digits.len().is_multiple_of(2) || !digits.is_ascii() {
        return None;
    }
    let data: Option<Vec<u8>> = digits
        .as_bytes()
        .chunks(2)
        .map(|pair| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok())
        .collect();
    Some((Frame::data_frame(id, &data?)?, time_us))
}

impl Bytes for Socketcand {
    fn next(&mut self, wait: Duration) -> Result<Option<Piece<Vec<u8>>>, String> {
        self.line.next(wait)
    }

    fn push(&mut self, bytes: &[u8], arrival: Instant) {
        for message in self.split(bytes, arrival) {
            self.take(&message, arrival);
        }
    }

    fn backlog(&mut self) -> &mut Vec<Incoming> {
        &mut self.backlog
    }
}

impl Driver for Socketcand {
    fn row(&self) -> &'static Row {
        row("socketcand").unwrap_or(&crate::ROWS[0])
    }

    fn serial(&self) -> String {
        self.interface.clone()
    }

    fn open(&mut self, _channel: Channel, _opening: Opening) -> Result<(), Refusal> {
        Ok(())
    }

    fn close(&mut self, _channel: Channel) {}

    fn send(&mut self, channel: Channel, mailbox: u8, frame: &Frame) -> bool {
        let at = At::arrival(Instant::now());
        if frame.is_remote() {
            self.oddities.count("remote frames, which cannot be sent");
            self.backlog.push(Incoming::NotSent { channel, mailbox, at });
            return true;
        }
        let width = if frame.id().is_extended() { 8 } else { 3 };
        let mut command = format!("< send {:0width$X} {}", frame.id().raw(), frame.data_len());
        for byte in frame.data() {
            // Writing to a text cannot fail.
            let _ = write!(command, " {byte:02X}");
        }
        command.push_str(" >");
        self.line.write(command.as_bytes());
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
        fn any_text_is_a_frame_or_refused(text in "[0-9a-fA-Fxé. -]{0,40}") {
            if let Some((frame, time_us)) = frame(text.split_ascii_whitespace(), false) {
                proptest::prop_assert!(frame.data_len() <= 8 && time_us < 1 << 53);
            }
        }
    }
}
