//! A device, for Python. Every waiting call lets other Python threads run, and Ctrl-C through.

mod channel_options;
pub mod diagnostics;
pub mod disturb;
mod fanout;
mod gateway;
mod lock;
pub mod odx;
mod records;
pub mod selftest;
mod session;
mod tasks;
mod transmissions;
mod waiting;

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use cantap::bit_timing::TimingRequest;
use cantap::device::{ClockSource, Transmission};
use cantap::wire::message::capability;
use cantap::wire::message::{ChannelConfig, Mode};
use cantap::wire::{BitTiming, Channel, Refusal};
use cantap::{DeviceError as DeviceFault, TraceFrame};
use cantap_trace::filter::Filter;
use cantap_trace::{BusErrorKind, TransmitFailure};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde_json::json;

use self::channel_options::ChannelOptions;
use self::fanout::{SentFrames, Wanted};
use self::gateway::Gateway;
use self::lock::lock;
use self::records::{Records, SLICE};
use self::session::{HowToSend, Session};
use self::tasks::{PeriodicFrame, Reply};
use self::transmissions::{NOBODY, SenderId};
use self::waiting::{duration, signals};
use crate::error::{DeviceError, Error};
use crate::frame::AnyFrame;
use crate::grammar::{OfDevice, Seconds};
use crate::number::Whole;
use crate::report::from_json;

/// A device in a session of this program.
#[pyclass(module = "cantap", frozen, weakref)]
pub struct Device {
    session: Mutex<Option<Arc<Session>>>,
    gateway: Mutex<Option<Gateway>>,
}

/// This computer's UTC in nanoseconds since 1970.
fn utc_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    since.as_nanos() as i64
}

/// The error for a frame that was not sent.
fn not_sent(end: &Transmission, frame: &TraceFrame) -> Error {
    let reason = end.result.err().map_or("", TransmitFailure::name);
    Error::Address(format!("{frame} was not sent on channel {}: {reason}", end.channel.number()))
}

impl Device {
    fn session(&self) -> Result<Arc<Session>, Error> {
        let session = lock(&self.session).clone();
        let session =
            session.ok_or_else(|| Error::Address("the device is closed; open it again".to_owned()))?;
        session.device()?;
        Ok(session)
    }

    /// Sends a request to the device while other Python threads run.
    fn ask<T: Send>(
        &self,
        py: Python<'_>,
        question: impl FnOnce(&cantap::Device) -> Result<T, DeviceFault> + Send,
    ) -> PyResult<T> {
        let session = self.session()?;
        Ok(py.detach(|| question(session.device()?).map_err(Error::from))?)
    }
}

#[pymethods]
impl Device {
    #[new]
    fn new(py: Python<'_>, address: String) -> PyResult<Self> {
        let session = py.detach(|| Session::open(&address))?;
        Ok(Self { session: Mutex::new(Some(Arc::new(session))), gateway: Mutex::new(None) })
    }

    /// Its address.
    #[getter]
    fn address(&self) -> PyResult<String> {
        Ok(self.session()?.address.clone())
    }

    /// Whether it is closed.
    #[getter]
    fn closed(&self) -> bool {
        lock(&self.session).is_none()
    }

    /// Whether a vehicle with its own database is on its buses.
    #[getter]
    fn is_virtual_car(&self) -> PyResult<bool> {
        Ok(self.session()?.is_car)
    }

    /// The device's description.
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let session = self.session()?;
        let hello = session.device()?.hello();
        let [major, minor, patch] = hello.firmware;
        let object = json!({
            "board": hello.board.as_str(),
            "serial": hello.serial.as_str(),
            "firmware": format!("{major}.{minor}.{patch}"),
            "protocol": hello.protocol,
            "channels": hello.channels,
            "tick_hz": hello.tick_hz,
            "can_clock_hz": hello.can_clock_hz,
            "tx_queue": hello.tx_queue,
            "periodic_slots": hello.periodic_slots,
            "reply_slots": hello.trigger_slots,
            "transmits": hello.capabilities & capability::TRANSMIT != 0,
            "transmits_fd": hello.sends_fd(),
        });
        from_json(py, &object.to_string())
    }

    /// Opens a channel. Returns its bit rate, and what part of its filters is left to this computer.
    fn open_channel(
        &self,
        py: Python<'_>,
        number: OfDevice,
        options: ChannelOptions,
    ) -> PyResult<(Option<u32>, Option<String>)> {
        let channel = number.0;
        let session = self.session()?;
        let opened = py.detach(|| -> Result<_, Error> {
            let device = session.device()?;
            let Some(mode) = Mode::from_name(&options.mode) else {
                let words = format!(
                    "'{}' is not a mode; there are listen-only, normal, loopback and silent-loopback",
                    options.mode
                );
                return Err(Error::argument(words));
            };
            let filters =
                options.filters.iter().map(|text| text.parse::<Filter>()).collect::<Result<Vec<_>, _>>();
            let filters = filters.map_err(Error::argument)?;
            let clock_hz = device.hello().can_clock_hz;
            let request = match options.segments {
                Some((prescaler, segment1, segment2, jump_width)) => {
                    Some(TimingRequest::Exact(BitTiming { prescaler, segment1, segment2, jump_width }))
                }
                None => options.bitrate.or_else(|| session.bitrate_of_bus(channel)).map(|bitrate_bps| {
                    let sample_point_percent = options.sample_point;
                    TimingRequest::Rate { bitrate_bps, sample_point_percent, sjw: options.sjw }
                }),
            };
            let timing = if let Some(request) = request {
                request.resolve(clock_hz).map_err(Error::argument)?
            } else if let Some(saved) = device.defaults(channel)? {
                saved.config.timing
            } else if device.hello().capabilities & capability::NO_BIT_RATE != 0 {
                BitTiming::UNKNOWN
            } else {
                return Err(Error::argument(format!(
                    "nothing is saved on the device for channel {}; give bitrate=, such as 500_000",
                    channel.number()
                )));
            };
            let config = ChannelConfig {
                mode,
                one_shot: options.one_shot,
                manual_recovery: options.manual_recovery,
                ..ChannelConfig::listen_only(timing)
            };
            let remainder = session.open_channel(channel, config, &filters)?;
            Ok((timing.known_bitrate_bps(clock_hz), remainder.map(|remainder| remainder.to_string())))
        })?;
        Ok(opened)
    }

    /// Finds the bit rate of a closed channel's bus, in bit/s.
    fn autobaud(&self, py: Python<'_>, number: OfDevice, silence: Seconds) -> PyResult<u32> {
        let session = self.session()?;
        let silence = duration(silence)?;
        Ok(py.detach(|| session.find_bitrate(number.0, silence, signals))?)
    }

    /// Times keep the device's own intervals from now on.
    fn keep_intervals(&self) -> PyResult<()> {
        self.session()?.device()?.keep_intervals();
        Ok(())
    }

    /// Closes a channel, after everything it captured has arrived.
    fn close_channel(&self, py: Python<'_>, number: OfDevice) -> PyResult<()> {
        let channel = number.0;
        self.ask(py, |device| device.close_channel(channel))
    }

    /// The open channels: by number, bit rate and mode.
    fn open_channels<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let session = self.session()?;
        let device = session.device()?;
        let open = PyDict::new(py);
        for (channel, config) in device.open_channels() {
            let about = PyDict::new(py);
            about.set_item("bitrate", config.timing.known_bitrate_bps(device.hello().can_clock_hz))?;
            about.set_item("mode", config.mode.name())?;
            open.set_item(channel.number(), about)?;
        }
        Ok(open)
    }

    /// Starts listening; at most `capacity` records wait. With a `node`, what others have sent was received: see [`SentFrames::AsNode`].
    #[pyo3(signature = (channel_number=None, filters=vec![], only_received=false, capacity=Whole(1 << 20), node=None))]
    fn records(
        slf: &Bound<'_, Self>,
        channel_number: Option<OfDevice>,
        filters: Vec<String>,
        only_received: bool,
        capacity: Whole<usize>,
        node: Option<SenderId>,
    ) -> PyResult<Records> {
        let session = slf.get().session()?;
        let filters = filters.iter().map(|text| text.parse()).collect::<Result<Vec<Filter>, _>>();
        let filters = filters.map_err(Error::argument)?;
        let channel = channel_number.map(|channel| channel.0.number());
        let sent = match (node, only_received) {
            (Some(me), _) => SentFrames::AsNode { me, own: !only_received },
            (None, true) => SentFrames::No,
            (None, false) => SentFrames::All,
        };
        let listener = session.fanout.listen(Wanted { channel, filters, sent }, capacity.0);
        Ok(Records::new(slf.clone().into_any().unbind(), session.address.clone(), listener))
    }

    /// Sends frames and returns when each was on the bus, in nanoseconds since 1970; without `timeout` they are only passed to the device.
    /// `node`: who sends them, see [`Self::records`].
    #[expect(clippy::too_many_arguments, reason = "what Python's half passes, each by its name")]
    #[pyo3(signature = (number, frames, timeout, at_ns=None, queue_timeout=1.0, node=NOBODY))]
    fn send(
        &self,
        py: Python<'_>,
        number: OfDevice,
        frames: Vec<AnyFrame>,
        timeout: Option<Seconds>,
        at_ns: Option<i64>,
        queue_timeout: f64,
        node: SenderId,
    ) -> PyResult<Vec<i64>> {
        let channel = number.0;
        let session = self.session()?;
        let frames: Vec<TraceFrame> = frames.into_iter().map(|frame| frame.0).collect();
        let seconds = timeout.map_or(queue_timeout, |timeout| timeout.0);
        let patience = duration(Seconds(seconds))?;
        if let (Some(_), Some(at_ns)) = (timeout, at_ns) {
            let ahead_s = at_ns.saturating_sub(utc_ns()) as f64 / 1e9;
            if ahead_s > patience.as_secs_f64() {
                return Err(Error::argument(format!(
                    "the send time is {ahead_s:.3} s ahead, and timeout= includes the time until then: give more than {seconds} s"
                ))
                .into());
            }
        }
        let ended = py.detach(|| -> Result<_, Error> {
            let device = session.device()?;
            let at_ticks = at_ns.map(|at_ns| device.clock_map().ticks(cantap::device::UtcNs(at_ns)).0);
            let deadline = Instant::now() + patience;
            let how = HowToSend { sender: node, at_ticks, is_told: timeout.is_some(), deadline };
            let sending = session.send(channel, &frames, how, signals)?;
            let ended = sending.wait(deadline, SLICE, signals);
            // It must not surprise anyone by being sent later.
            if timeout.is_some() && !matches!(ended, Ok(Some(_))) {
                device.abort(channel)?;
            }
            ended
        })?;
        let Some(ended) = ended else {
            return Err(DeviceError::new_err(format!(
                "not sent on channel {} within {} s, and taken back; does another node acknowledge, at the same bit rate?",
                channel.number(),
                patience.as_secs_f64()
            )));
        };
        for (end, frame) in ended.iter().zip(&frames) {
            if end.result.is_err() {
                return Err(not_sent(end, frame).into());
            }
        }
        Ok(ended.iter().map(|end| end.time_ns).collect())
    }

    /// Withdraws what a channel still has to send.
    fn abort(&self, py: Python<'_>, number: OfDevice) -> PyResult<()> {
        let channel = number.0;
        self.ask(py, |device| device.abort(channel))
    }

    /// Passes a frame to the device, unless its queue is full: then this returns false.
    fn send_now(&self, py: Python<'_>, number: OfDevice, frame: AnyFrame, node: SenderId) -> PyResult<bool> {
        let session = self.session()?;
        let sent = py.detach(|| {
            let how = HowToSend { sender: node, at_ticks: None, is_told: false, deadline: Instant::now() };
            session.send(number.0, &[frame.0], how, || Ok(())).map(drop)
        });
        match sent {
            Err(Error::Device(DeviceFault::Refused { refusal: Refusal::QueueFull { .. } })) => Ok(false),
            sent => Ok(sent.map(|()| true)?),
        }
    }

    /// Opens a channel anew with other filters; what it misses meanwhile is a loss.
    fn reopen(&self, py: Python<'_>, number: OfDevice, filters: Vec<String>) -> PyResult<()> {
        let session = self.session()?;
        let filters = filters.iter().map(|text| text.parse()).collect::<Result<Vec<Filter>, _>>();
        let filters = filters.map_err(Error::argument)?;
        Ok(py.detach(|| session.reopen(number.0, &filters))?)
    }

    /// Starts a periodic frame.
    #[expect(clippy::too_many_arguments, reason = "what Python's half passes, each by its name")]
    #[pyo3(signature = (number, frame, period, count, modifiers, node=NOBODY))]
    fn periodic(
        &self,
        py: Python<'_>,
        number: OfDevice,
        frame: AnyFrame,
        period: Seconds,
        count: Whole<u32>,
        modifiers: Vec<tasks::ModifierWords>,
        node: SenderId,
    ) -> PyResult<PeriodicFrame> {
        let channel = number.0;
        let session = self.session()?;
        let frame = frame.classic("what a device repeats")?;
        let begin = || PeriodicFrame::begin(session, channel, frame, period, count.0, &modifiers, node);
        Ok(py.detach(begin)?)
    }

    /// Starts a reply.
    fn reply(
        &self,
        py: Python<'_>,
        number: OfDevice,
        to: tasks::Match,
        frame: AnyFrame,
        count: Whole<u32>,
    ) -> PyResult<Reply> {
        let channel = number.0;
        let session = self.session()?;
        let frame = frame.classic("a reply")?;
        Ok(py.detach(|| Reply::begin(session, channel, to, frame, count.0))?)
    }

    /// The status of the device and its channels.
    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (status, counts_losses) =
            self.ask(py, |device| Ok((device.status()?, device.hello().counts_losses())))?;
        let channels = Channel::ALL.map(|channel| {
            let state = &status.channels[channel.index()];
            json!({
                "channel": channel.number(),
                "is_open": state.open.is_some(),
                "mode": state.open.map(|config| config.mode.name()),
                "state": state.state.name(),
                "tec": state.tec,
                "rec": state.rec,
                "last_error": state.last_error.map(BusErrorKind::name),
                "frames": state.frames,
                "lost_controller": counts_losses.then_some(state.lost_controller),
                "lost_queue": state.lost_queue,
                "bus_errors": state.bus_errors,
                "transmitted": state.transmitted,
                "transmit_failures": state.transmit_failures,
                "tx_pending": state.tx_pending,
            })
        });
        let object = json!({
            "queue_bytes": status.queue_bytes,
            "queue_high_water_bytes": status.queue_high_water_bytes,
            "temperature_c": status.temperature_decicelsius.map(|tenths| f64::from(tenths) / 10.0),
            "supply_v": status.supply_millivolts.map(|millivolts| f64::from(millivolts) / 1000.0),
            "channels": channels,
        });
        from_json(py, &object.to_string())
    }

    /// Frames received and lost since the session began, by channel and stage. `unknown` is how often an unknown number was lost, or may have
    /// been, as on an adapter that does not count its losses. `off_bus` is how often the device was off the bus because another client of its server changed the mode, `off_bus_ns` for how long: an unknown number of frames is missing each time.
    fn losses<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let session = self.session()?;
        let counters = session.device()?.counters();
        let all = PyDict::new(py);
        for channel in Channel::ALL {
            let of = &counters.channels[channel.index()];
            let counts = PyDict::new(py);
            counts.set_item("received", of.received)?;
            counts.set_item("controller", of.lost_controller)?;
            counts.set_item("queue", of.lost_queue)?;
            counts.set_item("link", of.lost_link)?;
            counts.set_item("host", of.lost_host)?;
            counts.set_item("gateway", of.lost_gateway)?;
            counts.set_item("unknown", of.unknown)?;
            counts.set_item("off_bus", of.off_bus)?;
            counts.set_item("off_bus_ns", of.off_bus_ns)?;
            counts.set_item("lost", of.lost())?;
            all.set_item(channel.number(), counts)?;
        }
        Ok(all)
    }

    /// Passes frames on between the channels, by a file's rules.
    fn start_gateway(&self, py: Python<'_>, rules: PathBuf) -> PyResult<()> {
        let session = self.session()?;
        let started = py.detach(|| Gateway::start(session.device()?, &rules))?;
        *lock(&self.gateway) = Some(started);
        Ok(())
    }

    /// Ends the gateway. What waits in it is lost, and counted.
    fn stop_gateway(&self, py: Python<'_>) -> PyResult<()> {
        self.ask(py, cantap::Device::stop_gateway)
    }

    /// What the gateway does, and its counts.
    fn gateway<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let session = self.session()?;
        let object = py.detach(|| Gateway::counts(lock(&self.gateway).as_ref(), session.device()?))?;
        from_json(py, &object.to_string())
    }

    /// What is known about the device's clock.
    fn clock<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let session = self.session()?;
        let report = session.device()?.clock();
        let object = json!({
            "source": if report.source == ClockSource::Frames { "frames" } else { "round-trips" },
            "drift_ppm": report.drift_ppm,
            "uncertainty_ns": report.uncertainty_ns,
            "round_trip_ns": report.round_trip_ns,
        });
        from_json(py, &object.to_string())
    }

    /// The device's time in UTC nanoseconds since 1970.
    fn time_ns(&self, py: Python<'_>) -> PyResult<i64> {
        self.ask(py, |device| {
            let ticks = device.time()?;
            Ok(device.clock_map().utc(cantap::device::Ticks(ticks)).0)
        })
    }

    /// Brings a channel that was opened with manual recovery back from bus-off.
    fn recover(&self, py: Python<'_>, number: OfDevice) -> PyResult<()> {
        let channel = number.0;
        self.ask(py, |device| device.recover(channel))
    }

    /// Shows an LED pattern, to find the device among others.
    fn identify(&self, py: Python<'_>, time: Seconds) -> PyResult<()> {
        let seconds = time.0.ceil();
        if !(0.0..=255.0).contains(&seconds) {
            return Err(
                Error::argument(format!("{seconds} s is not a time for this: give up to 255 s")).into()
            );
        }
        self.ask(py, |device| device.identify(seconds as u8))
    }

    /// Closes the channels and ends the session; records already received can still be read.
    fn close(&self, py: Python<'_>) {
        let Some(session) = lock(&self.session).take() else { return };
        py.detach(|| {
            if let Ok(device) = session.device() {
                // What was captured until the end still arrives. If the device is gone, its records end on their
                // own.
                let _ = device.stop();
            }
            drop(session);
        });
    }
}

/// Port, serial number, product.
type BoardWords = (String, Option<String>, Option<String>);

/// The connected boards.
#[pyfunction]
pub fn list_boards(py: Python<'_>) -> PyResult<Vec<BoardWords>> {
    let boards = py.detach(cantap::device::list).map_err(Error::from)?;
    Ok(boards.into_iter().map(|board| (board.port, board.serial_number, board.product)).collect())
}

/// Adds the classes to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Device>()?;
    module.add_class::<Records>()?;
    module.add_class::<PeriodicFrame>()?;
    module.add_class::<Reply>()?;
    module.add_function(wrap_pyfunction!(list_boards, module)?)
}
