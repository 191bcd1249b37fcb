//! The fields of a message, one after another.

use crate::text::NS_PER_S;

/// How a message is serialized.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Ros1,
    Cdr,
}

/// Seconds and nanoseconds since 1970.
pub(crate) fn time_ns(seconds: i64, ns: u32) -> i64 {
    seconds * NS_PER_S + i64::from(ns)
}

/// Reads fields; each is `None` beyond the message's end.
pub(super) struct Fields<'a> {
    encoding: Encoding,
    big_endian: bool,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Fields<'a> {
    /// At a message's first field.
    pub(super) fn new(encoding: Encoding, bytes: &'a [u8]) -> Option<Self> {
        /// Of CDR's header: the identifiers of its two versions, without the bit of the byte order.
        const PLAIN: [u8; 2] = [0, 6];
        match encoding {
            Encoding::Ros1 => Some(Self { encoding, big_endian: false, bytes, at: 0 }),
            Encoding::Cdr => {
                let ([0, representation, _, _], body) = bytes.split_first_chunk()? else { return None };
                PLAIN.contains(&(representation & !1)).then_some(())?;
                Some(Self { encoding, big_endian: representation & 1 == 0, bytes: body, at: 0 })
            }
        }
    }

    /// Only CDR aligns, counted from the end of its header.
    pub(super) fn u32(&mut self) -> Option<u32> {
        if self.encoding == Encoding::Cdr {
            self.at = self.at.next_multiple_of(4);
        }
        let word = *self.bytes.get(self.at..)?.first_chunk()?;
        self.at += 4;
        Some(if self.big_endian { u32::from_be_bytes(word) } else { u32::from_le_bytes(word) })
    }

    pub(super) fn u8(&mut self) -> Option<u8> {
        self.bytes(1).map(|byte| byte[0])
    }

    pub(super) fn bool(&mut self) -> Option<bool> {
        self.u8().map(|byte| byte != 0)
    }

    pub(super) fn bytes(&mut self, len: usize) -> Option<&'a [u8]> {
        let bytes = self.bytes.get(self.at..)?.get(..len)?;
        self.at += len;
        Some(bytes)
    }

    /// `std_msgs/Header`: its time, in nanoseconds since 1970.
    pub(super) fn header(&mut self) -> Option<i64> {
        let seconds = match self.encoding {
            Encoding::Ros1 => {
                let _number = self.u32()?;
                i64::from(self.u32()?)
            }
            Encoding::Cdr => i64::from(self.u32()? as i32),
        };
        let ns = self.u32()?;
        let name = self.u32()?;
        self.bytes(name as usize)?;
        Some(time_ns(seconds, ns))
    }
}
