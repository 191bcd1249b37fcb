//! Finding records in a trace by identifier, data and condition.

use std::fmt;
use std::str::FromStr;

use cantap_can::Id;

use crate::condition::Condition;
use cantap_trace::{TraceFrame, TraceRecord};

/// What to look for. Every given criterion must match.
#[derive(Clone, Debug, Default)]
pub struct Search {
    /// One of these identifiers; any if empty.
    pub ids: Vec<IdPattern>,
    /// One of these data patterns; any if empty.
    pub data: Vec<DataPattern>,
    /// This condition.
    pub condition: Option<Condition>,
}

impl Search {
    /// Whether the record matches. Pass every record of the trace, in order, so that conditions know their
    /// signals' last values.
    pub fn finds(&mut self, record: &TraceRecord) -> bool {
        let holds = self.condition.as_mut().is_none_or(|condition| condition.holds(record));
        let by_frame = self.ids.is_empty() && self.data.is_empty();
        match record.frame() {
            Some(frame) => holds && self.suits(frame),
            // Errors and losses have neither identifier nor data.
            None => holds && by_frame && self.condition.is_some(),
        }
    }

    fn suits(&self, frame: &TraceFrame) -> bool {
        (self.ids.is_empty() || self.ids.iter().any(|pattern| pattern.matches(frame.id())))
            && (self.data.is_empty() || self.data.iter().any(|pattern| pattern.matches(frame)))
    }
}

/// An identifier, `123` or `12345678` (29 bits), with `?` for any digit, or `LOW-HIGH`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IdPattern {
    extended: bool,
    kind: IdKind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum IdKind {
    Digits { value: u32, mask: u32 },
    Range { low: u32, high: u32 },
}

impl IdPattern {
    /// Whether an identifier matches.
    pub fn matches(self, id: Id) -> bool {
        id.is_extended() == self.extended
            && match self.kind {
                IdKind::Digits { value, mask } => id.raw() & mask == value,
                IdKind::Range { low, high } => (low..=high).contains(&id.raw()),
            }
    }
}

/// Why a text is not a pattern.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatternError {
    /// Not an identifier.
    #[error(
        "{0:?} is not an identifier; write up to 3 hexadecimal digits, or up to 8 (29 bits), with ? for any digit, or LOW-HIGH"
    )]
    Id(String),
    /// Not data.
    #[error(
        "{0:?} is not a pattern of bytes; write hexadecimal digits in pairs such as 1F, 3? or ??, and between them * for any number of bytes"
    )]
    Data(String),
}

/// Value and mask of hexadecimal digits, where `?` means any.
fn digits(text: &str) -> Option<(u32, u32)> {
    let mut both = (0u32, 0u32);
    for digit in text.chars() {
        let (value, mask) = match digit {
            '?' => (0, 0),
            _ => (digit.to_digit(16)?, 15),
        };
        both = (both.0 << 4 | value, both.1 << 4 | mask);
    }
    (!text.is_empty() && text.len() <= 8).then_some(both)
}

impl FromStr for IdPattern {
    type Err = PatternError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let wrong = || PatternError::Id(text.to_owned());
        let plain = text.strip_prefix("0x").unwrap_or(text);
        if let Some((low, high)) = plain.split_once('-') {
            let parse =
                |text: &str| text.strip_prefix("0x").unwrap_or(text).parse::<Id>().map_err(|_| wrong());
            let (low, high) = (parse(low)?, parse(high)?);
            if low.is_extended() != high.is_extended() || low.raw() > high.raw() {
                return Err(wrong());
            }
            let kind = IdKind::Range { low: low.raw(), high: high.raw() };
            return Ok(Self { extended: low.is_extended(), kind });
        }
        let (value, mask) = digits(plain).ok_or_else(wrong)?;
        let (extended, largest) = match plain.len() {
            1..=3 => (false, Id::MAX_STANDARD),
            // Too long for a standard identifier: leading zeros may be left out.
            4..=8 => (true, Id::MAX_EXTENDED),
            _ => return Err(wrong()),
        };
        if value > largest {
            return Err(wrong());
        }
        let mask = mask | u32::MAX.checked_shl(4 * plain.len() as u32).unwrap_or(0);
        Ok(Self { extended, kind: IdKind::Digits { value, mask } })
    }
}

/// Data bytes from the first on, such as `11 ?? 3?`; the bytes after them may be anything. A leading `*`
/// finds them anywhere; between bytes, it means any number of bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DataPattern {
    /// Each is found somewhere after the one before. Value and mask per byte.
    pieces: Vec<Vec<(u8, u8)>>,
    /// Whether the first piece starts at the first byte.
    anchored: bool,
}

impl DataPattern {
    /// Whether a frame's data match. Remote frames have none.
    pub fn matches(&self, frame: &TraceFrame) -> bool {
        let mut data = frame.data();
        for (at, piece) in self.pieces.iter().enumerate() {
            let suits =
                |window: &[u8]| window.iter().zip(piece).all(|(byte, (value, mask))| byte & mask == *value);
            let found = if at == 0 && self.anchored {
                (data.len() >= piece.len() && suits(data)).then_some(0)
            } else {
                data.windows(piece.len()).position(suits)
            };
            match found {
                Some(start) => data = &data[start + piece.len()..],
                None => return false,
            }
        }
        !frame.is_remote()
    }
}

impl FromStr for DataPattern {
    type Err = PatternError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let spaced = text.replace('*', " * ").replace([',', '.', ':'], " ");
        let mut pieces = vec![Vec::new()];
        let anchored = !spaced.trim_start().starts_with('*');
        for word in spaced.split_whitespace() {
            if word == "*" {
                pieces.push(Vec::new());
                continue;
            }
            let wrong = || PatternError::Data(word.to_owned());
            if word.len() % 2 != 0 || !word.is_ascii() {
                return Err(wrong());
            }
            for pair in word.as_bytes().chunks(2) {
                let pair = str::from_utf8(pair).map_err(|_| wrong())?;
                let (value, mask) = digits(pair).ok_or_else(wrong)?;
                pieces.last_mut().ok_or_else(wrong)?.push((value as u8, mask as u8));
            }
        }
        pieces.retain(|piece| !piece.is_empty());
        if pieces.is_empty() {
            return Err(PatternError::Data(text.to_owned()));
        }
        Ok(Self { pieces, anchored })
    }
}

impl fmt::Display for DataPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.anchored {
            f.write_str("* ")?;
        }
        for (at, piece) in self.pieces.iter().enumerate() {
            f.write_str(if at == 0 { "" } else { " * " })?;
            for (place, (value, mask)) in piece.iter().enumerate() {
                f.write_str(if place == 0 { "" } else { " " })?;
                for (value, mask) in [(value >> 4, mask >> 4), (value & 15, mask & 15)] {
                    match mask {
                        0 => f.write_str("?")?,
                        _ => write!(f, "{value:X}")?,
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_patterns_start_at_the_first_byte_unless_they_say_otherwise() {
        for (pattern, frame, expected) in [
            ("11 ?? 3?", "001#11223344", true),
            ("11??3?", "001#112230", true),
            ("11 ?? 3?", "001#112243", false),
            ("11 ?? 3?", "001#1122", false),
            ("11 ?? 3?", "001#00112233", false),
            ("* 11 ?? 3?", "001#00112233", true),
            ("11 * 33", "001#11223344", true),
            ("11 * 33 * 22", "001#11223344", false),
            ("11*44", "001#11223344", true),
            ("* 11 11", "001#1111", true),
            ("??", "001#R8", false),
            ("??", "001#", false),
        ] {
            let pattern: DataPattern = pattern.parse().unwrap();
            assert_eq!(pattern.matches(&frame.parse().unwrap()), expected, "{pattern} {frame}");
            assert_eq!(pattern.to_string().parse(), Ok(pattern));
        }
        for wrong in ["", "*", "1", "GG", "11 2", "é1"] {
            assert!(wrong.parse::<DataPattern>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn identifiers_have_wildcards_and_ranges() {
        for (pattern, frame, expected) in [
            ("123", "123#", true),
            ("0x123", "123#", true),
            ("123", "00000123#", false),
            ("12", "012#", true),
            ("9F80102", "09F80102#", true),
            ("12?", "12F#", true),
            ("12?", "13F#", false),
            ("18FEF1??", "18FEF121#", true),
            ("100-1FF", "180#", true),
            ("100-1FF", "200#", false),
            ("100-1FF", "00000180#", false),
        ] {
            let id = frame.parse::<TraceFrame>().unwrap().id();
            assert_eq!(pattern.parse::<IdPattern>().unwrap().matches(id), expected, "{pattern} {frame}");
        }
        for wrong in ["", "123456789", "800", "20000000", "200-100", "100-00000200", "12g", "-"] {
            assert!(wrong.parse::<IdPattern>().is_err(), "{wrong}");
        }
    }
}
