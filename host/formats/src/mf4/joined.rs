//! Files joined to one, such as by `cat`: a second one is not read, but must not be lost in silence.

use std::io;

use super::super::issue::Fault;
use super::super::whole::Whole;
use super::{FILE_MAGIC, HEADER_AT, UNFINISHED_MAGIC};

const HEADER_NAME: &[u8] = b"##HD\0\0\0\0";

/// So many bytes show that a file begins.
pub(super) const BEGIN_BYTES: usize = HEADER_AT as usize + HEADER_NAME.len();

/// Of a file that is searched for another one, so many bytes are looked at in one go.
const PIECE_BYTES: usize = 1 << 20;

/// Where in these bytes another file begins; all of its [`BEGIN_BYTES`] must be in them.
pub(super) fn begin(bytes: &[u8]) -> Option<usize> {
    let headers = memchr::memmem::find_iter(bytes, HEADER_NAME);
    let mut begins = headers.filter_map(|at| at.checked_sub(HEADER_AT as usize));
    begins.find(|at| {
        let id = &bytes[*at..];
        (id.starts_with(FILE_MAGIC) || id.starts_with(UNFINISHED_MAGIC)) && id[8..].starts_with(b"4.")
    })
}

/// Where another file begins behind the last block of the first, which is finished: its blocks follow each other.
pub(super) fn after_blocks(file: &mut Whole) -> io::Result<Option<u64>> {
    let mut at = HEADER_AT;
    while let Ok(head) = file.head(at) {
        let end = at.saturating_add(head.len);
        // Blocks begin at multiples of eight bytes; another file begins anywhere.
        let next = end.next_multiple_of(8);
        if end >= file.len() {
            return Ok(None);
        }
        if next != end && file.head(next).is_err() {
            at = end;
            break;
        }
        at = next;
    }
    while at + (BEGIN_BYTES as u64) < file.len() {
        let bytes = file.read_at(at, PIECE_BYTES)?;
        if let Some(begin) = begin(&bytes) {
            return Ok(Some(at + begin as u64));
        }
        if bytes.len() < PIECE_BYTES {
            break;
        }
        at += (PIECE_BYTES - BEGIN_BYTES) as u64;
    }
    Ok(None)
}

/// What is said about it.
pub(super) fn joined(at: u64) -> Fault {
    Fault::Malformed {
        expected: "the end of the file".into(),
        found: format!(
            "another MDF file behind it, which is not read; `tail -c +{} FILE` gives it alone",
            at + 1
        ),
    }
}
