//! A part of a file that is compressed by itself, read as a stream: of what it says to hold, nothing is believed in advance.

use std::io::{self, Cursor, Read};
use std::sync::{Arc, Mutex, PoisonError};

use super::super::compression::Compression;
use super::super::input::Input;

/// A longer part is not held. Those with pictures have tens of megabytes.
pub(super) const MAX_BYTES: u64 = 256 << 20;

/// The bytes inside such a part.
pub(super) struct Nested {
    pub input: Input,
    crc: Arc<Mutex<flate2::Crc>>,
    expected: Option<u32>,
}

/// Computes the checksum of what is read.
struct Summed {
    source: Box<dyn Read + Send>,
    crc: Arc<Mutex<flate2::Crc>>,
}

impl Read for Summed {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let read = self.source.read(out)?;
        self.crc.lock().unwrap_or_else(PoisonError::into_inner).update(&out[..read]);
        Ok(read)
    }
}

impl Nested {
    /// Unpacks bytes; `expected` is the checksum of what is in them, if there is one.
    pub(super) fn new(
        bytes: Vec<u8>,
        compression: Option<Compression>,
        expected: Option<u32>,
    ) -> io::Result<Self> {
        let source: Box<dyn Read + Send> = match compression {
            Some(compression) => compression.unpack(Cursor::new(bytes))?,
            None => Box::new(Cursor::new(bytes)),
        };
        let crc = Arc::new(Mutex::new(flate2::Crc::new()));
        let input = Input::unpacked(Box::new(Summed { source, crc: Arc::clone(&crc) }));
        Ok(Self { input, crc, expected })
    }

    /// Whether all that was read has the checksum that it should have.
    pub(super) fn is_intact(&self) -> bool {
        let sum = self.crc.lock().unwrap_or_else(PoisonError::into_inner).sum();
        self.expected.is_none_or(|expected| sum == expected)
    }
}

/// So many bytes of the input, and whether that is all of them. `None` if they are more than are held, and skipped.
pub(super) fn part(input: &mut Input, len: u64) -> io::Result<Option<(Vec<u8>, bool)>> {
    let is_held = len <= MAX_BYTES;
    let mut bytes = Vec::new();
    let mut rest = len;
    while rest > 0 {
        let there = input.peek(1)?;
        let used = there.len().min(usize::try_from(rest).unwrap_or(usize::MAX));
        if used == 0 {
            return Ok(is_held.then_some((bytes, false)));
        }
        if is_held {
            bytes.extend_from_slice(&there[..used]);
        }
        input.consume(used);
        rest -= used as u64;
    }
    Ok(is_held.then_some((bytes, true)))
}
