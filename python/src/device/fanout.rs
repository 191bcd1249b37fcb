//! Distributes one device's records to several listeners.
//!
//! A thread without Python takes them from the device and gives each listener its own copy. A listener that does not keep up loses
//! records: they are counted, and a loss takes their place.

use std::io::{self, PipeReader, PipeWriter, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use cantap::device::{Buffer, Records};
use cantap::wire::record::LossStage;
use cantap::wire::{CHANNELS, Channel};
use cantap::{Direction, TraceEvent, TraceRecord};
use cantap_trace::filter::{Filter, passes};

use super::lock::lock;
use super::transmissions::{NOBODY, SenderId, Transmissions};

/// How often to check whether to go on.
pub const LOOK_EVERY: Duration = Duration::from_millis(100);

/// What a listener wants to receive.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// Only this channel, from 1.
    pub channel: Option<u8>,
    /// Only these frames; a frame need match only one of several.
    pub filters: Vec<Filter>,
    /// Which frames that were sent, rather than received.
    pub sent: SentFrames,
}

/// Which of the frames that were sent a listener receives: by this session, or by another client of its server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SentFrames {
    /// All.
    #[default]
    All,
    /// None.
    No,
    /// Another node's view of the bus: what others have sent has been received, and what `me` has sent is there if `own`.
    AsNode {
        /// Who listens.
        me: SenderId,
        /// Also the frames that it sends.
        own: bool,
    },
}

impl Wanted {
    /// The record as the listener receives it, if it does. `sender` is who had it sent.
    fn taken(&self, record: &TraceRecord, sender: SenderId) -> Option<TraceRecord> {
        let mut taken = *record;
        if let TraceEvent::Frame { direction: direction @ Direction::Tx, .. } = &mut taken.event {
            match self.sent {
                SentFrames::All => {}
                SentFrames::No => return None,
                SentFrames::AsNode { me, own } if me == sender => {
                    if !own {
                        return None;
                    }
                }
                SentFrames::AsNode { .. } => *direction = Direction::Rx,
            }
        }
        let is_wanted =
            (self.channel.is_none() || self.channel == Some(record.channel)) && passes(&self.filters, record);
        is_wanted.then_some(taken)
    }
}

/// A listener.
pub struct Listener {
    buffer: Buffer,
    wanted: Mutex<Wanted>,
    /// What is waiting may have come before other filters were set.
    is_refiltered: AtomicBool,
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
            is_refiltered: AtomicBool::new(false),
            signal: Mutex::new(None),
            lost: Mutex::new([0; CHANNELS]),
            failure: Mutex::new(None),
        }
    }

    /// `senders`: who had each frame sent, if any of them was.
    fn push(&self, batch: &[TraceRecord], senders: &[SenderId]) {
        let wanted = lock(&self.wanted);
        let senders = senders.iter().copied().chain(std::iter::repeat(NOBODY));
        let mut chosen: Vec<TraceRecord> =
            batch.iter().zip(senders).filter_map(|(record, sender)| wanted.taken(record, sender)).collect();
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
        let mut batch = self.buffer.pop(Some(timeout)).unwrap_or(None)?;
        if self.is_refiltered.load(Ordering::Relaxed) {
            self.refilter(&mut batch);
        }
        Some(batch)
    }

    /// Drops what the filters that hold now do not accept.
    pub fn refilter(&self, records: &mut Vec<TraceRecord>) {
        let wanted = lock(&self.wanted);
        records.retain(|record| passes(&wanted.filters, record));
    }

    /// Why nothing more follows, unless that was requested.
    pub fn failure(&self) -> Option<String> {
        lock(&self.failure).clone()
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

    /// Changes the filters: also what is waiting must pass them.
    pub fn set_filters(&self, filters: Vec<Filter>) {
        lock(&self.wanted).filters = filters;
        self.is_refiltered.store(true, Ordering::Relaxed);
    }

    /// Frames lost here because nobody took them, per channel.
    pub fn lost(&self) -> [u64; CHANNELS] {
        *lock(&self.lost)
    }
}

/// The listeners of a device.
#[derive(Default)]
pub struct Fanout {
    listeners: Mutex<Listeners>,
    /// The filters with which a channel was opened; its hardware may pass more.
    filters: Mutex<[Vec<Filter>; CHANNELS]>,
    /// Until when, in UTC nanoseconds, what a channel receives is nobody's: its bit rate is being searched.
    ignored_until_ns: Mutex<[i64; CHANNELS]>,
    /// Losses that are known here alone, to be put in their places.
    gaps: Mutex<Vec<TraceRecord>>,
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

    /// Records of a channel up to this time (UTC nanoseconds) are dropped.
    pub fn ignore_until(&self, channel: Channel, time_ns: i64) {
        lock(&self.ignored_until_ns)[channel.index()] = time_ns;
    }

    /// From a time (UTC nanoseconds) on, a channel received nothing for a moment: a loss says so.
    pub fn add_gap(&self, channel: Channel, time_ns: i64) {
        let event = TraceEvent::Lost { stage: Some(LossStage::Controller), count: 0, at_least: true };
        lock(&self.gaps).push(TraceRecord { time_ns, device_ns: None, channel: channel.number(), event });
    }

    /// Puts gaps in their places. One that is later than everything in a batch belongs to the next one.
    fn place_gaps(&self, batch: &mut Vec<TraceRecord>) {
        let mut gaps = lock(&self.gaps);
        if gaps.is_empty() {
            return;
        }
        let last_ns = batch.last().map_or(i64::MAX, |last| last.time_ns);
        gaps.retain(|gap| {
            let is_later = gap.time_ns > last_ns;
            if !is_later {
                let place = batch.partition_point(|record| record.time_ns <= gap.time_ns);
                batch.insert(place, *gap);
            }
            is_later
        });
    }

    /// Distributes a device's records until they end, and reports how transmissions do. It needs a thread of its own.
    pub fn pump(&self, mut records: Records, transmissions: &Transmissions) {
        let failure = loop {
            match records.next_batch(LOOK_EVERY) {
                Ok(Some(mut batch)) => {
                    // The end of a transmission is known before its record is handed over.
                    transmissions.report();
                    let ignored_until_ns = *lock(&self.ignored_until_ns);
                    if ignored_until_ns != [0; CHANNELS] {
                        batch.retain(|record| {
                            let until_ns = ignored_until_ns.get(usize::from(record.channel).wrapping_sub(1));
                            until_ns.is_none_or(|until_ns| record.time_ns > *until_ns)
                        });
                    }
                    let filters = lock(&self.filters).clone();
                    if filters.iter().any(|filters| !filters.is_empty()) {
                        batch.retain(|record| {
                            let filters = filters.get(usize::from(record.channel).wrapping_sub(1));
                            filters.is_none_or(|filters| passes(filters, record))
                        });
                    }
                    self.place_gaps(&mut batch);
                    let senders = transmissions.senders(&batch);
                    lock(&self.listeners).all.retain(|listener| {
                        listener.upgrade().inspect(|listener| listener.push(&batch, &senders)).is_some()
                    });
                    records.recycle(batch);
                }
                Ok(None) => break None,
                Err(error) => break Some(error.to_string()),
            }
        };
        transmissions.end();
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
}
