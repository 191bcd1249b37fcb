//! The writer that a path and the options ask for.

use std::io;
use std::path::Path;

use super::file_writer::FileWriter;
use super::rotate::Rotating;
use super::writer::{TraceWriter, WriteOptions};

/// Creates a trace file, or writes to standard output for `-`. A name that ends in `.gz`, `.zst`,
/// `.xz` or `.lz4` is compressed. With a rotation it is a row of files, `trace-000001.log` and so on.
pub fn create_writer(path: impl AsRef<Path>, options: &WriteOptions) -> io::Result<Box<dyn TraceWriter>> {
    let path = path.as_ref();
    if options.rotation.at.is_empty() {
        Ok(Box::new(FileWriter::create(path, options)?))
    } else {
        Ok(Box::new(Rotating::create(path, options)?))
    }
}
