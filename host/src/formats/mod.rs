//! Trace files: every format read and written as a stream, with memory that does not grow with the
//! file.
//!
//! [`open_reader`] gives an iterator over records and issues; [`create_writer`] a [`TraceWriter`].
//! The format follows the file's suffix, `.gz` and `.zst` are transparent, `-` is standard input
//! or output. Each format is a file here, split into a decoder that takes bytes from an
//! `Input` and an encoder that appends to a buffer; neither knows files, compression or rotation.

mod analyser;
mod asc;
mod blf;
mod calendar;
mod candump;
mod compressed;
mod csv;
mod dif;
mod error_frames;
mod event_text;
mod format;
mod input;
mod interfaces;
mod issue;
mod line;
mod output;
mod pcapng;
mod reader;
mod rotate;
mod sja1000;
#[cfg(test)]
mod tests;
mod text;
mod trc;
mod writer;

pub(crate) use analyser::date as date_time_ns;
pub use analyser::{DifConvention, LineEnd, TableStyle};
pub use csv::CsvDialect;
pub use format::{Format, UnknownFormat};
pub use issue::{Fault, Place, ReadIssue};
pub use reader::{OpenError, ReadOptions, TraceReader, open_reader};
pub use rotate::{BadRotation, RotateAt, Rotation};
pub use trc::TrcVersion;
pub use writer::{LeftOut, TraceWriter, WriteOptions, create_writer};

/// Seconds with a fraction, as nanoseconds.
pub(crate) fn decimal_seconds_ns(text: &str) -> Option<i64> {
    text::time(text.as_bytes(), text::NS_PER_S, b'.')
}
