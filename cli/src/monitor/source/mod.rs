//! Where the records come from: a thread that reads a device or plays a file, records, and fills the model.
//!
//! It holds the model's lock only to hand over what it has, so that the display cannot make it late; a
//! device's own buffer in the library bridges a slow moment.

mod autobaud;
mod device;
mod playback;

use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cantap::device::channel_number;
use cantap::wire::CHANNELS;
use cantap::wire::message::Mode;
use cantap::{Channel, Frame, TraceRecord};

use super::model::Model;
use super::recorder::Recorder;
use crate::address::Address;
use crate::channel_args::ChannelArgs;
use crate::channel_bitrate::ChannelBitrate;

/// The model, shared by the source thread and the display.
pub type Shared = Arc<Mutex<Model>>;

/// Locks the model. Nobody leaves it half changed.
pub fn lock(model: &Mutex<Model>) -> MutexGuard<'_, Model> {
    model.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Which devices, and how to take part in their buses.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The devices. The second one's channels are 3 and 4, and so on.
    pub addresses: Vec<Address>,
    /// Channels to open, by number.
    pub channels: Vec<u8>,
    /// How to open them, as on the command line; only listening where it does not say.
    pub open: ChannelArgs,
}

impl Plan {
    /// Only listening to devices, on the channels whose bit rates are known; on all if none is.
    pub fn listening(addresses: Vec<Address>, options: &cantap_analysis::stats::Options) -> Self {
        let mut plan = Self { addresses, channels: Vec::new(), open: ChannelArgs::default() };
        for channel in plan.all_channels() {
            let rate = options.bitrate_of(channel);
            let rates = rate.map(|bitrate_bps| ChannelBitrate { channel: Some(channel), bitrate_bps });
            plan.open.timing.bitrates.extend(rates);
        }
        plan.choose_channels();
        plan
    }

    /// The same with other devices. With more or fewer of them, it has other channels, too.
    pub fn at(&self, addresses: Vec<Address>) -> Self {
        let is_as_many = addresses.len() == self.addresses.len();
        let mut plan = Self { addresses, ..self.clone() };
        if !is_as_many {
            plan.choose_channels();
        }
        plan
    }

    /// What messages call the devices.
    pub fn name(&self) -> String {
        let names: Vec<String> = self.addresses.iter().map(ToString::to_string).collect();
        names.join(" + ")
    }

    /// The channels of a device, from 0, that are to be opened.
    pub fn channels_of(&self, board: usize) -> impl Iterator<Item = Channel> + use<'_> {
        Channel::ALL
            .into_iter()
            .filter(move |channel| self.channels.contains(&channel_number(board, *channel)))
    }

    /// The numbers of all channels that the devices have.
    fn all_channels(&self) -> std::ops::RangeInclusive<u8> {
        1..=(self.addresses.len() * CHANNELS) as u8
    }

    /// How it takes part in the buses.
    pub fn mode(&self) -> Mode {
        self.open.mode().unwrap_or(Mode::ListenOnly)
    }

    /// Other bit rates, in place of whatever timing there was. A rate that is for one channel alone opens that channel alone.
    pub fn set_bit_rates(&mut self, rates: Vec<ChannelBitrate>) {
        self.open.timing.set_bit_rates(rates);
        self.choose_channels();
    }

    /// The channels that bit rates speak of; all if there are none.
    pub fn choose_channels(&mut self) {
        let rates = &self.open.timing.bitrates;
        self.channels = self
            .all_channels()
            .filter(|channel| rates.is_empty() || ChannelBitrate::of(rates, *channel).is_some())
            .collect();
    }

    /// The statistics' options with this plan's bit rates, as far as it has any.
    pub fn options(&self, others: &cantap_analysis::stats::Options) -> cantap_analysis::stats::Options {
        let rates = self.channels.iter().copied().filter_map(|number| {
            let own = ChannelBitrate::of(&self.open.timing.bitrates, number);
            Some((number, own.or_else(|| others.bitrate_of(number))?))
        });
        cantap_analysis::stats::Options {
            bitrate_bps: None,
            channel_bitrate_bps: rates.collect(),
            ..others.clone()
        }
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
    /// Send a frame once, on the channel with this number.
    Send(u8, Frame),
    /// Let the device send a frame periodically; `None` ends it.
    SetPeriodic(u8, u8, Option<(Frame, Duration)>),
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
    /// Find the bit rates of the device's channels, only listening; stop doing so.
    Autobaud,
    /// Another device, other bit rates, another mode.
    Open(Plan),
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
            self.recording_failed(&error);
        }
        lock(self.model).take(records);
    }

    fn record(&mut self, path: &Path) {
        self.stop_recording();
        let decoder = Arc::clone(lock(self.model).seen.signals.decoder());
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

    fn recording_failed(&mut self, error: &std::io::Error) {
        self.stop_recording();
        self.notice(format!("recording ended: {error}; check the disk's free space"));
    }

    fn show_recording(&mut self) {
        let Some(recorder) = &mut self.recorder else {
            return;
        };
        match recorder.state() {
            Ok(state) => lock(self.model).recording = Some(state),
            Err(error) => self.recording_failed(&error),
        }
    }

    /// Orders that any source follows.
    fn follow(&mut self, order: Order) -> Then {
        match order {
            Order::Record(path) => self.record(&path),
            Order::StopRecording => self.stop_recording(),
            Order::Open(plan) => return Then::Reopen(plan),
            Order::Autobaud => return Then::Autobaud,
            Order::Quit => return Then::Quit,
            Order::Send(..) => self.notice("there is no device to send with; open one with D"),
            Order::SetPeriodic(channel, slot, _) => {
                self.notice("there is no device to send with; open one with D");
                lock(self.model).refused.push((channel, slot));
            }
            Order::Faster | Order::Slower | Order::TogglePause | Order::Step | Order::ToggleLoop => {
                self.notice("only a file can be played slower, faster or in steps");
            }
        }
        Then::GoOn
    }
}
