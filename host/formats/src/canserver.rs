//! The binary log of CANServer, a logger for Teslas: 22 bytes that name its version, then frames, times and marks, each behind a byte that says which it is.
//! Files that were joined have another head in between.
//!
//! As SavvyCAN and CANServer's own converters read it.

use std::io;

use super::codec::Decode;
use super::found::Found;
use super::frame_fields::{FrameFields, Payload, identifier};
use super::input::Input;
use super::issue::{Fault, Place};
use cantap_trace::{Direction, TraceRecord};

const MARKS: &str = "marks that somebody set while driving";
const NO_TIME: &str = "frames before the log's first time count from 1970";

const HEAD_BYTES: usize = 22;
/// A frame without its data: the byte before it, and its time, identifier, bus and length.
const FRAME_BYTES: usize = 6;
const TIME_BYTES: usize = 9;

/// The two layouts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Version {
    V2,
    V3,
}

/// Of a head.
fn version(head: &[u8]) -> Option<Version> {
    if head.starts_with(b"CANSERVER_v2_CANSERVER") {
        Some(Version::V2)
    } else if head.starts_with(b"CANSERVER_v3_CANSERVER") {
        Some(Version::V3)
    } else {
        None
    }
}

/// Whether a file begins like such a log.
pub(crate) fn is_head(bytes: &[u8]) -> bool {
    version(bytes).is_some()
}

/// What stands behind a byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Item {
    Frame,
    Time,
    Mark,
}

impl Item {
    fn of(first: u8, version: Version) -> Option<Self> {
        match (first, version) {
            (0xCF, Version::V2) | (0xB0..=0xBF, Version::V3) => Some(Self::Frame),
            (0xCE, Version::V2) | (0xA0, Version::V3) => Some(Self::Time),
            (0xCD, Version::V2) | (0xD0, Version::V3) => Some(Self::Mark),
            _ => None,
        }
    }

    /// How long it is, from its first bytes; `None` if they are not all here.
    fn len(self, bytes: &[u8]) -> Option<usize> {
        Some(match self {
            Self::Frame => FRAME_BYTES + usize::from(*bytes.get(FRAME_BYTES - 1)? & 0xF).min(8),
            Self::Time => TIME_BYTES,
            Self::Mark => 2 + usize::from(*bytes.get(1)?),
        })
    }
}

/// Reads a log.
#[derive(Default)]
pub(crate) struct Decoder {
    version: Option<Version>,
    /// The last time, in microseconds since 1970.
    base_us: Option<u64>,
    noted_time: bool,
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        /// The longest is a mark.
        const MOST_BYTES: usize = 2 + 255;
        loop {
            let place = Place::Offset(input.offset());
            let bytes = input.peek(MOST_BYTES)?;
            let Some(&first) = bytes.first() else { return Ok(Found::End) };
            let version = match (self.version, version(bytes)) {
                (_, Some(version)) => {
                    self.version = Some(version);
                    input.consume(HEAD_BYTES);
                    continue;
                }
                (Some(version), None) => version,
                // The format was named by the user.
                (None, None) => {
                    let len = bytes.len();
                    let shown = &bytes[..len.min(HEAD_BYTES)];
                    let fault = Fault::malformed("CANSERVER_v2_CANSERVER or CANSERVER_v3_CANSERVER", shown);
                    input.consume(len);
                    return Ok(Found::Issue(place, fault));
                }
            };
            let Some(item) = Item::of(first, version) else { return Ok(skip(input, place, version)) };
            let Some(whole) = item.len(bytes).and_then(|len| bytes.get(..len)) else {
                let len = bytes.len();
                input.consume(len);
                return Ok(Found::Issue(place, Fault::Truncated("a frame, a time or a mark")));
            };
            let (whole, len) = (whole.to_vec(), whole.len());
            if item == Item::Frame && self.base_us.is_none() && !std::mem::replace(&mut self.noted_time, true)
            {
                return Ok(Found::Note(NO_TIME));
            }
            input.consume(len);
            match item {
                Item::Mark => return Ok(Found::LeftOut(MARKS)),
                Item::Time => {
                    self.base_us = whole[1..].first_chunk().map(|us| u64::from_le_bytes(*us));
                }
                Item::Frame => {
                    return Ok(match self.frame(&whole, version) {
                        Ok(record) => Found::Record(record),
                        Err(fault) => Found::Issue(place, fault),
                    });
                }
            }
        }
    }
}

impl Decoder {
    fn frame(&self, bytes: &[u8], version: Version) -> Result<TraceRecord, Fault> {
        let (head, data) = bytes.split_at(FRAME_BYTES);
        let number = |at: usize| u64::from(head[at]);
        let (offset_us, raw) = match version {
            Version::V2 => ((number(1) | number(2) << 8) * 1000, number(3) | number(4) << 8),
            Version::V3 => (
                number(0) & 0xF | number(1) << 4 | number(2) << 12 | number(3) >> 3 << 20,
                (number(3) & 7) << 8 | number(4),
            ),
        };
        let time_us = self.base_us.unwrap_or(0).checked_add(offset_us);
        let time_ns = time_us.and_then(|us| i64::try_from(us).ok()).and_then(|us| us.checked_mul(1000));
        let time_ns = time_ns.ok_or_else(|| Fault::malformed("a time before the year 2262", &head[1..3]))?;
        let id = identifier(raw as u32, false, format!("{raw:X}").as_bytes())?;
        let fields =
            FrameFields { id, remote: false, direction: Direction::Rx, len: head[5] & 0xF, fd: None };
        let data = Payload::of(data).unwrap_or(Payload::EMPTY);
        Ok(TraceRecord { time_ns, device_ns: None, channel: (head[5] >> 4) + 1, event: fields.event(&data)? })
    }
}

/// Skips bytes that are nothing, up to what may be something.
fn skip(input: &mut Input, place: Place, version: Version) -> Found {
    let bytes = input.buffered();
    let shown = bytes[..bytes.len().min(8)].to_vec();
    // A head begins with C.
    let may_be = |byte: &u8| *byte == b'C' || Item::of(*byte, version).is_some();
    let next = bytes.iter().skip(1).position(may_be);
    let skipped = next.map_or(bytes.len(), |next| next + 1);
    input.consume(skipped);
    Found::Issue(place, Fault::malformed("a frame, a time or a mark", &shown))
}

#[cfg(test)]
mod tests {
    use super::super::tests;
    use crate::Format;

    const V2: &[u8] = b"CANSERVER_v2_CANSERVER";

    fn time(first: u8) -> Vec<u8> {
        [&[first][..], &1_700_000_000_000_000_u64.to_le_bytes()].concat()
    }

    #[test]
    fn both_versions_are_read_also_joined() {
        let file = [
            V2,
            &time(0xCE),
            &[0xCF, 0xE8, 0x03, 0x23, 0x01, 0x02, 0x11, 0x22],
            b"\xCD\x04mark",
            &[0xCF, 0xE9, 0x03, 0xFF, 0x07, 0x10],
            b"CANSERVER_v3_CANSERVER",
            &time(0xA0),
            // 1.000001 s: F4241; the identifier's upper bits are 7.
            &[0xB1, 0x24, 0xF4, 0x07, 0xFF, 0x18, 1, 2, 3, 4, 5, 6, 7, 8],
        ]
        .concat();
        assert_eq!(Format::of_content(&file), Some(Format::CanServer));
        let (log, issues) = tests::as_log(Format::CanServer, &file);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            log,
            "(1700000001.000000) can0 123#1122\n(1700000001.001000) can1 7FF#\n\
             (1700000001.000001) can1 7FF#0102030405060708\n"
        );
    }

    #[test]
    fn damage_costs_what_it_hit_and_a_cut_end_is_named() {
        let frame = [0xCF, 1, 0, 0x23, 0x01, 0x01, 0x11];
        let file =
            [V2, &time(0xCE), &[0, 1, 2], &frame, &[0xCF, 1, 0, 0, 0x08, 0], &frame, &frame[..4]].concat();
        let (records, issues) = tests::read(Format::CanServer, &file);
        assert_eq!(records.len(), 2);
        assert_eq!(issues.len(), 3, "{issues:#?}");
        assert!(issues[1].contains("an identifier up to 7FF"), "{issues:#?}");
        assert!(issues[2].contains("the file ends inside"), "{issues:#?}");
        for other in [&b"x"[..], &[V2, &frame].concat()] {
            let (records, issues) = tests::read(Format::CanServer, other);
            assert_eq!((records.len(), issues.len()), if other.len() == 1 { (0, 1) } else { (1, 0) });
        }
    }
}
