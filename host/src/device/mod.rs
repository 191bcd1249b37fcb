//! A device: opening it, sending it requests, and the records it captures.
//!
//! [`Device::open`] connects to a serial port, [`Device::over`] to anything that makes a [`Link`]; [`Device::records`]
//! hands out what is captured, the other methods are requests. A separate thread reads the port, so a slow program loses
//! nothing as long as the buffer lasts, and after that is shown exactly what it lost.

mod buffer;
mod clock;
mod commands;
mod device_time;
mod intake;
mod pipe;
mod reader;
mod reconnect;
#[cfg(feature = "serial")]
mod serial;
mod several;
mod stamps;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::message::{ChannelConfig, Filter, Mode, Status, capability};
use cantap_wire::{BitTiming, CHANNELS, Channel, Command, Hello, Reply};

pub use buffer::Buffer;
pub use clock::{
    ClockMap, ClockReport, ClockSource, CommonClock, Follower, FollowerReport, FrameClock, FrameDoubt,
    FrameNs, NotCommon, SofMark, Ticks, UtcClock, UtcNs,
};
pub use device_time::DeviceTime;
pub(crate) use intake::unaccounted;
pub use intake::{ChannelCounters, Counters, Intake, Notice, PIECE_BYTES, Transmission};
pub use pipe::{PipeReader, PipeWriter, pipe};
pub use reconnect::{Gaps, Happening, Reconnecting, Return};
#[cfg(feature = "serial")]
pub use serial::{Board, list, open as open_port, open_at as open_port_at, port_of};
pub use several::{Several, channel_number};
pub use stamps::{BitLengths, tighten};

use crate::TraceRecord;
use crate::session::{self, Session};
pub use crate::session::{DeviceError, Link, SessionOver, encode, is_idle, write_patiently};
use reader::{Order, Reader, Shared, TimeAsked};

/// Records that wait for a consumer: 32 MB, half a minute of two saturated channels.
const BUFFER_RECORDS: usize = 1 << 20;
/// Time limit for a request.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(2);
/// Round trips that set the clock at the beginning.
const CLOCK_ROUNDS: u32 = 8;
/// When closing a channel, its last records are given up if none has arrived for this long.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
/// How many transmissions may wait for a subscriber.
const TRANSMISSIONS: usize = 65_536;

/// A device in a session of ours.
pub struct Device {
    session: Session<Option<TimeAsked>>,
    shared: Arc<Shared>,
    orders: Sender<Order>,
    settings: Mutex<Settings>,
    /// Whether this session may have a channel open. A gateway that the device runs on its own is not this session's to end.
    may_be_on_a_bus: AtomicBool,
}

/// The channels' settings in this session, to be applied again in the next.
#[derive(Clone, Debug, Default)]
pub(crate) struct Settings {
    filters: [Option<Vec<Filter>>; CHANNELS],
    open: [Option<ChannelConfig>; CHANNELS],
    /// Of data phases, in bit/s. It is no part of the session: whoever connects knows it.
    data_bitrates_bps: [Option<u32>; CHANNELS],
    keeps_intervals: bool,
}

impl Device {
    /// Connects to the device on a serial port, by its path or name: `/dev/ttyACM0`, `COM5`.
    #[cfg(feature = "serial")]
    pub fn open(port: &str) -> Result<Self, DeviceError> {
        Self::over(serial::open(port)?, port)
    }

    /// Talks to the device at the other end of a byte stream; messages call it `name`.
    pub fn over(link: Link, name: &str) -> Result<Self, DeviceError> {
        Self::over_holding(link, name, BUFFER_RECORDS)
    }

    /// The same, with a limit on how many records may wait to be taken; others are lost and counted.
    pub fn over_holding(link: Link, name: &str, records: usize) -> Result<Self, DeviceError> {
        let shared = Arc::new(Shared::new(records));
        let (orders, received_orders) = std::sync::mpsc::channel();
        let session = Session::begin(link, name, Reader::new(Arc::clone(&shared), received_orders))?;
        let device = Self {
            session,
            shared,
            orders,
            settings: Mutex::default(),
            may_be_on_a_bus: AtomicBool::new(false),
        };
        for _ in 0..CLOCK_ROUNDS {
            device.time()?;
        }
        device.order(Order::SettleClock);
        Ok(device)
    }

    /// The device's description of itself.
    pub const fn hello(&self) -> &Hello {
        self.session.hello()
    }

    /// Its address, as given when it was opened.
    pub fn name(&self) -> &str {
        self.session.requests().name()
    }

    /// Sends any request and waits for its answer.
    pub fn request(&self, command: Command) -> Result<Reply, DeviceError> {
        self.request_later(command)?.wait()
    }

    /// Sends any request without waiting for its answer, so that several can be in flight: a device handles them
    /// in order. Use it for a few at a time; their bytes wait in the device's input.
    pub fn request_later(&self, command: Command) -> Result<Pending<'_>, DeviceError> {
        if matches!(command, Command::Open { .. } | Command::StopGateway) {
            self.may_be_on_a_bus.store(true, Ordering::Relaxed);
        }
        let is_time = matches!(command, Command::Time);
        let note = is_time.then(|| self.shared.time_asked());
        self.session.requests().send(command, note).map(Pending)
    }

    fn order(&self, order: Order) {
        // If the thread has ended, nobody needs the order.
        let _ = self.orders.send(order);
    }

    /// The bit timing for a bit rate on this device, with the recommended sample point.
    pub fn timing(&self, bitrate_bps: u32) -> Result<BitTiming, DeviceError> {
        BitTiming::choose(self.hello().can_clock_hz, bitrate_bps, None)
            .map_err(|reason| DeviceError::BitRate { bitrate_bps, reason })
    }

    /// Opens a channel. Without a configuration, the one saved on the device applies, whatever its mode
    /// ([`Self::defaults`] reads it beforehand). Returns what was applied.
    pub fn open_channel(
        &self,
        channel: Channel,
        config: Option<ChannelConfig>,
    ) -> Result<ChannelConfig, DeviceError> {
        if channel.number() > self.hello().channels {
            return Err(DeviceError::NoChannel { channel });
        }
        let must_be_silent = config.as_ref().is_some_and(|config| config.mode == Mode::ListenOnly);
        if must_be_silent && self.hello().capabilities & capability::ALWAYS_ACKNOWLEDGES != 0 {
            return Err(DeviceError::AlwaysAcknowledges { address: self.name().to_owned() });
        }
        // This must be set before the first frame can arrive.
        if let Some(config) = &config {
            self.set_bit_length(channel, config);
        }
        match self.request(Command::Open { channel, config })? {
            Reply::Opened(applied)
                if config
                    .is_some_and(|asked| (asked.timing, asked.mode) != (applied.timing, applied.mode)) =>
            {
                // Left open, it might acknowledge frames, or destroy them at a wrong bit rate.
                self.done(Command::Close { channel })?;
                let bitrate_bps = applied.timing.bitrate_bps(self.hello().can_clock_hz);
                Err(DeviceError::OpenedOtherwise { channel, bitrate_bps, mode: applied.mode })
            }
            Reply::Opened(applied) => {
                self.set_bit_length(channel, &applied);
                self.settings().open[channel.index()] = Some(applied);
                Ok(applied)
            }
            _ => Err(DeviceError::WrongReply),
        }
    }

    fn set_bit_length(&self, channel: Channel, config: &ChannelConfig) {
        if self.hello().capabilities & capability::NO_BIT_RATE != 0 {
            return;
        }
        self.order(Order::BitLength {
            channel,
            clocks_per_bit: config.timing.clocks_per_bit(),
            clock_hz: self.hello().can_clock_hz,
            tick_hz: self.hello().tick_hz,
        });
    }

    /// Sets the bit rate of a bus's data phases, in bit/s, on which the lengths of CAN FD frames depend that switch to it; `None` if it is not
    /// known, as at first. The device is not asked. It tightens stamps where the adapter's bit rate is that of a bus.
    pub fn set_data_bitrate(&self, channel: Channel, bitrate_bps: Option<u32>) {
        self.settings().data_bitrates_bps[channel.index()] = bitrate_bps;
        self.order(Order::DataBitrate { channel, bitrate_bps, tick_hz: self.hello().tick_hz });
    }

    /// The bit rate of a bus's data phases, in bit/s, if it is known.
    pub fn data_bitrate(&self, channel: Channel) -> Option<u32> {
        self.settings().data_bitrates_bps[channel.index()]
    }

    /// From now on, intervals between times are the device's own, by its crystal, instead of being corrected towards UTC: times begin at UTC and
    /// then drift by [`ClockReport::drift_ppm`]. Call it before channels are opened. It cannot be undone in this session.
    pub fn keep_intervals(&self) {
        if !std::mem::replace(&mut self.settings().keeps_intervals, true) {
            self.order(Order::KeepIntervals);
        }
    }

    /// Opens a channel that only listens, at a bit rate.
    pub fn listen(&self, channel: Channel, bitrate_bps: u32) -> Result<ChannelConfig, DeviceError> {
        let timing = self.timing(bitrate_bps)?;
        self.open_channel(channel, Some(ChannelConfig::listen_only(timing)))
    }

    /// Opens a channel that takes part in the bus, at a bit rate: it acknowledges frames and may send.
    pub fn join(&self, channel: Channel, bitrate_bps: u32) -> Result<ChannelConfig, DeviceError> {
        let timing = self.timing(bitrate_bps)?;
        let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
        self.open_channel(channel, Some(config))
    }

    fn settings(&self) -> MutexGuard<'_, Settings> {
        self.settings.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a channel's filters keep frames back from this session.
    pub fn is_filtered(&self, channel: Channel) -> bool {
        self.settings().filters[channel.index()].as_ref().is_some_and(|filters| !filters.is_empty())
    }

    /// The open channels, with their configurations.
    pub fn open_channels(&self) -> Vec<(Channel, ChannelConfig)> {
        let open = self.settings().open;
        Channel::ALL.into_iter().filter_map(|channel| Some((channel, open[channel.index()]?))).collect()
    }

    /// Closes a channel and waits until everything it captured has arrived.
    pub fn close_channel(&self, channel: Channel) -> Result<(), DeviceError> {
        self.close_channels(&[channel])
    }

    /// Closes channels, all before it waits for any: a slow line is waited for once.
    fn close_channels(&self, channels: &[Channel]) -> Result<(), DeviceError> {
        let before = self.shared.published();
        let status = self.status()?;
        let mut open = channels.to_vec();
        open.retain(|channel| status.channels[channel.index()].open.is_some());
        let closes = channels.iter().map(|channel| self.request_later(Command::Close { channel: *channel }));
        for close in closes.collect::<Vec<_>>() {
            match close?.wait()? {
                Reply::Done => {}
                _ => return Err(DeviceError::WrongReply),
            }
        }
        // The records that say so are in the device's queue by now, so nothing of a later time is in front of them.
        let closed_at = self.time()?;
        let mut seen = self.shared.published();
        let mut quiet = Instant::now();
        let goes_on = |seen: &reader::Published| {
            let stopped =
                |channel: &Channel| seen.stopped[channel.index()] != before.stopped[channel.index()];
            !open.iter().all(stopped)
        };
        while goes_on(&seen) {
            if let Some(gone) = self.session.requests().gone() {
                return Err(gone);
            }
            let now = self.shared.wait_for_news(&seen, DRAIN_TIMEOUT / 4);
            if now.latest_ticks != seen.latest_ticks {
                quiet = Instant::now();
            }
            seen = now;
            if seen.latest_ticks > closed_at || quiet.elapsed() > DRAIN_TIMEOUT {
                // The record itself was lost on the way; the device's counters cover what else was.
                break;
            }
        }
        for channel in channels {
            self.settings().open[channel.index()] = None;
        }
        Ok(())
    }

    /// Closes both channels, waits for everything they captured, accounts for what the link lost at the very
    /// end, and ends the stream of records, even if one of these steps fails. Returns the device's last
    /// status.
    pub fn stop(&self) -> Result<Status, DeviceError> {
        let status = self.close_and_account();
        self.order(Order::Finish);
        let deadline = Instant::now() + DRAIN_TIMEOUT;
        while !self.shared.buffer.has_ended() && Instant::now() < deadline {
            self.shared.wait_for_news(&self.shared.published(), Duration::from_millis(5));
        }
        status
    }

    fn close_and_account(&self) -> Result<Status, DeviceError> {
        self.close_channels(&Channel::ALL)?;
        let status = self.status()?;
        for (channel, stage, count) in intake::unaccounted(&status, &self.counters()) {
            self.order(Order::Losses { channel, stage, count });
        }
        Ok(status)
    }

    /// The records captured from now on. If there are two handles, each record goes to one of them.
    pub fn records(&self) -> Records {
        Records { shared: Arc::clone(&self.shared), batch: Vec::new().into_iter() }
    }

    /// How transmissions end, from now on. Replaces an earlier subscription.
    pub fn transmissions(&self) -> Receiver<Transmission> {
        let (sender, receiver) = sync_channel(TRANSMISSIONS);
        self.shared.subscribe(sender);
        receiver
    }

    /// What has been received and lost so far: at least every record that was already handed over.
    pub fn counters(&self) -> Counters {
        self.shared.published().counters
    }

    /// The time after which nothing is known of its buses, in UTC nanoseconds since the Unix epoch, and how long ago that
    /// is: when it ended the session, or was last heard of.
    pub(crate) fn last_known(&self) -> (i64, Duration) {
        let now_ns = UtcClock::start().at(Instant::now()).0;
        let published = self.shared.published();
        if let Some(ended_ns) = published.ended_ns {
            return (ended_ns, Duration::from_nanos(now_ns.saturating_sub(ended_ns).max(0) as u64));
        }
        let ago = published.heard_at.map_or(Duration::ZERO, |heard_at| heard_at.elapsed());
        (now_ns.saturating_sub_unsigned(ago.as_nanos() as u64), ago)
    }

    /// What is known about the device's clock.
    pub fn clock(&self) -> ClockReport {
        self.shared.published().clock
    }

    /// The device's time, for whoever needs it often: it is not asked.
    pub fn device_time(&self) -> DeviceTime {
        DeviceTime { shared: Arc::clone(&self.shared), tick_hz: self.hello().tick_hz }
    }

    /// The current map from the device's time to UTC, with the marks that it is based on. It stays valid for as long as
    /// crystals keep their rate: some seconds. Before the device's time is known, a map from tick 0 to the epoch.
    pub fn clock_map(&self) -> Arc<ClockMap> {
        self.shared.clock_map().unwrap_or_else(|| Arc::new(ClockMap::new(self.hello().tick_hz, UtcNs(0))))
    }
}

impl Drop for Device {
    /// Leaves the buses, if this session is on one.
    fn drop(&mut self) {
        if self.may_be_on_a_bus.load(Ordering::Relaxed) && !self.shared.buffer.has_ended() {
            self.session.leave_buses();
        }
    }
}

/// A request under way. Dropping it ignores the answer.
#[must_use = "the answer may be a refusal"]
pub struct Pending<'d>(session::InFlight<'d, Option<TimeAsked>>);

impl Pending<'_> {
    /// Waits for the answer.
    pub fn wait(self) -> Result<Reply, DeviceError> {
        self.0.reply_within(REQUEST_TIMEOUT)
    }
}

/// Captured records, in order. As an iterator, it waits for the next one and ends after [`Device::stop`], or
/// with an error when the device vanished, in both cases after everything received.
pub struct Records {
    shared: Arc<Shared>,
    batch: std::vec::IntoIter<TraceRecord>,
}

impl Records {
    /// The next records in one piece; empty if there are none within `timeout`, `None` after the last.
    pub fn next_batch(&mut self, timeout: Duration) -> Result<Option<Vec<TraceRecord>>, DeviceError> {
        let rest: Vec<TraceRecord> = std::mem::take(&mut self.batch).collect();
        if rest.is_empty() { self.shared.buffer.pop(Some(timeout)) } else { Ok(Some(rest)) }
    }

    /// Frames of each channel that found no room here, because they were not taken fast enough. They are among the device's losses at the
    /// stage `host`.
    pub fn lost(&self) -> [u64; CHANNELS] {
        self.shared.buffer.lost()
    }

    /// Takes back the memory of a batch. Optional, but faster.
    pub fn recycle(&self, batch: Vec<TraceRecord>) {
        self.shared.buffer.recycle(batch);
    }
}

impl Iterator for Records {
    type Item = Result<TraceRecord, DeviceError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(record) = self.batch.next() {
                return Some(Ok(record));
            }
            match self.shared.buffer.pop(None) {
                Ok(Some(batch)) => self.batch = batch.into_iter(),
                Ok(None) => return None,
                Err(error) => return Some(Err(error)),
            }
        }
    }
}
