//! ASAM MDF 4, the format of loggers and measurement programs, as far as it holds the traffic of a bus: the names
//! `CAN_DataFrame`, `CAN_RemoteFrame` and `CAN_ErrorFrame` with their parts, which ASAM's *Bus Logging* gives such records.
//!
//! A file is blocks with links between them, so it is read at any place and not as a stream. Groups sorted and not, data in
//! one block or in lists, compressed by deflate, zstd or LZ4, with rows and columns exchanged or not, bytes in the records or
//! apart, times in another group (the columns of 4.2), files that were not finished: all is read. Measured signals are counted.

mod blocks;
mod decode;
mod encode;
mod layout;
mod record;
mod stream;
#[cfg(test)]
mod tests;

pub(crate) use decode::Decoder;
#[cfg(test)]
pub(crate) use encode::COUNTS_UNTOLD;
pub(crate) use encode::Encoder;

use cantap_wire::record::BusErrorKind;

/// The first bytes of a file, finished or not.
pub(crate) const FILE_MAGIC: &[u8] = b"MDF     ";
pub(crate) const UNFINISHED_MAGIC: &[u8] = b"UnFinMF ";

/// The channel of what the standard has no event for, in the words of [`super::event_text`].
const WORDS: &str = "cantap_Event";

/// Where the first block is.
const HEADER_AT: u64 = 64;

/// The kinds of errors by the standard's numbers. It has one, 1, for bit errors of either direction.
const ERROR_TYPES: [(u64, BusErrorKind); 4] = [
    (2, BusErrorKind::Form),
    (3, BusErrorKind::Stuff),
    (4, BusErrorKind::Crc),
    (5, BusErrorKind::Acknowledgment),
];
const BIT_ERROR: u8 = 1;
