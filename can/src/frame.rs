//! A classical CAN frame and its text form (`123#DEADBEEF`, the syntax of can-utils' `cansend`).

use core::fmt;
use core::str::FromStr;

/// An identifier of 11 (standard) or 29 bits (extended).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Id(u32);

const EXTENDED: u32 = 1 << 31;

impl Id {
    /// Largest standard identifier (11 bits).
    pub const MAX_STANDARD: u32 = (1 << 11) - 1;
    /// Largest extended identifier (29 bits).
    pub const MAX_EXTENDED: u32 = (1 << 29) - 1;

    /// A standard identifier, or `None` above 0x7FF.
    pub const fn standard(raw: u32) -> Option<Self> {
        if raw <= Self::MAX_STANDARD { Some(Self(raw)) } else { None }
    }

    /// An extended identifier, or `None` above 0x1FFF_FFFF.
    pub const fn extended(raw: u32) -> Option<Self> {
        if raw <= Self::MAX_EXTENDED { Some(Self(raw | EXTENDED)) } else { None }
    }

    /// Keeps the low 11 bits. For values that cannot be larger, such as register fields.
    pub const fn standard_truncated(raw: u32) -> Self {
        Self(raw & Self::MAX_STANDARD)
    }

    /// Keeps the low 29 bits. For values that cannot be larger, such as register fields.
    pub const fn extended_truncated(raw: u32) -> Self {
        Self(raw & Self::MAX_EXTENDED | EXTENDED)
    }

    /// The identifier's number, without any flag.
    pub const fn raw(self) -> u32 {
        self.0 & !EXTENDED
    }

    /// Whether it has 29 bits.
    pub const fn is_extended(self) -> bool {
        self.0 & EXTENDED != 0
    }
}

impl fmt::Display for Id {
    /// Three hexadecimal digits for a standard identifier, eight for an extended one.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_extended() { write!(f, "{:08X}", self.raw()) } else { write!(f, "{:03X}", self.raw()) }
    }
}

impl fmt::Debug for Id {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Id({self})")
    }
}

/// A data or remote frame.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct Frame {
    id: Id,
    remote: bool,
    dlc: u8,
    data: [u8; 8],
}

impl Frame {
    /// A data frame with up to eight bytes; `None` if there are more.
    pub fn data_frame(id: Id, bytes: &[u8]) -> Option<Self> {
        let mut data = [0; 8];
        data.get_mut(..bytes.len())?.copy_from_slice(bytes);
        Some(Self { id, remote: false, dlc: bytes.len() as u8, data })
    }

    /// A remote frame that asks for `dlc` bytes; `None` if `dlc` is above 15.
    pub const fn remote_frame(id: Id, dlc: u8) -> Option<Self> {
        if dlc > 15 { None } else { Some(Self { id, remote: true, dlc, data: [0; 8] }) }
    }

    /// A frame as a controller reports it. `dlc` is the four-bit field of the bus (0 to 15, its
    /// low four bits are kept; above 8 it still means eight bytes). Bytes of `data` beyond the
    /// length are ignored, as is all of it in a remote frame.
    #[inline]
    pub fn from_bus(id: Id, remote: bool, dlc: u8, data: [u8; 8]) -> Self {
        let dlc = dlc & 15;
        let len = if remote { 0 } else { dlc.min(8) as usize };
        Self { id, remote, dlc, data: first(len, data) }
    }

    /// A frame whose parts are as [`Self::from_bus`] would make them: a DLC of four bits, and zeros beyond the data. With other
    /// parts, it would not compare equal to the frame that it represents.
    #[inline]
    pub const fn from_clean_parts(id: Id, remote: bool, dlc: u8, data: [u8; 8]) -> Self {
        Self { id, remote, dlc, data }
    }

    /// The identifier.
    pub const fn id(&self) -> Id {
        self.id
    }

    /// Whether it is a remote frame.
    pub const fn is_remote(&self) -> bool {
        self.remote
    }

    /// The data length code as on the bus: 0 to 15; above 8 means eight bytes.
    pub const fn dlc(&self) -> u8 {
        self.dlc
    }

    /// The data bytes: as many as the DLC says and at most eight; none in a remote frame.
    pub fn data(&self) -> &[u8] {
        &self.data[..self.data_len()]
    }

    /// All eight bytes, those beyond [`Self::data`] zero.
    pub const fn padded_data(&self) -> [u8; 8] {
        self.data
    }

    /// How many data bytes the frame carries: 0 to 8.
    pub const fn data_len(&self) -> usize {
        if self.remote {
            0
        } else if self.dlc > 8 {
            8
        } else {
            self.dlc as usize
        }
    }
}

/// The first `len` bytes (at most 8), followed by zeros.
#[inline]
pub fn first(len: usize, data: [u8; 8]) -> [u8; 8] {
    // Shifts rather than a copy, which is a function call if the length is not a constant.
    match len {
        0 => [0; 8],
        1..8 => (u64::from_le_bytes(data) & ((1 << (8 * len)) - 1)).to_le_bytes(),
        _ => data,
    }
}

impl fmt::Display for Frame {
    /// `123#DEADBEEF`, `1F334455#`, `123#R3`; a DLC above 8 follows as `_9`, as can-utils write it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#", self.id)?;
        if self.remote {
            f.write_str("R")?;
            if self.dlc > 0 {
                write!(f, "{:X}", self.dlc.min(8))?;
            }
        }
        for byte in self.data() {
            write!(f, "{byte:02X}")?;
        }
        if self.dlc > 8 { write!(f, "_{:X}", self.dlc) } else { Ok(()) }
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Frame({self})")
    }
}

/// Why a text is not a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ParseFrameError {
    /// There is no `#` between identifier and data.
    MissingHash,
    /// The identifier does not have three or eight hexadecimal digits, or is too large.
    BadId,
    /// The data is not whole bytes of hexadecimal digits.
    BadData,
    /// More than eight data bytes.
    TooLong,
    /// The length after `R`, or the DLC after `_`, is out of range.
    BadDlc,
}

impl fmt::Display for ParseFrameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::MissingHash => "no '#' between identifier and data; write a frame as 123#DEADBEEF",
            Self::BadId => "the identifier needs 3 hexadecimal digits (up to 7FF) or 8 (up to 1FFFFFFF)",
            Self::BadData => {
                "the data must be pairs of hexadecimal digits, with '.' between pairs if you like"
            }
            Self::TooLong => "a classical CAN frame carries at most 8 data bytes",
            Self::BadDlc => "the length after 'R' is 0 to 8, a raw DLC after '_' is 9 to F",
        })
    }
}

impl core::error::Error for ParseFrameError {}

impl FromStr for Id {
    type Err = ParseFrameError;

    /// Three hexadecimal digits are a standard identifier, eight an extended one.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(ParseFrameError::BadId);
        }
        let raw = u32::from_str_radix(text, 16).map_err(|_| ParseFrameError::BadId)?;
        let id = match text.len() {
            3 => Id::standard(raw),
            8 => Id::extended(raw),
            _ => None,
        };
        id.ok_or(ParseFrameError::BadId)
    }
}

impl FromStr for Frame {
    type Err = ParseFrameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (id, rest) = text.split_once('#').ok_or(ParseFrameError::MissingHash)?;
        let id: Id = id.parse()?;
        let (rest, raw_dlc) = match rest.split_once('_') {
            Some((rest, dlc)) => (rest, Some(parse_raw_dlc(dlc)?)),
            None => (rest, None),
        };
        if let Some(length) = rest.strip_prefix(['R', 'r']) {
            let dlc = match length {
                "" => 0,
                _ => match length.as_bytes() {
                    [digit @ b'0'..=b'8'] => digit - b'0',
                    _ => return Err(ParseFrameError::BadDlc),
                },
            };
            let dlc = match raw_dlc {
                Some(raw) if dlc == 8 => raw,
                Some(_) => return Err(ParseFrameError::BadDlc),
                None => dlc,
            };
            return Frame::remote_frame(id, dlc).ok_or(ParseFrameError::BadDlc);
        }
        let mut data = [0; 8];
        let mut len = 0;
        let mut digits = rest.as_bytes();
        while !digits.is_empty() {
            if len > 0 && digits[0] == b'.' {
                digits = &digits[1..];
            }
            let [high, low, after @ ..] = digits else {
                return Err(ParseFrameError::BadData);
            };
            let slot = data.get_mut(len).ok_or(ParseFrameError::TooLong)?;
            *slot = hex(*high)? << 4 | hex(*low)?;
            len += 1;
            digits = after;
        }
        match raw_dlc {
            Some(dlc) if len == 8 => Ok(Frame::from_bus(id, false, dlc, data)),
            Some(_) => Err(ParseFrameError::BadDlc),
            None => Frame::data_frame(id, &data[..len]).ok_or(ParseFrameError::TooLong),
        }
    }
}

fn parse_raw_dlc(text: &str) -> Result<u8, ParseFrameError> {
    match text.as_bytes() {
        [b'9'] => Ok(9),
        [digit @ (b'A'..=b'F' | b'a'..=b'f')] => hex(*digit),
        _ => Err(ParseFrameError::BadDlc),
    }
}

fn hex(digit: u8) -> Result<u8, ParseFrameError> {
    (digit as char).to_digit(16).map(|value| value as u8).ok_or(ParseFrameError::BadData)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_forms_round_trip() {
        for text in [
            "123#DEADBEEF",
            "7FF#",
            "1F334455#1122334455667788",
            "123#R",
            "123#R3",
            "123#1122334455667788_9",
            "00000001#R8_F",
        ] {
            assert_eq!(text.parse::<Frame>().unwrap().to_string(), text);
        }
        assert_eq!("5A1#11.22.33".parse::<Frame>().unwrap().to_string(), "5A1#112233");
        assert_eq!("5a1#aB".parse::<Frame>().unwrap().to_string(), "5A1#AB");
    }

    #[test]
    fn bad_text_names_its_fault() {
        for (text, fault) in [
            ("123", ParseFrameError::MissingHash),
            ("800#", ParseFrameError::BadId),
            ("20000000#", ParseFrameError::BadId),
            ("1234#", ParseFrameError::BadId),
            ("+12#", ParseFrameError::BadId),
            ("123#1", ParseFrameError::BadData),
            ("123#.11", ParseFrameError::BadData),
            ("123#11.", ParseFrameError::BadData),
            ("123#112233445566778899", ParseFrameError::TooLong),
            ("123#R9", ParseFrameError::BadDlc),
            ("123#11_9", ParseFrameError::BadDlc),
        ] {
            assert_eq!(text.parse::<Frame>(), Err(fault), "{text}");
        }
    }

    #[test]
    fn a_dlc_above_eight_still_means_eight_bytes() {
        let id = Id::standard(1).unwrap();
        let frame = Frame::from_bus(id, false, 15, [7; 8]);
        assert_eq!((frame.dlc(), frame.data()), (15, &[7; 8][..]));
        assert_eq!(Frame::from_bus(id, true, 15, [7; 8]).data(), &[] as &[u8]);
    }

    #[test]
    fn an_identifier_is_one_of_eleven_or_of_twenty_nine_bits() {
        assert_eq!(Id::standard(0x7FF).map(|id| (id.raw(), id.is_extended())), Some((0x7FF, false)));
        assert_eq!(
            Id::extended(0x1FFF_FFFF).map(|id| (id.raw(), id.is_extended())),
            Some((0x1FFF_FFFF, true))
        );
        assert_eq!((Id::standard(0x800), Id::extended(0x2000_0000)), (None, None));
        // The same number is another identifier.
        assert_ne!(Id::standard(1), Id::extended(1));
        // Registers may hold more than the identifier.
        assert_eq!(Id::standard_truncated(0xFFFF_FFFF), Id::standard(0x7FF).unwrap());
        assert_eq!(Id::extended_truncated(0xFFFF_FFFF), Id::extended(0x1FFF_FFFF).unwrap());
        assert_eq!(
            format!("{:?} {:?}", Id::standard(0x12).unwrap(), Id::extended(0x12).unwrap()),
            "Id(012) Id(00000012)"
        );
        assert_eq!((Id::MAX_STANDARD, Id::MAX_EXTENDED), (0x7FF, 0x1FFF_FFFF));
    }

    #[test]
    fn bytes_beyond_the_length_are_not_part_of_a_frame() {
        let id = Id::standard(1).unwrap();
        let all = [1, 2, 3, 4, 5, 6, 7, 8];
        for dlc in 0..=8_u8 {
            let frame = Frame::from_bus(id, false, dlc, all);
            assert_eq!(frame.data(), &all[..usize::from(dlc)]);
            assert_eq!(frame.padded_data()[usize::from(dlc)..], [0; 8][usize::from(dlc)..]);
            assert_eq!(Some(frame), Frame::data_frame(id, &all[..usize::from(dlc)]));
            assert_eq!(frame, Frame::from_clean_parts(id, false, dlc, frame.padded_data()));
        }
        // Of a register, four bits are the code.
        assert_eq!(Frame::from_bus(id, false, 0xF3, all), Frame::from_bus(id, false, 3, all));
        assert_eq!(Frame::data_frame(id, &[0; 9]), None);
        let remote = Frame::remote_frame(id, 15).unwrap();
        assert_eq!(
            (remote.is_remote(), remote.dlc(), remote.data_len(), remote.data()),
            (true, 15, 0, &[] as &[u8])
        );
        assert_eq!(Frame::remote_frame(id, 16), None);
        assert_eq!(format!("{remote:?}"), "Frame(001#R8_F)");
    }

    #[test]
    fn lengths_after_an_r_and_raw_ones_are_those_of_can_utils() {
        let parse = |text: &str| text.parse::<Frame>().map(|frame| frame.to_string());
        for text in ["123#R8", "123#R1", "123#R8_9", "123#1122334455667788_F", "123#1122334455667788_A"] {
            assert_eq!(parse(text), Ok(text.to_owned()));
        }
        assert_eq!(parse("123#r8_a"), Ok("123#R8_A".to_owned()));
        assert_eq!(parse("123#R0"), Ok("123#R".to_owned()));
        for text in
            ["123#R7_9", "123#R_9", "123#R8_8", "123#R12", "123#1122334455667788_8", "123#1122334455667788_G"]
        {
            assert_eq!(parse(text), Err(ParseFrameError::BadDlc), "{text}");
        }
        assert_eq!(parse("123#11..22"), Err(ParseFrameError::BadData));
        assert_eq!(parse("123#1G"), Err(ParseFrameError::BadData));
    }

    /// Each says what to write instead.
    #[test]
    fn every_fault_has_its_own_words() {
        use ParseFrameError::{BadData, BadDlc, BadId, MissingHash, TooLong};
        for (fault, words) in [
            (MissingHash, "123#DEADBEEF"),
            (BadId, "3 hexadecimal digits"),
            (BadData, "pairs of hexadecimal digits"),
            (TooLong, "at most 8 data bytes"),
            (BadDlc, "0 to 8"),
        ] {
            assert!(fault.to_string().contains(words), "{fault}");
        }
    }
}
