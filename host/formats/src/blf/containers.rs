//! Containers, unpacked by all cores before they are needed: each stands on its own.

use std::sync::{Mutex, PoisonError};

use flate2::{Decompress, FlushDecompress, Status};

use super::super::cores;
use super::object::{u16_at, u32_at};
use super::{BASE_HEADER_BYTES, COMPRESSION_ZLIB, CONTAINER_FIELDS_BYTES, LOG_CONTAINER, OBJECT_MAGIC};

/// How many bytes of the file are looked at for containers at a time.
pub(super) const AHEAD_BYTES: usize = 1 << 20;

/// How many bytes they may have together when unpacked: other containers are unpacked when it is their turn.
const MOST_UNPACKED_BYTES: usize = 8 << 20;

/// Containers that have been unpacked.
#[derive(Default)]
pub(super) struct Containers {
    /// By their offsets in the file. Only undamaged ones, of just the length that they say.
    ready: Vec<(u64, Vec<u8>)>,
    /// Those before this offset have been looked at.
    until: u64,
}

impl Containers {
    /// Whether it is time to unpack those from here on.
    pub(super) fn is_due(&self, offset: u64) -> bool {
        offset >= self.until && cores::count() > 1
    }

    /// Unpacks those at the beginning of `bytes`, which stand at `offset` in the file.
    pub(super) fn unpack(&mut self, bytes: &[u8], offset: u64) {
        let (mut at, mut unpacked_bytes) = (0, 0);
        let mut found = Vec::new();
        while let Some((len, data, unpacked)) = bytes.get(at..).and_then(container) {
            unpacked_bytes += unpacked;
            if unpacked_bytes > MOST_UNPACKED_BYTES {
                break;
            }
            found.push((offset + at as u64, data, unpacked));
            // Objects are filled up to four bytes.
            at += len;
            at += bytes[at..].iter().take(3).take_while(|byte| **byte == 0).count();
        }
        // Where there is none, there will hardly be one right behind it.
        self.until = offset + if found.is_empty() { AHEAD_BYTES } else { at } as u64;
        let ready = Mutex::new(std::mem::take(&mut self.ready));
        let lock = || ready.lock().unwrap_or_else(PoisonError::into_inner);
        lock().clear();
        cores::each(found, |(offset, data, len)| {
            if let Some(objects) = inflate(data, len) {
                lock().push((offset, objects));
            }
        });
        self.ready = ready.into_inner().unwrap_or_else(PoisonError::into_inner);
    }

    /// The objects of the container at this offset, if it has been unpacked.
    pub(super) fn take(&mut self, offset: u64) -> Option<Vec<u8>> {
        let place = self.ready.iter().position(|(known, _)| *known == offset)?;
        Some(self.ready.swap_remove(place).1)
    }
}

/// The whole compressed container that these bytes begin with: its length, its compressed bytes, and the length of its objects.
fn container(bytes: &[u8]) -> Option<(usize, &[u8], usize)> {
    let head = bytes.get(..BASE_HEADER_BYTES + CONTAINER_FIELDS_BYTES)?;
    let len = u32_at(head, 8) as usize;
    let is_packed = head.starts_with(OBJECT_MAGIC)
        && u32_at(head, 12) == LOG_CONTAINER
        && u16_at(head, BASE_HEADER_BYTES) == COMPRESSION_ZLIB;
    let data = bytes.get(head.len()..len).filter(|_| is_packed)?;
    Some((len, data, u32_at(head, BASE_HEADER_BYTES + 8) as usize))
}

/// The bytes of a zlib stream that has exactly so many.
fn inflate(data: &[u8], len: usize) -> Option<Vec<u8>> {
    // In one step, for which there must be room to see that nothing follows.
    let mut objects = Vec::with_capacity(len.checked_add(1)?);
    let status = Decompress::new(true).decompress_vec(data, &mut objects, FlushDecompress::Finish);
    (matches!(status, Ok(Status::StreamEnd)) && objects.len() == len).then_some(objects)
}
