//! What is in a container, and where the next object begins after damage.

use std::io;

use flate2::{Decompress, FlushDecompress, Status};

use super::super::input::{Input, MAX_ITEM_BYTES};
use super::OBJECT_MAGIC;

/// Skips to the next LOBJ in the file, or to its end.
pub(super) fn skip_to_object(input: &mut Input) -> io::Result<()> {
    loop {
        let bytes = input.peek(OBJECT_MAGIC.len())?;
        if bytes.len() < OBJECT_MAGIC.len() {
            let rest = bytes.len();
            input.consume(rest);
            return Ok(());
        }
        if let Some(at) = memchr::memmem::find(bytes, OBJECT_MAGIC) {
            input.consume(at);
            return Ok(());
        }
        let searched = bytes.len() + 1 - OBJECT_MAGIC.len();
        input.consume(searched);
    }
}

/// Appends the decompressed content of a zlib stream; false if it is damaged, cut or implausibly large.
pub(super) fn inflate(
    decompressor: &mut Decompress,
    mut data: &[u8],
    expected_len: usize,
    out: &mut Vec<u8>,
) -> bool {
    const STEP_BYTES: usize = 256 * 1024;
    let limit = out.len() + MAX_ITEM_BYTES;
    decompressor.reset(true);
    out.reserve(expected_len.min(MAX_ITEM_BYTES));
    loop {
        let (before_in, before_out) = (decompressor.total_in(), decompressor.total_out());
        let status = decompressor.decompress_vec(data, out, FlushDecompress::None);
        let used = (decompressor.total_in() - before_in) as usize;
        data = &data[used..];
        match status {
            Ok(Status::StreamEnd) => return true,
            Ok(_) if out.len() == out.capacity() && out.len() < limit => out.reserve(STEP_BYTES),
            Ok(_) if used > 0 || decompressor.total_out() > before_out => {
                if out.len() >= limit {
                    return false;
                }
            }
            _ => return false,
        }
    }
}
