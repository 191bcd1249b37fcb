//! openpilot's rlog and qlog: Cap'n Proto messages one after another, each an `Event`, of which a few kinds hold CAN frames.
//!
//! The layout of these few is written out here and not generated from the schema: a log is what a crash or a failing disk made of it,
//! so every length is checked before it is followed.
//!
//! Source: openpilot's `cereal/log.capnp` (`Event`, `CanData`, `InitData`), its `panda.h` for `src`, and Cap'n Proto's encoding.

mod message;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io;

use super::codec::{Decode, REQUESTS_TO_SEND};
use super::found::Found;
use super::frame_fields::{FdFields, FrameFields, Payload, identifier};
use super::input::{Input, MAX_ITEM_BYTES};
use super::issue::{Fault, Place};
use super::panda::{self, REJECTED};
use cantap_trace::{TraceEvent, TraceRecord};
use message::{LONGEST_TABLE_BYTES, Message, Struct};

const OTHER_EVENTS: &str = "openpilot's events other than CAN frames";
const UNHEALTHY: &str = "the link to the panda was disturbed: frames may be missing";
const NO_DATE: &str = "the log does not say when the device started: times count from then";

/// Which member of the union an event is.
mod kind {
    pub(super) const INIT_DATA: u16 = 0;
    pub(super) const CAN: u16 = 4;
    pub(super) const SENDCAN: u16 = 16;
}

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    /// What the last event contained.
    found: VecDeque<Found>,
    clock: Clock,
}

/// How the device's clock becomes a time since 1970.
#[derive(Clone, Copy, Default)]
enum Clock {
    #[default]
    Unknown,
    /// Unknown, and reported.
    Reported,
    Begins {
        /// When the device started, in nanoseconds since 1970.
        at_ns: i64,
    },
}

/// Whether a file begins with an event.
pub(crate) fn is_head(bytes: &[u8]) -> bool {
    message::event_len(bytes).is_some()
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        loop {
            if let Some(found) = self.found.pop_front() {
                return Ok(found);
            }
            if !self.read(input)? {
                return Ok(Found::End);
            }
        }
    }
}

impl Decoder {
    /// Reads the next event into `found`, which may stay empty; false at the end.
    fn read(&mut self, input: &mut Input) -> io::Result<bool> {
        let place = Place::Offset(input.offset());
        let head = input.peek(LONGEST_TABLE_BYTES)?;
        if head.is_empty() {
            return Ok(false);
        }
        let (is_short, len) = (head.len() < LONGEST_TABLE_BYTES, message::event_len(head));
        let shown = head[..head.len().min(16)].to_vec();
        let whole = match len {
            Some(len) if len <= MAX_ITEM_BYTES => input.peek(len)?.get(..len),
            _ => None,
        };
        if let (Some(len), Some(bytes)) = (len, whole) {
            if self.event(bytes, place).is_none() {
                let found = Fault::malformed("an event of openpilot", b"one with parts beyond its end");
                self.found.push_back(Found::Issue(place, found));
            }
            input.consume(len);
            return Ok(true);
        }
        // A length beyond the end is that of a file which was cut, or a wrong one with events behind it.
        let may_be_cut = len.is_some_and(|len| len <= MAX_ITEM_BYTES) || is_short;
        let fault = if resync(input)? || !may_be_cut {
            Fault::malformed("an event of openpilot", &shown)
        } else {
            Fault::Truncated("an event")
        };
        self.found.push_back(Found::Issue(place, fault));
        Ok(true)
    }

    /// The content of an event; `None` if it contradicts itself.
    fn event(&mut self, bytes: &[u8], place: Place) -> Option<()> {
        let message = Message::new(bytes)?;
        let event = message.root()?;
        let mono_ns = event.u64(0);
        match event.u16(8) {
            kind::INIT_DATA => {
                let wall_ns = event.pointer(0)?.struct_at()?.u64(8);
                // Logs from before 2022 have none.
                if wall_ns > 0 {
                    let at_ns = i64::try_from(wall_ns).ok()?.checked_sub(i64::try_from(mono_ns).ok()?)?;
                    self.clock = Clock::Begins { at_ns };
                }
                self.found.push_back(Found::LeftOut(OTHER_EVENTS));
            }
            kind::CAN => {
                const INVALID: u8 = 1;
                let at_ns = match self.clock {
                    Clock::Begins { at_ns } => at_ns,
                    Clock::Unknown => {
                        self.clock = Clock::Reported;
                        self.found.push_back(Found::Note(NO_DATE));
                        0
                    }
                    Clock::Reported => 0,
                };
                let time_ns = i64::try_from(mono_ns).ok()?.checked_add(at_ns)?;
                if event.u8(10) & INVALID != 0 {
                    self.found.push_back(Found::Note(UNHEALTHY));
                }
                for frame in event.pointer(0)?.structs()? {
                    self.found.push_back(match can_data(&frame?, time_ns) {
                        Ok(found) => found,
                        Err(fault) => Found::Issue(place, fault),
                    });
                }
            }
            kind::SENDCAN => {
                let frames = event.pointer(0)?.structs()?;
                self.found.extend(frames.map(|_| Found::Note(REQUESTS_TO_SEND)));
            }
            _ => self.found.push_back(Found::LeftOut(OTHER_EVENTS)),
        }
        Some(())
    }
}

/// A frame. All that the panda had for the device at a time have the time of their arrival there, so that it is an upper bound.
fn can_data(data: &Struct<'_>, time_ns: i64) -> Result<Found, Fault> {
    /// Longest identifier of 11 bits: only the value shows which it is.
    const STANDARD_MAX: u32 = 0x7FF;
    let bytes = data.pointer(0).and_then(message::Pointer::bytes);
    let bytes = bytes.ok_or_else(|| Fault::malformed("a frame's data", b"data beyond the event's end"))?;
    let Some((channel, direction)) = panda::bus(data.u8(6)) else { return Ok(Found::LeftOut(REJECTED)) };
    let raw = data.u32(0);
    let id = identifier(raw, raw > STANDARD_MAX, format!("{raw:X}").as_bytes())?;
    let payload = Payload::of(bytes)
        .ok_or_else(|| Fault::malformed("up to 64 data bytes", bytes.len().to_string().as_bytes()))?;
    let fields = FrameFields {
        id,
        remote: false,
        direction,
        len: bytes.len() as u8,
        fd: (bytes.len() > 8).then(FdFields::default),
    };
    let mut event = fields.event(&payload)?;
    if let TraceEvent::Frame { late, .. } = &mut event {
        *late = true;
    }
    Ok(Found::Record(TraceRecord { time_ns, device_ns: None, channel, event }))
}

/// Skips to what looks like an event behind the next byte, or to the end; false at the end.
fn resync(input: &mut Input) -> io::Result<bool> {
    input.consume(1);
    loop {
        let bytes = input.peek(LONGEST_TABLE_BYTES)?;
        if bytes.is_empty() {
            return Ok(false);
        }
        let is_end = bytes.len() < LONGEST_TABLE_BYTES;
        let next = message::find_event(bytes);
        // Of the last bytes, an event's head may still come.
        let kept = if is_end { 0 } else { LONGEST_TABLE_BYTES - 1 };
        let skipped = next.unwrap_or(bytes.len() - kept);
        input.consume(skipped);
        if next.is_some() {
            return Ok(true);
        }
    }
}
