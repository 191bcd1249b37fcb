//! Writes one file in any format.

use std::io::{self, Write};
use std::path::Path;

use super::Format;
use super::codec::Encode;
use super::format_names::NotWritten;
use super::left_out::LeftOut;
use super::output::Output;
use super::spec::FormatSpec;
use super::writer::{TraceWriter, WriteOptions};
use cantap_trace::{TraceEvent, TraceRecord};

/// Bytes collected before they are passed to the system.
const BUFFER_BYTES: usize = 128 * 1024;

/// The writer of one file.
pub(crate) struct FileWriter {
    encoder: Box<dyn Encode>,
    output: Output,
    buffer: Vec<u8>,
    /// Bytes produced so far, before compression, excluding the buffer.
    written: u64,
    has_records: bool,
    /// Size of the file when last checked.
    size: u64,
    left_out: LeftOut,
}

/// The format for a path and options.
fn format_of(path: &Path, options: &WriteOptions) -> io::Result<Format> {
    match options.format {
        Some(format) => Ok(format),
        None if path.as_os_str() == "-" => Ok(Format::Candump),
        None => Format::of_path(path).map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error)),
    }
}

/// The encoder of a format. For a format that can only be read, the error names those that can be written.
fn encoder_of(format: Format, options: &WriteOptions) -> io::Result<Box<dyn Encode>> {
    let unwritten = || io::Error::new(io::ErrorKind::Unsupported, NotWritten(format));
    FormatSpec::of(format).writer.map(|writer| writer(options)).ok_or_else(unwritten)
}

impl FileWriter {
    pub(crate) fn create(path: &Path, options: &WriteOptions) -> io::Result<Self> {
        // If the format cannot be written, nothing is created or overwritten.
        let encoder = encoder_of(format_of(path, options)?, options)?;
        Ok(Self::with(Output::create(path)?, encoder))
    }

    pub(crate) fn to_stream(
        stream: Box<dyn Write + Send>,
        format: Format,
        options: &WriteOptions,
    ) -> io::Result<Self> {
        Ok(Self::with(Output::Stream(stream), encoder_of(format, options)?))
    }

    #[cfg(test)]
    pub(crate) fn new(output: Output, format: Format, options: &WriteOptions) -> Self {
        Self::with(output, encoder_of(format, options).unwrap())
    }

    fn with(output: Output, encoder: Box<dyn Encode>) -> Self {
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

    /// The file's size in bytes, including what is still held back.
    pub(crate) fn size(&self) -> u64 {
        self.size + (self.buffer.len() + self.encoder.held_back()) as u64
    }

    /// Whether any record was written.
    pub(crate) fn has_records(&self) -> bool {
        self.has_records
    }

    /// Passes the buffer on, and leaves a file that may end there.
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

    /// Brings the header up to date; where that is impossible, returns what other programs will miss in it.
    fn patch(&mut self) -> io::Result<Option<&'static str>> {
        let Some(patch) = self.encoder.patch(self.written) else { return Ok(None) };
        let patched = self.output.patch(&patch)?;
        Ok(patch.missed.filter(|_| !patched))
    }
}

impl TraceWriter for FileWriter {
    #[inline]
    fn write(&mut self, record: &TraceRecord) -> io::Result<()> {
        if record.lin().is_some() && !self.encoder.carries_lin() {
            self.left_out.note("LIN frames, which this format has no form for");
            return Ok(());
        }
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

    fn remark(&mut self, channel: u8, text: &str) {
        self.encoder.remark(channel, text);
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
