//! ASAM MDF 4, the format of loggers and measurement programs, as far as it holds bus traffic: the names `CAN_DataFrame`,
//! `CAN_RemoteFrame` and `CAN_ErrorFrame` with their parts, which ASAM's *Bus Logging* gives such records.
//!
//! A file consists of linked blocks, so it needs random access and cannot be read as a stream. Supported are sorted and unsorted groups; data in one
//! block or in lists, compressed by deflate, zstd or LZ4, transposed or not; bytes inside or outside the records; times in another group (the columns
//! of 4.2); and unfinished files. Measured signals are counted.

mod apart;
mod blocks;
mod channel;
mod clock;
mod comment;
mod conversion;
mod decode;
mod encode;
mod field;
mod joined;
mod layout;
mod map;
mod order;
mod part;
mod place;
mod plain;
mod record;
mod resume;
mod stream;
#[cfg(test)]
pub(crate) mod tests;
mod unpack;
mod value;

pub(crate) use comment::Properties;
pub(crate) use decode::Decoder;
#[cfg(test)]
pub(crate) use encode::COUNTS_UNTOLD;
pub(crate) use encode::Encoder;

use cantap_can::BusErrorKind;

/// The first bytes of a file, finished or not.
pub(crate) const FILE_MAGIC: &[u8] = b"MDF     ";
pub(crate) const UNFINISHED_MAGIC: &[u8] = b"UnFinMF ";

/// The program that wrote the file, in its head: this library.
const PROGRAM_NAME: [u8; 8] = *b"cantap  ";

/// The channel for events that the standard does not have, in the words of [`super::event_text`].
const WORDS: &str = "cantap_Event";

/// A frame's or event's channel for the device's own time in nanoseconds, which the standard does not have either; 0 if it is unknown.
const DEVICE_TIME: &str = "cantap_DeviceTime";

/// Where the first block is.
const HEADER_AT: u64 = 64;

/// The kinds of errors by the standard's numbers. It has a single one, 1, for bit errors in either direction.
const ERROR_TYPES: [(u64, BusErrorKind); 4] = [
    (2, BusErrorKind::Form),
    (3, BusErrorKind::Stuff),
    (4, BusErrorKind::Crc),
    (5, BusErrorKind::Acknowledgment),
];
const BIT_ERROR: u8 = 1;
