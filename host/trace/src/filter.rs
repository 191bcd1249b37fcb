//! Filters in the syntax of can-utils' `candump`: `can0,123:7FF,400~7F0,#FF,j`.
//!
//! An interface, then comma-separated items: `ID:MASK` accepts frames with `id & MASK == ID & MASK`, `ID~MASK`
//! all other frames, `#MASK` error frames of these SocketCAN classes, and `j` requires all items to match
//! instead of any. All numbers are hexadecimal; an ID of eight digits is a 29-bit one. As on Linux, a mask
//! without the flag bits (80000000 extended, 40000000 remote) ignores them. Identifiers without a mask are those of
//! [`crate::grammar`], with ranges and parameter groups.

use std::fmt;
use std::str::FromStr;

use crate::grammar::{self, IdError, IdPattern};
pub use crate::id_filter::{EXTENDED, IdFilter, REMOTE};
use crate::{CHANNEL_0, Interface, TraceEvent, TraceFrame, TraceRecord};

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
    /// Nothing, or commas alone.
    #[error("a filter is empty; write any for all frames, an ID, such as 123, or an interface, such as can0")]
    Empty,
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
    /// An identifier that there cannot be.
    #[error(transparent)]
    Id(IdError),
    /// A range consists of several filters, which cannot all match.
    #[error(
        "'{0}' is several filters, and with j all of them must match; write it without j, or with a mask"
    )]
    JoinedRange(String),
}

/// Whether one of several filters accepts a record. Without filters, every record passes.
pub fn passes(filters: &[Filter], record: &TraceRecord) -> bool {
    filters.is_empty() || filters.iter().any(|filter| filter.accepts(record))
}

impl Filter {
    /// A filter that accepts everything on one channel.
    pub fn on_channel(channel: u8) -> Self {
        Self { channel: Some(channel), ..Self::default() }
    }

    /// Whether every frame of a channel passes.
    pub fn accepts_all_of(&self, channel: u8) -> bool {
        self.channel.is_none_or(|own| own == channel) && self.ids.is_empty()
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
    /// interface. A loss always passes: it says that the trace is incomplete. LIN frames pass filters that name nothing of CAN.
    pub fn accepts(&self, record: &TraceRecord) -> bool {
        if record.lin().is_some() {
            return self.channel.is_none() && self.ids.is_empty() && self.errors.is_none();
        }
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
    grammar::hex(text).ok_or_else(|| ParseFilterError::Number(text.to_owned()))
}

/// What an interface's name means.
enum Channels {
    Any,
    One(u8),
}

/// `can0` is channel 1, and so is `vcan0`; so may any name be that no identifier can look like.
fn interface(text: &str) -> Option<Channels> {
    if text.is_empty() || text == "any" {
        return Some(Channels::Any);
    }
    if text == CHANNEL_0 {
        return Some(Channels::One(0));
    }
    if let Some(channel) = grammar::interface(text) {
        return Some(Channels::One(channel));
    }
    let letters = text.trim_end_matches(|c: char| c.is_ascii_digit());
    let is_name = letters.starts_with(|c: char| c.is_ascii_alphabetic())
        && letters.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
        && !text.bytes().all(|byte| byte.is_ascii_hexdigit())
        && !text.starts_with("0x");
    let channel = text[letters.len()..].parse::<u8>().ok()?.checked_add(1)?;
    is_name.then_some(Channels::One(channel))
}

impl FromStr for Filter {
    type Err = ParseFilterError;

    /// The interface may be left out: `123:7FF` applies to every channel. So may the mask: `123` is that identifier
    /// alone. Identifiers are those of [`grammar::IdPattern`].
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        // What a script makes of a variable that is not set must not mean everything; `any` does.
        if text.split(',').all(|part| part.trim().is_empty()) {
            return Err(ParseFilterError::Empty);
        }
        let mut filter = Self::default();
        let mut has_several = None;
        for (at, part) in text.split(',').enumerate() {
            if let Some(mask) = part.strip_prefix('#') {
                filter.errors = Some(filter.errors.unwrap_or(0) | number(mask)?);
            } else if let Some((id, mask)) = part.split_once('~') {
                // It is clear which of the two is no number.
                number(id)?;
                number(mask)?;
                filter.ids.extend(grammar::masked(id, mask, true));
            } else if let Some(channels) = interface(part).filter(|_| at == 0) {
                filter.channel = match channels {
                    Channels::Any => None,
                    Channels::One(channel) => Some(channel),
                };
            } else if part.eq_ignore_ascii_case("j") {
                filter.join = true;
            } else {
                if let Some((id, mask)) =
                    part.split_once(':').filter(|(id, _)| !id.eq_ignore_ascii_case("pgn"))
                {
                    number(id)?;
                    number(mask)?;
                }
                let pattern = part.parse::<IdPattern>().map_err(|error| match error {
                    IdError::Unknown(part) if at == 0 => ParseFilterError::Interface(part),
                    IdError::Unknown(part) => ParseFilterError::Element(part),
                    error => ParseFilterError::Id(error),
                })?;
                if pattern.filters().len() > 1 {
                    has_several = Some(part);
                }
                filter.ids.extend(pattern.filters());
            }
        }
        match has_several.filter(|_| filter.join) {
            Some(range) => Err(ParseFilterError::JoinedRange(range.to_owned())),
            None => Ok(filter),
        }
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
        // Letters followed by a number are an identifier wherever they can be one.
        assert!(
            accepts("C0", "0C0#")
                && accepts("F0", "0F0#")
                && accepts("CAFE0", "000CAFE0#")
                && accepts("FEF1", "0000FEF1#")
        );
        for text in ["C0", "F0", "CAFE0", "FEF1", "123", "0x7E8"] {
            assert_eq!(text.parse::<Filter>().unwrap().channel, None, "{text}");
        }
        for text in ["can0", "vcan0", "slcan0", "eth0", "can0,123"] {
            assert_eq!(text.parse::<Filter>().unwrap().channel, Some(1), "{text}");
        }
        let doubtful = "ca0".parse::<Filter>().unwrap_err().to_string();
        assert!(doubtful.contains("00000CA0") && doubtful.contains("can0"), "{doubtful}");
        assert!(accepts("0x123", "123#") && accepts("100-1FF", "17A#") && !accepts("100-1FF", "200#"));
        assert!(accepts("pgn:61444", "0CF00400#") && accepts("can0,18FEF1??", "18FEF1AA#"));
        assert!(accepts("0x120:0x7F0", "12A#") && !accepts("can0,100-1FF,200", "201#"));
        // A block is one filter; other ranges are several, which cannot all match.
        assert!(accepts("100-1FF,j", "17A#") && "100-1FE,j".parse::<Filter>().is_err());
        for text in ["800", "3FFFFFFF", "123456789", "12g"] {
            assert!(text.parse::<Filter>().is_err(), "{text}");
        }
        for text in ["", " ", ",", ",,", " , "] {
            assert_eq!(text.parse::<Filter>(), Err(ParseFilterError::Empty), "'{text}'");
        }
        assert!(accepts("any", "123#") && accepts(",123", "123#"));
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
        let record = |event| TraceRecord { time_ns: 0, device_ns: None, channel: 1, event };
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

    #[test]
    fn a_channel_s_filter_passes_all_of_that_channel_and_nothing_of_another() {
        let record = |channel, frame: &str| {
            let event = TraceEvent::Frame {
                frame: frame.parse().unwrap(),
                direction: crate::Direction::Rx,
                late: false,
            };
            TraceRecord { time_ns: 0, device_ns: None, channel, event }
        };
        let second = Filter::on_channel(2);
        assert_eq!(second, "can1".parse().unwrap());
        assert!(second.accepts_all_of(2) && !second.accepts_all_of(1));
        assert!("any".parse::<Filter>().unwrap().accepts_all_of(1));
        let one: Filter = "123".parse().unwrap();
        assert!(!one.accepts_all_of(1) && !"can0,123".parse::<Filter>().unwrap().accepts_all_of(1));
        // Of several, one is enough; none means everything.
        assert!(
            passes(&[], &record(1, "123#")) && passes(&[second.clone(), one.clone()], &record(1, "123#"))
        );
        assert!(
            passes(&[second.clone(), one.clone()], &record(2, "124#"))
                && !passes(&[second, one], &record(1, "124#"))
        );
    }

    /// As the kernel applies them: with the format compared, a mask has no bits above the eleventh.
    #[test]
    fn a_standard_identifier_compared_with_its_format_has_eleven_bits() {
        let passes = |filter: &str, frame: &str| {
            filter.parse::<Filter>().unwrap().accepts_frame(&frame.parse().unwrap())
        };
        // Twenty-nine bits of the mask, and the format.
        assert!(
            passes("123:9FFFFFFF", "123#")
                && !passes("123:9FFFFFFF", "00000123#")
                && !passes("123:9FFFFFFF", "124#")
        );
        // Without the format, an extended one that has these bits passes, too.
        assert!(
            passes("123:7FF", "123#")
                && passes("123:7FF", "1FFFF923#")
                && !passes("123:1FFFFFFF", "1FFFF923#")
        );
        assert!(passes("00000123:9FFFFFFF", "00000123#") && !passes("00000123:9FFFFFFF", "123#"));
        // And whether it is a remote frame, if that bit is in the mask.
        assert!(
            passes("123:7FF", "123#R") && !passes("123:400007FF", "123#R") && passes("123:400007FF", "123#")
        );
        assert!(!passes("123:C00007FF", "123#R"));
    }

    #[test]
    fn what_looks_like_an_identifier_is_no_interface() {
        let of = |text: &str| text.parse::<Filter>().map(|filter| (filter.channel, filter.ids.len())).ok();
        assert_eq!(
            (of("vcan3"), of("my_bus1"), of("slcan0")),
            (Some((Some(4), 0)), Some((Some(2), 0)), Some((Some(1), 0)))
        );
        assert_eq!((of("BEEF1"), of("0x1"), of("C0")), (Some((None, 1)), Some((None, 1)), Some((None, 1))));
        assert_eq!((of("my-bus1"), of("_bus1"), of("0xbus1"), of("can300")), (None, None, None, None));
    }
}
