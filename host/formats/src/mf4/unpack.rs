//! Compressed blocks of data, unpacked by all cores: each block stands on its own.

use std::io::Read;
use std::sync::Mutex;

use cantap_trace::counted;
use flate2::{Decompress, FlushDecompress, Status};
use serde::{Deserialize, Serialize};

use super::super::compression;
use super::super::cores;
use super::super::issue::Fault;
use super::super::whole::Whole;

/// How a block is compressed.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct Packed {
    /// Bytes in the file.
    pub stored: u64,
    /// 0 deflate, 2 zstd, 4 LZ4; the odd numbers are the same, transposed.
    pub kind: u8,
    /// Number of columns if transposed.
    pub columns: u32,
}

/// A compressed block: where it is in the file, how long its content is, and how it is compressed.
pub(super) type PackedBlock = (u64, u64, Packed);

/// Blocks are unpacked ahead only as far as they have at most this many bytes together.
const MOST_AHEAD_BYTES: u64 = 32 << 20;

/// Unpacks the blocks of a stream, those that come next at the same time.
#[derive(Default)]
pub(super) struct Unpacker {
    /// By their places in the stream's list of pieces; the next one first.
    ahead: Vec<(usize, Result<Vec<u8>, Fault>)>,
    /// The piece that follows the last one. Whoever reads in order wants it next.
    next: usize,
}

impl Unpacker {
    /// The content of the block that is this piece of the stream. `block` is asked for those behind it.
    pub(super) fn take(
        &mut self,
        file: &mut Whole,
        index: usize,
        block: impl Fn(usize) -> Option<PackedBlock>,
    ) -> Result<Vec<u8>, Fault> {
        let is_in_order = index == self.next;
        self.next = index + 1;
        if let Some(place) = self.ahead.iter().position(|(known, _)| *known == index) {
            return self.ahead.swap_remove(place).1;
        }
        self.ahead.clear();
        let most = if is_in_order { cores::count() } else { 1 };
        let mut stored = Vec::with_capacity(most);
        let mut bytes = 0;
        for index in index..index + most {
            let Some((at, len, packed)) = block(index) else { break };
            bytes += len;
            if !stored.is_empty() && bytes > MOST_AHEAD_BYTES {
                break;
            }
            stored.push((index, at, len, packed, file.read_at(at, packed.stored as usize)?));
        }
        let unpacked = Mutex::new(Vec::with_capacity(stored.len()));
        cores::each(stored, |(index, at, len, packed, stored)| {
            let block = unpack(&stored, at, len, packed);
            unpacked.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((index, block));
        });
        self.ahead = unpacked.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        let first = self.ahead.iter().position(|(known, _)| *known == index);
        first.map_or_else(|| Ok(Vec::new()), |place| self.ahead.swap_remove(place).1)
    }
}

/// Decompresses a whole block, which stands at `at` in the file.
fn unpack(stored: &[u8], at: u64, len: u64, packed: Packed) -> Result<Vec<u8>, Fault> {
    let len = len as usize;
    let (bytes, is_whole) = match packed.kind & !1 {
        0 => inflate(stored, len),
        2 => read_whole(compression::unpack_zstd(stored)?, stored.len(), len),
        _ => read_whole(lz4_flex::frame::FrameDecoder::new(stored), stored.len(), len),
    };
    if !is_whole || bytes.len() != len {
        let found = format!("{} of {len}", bytes.len(), len = counted(len, "byte"));
        let expected = format!("compressed data at {at:#x}");
        return Err(Fault::malformed(expected, found.as_bytes()));
    }
    let columns = packed.columns as usize;
    Ok(if packed.kind & 1 == 1 && columns > 1 { exchange(&bytes, columns) } else { bytes })
}

/// What a block may be made room for at first: its length may be damaged.
fn likely(stored: usize, len: usize) -> usize {
    len.min(stored.saturating_mul(64))
}

/// The bytes of a zlib stream, one more than `len` if there are more; and whether it is whole.
fn inflate(stored: &[u8], len: usize) -> (Vec<u8>, bool) {
    let mut decompressor = Decompress::new(true);
    let mut bytes = Vec::with_capacity(likely(stored.len(), len) + 1);
    loop {
        let (used, before) = (decompressor.total_in() as usize, bytes.len());
        let rest = stored.get(used..).unwrap_or_default();
        match decompressor.decompress_vec(rest, &mut bytes, FlushDecompress::Finish) {
            Ok(Status::StreamEnd) => return (bytes, true),
            // There was not enough room.
            Ok(_) if bytes.len() == bytes.capacity() && bytes.len() <= len => {
                bytes.reserve((bytes.len()).min(len + 1 - bytes.len()).max(1));
            }
            Ok(_) if bytes.len() > before && bytes.len() <= len => {}
            _ => return (bytes, false),
        }
    }
}

fn read_whole(source: impl Read, stored: usize, len: usize) -> (Vec<u8>, bool) {
    let mut bytes = Vec::with_capacity(likely(stored, len));
    let is_whole = source.take(len as u64 + 1).read_to_end(&mut bytes).is_ok();
    (bytes, is_whole)
}

/// Turns columns one after another into rows. What is left of an incomplete row stays unchanged at the end.
fn exchange(columns_first: &[u8], columns: usize) -> Vec<u8> {
    /// So many rows at a time stay in the processor's cache until each of them is complete.
    const ROWS: usize = 256;
    let rows = columns_first.len() / columns;
    let mut bytes = columns_first.to_vec();
    if rows == 0 {
        return bytes;
    }
    for (at, block) in bytes[..rows * columns].chunks_mut(ROWS * columns).enumerate() {
        let first = at * ROWS;
        let count = block.len() / columns;
        for (column, values) in columns_first[..rows * columns].chunks_exact(rows).enumerate() {
            for (row, value) in block.chunks_exact_mut(columns).zip(&values[first..first + count]) {
                row[column] = *value;
            }
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_become_rows_and_an_incomplete_row_stays_at_the_end() {
        for (len, columns) in [(0, 3), (2, 3), (3, 3), (10, 3), (256 * 7, 7), (257 * 7 + 5, 7), (1000, 1000)]
        {
            let rows = len / columns;
            let columns_first: Vec<u8> = (0..len).map(|at| (at * 31 + at / 256) as u8).collect();
            let bytes = exchange(&columns_first, columns);
            for row in 0..rows {
                for column in 0..columns {
                    assert_eq!(bytes[row * columns + column], columns_first[column * rows + row]);
                }
            }
            assert_eq!(bytes[rows * columns..], columns_first[rows * columns..]);
        }
    }
}
