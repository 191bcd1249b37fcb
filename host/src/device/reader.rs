//! The thread that reads a device's port. It never waits: requests are answered through channels that
//! always have room, records go into a bounded buffer.

use std::collections::HashMap;
use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::framing::{self, CRC_LEN, MAX_REQUEST, max_encoded_len};
use cantap_wire::record::LossStage;
use cantap_wire::{CHANNELS, Channel, Command, Refusal, Reply, Request, Response};

use super::buffer::Buffer;
use super::clock::{ClockMap, ClockReport, Ticks};
use super::error::Gone;
use super::intake::{Counters, Intake, Notice, PIECE_BYTES, Transmission};
use super::link::is_idle;
use super::watch::{Next, SilenceWatch};
use super::{DeviceError, SessionOver};

/// Bytes read at a time; an operating system's serial buffer is smaller.
const READ_BYTES: usize = 64 * 1024;
/// A device makes the host wait while it has no room; one that accepts nothing for this long is stuck.
const WRITE_PATIENCE: Duration = Duration::from_secs(2);
/// How long a failed write waits for what reading says of the end.
const END_PATIENCE: Duration = Duration::from_millis(300);

/// The possible answers to a request.
#[expect(clippy::large_enum_variant, reason = "one for each request, taken at once")]
pub(super) enum Answer {
    Response(Response),
    OtherProtocol(u16),
}

/// Orders to the reader from outside.
pub(super) enum Order {
    /// From now on, a channel's bits have this length: clocks of the controller per bit, its clock, tick
    /// rate.
    BitLength { channel: Channel, clocks_per_bit: u32, clock_hz: u32, tick_hz: u32 },
    /// The first clock samples are complete; start from the best.
    SettleClock,
    /// Losses that only the device's counters show.
    Losses { channel: Channel, stage: LossStage, count: u32 },
    /// Nothing more is expected.
    Finish,
}

/// What the reader publishes after each read.
#[derive(Clone, Copy, Default)]
pub(super) struct Published {
    pub counters: Counters,
    pub clock: ClockReport,
    /// How often each channel has stopped.
    pub stopped: [u32; CHANNELS],
    /// Device time of the latest record, in ticks.
    pub latest_ticks: u64,
    /// When the device was last heard of.
    pub heard_at: Option<Instant>,
    /// When it ended the session, in UTC nanoseconds since the Unix epoch.
    pub ended_ns: Option<i64>,
}

/// What the reader shares with the device's handle.
pub(super) struct Shared {
    pub name: String,
    output: Mutex<Output>,
    pub buffer: Buffer,
    pub quit: AtomicBool,
    published: Mutex<Published>,
    /// As of the last round trip.
    clock_map: Mutex<Option<Arc<ClockMap>>>,
    changed: Condvar,
    pending: Mutex<Pending>,
}

/// The direction towards the device.
struct Output {
    port: Box<dyn Write + Send>,
    /// The last message was cut short: the next one must not be read as its end.
    is_cut: bool,
}

impl Output {
    fn write(&mut self, bytes: &[u8], patience: Duration) -> std::io::Result<()> {
        if self.is_cut {
            write_patiently(&mut self.port, &[0], patience)?;
        }
        self.is_cut = true;
        write_patiently(&mut self.port, bytes, patience)?;
        self.is_cut = false;
        self.port.flush()
    }
}

/// Writes everything, waiting as long as the other end accepts something at least every `patience`.
pub fn write_patiently(
    port: &mut (impl Write + ?Sized),
    mut bytes: &[u8],
    patience: Duration,
) -> std::io::Result<()> {
    let mut moved = Instant::now();
    while !bytes.is_empty() {
        match port.write(bytes) {
            Ok(0) => return Err(std::io::ErrorKind::WriteZero.into()),
            Ok(len) => {
                bytes = &bytes[len..];
                moved = Instant::now();
            }
            Err(error) if is_idle(&error) && moved.elapsed() < patience => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// A request for the device's time.
#[derive(Clone, Copy)]
struct ClockRequest {
    id: u16,
    at: Instant,
    /// Device time of the latest record that had been heard by then.
    latest_ticks: u64,
}

#[derive(Default)]
struct Pending {
    /// Our first request number.
    first_id: u16,
    next_id: u16,
    waiting: HashMap<u16, SyncSender<Answer>>,
    /// A request for the device's time that is in flight.
    clock: Option<ClockRequest>,
    subscriber: Option<SyncSender<Transmission>>,
    gone: Option<Gone>,
}

impl Pending {
    fn take_id(&mut self) -> u16 {
        let id = self.next_id;
        self.next_id = id.wrapping_add(1);
        id
    }

    /// Whether one of our requests had this number. (After 65,536 requests, every number was ours.)
    fn is_ours(&self, id: u16) -> bool {
        id.wrapping_sub(self.first_id) < self.next_id.wrapping_sub(self.first_id)
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent, even if it panicked elsewhere.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub fn new(name: &str, writer: Box<dyn Write + Send>, capacity: usize) -> Self {
        // Answers to an earlier host must not be mistaken for ours, so begin at an arbitrary number.
        let start = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let next_id = start.map_or(1, |since| (since.as_micros() >> 4) as u16);
        Self {
            name: name.to_owned(),
            output: Mutex::new(Output { port: writer, is_cut: false }),
            buffer: Buffer::new(capacity),
            quit: AtomicBool::new(false),
            published: Mutex::new(Published::default()),
            clock_map: Mutex::new(None),
            changed: Condvar::new(),
            pending: Mutex::new(Pending { first_id: next_id, next_id, ..Pending::default() }),
        }
    }

    pub fn published(&self) -> Published {
        *lock(&self.published)
    }

    /// The map from device time to UTC.
    pub fn clock_map(&self) -> Option<Arc<ClockMap>> {
        lock(&self.clock_map).clone()
    }

    /// Waits until something new was published; at most `timeout`.
    pub fn wait_for_news(&self, seen: &Published, timeout: Duration) -> Published {
        let published = lock(&self.published);
        let unchanged = |now: &mut Published| now.heard_at == seen.heard_at && now.stopped == seen.stopped;
        let waited = self.changed.wait_timeout_while(published, timeout, unchanged);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Sets where transmissions are reported.
    pub fn subscribe(&self, subscriber: SyncSender<Transmission>) {
        lock(&self.pending).subscriber = Some(subscriber);
    }

    /// Why the connection is no longer usable, if it is not.
    pub fn gone(&self) -> Option<DeviceError> {
        lock(&self.pending).gone.as_ref().map(|gone| gone.error(&self.name))
    }

    /// Sends a request and returns where its answer will arrive.
    pub fn ask(&self, command: Command) -> Result<(u16, Receiver<Answer>), DeviceError> {
        let (sender, receiver) = std::sync::mpsc::sync_channel(1);
        let is_clock = matches!(command, Command::Time);
        let id = {
            let mut pending = lock(&self.pending);
            let id = pending.take_id();
            pending.waiting.insert(id, sender);
            id
        };
        let bytes = encode(&Request { id, command })?;
        if is_clock {
            let latest_ticks = lock(&self.published).latest_ticks;
            lock(&self.pending).clock = Some(ClockRequest { id, at: Instant::now(), latest_ticks });
        }
        if let Err(error) = self.write(&bytes) {
            self.forget(id);
            return Err(error);
        }
        Ok((id, receiver))
    }

    /// Stops waiting for an answer.
    pub fn forget(&self, id: u16) {
        lock(&self.pending).waiting.remove(&id);
    }

    /// Writes bytes as they are.
    pub fn write(&self, bytes: &[u8]) -> Result<(), DeviceError> {
        let written = lock(&self.output).write(bytes, WRITE_PATIENCE);
        written.map_err(|error| {
            if is_idle(&error) {
                return self.gone().unwrap_or(DeviceError::Timeout { seconds: WRITE_PATIENCE.as_secs_f32() });
            }
            self.reason_for_the_end().unwrap_or_else(|| Gone::Vanished(error.to_string()).error(&self.name))
        })
    }

    /// Why the connection ended, as the reading thread sees it: a server says why before it closes. Waits a moment for it.
    fn reason_for_the_end(&self) -> Option<DeviceError> {
        let deadline = Instant::now() + END_PATIENCE;
        loop {
            let gone = self.gone();
            if gone.is_some() || Instant::now() >= deadline {
                return gone;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The reader's own request for the time; nothing waits for it, and it waits for nothing.
    fn ask_time(&self) {
        let Ok(mut output) = self.output.try_lock() else { return };
        let latest_ticks = lock(&self.published).latest_ticks;
        let mut pending = lock(&self.pending);
        let id = pending.take_id();
        pending.clock = Some(ClockRequest { id, at: Instant::now(), latest_ticks });
        drop(pending);
        if let Ok(bytes) = encode(&Request { id, command: Command::Time }) {
            // If it fails, reading fails too and says why, or the missing answer is noticed.
            let _ = output.write(&bytes, Duration::ZERO);
        }
    }
}

/// Encodes a request as it goes over the wire.
pub fn encode(request: &Request) -> Result<Vec<u8>, DeviceError> {
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
    let mut watch = SilenceWatch::default();
    let mut passed_at = Instant::now();
    let gone = loop {
        let len = match port.read(&mut bytes) {
            Ok(0) => break Gone::Vanished("the connection was closed".to_owned()),
            Ok(len) => len,
            Err(error) if is_idle(&error) => 0,
            Err(error) => break Gone::Vanished(error.to_string()),
        };
        if shared.quit.load(Ordering::Relaxed) {
            return shared.buffer.finish();
        }
        let finished = follow(orders, &mut intake, shared);
        let mut heard = Heard::default();
        for piece in bytes[..len].chunks(PIECE_BYTES) {
            let answered = Instant::now();
            let mut times = None;
            let is_ours = intake.is_in_session();
            let records = intake.push(piece, |notice| match notice {
                Notice::Response(response) => {
                    heard.answered = true;
                    if is_ours {
                        heard.end = heard.end.or_else(|| ends_session(shared, &response));
                    }
                    times = answer(shared, response).or(times);
                }
                Notice::OtherProtocol(version) => refuse(shared, version),
                Notice::Stopped(channel) => published.stopped[channel.index()] += 1,
                Notice::Transmission(transmission) => report(shared, transmission),
                Notice::WentBack => heard.end = heard.end.or(Some(SessionOver::StreamWentBack)),
                Notice::TimesDisagree => heard.end = heard.end.or(Some(SessionOver::TimesDisagree)),
                Notice::Ended { time_ns, reason } => {
                    published.ended_ns = Some(time_ns);
                    heard.end = Some(reason.into());
                }
            });
            if !records.is_empty() || heard.answered {
                published.heard_at = Some(answered);
            }
            let lost = shared.buffer.push(records);
            intake.count_host_losses(lost);
            if let Some((ticks, asked)) = times {
                if !intake.add_time(ticks, asked.latest_ticks, asked.at, answered) {
                    heard.end = heard.end.or(Some(SessionOver::TimesDisagree));
                }
                *lock(&shared.clock_map) = Some(Arc::new(intake.clock().clone()));
            }
        }
        published.counters = *intake.counters();
        published.clock = intake.clock().report();
        published.latest_ticks = intake.latest_ticks();
        *lock(&shared.published) = published;
        shared.changed.notify_all();
        if finished {
            return shared.buffer.finish();
        }
        if let Some(end) = heard.end {
            break Gone::Ended(end);
        }
        let now = Instant::now();
        let passed = now.duration_since(std::mem::replace(&mut passed_at, now));
        if intake.is_in_session() {
            match watch.pass(passed, heard.answered) {
                Next::Listen => {}
                Next::Ask => shared.ask_time(),
                Next::GiveUp(silent) => break Gone::Silent(silent),
            }
        }
    };
    shared.buffer.fail(gone.error(&shared.name));
    let mut pending = lock(&shared.pending);
    pending.gone = Some(gone);
    // Everyone waiting for an answer learns that none will come.
    pending.waiting.clear();
    pending.subscriber = None;
    drop(pending);
    shared.changed.notify_all();
}

/// The content of one read, besides records.
#[derive(Default)]
struct Heard {
    answered: bool,
    end: Option<SessionOver>,
}

/// Whether an answer shows that our session is over.
fn ends_session(shared: &Shared, response: &Response) -> Option<SessionOver> {
    match response.result {
        Err(Refusal::NoSession) => Some(SessionOver::Refused),
        Ok(Reply::Hello(_)) if !lock(&shared.pending).is_ours(response.id) => Some(SessionOver::Greeted),
        _ => None,
    }
}

/// Carries out orders. Returns whether to finish.
fn follow(orders: &Receiver<Order>, intake: &mut Intake, shared: &Shared) -> bool {
    while let Ok(order) = orders.try_recv() {
        match order {
            Order::BitLength { channel, clocks_per_bit, clock_hz, tick_hz } => {
                intake.lengths().set(channel.index(), clocks_per_bit, clock_hz, tick_hz);
            }
            Order::SettleClock => {
                intake.clock().settle();
                *lock(&shared.clock_map) = Some(Arc::new(intake.clock().clone()));
            }
            Order::Losses { channel, stage, count } => {
                shared.buffer.push(intake.add_losses(channel, stage, count));
            }
            Order::Finish => return true,
        }
    }
    false
}

/// Passes an answer to the caller that asked. If it is the device's time, returns that and its request.
fn answer(shared: &Shared, response: Response) -> Option<(Ticks, ClockRequest)> {
    let mut pending = lock(&shared.pending);
    let time = match (&response.result, pending.clock) {
        (Ok(Reply::Time(ticks)), Some(asked)) if asked.id == response.id => Some((Ticks(*ticks), asked)),
        _ => None,
    };
    if let Some(waiting) = pending.waiting.remove(&response.id) {
        // The channel has room for one; it does not matter if nobody waits any more.
        let _ = waiting.try_send(Answer::Response(response));
    }
    time
}

/// Tells everyone waiting that the device speaks another version.
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
