//! MCAP files: what ROS 2 records, and bags of ROS 1 that were converted.
//!
//! Source: the MCAP format specification (mcap.dev), with the profiles `ros1` and `ros2`.

#[cfg(test)]
mod tests;

use cantap_trace::counted;
use std::collections::HashMap;
use std::io;

use super::super::compression::Compression;
use super::super::found::Found;
use super::super::input::Input;
use super::super::issue::{Fault, Place};
use super::container::{ChunkHead, Container, Counts, Known, Step, array_of, skip, text_of, u32_of};
use super::{Encoding, Kind, OTHER_MESSAGES, Topic};

/// Kinds of records.
mod op {
    pub(super) const FOOTER: u8 = 2;
    pub(super) const SCHEMA: u8 = 3;
    pub(super) const CHANNEL: u8 = 4;
    pub(super) const MESSAGE: u8 = 5;
    pub(super) const CHUNK: u8 = 6;
    pub(super) const MESSAGE_INDEX: u8 = 7;
    pub(super) const CHUNK_INDEX: u8 = 8;
    pub(super) const ATTACHMENT_INDEX: u8 = 10;
    pub(super) const STATISTICS: u8 = 11;
    pub(super) const METADATA_INDEX: u8 = 13;
    pub(super) const SUMMARY_OFFSET: u8 = 14;
    pub(super) const DATA_END: u8 = 15;
    /// From here on they are anyone's own.
    pub(super) const FIRST_PRIVATE: u8 = 0x80;
}

/// Of a record: its kind and its length.
const HEAD_BYTES: usize = 9;
/// Of a message, before its content: channel, number, two times.
const MESSAGE_HEAD_BYTES: usize = 22;
/// No message with a frame is so long, nor the name of a topic.
const MAX_HELD_BYTES: u64 = 1 << 20;

const PRIVATE_RECORDS: &str = "records of MCAP of a kind of some program's own";

/// What a file has said so far.
#[derive(Default)]
pub(crate) struct Mcap {
    schemas: HashMap<u16, Option<Kind>>,
    channels: HashMap<u16, Option<Channel>>,
    /// What was read.
    counts: Counts,
}

#[derive(Clone, Copy)]
struct Channel {
    kind: Kind,
    encoding: Encoding,
    topic: Topic,
}

impl Container for Mcap {
    const MAGIC: &'static [u8] = b"\x89MCAP0\r\n";
    const EXPECTED: &'static str = "an MCAP file, which begins with a magic number";
    const CUT: &'static str = "an MCAP file that has no end";
    /// Record, two times, length, checksum, `zstd`, length of the records.
    const CHUNK_HEAD_BYTES: usize = HEAD_BYTES + 8 + 8 + 8 + 4 + 4 + 4 + 8;

    fn step(&mut self, input: &mut Input, place: Place, known: &mut Known) -> io::Result<Step> {
        let bytes = input.peek(HEAD_BYTES)?;
        let Some((op, len)) = record_head(bytes) else {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(if rest == 0 { Step::End } else { Step::Cut });
        };
        match op {
            op::CHUNK => {
                self.counts.chunks += 1;
                return Ok(Step::Chunk);
            }
            op::DATA_END => return Ok(Step::Last),
            op::MESSAGE => return self.message(input, len, place, known),
            op::SCHEMA | op::CHANNEL if len <= MAX_HELD_BYTES => {
                let end = HEAD_BYTES + len as usize;
                let Some(bytes) = input.peek(end)?.get(HEAD_BYTES..end) else { return Ok(Step::Cut) };
                let read = if op == op::SCHEMA { self.schema(bytes) } else { self.channel(bytes, known) };
                input.consume(end);
                let fault = Fault::malformed("a schema or a channel", b"one that ends early");
                return Ok(read.map_or(Step::Found(Found::Issue(place, fault)), |()| Step::Nothing));
            }
            op::MESSAGE_INDEX => {
                let Some(bytes) = input.peek(HEAD_BYTES + 6)?.get(HEAD_BYTES + 2..) else {
                    return Ok(Step::Cut);
                };
                let entries = bytes.first_chunk().map_or(0, |len| u64::from(u32::from_le_bytes(*len)));
                if !entries.is_multiple_of(16) || len != 6 + entries {
                    let found = b"one that contradicts itself";
                    return Ok(Step::Wrong(Fault::malformed("an index of messages", found)));
                }
            }
            // What stands only behind the end of the data, or is no kind at all.
            0
            | op::FOOTER
            | op::SCHEMA
            | op::CHANNEL
            | op::CHUNK_INDEX
            | op::ATTACHMENT_INDEX
            | op::STATISTICS
            | op::METADATA_INDEX
            | op::SUMMARY_OFFSET
            | op::DATA_END..op::FIRST_PRIVATE => {
                let found = format!("one of kind {op}");
                return Ok(Step::Wrong(Fault::malformed("a record of MCAP", found.as_bytes())));
            }
            // Such a kind may also be that of a damaged record.
            op::FIRST_PRIVATE.. => {
                let is_whole = skip(input, len.saturating_add(HEAD_BYTES as u64))?;
                return Ok(if is_whole { Step::Found(Found::LeftOut(PRIVATE_RECORDS)) } else { Step::Cut });
            }
            _ => {}
        }
        Ok(if skip(input, len.saturating_add(HEAD_BYTES as u64))? { Step::Nothing } else { Step::Cut })
    }

    fn chunk(record: &[u8]) -> Option<ChunkHead> {
        /// Its times and the length of the records without compression.
        const BEFORE_CRC: usize = 24;
        let (op::CHUNK, record_len) = record_head(record)? else { return None };
        let mut rest = record.get(HEAD_BYTES + BEFORE_CRC..)?;
        let crc = u32_of(&mut rest)?;
        let compression = match text_of(&mut rest)? {
            b"" => None,
            b"zstd" => Some(Compression::Zstd),
            b"lz4" => Some(Compression::Lz4),
            _ => return None,
        };
        let len = u64_of(&mut rest)?;
        let bytes = record.len() - rest.len();
        let is_sound = len.checked_add((bytes - HEAD_BYTES) as u64)? == record_len;
        is_sound.then_some(ChunkHead { bytes, crc: (crc != 0).then_some(crc), compression, len })
    }

    fn may_end(&self, _: u64) -> bool {
        false
    }

    fn end(&mut self, input: &mut Input) -> io::Result<Option<Fault>> {
        /// Of the statistics, up to the count of chunks.
        const STATISTICS_BYTES: usize = HEAD_BYTES + 8 + 2 + 4 + 4 + 4 + 4;
        while let Some((op, len)) = record_head(input.peek(HEAD_BYTES)?) {
            if op == op::STATISTICS {
                let Some(bytes) = input.peek(STATISTICS_BYTES)?.first_chunk::<STATISTICS_BYTES>() else {
                    break;
                };
                let [mut messages, mut chunks] = [&bytes[HEAD_BYTES..], &bytes[STATISTICS_BYTES - 4..]];
                let messages = u64_of(&mut messages).unwrap_or_default();
                let chunks = u32_of(&mut chunks).unwrap_or_default().into();
                return Ok(self.counts.check(Counts { chunks, messages }));
            }
            if !skip(input, len.saturating_add(HEAD_BYTES as u64))? {
                break;
            }
        }
        Ok(None)
    }
}

impl Mcap {
    fn schema(&mut self, bytes: &[u8]) -> Option<()> {
        let mut bytes = bytes;
        let number = u16_of(&mut bytes)?;
        self.schemas.insert(number, Kind::of_type(text_of(&mut bytes)?));
        Some(())
    }

    fn channel(&mut self, bytes: &[u8], known: &mut Known) -> Option<()> {
        let mut bytes = bytes;
        let (number, schema) = (u16_of(&mut bytes)?, u16_of(&mut bytes)?);
        let topic = text_of(&mut bytes)?;
        let encoding = match text_of(&mut bytes)? {
            b"ros1" => Some(Encoding::Ros1),
            b"cdr" => Some(Encoding::Cdr),
            _ => None,
        };
        let kind = self.schemas.get(&schema).copied().flatten();
        let channel = kind.zip(encoding);
        let channel =
            channel.map(|(kind, encoding)| Channel { kind, encoding, topic: known.topics.topic(topic) });
        self.channels.insert(number, channel);
        Some(())
    }

    fn message(&mut self, input: &mut Input, len: u64, place: Place, known: &mut Known) -> io::Result<Step> {
        let bytes = input.peek(HEAD_BYTES + MESSAGE_HEAD_BYTES)?;
        let mut head = bytes.get(HEAD_BYTES..).unwrap_or_default();
        let (Some(number), Some(_), Some(log_ns)) = (u16_of(&mut head), u32_of(&mut head), u64_of(&mut head))
        else {
            return Ok(Step::Cut);
        };
        self.counts.messages += 1;
        let Channel { kind, encoding, topic } = match self.channels.get(&number) {
            Some(Some(channel)) if (MESSAGE_HEAD_BYTES as u64..=MAX_HELD_BYTES).contains(&len) => *channel,
            other => {
                let issue = |expected: &'static str, found: String| {
                    Found::Issue(place, Fault::malformed(expected, found.as_bytes()))
                };
                let found = match other {
                    Some(None) => Found::LeftOut(OTHER_MESSAGES),
                    Some(_) => issue("a message with a CAN frame", counted(len, "byte")),
                    None => issue("a message of a channel of the file", format!("channel {number}")),
                };
                let is_whole = skip(input, len.saturating_add(HEAD_BYTES as u64))?;
                return Ok(if is_whole { Step::Found(found) } else { Step::Cut });
            }
        };
        let end = HEAD_BYTES + len as usize;
        let Some(message) = input.peek(end)?.get(HEAD_BYTES + MESSAGE_HEAD_BYTES..end) else {
            return Ok(Step::Cut);
        };
        let stored_ns = i64::try_from(log_ns).unwrap_or(i64::MAX);
        let found = known.message((kind, encoding), topic, stored_ns, message, place);
        input.consume(end);
        Ok(Step::Found(found))
    }
}

/// A record's kind and the length of what follows.
fn record_head(bytes: &[u8]) -> Option<(u8, u64)> {
    let (op, mut rest) = bytes.split_first()?;
    Some((*op, u64_of(&mut rest)?))
}

fn u16_of(bytes: &mut &[u8]) -> Option<u16> {
    array_of(bytes).map(u16::from_le_bytes)
}

fn u64_of(bytes: &mut &[u8]) -> Option<u64> {
    array_of(bytes).map(u64::from_le_bytes)
}
