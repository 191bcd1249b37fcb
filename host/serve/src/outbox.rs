//! What waits for one client. Whoever puts something in never waits; where there is no room, the client loses, counted.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::message::EndReason;
use cantap_wire::{CHANNELS, Channel};

use crate::flow::Flow;
use crate::stream::{ClientId, Counts, Entry, Gap, View, Views, count, shown};

/// Records that wait for a client at most: six seconds of two saturated channels, in at most 15 MB, which all clients share as far as they
/// wait for the same.
pub const MOST_RECORDS: usize = 1 << 18;
/// Answers that wait at most; with more, the client's next request is not read.
const MOST_ANSWERS: usize = 64;
/// Taken to be written at a time.
const TAKEN_RECORDS: usize = 4096;
/// Bytes that a record takes at most, most of the time.
const RECORD_BYTES: u64 = 16;
/// Whoever closes a channel is given what waits for him for so long. A line that carries the buses needs milliseconds; one that does not would
/// have him wait for as long as it is behind.
const REST_TIMEOUT: Duration = Duration::from_secs(2);

/// One thing to tell the client.
pub enum Item {
    /// A session begins with this answer, encoded, at this time.
    Restart(Vec<u8>, u64),
    /// A channel is the client's from here on.
    Attach(Channel, View, u64),
    /// Nothing of the channel follows, and from the moment on what waits before it is not sent any more.
    Detach(Channel, u64, Instant),
    /// Records.
    Chunk(Arc<[Entry]>),
    /// Records that there was no room for.
    Gap(Gap),
    /// The session is over.
    Ended(EndReason, u64),
}

/// What there is to write.
#[derive(Default)]
pub struct Work {
    /// Encoded.
    pub answers: Vec<Vec<u8>>,
    /// Too late to be sent: a channel was closed behind it.
    pub given_up: Vec<Item>,
    pub items: Vec<Item>,
    /// Nothing follows.
    pub is_last: bool,
}

#[derive(Default)]
struct Queue {
    answers: VecDeque<Vec<u8>>,
    items: VecDeque<Item>,
    /// Records in the items.
    records: usize,
    gap: Option<Gap>,
    flow: Flow,
    /// Sent frames of others among what was given up, which count as frames only then.
    given_up: [u32; CHANNELS],
    /// Nothing more is put in.
    is_closed: bool,
    /// Nobody takes anything out any more.
    is_abandoned: bool,
}

/// What waits for one client.
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
        // Every holder leaves the queue whole.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Puts records in, as far as the client sees them, and counts them for its status. It may have no room: then they are its losses.
    pub fn offer(
        &self,
        chunk: &Arc<[Entry]>,
        client: ClientId,
        views: &Views,
        counts: &mut [Counts; CHANNELS],
    ) {
        let mut queue = self.lock();
        // After a loss there has to be some room before anything is taken: one long gap says the same as many short ones.
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
                // The client will count it among what arrived and was lost.
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

    /// Puts something in that takes no room.
    pub fn push(&self, item: Item) {
        self.lock().push(item);
        self.changed.notify_all();
    }

    /// Nothing of a channel follows. What waits is sent for [`REST_TIMEOUT`]; then the rest of it is the client's loss.
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

    /// Their sum in this session.
    pub fn given_up(&self) -> [u32; CHANNELS] {
        self.lock().given_up
    }

    /// Begins a session: what waits belongs to none.
    pub fn restart(&self, answer: Vec<u8>, ticks: u64) {
        let mut queue = self.lock();
        let is_closed = queue.is_closed;
        let is_abandoned = queue.is_abandoned;
        let flow = std::mem::take(&mut queue.flow);
        *queue = Queue { is_closed, is_abandoned, flow, ..Queue::default() };
        queue.items.push_back(Item::Restart(answer, ticks));
        drop(queue);
        self.changed.notify_all();
    }

    /// Puts an answer in. Waits while too many are there. Returns whether anybody takes them.
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

    /// What there is to write next, waited for at most `timeout`.
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
        let most = taken + (queue.flow.room() / RECORD_BYTES).min(TAKEN_RECORDS as u64) as usize;
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

    /// Nothing more is put in; what waits can still be taken.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_all();
    }

    /// Nobody takes anything any more.
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
    /// Whether what waits may go on its way. At the end nobody says any more what has arrived.
    fn may_take_items(&self) -> bool {
        self.is_closed || self.flow.room() >= RECORD_BYTES
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
