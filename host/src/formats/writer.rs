//! Writing a trace of any format as a stream.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;

use super::analyser::{CsvLayout, TableEncoder, TableStyle};
use super::csv::CsvDialect;
use super::dif::DifLayout;
use super::output::{Output, Patch};
use super::rotate::{Rotating, Rotation};
use super::{Format, asc, blf, candump, csv, pcapng, trc};
use crate::{TraceEvent, TraceRecord};

/// Bytes collected before they go to the system.
const BUFFER_BYTES: usize = 128 * 1024;

/// How to write.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// The format; by the file's suffix if not given, and a candump log to standard output.
    pub format: Option<Format>,
    /// When to begin a new file.
    pub rotation: Rotation,
    /// How the earlier CANanalyser's tables look.
    pub table: TableStyle,
}

/// What a file could not carry, or what there is to know about one: a description and how often.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LeftOut(BTreeMap<&'static str, u64>);

impl LeftOut {
    /// Counts one more of something.
    pub(crate) fn note(&mut self, what: &'static str) {
        self.add(what, 1);
    }

    /// Counts `count` more of something.
    pub(crate) fn add(&mut self, what: &'static str, count: u64) {
        *self.0.entry(what).or_default() += count;
    }

    /// Adds another file's.
    pub(crate) fn merge(&mut self, other: &Self) {
        for (what, count) in &other.0 {
            self.add(what, *count);
        }
    }

    /// Whether everything was written.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Descriptions and counts.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.0.iter().map(|(what, count)| (*what, *count))
    }
}

/// Takes records and makes a file of them.
pub trait TraceWriter: Send {
    /// Adds a record. It may stay in a buffer until [`Self::flush`].
    fn write(&mut self, record: &TraceRecord) -> io::Result<()>;

    /// Hands everything to the system: what was written until now survives a crash of the program,
    /// in a file that is valid.
    fn flush(&mut self) -> io::Result<()>;

    /// Ends the file and says what it could not carry.
    fn finish(self: Box<Self>) -> io::Result<LeftOut>;
}

/// The writing half of a format: appends to a buffer, knows nothing of files.
pub(crate) trait Encode: Send {
    /// Appends a record, and before the first one the file's head.
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut);

    /// Whether the format can say that a frame's time is only an upper bound.
    fn carries_late(&self) -> bool {
        false
    }

    /// Appends what was held back, so that a file ending here is valid.
    fn flush(&mut self, _out: &mut Vec<u8>, _left_out: &mut LeftOut) {}

    /// Bytes that [`Self::flush`] would append at most.
    fn held_back(&self) -> usize {
        0
    }

    /// Appends the file's end. A file without any record gets its head here.
    fn finish(&mut self, out: &mut Vec<u8>, left_out: &mut LeftOut);

    /// Appends what would make a file end here: what [`Self::finish`] would append, and what is held back for a record that
    /// may come.
    fn provisional_end(&self, _out: &mut Vec<u8>) {}

    /// What to change in the bytes already written, after `written` bytes in all.
    fn patch(&self, _written: u64) -> Option<Patch> {
        None
    }

    /// How many of these bytes at the end of the file are whole records.
    fn whole(&self, bytes: &[u8]) -> usize {
        memchr::memrchr(b'\n', bytes).map_or(0, |end| end + 1)
    }
}

/// The writer of one file.
pub(crate) struct FileWriter {
    encoder: Box<dyn Encode>,
    output: Output,
    buffer: Vec<u8>,
    /// Bytes made so far, before compression, without the buffer.
    written: u64,
    has_records: bool,
    /// Size of the file when last looked at.
    size: u64,
    left_out: LeftOut,
}

/// Creates a trace file, or writes to standard output for `-`. A name that ends in `.gz` or `.zst` is
/// compressed. With a rotation it is a row of files, `trace-000001.log` and so on.
pub fn create_writer(path: impl AsRef<Path>, options: &WriteOptions) -> io::Result<Box<dyn TraceWriter>> {
    let path = path.as_ref();
    if options.rotation.at.is_empty() {
        Ok(Box::new(FileWriter::create(path, options)?))
    } else {
        Ok(Box::new(Rotating::create(path, options)?))
    }
}

/// The format that a path and the options ask for.
fn format_of(path: &Path, options: &WriteOptions) -> io::Result<Format> {
    match options.format {
        Some(format) => Ok(format),
        None if path.as_os_str() == "-" => Ok(Format::Candump),
        None => Format::of_path(path).map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error)),
    }
}

impl FileWriter {
    pub(crate) fn create(path: &Path, options: &WriteOptions) -> io::Result<Self> {
        let format = format_of(path, options)?;
        Ok(Self::new(Output::create(path)?, format, options))
    }

    pub(crate) fn new(output: Output, format: Format, options: &WriteOptions) -> Self {
        let encoder: Box<dyn Encode> = match format {
            Format::Candump => Box::new(candump::Encoder::default()),
            Format::Asc => Box::new(asc::Encoder::default()),
            Format::Blf => Box::new(blf::Encoder::default()),
            Format::Trc(version) => Box::new(trc::Encoder::new(version)),
            Format::Csv(CsvDialect::PythonCan) => Box::new(csv::PythonCanEncoder::default()),
            Format::Csv(CsvDialect::Full) => Box::new(csv::FullEncoder::default()),
            Format::Csv(CsvDialect::Analyser) => Box::new(TableEncoder::new(CsvLayout(options.table))),
            Format::Pcapng => Box::new(pcapng::Encoder::default()),
            Format::Dif => Box::new(TableEncoder::new(DifLayout::new(options.table))),
        };
        let buffer = Vec::with_capacity(BUFFER_BYTES + 1024);
        Self {
            encoder,
            output,
            buffer,
            written: 0,
            has_records: false,
            size: 0,
            left_out: LeftOut::default(),
        }
    }

    /// Bytes the file has, with what is still held back.
    pub(crate) fn size(&self) -> u64 {
        self.size + (self.buffer.len() + self.encoder.held_back()) as u64
    }

    /// Whether any record was written.
    pub(crate) fn has_records(&self) -> bool {
        self.has_records
    }

    /// Hands the buffer on, and makes the file one that may end there.
    fn drain(&mut self) -> io::Result<()> {
        let encoder = &self.encoder;
        let result = self.output.write(&self.buffer, |bytes| encoder.whole(bytes));
        self.written += self.buffer.len() as u64;
        self.buffer.clear();
        self.size = self.output.size().unwrap_or(self.written);
        result?;
        self.patch()?;
        self.encoder.provisional_end(&mut self.buffer);
        let result = self.output.provisional_end(&self.buffer);
        self.buffer.clear();
        result
    }

    /// Brings the head up to date; returns what other programs miss in it where that cannot be done.
    fn patch(&mut self) -> io::Result<Option<&'static str>> {
        let Some(patch) = self.encoder.patch(self.written) else { return Ok(None) };
        let patched = self.output.patch(&patch)?;
        Ok(patch.missed.filter(|_| !patched))
    }
}

impl TraceWriter for FileWriter {
    #[inline]
    fn write(&mut self, record: &TraceRecord) -> io::Result<()> {
        self.has_records = true;
        if matches!(record.event, TraceEvent::Frame { late: true, .. }) && !self.encoder.carries_late() {
            self.left_out.note("the mark of times that are only upper bounds");
        }
        self.encoder.record(record, &mut self.buffer, &mut self.left_out);
        if self.buffer.len() >= BUFFER_BYTES { self.drain() } else { Ok(()) }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.encoder.flush(&mut self.buffer, &mut self.left_out);
        self.drain()?;
        self.output.flush()
    }

    fn finish(mut self: Box<Self>) -> io::Result<LeftOut> {
        self.encoder.finish(&mut self.buffer, &mut self.left_out);
        let result = self.output.write(&self.buffer, |bytes| self.encoder.whole(bytes));
        self.written += self.buffer.len() as u64;
        result?;
        if let Some(what) = self.patch()? {
            self.left_out.note(what);
        }
        self.output.finish()?;
        Ok(self.left_out)
    }
}
