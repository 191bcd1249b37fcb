//! What is done with a device's stream: records go into a bounded buffer, and what is known of the device is published. It never waits for
//! a consumer.

use std::ops::ControlFlow;
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::record::LossStage;
use cantap_wire::{CHANNELS, Channel, Reply};

use super::buffer::Buffer;
use super::clock::{ClockMap, ClockReport, Ticks, UtcClock};
use super::intake::{Counters, Intake, Notice, PIECE_BYTES, Transmission};
use crate::session::{DeviceError, Pass, SessionOver, Sink};

/// Orders to the reader from outside.
pub(super) enum Order {
    /// From now on, a channel's bits have this length: clocks of the controller per bit, its clock, tick
    /// rate.
    BitLength { channel: Channel, clocks_per_bit: u32, clock_hz: u32, tick_hz: u32 },
    /// The bits of a channel's data phases have this rate from now on, in bit/s, if it is known.
    DataBitrate { channel: Channel, bitrate_bps: Option<u32>, tick_hz: u32 },
    /// The first clock samples are complete; start from the best.
    SettleClock,
    /// Times go on by the device's own clock.
    KeepIntervals,
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
    pub buffer: Buffer,
    published: Mutex<Published>,
    /// As of the last round trip.
    clock_map: Mutex<Option<Arc<ClockMap>>>,
    changed: Condvar,
    subscriber: Mutex<Option<SyncSender<Transmission>>>,
    /// The computer's clock, to which the device's is mapped.
    pub utc: UtcClock,
}

/// A request for the device's time.
#[derive(Clone, Copy)]
pub(super) struct TimeAsked {
    at: Instant,
    /// Device time of the latest record that had been received by then.
    latest_ticks: u64,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every holder leaves the state consistent, even if it panicked elsewhere.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub fn new(capacity: usize) -> Self {
        Self {
            buffer: Buffer::new(capacity),
            published: Mutex::new(Published::default()),
            clock_map: Mutex::new(None),
            changed: Condvar::new(),
            subscriber: Mutex::new(None),
            utc: UtcClock::start(),
        }
    }

    pub fn published(&self) -> Published {
        *lock(&self.published)
    }

    /// What is noted with a request for the device's time that is sent now.
    pub fn time_asked(&self) -> TimeAsked {
        TimeAsked { latest_ticks: self.published().latest_ticks, at: Instant::now() }
    }

    /// The map from device time to UTC.
    pub fn clock_map(&self) -> Option<Arc<ClockMap>> {
        lock(&self.clock_map).clone()
    }

    fn publish_clock(&self, map: &ClockMap) {
        *lock(&self.clock_map) = Some(Arc::new(map.clone()));
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
        *lock(&self.subscriber) = Some(subscriber);
    }

    fn report(&self, transmission: Transmission) {
        if let Some(subscriber) = &*lock(&self.subscriber) {
            // A subscriber that does not keep up misses confirmations; the trace still has them.
            let _ = subscriber.try_send(transmission);
        }
    }
}

/// Turns the stream into records.
pub(super) struct Reader {
    shared: Arc<Shared>,
    orders: Receiver<Order>,
    intake: Intake,
    utc: UtcClock,
    published: Published,
}

impl Reader {
    pub fn new(shared: Arc<Shared>, orders: Receiver<Order>) -> Self {
        let (intake, utc) = (Intake::new(), shared.utc);
        Self { shared, orders, intake, utc, published: Published::default() }
    }

    fn take_piece(&mut self, piece: &[u8], pass: &mut Pass<'_, Option<TimeAsked>>) {
        let Self { shared, intake, utc, published, .. } = self;
        let at = Instant::now();
        let (mut time, mut answered) = (None, false);
        intake.push(piece, utc.at(at), |notice| match notice {
            Notice::Response(response) => {
                answered = true;
                if let Some(waiting) = pass.response(&response) {
                    if let (Ok(Reply::Time(ticks)), Some(asked)) = (&response.result, waiting.note) {
                        time = Some((Ticks(*ticks), asked));
                    }
                    waiting.answer(response.result);
                }
            }
            Notice::OtherProtocol(version) => pass.other_protocol(version),
            Notice::Stopped(channel) => published.stopped[channel.index()] += 1,
            Notice::Transmission(transmission) => shared.report(transmission),
            Notice::WentBack => pass.end(SessionOver::StreamWentBack),
            Notice::TimesDisagree => pass.end(SessionOver::TimesDisagree),
            Notice::Ended { time_ns, reason } => {
                published.ended_ns = Some(time_ns);
                // Whatever else the same read shows, the device's own reason says most.
                pass.end_by_device(reason.into());
            }
        });
        if !intake.records().is_empty() || answered {
            published.heard_at = Some(at);
        }
        // Before the records are: whoever has one finds it counted.
        lock(&shared.published).counters = *intake.counters();
        let lost = shared.buffer.push(intake.records());
        intake.count_host_losses(lost);
        if let Some((ticks, asked)) = time {
            if !intake.add_time(ticks, asked.latest_ticks, utc.at(asked.at), utc.at(at)) {
                pass.end(SessionOver::TimesDisagree);
            }
            shared.publish_clock(intake.clock());
        }
    }

    /// Carries out orders. Returns whether to finish.
    fn follow_orders(&mut self) -> bool {
        let Self { shared, orders, intake, .. } = self;
        while let Ok(order) = orders.try_recv() {
            match order {
                Order::BitLength { channel, clocks_per_bit, clock_hz, tick_hz } => {
                    intake.lengths().set(channel.index(), clocks_per_bit, clock_hz, tick_hz);
                }
                Order::DataBitrate { channel, bitrate_bps, tick_hz } => {
                    intake.lengths().set_data(channel.index(), bitrate_bps, tick_hz);
                }
                Order::SettleClock => {
                    intake.clock().settle();
                    shared.publish_clock(intake.clock());
                }
                Order::KeepIntervals => {
                    let now = Ticks(intake.latest_ticks());
                    intake.clock().keep_intervals(now);
                    shared.publish_clock(intake.clock());
                }
                Order::Losses { channel, stage, count } => {
                    shared.buffer.push(intake.add_losses(channel, stage, count));
                }
                Order::Finish => return true,
            }
        }
        false
    }
}

impl Sink for Reader {
    type Note = Option<TimeAsked>;

    fn take(&mut self, bytes: &[u8], pass: &mut Pass<'_, Self::Note>) -> ControlFlow<()> {
        let finished = self.follow_orders();
        for piece in bytes.chunks(PIECE_BYTES) {
            self.take_piece(piece, pass);
        }
        self.published.counters = *self.intake.counters();
        self.published.clock = self.intake.clock().report();
        self.published.latest_ticks = self.intake.latest_ticks();
        *lock(&self.shared.published) = self.published;
        self.shared.changed.notify_all();
        if finished { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    fn time_note(&self) -> Self::Note {
        Some(self.shared.time_asked())
    }

    fn over(&mut self, reason: Option<DeviceError>) {
        match reason {
            Some(error) => self.shared.buffer.fail(error),
            None => self.shared.buffer.finish(),
        }
        *lock(&self.shared.subscriber) = None;
        self.shared.changed.notify_all();
    }
}
