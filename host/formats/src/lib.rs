#![doc = include_str!("../README.md")]
//!
//! [`open_reader`] gives an iterator over records and issues, [`create_writer`] a [`TraceWriter`]. The format follows the file's
//! suffix; `-` is standard input or output. Each format is a module here, split into a decoder that takes bytes from an `Input`
//! and an encoder that appends to a buffer; neither knows files, compression or rotation.

#![forbid(unsafe_code)]

// What unit tests share with the others calls it by its name.
#[cfg(test)]
extern crate self as cantap_formats;

mod actisense;
mod analyser;
mod archive;
mod asc;
mod battery_emulator;
mod bit_rates;
mod blf;
mod busmaster;
mod calendar;
mod candump;
mod candump_screen;
mod canedge;
mod canhacker;
mod canking;
mod canserver;
mod carbus;
mod carriage_return;
mod channel_info;
mod codec;
mod compressed;
mod compression;
mod content;
mod cores;
mod create;
mod crtd;
mod csv;
mod dif;
mod division;
mod error_frames;
mod esphome;
mod event_text;
mod file_writer;
mod format;
mod format_names;
mod found;
mod frame_fields;
mod gvret;
mod input;
mod interfaces;
mod issue;
mod json;
mod kvaser;
mod labelled;
mod left_out;
mod line;
mod line_clock;
mod lz4;
mod memory_file;
mod mf4;
mod microchip;
mod nmea2000;
mod output;
mod panda;
#[cfg(feature = "parquet")]
mod parquet;
mod pcap;
mod pcapng;
mod printer;
mod read_options;
mod reader;
mod rlog;
mod ros;
mod rotate;
mod rotation;
mod row_format;
mod saleae;
mod seek;
mod sigrok;
mod sja1000;
mod slcan;
mod socketcan_packet;
mod spec;
#[cfg(feature = "sqlite")]
mod sqlite;
mod table;
#[cfg(test)]
mod tests;
mod text;
pub mod time_range;
mod trace_window;
mod trc;
mod unread;
mod usbcan;
mod utf16;
mod whole;
mod writer;
mod zone;
// Where both features are, the library reads.
#[cfg(all(feature = "zstd-in-rust", any(test, not(feature = "zstd"))))]
mod zstd_frames;

pub(crate) use analyser::date as date_time_ns;
pub use analyser::{DifConvention, LineEnd, TableStyle};
pub use archive::ArchiveError;
pub use channel_info::ChannelInfo;
pub use create::{create_stream_writer, create_writer};
pub use csv::CsvDialect;
pub use division::{TimePart, divide};
pub use format::Format;
pub use format_names::{NotWritten, UnknownFormat};
pub use issue::{Fault, Place, ReadIssue};
pub use left_out::LeftOut;
pub use memory_file::MemoryFile;
pub use read_options::ReadOptions;
pub use reader::{NothingRead, OpenError, TraceReader, open_reader, open_source};
pub use rotation::{BadRotation, RotateAt, Rotation};
pub use seek::IndexFolder;
pub use table::{BadColumns, Columns};
pub use trc::TrcVersion;
pub use unread::{Readable, Unread};
pub use writer::{TraceWriter, WriteOptions};
pub use zone::{UnknownZone, Zone};

/// Seconds with a fraction, as nanoseconds.
pub(crate) fn decimal_seconds_ns(text: &str) -> Option<i64> {
    text::time(text.as_bytes(), text::NS_PER_S, b'.')
}
