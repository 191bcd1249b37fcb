//! The record queue between the tasks of priority 4 and USB: a lock-free byte ring that knows how
//! full it is. Records are whole and contiguous in it.

use core::sync::atomic::{AtomicU32, Ordering};

use bbqueue::nicknames::Churrasco;
use bbqueue::prod_cons::stream::{StreamConsumer, StreamProducer};
use cantap_wire::Received;
use cantap_wire::record::{MAX_FD_RECORD, MAX_RECORD, encode_received};

use crate::QUEUE_BYTES;

/// Bytes that frames must leave free, so that the records that explain their absence (loss, state, stop) still
/// fit.
const RESERVE: u32 = 512;
/// Once the queue has been full, frames are accepted again only when this much is free: one long gap
/// says the same as hundreds of short ones, in fewer bytes.
const RESUME_FREE: u32 = 4096;

/// The ring.
pub struct RecordQueue<const N: usize = QUEUE_BYTES> {
    ring: Churrasco<N>,
    /// Bytes ever released by the consumer; wraps.
    released: AtomicU32,
}

impl<const N: usize> RecordQueue<N> {
    /// An empty queue.
    pub const fn new() -> Self {
        const { assert!(N > 2 * RESUME_FREE as usize) };
        Self { ring: Churrasco::new(), released: AtomicU32::new(0) }
    }

    /// Its two ends. There must be only one of each.
    pub const fn split(&self) -> (Producer<'_, N>, Consumer<'_, N>) {
        let producer = Producer {
            queue: self,
            ring: self.ring.stream_producer(),
            written: 0,
            high_water: 0,
            full: false,
        };
        (producer, Consumer { queue: self, ring: self.ring.stream_consumer() })
    }
}

impl<const N: usize> Default for RecordQueue<N> {
    fn default() -> Self {
        Self::new()
    }
}

/// The interrupts' end.
pub struct Producer<'q, const N: usize> {
    queue: &'q RecordQueue<N>,
    ring: StreamProducer<&'q Churrasco<N>>,
    written: u32,
    high_water: u32,
    full: bool,
}

impl<const N: usize> Producer<'_, N> {
    /// Bytes in the queue.
    pub fn fill(&self) -> u32 {
        self.written.wrapping_sub(self.queue.released.load(Ordering::Acquire))
    }

    /// Most bytes ever in the queue since [`Self::reset_high_water`].
    pub const fn high_water(&self) -> u32 {
        self.high_water
    }

    /// Starts the high-water mark over.
    pub fn reset_high_water(&mut self) {
        self.high_water = self.fill();
    }

    /// Whether a frame would be accepted now. After the queue was full, only once `RESUME_FREE` bytes are
    /// free.
    #[inline]
    pub fn takes_frames(&mut self) -> bool {
        self.has_room_beside(self.fill())
    }

    #[inline]
    fn has_room_beside(&mut self, fill: u32) -> bool {
        let free = (N as u32).saturating_sub(fill);
        self.full = free < if self.full { RESUME_FREE } else { RESERVE };
        !self.full
    }

    /// Writes a received frame in place. Returns false if the queue is full.
    #[inline(always)]
    #[expect(clippy::inline_always, reason = "measured, as for `Recorder::frame`")]
    pub fn push_frame(&mut self, received: &Received, ticks: i64) -> bool {
        let fill = self.fill();
        if !self.has_room_beside(fill) {
            return false;
        }
        let Ok(mut grant) = self.ring.grant_exact(MAX_RECORD) else {
            self.full = true;
            return false;
        };
        let Some(room) = grant.first_chunk_mut::<MAX_RECORD>() else { return false };
        let len = encode_received(received, ticks, room);
        grant.commit(len);
        self.has_written(fill, len as u32);
        true
    }

    /// Lets `encode` write the record of a CAN FD frame, which no controller of a board receives or sends; that of a sent one may use the
    /// reserve. Returns false if there is no room.
    pub fn push_fd(
        &mut self,
        in_reserve: bool,
        encode: impl FnOnce(&mut [u8; MAX_FD_RECORD]) -> usize,
    ) -> bool {
        let fill = self.fill();
        if !in_reserve && !self.has_room_beside(fill) {
            return false;
        }
        let Ok(mut grant) = self.ring.grant_exact(MAX_FD_RECORD) else {
            self.full |= !in_reserve;
            return false;
        };
        let Some(room) = grant.first_chunk_mut::<MAX_FD_RECORD>() else { return false };
        let len = encode(room);
        grant.commit(len);
        self.has_written(fill, len as u32);
        true
    }

    /// Lets `encode` write one record of anything else in place, which may use the reserve. Returns false, without calling it, if there is
    /// no room.
    #[inline]
    pub fn push_event(&mut self, encode: impl FnOnce(&mut [u8; MAX_RECORD]) -> usize) -> bool {
        let fill = self.fill();
        let Ok(mut grant) = self.ring.grant_exact(MAX_RECORD) else { return false };
        let Some(room) = grant.first_chunk_mut::<MAX_RECORD>() else { return false };
        let len = encode(room);
        grant.commit(len);
        self.has_written(fill, len as u32);
        true
    }

    #[inline]
    fn has_written(&mut self, fill: u32, len: u32) {
        self.written = self.written.wrapping_add(len);
        // The reader may have taken some since then: reading its position once per record is enough.
        self.high_water = self.high_water.max(fill + len);
    }
}

/// USB's end.
pub struct Consumer<'q, const N: usize> {
    queue: &'q RecordQueue<N>,
    ring: StreamConsumer<&'q Churrasco<N>>,
}

impl<const N: usize> Consumer<'_, N> {
    /// Passes `take` the contiguous bytes available, which are whole records; `take` returns how many it used.
    pub fn read(&mut self, take: impl FnOnce(&[u8]) -> usize) -> usize {
        let Ok(grant) = self.ring.read() else { return 0 };
        let used = take(&grant).min(grant.len());
        grant.release(used);
        self.queue.released.fetch_add(used as u32, Ordering::Release);
        used
    }

    /// Whether the queue is empty.
    pub fn is_empty(&mut self) -> bool {
        self.ring.read().is_err()
    }

    /// Drops everything. Nothing may be pushed at the same time.
    pub fn clear(&mut self) {
        while self.read(<[u8]>::len) > 0 {}
    }
}
