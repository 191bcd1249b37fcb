//! Creates the writer for a path and options.

use std::io::{self, Write};
use std::path::Path;

use super::Format;
use super::file_writer::FileWriter;
use super::rotate::Rotating;
use super::writer::{TraceWriter, WriteOptions};

/// Creates a trace file, or writes to standard output for `-`. A name that ends in `.gz`, `.zst`, `.xz` or
/// `.lz4` is compressed. With rotation it is a series of files: `trace-000001.log` and so on.
pub fn create_writer(path: impl AsRef<Path>, options: &WriteOptions) -> io::Result<Box<dyn TraceWriter>> {
    let path = path.as_ref();
    if options.rotation.at.is_empty() {
        Ok(Box::new(FileWriter::create(path, options)?))
    } else {
        Ok(Box::new(Rotating::create(path, options)?))
    }
}

/// Writes a trace to any byte stream, such as an open pipe: as a candump log, if the options name no format. It cannot be rotated.
pub fn create_stream_writer(
    stream: Box<dyn Write + Send>,
    options: &WriteOptions,
) -> io::Result<Box<dyn TraceWriter>> {
    if !options.rotation.at.is_empty() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "a stream cannot be split into files"));
    }
    Ok(Box::new(FileWriter::to_stream(stream, options.format.unwrap_or(Format::Candump), options)?))
}
