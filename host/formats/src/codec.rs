//! The two halves of a format, which know nothing of files or compression: a [`Decode`] takes bytes from an [`Input`],
//! an [`Encode`] appends them to a buffer.

use std::io;

use super::found::Found;
use super::input::Input;
use super::left_out::LeftOut;
use super::mf4::Properties;
use super::output::Patch;
use cantap_trace::{PlainFrame, TraceRecord};

/// Records decoded at a time: few enough to stay in the processor's cache.
pub(crate) const BATCH: usize = if cfg!(test) { 16 } else { 256 };

/// Plain frames decoded at a time: more, because they may go to another thread.
pub(crate) const PLAIN_BATCH: usize = 4096;

/// Of the rows and objects that Vector's programs write before they send a frame.
pub(crate) const REQUESTS_TO_SEND: &str =
    "requests to send were skipped: what was sent is in the trace as sent";

/// LIN events of which a trace has no form: frames are kept.
pub(crate) const OTHER_LIN: &str = "LIN events other than frames";

/// The reading half of a format.
pub(crate) trait Decode: Send {
    /// The next record or issue. Errors are the system's.
    fn next(&mut self, input: &mut Input) -> io::Result<Found>;

    /// Whether [`Self::next`] can return for a single line without waiting for more.
    fn needs_one_line(&self) -> bool {
        true
    }

    /// What the file says about its measurement, once something was read; `None` if the format has nothing of the kind.
    fn properties(&self) -> Option<&Properties> {
        None
    }

    /// Bit rates that the file has said so far, outside CAN FD's data phases: channel from 1, bit/s.
    fn bit_rates(&self) -> &[(u8, u32)] {
        &[]
    }

    /// Between two batches: appends what reading on depends on besides the bytes that follow. False if reading cannot begin here, or nowhere in
    /// files of the format but at their beginning.
    fn save(&self, _state: &mut Vec<u8>) -> bool {
        false
    }

    /// Takes up what [`Self::save`] appended, before anything is read; `None` if that is nonsense.
    fn restore(&mut self, _state: &[u8]) -> Option<()> {
        None
    }

    /// Once records were read: appends what was found out about the whole file that a reading from another place can use. False if there is nothing.
    fn save_layout(&self, _layout: &mut Vec<u8>) -> bool {
        false
    }

    /// What follows is the next of several files of one recording, from its beginning: what was known of the file before is not, but channels stay.
    fn begin_next_file(&mut self) {}

    /// Takes up what [`Self::save_layout`] appended for the same file, before anything is read.
    fn restore_layout(&mut self, _layout: &[u8]) {}

    /// How far the reading has come in a file that is read at many places: it grows with whatever is handed out. `None` if the file is read from its
    /// beginning to its end.
    fn position(&self) -> Option<u64> {
        None
    }

    /// Adds records until it finds something else, which is returned; `None` if there are enough, or if it would have to
    /// wait for more. It is in the trait so that each format's [`Self::next`] is inlined into its own loop.
    fn batch(&mut self, input: &mut Input, records: &mut Vec<TraceRecord>) -> io::Result<Option<Found>> {
        loop {
            match self.next(input)? {
                Found::Record(record) => records.push(record),
                other => return Ok(Some(other)),
            }
            if records.len() >= BATCH || input.may_wait() && !(self.needs_one_line() && input.has_line()) {
                return Ok(None);
            }
        }
    }

    /// Appends the data frames that are next and can be taken out of the file without becoming records in between. Returns whether the
    /// format has such frames at all.
    fn plain_frames(&mut self, _frames: &mut Vec<PlainFrame>) -> io::Result<bool> {
        Ok(false)
    }

    /// As [`Self::batch`], but data frames at its beginning may be in `frames` instead.
    fn mixed(
        &mut self,
        input: &mut Input,
        frames: &mut Vec<PlainFrame>,
        records: &mut Vec<TraceRecord>,
    ) -> io::Result<Option<Found>> {
        if !self.plain_frames(frames)? {
            return self.batch(input, records);
        }
        if !frames.is_empty() {
            return Ok(None);
        }
        // One alone, because plain frames may follow it.
        match self.next(input)? {
            Found::Record(record) => {
                records.push(record);
                Ok(None)
            }
            other => Ok(Some(other)),
        }
    }
}

/// Takes the place of a format that this build leaves out, and returns a system error saying so.
#[cfg(not(all(feature = "parquet", feature = "sqlite")))]
pub(crate) struct Missing(pub &'static str);

#[cfg(not(all(feature = "parquet", feature = "sqlite")))]
impl Decode for Missing {
    fn next(&mut self, _input: &mut Input) -> io::Result<Found> {
        Err(io::Error::new(io::ErrorKind::Unsupported, self.0))
    }
}

/// The writing half of a format: appends to a buffer and knows nothing of files.
pub(crate) trait Encode: Send {
    /// Appends a record, preceded by the file's header the first time.
    fn record(&mut self, record: &TraceRecord, out: &mut Vec<u8>, left_out: &mut LeftOut);

    /// Whether the format can say that a frame's time is only an upper bound.
    fn carries_late(&self) -> bool {
        false
    }

    /// Whether the format can say what was on a LIN bus.
    fn carries_lin(&self) -> bool {
        false
    }

    /// Appends whatever was held back, so that a file ending here is valid.
    fn flush(&mut self, _out: &mut Vec<u8>, _left_out: &mut LeftOut) {}

    /// The most bytes that [`Self::flush`] or [`Self::finish`] would append, if that is a lot.
    fn held_back(&self) -> usize {
        0
    }

    /// Adds a remark to the next record of a channel, if the format allows it.
    fn remark(&mut self, _channel: u8, _text: &str) {}

    /// Appends the file's end. A file without records gets its header here.
    fn finish(&mut self, out: &mut Vec<u8>, left_out: &mut LeftOut);

    /// Appends what is needed for the file to end here: what [`Self::finish`] would append, and what is held back for a
    /// possible next record.
    fn provisional_end(&self, _out: &mut Vec<u8>) {}

    /// Changes to make in bytes already written, after `written` bytes in total.
    fn patch(&self, _written: u64) -> Option<Patch> {
        None
    }

    /// How many of these bytes at the end of the file are whole records.
    fn whole(&self, bytes: &[u8]) -> usize {
        memchr::memrchr(b'\n', bytes).map_or(0, |end| end + 1)
    }
}

/// The line before the first row of a table.
pub(crate) struct HeadLine {
    text: &'static str,
    is_written: bool,
}

impl HeadLine {
    /// Not written yet; `text` has no line end.
    pub(crate) const fn of(text: &'static str) -> Self {
        Self { text, is_written: false }
    }

    /// Writes it, but only once.
    pub(crate) fn write(&mut self, out: &mut Vec<u8>) {
        if !std::mem::replace(&mut self.is_written, true) {
            out.extend_from_slice(self.text.as_bytes());
            out.push(b'\n');
        }
    }
}
