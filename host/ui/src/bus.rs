//! The device's thread: takes what arrives, records it, keeps it for the pages, and does what they ask for.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use cantap::Channel;
use cantap::device::{Happening, UtcClock, channel_number};
use cantap::wire::message::Mode;
use cantap::wire::record::ErrorState;
use cantap_signals::Decoder;
use cantap_signals::named::NamedFilter;
use cantap_trace::filter::{Filter, passes};
use cantap_trace::{TraceEvent, TraceRecord};
use cantap_work::boards::{Boards, filters_on};
use cantap_work::bus_hints::{BusHint, HintPlace};
use cantap_work::channel_bitrate::ChannelBitrate;
use cantap_work::channel_options::ChannelOptions;
use cantap_work::live::{Lines, lines, return_text};
use cantap_work::reception::Reception;
use cantap_work::recording::{Older, Recording};
use cantap_work::report::{Reporter, Severity};
use cantap_work::{advice, channels::place_of, interrupt};
use serde_json::{Value, json};

use crate::recorder;
use crate::request::{Only, Request};
use crate::sender;
use crate::shared::{Order, Shared};
use crate::state::{ChannelState, DeviceState, RecordingState, State};

/// How long a single wait for records lasts.
const WAIT: Duration = Duration::from_millis(20);
/// How often to ask for the device's state, and to flush a recording.
const FIGURES_EVERY: Duration = Duration::from_millis(500);
/// After so many requests of pages, what has arrived is taken first.
const ORDERS_AT_A_TIME: usize = 8;
/// Below this no controller works, in bit/s.
const LEAST_BITRATE: u32 = 1000;
/// More filters than anybody needs.
const MOST_FILTERS: usize = 64;

/// Which devices, and how.
pub struct Device {
    /// Which.
    pub boards: Boards,
    /// How to open their channels: they only listen unless it says otherwise.
    pub open: ChannelOptions,
    /// What passes; everything if there are none.
    pub filters: Vec<Filter>,
    /// Whether pages may send and take part in the buses.
    pub may_send: bool,
    /// For frames that are given by their signals.
    pub decoder: Decoder,
    /// The folder of recordings that pages begin.
    pub folder: PathBuf,
    /// A recording from the start, into a file that is new; `FILE if CONDITION` for what happens around events.
    pub record: Option<PathBuf>,
    /// What the device sends by itself stops when no page has shown for this long that it is there. Pages show it every second.
    pub dead_man: Duration,
}

/// The device's thread.
pub struct Bus {
    device: Device,
    shared: Arc<Shared>,
    orders: Receiver<Order>,
    reporter: Reporter,
    lines: Option<Lines>,
    recording: Option<Recording>,
    reception: Reception,
    /// The latest record's time.
    latest_ns: i64,
}

impl Bus {
    /// Opens the devices and begins the recording, if one is requested.
    pub fn open(device: Device, reporter: Reporter) -> anyhow::Result<Self> {
        device.open.timing.check_channels(device.boards.addresses().len())?;
        let begin = |text: &PathBuf| Recording::create_by_text(text, &device.decoder, Older::Refuse);
        let recording = device.record.as_ref().map(begin).transpose()?;
        let state = State { may_send: device.may_send, ..State::default() };
        let (shared, orders) = Shared::new(state);
        let shared = Arc::new(shared);
        let mut bus = Self {
            device,
            shared,
            orders,
            reporter,
            lines: None,
            recording,
            reception: Reception::default(),
            latest_ns: 0,
        };
        match bus.connect() {
            Ok(()) => Ok(bus),
            Err(error) => {
                // A recording that could not begin leaves nothing behind.
                if let Some(state) = bus.recording.take().and_then(|mut recording| recording.state().ok())
                    && state.condition.is_none()
                {
                    let _ = std::fs::remove_file(state.path);
                }
                Err(error)
            }
        }
    }

    /// What it shares with the pages' threads.
    pub fn shared(&self) -> Arc<Shared> {
        Arc::clone(&self.shared)
    }

    /// Runs until Ctrl-C or the server's end.
    pub fn run(mut self) {
        let mut recovery: Vec<_> =
            self.device.boards.addresses().iter().map(|_| self.device.open.recovery()).collect();
        let mut next_figures = Instant::now();
        while !interrupt::requested() && !self.shared.is_over() {
            self.receive();
            for _ in 0..ORDERS_AT_A_TIME {
                let Ok(Order { request, answer }) = self.orders.try_recv() else { break };
                let result = self.follow(request).map_err(|error| advice::sentence(&error));
                // The page may have gone.
                let _ = answer.try_send(result);
            }
            let Some(lines) = &self.lines else { continue };
            for (board, device) in lines.devices() {
                // If it does not answer, the stream reports that.
                let back = recovery[board].as_mut().and_then(|recovery| recovery.look(device).ok());
                for channel in back.into_iter().flatten() {
                    let number = channel_number(board, channel);
                    self.shared.notify(
                        Severity::Note,
                        format!("channel {number} was bus-off and joins the bus again"),
                    );
                }
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                self.show_figures();
                self.stop_what_nobody_watches();
            }
        }
        self.disconnect();
        self.stop_recording();
        self.shared.end();
    }

    fn note(&self, text: impl Into<String>) {
        let text = text.into();
        self.reporter.note(&text);
        self.shared.notify(Severity::Note, text);
    }

    fn warn(&self, text: impl Into<String>) {
        let text = text.into();
        self.reporter.warn(&text);
        self.shared.notify(Severity::Warning, text);
    }

    /// Opens the devices as they should be now.
    fn connect(&mut self) -> anyhow::Result<()> {
        let Device { boards, open, filters, .. } = &self.device;
        let (setup_boards, setup_open, setup_filters) = (boards.clone(), open.clone(), filters.clone());
        let reporter = self.reporter.clone();
        let mut lines = lines(boards.addresses(), move |board, device| {
            let (open, filters) = (setup_open.on_board(board), filters_on(board, &setup_filters));
            let channels = setup_boards.channels_of(board);
            open.open(device, channels, Mode::ListenOnly, Some(&filters), &reporter).map(|_| ())
        });
        lines.connect()?;
        self.lines = Some(lines);
        self.reception = Reception::default();
        let is_there = |address: &cantap_address::Address| DeviceState {
            name: address.to_string(),
            is_there: true,
            reason: None,
        };
        let devices = self.device.boards.addresses().iter().map(is_there).collect();
        let (mode, filters) = (self.device.open.mode, &self.device.filters);
        self.shared.change(|state| {
            state.devices = devices;
            state.is_normal = mode.is_some_and(Mode::transmits);
            state.filters = filters.iter().map(ToString::to_string).collect();
            state.periodic.clear();
            state.ended = None;
        });
        self.show_figures();
        Ok(())
    }

    /// Ends the session; what was captured up to then is kept.
    fn disconnect(&mut self) {
        let Some(mut lines) = self.lines.take() else { return };
        // If that fails, a device has just gone.
        let _ = lines.stop();
        loop {
            match lines.next(WAIT).1 {
                Happening::Records(batch) => self.take(&batch),
                Happening::Gone(_) | Happening::Back(_) => {}
                Happening::Ended => return,
            }
        }
    }

    /// Opens the devices in another way; if that fails, as before.
    fn reconnect(&mut self, open: ChannelOptions, filters: Vec<Filter>) -> anyhow::Result<()> {
        let had_periodic = !self.shared.state().periodic.is_empty();
        self.disconnect();
        self.mark_gap();
        let before = (
            std::mem::replace(&mut self.device.open, open),
            std::mem::replace(&mut self.device.filters, filters),
        );
        let result = self.connect();
        if result.is_err() {
            (self.device.open, self.device.filters) = before;
            if let Err(error) = self.connect() {
                self.has_ended(&error);
            }
        }
        if had_periodic {
            self.warn("what the device sent periodically has stopped: its channels were opened anew");
        }
        result
    }

    fn has_ended(&mut self, error: &anyhow::Error) {
        let reason = advice::sentence(error);
        self.lines = None;
        self.warn(&reason);
        self.shared.change(|state| {
            state.ended = Some(reason);
            state.devices.iter_mut().for_each(|device| device.is_there = false);
            state.periodic.clear();
        });
    }

    /// From the latest record to the next one nothing is known.
    fn mark_gap(&mut self) {
        let now_ns = UtcClock::start().at(Instant::now()).0.max(self.latest_ns);
        let channels = self.shared.state().channels;
        let gap = |channel: &ChannelState| TraceRecord {
            time_ns: now_ns,
            channel: channel.channel,
            event: TraceEvent::GAP,
        };
        self.take(&channels.iter().map(gap).collect::<Vec<_>>());
    }

    fn receive(&mut self) {
        let Some(lines) = &mut self.lines else {
            std::thread::sleep(WAIT);
            return;
        };
        match lines.next(WAIT) {
            (_, Happening::Records(batch)) => {
                self.take(&batch);
                if let Some(lines) = &self.lines {
                    lines.recycle(batch);
                }
            }
            (board, Happening::Gone(error)) if self.device.boards.addresses()[board].may_come_back() => {
                let reason = advice::sentence(&error);
                self.warn(format!("{reason}; it continues when the device is back"));
                self.shared.change(|state| {
                    state.periodic.retain(|entry| place_of(entry.channel).0 != board);
                    if let Some(device) = state.devices.get_mut(board) {
                        (device.is_there, device.reason) = (false, Some(reason));
                    }
                });
            }
            (_, Happening::Gone(error)) => {
                self.mark_gap();
                self.has_ended(&error);
            }
            (board, Happening::Back(back)) => {
                let addresses = self.device.boards.addresses();
                let name = (addresses.len() > 1).then(|| &addresses[board]);
                // The first time, no absence preceded it.
                if back.after.is_some() {
                    self.note(return_text(board, name, &back));
                }
                self.shared.change(|state| {
                    if let Some(device) = state.devices.get_mut(board) {
                        (device.is_there, device.reason) = (true, None);
                    }
                });
            }
            // Nobody has stopped it.
            (_, Happening::Ended) => {}
        }
    }

    /// Records first, then keeps it for the pages.
    fn take(&mut self, records: &[TraceRecord]) {
        let filters = &self.device.filters;
        let is_wanted = |record: &&TraceRecord| record.frame().is_none() || passes(filters, record);
        let passed: Vec<TraceRecord>;
        let records = if filters.is_empty() {
            records
        } else {
            passed = records.iter().filter(is_wanted).copied().collect();
            &passed
        };
        if let Some(last) = records.last() {
            self.latest_ns = self.latest_ns.max(last.time_ns);
        }
        if let Some(recording) = &mut self.recording
            && let Err(error) = recording.write(records)
        {
            self.recording_failed(&error);
        }
        self.shared.backlog.push(records);
        let now = Instant::now();
        self.reception.take(records, now);
        if self.device.filters.is_empty() {
            for number in self.reception.news(now) {
                let (board, channel) = place_of(number);
                let name =
                    self.device.boards.addresses().get(board).map(ToString::to_string).unwrap_or_default();
                let hint = self.reception.hint(number, false).unwrap_or(BusHint::WrongBitRate);
                let place = HintPlace { number, device: &name, channel_there: channel.number() };
                self.warn(hint.sentence(&place));
            }
        }
    }

    fn show_figures(&mut self) {
        let Some(lines) = &self.lines else { return };
        let mut channels = Vec::new();
        for (board, device) in lines.devices() {
            // If it does not answer, the stream reports that.
            let Ok(status) = device.status() else { return };
            let clock_hz = device.hello().can_clock_hz;
            for (channel, config) in device.open_channels() {
                let of = &status.channels[channel.index()];
                channels.push(ChannelState {
                    channel: channel_number(board, channel),
                    bitrate: config.timing.bitrate_bps(clock_hz),
                    state: of.state.name(),
                    counters: (of.tec, of.rec),
                });
            }
        }
        let recording = match self.recording.as_mut().map(Recording::state).transpose() {
            Ok(recording) => recording.map(|recording| RecordingState::new(recording, self.latest_ns)),
            Err(error) => {
                self.recording_failed(&error.into());
                None
            }
        };
        self.shared.change(|state| {
            // Those of a device that is away stay as they were.
            if state.devices.iter().all(|device| device.is_there) {
                state.channels = channels;
            }
            state.recording = recording;
        });
    }

    fn stop_what_nobody_watches(&mut self) {
        let entries = self.shared.state().periodic;
        if entries.is_empty() || self.shared.silence() < self.device.dead_man {
            return;
        }
        let Some(lines) = &self.lines else { return };
        let mut result = Ok(());
        for entry in &entries {
            result = result.and(sender::stop(lines, entry.channel, entry.slot));
        }
        if let Err(error) = result {
            self.warn(advice::sentence(&error));
            return;
        }
        self.shared.change(|state| state.periodic.clear());
        self.warn(format!(
            "no page has been there for {} s: what the device sent periodically has stopped",
            self.device.dead_man.as_secs()
        ));
    }

    fn follow(&mut self, request: Request) -> anyhow::Result<Value> {
        match request {
            Request::Record { name, only } => {
                if let Some(recording) = self.shared.state().recording {
                    bail!("{} is being recorded; stop that first", recording.name);
                }
                let Device { folder, decoder, .. } = &self.device;
                self.recording = Some(recorder::create(folder, &name, only.as_ref(), decoder)?);
                self.note(match only {
                    Some(Only { around, .. }) => format!("{name} begins when {around}"),
                    None => format!("recording to {name}"),
                });
                self.show_figures();
            }
            Request::StopRecording {} => self.stop_recording(),
            Request::Bitrate { channel, bitrate } => self.set_bitrate(channel, bitrate)?,
            Request::Filters { filters } => {
                if filters.len() > MOST_FILTERS {
                    bail!("{} filters are too many; give at most {MOST_FILTERS}", filters.len());
                }
                let filters = filters.iter().map(|text| self.filter(text)).collect::<anyhow::Result<_>>()?;
                self.reconnect(self.device.open.clone(), filters)?;
            }
            Request::Mode { normal, confirmed } => self.set_mode(normal, confirmed)?,
            Request::Send { channel, frame } => {
                let lines = self.sending_lines()?;
                sender::send(lines, channel, sender::frame(&self.device.decoder, channel, &frame)?)?;
            }
            Request::Periodic { channel, frame, period_ms, modifiers } => {
                let lines = self.sending_lines()?;
                let frame = sender::frame(&self.device.decoder, channel, &frame)?;
                let entries = self.shared.state().periodic;
                let entry = sender::start(lines, &entries, channel, frame, period_ms, &modifiers)?;
                let slot = entry.slot;
                self.shared.change(|state| state.periodic.push(entry));
                return Ok(json!({ "slot": slot }));
            }
            Request::StopPeriodic { channel, slot } => {
                let lines = self.lines.as_ref().context("no device is open")?;
                sender::stop(lines, channel, slot)?;
                self.shared.change(|state| {
                    state.periodic.retain(|entry| (entry.channel, entry.slot) != (channel, slot));
                });
            }
            Request::Recover {} => self.recover()?,
        }
        Ok(json!({}))
    }

    /// A filter as the command takes it, with the databases' names of messages.
    fn filter(&self, text: &str) -> anyhow::Result<Filter> {
        let named = text.parse::<NamedFilter>().map_err(|error| anyhow::anyhow!("{error}"))?;
        Ok(named.resolve(&self.device.decoder)?)
    }

    fn may_send(&self) -> anyhow::Result<()> {
        if self.device.may_send {
            return Ok(());
        }
        bail!("pages of this server only listen; start it with cantap ui --allow send")
    }

    /// The devices, if they may send now.
    fn sending_lines(&self) -> anyhow::Result<&Lines> {
        self.may_send()?;
        if !self.shared.state().is_normal {
            bail!(
                "the channels only listen; choose normal mode first, in which they take part in their buses"
            );
        }
        self.lines.as_ref().context("no device is open")
    }

    fn set_mode(&mut self, normal: bool, confirmed: bool) -> anyhow::Result<()> {
        let mode = if normal {
            self.may_send()?;
            if !confirmed {
                bail!(
                    "normal mode acknowledges frames and takes part in the bus; the user has to confirm it"
                );
            }
            Mode::Normal
        } else {
            Mode::ListenOnly
        };
        if normal == self.shared.state().is_normal {
            return Ok(());
        }
        let open = ChannelOptions { mode: Some(mode), ..self.device.open.clone() };
        self.reconnect(open, self.device.filters.clone())?;
        self.note(if normal { "the channels take part in their buses" } else { "the channels only listen" });
        Ok(())
    }

    fn set_bitrate(&mut self, channel: u8, bitrate_bps: u32) -> anyhow::Result<()> {
        let state = self.shared.state();
        if bitrate_bps < LEAST_BITRATE {
            bail!("{bitrate_bps} bit/s is no bit rate of a bus; give for example 500000");
        }
        if state.channels.iter().all(|open| open.channel != channel) {
            bail!("channel {channel} is not open; choose one that is");
        }
        let rates = state.channels.iter().map(|open| ChannelBitrate {
            channel: Some(open.channel),
            bitrate_bps: if open.channel == channel { bitrate_bps } else { open.bitrate },
        });
        let mut open = self.device.open.clone();
        open.timing.set_bit_rates(rates);
        // The user has agreed to take part at another bit rate.
        open.mode = Some(Mode::ListenOnly);
        self.reconnect(open, self.device.filters.clone())?;
        let listens = if state.is_normal { ", and all channels only listen now" } else { "" };
        self.note(format!("channel {channel} is at {bitrate_bps} bit/s{listens}"));
        Ok(())
    }

    fn recover(&self) -> anyhow::Result<()> {
        let lines = self.sending_lines()?;
        let mut recovered = 0;
        for (_, device) in lines.devices() {
            let status = device.status()?;
            for (channel, state) in Channel::ALL.into_iter().zip(&status.channels) {
                if state.open.is_some() && state.state == ErrorState::BusOff {
                    device.recover(channel)?;
                    recovered += 1;
                }
            }
        }
        if recovered == 0 {
            bail!("no channel is bus-off");
        }
        Ok(())
    }

    fn stop_recording(&mut self) {
        if let Some(recording) = self.recording.take() {
            self.note(recording.finish());
            self.shared.change(|state| state.recording = None);
        }
    }

    fn recording_failed(&mut self, error: &anyhow::Error) {
        self.stop_recording();
        self.warn(Recording::failure(error));
    }
}
