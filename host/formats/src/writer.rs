//! Writers of traces, and their options.

use std::io;
use std::time::Duration;

use super::Format;
use super::analyser::TableStyle;
use super::channel_info::ChannelInfo;
use super::left_out::LeftOut;
use super::rotation::Rotation;
use super::zone::Zone;
use cantap_trace::TraceRecord;

/// How to write.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// The format; if not given, determined by the file's suffix, or a candump log for standard output.
    pub format: Option<Format>,
    /// When to begin a new file.
    pub rotation: Rotation,
    /// How the earlier CANanalyser's tables look.
    pub table: TableStyle,
    /// The zone of dates in formats that do not name one.
    pub zone: Zone,
    /// What is known of the channels, for formats that have a place for it. Channels listed here are in the file even if they
    /// carry nothing, as far as the format allows.
    pub channels: Vec<ChannelInfo>,
    /// For anyone who reads while it is written, in formats that have a place for it: [`TraceWriter::flush`] writes the header even
    /// before the first record, and each channel's frames received and lost at this interval.
    pub statistics_every: Option<Duration>,
}

/// Takes records and writes them to a file.
pub trait TraceWriter: Send {
    /// Adds a record. It may stay in a buffer until [`Self::flush`].
    fn write(&mut self, record: &TraceRecord) -> io::Result<()>;

    /// Passes everything to the system: what has been written so far survives a crash of the program, in a
    /// valid file.
    fn flush(&mut self) -> io::Result<()>;

    /// Adds a remark to the next record of a channel, in formats that allow it.
    fn remark(&mut self, _channel: u8, _text: &str) {}

    /// Ends the file and returns what it could not carry.
    fn finish(self: Box<Self>) -> io::Result<LeftOut>;
}
