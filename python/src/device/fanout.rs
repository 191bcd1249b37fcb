//! Distributes one device's records to several listeners.
//!
//! A thread without Python takes them from the device and gives each listener its own copy. A listener that does not keep up loses
//! records: they are counted, and a loss takes their place.

use std::collections::HashMap;
use std::io::{self, PipeReader, PipeWriter, Read, Write};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use cantap::device::{Buffer, Records, Transmission};
use cantap::wire::{CHANNELS, Channel};
use cantap::{Direction, TraceEvent, TraceRecord};
use cantap_trace::filter::Filter;

/// How often to check whether to go on.
pub const LOOK_EVERY: Duration = Duration::from_millis(100);

/// What a listener wants to receive.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// Only this channel, from 1.
    pub channel: Option<u8>,
    /// Only these frames; a frame need match only one of several.
    pub filters: Vec<Filter>,
    /// Not the frames sent by this device.
    pub only_received: bool,
}

impl Wanted {
    fn accepts(&self, record: &TraceRecord) -> bool {
        let is_sent = matches!(record.event, TraceEvent::Frame { direction: Direction::Tx, .. });
        (self.channel.is_none() || self.channel == Some(record.channel))
            && !(self.only_received && is_sent)
            && passes(&self.filters, record)
    }
}

/// Whether one of the filters accepts a record; without filters all are accepted.
fn passes(filters: &[Filter], record: &TraceRecord) -> bool {
    filters.is_empty() || filters.iter().any(|filter| filter.accepts(record))
}

pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A listener.
pub struct Listener {
    buffer: Buffer,
    wanted: Mutex<Wanted>,
    /// Readable while something is waiting; created on demand.
    signal: Mutex<Option<Signal>>,
    lost: Mutex<[u64; CHANNELS]>,
    failure: Mutex<Option<String>>,
}

/// A pipe with at most one byte in it.
struct Signal {
    reader: PipeReader,
    writer: PipeWriter,
    is_set: bool,
}

impl Signal {
    fn set(&mut self) {
        if !self.is_set {
            // One byte always fits.
            self.is_set = self.writer.write_all(&[1]).is_ok();
        }
    }

    fn clear(&mut self) {
        if self.is_set {
            self.is_set = self.reader.read_exact(&mut [0]).is_err();
        }
    }
}

impl Listener {
    fn new(wanted: Wanted, capacity: usize) -> Self {
        Self {
            buffer: Buffer::new(capacity),
            wanted: Mutex::new(wanted),
            signal: Mutex::new(None),
            lost: Mutex::new([0; CHANNELS]),
            failure: Mutex::new(None),
        }
    }

    fn push(&self, batch: &[TraceRecord]) {
        let wanted = lock(&self.wanted);
        let mut chosen: Vec<TraceRecord> =
            batch.iter().filter(|record| wanted.accepts(record)).copied().collect();
        drop(wanted);
        if chosen.is_empty() {
            return;
        }
        let lost = self.buffer.push(&mut chosen);
        for (sum, lost) in lock(&self.lost).iter_mut().zip(lost) {
            *sum += u64::from(lost);
        }
        self.wake();
    }

    fn wake(&self) {
        if let Some(signal) = lock(&self.signal).as_mut() {
            signal.set();
        }
    }

    /// Nothing more follows, for this reason if there is one.
    pub fn end(&self, failure: Option<String>) {
        *lock(&self.failure) = failure;
        self.buffer.finish();
        self.wake();
    }

    /// The next records; empty if there are none within this time; `None` after the last.
    pub fn pop(&self, timeout: Duration) -> Option<Vec<TraceRecord>> {
        // A listener's buffer ends without an error; the reason is kept separately, so that each listener
        // gets it.
        self.buffer.pop(Some(timeout)).unwrap_or(None)
    }

    /// Why nothing more follows, unless that was requested. Returned once.
    pub fn failure(&self) -> Option<String> {
        lock(&self.failure).take()
    }

    /// Call it when everything that was popped is used up: from then on, the pipe shows whether there is more.
    pub fn used_up(&self) {
        if let Some(signal) = lock(&self.signal).as_mut() {
            signal.clear();
            if self.buffer.is_ready() {
                signal.set();
            }
        }
    }

    /// A pipe that is readable while something is waiting: here, or in what the caller has popped.
    pub fn signal(&self, is_waiting: bool) -> io::Result<&Self> {
        let mut signal = lock(&self.signal);
        if signal.is_none() {
            let (reader, writer) = io::pipe()?;
            let mut made = Signal { reader, writer, is_set: false };
            if is_waiting || self.buffer.is_ready() {
                made.set();
            }
            *signal = Some(made);
        }
        Ok(self)
    }

    /// Its file descriptor.
    #[cfg(unix)]
    pub fn descriptor(&self) -> Option<i32> {
        use std::os::fd::AsRawFd;
        lock(&self.signal).as_ref().map(|signal| signal.reader.as_raw_fd())
    }

    /// Changes what is received from now on.
    pub fn want(&self, change: impl FnOnce(&mut Wanted)) {
        change(&mut lock(&self.wanted));
    }

    /// Frames lost here because nobody took them, per channel.
    pub fn lost(&self) -> [u64; CHANNELS] {
        *lock(&self.lost)
    }
}

/// The listeners of a device, and those waiting for confirmations.
#[derive(Default)]
pub struct Fanout {
    listeners: Mutex<Listeners>,
    /// By tag.
    waiting: Mutex<HashMap<u32, SyncSender<Transmission>>>,
    /// The filters with which a channel was opened; its hardware may pass more.
    filters: Mutex<[Vec<Filter>; CHANNELS]>,
}

#[derive(Default)]
struct Listeners {
    all: Vec<Weak<Listener>>,
    /// Nothing more follows.
    has_ended: bool,
    /// The reason, unless the end was requested.
    failure: Option<String>,
}

impl Fanout {
    /// Adds a listener from now on.
    pub fn listen(&self, wanted: Wanted, capacity: usize) -> Arc<Listener> {
        let listener = Arc::new(Listener::new(wanted, capacity));
        let mut listeners = lock(&self.listeners);
        if listeners.has_ended {
            listener.end(listeners.failure.clone());
        } else {
            listeners.all.push(Arc::downgrade(&listener));
        }
        listener
    }

    /// From now on, only frames matching these filters pass on a channel.
    pub fn set_filters(&self, channel: Channel, filters: Vec<Filter>) {
        lock(&self.filters)[channel.index()] = filters;
    }

    /// Distributes a device's records until they end. It needs a thread of its own.
    pub fn pump(&self, mut records: Records) {
        let failure = loop {
            match records.next_batch(LOOK_EVERY) {
                Ok(Some(mut batch)) => {
                    let filters = lock(&self.filters).clone();
                    if filters.iter().any(|filters| !filters.is_empty()) {
                        batch.retain(|record| {
                            let filters = filters.get(usize::from(record.channel).wrapping_sub(1));
                            filters.is_none_or(|filters| passes(filters, record))
                        });
                    }
                    lock(&self.listeners).all.retain(|listener| {
                        listener.upgrade().inspect(|listener| listener.push(&batch)).is_some()
                    });
                    records.recycle(batch);
                }
                Ok(None) => break None,
                Err(error) => break Some(error.to_string()),
            }
        };
        self.end(failure);
    }

    fn end(&self, failure: Option<String>) {
        let mut listeners = lock(&self.listeners);
        for listener in listeners.all.drain(..).filter_map(|listener| listener.upgrade()) {
            listener.end(failure.clone());
        }
        listeners.has_ended = true;
        listeners.failure = failure;
    }

    /// Reports how transmissions end, until there are no more. It needs a thread of its own.
    pub fn report(&self, ends: &Receiver<Transmission>) {
        while let Ok(end) = ends.recv() {
            if let Some(waiting) = lock(&self.waiting).remove(&end.tag) {
                // It does not matter if nobody waits any more.
                let _ = waiting.try_send(end);
            }
        }
        // Everyone waiting learns that nothing comes.
        lock(&self.waiting).clear();
    }

    /// Has the end of a transmission reported to a channel.
    pub fn wait_for(&self, tag: u32, told: SyncSender<Transmission>) {
        lock(&self.waiting).insert(tag, told);
    }

    /// Nobody waits for these any more.
    pub fn forget(&self, tags: &[u32]) {
        let mut waiting = lock(&self.waiting);
        for tag in tags {
            waiting.remove(tag);
        }
    }
}
