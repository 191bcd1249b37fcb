//! Queues everything for one client. Adding never blocks; if there is no room, the client loses records, which are
//! counted.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cantap_wire::message::EndReason;
use cantap_wire::{CHANNELS, Channel};

use crate::stream::{ClientId, Counts, Entry, Gap, View, Views, count, shown};

/// Limit for records waiting for a client: six seconds of two saturated channels, in at most 15 MB, which clients share if they wait for
/// the same records.
pub const MOST_RECORDS: usize = 1 << 18;
/// Limit for waiting answers; beyond it, the client's next request is not read.
const MOST_ANSWERS: usize = 64;
/// Records taken for writing at a time.
const TAKEN_RECORDS: usize = 4096;

/// One thing to send to the client.
pub enum Item {
    /// A session begins with this encoded answer, at this time.
    Restart(Vec<u8>, u64),
    /// The client has a channel from here on.
    Attach(Channel, View, u64),
    /// Nothing more follows of the channel.
    Detach(Channel, u64),
    /// Records.
    Chunk(Arc<[Entry]>),
    /// Records for which there was no room.
    Gap(Gap),
    /// The session is over.
    Ended(EndReason, u64),
}

/// What to write.
#[derive(Default)]
pub struct Work {
    /// Encoded answers.
    pub answers: Vec<Vec<u8>>,
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
}

impl Outbox {
    pub fn new(most_records: usize) -> Self {
        Self { queue: Mutex::default(), changed: Condvar::new(), most_records }
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
            if !has_room
                && let Some(channel) = queue.gap.get_or_insert_default().absorb(entry.ticks, &record)
                && !matches!(record, cantap_wire::record::Record::Received(_))
            {
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

    /// Begins a session: what is waiting belongs to none.
    pub fn restart(&self, answer: Vec<u8>, ticks: u64) {
        let mut queue = self.lock();
        let is_closed = queue.is_closed;
        let is_abandoned = queue.is_abandoned;
        *queue = Queue { is_closed, is_abandoned, ..Queue::default() };
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

    /// What to write next, waiting at most `timeout`.
    pub fn take(&self, timeout: Duration) -> Work {
        let idle = |queue: &mut Queue| {
            queue.answers.is_empty() && queue.items.is_empty() && queue.gap.is_none() && !queue.is_closed
        };
        let waited = self.changed.wait_timeout_while(self.lock(), timeout, idle);
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        let mut work = Work { answers: queue.answers.drain(..).collect(), ..Work::default() };
        let mut taken = 0;
        while taken < TAKEN_RECORDS
            && let Some(item) = queue.items.pop_front()
        {
            if let Item::Chunk(chunk) = &item {
                taken += chunk.len();
            }
            work.items.push(item);
        }
        queue.records -= taken;
        if queue.items.is_empty() {
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

impl Queue {
    fn push(&mut self, item: Item) {
        if self.is_closed {
            return;
        }
        self.items.extend(self.gap.take().map(Item::Gap));
        self.items.push_back(item);
    }
}
