//! The bags of ROS 1 (`.bag`, version 2.0).
//!
//! Source: "Bags/Format/2.0" in the ROS wiki.

#[cfg(test)]
mod tests;

use cantap_trace::counted;
use std::collections::HashMap;
use std::io;

use super::super::compression::Compression;
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::{Fault, Place};
use super::container::{ChunkHead, Container, Counts, Known, Step, skip, text_of, u32_of};
use super::{Encoding, Kind, OTHER_MESSAGES, Topic, time_ns};

/// Kinds of records.
mod op {
    pub(super) const MESSAGE: u8 = 2;
    pub(super) const BAG: u8 = 3;
    pub(super) const INDEX: u8 = 4;
    pub(super) const CHUNK: u8 = 5;
    pub(super) const CHUNK_INFO: u8 = 6;
    pub(super) const CONNECTION: u8 = 7;
}

/// A record's header is far shorter, and so are a connection's fields and a message with a frame.
const MAX_HELD_BYTES: usize = 1 << 20;

/// What a file has said so far.
#[derive(Default)]
pub(crate) struct Bag {
    connections: HashMap<u32, Option<(Kind, Topic)>>,
    /// Where the index begins; 0 if the bag was never closed.
    index_at: u64,
    /// How many chunks the bag's header says there are.
    chunks: Option<u32>,
    /// What was read.
    counts: Counts,
    /// What the index says there is.
    indexed: Counts,
}

/// A record's header, and the length of its data.
struct Head<'a> {
    fields: &'a [u8],
    /// Length of the record up to its data.
    bytes: usize,
    data_len: u32,
}

impl<'a> Head<'a> {
    /// The record that begins here, if its header is in these bytes.
    fn of(bytes: &'a [u8]) -> Option<Self> {
        let mut rest = bytes;
        let fields = text_of(&mut rest)?;
        let data_len = u32_of(&mut rest)?;
        Some(Self { fields, bytes: bytes.len() - rest.len(), data_len })
    }

    fn field(&self, name: &[u8]) -> Option<&'a [u8]> {
        field(self.fields, name)
    }

    fn op(&self) -> Option<u8> {
        self.field(b"op").and_then(|value| <[u8; 1]>::try_from(value).ok()).map(|[op]| op)
    }

    fn number<const N: usize>(&self, name: &[u8]) -> Option<[u8; N]> {
        self.field(name)?.try_into().ok()
    }
}

/// The value of a field: each is a length, a name, `=`, and a value.
fn field<'a>(fields: &'a [u8], name: &[u8]) -> Option<&'a [u8]> {
    let mut rest = fields;
    std::iter::from_fn(|| text_of(&mut rest)).find_map(|field| field.strip_prefix(name)?.strip_prefix(b"="))
}

impl Container for Bag {
    const MAGIC: &'static [u8] = b"#ROSBAG V2.0\n";
    const EXPECTED: &'static str = "a bag of ROS 1 in version 2.0, which begins with its name";
    const CUT: &'static str = "a bag that has no index";
    /// Its length, `op`, `compression`, `size`, the length of the records.
    const CHUNK_HEAD_BYTES: usize = 4 + (4 + 4) + (4 + 16) + (4 + 9) + 4;

    fn step(&mut self, input: &mut Input, place: Place, known: &mut Known) -> io::Result<Step> {
        let len = input.peek(4)?.first_chunk().map(|len| u32::from_le_bytes(*len) as usize);
        let Some(len) = len else {
            let rest = input.buffered().len();
            input.consume(rest);
            return Ok(if rest == 0 { Step::End } else { Step::Cut });
        };
        let wrong = |found: String| Step::Wrong(Fault::malformed("a record of a bag", found.as_bytes()));
        if len > MAX_HELD_BYTES {
            return Ok(wrong(format!("one with a header of {}", counted(len, "byte"))));
        }
        let Some(head) = Head::of(input.peek(len + 8)?) else { return Ok(Step::Cut) };
        let Some(op) = head.op() else { return Ok(wrong("one without its kind".to_owned())) };
        let end = head.bytes.saturating_add(head.data_len as usize);
        let connection = head.number(b"conn").map(u32::from_le_bytes);
        match op {
            op::CHUNK => {
                self.counts.chunks += 1;
                return Ok(Step::Chunk);
            }
            op::BAG => {
                self.index_at = head.number(b"index_pos").map_or(0, u64::from_le_bytes);
                self.chunks = head.number(b"chunk_count").map(u32::from_le_bytes);
            }
            op::CONNECTION if end <= MAX_HELD_BYTES => {
                let topic = head.field(b"topic").map(<[u8]>::to_vec);
                let start = head.bytes;
                let Some(fields) = input.peek(end)?.get(start..end) else { return Ok(Step::Cut) };
                let (Some(number), Some(topic), Some(kind)) = (connection, topic, field(fields, b"type"))
                else {
                    input.consume(end);
                    let fault = Fault::malformed("a connection with its topic and type", b"one without");
                    return Ok(Step::Found(Found::Issue(place, fault)));
                };
                let kind = Kind::of_type(kind).map(|kind| (kind, known.topics.topic(&topic)));
                self.connections.insert(number, kind);
            }
            op::MESSAGE => {
                self.counts.messages += 1;
                let time = head.number::<8>(b"time").unwrap_or_default();
                let found = match connection.and_then(|number| self.connections.get(&number)) {
                    Some(Some((kind, topic))) if end <= MAX_HELD_BYTES => {
                        let start = head.bytes;
                        let Some(bytes) = input.peek(end)?.get(start..end) else { return Ok(Step::Cut) };
                        let mut time = &time[..];
                        let [seconds, ns] =
                            [u32_of(&mut time), u32_of(&mut time)].map(Option::unwrap_or_default);
                        known.message(
                            (*kind, Encoding::Ros1),
                            *topic,
                            time_ns(seconds.into(), ns),
                            bytes,
                            place,
                        )
                    }
                    Some(None) => Found::LeftOut(OTHER_MESSAGES),
                    Some(_) => {
                        let found = counted(head.data_len, "byte");
                        Found::Issue(place, Fault::malformed("a message with a CAN frame", found.as_bytes()))
                    }
                    None => {
                        let found = format!("connection {connection:?}");
                        Found::Issue(
                            place,
                            Fault::malformed("a message of a connection of the bag", found.as_bytes()),
                        )
                    }
                };
                return Ok(if skip(input, end as u64)? { Step::Found(found) } else { Step::Cut });
            }
            // One that is longer than any is not one.
            op::INDEX if connection.is_some() => {}
            op::CHUNK_INFO if head.field(b"chunk_pos").is_some() && end <= MAX_HELD_BYTES => {
                let start = head.bytes;
                let Some(connections) = input.peek(end)?.get(start..end) else { return Ok(Step::Cut) };
                let counts = connections.chunks_exact(8).filter_map(|bytes| u32_of(&mut &bytes[4..]));
                self.indexed.messages += counts.map(u64::from).sum::<u64>();
                self.indexed.chunks += 1;
            }
            other => return Ok(wrong(format!("one of kind {other}"))),
        }
        Ok(if skip(input, end as u64)? { Step::Nothing } else { Step::Cut })
    }

    fn chunk(record: &[u8]) -> Option<ChunkHead> {
        let head = Head::of(record)?;
        (head.op()? == op::CHUNK).then_some(())?;
        let compression = match head.field(b"compression")? {
            b"none" => None,
            b"bz2" => Some(Compression::Bzip2),
            b"lz4" => Some(Compression::Lz4),
            _ => return None,
        };
        let len = u64::from(head.data_len);
        let unpacked = u64::from(u32::from_le_bytes(head.number(b"size")?));
        // Without compression, both are the same.
        (compression.is_some() || len == unpacked).then_some(ChunkHead {
            bytes: head.bytes,
            crc: None,
            compression,
            len,
        })
    }

    fn may_end(&self, at: u64) -> bool {
        self.index_at != 0 && at >= self.index_at
    }

    fn end(&mut self, _: &mut Input) -> io::Result<Option<Fault>> {
        let Some(chunks) = self.chunks.map(u64::from) else { return Ok(None) };
        // An index that is not whole does not count all messages.
        let is_whole = self.indexed.chunks == chunks;
        let messages = if is_whole { self.indexed.messages } else { self.counts.messages };
        Ok(self.counts.check(Counts { chunks, messages }))
    }
}
