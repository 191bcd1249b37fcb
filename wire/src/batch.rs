//! Batches: records packed so that each batch stands alone. Losing one loses its records only, and
//! the next one says exactly how many frames those were.

use serde::{Deserialize, Serialize};

use crate::framing::{CRC_LEN, MAX_MESSAGE, seal};
use crate::message::DeviceMessage;
use crate::{CHANNELS, Channel};

/// Stands in front of a batch's records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BatchHeader {
    /// Counts batches from 0 at `Hello`; wraps.
    pub sequence: u32,
    /// Absolute device time, in ticks, that the first record's time difference is added to.
    pub base_ticks: u64,
    /// Received-frame records in all batches before this one since `Hello`, per channel; wraps. The
    /// host takes from it how many frames went with a lost batch.
    pub frames_before: [u32; CHANNELS],
}

/// Room a header takes at most: message kind, sequence, base, two counts.
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

    /// Starts over at sequence number 0 and drops what was not finished.
    pub fn restart(&mut self) {
        self.len = 0;
        self.header_len = 0;
        self.sequence = 0;
        self.frames = [0; CHANNELS];
    }

    /// Whether no record waits to be sent.
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
        if record.len() > self.room() {
            return false;
        }
        if self.len == 0 {
            let header = BatchHeader { sequence: self.sequence, base_ticks, frames_before: self.frames };
            let message = DeviceMessage::Batch(header);
            // Cannot fail: the buffer is longer than the longest header.
            self.len = postcard::to_slice(&message, &mut self.message).map_or(0, |header| header.len());
            self.header_len = self.len;
        }
        self.message[self.len..self.len + record.len()].copy_from_slice(record);
        self.len += record.len();
        if let Some(channel) = frame_of {
            let frames = &mut self.frames[channel.index()];
            *frames = frames.wrapping_add(1);
        }
        true
    }

    /// Writes the batch, encoded and with its zero byte, into `out` and returns its length; 0 if it
    /// is empty. `out` needs [`crate::framing::MAX_ENCODED`] bytes; with less, the batch stays.
    pub fn finish(&mut self, out: &mut [u8]) -> usize {
        if self.is_empty() {
            return 0;
        }
        let Some(encoded) = seal(&mut self.message, self.len, out) else {
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
