//! What writes a trace, and how it is to be written.

use std::io;

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
}

/// Takes records and makes a file of them.
pub trait TraceWriter: Send {
    /// Adds a record. It may stay in a buffer until [`Self::flush`].
    fn write(&mut self, record: &TraceRecord) -> io::Result<()>;

    /// Hands everything to the system: what was written until now survives a crash of the program,
    /// in a file that is valid.
    fn flush(&mut self) -> io::Result<()>;

    /// Ends the file and says what it could not carry.
    fn finish(self: Box<Self>) -> io::Result<LeftOut>;
}
