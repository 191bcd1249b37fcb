//! Reading a part of a large file without the rest: an index of places to read on from, made while the file is read.
//!
//! A place is what reading on from there depends on: an offset, a line number and the state of the format's decoder. Between two
//! places, the index says which times there are, and what else a reading says of that part. A part is passed over only if nothing in it is
//! asked for and nothing in it is wrong, so that what is left is what a reading of the whole file gives for these times, whatever their order.
//!
//! An index is about bytes: it has the digest of each block up to its last place. It is used if the system says that the file is the
//! same and has not been written to since ([`identity`]), otherwise after all blocks were compared, and only up to the first that differs. Whatever
//! is read by it is compared once more. What follows the last place, at least the end of the file, is always read.
//!
//! A file that is read at many places (MF4) has no such digests: its index is used only if the system says that the file is the same, before each jump
//! and until the reading ends.

mod blocks;
mod folder;
mod identity;
mod index;
mod indexing;
mod state;
#[cfg(test)]
mod tests;

pub(crate) use blocks::{Blocks, has_changed};
pub use folder::IndexFolder;
pub(crate) use indexing::{Indexing, Passed, Reading};
pub(crate) use state::{load, save};

/// Bytes that have one digest.
pub(crate) const BLOCK_BYTES: usize = if cfg!(test) { 256 } else { 256 * 1024 };

/// Bytes from one place to the next, at least: read in some hundredths of a second.
const STEP_BYTES: u64 = if cfg!(test) { 1024 } else { 2 << 20 };
