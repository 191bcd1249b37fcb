//! Filters in the syntax of can-utils' `candump`: `can0,123:7FF,400~7F0,#FF,j`.
//!
//! An interface, then comma-separated items: `ID:MASK` accepts frames with `id & MASK == ID & MASK`, `ID~MASK`
//! all other frames, `#MASK` error frames of these SocketCAN classes, and `j` requires all items to match
//! instead of any. All numbers are hexadecimal; an ID of eight digits is a 29-bit one. As on Linux, a mask
//! without the flag bits (80000000 extended, 40000000 remote) ignores them.

use std::fmt;
use std::str::FromStr;

use crate::{CHANNEL_0, Interface, TraceEvent, TraceFrame, TraceRecord};

/// The flag for an extended identifier, as on Linux.
pub const EXTENDED: u32 = 1 << 31;
/// The flag for a remote frame, as on Linux.
pub const REMOTE: u32 = 1 << 30;
/// Bit 29 is reserved by the kernel: it marks inverse filters and error frames.
const RESERVED: u32 = 1 << 29;
const STANDARD_BITS: u32 = 0x7FF;
const EXTENDED_BITS: u32 = 0x1FFF_FFFF;

/// One `ID:MASK` or `ID~MASK`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct IdFilter {
    /// The identifier, with [`EXTENDED`] and [`REMOTE`].
    pub id: u32,
    /// The bits that are compared.
    pub mask: u32,
    /// Accepts whatever does not match.
    pub inverse: bool,
}

/// Which records to accept, by channel, ID and kind of error.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Filter {
    /// The channel from 1; any if `None`.
    pub channel: Option<u8>,
    /// Which identifiers; any if there are none.
    pub ids: Vec<IdFilter>,
    /// SocketCAN error classes to accept; `None` if the filter does not mention errors.
    pub errors: Option<u32>,
    /// A frame must match all of [`Self::ids`] instead of any.
    pub join: bool,
}

/// Why a text is not a filter.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ParseFilterError {
    /// The part before the first comma.
    #[error(
        "'{0}' is neither an ID, such as 123, 123:7FF or 09F80102, nor an interface, such as can0 for channel 1, can1 for channel 2, \
         or any"
    )]
    Interface(String),
    /// Neither an ID nor an ID with a mask.
    #[error(
        "'{0}' is not a filter; write ID, such as 123 or 09F80102, ID:MASK, such as 120:7F0, or ID~MASK for everything else"
    )]
    Element(String),
    /// A number.
    #[error("'{0}' is not a hexadecimal number of up to 8 digits")]
    Number(String),
}

impl IdFilter {
    /// The mask as the kernel applies it: a standard ID compared with its format has no bits above the
    /// eleventh.
    pub const fn effective_mask(&self) -> u32 {
        if self.mask & EXTENDED != 0 && self.id & EXTENDED == 0 {
            self.mask & (STANDARD_BITS | EXTENDED | REMOTE)
        } else {
            self.mask
        }
    }

    fn accepts(&self, id: u32) -> bool {
        ((id ^ self.id) & self.effective_mask() == 0) != self.inverse
    }
}

impl Filter {
    /// A filter that accepts everything on one channel.
    pub fn on_channel(channel: u8) -> Self {
        Self { channel: Some(channel), ..Self::default() }
    }

    /// Whether a frame passes, on whichever channel.
    pub fn accepts_frame(&self, frame: &TraceFrame) -> bool {
        if self.ids.is_empty() {
            return true;
        }
        let extended = if frame.id().is_extended() { EXTENDED } else { 0 };
        let remote = if frame.is_remote() { REMOTE } else { 0 };
        let id = frame.id().raw() | extended | remote;
        if self.join {
            self.ids.iter().all(|filter| filter.accepts(id))
        } else {
            self.ids.iter().any(|filter| filter.accepts(id))
        }
    }

    /// Whether a record passes. Errors pass if their class is in `#MASK`, or if the filter names only an
    /// interface. A loss always passes: it says that the trace is incomplete.
    pub fn accepts(&self, record: &TraceRecord) -> bool {
        if self.channel.is_some_and(|channel| channel != record.channel) {
            return false;
        }
        match &record.event {
            TraceEvent::Frame { frame, .. } => self.accepts_frame(frame),
            TraceEvent::Lost { .. } => true,
            event => match self.errors {
                Some(mask) => {
                    crate::socketcan::ErrorFrame::of(event).is_some_and(|error| error.classes & mask != 0)
                }
                None => self.ids.is_empty(),
            },
        }
    }
}

fn number(text: &str) -> Result<u32, ParseFilterError> {
    let digits = text.bytes().all(|byte| byte.is_ascii_hexdigit()) && text.len() <= 8;
    u32::from_str_radix(text, 16)
        .ok()
        .filter(|_| digits)
        .ok_or_else(|| ParseFilterError::Number(text.to_owned()))
}

/// `can0` is channel 1; any letters may precede the number, as in `vcan0`.
fn interface(text: &str) -> Result<Option<u8>, ParseFilterError> {
    if text.is_empty() || text == "any" {
        return Ok(None);
    }
    if text == CHANNEL_0 {
        return Ok(Some(0));
    }
    let letters = text.trim_end_matches(|c: char| c.is_ascii_digit());
    let channel = text[letters.len()..].parse::<u8>().ok().and_then(|number| number.checked_add(1));
    match channel {
        Some(channel) if letters.starts_with(|c: char| c.is_ascii_alphabetic()) => Ok(Some(channel)),
        _ => Err(ParseFilterError::Interface(text.to_owned())),
    }
}

/// An identifier without a mask matches exactly: up to three digits are a standard one, more are one of 29 bits. candump requires
/// the mask, but everybody forgets it.
fn lone_id(text: &str) -> Option<IdFilter> {
    let id = number(text).ok()?;
    let (id, bits) = match text.len() {
        ..=3 => (id, STANDARD_BITS),
        _ => (id | EXTENDED, EXTENDED_BITS),
    };
    (id & !EXTENDED <= bits).then_some(IdFilter { id, mask: bits | EXTENDED, inverse: false })
}

impl FromStr for Filter {
    type Err = ParseFilterError;

    /// The interface may be left out: `123:7FF` applies to every channel. So may the mask: `123` is that identifier
    /// alone.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut filter = Self::default();
        for (at, part) in text.split(',').enumerate() {
            if let Some(mask) = part.strip_prefix('#') {
                filter.errors = Some(filter.errors.unwrap_or(0) | number(mask)?);
            } else if let Some((id, mask)) = part.split_once([':', '~']) {
                let extended = if id.len() == 8 { EXTENDED } else { 0 };
                let inverse = part.as_bytes()[id.len()] == b'~';
                let id = number(id)? & !RESERVED | extended;
                filter.ids.push(IdFilter { id, mask: number(mask)? & !RESERVED, inverse });
            } else if let Some(id) = lone_id(part).filter(|_| at > 0 || interface(part).is_err()) {
                filter.ids.push(id);
            } else if at == 0 {
                filter.channel = interface(part)?;
            } else if part.eq_ignore_ascii_case("j") {
                filter.join = true;
            } else {
                return Err(ParseFilterError::Element(part.to_owned()));
            }
        }
        Ok(filter)
    }
}

impl fmt::Display for Filter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.channel {
            Some(channel) => write!(f, "{}", Interface(channel))?,
            None => f.write_str("any")?,
        }
        for IdFilter { id, mask, inverse } in &self.ids {
            let sign = if *inverse { '~' } else { ':' };
            if id & EXTENDED != 0 {
                write!(f, ",{:08X}{sign}{mask:X}", id & !EXTENDED)?;
            } else {
                write!(f, ",{id:03X}{sign}{mask:X}")?;
            }
        }
        if let Some(mask) = self.errors {
            write!(f, ",#{mask:X}")?;
        }
        f.write_str(if self.join { ",j" } else { "" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Direction;
    use cantap_can::{BusErrorKind, ErrorState};

    fn accepts(filter: &str, frame: &str) -> bool {
        filter.parse::<Filter>().unwrap().accepts_frame(&frame.parse().unwrap())
    }

    #[test]
    fn an_identifier_without_a_mask_is_exactly_that_one() {
        assert!(accepts("123", "123#") && accepts("123", "123#R") && accepts("can0,123", "123#"));
        assert!(!accepts("123", "124#") && !accepts("123", "00000123#"));
        assert!(accepts("9F80102", "09F80102#") && accepts("09F80102", "09F80102#11"));
        assert!(!accepts("9F80102", "09F80103#") && accepts("can0,100,200", "200#"));
        // Letters followed by a number are tried as an interface first.
        assert_eq!("ca0".parse::<Filter>().unwrap().channel, Some(1));
        for text in ["800", "3FFFFFFF", "123456789", "12g", ","] {
            assert!(text.parse::<Filter>().is_err() || text == ",", "{text}");
        }
    }

    /// The examples of candump's own help.
    #[test]
    fn filters_mean_what_candump_says() {
        assert!(accepts("vcan2,123:7FF", "123#"));
        assert!(accepts("vcan2,123:7FF", "00000123#"));
        assert!(accepts("vcan2,123:7FF", "123#R"));
        assert!(!accepts("vcan2,123:7FF", "124#"));
        assert!(accepts("vcan2,123:C00007FF", "123#"));
        assert!(!accepts("vcan2,123:C00007FF", "00000123#"));
        assert!(!accepts("vcan2,123:C00007FF", "123#R"));
        assert!(accepts("vcan2,12345678:DFFFFFFF", "12345678#"));
        assert!(!accepts("vcan2,12345678:DFFFFFFF", "12345679#"));
        assert!(!accepts("can0,400~7F0", "40F#"));
        assert!(accepts("can0,400~7F0", "410#"));
    }

    #[test]
    fn several_filters_accept_any_unless_joined() {
        assert!(accepts("can0,100:7FF,200:7FF", "200#"));
        assert!(accepts("can0,100~7FF,200~7FF", "200#"));
        assert!(!accepts("can0,100~7FF,200~7FF,j", "200#"));
        assert!(accepts("can0,100~7FF,200~7FF,J", "201#"));
        assert!(accepts("any", "7FF#"));
        assert!(accepts("123:7FF", "123#"));
    }

    #[test]
    fn errors_need_their_class_and_losses_always_pass() {
        let record = |event| TraceRecord { time_ns: 0, channel: 1, event };
        let error = record(TraceEvent::BusError { kind: Some(BusErrorKind::Stuff), counters: None });
        let state = record(TraceEvent::State { state: ErrorState::BusOff, counters: None });
        let lost = record(TraceEvent::Lost { stage: None, count: 1, at_least: true });
        let frame = "123#".parse().unwrap();
        let frame = record(TraceEvent::Frame { frame, direction: Direction::Rx, late: false });
        for (filter, expected) in [
            ("can0", [true, true, true, true]),
            ("can1", [false; 4]),
            ("can0,100:7FF", [false, false, true, false]),
            ("can0,#40", [false, true, true, true]),
            ("can0,100:7FF,#1FFFFFFF", [true, true, true, false]),
        ] {
            let filter: Filter = filter.parse().unwrap();
            let found = [&error, &state, &lost, &frame].map(|record| filter.accepts(record));
            assert_eq!(found, expected, "{filter}");
        }
    }

    #[test]
    fn text_round_trips() {
        for text in
            ["any", "can0", "channel0,123:7FF", "can1,123:7FF,00000123~DFFFFFFF,#FF,j", "any,7FF:C00007FF"]
        {
            assert_eq!(text.parse::<Filter>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn what_is_no_filter_is_refused_with_a_hint() {
        for (text, message) in [
            (
                "can0,x",
                "'x' is not a filter; write ID, such as 123 or 09F80102, ID:MASK, such as 120:7F0, or ID~MASK for everything else",
            ),
            (
                "x",
                "'x' is neither an ID, such as 123, 123:7FF or 09F80102, nor an interface, such as can0 for channel 1, can1 for channel 2, \
                 or any",
            ),
            ("can0,12G:7FF", "'12G' is not a hexadecimal number of up to 8 digits"),
            ("can0,#", "'' is not a hexadecimal number of up to 8 digits"),
            ("can0,+1:7FF", "'+1' is not a hexadecimal number of up to 8 digits"),
        ] {
            assert_eq!(text.parse::<Filter>().unwrap_err().to_string(), message);
        }
    }
}
