//! A file read in blocks that have digests, from any place on.

use std::fs::File;
use std::io::{self, Seek, SeekFrom};

use super::Input;
use crate::seek::{BLOCK_BYTES, Blocks};

impl Input {
    /// Whether there is a line with a NUL byte that was not asked for.
    pub(crate) fn has_nul_line(&self) -> bool {
        !self.nul_lines.is_empty()
    }

    /// Reads up to the end of a block, and compares or learns it.
    pub(super) fn fill_block(&mut self) -> io::Result<bool> {
        let at = self.offset + (self.end - self.start) as u64;
        let rest = BLOCK_BYTES as u64 - at % BLOCK_BYTES as u64;
        let (before, source) = (self.end, &mut self.source);
        let block = &mut self.buffer[before..before + rest as usize];
        let mut len = 0;
        while len < block.len() {
            match source.read(&mut block[len..]) {
                Ok(0) => break,
                Ok(read) => len += read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        if let Some(blocks) = &mut self.blocks {
            blocks.read(at, &block[..len])?;
        }
        self.has_nul = self.has_nul || memchr::memchr(0, &block[..len]).is_some();
        self.end += len;
        self.ended = len == 0;
        Ok(len > 0)
    }

    /// The file itself, if its bytes are read as they are.
    pub(crate) fn file(&self) -> Option<&File> {
        self.file.as_ref()
    }

    /// What is read from the next [`Self::seek_to`] on is compared with these digests, or added to them.
    pub(crate) fn set_blocks(&mut self, blocks: Option<Blocks>) {
        self.blocks = blocks;
    }

    /// The digests.
    pub(crate) fn take_blocks(&mut self) -> Option<Blocks> {
        self.blocks.take()
    }

    /// Goes to a place in [`Self::file`], before which there are so many lines.
    pub(crate) fn seek_to(&mut self, offset: u64, lines: u64) -> io::Result<()> {
        let Some(file) = &mut self.file else { return Err(io::ErrorKind::Unsupported.into()) };
        // Whole blocks are compared. The source has the same position, because it is the same file.
        let inside = offset % BLOCK_BYTES as u64;
        file.seek(SeekFrom::Start(offset - inside))?;
        (self.start, self.end) = (0, 0);
        self.offset = offset - inside;
        self.lines = lines;
        self.ended = false;
        let inside = inside as usize;
        if self.peek(inside)?.len() < inside {
            return Err(io::Error::new(
                io::ErrorKind::UnexpectedEof,
                "the file became shorter; read it again",
            ));
        }
        self.consume(inside);
        Ok(())
    }
}
