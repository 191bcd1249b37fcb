//! A file with random access, for the formats that cannot be read as streams.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

/// Data that are compressed or come through a pipe are kept in memory, up to this many bytes.
pub(crate) const MAX_MEMORY_BYTES: u64 = 1 << 30;

/// A source with random access.
pub(crate) struct Whole {
    source: Box<dyn ReadSeek>,
    len: u64,
}

/// A reader that can seek.
pub(crate) trait ReadSeek: Read + Seek + Send {}

impl ReadSeek for File {}
impl ReadSeek for io::Cursor<Vec<u8>> {}

impl Whole {
    pub(crate) fn new(mut source: Box<dyn ReadSeek>) -> io::Result<Self> {
        let len = source.seek(SeekFrom::End(0))?;
        Ok(Self { source, len })
    }

    /// The source itself.
    pub(crate) fn into_source(self) -> Box<dyn ReadSeek> {
        self.source
    }

    /// Length of the file in bytes.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }

    /// The bytes at a position, at most as many as requested.
    pub(crate) fn read_at(&mut self, at: u64, len: usize) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.append_at(at, len, &mut bytes)?;
        Ok(bytes)
    }

    /// The same, appended.
    pub(crate) fn append_at(&mut self, at: u64, len: usize, bytes: &mut Vec<u8>) -> io::Result<()> {
        let there = self.len.saturating_sub(at).min(len as u64);
        // In a damaged file an address may be beyond what the system can seek to.
        if there == 0 {
            return Ok(());
        }
        bytes.reserve(there as usize);
        self.source.seek(SeekFrom::Start(at))?;
        let read = self.source.by_ref().take(there).read_to_end(bytes)?;
        if (read as u64) < there {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        Ok(())
    }
}
