//! Where the records come from: a thread that reads a device or plays a file, records, and fills the model.
//!
//! It holds the model's lock only to hand over what it has, so that the display cannot make it late; a
//! device's own buffer in the library bridges a slow moment.

use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap::autobaud::{self, Limits, Outcome, Progress};
use cantap::device::{Records, UtcClock};
use cantap::filter::Filter;
use cantap::formats::{ReadOptions, open_reader};
use cantap::playback::{Due, Playback};
use cantap::wire::message::{ChannelConfig, Mode, Periodic, TxFrame};
use cantap::{Address, Channel, Device, DeviceError, Frame, TraceRecord};

use super::model::{DeviceFigures, Model, SourceState};
use super::recorder::Recorder;

/// The model, shared by the source thread and the display.
pub type Shared = Arc<Mutex<Model>>;

/// Locks the model. Nobody leaves it half changed.
pub fn lock(model: &Mutex<Model>) -> MutexGuard<'_, Model> {
    model.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Which device, and how to take part in its buses.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The device.
    pub address: Address,
    /// Channels to open, with their bit rates in bit/s.
    pub channels: Vec<(Channel, u32)>,
    /// How.
    pub mode: Mode,
}

impl Plan {
    /// The statistics' options with this plan's bit rates.
    pub fn options(&self, others: &cantap::stats::Options) -> cantap::stats::Options {
        let rates = self.channels.iter().map(|(channel, rate)| (channel.number(), *rate));
        cantap::stats::Options { bitrate_bps: None, channel_bitrate_bps: rates.collect(), ..others.clone() }
    }
}

/// Where records come from.
#[derive(Clone, Debug)]
pub enum Origin {
    /// A device.
    Device(Plan),
    /// A file, played back.
    File(PathBuf),
}

/// What the display asks of the source.
#[derive(Clone, Debug)]
pub enum Order {
    /// Record to this file.
    Record(PathBuf),
    /// End the recording.
    StopRecording,
    /// Send a frame once.
    Send(Channel, Frame),
    /// Let the device send a frame periodically; `None` ends it.
    SetPeriodic(Channel, u8, Option<(Frame, Duration)>),
    /// Playback: faster.
    Faster,
    /// Playback: slower.
    Slower,
    /// Playback: pause or go on.
    TogglePause,
    /// Playback: one record.
    Step,
    /// Playback: loop or not.
    ToggleLoop,
    /// Find the bit rates of the device's channels, only listening.
    Autobaud,
    /// Another device, other bit rates, another mode.
    Open(Plan),
    /// Show only what one of these accepts.
    Filter(Vec<Filter>),
    /// End.
    Quit,
}

/// What becomes of the source after an order.
enum Then {
    GoOn,
    Autobaud,
    Reopen(Plan),
    Quit,
}

/// How long to wait for records at once.
const WAIT: Duration = Duration::from_millis(20);
/// How often the device is asked for its state, and a recording flushed.
const FIGURES_EVERY: Duration = Duration::from_millis(500);
/// How long after it was gone a device is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(1);
/// A window is closed so long after its end although nothing came, so that a late frame finds it open.
const LATENESS_NS: i64 = 1_000_000_000;
/// Records handed over under one lock in playback.
const MOST_AT_ONCE: usize = 4096;

/// Runs until [`Order::Quit`].
pub fn run(origin: Origin, model: &Shared, orders: &Receiver<Order>) {
    let mut source = Source { model, orders, recorder: None };
    match origin {
        Origin::Device(plan) => source.run_device(plan),
        Origin::File(path) => source.run_file(&path),
    }
    source.stop_recording();
}

struct Source<'a> {
    model: &'a Shared,
    orders: &'a Receiver<Order>,
    recorder: Option<Recorder>,
}

impl Source<'_> {
    fn notice(&self, text: impl Into<String>) {
        lock(self.model).notice = text.into();
    }

    /// Records, then shows.
    fn take(&mut self, records: &[TraceRecord]) {
        if let Some(recorder) = &mut self.recorder
            && let Err(error) = recorder.write(records)
        {
            self.stop_recording();
            self.notice(format!("recording ended: {error}; check the disk's free space"));
        }
        lock(self.model).take(records);
    }

    fn record(&mut self, path: &Path) {
        self.stop_recording();
        let decoder = Arc::clone(lock(self.model).signals.decoder());
        match Recorder::create(path, &decoder) {
            Ok(recorder) => {
                self.recorder = Some(recorder);
                self.notice(format!("recording to {}", path.display()));
                self.show_recording();
            }
            Err(error) => self.notice(error.to_string()),
        }
    }

    fn stop_recording(&mut self) {
        if let Some(recorder) = self.recorder.take() {
            let said = recorder.finish();
            let mut model = lock(self.model);
            model.recording = None;
            model.notice = said;
        }
    }

    fn show_recording(&mut self) {
        let Some(recorder) = &mut self.recorder else {
            return;
        };
        match recorder.state() {
            Ok(state) => lock(self.model).recording = Some(state),
            Err(error) => {
                self.stop_recording();
                self.notice(format!("recording ended: {error}; check the disk's free space"));
            }
        }
    }

    /// Orders that any source follows.
    fn follow(&mut self, order: Order) -> Then {
        match order {
            Order::Record(path) => self.record(&path),
            Order::StopRecording => self.stop_recording(),
            Order::Filter(filters) => lock(self.model).filters = filters,
            Order::Open(plan) => return Then::Reopen(plan),
            Order::Autobaud => return Then::Autobaud,
            Order::Quit => return Then::Quit,
            Order::Send(..) | Order::SetPeriodic(..) => {
                self.notice("there is no device to send with; open one with D");
            }
            Order::Faster | Order::Slower | Order::TogglePause | Order::Step | Order::ToggleLoop => {
                self.notice("only a file can be played slower, faster or in steps");
            }
        }
        Then::GoOn
    }

    fn run_device(&mut self, mut plan: Plan) {
        let mut reconnects = 0;
        loop {
            match self.session(&plan, reconnects) {
                Ok(Then::Reopen(other)) => {
                    plan = other;
                    reconnects = 0;
                    continue;
                }
                Ok(Then::Autobaud) => {
                    plan = self.autobaud(plan);
                    continue;
                }
                Ok(_) => return,
                Err(error) => {
                    let mut model = lock(self.model);
                    model.source = SourceState::Gone(error.to_string());
                    model.statistics.interrupt();
                }
            }
            // The device may come back, and the user may choose another one meanwhile.
            let retry_at = Instant::now() + RETRY_AFTER;
            loop {
                match self.orders.recv_timeout(retry_at.saturating_duration_since(Instant::now())) {
                    Ok(order) => match self.follow(order) {
                        Then::GoOn | Then::Autobaud => {}
                        Then::Reopen(other) => {
                            plan = other;
                            break;
                        }
                        Then::Quit => return,
                    },
                    Err(RecvTimeoutError::Timeout) => break,
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
            reconnects += 1;
        }
    }

    /// One session with the device, until it is gone or an order ends it.
    fn session(&mut self, plan: &Plan, reconnects: u32) -> Result<Then, DeviceError> {
        let device = Device::open(&plan.address)?;
        let mut records = device.records();
        for (channel, bitrate) in &plan.channels {
            let timing = device.timing(*bitrate)?;
            let config = ChannelConfig { mode: plan.mode, ..ChannelConfig::listen_only(timing) };
            device.open_channel(*channel, Some(config))?;
        }
        let hello = device.hello();
        let figures = DeviceFigures {
            queue_bytes: hello.queue_bytes,
            name: format!("{} {}", hello.board, hello.serial),
            reconnects,
            ..DeviceFigures::default()
        };
        {
            let mut model = lock(self.model);
            model.device = Some(figures);
            model.source = SourceState::Running;
            if reconnects > 0 {
                model.notice = format!("{} is back", plan.address);
            }
        }
        let clock = UtcClock::start();
        let mut next_figures = Instant::now();
        loop {
            match records.next_batch(WAIT)? {
                Some(batch) => self.hand_over(batch, &records),
                None => return Err(DeviceError::Timeout { seconds: WAIT.as_secs_f32() }),
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                let status = device.status()?;
                let mut model = lock(self.model);
                if let Some(figures) = &mut model.device {
                    figures.status = Some(status);
                    figures.counters = device.counters();
                    figures.clock = Some(device.clock());
                }
                // What is still on the way must not find its window closed.
                model.advance(clock.at(Instant::now()).saturating_sub(LATENESS_NS));
                drop(model);
                self.show_recording();
            }
            loop {
                match self.orders.try_recv() {
                    Ok(Order::Send(channel, frame)) => {
                        let frame = TxFrame { tag: 0, frame, at_ticks: None };
                        if let Err(error) = device.send(channel, &[frame]) {
                            self.notice(error.to_string());
                        }
                    }
                    Ok(Order::SetPeriodic(channel, slot, entry)) => {
                        let entry = entry.map(|(frame, period)| periodic(hello.tick_hz, frame, period));
                        if let Err(error) = device.set_periodic(channel, slot, entry) {
                            self.notice(error.to_string());
                        }
                    }
                    Ok(order) => match self.follow(order) {
                        Then::GoOn => {}
                        then => {
                            device.stop()?;
                            while let Some(batch) = records.next_batch(WAIT)? {
                                self.hand_over(batch, &records);
                            }
                            return Ok(then);
                        }
                    },
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => return Ok(Then::Quit),
                }
            }
        }
    }

    /// The plan with the bit rates that were found; what was not found stays as it was.
    fn autobaud(&mut self, mut plan: Plan) -> Plan {
        let mut said = Vec::new();
        let device = match Device::open(&plan.address) {
            Ok(device) => device,
            Err(error) => {
                self.notice(error.to_string());
                return plan;
            }
        };
        for (channel, bitrate) in &mut plan.channels {
            let number = channel.number();
            let mut progress = |progress: Progress| {
                self.notice(match progress {
                    Progress::Common { bitrate_bps, at, of } => {
                        format!("channel {number}: common rates {}/{of}, {bitrate_bps} bit/s", at + 1)
                    }
                    Progress::Scan { bitrate_bps, at, of } => {
                        format!("channel {number}: all rates {}/{of}, {bitrate_bps} bit/s", at + 1)
                    }
                    Progress::Checking { bitrate_bps } => {
                        format!("channel {number}: frames at {bitrate_bps} bit/s, making sure")
                    }
                });
                true
            };
            said.push(match autobaud::search(&device, *channel, &Limits::default(), &mut progress) {
                Ok(Outcome::Found { bitrate_bps, .. }) => {
                    *bitrate = bitrate_bps;
                    format!("channel {number}: {bitrate_bps} bit/s")
                }
                Ok(Outcome::NoTraffic) => format!("channel {number}: no traffic"),
                Ok(Outcome::NoMatch { .. }) => format!("channel {number}: traffic, but no bit rate fits"),
                Ok(Outcome::Stopped) => format!("channel {number}: stopped"),
                Err(error) => format!("channel {number}: {error}"),
            });
        }
        let mut model = lock(self.model);
        let options = plan.options(model.options());
        model.notice = match model.set_options(options) {
            Ok(()) => said.join("; "),
            Err(error) => error.to_string(),
        };
        plan
    }

    fn hand_over(&mut self, batch: Vec<TraceRecord>, records: &Records) {
        if !batch.is_empty() {
            self.take(&batch);
            records.recycle(batch);
        }
    }

    fn run_file(&mut self, path: &Path) {
        let open = || {
            let reader = open_reader(path, &ReadOptions::default())?;
            // What cannot be read is left out; `cantap convert` or `cantap stats` say what it was.
            Ok::<_, cantap::formats::OpenError>(reader.filter_map(Result::ok))
        };
        let start = Instant::now();
        let mut playback = match Playback::new(open, start.elapsed()) {
            Ok(playback) => playback,
            Err(error) => {
                lock(self.model).source = SourceState::Gone(error.to_string());
                return self.wait_without_source();
            }
        };
        let mut due = Vec::with_capacity(MOST_AT_ONCE);
        let mut next_figures = Instant::now();
        loop {
            let mut wait = WAIT;
            let mut ended = false;
            while due.len() < MOST_AT_ONCE {
                match playback.poll(start.elapsed()) {
                    Ok(Due::Record(record)) => {
                        due.push(record);
                        continue;
                    }
                    Ok(Due::Wait(time)) => wait = time.min(WAIT),
                    Ok(Due::Paused) => {}
                    Ok(Due::Ended) => ended = true,
                    Err(error) => {
                        self.notice(error.to_string());
                        ended = true;
                    }
                }
                break;
            }
            if due.len() == MOST_AT_ONCE {
                wait = Duration::ZERO;
            }
            if !due.is_empty() {
                self.take(&due);
                due.clear();
            }
            lock(self.model).source = SourceState::Playing {
                factor: playback.factor(),
                paused: playback.is_paused(),
                looped: playback.is_looped(),
                ended,
            };
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                self.show_recording();
            }
            let now = start.elapsed();
            match self.orders.recv_timeout(wait) {
                Ok(Order::Faster) => playback.faster(now),
                Ok(Order::Slower) => playback.slower(now),
                Ok(Order::Step) => playback.step(now),
                Ok(Order::TogglePause) if playback.is_paused() => playback.resume(now),
                Ok(Order::TogglePause) => playback.pause(now),
                Ok(Order::ToggleLoop) => playback.set_looped(!playback.is_looped()),
                Ok(order) => match self.follow(order) {
                    Then::GoOn | Then::Autobaud => {}
                    Then::Reopen(plan) => return self.run_device(plan),
                    Then::Quit => return,
                },
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// The file cannot be opened; the user may choose a device.
    fn wait_without_source(&mut self) {
        while let Ok(order) = self.orders.recv() {
            match self.follow(order) {
                Then::GoOn | Then::Autobaud => {}
                Then::Reopen(plan) => return self.run_device(plan),
                Then::Quit => return,
            }
        }
    }
}

fn periodic(tick_hz: u32, frame: Frame, period: Duration) -> Periodic {
    let ticks = period.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
    Periodic {
        frame,
        period_ticks: u32::try_from(ticks).unwrap_or(u32::MAX),
        count: 0,
        modifiers: heapless::Vec::new(),
    }
}
