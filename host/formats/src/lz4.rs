//! LZ4 as every version of its program writes it: frames one after another, blocks that depend on those before or not, legacy files, and
//! frames to be skipped. Of a file that ends in the middle of a block, everything that the block's beginning says is read: blocks
//! are 4 MiB by default, which is a drive of minutes.
//!
//! Source: the LZ4 frame format 1.6.4 and the LZ4 block format, in the documentation of the program.

use std::hash::Hasher as _;
use std::io::{self, Read};

use twox_hash::XxHash32;

/// What a frame begins with.
pub(crate) const MAGIC: [u8; 4] = 0x184D_2204_u32.to_le_bytes();
/// What a file of `lz4 -l` and of kernels begins with.
pub(crate) const LEGACY_MAGIC: [u8; 4] = 0x184C_2102_u32.to_le_bytes();

/// How far back a match reaches.
const WINDOW_BYTES: usize = 64 << 10;
/// What a block of a legacy file unpacks to at most.
const LEGACY_BLOCK_BYTES: usize = 8 << 20;

/// Unpacks a file.
pub(crate) struct Unpacker<R> {
    source: R,
    frame: Option<Frame>,
    /// What the last block was; `at` is where it was not handed out yet.
    block: Vec<u8>,
    at: usize,
    /// What comes after the block.
    after: Option<io::Error>,
}

struct Frame {
    is_legacy: bool,
    /// The end of the blocks before, if blocks refer to it.
    window: Option<Vec<u8>>,
    has_block_checksums: bool,
    content: Option<XxHash32>,
    content_len: Option<u64>,
    len: u64,
    max_block: usize,
}

fn damage(what: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

fn checksum(bytes: &[u8]) -> u32 {
    let mut hasher = XxHash32::with_seed(0);
    hasher.write(bytes);
    hasher.finish() as u32
}

impl<R: Read> Unpacker<R> {
    pub(crate) fn new(source: R) -> Self {
        Self { source, frame: None, block: Vec::new(), at: 0, after: None }
    }

    /// As many bytes as there are, at most `len`.
    fn take(&mut self, len: usize) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.source.by_ref().take(len as u64).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    fn exactly<const N: usize>(&mut self) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.source.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// Begins the next frame; false at the end of the file.
    fn begin(&mut self) -> io::Result<bool> {
        let magic = self.take(MAGIC.len())?;
        let Ok(magic) = <[u8; 4]>::try_from(magic.as_slice()) else {
            return if magic.is_empty() { Ok(false) } else { Err(io::ErrorKind::UnexpectedEof.into()) };
        };
        self.begin_with(magic).map(|()| true)
    }

    fn begin_with(&mut self, magic: [u8; 4]) -> io::Result<()> {
        match magic {
            MAGIC => self.frame = Some(self.header()?),
            LEGACY_MAGIC => self.frame = Some(Frame::legacy()),
            _ if is_skipped(magic) => {
                let len = u64::from(u32::from_le_bytes(self.exactly()?));
                let skipped = io::copy(&mut self.source.by_ref().take(len), &mut io::sink())?;
                if skipped < len {
                    return Err(io::ErrorKind::UnexpectedEof.into());
                }
            }
            _ => return Err(damage("what follows a frame of LZ4 is no other frame")),
        }
        Ok(())
    }

    fn header(&mut self) -> io::Result<Frame> {
        let [flags, sizes] = self.exactly()?;
        let is = |bit: u8| flags >> bit & 1 == 1;
        if flags >> 6 != 1 || is(1) || sizes & 0x8F != 0 {
            return Err(damage("the head of a frame of LZ4 is of no known version"));
        }
        let mut header = vec![flags, sizes];
        let content_len = if is(3) {
            let bytes: [u8; 8] = self.exactly()?;
            header.extend(bytes);
            Some(u64::from_le_bytes(bytes))
        } else {
            None
        };
        if is(0) {
            header.extend(self.exactly::<4>()?);
        }
        let [wanted] = self.exactly()?;
        if (checksum(&header) >> 8) as u8 != wanted {
            return Err(damage("the head of a frame of LZ4 does not fit its checksum"));
        }
        if is(0) {
            return Err(damage("it was made with a dictionary of LZ4, and cannot be unpacked without it"));
        }
        let max_block = match sizes >> 4 {
            size @ 4..=7 => 1 << (8 + 2 * size),
            _ => return Err(damage("the blocks of a frame of LZ4 have no known size")),
        };
        Ok(Frame {
            is_legacy: false,
            window: (!is(5)).then(Vec::new),
            has_block_checksums: is(4),
            content: is(2).then(|| XxHash32::with_seed(0)),
            content_len,
            len: 0,
            max_block,
        })
    }

    /// Reads the next block, or the end of a frame; false at the end of the file.
    fn next(&mut self) -> io::Result<bool> {
        let Some(mut frame) = self.frame.take() else { return self.begin() };
        let size = self.take(4)?;
        let Ok(size) = <[u8; 4]>::try_from(size.as_slice()) else {
            // Only a legacy file has no mark at its end.
            let is_end = size.is_empty() && frame.is_legacy;
            return if is_end { Ok(false) } else { Err(io::ErrorKind::UnexpectedEof.into()) };
        };
        if frame.is_legacy && (size == MAGIC || size == LEGACY_MAGIC || is_skipped(size)) {
            return self.begin_with(size).map(|()| true);
        }
        let size = u32::from_le_bytes(size);
        if size == 0 && !frame.is_legacy {
            return self.end(&frame).map(|()| true);
        }
        let is_packed = frame.is_legacy || size >> 31 == 0;
        let size = if frame.is_legacy { size } else { size & 0x7FFF_FFFF } as usize;
        if size > frame.most_packed() {
            return Err(damage("a block of LZ4 is larger than its frame allows"));
        }
        let packed = self.take(size)?;
        if packed.len() < size {
            self.after = Some(io::ErrorKind::UnexpectedEof.into());
        } else if frame.has_block_checksums {
            let wanted = self.take(4)?;
            match <[u8; 4]>::try_from(wanted.as_slice()) {
                Ok(wanted) if u32::from_le_bytes(wanted) != checksum(&packed) => {
                    return Err(damage("a block of LZ4 does not fit its checksum"));
                }
                Ok(_) => {}
                Err(_) => self.after = Some(io::ErrorKind::UnexpectedEof.into()),
            }
        }
        if !is_packed {
            self.block = packed;
        } else if packed.len() < size {
            self.block = beginning(&packed, frame.window.as_deref().unwrap_or_default(), frame.max_block);
        } else {
            self.block.resize(frame.max_block, 0);
            let window = frame.window.as_deref().unwrap_or_default();
            let len = lz4_flex::block::decompress_into_with_dict(&packed, &mut self.block, window);
            self.block.truncate(len.as_ref().map_or(0, |len| *len));
            len.map_err(|_| damage("a block of LZ4 cannot be unpacked"))?;
        }
        frame.push(&self.block);
        self.frame = Some(frame);
        Ok(true)
    }

    /// Checks a frame's content after its end mark.
    fn end(&mut self, frame: &Frame) -> io::Result<()> {
        if let Some(content) = &frame.content
            && u32::from_le_bytes(self.exactly()?) != content.finish() as u32
        {
            return Err(damage("the content of a frame of LZ4 does not fit its checksum"));
        }
        if frame.content_len.is_some_and(|len| len != frame.len) {
            return Err(damage("a frame of LZ4 does not have the length that it says"));
        }
        Ok(())
    }
}

/// Whether a frame is only there to be skipped.
fn is_skipped(magic: [u8; 4]) -> bool {
    u32::from_le_bytes(magic) & 0xFFFF_FFF0 == 0x184D_2A50
}

impl Frame {
    fn legacy() -> Self {
        Self {
            is_legacy: true,
            window: None,
            has_block_checksums: false,
            content: None,
            content_len: None,
            len: 0,
            max_block: LEGACY_BLOCK_BYTES,
        }
    }

    /// The most bytes of a block as it is in the file. What does not get smaller is written as it is, but not in legacy files.
    fn most_packed(&self) -> usize {
        if self.is_legacy { lz4_flex::block::get_maximum_output_size(self.max_block) } else { self.max_block }
    }

    /// Takes note of a block that was unpacked.
    fn push(&mut self, block: &[u8]) {
        self.len += block.len() as u64;
        if let Some(content) = &mut self.content {
            content.write(block);
        }
        if let Some(window) = &mut self.window {
            window.extend_from_slice(&block[block.len().saturating_sub(WINDOW_BYTES)..]);
            window.drain(..window.len().saturating_sub(WINDOW_BYTES));
        }
    }
}

/// What the beginning of a block unpacks to, after the content before it.
fn beginning(packed: &[u8], window: &[u8], max_block: usize) -> Vec<u8> {
    let mut out = window.to_vec();
    let end = window.len() + max_block;
    let mut rest = packed;
    // A length that does not fit the token's four bits goes on in bytes, until one is not 255.
    let length = |short: u8, rest: &mut &[u8]| {
        let mut len = usize::from(short);
        if short == 15 {
            loop {
                let (more, after) = rest.split_first()?;
                *rest = after;
                len += usize::from(*more);
                if *more != u8::MAX {
                    break;
                }
            }
        }
        Some(len)
    };
    while let Some((token, after)) = rest.split_first() {
        rest = after;
        let Some(literals) = length(token >> 4, &mut rest) else { break };
        let there = literals.min(rest.len()).min(end - out.len());
        out.extend_from_slice(&rest[..there]);
        if there < literals {
            break;
        }
        rest = &rest[literals..];
        let Some((offset, after)) = rest.split_first_chunk() else { break };
        rest = after;
        let offset = usize::from(u16::from_le_bytes(*offset));
        let Some(len) = length(token & 15, &mut rest) else { break };
        let Some(from) = out.len().checked_sub(offset).filter(|_| offset > 0) else { break };
        // It may overlap what it makes.
        for at in from..from + (len + MIN_MATCH).min(end - out.len()) {
            out.push(out[at]);
        }
    }
    out.split_off(window.len())
}

/// The length of a match that is written as 0.
const MIN_MATCH: usize = 4;

impl<R: Read> Read for Unpacker<R> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if out.is_empty() {
            return Ok(0);
        }
        while self.at == self.block.len() {
            if let Some(error) = self.after.take() {
                return Err(error);
            }
            self.block.clear();
            self.at = 0;
            if !self.next()? {
                return Ok(0);
            }
        }
        let len = out.len().min(self.block.len() - self.at);
        out[..len].copy_from_slice(&self.block[self.at..self.at + len]);
        self.at += len;
        Ok(len)
    }
}

#[cfg(test)]
mod tests;
