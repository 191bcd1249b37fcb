//! What writes a trace, and how it is to be written.

use std::io;
use std::time::Duration;

use super::Format;
use super::analyser::TableStyle;
use super::left_out::LeftOut;
use super::rotation::Rotation;
use super::zone::Zone;
use cantap_trace::TraceRecord;

/// How to write.
#[derive(Clone, Debug, Default)]
pub struct WriteOptions {
    /// The format; by the file's suffix if not given, and a candump log to standard output.
    pub format: Option<Format>,
    /// When to begin a new file.
    pub rotation: Rotation,
    /// How the earlier CANanalyser's tables look.
    pub table: TableStyle,
    /// The zone of dates in formats that name none.
    pub zone: Zone,
    /// What is known of the channels, for formats that have a place for it. Those that are here are in the file even if they carry
    /// nothing, as far as the format can say so.
    pub channels: Vec<ChannelInfo>,
    /// For somebody who reads while it is written, in formats that have a place for it: [`TraceWriter::flush`] writes the head even
    /// before the first record, and at this interval how many frames each channel has had and lost.
    pub statistics_every: Option<Duration>,
}

/// What is known of a channel before anything is heard on it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChannelInfo {
    /// From 1.
    pub channel: u8,
    /// Of its bus, in bit/s.
    pub bitrate_bps: Option<u32>,
    /// Where it is and how it was opened, in words.
    pub description: String,
}

/// Takes records and makes a file of them.
pub trait TraceWriter: Send {
    /// Adds a record. It may stay in a buffer until [`Self::flush`].
    fn write(&mut self, record: &TraceRecord) -> io::Result<()>;

    /// Hands everything to the system: what was written until now survives a crash of the program,
    /// in a file that is valid.
    fn flush(&mut self) -> io::Result<()>;

    /// Has the next record of a channel say something more, in formats where a record can.
    fn remark(&mut self, _channel: u8, _text: &str) {}

    /// Ends the file and says what it could not carry.
    fn finish(self: Box<Self>) -> io::Result<LeftOut>;
}
