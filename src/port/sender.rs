//! Packs queued records into batches: walks whole records and keeps the running time, so that every
//! batch carries its own absolute time.

use cantap_wire::CHANNELS;
use cantap_wire::batch::BatchWriter;
use cantap_wire::message::EndReason;
use cantap_wire::record::{self, Outline};

use crate::TICKS_PER_MS;
use crate::bus::queue::Consumer;

/// A batch is sent when it is full, or this long after its first record was added.
const FLUSH_AFTER_TICKS: u32 = TICKS_PER_MS;

/// Turns queued records into batches.
pub struct Sender {
    batch: BatchWriter,
    /// Device time of the last record taken from the queue.
    running_ticks: u64,
    /// When the batch got its first record.
    started: u32,
    /// The next record no longer fits.
    full: bool,
}

impl Sender {
    /// Nothing to send.
    pub const fn new() -> Self {
        Self { batch: BatchWriter::new(), running_ticks: 0, started: 0, full: false }
    }

    /// Starts a session: sequence number 0, and the first record's difference counts from `now`.
    pub fn restart(&mut self, now: u64) {
        self.batch.restart();
        self.running_ticks = now;
        self.full = false;
    }

    /// Takes records from the queue; if a batch is due, writes it to `out`, encoded, and returns its length. `crc32` computes
    /// its CRC.
    pub fn next_batch<const N: usize>(
        &mut self,
        queue: &mut Consumer<'_, N>,
        now: u32,
        out: &mut [u8],
        crc32: impl FnOnce(&[u8]) -> u32,
    ) -> usize {
        // The ring may be read in two pieces, before and after its wrap.
        while !self.full && queue.read(|bytes| self.take(bytes, now)) > 0 {}
        let old = now.wrapping_sub(self.started) >= FLUSH_AFTER_TICKS;
        if !(self.full || old && !self.batch.is_empty()) {
            return 0;
        }
        self.full = false;
        self.batch.finish_with(out, crc32)
    }

    /// Writes the end of the session, which came at `at`, to `out` and returns its length; 0 while there are records still to be
    /// sent before it.
    pub fn end<const N: usize>(
        &mut self,
        queue: &mut Consumer<'_, N>,
        reason: EndReason,
        at: u64,
        out: &mut [u8],
    ) -> usize {
        if self.batch.is_empty() && queue.is_empty() { self.batch.end(reason, at, out) } else { 0 }
    }

    /// Appends whole records until the batch is full and returns their length.
    fn take(&mut self, bytes: &[u8], now: u32) -> usize {
        let room = self.batch.room();
        let mut running_ticks = self.running_ticks;
        let mut frames = [0; CHANNELS];
        let mut rest = bytes;
        while !rest.is_empty() {
            let Ok(Outline { len, ticks, frame_of }) = record::outline(rest) else {
                // Cannot happen, since the recorder wrote the record; if it did, the rest could not be read either.
                return bytes.len();
            };
            if bytes.len() - rest.len() + len > room {
                self.full = true;
                break;
            }
            if let Some(channel) = frame_of {
                frames[channel.index()] += 1;
            }
            running_ticks = running_ticks.wrapping_add_signed(ticks);
            rest = &rest[len..];
        }
        let taken = bytes.len() - rest.len();
        if taken > 0 {
            if self.batch.is_empty() {
                self.started = now;
            }
            // It fits: it is no more than there was room for.
            self.batch.append(&bytes[..taken], self.running_ticks, frames);
            self.running_ticks = running_ticks;
        }
        taken
    }
}

impl Default for Sender {
    fn default() -> Self {
        Self::new()
    }
}
