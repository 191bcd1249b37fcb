//! The device's thread: takes what arrives, records it, keeps it for the pages, and does what they ask for.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use cantap::device::{Happening, UtcClock, channel_number};
use cantap::wire::message::{Mode, Role};
use cantap_address::Address;
use cantap_trace::filter::{Filter, passes};
use cantap_trace::{TraceEvent, TraceRecord};
use cantap_work::bus_hints::{BusHint, HintPlace};
use cantap_work::channel_options::ChannelOptions;
use cantap_work::live::{Line, Lines, return_text};
use cantap_work::reception::Reception;
use cantap_work::recording::{Older, Recording};
use cantap_work::report::{Reporter, Severity};
use cantap_work::requested_rate::RequestedRate;
use cantap_work::{advice, channels::place_of, interrupt};

use crate::device::Device;
use crate::sender;
use crate::shared::{Order, Shared};
use crate::state::{ChannelState, DeviceState, RecordingState, State};
use crate::vehicle::Vehicle;
use crate::visits::Visits;

/// How long a single wait for records lasts.
const WAIT: Duration = Duration::from_millis(20);
/// The same while a vehicle's answer is awaited: what it sends wants its flow control soon.
const SHORT_WAIT: Duration = Duration::from_millis(1);
/// How often to ask for the device's state, and to flush a recording.
const FIGURES_EVERY: Duration = Duration::from_millis(500);
/// After so many requests of pages, what has arrived is taken first.
const ORDERS_AT_A_TIME: usize = 8;

/// The device's thread.
pub struct Bus {
    pub(crate) device: Device,
    pub(crate) shared: Arc<Shared>,
    orders: Receiver<Order>,
    reporter: Reporter,
    pub(crate) visits: Visits,
    pub(crate) lines: Option<Lines>,
    /// How shared devices are opened when the first page comes, whatever earlier ones have changed.
    at_first: (ChannelOptions, Vec<Filter>),
    pub(crate) recording: Option<Recording>,
    reception: Reception,
    pub(crate) vehicle: Vehicle,
    /// The latest record's time.
    latest_ns: i64,
}

impl Bus {
    /// Opens the devices and begins the recording, if one is requested.
    pub fn open(device: Device, reporter: Reporter, visits: Visits) -> anyhow::Result<Self> {
        device.open.timing.check_channels(device.boards.addresses().len())?;
        let begin =
            |text: &PathBuf| Recording::create_by_text(text, &device.decoder, Older::Refuse, Vec::new());
        let recording = device.record.as_ref().map(begin).transpose()?;
        let state = State {
            may_send: device.role >= Role::Send,
            may_configure: device.role >= Role::Configure,
            may_record: device.folder.is_some(),
            send_option: device.option(Role::Send),
            ..State::default()
        };
        let at_first = (device.open.clone(), device.filters.clone());
        let (shared, orders) = Shared::new(state);
        let shared = Arc::new(shared);
        let mut bus = Self {
            device,
            shared,
            orders,
            reporter,
            visits,
            lines: None,
            at_first,
            recording,
            reception: Reception::default(),
            vehicle: Vehicle::default(),
            latest_ns: 0,
        };
        // Those that are shared are opened for the first page.
        if bus.device.hosted.is_some() {
            return Ok(bus);
        }
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
    pub fn run(self) {
        self.run_while(|| true);
    }

    /// The same; when no page has been there for some time, it goes on only if this says so.
    pub fn run_while(mut self, goes_on: impl Fn() -> bool) {
        let mut recovery: Vec<_> =
            self.device.boards.addresses().iter().map(|_| self.device.open.recovery()).collect();
        let mut next_figures = Instant::now();
        while !interrupt::requested() && !self.shared.is_over() {
            if self.come_and_go() && !goes_on() {
                break;
            }
            self.receive();
            for _ in 0..ORDERS_AT_A_TIME {
                let Ok(order) = self.orders.try_recv() else { break };
                self.obey(order);
            }
            self.ask_vehicle();
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

    /// Shared devices are listened to while pages are there, and a little longer: without any, whoever shares them with others is not kept
    /// from anything. Returns whether they are at rest.
    fn come_and_go(&mut self) -> bool {
        let Some(hosted) = &self.device.hosted else { return false };
        let has_pages = self.shared.has_pages();
        let is_at_rest = !has_pages && self.shared.silence() >= hosted.linger;
        if is_at_rest && self.lines.is_some() {
            self.rest();
        }
        if has_pages && self.lines.is_none() {
            self.connect_when_there();
        }
        is_at_rest
    }

    fn rest(&mut self) {
        self.disconnect();
        self.mark_gap();
        (self.device.open, self.device.filters) = self.at_first.clone();
        self.shared.change(|state| {
            state.is_normal = false;
            state.periodic.clear();
        });
    }

    pub(crate) fn note(&self, text: impl Into<String>) {
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
        let mut lines = self.device.lines(&self.reporter);
        lines.connect()?;
        self.begin(lines);
        // What was found by listening is not looked for again when something else changes.
        if self.device.open.timing.has_auto() {
            self.device.open = self.at_rates(&self.shared.state().channels);
        }
        Ok(())
    }

    /// How to open the devices with the bit rates that these channels have; the others as before.
    pub(crate) fn at_rates(&self, channels: &[ChannelState]) -> ChannelOptions {
        let mut open = self.device.open.clone();
        for of in channels.iter().filter(|of| of.bitrate.is_some()) {
            let rate = RequestedRate { channel: Some(of.channel), bitrate_bps: of.bitrate };
            open.timing.set_bit_rate_of(rate);
        }
        open
    }

    /// The same for devices of which some may be away: they are opened as soon as they are there.
    fn connect_when_there(&mut self) {
        let mut lines = self.device.lines(&self.reporter);
        // What is not there is tried again, and says why.
        let _ = lines.connect();
        self.begin(lines);
    }

    fn begin(&mut self, lines: Lines) {
        self.reception = Reception::default();
        let state_of = |(address, line): (&Address, &Line)| DeviceState {
            name: address.to_string(),
            is_there: line.device().is_some(),
            reason: None,
        };
        let devices = self.device.boards.addresses().iter().zip(lines.lines()).map(state_of).collect();
        self.lines = Some(lines);
        let (mode, filters) = (self.device.open.mode, &self.device.filters);
        self.shared.change(|state| {
            state.devices = devices;
            state.is_normal = mode.is_some_and(Mode::transmits);
            state.filters = filters.iter().map(ToString::to_string).collect();
            state.periodic.clear();
            state.ended = None;
        });
        self.show_figures();
    }

    /// Ends the session; what was captured up to then is kept.
    fn disconnect(&mut self) {
        let Some(mut lines) = self.lines.take() else { return };
        self.vehicle.forget("its channels were opened anew");
        self.show_vehicle();
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
    pub(crate) fn reconnect(&mut self, open: ChannelOptions, filters: Vec<Filter>) -> anyhow::Result<()> {
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
            match self.connect() {
                Err(_) if self.device.hosted.is_some() => self.connect_when_there(),
                Err(error) => self.has_ended(&error),
                Ok(()) => {}
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
        self.vehicle.forget(&reason);
        self.show_vehicle();
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
            device_ns: None,
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
        match lines.next(if self.vehicle.is_urgent() { SHORT_WAIT } else { WAIT }) {
            (_, Happening::Records(batch)) => {
                self.take(&batch);
                if let Some(lines) = &self.lines {
                    lines.recycle(batch);
                }
            }
            (board, Happening::Gone(error)) if self.device.may_come_back(board) => {
                let reason = advice::sentence(&error);
                self.warn(format!("{reason}; it continues when the device is back"));
                if board == 0 {
                    self.vehicle.forget(&reason);
                    self.show_vehicle();
                }
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
        self.vehicle.take(records);
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

    pub(crate) fn show_figures(&mut self) {
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
                    bitrate: config.timing.known_bitrate_bps(clock_hz),
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

    fn ask_vehicle(&mut self) {
        let device = self.lines.as_ref().and_then(|lines| lines.devices().find(|(board, _)| *board == 0));
        if self.vehicle.go_on(device.map(|(_, device)| device)) {
            self.show_vehicle();
        }
    }

    pub(crate) fn show_vehicle(&self) {
        let vehicle = self.vehicle.state();
        self.shared.change(|state| state.vehicle = vehicle);
    }

    fn stop_what_nobody_watches(&mut self) {
        if self.shared.silence() < self.device.dead_man {
            return;
        }
        if self.vehicle.is_asked() {
            self.vehicle.leave();
            self.show_vehicle();
        }
        let entries = self.shared.state().periodic;
        if entries.is_empty() {
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

    pub(crate) fn stop_recording(&mut self) {
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
