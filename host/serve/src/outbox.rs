//! Queues everything for one client. Adding never blocks; if there is no room, the client loses records, which are
//! counted.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::message::EndReason;
use cantap_wire::{CHANNELS, Channel};

use crate::flow::Flow;
use crate::stream::{ClientId, Counts, Entry, Gap, View, Views, count, shown};
use crate::totals::Totals;

/// Limit for records waiting for a client: six seconds of two saturated channels, in at most 30 MB, which clients share if they wait for
/// the same records.
pub const MOST_RECORDS: usize = 1 << 18;
/// Limit for waiting answers; beyond it, the client's next request is not read.
const MOST_ANSWERS: usize = 64;
/// Records taken for writing at a time.
const TAKEN_RECORDS: usize = 4096;
/// Bytes of a typical large record.
const RECORD_BYTES: u64 = 16;
/// How long a client that closes a channel still gets what is waiting. A line that carries the buses needs milliseconds; on one that does not,
/// the client would wait for as long as the line is behind.
const REST_TIMEOUT: Duration = Duration::from_secs(2);

/// One thing to send to the client.
pub enum Item {
    /// A session begins with this encoded answer, at this time.
    Restart(Vec<u8>, u64),
    /// The client has a channel from here on.
    Attach(Channel, View, u64),
    /// Nothing more follows of the channel. From this moment on, what is still waiting before it is given up.
    Detach(Channel, u64, Instant),
    /// Records.
    Chunk(Arc<[Entry]>),
    /// Records for which there was no room.
    Gap(Gap),
    /// An encoded answer that must not overtake what is in front of it.
    Answer(Vec<u8>),
    /// The session is over.
    Ended(EndReason, u64),
}

/// What to write.
#[derive(Default)]
pub struct Work {
    /// Encoded answers.
    pub answers: Vec<Vec<u8>>,
    /// Too late to send: a channel behind it was closed too long ago.
    pub given_up: Vec<Item>,
    pub items: Vec<Item>,
    /// Nothing more follows.
    pub is_last: bool,
}

#[derive(Default)]
struct Queue {
    answers: VecDeque<Vec<u8>>,
    items: VecDeque<Item>,
    /// Number of records in the items.
    records: usize,
    gap: Option<Gap>,
    flow: Flow,
    /// Frames sent by others among what was given up: only as losses do they count as frames.
    given_up: [u32; CHANNELS],
    /// Nothing more is added.
    is_closed: bool,
    /// Nothing more is taken out.
    is_abandoned: bool,
}

/// The queue for one client.
pub struct Outbox {
    queue: Mutex<Queue>,
    changed: Condvar,
    most_records: usize,
    /// Frames of each channel lost here since the client came.
    lost: [AtomicU64; CHANNELS],
}

impl Outbox {
    pub fn new(most_records: usize) -> Self {
        Self { queue: Mutex::default(), changed: Condvar::new(), most_records, lost: Default::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        // Every holder of the lock leaves the queue consistent.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds records, as far as the client sees them, and counts them for its status. Records for which there is no room are the
    /// client's losses.
    pub fn offer(
        &self,
        chunk: &Arc<[Entry]>,
        client: ClientId,
        views: &Views,
        counts: &mut [Counts; CHANNELS],
    ) {
        let mut queue = self.lock();
        // After a loss, wait for some room before accepting anything: one long gap says the same as many short ones.
        let most = if queue.gap.is_some() { self.most_records / 2 } else { self.most_records };
        let has_room = queue.records + chunk.len() <= most;
        let mut seen = 0;
        for entry in chunk.iter() {
            let Some(record) = shown(entry, client, views) else { continue };
            seen += 1;
            let is_own = entry.owner.is_some_and(|owner| owner.client == client);
            count(counts, &record, is_own);
            if !has_room && let Some(channel) = queue.gap.get_or_insert_default().absorb(entry.ticks, &record)
            {
                self.count_lost(channel);
                if record.received_on().is_some() {
                    continue;
                }
                // The client will count it as both received and lost.
                let frames = &mut counts[channel.index()].frames;
                *frames = frames.wrapping_add(1);
            }
        }
        if has_room && seen > 0 {
            queue.records += chunk.len();
            queue.push(Item::Chunk(Arc::clone(chunk)));
        }
        drop(queue);
        self.changed.notify_all();
    }

    /// Adds something that takes no room.
    pub fn push(&self, item: Item) {
        self.lock().push(item);
        self.changed.notify_all();
    }

    /// Nothing more follows of a channel. What is waiting is sent for [`REST_TIMEOUT`]; the rest is the client's loss.
    pub fn detach(&self, channel: Channel, ticks: u64) {
        self.push(Item::Detach(channel, ticks, Instant::now() + REST_TIMEOUT));
    }

    /// The client has read so many bytes.
    pub fn acknowledge(&self, read: u64) {
        self.lock().flow.acknowledge(read, Instant::now());
        self.changed.notify_all();
    }

    /// So many bytes were written.
    pub fn wrote(&self, len: usize) {
        self.lock().flow.wrote(len, Instant::now());
    }

    /// Whether there is something to write that has to wait until the client has read more.
    pub fn is_held_up(&self) -> bool {
        let queue = self.lock();
        !queue.may_take_items() && !queue.items.is_empty()
    }

    /// Frames of each channel that were given up, beyond those counted when they were put in.
    pub fn give_up(&self, frames: [u32; CHANNELS]) {
        for (sum, frames) in self.lock().given_up.iter_mut().zip(frames) {
            *sum = sum.wrapping_add(frames);
        }
    }

    /// Counts a frame that is not sent to the client.
    pub fn count_lost(&self, channel: Channel) {
        self.lost[channel.index()].fetch_add(1, Ordering::Relaxed);
    }

    /// Adds what was lost here.
    pub fn add_lost(&self, totals: &mut Totals) {
        for (of, lost) in totals.iter_mut().zip(&self.lost) {
            of.lost_host += lost.load(Ordering::Relaxed);
        }
    }

    /// Their sum in this session.
    pub fn given_up(&self) -> [u32; CHANNELS] {
        self.lock().given_up
    }

    /// Begins a session: what is waiting belongs to none.
    pub fn restart(&self, answer: Vec<u8>, ticks: u64) {
        let mut queue = self.lock();
        let is_closed = queue.is_closed;
        let is_abandoned = queue.is_abandoned;
        let flow = std::mem::take(&mut queue.flow);
        *queue = Queue { flow, is_closed, is_abandoned, ..Queue::default() };
        queue.items.push_back(Item::Restart(answer, ticks));
        drop(queue);
        self.changed.notify_all();
    }

    /// Adds an answer. Waits while there are too many. Returns whether anybody takes them.
    pub fn answer(&self, bytes: Vec<u8>) -> bool {
        let full = |queue: &mut Queue| queue.answers.len() >= MOST_ANSWERS && !queue.is_abandoned;
        let waited = self.changed.wait_while(self.lock(), full);
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner);
        queue.answers.push_back(bytes);
        let is_there = !queue.is_abandoned;
        drop(queue);
        self.changed.notify_all();
        is_there
    }

    /// Adds an answer behind everything that waits. Returns whether anybody takes it.
    pub fn answer_in_turn(&self, bytes: Vec<u8>) -> bool {
        let waiting =
            |queue: &Queue| queue.items.iter().filter(|item| matches!(item, Item::Answer(_))).count();
        let full = |queue: &mut Queue| waiting(queue) >= MOST_ANSWERS && !queue.is_abandoned;
        let waited = self.changed.wait_while(self.lock(), full);
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner);
        queue.push(Item::Answer(bytes));
        let is_there = !queue.is_abandoned;
        drop(queue);
        self.changed.notify_all();
        is_there
    }

    /// What to write next, waiting at most `timeout`.
    pub fn take(&self, timeout: Duration) -> Work {
        let idle = |queue: &mut Queue| {
            let nothing = queue.items.is_empty() && queue.gap.is_none() && !queue.is_closed;
            queue.answers.is_empty() && (nothing || !queue.may_take_items())
        };
        let waited = self.changed.wait_timeout_while(self.lock(), timeout, idle);
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        let mut work = Work { answers: queue.answers.drain(..).collect(), ..Work::default() };
        let mut taken = 0;
        for _ in 0..queue.overdue(Instant::now()) {
            let Some(item) = queue.items.pop_front() else { break };
            taken += item.records();
            work.given_up.push(item);
        }
        let most = taken + (queue.room() / RECORD_BYTES).min(TAKEN_RECORDS as u64) as usize;
        while taken < most
            && queue.may_take_items()
            && let Some(item) = queue.items.pop_front()
        {
            taken += item.records();
            work.items.push(item);
        }
        queue.records -= taken;
        if queue.items.is_empty() && queue.may_take_items() {
            work.items.extend(queue.gap.take().map(Item::Gap));
            work.is_last = queue.is_closed;
        }
        drop(queue);
        self.changed.notify_all();
        work
    }

    /// Nothing more is added; what is waiting can still be taken.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Nothing more is taken.
    pub fn abandon(&self) {
        let mut queue = self.lock();
        *queue = Queue { is_closed: true, is_abandoned: true, ..Queue::default() };
        drop(queue);
        self.changed.notify_all();
    }

    /// Whether the connection is over, from either side.
    pub fn is_closed(&self) -> bool {
        self.lock().is_closed
    }
}

impl Item {
    /// Records that it takes room for.
    fn records(&self) -> usize {
        if let Self::Chunk(chunk) = self { chunk.len() } else { 0 }
    }
}

impl Queue {
    /// Bytes that may be sent now. At the end nobody listens any more for what the client has read.
    fn room(&self) -> u64 {
        if self.is_closed { u64::MAX } else { self.flow.room() }
    }

    fn may_take_items(&self) -> bool {
        self.room() >= RECORD_BYTES
    }

    /// How many items stand up to the last channel that was closed too long ago.
    fn overdue(&self, now: Instant) -> usize {
        let is_late = |item: &Item| matches!(item, Item::Detach(_, _, until) if *until <= now);
        self.items.iter().rposition(is_late).map_or(0, |at| at + 1)
    }

    fn push(&mut self, item: Item) {
        if self.is_closed {
            return;
        }
        self.items.extend(self.gap.take().map(Item::Gap));
        self.items.push_back(item);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A client on a slow line still learns that its server has ended.
    #[test]
    fn at_the_end_everything_is_written_however_little_the_client_has_read() {
        let outbox = Outbox::new(1000);
        outbox.acknowledge(0);
        outbox.wrote(1_000_000);
        outbox.push(Item::Ended(EndReason::ServerEnded, 0));
        assert!(outbox.take(Duration::ZERO).items.is_empty() && outbox.is_held_up());
        outbox.close();
        let work = outbox.take(Duration::ZERO);
        assert!(work.items.len() == 1 && work.is_last);
    }

    #[test]
    fn what_waits_in_front_of_a_closed_channel_is_given_up_after_a_while() {
        let outbox = Outbox::new(1000);
        outbox.acknowledge(0);
        outbox.wrote(1_000_000);
        outbox.push(Item::Chunk(Arc::from([])));
        outbox.push(Item::Detach(Channel::Can1, 0, Instant::now() + Duration::from_hours(1)));
        assert!(outbox.take(Duration::ZERO).given_up.is_empty());
        outbox.push(Item::Detach(Channel::Can2, 0, Instant::now()));
        outbox.push(Item::Ended(EndReason::ServerEnded, 0));
        let work = outbox.take(Duration::ZERO);
        assert_eq!((work.given_up.len(), work.items.len()), (3, 0));
    }
}
