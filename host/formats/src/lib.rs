#![doc = include_str!("../README.md")]
//!
//! [`open_reader`] gives an iterator over records and issues, [`create_writer`] a [`TraceWriter`]. The format follows the file's
//! suffix; `-` is standard input or output. Each format is a file here, split into a decoder that takes bytes from an
//! `Input` and an encoder that appends to a buffer; neither knows files, compression or rotation.

#![forbid(unsafe_code)]

mod analyser;
mod asc;
mod blf;
mod calendar;
mod candump;
mod codec;
mod compressed;
mod create;
mod csv;
mod dif;
mod error_frames;
mod event_text;
mod file_writer;
mod format;
mod found;
mod input;
mod interfaces;
mod issue;
mod left_out;
mod line;
mod output;
mod pcapng;
mod reader;
mod rotate;
mod rotation;
mod sja1000;
#[cfg(test)]
mod tests;
mod text;
pub mod time_range;
mod trc;
mod writer;

pub(crate) use analyser::date as date_time_ns;
pub use analyser::{DifConvention, LineEnd, TableStyle};
pub use create::create_writer;
pub use csv::CsvDialect;
pub use format::{Format, UnknownFormat};
pub use issue::{Fault, Place, ReadIssue};
pub use left_out::LeftOut;
pub use reader::{OpenError, ReadOptions, TraceReader, open_reader};
pub use rotation::{BadRotation, RotateAt, Rotation};
pub use trc::TrcVersion;
pub use writer::{TraceWriter, WriteOptions};

/// Seconds with a fraction, as nanoseconds.
pub(crate) fn decimal_seconds_ns(text: &str) -> Option<i64> {
    text::time(text.as_bytes(), text::NS_PER_S, b'.')
}
