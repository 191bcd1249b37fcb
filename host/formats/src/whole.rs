//! A file that is read at any place, for the formats that are no streams.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

/// What is compressed or comes through a pipe is kept in memory, at most so much of it.
pub(crate) const MAX_MEMORY_BYTES: u64 = 1 << 30;

/// A source that is read at any place.
pub(crate) struct Whole {
    source: Box<dyn ReadSeek>,
    len: u64,
}

/// A source that can be read at any place.
pub(crate) trait ReadSeek: Read + Seek + Send {}

impl ReadSeek for File {}
impl ReadSeek for io::Cursor<Vec<u8>> {}

impl Whole {
    pub(crate) fn new(mut source: Box<dyn ReadSeek>) -> io::Result<Self> {
        let len = source.seek(SeekFrom::End(0))?;
        Ok(Self { source, len })
    }

    /// Bytes in the file.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }

    /// As many bytes as there are at a place, at most those asked for.
    pub(crate) fn read_at(&mut self, at: u64, len: usize) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.append_at(at, len, &mut bytes)?;
        Ok(bytes)
    }

    /// The same, appended.
    pub(crate) fn append_at(&mut self, at: u64, len: usize, bytes: &mut Vec<u8>) -> io::Result<()> {
        let there = self.len.saturating_sub(at).min(len as u64);
        bytes.reserve(there as usize);
        self.source.seek(SeekFrom::Start(at))?;
        let read = self.source.by_ref().take(there).read_to_end(bytes)?;
        if (read as u64) < there {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok(())
    }
}
