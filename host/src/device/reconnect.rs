//! A device that may go and come back: unplugged, silent, its session taken over by another program or ended
//! because the computer slept.
//!
//! When it is there again, capturing continues automatically, on channels opened as before, with the gap in the trace.
//! Sending does not: only whoever asked for it knows whether it is still wanted.

use std::borrow::Borrow;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use cantap_wire::message::Mode;
use cantap_wire::{Channel, Hello};

use super::{ClockReport, Counters, Device, DeviceError, Records, Settings};
use crate::{TraceEvent, TraceRecord};

/// Time from a failure to the next try.
const RETRY_AFTER: Duration = Duration::from_millis(500);

/// What happened next. `E` is the caller's error.
#[derive(Debug)]
pub enum Happening<E> {
    /// Records; an empty vector if none arrived in time.
    Records(Vec<TraceRecord>),
    /// The device is gone, or still absent for a different reason than before. When it was lost, the records before this
    /// end with a loss of an unknown number of frames on each open channel.
    Gone(E),
    /// It is there, and its channels are open. The first time, no absence preceded it.
    Back(Return),
    /// Everything captured before [`Reconnecting::stop`] has been handed out.
    Ended,
}

/// How a device came back.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Return {
    /// How long it was away; `None` the first time.
    pub after: Option<Duration>,
    /// Its name, if it is a different board from before.
    pub other_board: Option<String>,
    /// Channels that took part in their bus and now only listen: another board may be on other buses.
    pub only_listening: Vec<Channel>,
}

/// Connects to the device: the one with this serial number, if it is known and the device can be found by it.
type Connect<D, E> = Box<dyn FnMut(Option<&str>) -> Result<D, E> + Send>;
/// Opens channels on a device the first time.
type Setup<D, E> = Box<dyn FnMut(&D) -> Result<(), E> + Send>;

/// Brings a device here and sets it up.
struct Hands<D, E> {
    connect: Connect<D, E>,
    setup: Setup<D, E>,
}

/// A connected device with its channels open.
struct Opened<D> {
    handle: D,
    records: Records,
    known: Known,
    back: Return,
}

/// The current attempt to open the device, in a separate thread: a port that does not answer takes seconds, and
/// whoever waits for records should not have to.
struct Attempt<D, E> {
    result: Receiver<Result<Opened<D>, E>>,
    is_wanted: Arc<AtomicBool>,
}

impl<D, E> Drop for Attempt<D, E> {
    fn drop(&mut self) {
        self.is_wanted.store(false, Ordering::Relaxed);
    }
}

/// A device that is opened again whenever it is there. `D` is the handle that connecting makes: a [`Device`], or a program's
/// wrapper around one.
pub struct Reconnecting<D, E> {
    /// Its name in messages.
    name: String,
    hands: Arc<Mutex<Hands<D, E>>>,
    attempt: Option<Attempt<D, E>>,
    session: Option<(D, Records)>,
    known: Option<Known>,
    /// Counted in earlier sessions.
    before: Counters,
    clock: ClockReport,
    /// When it was noticed that the device is gone, and how long it had been gone then.
    gone: Option<(Instant, Duration)>,
    /// The last report, so that nothing is reported twice.
    told: Option<String>,
    retry_at: Instant,
    /// Time of the last record handed out.
    latest_ns: i64,
    next: Option<Happening<E>>,
    gaps: Gaps,
    /// The capture is over: a device that goes now is not waited for.
    stopped: bool,
    /// Why it did not end properly: how much is missing at its end is unknown.
    unaccounted: Option<DeviceError>,
}

/// How often and how long a device was absent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Gaps {
    /// How often.
    pub count: u32,
    /// In total.
    pub time: Duration,
}

/// The board of the last session, and its settings.
#[derive(Clone)]
struct Known {
    board: String,
    serial: String,
    can_clock_hz: u32,
    settings: Settings,
}

impl Known {
    fn name(hello: &Hello) -> String {
        format!("{} {}", hello.board, hello.serial)
    }

    fn is(&self, hello: &Hello) -> bool {
        hello.board == self.board.as_str() && hello.serial == self.serial.as_str()
    }
}

impl<D, E> Reconnecting<D, E>
where
    D: Borrow<Device> + Send + 'static,
    E: From<DeviceError> + std::fmt::Display + Send + 'static,
{
    /// A device that need not be there yet; messages call it `name`. `connect` gets the serial number of the board that was
    /// there, if any: `port_of` finds its current port. `setup` opens its channels the first time; later they are opened as
    /// they were.
    pub fn new(
        name: &str,
        connect: impl FnMut(Option<&str>) -> Result<D, E> + Send + 'static,
        setup: impl FnMut(&D) -> Result<(), E> + Send + 'static,
    ) -> Self {
        Self {
            name: name.to_owned(),
            hands: Arc::new(Mutex::new(Hands { connect: Box::new(connect), setup: Box::new(setup) })),
            attempt: None,
            session: None,
            known: None,
            before: Counters::default(),
            clock: ClockReport::default(),
            gone: None,
            told: None,
            retry_at: Instant::now(),
            latest_ns: i64::MIN,
            next: None,
            gaps: Gaps::default(),
            stopped: false,
            unaccounted: None,
        }
    }

    /// Connects now, to a device that must be there.
    pub fn connect(&mut self) -> Result<(), E> {
        let opened = open(&self.hands, &self.name, self.known.as_ref(), &AtomicBool::new(true))?;
        self.welcome(opened);
        Ok(())
    }

    /// How long it has been away; `None` while it is there.
    pub fn away_for(&self) -> Option<Duration> {
        self.gone.map(|(noticed_at, ago)| ago + noticed_at.elapsed())
    }

    /// The device, while it is there.
    pub fn device(&self) -> Option<&Device> {
        self.session.as_ref().map(|(handle, _)| handle.borrow())
    }

    /// Waits for the next happening, at most `timeout`.
    pub fn next(&mut self, timeout: Duration) -> Happening<E> {
        if let Some(next) = self.next.take() {
            return next;
        }
        let Some((_, records)) = &mut self.session else {
            return if self.stopped { Happening::Ended } else { self.try_again(timeout) };
        };
        match records.next_batch(timeout) {
            Ok(Some(mut records)) => {
                self.keep_in_order(&mut records);
                Happening::Records(records)
            }
            Ok(None) => match self.unaccounted.take() {
                Some(error) => self.lose(error),
                None => Happening::Ended,
            },
            Err(error) => self.lose(error),
        }
    }

    /// Takes back the memory of a batch. Optional, but faster.
    pub fn recycle(&self, batch: Vec<TraceRecord>) {
        if let Some((_, records)) = &self.session {
            records.recycle(batch);
        }
    }

    /// Ends the capture. The rest comes from [`Self::next`], up to [`Happening::Ended`]. Returns an error if the device is
    /// not there or is lost while stopping; the rest then ends as well.
    pub fn stop(&mut self) -> Result<(), E> {
        self.stopped = true;
        self.attempt = None;
        let Some(device) = self.device() else {
            let reason = self.told.clone().unwrap_or_default();
            return Err(DeviceError::StillGone { address: self.name.clone(), reason }.into());
        };
        let Err(error) = device.stop() else { return Ok(()) };
        let said = DeviceError::BadEnd { address: self.name.clone(), reason: error.to_string() };
        self.unaccounted = Some(error);
        Err(said.into())
    }

    /// What was received and lost in all sessions.
    pub fn counters(&self) -> Counters {
        self.device().map_or(self.before, |device| self.before + device.counters())
    }

    /// What is known of the device's clock.
    pub fn clock(&self) -> ClockReport {
        self.device().map_or(self.clock, Device::clock)
    }

    /// The device's absences, including the current one.
    pub fn gaps(&self) -> Gaps {
        let open = self.away_for();
        Gaps {
            count: self.gaps.count + u32::from(open.is_some()),
            time: self.gaps.time + open.unwrap_or_default(),
        }
    }

    fn keep_in_order(&mut self, records: &mut [TraceRecord]) {
        // Within a session they are in order, but each session has its own estimate of UTC.
        for record in records.iter_mut().take_while(|record| record.time_ns < self.latest_ns) {
            record.time_ns = self.latest_ns;
        }
        self.latest_ns = records.last().map_or(self.latest_ns, |last| last.time_ns);
    }

    /// The device has gone: the gap is the last record it leaves.
    fn lose(&mut self, error: DeviceError) -> Happening<E> {
        let Some((handle, _)) = self.session.take() else { return Happening::Gone(error.into()) };
        let device: &Device = handle.borrow();
        self.before = self.before + device.counters();
        self.clock = device.clock();
        let (last_known_ns, ago) = device.last_known();
        let time_ns = self.latest_ns.max(last_known_ns);
        let channels = device.open_channels().into_iter().map(|(channel, _)| channel.number());
        let event = TraceEvent::GAP;
        let mut gap: Vec<_> =
            channels.map(|channel| TraceRecord { time_ns, device_ns: None, channel, event }).collect();
        self.keep_in_order(&mut gap);
        self.gone = Some((Instant::now(), ago));
        self.retry_at = Instant::now() + RETRY_AFTER;
        self.told = Some(error.to_string());
        self.next = Some(if self.stopped { Happening::Ended } else { Happening::Gone(error.into()) });
        Happening::Records(gap)
    }

    fn try_again(&mut self, timeout: Duration) -> Happening<E> {
        let deadline = Instant::now() + timeout;
        let nothing = || Happening::Records(Vec::new());
        let attempt = match self.attempt.take() {
            Some(attempt) => attempt,
            None if self.retry_at > deadline => {
                std::thread::sleep(timeout);
                return nothing();
            }
            None => {
                std::thread::sleep(self.retry_at.saturating_duration_since(Instant::now()));
                match self.start_attempt() {
                    Ok(attempt) => attempt,
                    Err(error) => return self.failed(DeviceError::Thread(error).into()),
                }
            }
        };
        match attempt.result.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(Ok(opened)) => Happening::Back(self.welcome(opened)),
            Ok(Err(error)) => self.failed(error),
            Err(RecvTimeoutError::Timeout) => {
                self.attempt = Some(attempt);
                nothing()
            }
            // The thread panicked and has reported it.
            Err(RecvTimeoutError::Disconnected) => {
                self.retry_at = Instant::now() + RETRY_AFTER;
                nothing()
            }
        }
    }

    fn start_attempt(&self) -> std::io::Result<Attempt<D, E>> {
        let (sender, result) = sync_channel(1);
        let is_wanted = Arc::new(AtomicBool::new(true));
        let (hands, name, known) = (Arc::clone(&self.hands), self.name.clone(), self.known.clone());
        let still_wanted = Arc::clone(&is_wanted);
        std::thread::Builder::new().name("cantap-reconnect".to_owned()).spawn(move || {
            // If nobody waits any more, the device is dropped, which closes it.
            let _ = sender.send(open(&hands, &name, known.as_ref(), &still_wanted));
        })?;
        Ok(Attempt { result, is_wanted })
    }

    /// The device could not be opened.
    fn failed(&mut self, error: E) -> Happening<E> {
        self.retry_at = Instant::now() + RETRY_AFTER;
        let reason = error.to_string();
        if self.told.as_ref() == Some(&reason) {
            return Happening::Records(Vec::new());
        }
        self.told = Some(reason);
        Happening::Gone(error)
    }

    /// The device was opened.
    fn welcome(&mut self, opened: Opened<D>) -> Return {
        let Opened { handle, records, known, mut back } = opened;
        self.known = Some(known);
        back.after = self.away_for();
        self.gone = None;
        if let Some(after) = back.after {
            self.gaps.count += 1;
            self.gaps.time += after;
        }
        self.told = None;
        self.session = Some((handle, records));
        back
    }
}

/// Opens a device at its current port, and its channels: as before, if it is known.
fn open<D: Borrow<Device>, E: From<DeviceError>>(
    hands: &Mutex<Hands<D, E>>,
    name: &str,
    known: Option<&Known>,
    is_wanted: &AtomicBool,
) -> Result<Opened<D>, E> {
    let mut hands = hands.lock().unwrap_or_else(PoisonError::into_inner);
    let handle = (hands.connect)(known.map(|known| known.serial.as_str()))?;
    let device: &Device = handle.borrow();
    let hello = device.hello();
    let mut back = Return::default();
    let records = device.records();
    if !is_wanted.load(Ordering::Relaxed) {
        return Err(DeviceError::StillGone { address: name.to_owned(), reason: String::new() }.into());
    }
    match known {
        None => (hands.setup)(&handle)?,
        Some(known) if known.is(hello) => device.restore(&known.settings)?,
        Some(known) => {
            let board = Known::name(hello);
            if known.can_clock_hz != hello.can_clock_hz {
                return Err(DeviceError::OtherClock { address: name.to_owned(), name: board }.into());
            }
            let mut settings = known.settings.clone();
            back.only_listening = settings.only_listen();
            back.other_board = Some(board);
            device.restore(&settings)?;
        }
    }
    let known = Known {
        board: hello.board.as_str().to_owned(),
        serial: hello.serial.as_str().to_owned(),
        can_clock_hz: hello.can_clock_hz,
        settings: device.settings().clone(),
    };
    Ok(Opened { handle, records, known, back })
}

impl Settings {
    /// Takes every channel that took part in its bus off it and opens it to listen only; returns those
    /// channels.
    fn only_listen(&mut self) -> Vec<Channel> {
        let mut changed = Vec::new();
        for channel in Channel::ALL {
            if let Some(config) = &mut self.open[channel.index()]
                && config.mode != Mode::ListenOnly
            {
                config.mode = Mode::ListenOnly;
                changed.push(channel);
            }
        }
        changed
    }
}

impl Device {
    /// Gives the channels the filters and configurations of another session.
    fn restore(&self, settings: &Settings) -> Result<(), DeviceError> {
        if settings.keeps_intervals {
            self.keep_intervals();
        }
        // A channel's filters can be changed only while both channels are closed.
        for (channel, filters) in Channel::ALL.into_iter().zip(&settings.filters) {
            if let Some(filters) = filters {
                self.set_filters(channel, filters)?;
            }
        }
        for (channel, config) in Channel::ALL.into_iter().zip(settings.open) {
            if config.is_some() {
                self.open_channel(channel, config)?;
            }
        }
        Ok(())
    }
}
