//! Turns the fields of a row into an event, for the formats with an identifier, a length and bytes side by side.

use cantap_can::{Frame, Id};

use super::issue::Fault;
use super::text;
use cantap_trace::counted;
use cantap_trace::fd::{FD_LENGTHS, FD_MAX_BYTES};
use cantap_trace::{Direction, FdFrame, TraceEvent};

/// A frame's fields in a row, other than its bytes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameFields {
    pub id: Id,
    pub remote: bool,
    pub direction: Direction,
    /// The length as in the row: the bus's length code for a classical frame, the number of bytes for a CAN FD one.
    pub len: u8,
    pub fd: Option<FdFields>,
}

/// The fields that only CAN FD frames have.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct FdFields {
    pub brs: bool,
    pub esi: bool,
}

/// The bytes of a row.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Payload {
    bytes: [u8; FD_MAX_BYTES],
    len: usize,
}

impl Payload {
    /// No bytes.
    pub(crate) const EMPTY: Self = Self { bytes: [0; FD_MAX_BYTES], len: 0 };

    /// At most 64 bytes.
    pub(crate) fn of(bytes: &[u8]) -> Option<Self> {
        let mut payload = Self::EMPTY;
        payload.bytes.get_mut(..bytes.len())?.copy_from_slice(bytes);
        payload.len = bytes.len();
        Some(payload)
    }

    /// The first `len` of these words, each a byte as `parse` reads it. Anything after them is ignored.
    pub(crate) fn words<'a>(
        mut words: impl Iterator<Item = &'a [u8]>,
        len: usize,
        parse: impl Fn(&[u8]) -> Option<u8>,
    ) -> Result<Self, Fault> {
        let mut payload = Self::EMPTY;
        let slots = payload.bytes.get_mut(..len);
        let slots =
            slots.ok_or_else(|| Fault::malformed("up to 64 data bytes", len.to_string().as_bytes()))?;
        for slot in slots {
            let word = words.next().unwrap_or_default();
            *slot = parse(word).ok_or_else(|| Fault::malformed(format!("{len} data bytes"), word))?;
        }
        payload.len = len;
        Ok(payload)
    }

    /// Like [`Self::words`], but no further byte may follow: otherwise the length would be wrong.
    pub(crate) fn exactly<'a>(
        mut words: impl Iterator<Item = &'a [u8]>,
        len: usize,
        parse: impl Fn(&[u8]) -> Option<u8>,
    ) -> Result<Self, Fault> {
        let payload = Self::words(&mut words, len, &parse)?;
        match words.next() {
            Some(word) if parse(word).is_some() => {
                Err(Fault::malformed(format!("{len} data bytes"), b"more"))
            }
            _ => Ok(payload),
        }
    }

    pub(crate) fn as_slice(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// The first eight bytes, padded with zeros: the form of a classical frame's data.
    pub(crate) fn first_eight(&self) -> [u8; 8] {
        self.bytes.first_chunk().copied().unwrap_or_default()
    }
}

/// A byte of exactly two hexadecimal digits.
pub(crate) fn hex_byte(word: &[u8]) -> Option<u8> {
    match word {
        [high, low] => text::hex_pair(*high, *low),
        _ => None,
    }
}

/// A byte in decimal digits.
pub(crate) fn decimal_byte(word: &[u8]) -> Option<u8> {
    text::decimal(word).and_then(|byte| u8::try_from(byte).ok())
}

/// Whether more bytes are written in a way only decimal numbers are (one or three digits) than in a way only hexadecimal ones are (a letter or a
/// leading zero).
pub(crate) fn bytes_are_decimal<'a>(bytes: impl Iterator<Item = &'a [u8]>) -> bool {
    let (mut decimal, mut hexadecimal) = (0, 0);
    for byte in bytes {
        match byte {
            [b'0', _] => hexadecimal += 1,
            [_, _] if decimal_byte(byte).is_none() && hex_byte(byte).is_some() => hexadecimal += 1,
            [_] | [_, _, _] if decimal_byte(byte).is_some() => decimal += 1,
            _ => {}
        }
    }
    decimal > hexadecimal
}

/// Checks that an identifier fits its format.
pub(crate) fn identifier(raw: u32, extended: bool, shown: &[u8]) -> Result<Id, Fault> {
    let (id, expected) = if extended {
        (Id::extended(raw), "an identifier up to 1FFFFFFF")
    } else {
        (Id::standard(raw), "an identifier up to 7FF, or a mark that it is extended")
    };
    id.ok_or_else(|| Fault::malformed(expected, shown))
}

/// A length code of the bus, as a number in decimal digits.
pub(crate) fn length_code(word: &[u8]) -> Result<u8, Fault> {
    let code = text::decimal(word).filter(|code| *code <= 15);
    code.map(|code| code as u8).ok_or_else(|| Fault::malformed("a data length code of 0 to 15", word))
}

impl FrameFields {
    /// The number of bytes that are required.
    pub(crate) fn data_len(&self) -> usize {
        match self.fd {
            _ if self.remote => 0,
            None => usize::from(self.len.min(8)),
            Some(_) => usize::from(self.len),
        }
    }

    /// The frame with these bytes, as many as [`Self::data_len`] says.
    pub(crate) fn event(&self, data: &Payload) -> Result<TraceEvent, Fault> {
        let frame = match self.fd {
            None => Frame::from_bus(self.id, self.remote, self.len, data.first_eight()).into(),
            Some(FdFields { brs, esi }) => {
                let bytes = data.as_slice();
                let frame = FdFrame::new(self.id, brs, esi, bytes);
                let found = || counted(bytes.len(), "byte");
                frame.ok_or_else(|| Fault::malformed("a length that CAN FD has", found().as_bytes()))?.into()
            }
        };
        Ok(TraceEvent::Frame { frame, direction: self.direction, late: false })
    }
}

/// The number of bytes for a length code, 0 to 15, in a CAN FD frame.
pub(crate) fn fd_len(code: u8) -> u8 {
    FD_LENGTHS[usize::from(code & 15)]
}

/// A direction as a word.
pub(crate) fn direction(word: &[u8]) -> Result<Direction, Fault> {
    if word.eq_ignore_ascii_case(b"rx") {
        Ok(Direction::Rx)
    } else if word.eq_ignore_ascii_case(b"tx") {
        Ok(Direction::Tx)
    } else {
        Err(Fault::malformed("'Rx' or 'Tx'", word))
    }
}
