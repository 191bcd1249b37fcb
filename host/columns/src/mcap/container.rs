//! The container: chunks of messages, an index of them, and a summary at the end, by which viewers find any moment without reading all of a file.
//!
//! Source: the MCAP format specification, version 0 of the format, "Records" and "Summary Section".

use std::collections::BTreeMap;
use std::io::{self, Write};

const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";

/// The opcodes of records.
mod op {
    pub const HEADER: u8 = 0x01;
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const MESSAGE_INDEX: u8 = 0x07;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const STATISTICS: u8 = 0x0B;
    pub const SUMMARY_OFFSET: u8 = 0x0E;
    pub const DATA_END: u8 = 0x0F;
}

/// Bytes of messages in a chunk: what a viewer unpacks to show a moment, and what is lost if the program is killed.
const CHUNK_BYTES: usize = 1 << 20;

/// The content of a record: little-endian numbers, and texts, lists and maps with their length in bytes before them.
#[derive(Default)]
struct Content(Vec<u8>);

impl Content {
    fn u8(mut self, value: u8) -> Self {
        self.0.push(value);
        self
    }

    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        let mut content = self.u32(bytes.len() as u32);
        content.0.extend_from_slice(bytes);
        content
    }

    fn text(self, text: &str) -> Self {
        self.bytes(text.as_bytes())
    }

    fn list<T>(self, items: impl IntoIterator<Item = T>, item: impl Fn(Self, T) -> Self) -> Self {
        let list = items.into_iter().fold(Self::default(), item);
        self.bytes(&list.0)
    }
}

/// A record, with its opcode and length.
fn record(opcode: u8, content: &[u8]) -> Vec<u8> {
    let mut record = Vec::with_capacity(9 + content.len());
    record.push(opcode);
    record.extend((content.len() as u64).to_le_bytes());
    record.extend_from_slice(content);
    record
}

/// Writes a file in order, to anything that takes bytes.
pub struct Container<W> {
    out: W,
    written: u64,
    /// As they stand in the summary.
    schemas: Vec<Vec<u8>>,
    channels: Vec<Channel>,
    chunk: Chunk,
    chunk_indexes: Vec<Vec<u8>>,
    times: Times,
}

struct Channel {
    record: Vec<u8>,
    messages: u64,
}

/// The earliest and the latest time.
#[derive(Clone, Copy, Default)]
struct Times(Option<(u64, u64)>);

impl Times {
    fn add(&mut self, time_ns: u64) {
        self.0 =
            Some(self.0.map_or((time_ns, time_ns), |(first, last)| (first.min(time_ns), last.max(time_ns))));
    }

    fn put(self, content: Content) -> Content {
        let (first, last) = self.0.unwrap_or_default();
        content.u64(first).u64(last)
    }
}

/// Messages that are not written yet.
#[derive(Default)]
struct Chunk {
    records: Vec<u8>,
    times: Times,
    /// Where in it the messages of each channel begin.
    index: BTreeMap<u16, Vec<(u64, u64)>>,
}

/// More schemas or channels than a file can have.
fn too_many() -> io::Error {
    io::Error::new(
        io::ErrorKind::InvalidInput,
        "an MCAP file has no more than 65,535 schemas and channels; choose messages with --signal",
    )
}

impl<W: Write> Container<W> {
    /// Begins a file.
    pub fn new(mut out: W) -> io::Result<Self> {
        let header = Content::default().text("").text(concat!("cantap ", env!("CARGO_PKG_VERSION")));
        let header = record(op::HEADER, &header.0);
        out.write_all(MAGIC)?;
        out.write_all(&header)?;
        Ok(Self {
            out,
            written: (MAGIC.len() + header.len()) as u64,
            schemas: Vec::new(),
            channels: Vec::new(),
            chunk: Chunk::default(),
            chunk_indexes: Vec::new(),
            times: Times::default(),
        })
    }

    /// Adds a JSON schema. Returns its number.
    pub fn add_schema(&mut self, name: &str, schema: &str) -> io::Result<u16> {
        // 0 means none.
        let id = u16::try_from(self.schemas.len() + 1).map_err(|_| too_many())?;
        let content = Content::default().u16(id).text(name).text("jsonschema").text(schema);
        let record = record(op::SCHEMA, &content.0);
        self.chunk.records.extend_from_slice(&record);
        self.schemas.push(record);
        Ok(id)
    }

    /// Adds a channel of messages in JSON. Returns its number.
    pub fn add_channel(&mut self, schema: u16, topic: &str, about: &[(&str, String)]) -> io::Result<u16> {
        let id = u16::try_from(self.channels.len()).map_err(|_| too_many())?;
        let content = Content::default().u16(id).u16(schema).text(topic).text("json");
        let content = content.list(about, |map, (key, value)| map.text(key).text(value));
        let record = record(op::CHANNEL, &content.0);
        self.chunk.records.extend_from_slice(&record);
        self.channels.push(Channel { record, messages: 0 });
        Ok(id)
    }

    /// Adds a message to a channel. Its time is in nanoseconds since 1970, or since the start.
    pub fn message(&mut self, channel: u16, time_ns: u64, data: &[u8]) -> io::Result<()> {
        let Some(of) = self.channels.get_mut(usize::from(channel)) else { return Err(too_many()) };
        let sequence = of.messages as u32;
        of.messages += 1;
        let head = Content::default().u16(channel).u32(sequence).u64(time_ns).u64(time_ns).0;
        let chunk = &mut self.chunk;
        let at = chunk.records.len() as u64;
        chunk.records.push(op::MESSAGE);
        chunk.records.extend(((head.len() + data.len()) as u64).to_le_bytes());
        chunk.records.extend(head);
        chunk.records.extend_from_slice(data);
        chunk.times.add(time_ns);
        chunk.index.entry(channel).or_default().push((time_ns, at));
        self.times.add(time_ns);
        if self.chunk.records.len() >= CHUNK_BYTES { self.end_chunk() } else { Ok(()) }
    }

    fn put(&mut self, record: &[u8]) -> io::Result<()> {
        self.out.write_all(record)?;
        self.written += record.len() as u64;
        Ok(())
    }

    fn end_chunk(&mut self) -> io::Result<()> {
        let Chunk { records, times, index } = std::mem::take(&mut self.chunk);
        if records.is_empty() {
            return Ok(());
        }
        let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
        encoder.write_all(&records)?;
        let packed = encoder.finish().map_err(io::Error::other)?;
        let content = times.put(Content::default());
        let content = content.u64(records.len() as u64).u32(crc32fast::hash(&records)).text(COMPRESSION);
        let mut content = content.u64(packed.len() as u64);
        content.0.extend_from_slice(&packed);
        let start = self.written;
        self.put(&record(op::CHUNK, &content.0))?;
        let end = self.written;
        let mut places = Vec::new();
        for (channel, messages) in &index {
            places.push((*channel, self.written));
            let content = Content::default().u16(*channel);
            let content = content.list(messages, |list, (time_ns, at)| list.u64(*time_ns).u64(*at));
            self.put(&record(op::MESSAGE_INDEX, &content.0))?;
        }
        let content = times.put(Content::default()).u64(start).u64(end - start);
        let content = content.list(places, |map, (channel, at)| map.u16(channel).u64(at));
        let content = content.u64(self.written - end).text(COMPRESSION);
        let content = content.u64(packed.len() as u64).u64(records.len() as u64);
        self.chunk_indexes.push(record(op::CHUNK_INDEX, &content.0));
        Ok(())
    }

    /// Writes the rest and the summary. Returns what it was written to.
    pub fn finish(mut self) -> io::Result<W> {
        self.end_chunk()?;
        self.put(&record(op::DATA_END, &Content::default().u32(0).0))?;
        let start = self.written;
        let messages = self.channels.iter().map(|channel| channel.messages).sum();
        let statistics = Content::default().u64(messages).u16(self.schemas.len() as u16);
        // Neither attachments nor metadata.
        let statistics = statistics.u32(self.channels.len() as u32).u32(0).u32(0);
        let statistics = self.times.put(statistics.u32(self.chunk_indexes.len() as u32));
        let counts = (0..).zip(&self.channels);
        let statistics = statistics.list(counts, |map, (id, channel)| map.u16(id).u64(channel.messages));
        let channels = self.channels.iter().map(|channel| channel.record.as_slice()).collect::<Vec<_>>();
        let groups = [
            (op::SCHEMA, self.schemas.concat()),
            (op::CHANNEL, channels.concat()),
            (op::STATISTICS, record(op::STATISTICS, &statistics.0)),
            (op::CHUNK_INDEX, self.chunk_indexes.concat()),
        ];
        let mut summary = Vec::new();
        let mut offsets = Vec::new();
        for (opcode, records) in groups.into_iter().filter(|(_, records)| !records.is_empty()) {
            let at = start + summary.len() as u64;
            let offset = Content::default().u8(opcode).u64(at).u64(records.len() as u64);
            offsets.extend(record(op::SUMMARY_OFFSET, &offset.0));
            summary.extend(records);
        }
        let offsets_start = start + summary.len() as u64;
        summary.extend(offsets);
        // The checksum covers the summary and the footer up to itself.
        let footer = Content::default().u64(start).u64(offsets_start);
        let mut footer = record(op::FOOTER, &footer.u32(0).0);
        let content_end = footer.len() - size_of::<u32>();
        let mut checksum = crc32fast::Hasher::new();
        checksum.update(&summary);
        checksum.update(&footer[..content_end]);
        footer[content_end..].copy_from_slice(&checksum.finalize().to_le_bytes());
        self.put(&summary)?;
        self.put(&footer)?;
        self.put(MAGIC)?;
        self.out.flush()?;
        Ok(self.out)
    }
}

const COMPRESSION: &str = "lz4";
