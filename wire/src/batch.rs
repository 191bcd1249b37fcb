//! Batches: records packed so that each batch stands alone. Losing one loses only its records, and
//! the next one says exactly how many frames those were.

use crate::framing::{CRC_LEN, MAX_MESSAGE, crc32, seal, seal_with};
use crate::message::{DeviceMessage, EndReason, SessionEnd};
use crate::{CHANNELS, Channel};

pub use crate::message::BatchHeader;

/// The most room that a header takes: message kind, sequence, base, two counts.
const MAX_HEADER: usize = 1 + 5 + 10 + 2 * 5;

/// Packs records into batches. No allocation; about [`MAX_MESSAGE`] bytes of state.
pub struct BatchWriter {
    message: [u8; MAX_MESSAGE + CRC_LEN],
    len: usize,
    header_len: usize,
    sequence: u32,
    frames: [u32; CHANNELS],
}

impl BatchWriter {
    /// A writer whose first batch has sequence number 0.
    pub const fn new() -> Self {
        Self {
            message: [0; MAX_MESSAGE + CRC_LEN],
            len: 0,
            header_len: 0,
            sequence: 0,
            frames: [0; CHANNELS],
        }
    }

    /// Starts again at sequence number 0 and drops an unfinished batch.
    pub fn restart(&mut self) {
        self.len = 0;
        self.header_len = 0;
        self.sequence = 0;
        self.frames = [0; CHANNELS];
    }

    /// Whether no record is waiting to be sent.
    pub const fn is_empty(&self) -> bool {
        self.len == self.header_len
    }

    /// Bytes of records that still fit. Before the first record this leaves room for the header.
    pub const fn room(&self) -> usize {
        MAX_MESSAGE - if self.len == 0 { MAX_HEADER } else { self.len }
    }

    /// Appends one whole encoded record and returns whether it fitted. `base_ticks` is the absolute
    /// time that its time difference is relative to; `frame_of` its channel if it is a received
    /// frame.
    pub fn push(&mut self, record: &[u8], base_ticks: u64, frame_of: Option<Channel>) -> bool {
        let frames = Channel::ALL.map(|channel| u32::from(frame_of == Some(channel)));
        self.append(record, base_ticks, frames)
    }

    /// Appends whole encoded records, as [`Self::push`] would one by one; `frames` says how many of each channel's frames are
    /// among them.
    pub fn append(&mut self, records: &[u8], base_ticks: u64, frames: [u32; CHANNELS]) -> bool {
        if records.len() > self.room() {
            return false;
        }
        if self.len == 0 {
            let header = BatchHeader { sequence: self.sequence, base_ticks, frames_before: self.frames };
            let message = DeviceMessage::Batch(header);
            // Cannot fail: the buffer is longer than the longest header.
            self.len = postcard::to_slice(&message, &mut self.message).map_or(0, |header| header.len());
            self.header_len = self.len;
        }
        self.message[self.len..self.len + records.len()].copy_from_slice(records);
        self.len += records.len();
        for (all, more) in self.frames.iter_mut().zip(frames) {
            *all = all.wrapping_add(more);
        }
        true
    }

    /// Writes the session's end, encoded and with its zero byte, into `out` and returns its length. Call it when the last
    /// batch is finished; `out` as for [`Self::finish`].
    pub fn end(&mut self, reason: EndReason, at_ticks: u64, out: &mut [u8]) -> usize {
        let header =
            BatchHeader { sequence: self.sequence, base_ticks: at_ticks, frames_before: self.frames };
        let message = DeviceMessage::Ended(SessionEnd { reason, header });
        // Cannot fail: the buffer is longer than the longest header.
        let len = postcard::to_slice(&message, &mut self.message).map_or(0, |message| message.len());
        seal(&mut self.message, len, out).unwrap_or(0)
    }

    /// Writes the batch, encoded and with its zero byte, into `out` and returns its length; 0 if it
    /// is empty. `out` needs [`crate::framing::MAX_ENCODED`] bytes; with less, the batch stays.
    pub fn finish(&mut self, out: &mut [u8]) -> usize {
        self.finish_with(out, crc32)
    }

    /// The same, for callers that have a faster way than [`crc32`] to compute a message's CRC.
    pub fn finish_with(&mut self, out: &mut [u8], crc32: impl FnOnce(&[u8]) -> u32) -> usize {
        if self.is_empty() {
            return 0;
        }
        let Some(encoded) = seal_with(&mut self.message, self.len, out, crc32) else {
            return 0;
        };
        self.len = 0;
        self.header_len = 0;
        self.sequence = self.sequence.wrapping_add(1);
        encoded
    }
}

impl Default for BatchWriter {
    fn default() -> Self {
        Self::new()
    }
}
