//! The thread that reads a device's port. It waits for nobody: requests are answered through channels that
//! always have room, records go into a bounded buffer.

use std::collections::HashMap;
use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::framing::{self, CRC_LEN, MAX_REQUEST, max_encoded_len};
use cantap_wire::record::LossStage;
use cantap_wire::{CHANNELS, Channel, Command, Reply, Request, Response};

use super::DeviceError;
use super::buffer::Buffer;
use super::clock::ClockReport;
use super::intake::{Counters, Intake, Notice, PIECE_BYTES, Transmission};
use super::link::is_idle;

/// Read at a time; an operating system's serial buffer is smaller.
const READ_BYTES: usize = 64 * 1024;
/// The device's time is asked for so often.
const CLOCK_EVERY: Duration = Duration::from_secs(1);

/// What a request's answer can be.
#[expect(clippy::large_enum_variant, reason = "one for each request, taken at once")]
pub(super) enum Answer {
    Response(Response),
    OtherProtocol(u16),
}

/// What the reader is told from outside.
pub(super) enum Order {
    /// A channel's bits are this long from now on: clocks of the controller per bit, its clock, tick rate.
    BitLength { channel: Channel, clocks_per_bit: u32, clock_hz: u32, tick_hz: u32 },
    /// The samples of the clock so far are the first; start from the best.
    SettleClock,
    /// Losses that only the device's counters tell of.
    Losses { channel: Channel, stage: LossStage, count: u32 },
    /// Nothing more is expected.
    Finish,
}

/// What the reader publishes after each read.
#[derive(Clone, Copy, Default)]
pub(super) struct Published {
    pub counters: Counters,
    pub clock: Option<ClockReport>,
    /// Times each channel stopped.
    pub stopped: [u32; CHANNELS],
    /// Reads that brought something.
    pub reads: u64,
}

/// What the reader shares with the device's handle.
pub(super) struct Shared {
    pub name: String,
    pub writer: Mutex<Box<dyn Write + Send>>,
    pub buffer: Buffer,
    pub quit: AtomicBool,
    published: Mutex<Published>,
    changed: Condvar,
    pending: Mutex<Pending>,
}

#[derive(Default)]
struct Pending {
    next_id: u16,
    waiting: HashMap<u16, SyncSender<Answer>>,
    /// Questions for the device's time that are under way.
    clock: Option<(u16, Instant)>,
    subscriber: Option<SyncSender<Transmission>>,
    /// Why the port is gone.
    gone: Option<String>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state whole, even if it panicked elsewhere.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub fn new(name: &str, writer: Box<dyn Write + Send>, capacity: usize) -> Self {
        // Answers to a host before us must not be taken for ours: begin at an arbitrary number.
        let start = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let next_id = start.map_or(1, |since| (since.as_micros() >> 4) as u16);
        Self {
            name: name.to_owned(),
            writer: Mutex::new(writer),
            buffer: Buffer::new(capacity),
            quit: AtomicBool::new(false),
            published: Mutex::new(Published::default()),
            changed: Condvar::new(),
            pending: Mutex::new(Pending { next_id, ..Pending::default() }),
        }
    }

    pub fn published(&self) -> Published {
        *lock(&self.published)
    }

    /// Waits until something new was published; at most `timeout`.
    pub fn wait_for_news(&self, seen: &Published, timeout: Duration) -> Published {
        let published = lock(&self.published);
        let unchanged = |now: &mut Published| now.reads == seen.reads && now.stopped == seen.stopped;
        let waited = self.changed.wait_timeout_while(published, timeout, unchanged);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Where transmissions are reported.
    pub fn subscribe(&self, subscriber: SyncSender<Transmission>) {
        lock(&self.pending).subscriber = Some(subscriber);
    }

    /// The port's end, if it has come.
    pub fn gone(&self) -> Option<DeviceError> {
        let reason = lock(&self.pending).gone.clone()?;
        Some(DeviceError::Vanished { address: self.name.clone(), reason })
    }

    /// Sends a request and returns where its answer will arrive.
    pub fn ask(&self, command: Command) -> Result<(u16, Receiver<Answer>), DeviceError> {
        let (sender, receiver) = std::sync::mpsc::sync_channel(1);
        let is_clock = matches!(command, Command::Time);
        let id = {
            let mut pending = lock(&self.pending);
            let id = pending.next_id;
            pending.next_id = id.wrapping_add(1);
            pending.waiting.insert(id, sender);
            id
        };
        let bytes = encode(&Request { id, command })?;
        if is_clock {
            lock(&self.pending).clock = Some((id, Instant::now()));
        }
        if let Err(error) = self.write(&bytes) {
            self.forget(id);
            return Err(error);
        }
        Ok((id, receiver))
    }

    /// Gives up on an answer.
    pub fn forget(&self, id: u16) {
        lock(&self.pending).waiting.remove(&id);
    }

    /// Writes bytes as they are.
    pub fn write(&self, bytes: &[u8]) -> Result<(), DeviceError> {
        let mut writer = lock(&self.writer);
        let written = writer.write_all(bytes).and_then(|()| writer.flush());
        written.map_err(|error| self.gone().unwrap_or_else(|| self.vanished(&error.to_string())))
    }

    fn vanished(&self, reason: &str) -> DeviceError {
        DeviceError::Vanished { address: self.name.clone(), reason: reason.to_owned() }
    }

    /// The reader's own question for the time; nobody waits for it, and it waits for nobody.
    fn ask_time(&self) {
        let Ok(mut writer) = self.writer.try_lock() else { return };
        let mut pending = lock(&self.pending);
        let id = pending.next_id;
        pending.next_id = id.wrapping_add(1);
        pending.clock = Some((id, Instant::now()));
        drop(pending);
        if let Ok(bytes) = encode(&Request { id, command: Command::Time }) {
            // If it fails, reading fails too and says why.
            let _ = writer.write_all(&bytes).and_then(|()| writer.flush());
        }
    }
}

/// A request as it goes over the wire.
pub(crate) fn encode(request: &Request) -> Result<Vec<u8>, DeviceError> {
    let mut message = [0; MAX_REQUEST + CRC_LEN];
    let mut out = vec![0; max_encoded_len(MAX_REQUEST)];
    let encoded = framing::encode(request, &mut message, &mut out).ok_or(DeviceError::RequestTooLong)?;
    out.truncate(encoded);
    Ok(out)
}

/// The thread's body.
pub(super) fn run(mut port: Box<dyn Read + Send>, shared: &Arc<Shared>, orders: &Receiver<Order>) {
    let mut intake = Intake::new();
    let mut bytes = vec![0; READ_BYTES];
    let mut published = Published::default();
    let mut asked = Instant::now();
    let reason = loop {
        let len = match port.read(&mut bytes) {
            Ok(0) => break "the connection was closed".to_owned(),
            Ok(len) => len,
            Err(error) if is_idle(&error) => 0,
            Err(error) => break error.to_string(),
        };
        if shared.quit.load(Ordering::Relaxed) {
            return shared.buffer.finish();
        }
        let finished = follow(orders, &mut intake, shared);
        for piece in bytes[..len].chunks(PIECE_BYTES) {
            let answered = Instant::now();
            let mut times = None;
            let records = intake.push(piece, |notice| match notice {
                Notice::Response(response) => times = answer(shared, response).or(times),
                Notice::OtherProtocol(version) => refuse(shared, version),
                Notice::Stopped(channel) => published.stopped[channel.index()] += 1,
                Notice::Transmission(transmission) => report(shared, transmission),
            });
            let lost = shared.buffer.push(records);
            intake.count_host_losses(lost);
            if let Some((ticks, asked)) = times {
                intake.add_time(ticks, asked, answered);
            }
        }
        published.reads += u64::from(len > 0);
        published.counters = *intake.counters();
        published.clock = Some(intake.clock().report());
        *lock(&shared.published) = published;
        shared.changed.notify_all();
        if finished {
            return shared.buffer.finish();
        }
        if asked.elapsed() > CLOCK_EVERY && intake.is_in_session() {
            shared.ask_time();
            asked = Instant::now();
        }
    };
    shared.buffer.fail(shared.vanished(&reason));
    let mut pending = lock(&shared.pending);
    pending.gone = Some(reason);
    // Whoever waits for an answer learns that none will come.
    pending.waiting.clear();
    pending.subscriber = None;
    drop(pending);
    shared.changed.notify_all();
}

/// Does what was ordered. Returns whether to finish.
fn follow(orders: &Receiver<Order>, intake: &mut Intake, shared: &Shared) -> bool {
    while let Ok(order) = orders.try_recv() {
        match order {
            Order::BitLength { channel, clocks_per_bit, clock_hz, tick_hz } => {
                intake.lengths().set(channel.index(), clocks_per_bit, clock_hz, tick_hz);
            }
            Order::SettleClock => intake.clock().settle(),
            Order::Losses { channel, stage, count } => {
                shared.buffer.push(intake.add_losses(channel, stage, count));
            }
            Order::Finish => return true,
        }
    }
    false
}

/// Passes an answer to whoever asked. Returns the device's time and when it was asked for, if it was.
fn answer(shared: &Shared, response: Response) -> Option<(u64, Instant)> {
    let mut pending = lock(&shared.pending);
    let time = match (&response.result, pending.clock) {
        (Ok(Reply::Time(ticks)), Some((id, asked))) if id == response.id => Some((*ticks, asked)),
        _ => None,
    };
    if let Some(waiting) = pending.waiting.remove(&response.id) {
        // The channel has room for one; if nobody waits any more, that is fine.
        let _ = waiting.try_send(Answer::Response(response));
    }
    time
}

/// Tells everybody who waits that the device speaks another version.
fn refuse(shared: &Shared, version: u16) {
    for (_, waiting) in lock(&shared.pending).waiting.drain() {
        let _ = waiting.try_send(Answer::OtherProtocol(version));
    }
}

fn report(shared: &Shared, transmission: Transmission) {
    if let Some(subscriber) = &lock(&shared.pending).subscriber {
        // A subscriber that does not keep up misses confirmations; the trace still has them.
        let _ = subscriber.try_send(transmission);
    }
}
