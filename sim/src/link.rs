//! The emulated device as another program's serial port: behind a pseudo-terminal, or behind a reader and a
//! writer in this process.
//!
//! Emulated time follows the wall clock, or a fraction of it, and never runs ahead of it; under full load it
//! falls behind. [`Pace`] decides what happens when the client does not read.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::CYCLES_PER_SECOND;
use crate::board::{self, CLOCK};
use crate::rig::{MS, Rig, RigError};
use crate::run::{DEFAULT_BITRATE_BPS, Load, Options};
use cantap_emu::bus::{BitTime, BusFrame};
use cantap_emu::elf::Image;
use cantap_emu::machine::Setup;
use cantap_emu::traffic::Script;
use cantap_wire::{CHANNELS, Channel};

/// What happens while the client does not read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// Time stands still: the client sets the pace, and nothing is lost on its account.
    Client,
    /// Time continues, and the device's queue fills.
    RealTime,
}

/// How a device is served.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Manner {
    /// What happens while the client does not read.
    pub pace: Pace,
    /// Emulated time passes at most this many times as fast as the wall clock. The smaller this is, the more time a client
    /// on a busy machine has for each emulated millisecond.
    pub speed: f64,
    /// Both channels on one bus.
    pub joined: bool,
    /// The simulated nodes acknowledge.
    pub acknowledge: bool,
    /// Share of the frames that are destroyed and sent again, in per cent.
    pub error_percent: f64,
    /// Keep every frame that crosses a bus for [`Witness::frames`].
    pub witness: bool,
}

impl Default for Manner {
    /// The client sets the pace, up to real time; two buses; nothing is kept.
    fn default() -> Self {
        Self {
            pace: Pace::Client,
            speed: 1.0,
            joined: false,
            acknowledge: true,
            error_percent: 0.0,
            witness: false,
        }
    }
}

/// What really happened on the buses, whatever the device says about it.
#[derive(Clone, Debug, Default)]
pub struct Witness {
    /// Core cycle up to which it was observed.
    pub now: u64,
    /// Frames that crossed each bus, if [`Manner::witness`] was set.
    pub frames: [Vec<BusFrame>; CHANNELS],
    /// Bits that each controller has driven dominant since power-on.
    pub dominant_bits: [u64; CHANNELS],
}

/// Most pieces that wait for a reader in this process; each is what the device sent in a millisecond.
const PIECES: usize = 64;
/// A read that gets no bytes returns after this time.
const READ_WAIT: Duration = Duration::from_millis(50);
/// How long to wait before checking a lagging client again.
const LAG_WAIT: Duration = Duration::from_micros(500);
/// How far the emulation may lag behind the wall clock before it drops the difference.
const MOST_BEHIND: Duration = Duration::from_millis(100);

/// A client's end of the byte stream. Neither direction waits.
pub trait Client {
    /// What the client has written since the last call. An error means that it is gone.
    fn receive(&self) -> io::Result<Vec<u8>>;
    /// Takes as many of the bytes as it can and says how many.
    fn deliver(&self, bytes: &[u8]) -> io::Result<usize>;
    /// Whether a program has the port open, as of the last [`Self::receive`].
    fn is_open(&self) -> bool {
        true
    }
}

#[cfg(unix)]
impl Client for crate::pty::Pty {
    fn receive(&self) -> io::Result<Vec<u8>> {
        self.read()
    }

    fn deliver(&self, bytes: &[u8]) -> io::Result<usize> {
        self.write(bytes)
    }

    fn is_open(&self) -> bool {
        self.has_client()
    }
}

/// An emulated device with its port open, and traffic on the buses of its open channels.
pub struct Served {
    rig: Rig,
    manner: Manner,
    options: Options,
    witness: Arc<Mutex<Witness>>,
    /// Cycles per bit of each open channel.
    open: [Option<u64>; CHANNELS],
    /// When the first of the open channels was opened: a replay begins then.
    origin: u64,
    waiting: VecDeque<u8>,
    /// From the client, until the device knows that its port is open.
    to_device: Vec<u8>,
    /// Whether a client has the port open.
    attended: bool,
}

impl Served {
    /// Boots the firmware, enumerates the device and opens its port. A bus with a given bit rate carries the traffic of
    /// `options` from now on; any other bus, or a replayed log, only while the channel is open.
    pub fn start(image: Image, options: Options, manner: Manner) -> Result<Self, RigError> {
        let setup = Setup { joined: manner.joined, bound: options.bound, ..board::setup_for(&image) };
        let mut rig = Rig::new(image, setup, options.timing);
        rig.plug_in()?;
        let bitrate_bps = options.bitrate_bps.unwrap_or(DEFAULT_BITRATE_BPS);
        let now = rig.now();
        for channel in Channel::ALL {
            if options.channels.contains(&channel) && Self::is_independent(&options) {
                rig.add_traffic(channel, bitrate_bps, options.source(channel, now, now, u64::MAX));
            } else {
                rig.add_traffic(channel, bitrate_bps, Script::new(Vec::new()));
            }
        }
        for wire in &mut rig.machine.board().wires {
            (0..wire.node_count()).for_each(|n| wire.node(n).acknowledge(manner.acknowledge));
            wire.make_noise(manner.error_percent / 100.0, options.seed);
        }
        let witness = Arc::default();
        let (open, origin, waiting) = ([None; CHANNELS], 0, VecDeque::new());
        let (to_device, attended) = (Vec::new(), true);
        Ok(Self { rig, manner, options, witness, open, origin, waiting, to_device, attended })
    }

    /// Whether the buses' traffic continues regardless of which channels are open.
    fn is_independent(options: &Options) -> bool {
        options.bitrate_bps.is_some() && !matches!(options.load, Load::Replay(_))
    }

    /// Shows what really happens on the buses.
    pub fn witness(&self) -> Arc<Mutex<Witness>> {
        Arc::clone(&self.witness)
    }

    /// Starts and ends the traffic of channels as they are opened and closed.
    fn follow_channels(&mut self) {
        if Self::is_independent(&self.options) {
            return;
        }
        for channel in Channel::ALL {
            // A pin being measured needs something to measure.
            let watched =
                self.rig.watches(channel).then(|| BitTime::of_rate(DEFAULT_BITRATE_BPS, CLOCK).cycles(1));
            let bit = self.rig.bit_cycles(channel).or(watched);
            if bit == self.open[channel.index()] {
                continue;
            }
            if self.open == [None; CHANNELS] {
                self.origin = self.rig.now();
            }
            self.open[channel.index()] = bit;
            let bus_bit = match (self.options.bitrate_bps, bit) {
                (Some(bitrate_bps), _) => BitTime::of_rate(bitrate_bps, CLOCK),
                (None, Some(cycles)) => BitTime::of_cycles(cycles),
                (None, None) => BitTime::of_rate(DEFAULT_BITRATE_BPS, CLOCK),
            };
            let carries = bit.is_some() && self.options.channels.contains(&channel);
            let now = self.rig.now();
            let source = carries.then(|| self.options.source(channel, self.origin, now, u64::MAX));
            self.rig.change_traffic(channel, bus_bit, source);
        }
    }

    /// Serves a client until `seconds` of emulated time are over, or without end.
    pub fn until(&mut self, seconds: Option<Duration>, client: &impl Client) -> Result<(), ServeError> {
        let cycles = seconds.map(|seconds| (seconds.as_secs_f64() * CYCLES_PER_SECOND as f64) as u64);
        let end = cycles.map_or(u64::MAX, |cycles| self.rig.now().saturating_add(cycles));
        // A board with a fast crystal gets through its cycles sooner.
        let millisecond =
            Duration::from_millis(1).div_f64(self.manner.speed * self.options.timing.board_rate());
        let mut due = Instant::now();
        while self.rig.now() < end {
            self.hand_over(client)?;
            let lags = !self.waiting.is_empty();
            if lags && self.manner.pace == Pace::Client {
                std::thread::sleep(LAG_WAIT);
                due = Instant::now();
                continue;
            }
            self.millisecond(!lags)?;
            due += millisecond;
            let now = Instant::now();
            match due.checked_duration_since(now) {
                Some(ahead) => {
                    self.hand_over(client)?;
                    std::thread::sleep(ahead);
                }
                None if now - due > MOST_BEHIND => due = now,
                None => {}
            }
        }
        Ok(self.hand_over(client)?)
    }

    /// One emulated millisecond. A port that is not read is left alone by the host's driver.
    fn millisecond(&mut self, reading: bool) -> Result<(), RigError> {
        self.rig.with_host(|host, _| host.read(reading));
        let (bytes, crossed) = self.rig.run_watched(MS)?;
        self.testify(crossed);
        self.follow_channels();
        self.waiting.extend(bytes);
        if self.attended {
            // The client cannot see that a device comes back on its own after a reset: its port stays.
            self.rig.with_host(|host, _| host.open_port());
        }
        Ok(())
    }

    /// Records what happened on the buses.
    fn testify(&self, crossed: [Vec<BusFrame>; CHANNELS]) {
        let mut witness = self.witness.lock().unwrap_or_else(PoisonError::into_inner);
        witness.now = self.rig.now();
        witness.dominant_bits = Channel::ALL.map(|channel| self.rig.dominant_bits(channel));
        if self.manner.witness {
            for (all, new) in witness.frames.iter_mut().zip(crossed) {
                all.extend(new);
            }
        }
    }

    /// Moves bytes in both directions.
    fn hand_over(&mut self, client: &impl Client) -> io::Result<()> {
        self.to_device.extend(client.receive()?);
        let open = client.is_open();
        if open != self.attended {
            self.attended = open;
            self.rig.with_host(|host, _| if open { host.open_port() } else { host.close_port() });
        }
        if !open {
            self.to_device.clear();
            self.waiting.clear();
            return Ok(());
        }
        if !self.to_device.is_empty() && self.rig.with_host(|host, _| host.port_ready()) {
            let bytes = std::mem::take(&mut self.to_device);
            self.rig.with_host(|host, _| host.send(&bytes));
        }
        while !self.waiting.is_empty() {
            let (piece, _) = self.waiting.as_slices();
            let taken = client.deliver(piece)?;
            if taken == 0 {
                break;
            }
            self.waiting.drain(..taken);
        }
        Ok(())
    }
}

/// Why serving ended.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The board.
    #[error("{0}")]
    Rig(#[from] RigError),
    /// The client's end.
    #[error("the client is gone: {0}")]
    Client(#[from] io::Error),
}

/// The channel ends used by the emulation's thread.
struct Channels {
    to_client: SyncSender<Vec<u8>>,
    from_client: Receiver<Vec<u8>>,
    stop: Arc<AtomicBool>,
}

impl Client for Channels {
    fn receive(&self) -> io::Result<Vec<u8>> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        match self.from_client.try_recv() {
            Ok(bytes) => Ok(bytes),
            // A writer that is gone sends no more; the reader may still be listening.
            Err(TryRecvError::Empty | TryRecvError::Disconnected) => Ok(Vec::new()),
        }
    }

    fn deliver(&self, bytes: &[u8]) -> io::Result<usize> {
        match self.to_client.try_send(bytes.to_vec()) {
            Ok(()) => Ok(bytes.len()),
            Err(TrySendError::Full(_)) => Ok(0),
            Err(TrySendError::Disconnected(_)) => Err(io::ErrorKind::BrokenPipe.into()),
        }
    }
}

/// An emulated device in its own thread, as two halves of a byte stream.
pub struct EmulatedPort {
    /// From the device. If there are no bytes, it returns [`io::ErrorKind::TimedOut`] after a moment; no bytes
    /// (`Ok(0)`) mean that the emulation has ended.
    pub reader: PortReader,
    /// To the device.
    pub writer: PortWriter,
    /// Ends the emulation when it is dropped.
    pub device: EmulatedDevice,
}

impl EmulatedPort {
    /// Boots `image` and opens its port; returns once a host would see it.
    pub fn start(image: Image, options: Options, manner: Manner) -> Result<Self, ServeError> {
        let (to_client, from_device) = sync_channel(PIECES);
        let (to_device, from_client) = sync_channel(PIECES);
        let (started, ready) = sync_channel(1);
        let stop = Arc::new(AtomicBool::new(false));
        let end = Arc::new(Mutex::new(None));
        let channels = Channels { to_client, from_client, stop: Arc::clone(&stop) };
        let last_words = Arc::clone(&end);
        let thread = std::thread::Builder::new().name("cantap-emulation".to_owned()).spawn(move || {
            let mut served = match Served::start(image, options, manner) {
                Ok(served) => served,
                Err(error) => {
                    let _ = started.send(Err(error));
                    return;
                }
            };
            let _ = started.send(Ok(served.witness()));
            if let Err(ServeError::Rig(error)) = served.until(None, &channels) {
                *last_words.lock().unwrap_or_else(PoisonError::into_inner) = Some(error.to_string());
            }
        })?;
        // The thread ends only after it has reported one or the other.
        let said = ready.recv().map_err(|_| io::Error::other("the emulation ended before it began"))?;
        let device = EmulatedDevice { stop, thread: Some(thread), witness: said? };
        Ok(Self {
            reader: PortReader { pieces: from_device, rest: VecDeque::new(), end },
            writer: PortWriter(to_device),
            device,
        })
    }
}

/// See [`EmulatedPort::reader`].
pub struct PortReader {
    pieces: Receiver<Vec<u8>>,
    rest: VecDeque<u8>,
    end: Arc<Mutex<Option<String>>>,
}

impl Read for PortReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.rest.is_empty() {
            match self.pieces.recv_timeout(READ_WAIT) {
                Ok(piece) => self.rest = piece.into(),
                Err(RecvTimeoutError::Timeout) => return Err(io::ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => {
                    let end = self.end.lock().unwrap_or_else(PoisonError::into_inner).take();
                    return end.map_or(Ok(0), |words| Err(io::Error::other(words)));
                }
            }
        }
        self.rest.read(out)
    }
}

/// See [`EmulatedPort::writer`].
pub struct PortWriter(SyncSender<Vec<u8>>);

impl Write for PortWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self.0.try_send(bytes.to_vec()) {
            Ok(()) => Ok(bytes.len()),
            Err(TrySendError::Full(_)) => {
                std::thread::sleep(LAG_WAIT);
                Err(io::ErrorKind::Interrupted.into())
            }
            Err(TrySendError::Disconnected(_)) => Err(io::ErrorKind::BrokenPipe.into()),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// See [`EmulatedPort::device`].
pub struct EmulatedDevice {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    witness: Arc<Mutex<Witness>>,
}

impl EmulatedDevice {
    /// Shows what really happens on the buses.
    pub fn witness(&self) -> Arc<Mutex<Witness>> {
        Arc::clone(&self.witness)
    }
}

impl Drop for EmulatedDevice {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has already reported it.
            let _ = thread.join();
        }
    }
}
