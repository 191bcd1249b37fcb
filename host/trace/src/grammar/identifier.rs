//! Identifiers: one of them, or several in one word.

use std::fmt;
use std::str::FromStr;

use crate::fd::FD_LENGTHS;
use crate::id_filter::{EXTENDED, IdFilter, REMOTE};
use crate::{Frame, Id, ParseTraceFrameError, TraceFrame};

/// Bit 29 is reserved by the kernel: it marks inverse filters and error frames.
const RESERVED: u32 = 1 << 29;
/// The largest parameter group number: 18 bits.
const MAX_PGN: u32 = 0x3_FFFF;

/// Identifiers: `123` (11 bits), `09F80102` (29 bits), with `?` for any digit, `100-1FF`, `120:7F0` with a mask, or `pgn:61444`.
///
/// Up to three hexadecimal digits are a standard identifier, four to eight an extended one; `0x` may stand before them.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct IdPattern {
    /// As typed.
    text: String,
    /// One of these must match.
    filters: Vec<IdFilter>,
}

/// Why a text is not an identifier.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum IdError {
    /// Nothing of what is known.
    #[error(
        "'{0}' is not an identifier; write up to 3 hexadecimal digits (123), or up to 8 for 29 bits (09F80102), with ? for any digit, \
         LOW-HIGH, ID:MASK, or pgn:NUMBER"
    )]
    Unknown(String),
    /// Hexadecimal, but more than the bits that go with its number of digits.
    #[error("'{text}' has more than {bits} bits; write {instead}")]
    TooLarge {
        /// What was written.
        text: String,
        /// The bits that there are.
        bits: u8,
        /// What may have been meant.
        instead: String,
    },
    /// A range from high to low, or between a standard and an extended identifier.
    #[error("'{0}' is no range; write LOW-HIGH, both with up to 3 digits, or both with more")]
    Range(String),
    /// Not a parameter group.
    #[error("'{0}' is no parameter group; write pgn:61444 or pgn:0xF004, up to 262143")]
    Pgn(String),
}

impl IdPattern {
    /// Whether an identifier matches.
    pub fn matches(&self, id: Id) -> bool {
        let flag = if id.is_extended() { EXTENDED } else { 0 };
        self.filters
            .iter()
            .any(|filter| (filter.id ^ (id.raw() | flag)) & filter.effective_mask() & !REMOTE == 0)
    }

    /// The same as filters, any of which may match.
    pub fn filters(&self) -> &[IdFilter] {
        &self.filters
    }
}

impl fmt::Display for IdPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl FromStr for IdPattern {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let filters = if let Some(number) = text.strip_prefix("pgn:").or_else(|| text.strip_prefix("PGN:")) {
            vec![group(number).ok_or_else(|| IdError::Pgn(text.to_owned()))?]
        } else if let Some((id, mask)) = text.split_once(':') {
            vec![masked(id, mask, false).ok_or_else(|| IdError::Unknown(text.to_owned()))?]
        } else if let Some((low, high)) = text.split_once('-') {
            range(text, low, high)?
        } else {
            vec![digits(text)?]
        };
        Ok(Self { text: text.to_owned(), filters })
    }
}

/// Where several identifiers may stand, in filters an interface may, too.
const OR_INTERFACE: &str = ", or an interface as can0";

impl IdError {
    /// The same where only one identifier may stand.
    fn of_one(self) -> String {
        match self {
            Self::Unknown(text) => format!(
                "'{text}' is not an identifier; write up to 3 hexadecimal digits (123), or up to 8 for 29 bits (09F80102)"
            ),
            Self::TooLarge { text, bits, instead } => {
                let instead = instead.strip_suffix(OR_INTERFACE).map(str::to_owned).unwrap_or(instead);
                Self::TooLarge { text, bits, instead }.to_string()
            }
            other => other.to_string(),
        }
    }
}

/// Without `0x`.
fn plain(text: &str) -> &str {
    text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text)
}

/// A hexadecimal number of up to eight digits.
pub(crate) fn hex(text: &str) -> Option<u32> {
    let text = plain(text);
    let is_hex = (1..=8).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    u32::from_str_radix(text, 16).ok().filter(|_| is_hex)
}

/// `ID:MASK` and `ID~MASK` as can-utils' candump has them: only eight digits make the identifier an extended one, and only bits in the mask
/// compare.
pub(crate) fn masked(id: &str, mask: &str, inverse: bool) -> Option<IdFilter> {
    let extended = if plain(id).len() == 8 { EXTENDED } else { 0 };
    Some(IdFilter { id: hex(id)? & !RESERVED | extended, mask: hex(mask)? & !RESERVED, inverse })
}

/// The bits of an identifier with this many digits, and its flag.
fn width(digits: usize) -> (u32, u32) {
    if digits <= 3 { (Id::MAX_STANDARD, 0) } else { (Id::MAX_EXTENDED, EXTENDED) }
}

/// Digits, some of which may be `?`.
fn digits(text: &str) -> Result<IdFilter, IdError> {
    let unknown = || IdError::Unknown(text.to_owned());
    let word = plain(text);
    if !(1..=8).contains(&word.len()) {
        return Err(unknown());
    }
    let (bits, flag) = width(word.len());
    let (mut value, mut any) = (0_u32, 0_u32);
    for character in word.chars() {
        let (digit, free) = match character {
            '?' => (0, 0xF),
            _ => (character.to_digit(16).ok_or_else(unknown)?, 0),
        };
        (value, any) = (value << 4 | digit, any << 4 | free);
    }
    if value > bits {
        return Err(IdError::TooLarge {
            text: text.to_owned(),
            bits: if flag == 0 { 11 } else { 29 },
            instead: if flag == 0 {
                format!("{value:08X} for the one of 29 bits{OR_INTERFACE}")
            } else {
                "an identifier up to 1FFFFFFF".to_owned()
            },
        });
    }
    Ok(IdFilter { id: value | flag, mask: bits & !any | EXTENDED, inverse: false })
}

/// All from one identifier to another, as few filters as possible.
fn range(text: &str, low: &str, high: &str) -> Result<Vec<IdFilter>, IdError> {
    let no_range = || IdError::Range(text.to_owned());
    let exact = |text: &str| digits(text).ok().filter(|_| !text.contains('?')).ok_or_else(no_range);
    let (low, high) = (exact(low)?, exact(high)?);
    if (low.id ^ high.id) & EXTENDED != 0 || low.id > high.id {
        return Err(no_range());
    }
    let flag = low.id & EXTENDED;
    let bits = low.mask & !EXTENDED;
    let (mut next, last) = (u64::from(low.id & !EXTENDED), u64::from(high.id & !EXTENDED));
    let mut filters = Vec::new();
    while next <= last {
        // The largest block that begins here and does not reach beyond the end.
        let aligned = if next == 0 { 1 << 29 } else { next & next.wrapping_neg() };
        let fits = 1_u64 << (last - next + 1).ilog2();
        let size = aligned.min(fits);
        let mask = bits & !(size as u32 - 1) | EXTENDED;
        filters.push(IdFilter { id: next as u32 | flag, mask, inverse: false });
        next += size;
    }
    Ok(filters)
}

/// The identifiers of a parameter group (SAE J1939-21): of all priorities and senders, and of one that has a destination, all of those.
fn group(number: &str) -> Option<IdFilter> {
    let pgn = parameter_group(number)?;
    // Formats below 240 have a destination in their lower byte.
    let has_destination = pgn >> 8 & 0xFF < 240;
    let mask = if has_destination { 0x3_FF00 } else { 0x3_FFFF };
    Some(IdFilter { id: (pgn & mask) << 8 | EXTENDED, mask: mask << 8 | EXTENDED, inverse: false })
}

/// The number of a parameter group: `61444`, `0xF004`, also with `pgn:` before it.
pub fn parameter_group(text: &str) -> Option<u32> {
    let number = text.strip_prefix("pgn:").or_else(|| text.strip_prefix("PGN:")).unwrap_or(text);
    let pgn = match number.strip_prefix("0x").or_else(|| number.strip_prefix("0X")) {
        Some(_) => hex(number)?,
        None => number.parse().ok().filter(|_| number.bytes().all(|byte| byte.is_ascii_digit()))?,
    };
    (pgn <= MAX_PGN).then_some(pgn)
}

/// The parameter group of an identifier, without a destination; `None` if it has 11 bits.
pub const fn group_of(id: Id) -> Option<u32> {
    if !id.is_extended() {
        return None;
    }
    let pgn = id.raw() >> 8 & MAX_PGN;
    Some(if pgn >> 8 & 0xFF < 240 { pgn & 0x3_FF00 } else { pgn })
}

/// One identifier: `123`, `0x123`, `09F80102`.
pub fn identifier(text: &str) -> Result<Id, String> {
    let IdFilter { id, .. } = digits(text).map_err(IdError::of_one)?;
    if text.contains('?') {
        return Err(format!("'{text}' is several identifiers; give one"));
    }
    let raw = id & !EXTENDED;
    let id = if id & EXTENDED == 0 { Id::standard(raw) } else { Id::extended(raw) };
    id.ok_or_else(|| IdError::Unknown(text.to_owned()).of_one())
}

/// A frame to be sent, as can-utils' cansend has it, with its identifier in this grammar: `123#DEADBEEF`, `1#00`, `0x18FEF100#11.22`, `123#R3`.
pub fn frame(text: &str) -> Result<Frame, String> {
    let Some((id, rest)) = text.split_once('#') else {
        return text.parse::<Frame>().map_err(|error| error.to_string());
    };
    let id = identifier(id)?;
    format!("{id}#{rest}").parse::<Frame>().map_err(|error| error.to_string())
}

/// The same, or a CAN FD frame: `123##1DEADBEEF`, where the digit has the flags (1: the bit rate is switched, 2: the sender is error passive).
/// With `pad`, one of a length that CAN FD does not have is filled with zeros up to the next one, as cansend does unasked.
pub fn any_frame(text: &str, pad: bool) -> Result<TraceFrame, String> {
    let Some((id, rest)) = text.split_once("##") else { return frame(text).map(TraceFrame::Classic) };
    let id = identifier(id)?;
    let whole = format!("{id}##{rest}");
    match whole.parse::<TraceFrame>() {
        Err(ParseTraceFrameError::BadLength) if pad => {}
        parsed => return parsed.map_err(|error| error.to_string()),
    }
    // Its digits are in order: only their number is not.
    let digits = rest.get(1..).unwrap_or_default().replace('.', "");
    let bytes = digits.len() / 2;
    let len = FD_LENGTHS.iter().map(|len| usize::from(*len)).find(|len| *len >= bytes);
    let padding = "00".repeat(len.map_or(0, |len| len - bytes));
    format!("{id}##{}{digits}{padding}", &rest[..1]).parse::<TraceFrame>().map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn matches(pattern: &str, id: &str) -> bool {
        pattern.parse::<IdPattern>().unwrap().matches(id.parse().unwrap())
    }

    #[test]
    fn identifiers_are_hexadecimal_with_or_without_0x() {
        for pattern in ["123", "0x123", "12?", "1?3", "100-1FF", "0x100-0x1FF", "120:7F0"] {
            assert!(matches(pattern, "123"), "{pattern}");
            assert!(!matches(pattern, "223"), "{pattern}");
        }
        // Letters and a digit are no interface.
        for (pattern, id) in [
            ("C0", "0C0"),
            ("F0", "0F0"),
            ("CAFE0", "000CAFE0"),
            ("FEF1", "0000FEF1"),
            ("1", "001"),
            ("18FEF1??", "18FEF12A"),
        ] {
            assert!(matches(pattern, id), "{pattern}");
        }
        assert!(!matches("123", "00000123") && !matches("0123", "123"));
    }

    #[test]
    fn a_range_is_exact() {
        for (low, high) in [(0, 0x7FF), (0, 0), (1, 0x7FE), (0x123, 0x456), (0x7FF, 0x7FF), (5, 6)] {
            let pattern: IdPattern = format!("{low:03X}-{high:03X}").parse().unwrap();
            for id in 0..=0x7FF {
                let found = pattern.matches(Id::standard(id).unwrap());
                assert_eq!(found, (low..=high).contains(&id), "{low:X}-{high:X}: {id:X}");
            }
            assert!(!pattern.matches(Id::extended(low).unwrap()));
        }
        assert!(matches("0000-1FFFFFFF", "1FFFFFFF") && matches("00000000-00000000", "00000000"));
        assert!(matches("18FEF100-18FEF1FF", "18FEF1FF") && !matches("18FEF100-18FEF1FF", "18FEF200"));
    }

    #[test]
    fn a_parameter_group_has_any_priority_sender_and_destination() {
        assert!(matches("pgn:61444", "0CF00400") && matches("pgn:0xF004", "18F00427"));
        assert!(!matches("pgn:61444", "0CF00500") && !matches("pgn:61444", "0DF00400"));
        assert_eq!(group_of("18EAFF00".parse().unwrap()), Some(59904));
        assert_eq!(
            (group_of("0CF00400".parse().unwrap()), group_of("123".parse().unwrap())),
            (Some(61444), None)
        );
        // A request may go to anyone.
        assert!(matches("pgn:59904", "18EAFF00") && matches("pgn:0xEA00", "18EA2711"));
    }

    #[test]
    fn what_is_no_identifier_is_told_what_would_be() {
        for (text, part) in [
            ("12g", "'12g' is not an identifier; write up to 3 hexadecimal digits"),
            ("", "'' is not an identifier"),
            ("123456789", "is not an identifier"),
            (
                "800",
                "'800' has more than 11 bits; write 00000800 for the one of 29 bits, or an interface as can0",
            ),
            ("CA0", "write 00000CA0 for the one of 29 bits, or an interface as can0"),
            ("3FFFFFFF", "an identifier up to 1FFFFFFF"),
            ("200-100", "'200-100' is no range"),
            ("100-00000200", "no range"),
            ("1?0-200", "no range"),
            ("pgn:x", "'pgn:x' is no parameter group"),
            ("pgn:300000", "no parameter group"),
            ("+12", "not an identifier"),
            ("123:x", "not an identifier"),
        ] {
            let error = text.parse::<IdPattern>().unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }

    #[test]
    fn a_frame_s_identifier_is_written_like_the_others() {
        for (text, same) in
            [("1#00", "001#00"), ("0x123#R", "123#R"), ("18fef1#11.22", "0018FEF1#1122"), ("123#", "123#")]
        {
            assert_eq!(
                frame(text).unwrap().to_string(),
                same.parse::<Frame>().unwrap().to_string(),
                "{text}"
            );
        }
        for text in ["12?#00", "800#", "x#", "123", "123#1"] {
            assert!(frame(text).is_err(), "{text}");
        }
        // What is advised can be written there.
        for (text, says) in [
            (
                "7EG#11",
                "'7EG' is not an identifier; write up to 3 hexadecimal digits (123), or up to 8 for 29 bits (09F80102)",
            ),
            (
                "pgn:129025#11",
                "'pgn:129025' is not an identifier; write up to 3 hexadecimal digits (123), or up to 8 for 29 bits (09F80102)",
            ),
            ("800#11", "'800' has more than 11 bits; write 00000800 for the one of 29 bits"),
        ] {
            assert_eq!(frame(text), Err(says.to_owned()), "{text}");
        }
    }

    #[test]
    fn a_frame_is_filled_to_a_length_of_can_fd_only_if_asked() {
        let frame = |text: &str, pad| any_frame(text, pad).map(|frame| frame.to_string());
        let nine = "123##111.22.33.44.55.66.77.88.99";
        assert!(frame(nine, false).unwrap_err().contains("0 to 8, 12, 16"));
        assert_eq!(frame(nine, true), Ok("123##1112233445566778899000000".to_owned()));
        assert_eq!(frame("123##31122", true), Ok("123##31122".to_owned()));
        // Twelve are a length, thirteen become sixteen; more than 64 are none.
        let bytes = |count| format!("123##0{}", "AB".repeat(count));
        assert_eq!(frame(&bytes(12), true), Ok(bytes(12)));
        assert_eq!(frame(&bytes(13), true), Ok(bytes(13) + "000000"));
        assert_eq!((frame(&bytes(63), true), frame(&bytes(64), true)), (Ok(bytes(63) + "00"), Ok(bytes(64))));
        assert!(frame(&bytes(65), true).unwrap_err().contains("64"));
        assert!(frame("123##0112", true).is_err());
        assert_eq!(frame("1#00", true), Ok("001#00".to_owned()));
    }

    #[test]
    fn a_pattern_is_shown_as_it_was_written() {
        for text in ["123", "0x12?", "100-1FF", "120:7F0"] {
            assert_eq!(text.parse::<IdPattern>().unwrap().to_string(), text);
        }
    }
}
