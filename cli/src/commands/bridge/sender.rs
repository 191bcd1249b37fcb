//! The direction from programs to the buses. It waits neither for reception nor for the other channel: if nothing leaves on a bus,
//! its frames stay in the interface's socket.

use std::collections::HashMap;
use std::io;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use cantap::transmit::Stream;
use cantap::wire::message::Mode;
use cantap::{Device, DeviceError};
use cantap_adapters::fd_advice;
use cantap_adapters::raw_can::BATCH;
use cantap_address::OpenDevice;
use cantap_trace::TraceFrame;
use rustix::event::{PollFd, PollFlags, poll};

use super::lane::Lane;
use super::raw::Raw;
use crate::stderr;
use cantap_work::advice;

/// How often to check for confirmations while frames are on their way.
const CONFIRM_EVERY: Duration = Duration::from_millis(2);
/// A thread that is not waiting for anything follows a change within this many milliseconds.
const FOLLOWS_IN_MS: u32 = 500;
/// How often to check whether to continue.
const LOOK_EVERY: Duration = Duration::from_millis(20);

/// The thread that sends.
pub struct Sender {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    /// The device, while it is there.
    device: Mutex<Option<Arc<OpenDevice>>>,
    /// How often that has changed, and the last change followed by the thread.
    wanted: AtomicU32,
    followed: AtomicU32,
    quit: AtomicBool,
    /// Set when an interface is gone.
    failed: Mutex<Option<String>>,
}

impl Shared {
    fn device(&self) -> Option<Arc<OpenDevice>> {
        self.device.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn goes_on(&self, with: &Arc<OpenDevice>) -> bool {
        !self.quit.load(Ordering::Relaxed) && self.device().is_some_and(|device| Arc::ptr_eq(&device, with))
    }
}

impl Sender {
    /// Starts it. Until there is a device, what programs write is refused.
    pub fn start(lanes: Arc<[Lane]>) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            device: Mutex::new(None),
            wanted: AtomicU32::new(0),
            followed: AtomicU32::new(0),
            quit: AtomicBool::new(false),
            failed: Mutex::new(None),
        });
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("cantap-bridge".to_owned()).spawn(move || {
            if let Err(error) = run(&for_thread, &lanes) {
                *for_thread.failed.lock().unwrap_or_else(PoisonError::into_inner) = Some(error.to_string());
            }
        })?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Sets the device, or none. What programs wrote before is not sent; what they write after this returns is, unless the thread
    /// does not follow in time.
    pub fn use_device(&self, device: Option<Arc<OpenDevice>>) {
        *self.shared.device.lock().unwrap_or_else(PoisonError::into_inner) = device;
        let wanted = self.shared.wanted.fetch_add(1, Ordering::Relaxed) + 1;
        for _ in 0..FOLLOWS_IN_MS {
            if self.shared.followed.load(Ordering::Relaxed) == wanted {
                return;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Why it cannot continue, if so.
    pub fn failed(&self) -> Option<String> {
        self.shared.failed.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        self.shared.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Takes frames from one interface.
struct Inlet<'l> {
    lane: &'l Lane,
    raw: Vec<Raw>,
    /// Number of frames that the kernel has discarded so far.
    thrown_away: u32,
    /// Frames on their way, by tag.
    under_way: HashMap<u32, TraceFrame>,
}

impl<'l> Inlet<'l> {
    fn new(lane: &'l Lane) -> Self {
        Self { lane, raw: Vec::new(), thrown_away: 0, under_way: HashMap::new() }
    }

    /// Takes what is there, up to a limit. Returns whether there was anything.
    fn receive(&mut self, most: usize) -> io::Result<bool> {
        self.raw.clear();
        let thrown_away = self.lane.port.receive(most.min(BATCH), &mut self.raw)?;
        // The kernel reports the number only together with frames.
        if thrown_away > self.thrown_away {
            self.lane.overflowed(thrown_away - self.thrown_away)?;
            self.thrown_away = thrown_away;
        }
        Ok(!self.raw.is_empty())
    }

    /// Refuses everything that is there.
    fn refuse_all(&mut self) -> io::Result<()> {
        while self.receive(BATCH)? {
            self.lane.refuse(self.raw.len())?;
        }
        Ok(())
    }

    /// The fate of the frames on their way is unknown.
    fn forget(&mut self) -> io::Result<()> {
        let under_way = std::mem::take(&mut self.under_way);
        for frame in under_way.values() {
            self.lane.has_ended(frame);
        }
        self.lane.refuse(under_way.len())
    }
}

/// The thread's body. An error means that an interface is gone.
fn run(shared: &Shared, lanes: &[Lane]) -> io::Result<()> {
    let mut inlets: Vec<Inlet<'_>> = lanes.iter().map(Inlet::new).collect();
    while !shared.quit.load(Ordering::Relaxed) {
        let wanted = shared.wanted.load(Ordering::Relaxed);
        let current = shared.device();
        // What was written while there was no device, or another one, was meant for that time.
        if current.is_none() || shared.followed.load(Ordering::Relaxed) != wanted {
            for inlet in &mut inlets {
                inlet.refuse_all()?;
            }
        }
        shared.followed.store(wanted, Ordering::Relaxed);
        let Some(device) = current else {
            wait_for(inlets.iter(), LOOK_EVERY);
            continue;
        };
        let ended = session(shared, &device, &mut inlets);
        for inlet in &mut inlets {
            inlet.forget()?;
        }
        match ended {
            Ok(()) => {}
            Err(Ended::Interface(error)) => return Err(error),
            // The stream of records reports it.
            Err(Ended::Device(error)) if error.is_of_the_connection() => {
                let mut current = shared.device.lock().unwrap_or_else(PoisonError::into_inner);
                if current.as_ref().is_some_and(|current| Arc::ptr_eq(current, &device)) {
                    *current = None;
                }
            }
            Err(Ended::Device(error)) => {
                stderr::warn(&format!(
                    "programs' frames were not sent, or it is unknown whether they were: {}",
                    advice::sentence(&error.into())
                ));
            }
        }
    }
    Ok(())
}

/// Why sending to a device ended.
enum Ended {
    Device(DeviceError),
    Interface(io::Error),
}

impl From<DeviceError> for Ended {
    fn from(error: DeviceError) -> Self {
        Self::Device(error)
    }
}

impl From<io::Error> for Ended {
    fn from(error: io::Error) -> Self {
        Self::Interface(error)
    }
}

/// Sends to a device until it is replaced.
fn session(shared: &Shared, device: &Arc<OpenDevice>, inlets: &mut [Inlet<'_>]) -> Result<(), Ended> {
    let room = usize::from(device.hello().tx_queue).max(1);
    let mut stream = Stream::new(device);
    while shared.goes_on(device) {
        let mut is_idle = true;
        for inlet in &mut *inlets {
            let free = room.saturating_sub(inlet.under_way.len());
            if free == 0 || !inlet.receive(free)? {
                continue;
            }
            is_idle = false;
            take(inlet, device, &mut stream)?;
        }
        stream.flush()?;
        stream.wait(Duration::ZERO)?;
        for end in stream.take_ended() {
            let Some(inlet) = inlets.iter_mut().find(|inlet| inlet.lane.channel == end.channel) else {
                continue;
            };
            let Some(frame) = inlet.under_way.remove(&end.tag) else { continue };
            if end.result.is_ok() {
                inlet.lane.count_sent();
            } else {
                // The record informs the programs.
                inlet.lane.has_ended(&frame);
                inlet.lane.count_not_sent();
            }
        }
        if is_idle {
            let is_waiting = inlets.iter().any(|inlet| !inlet.under_way.is_empty());
            let with_room = inlets.iter().filter(|inlet| inlet.under_way.len() < room);
            wait_for(with_room, if is_waiting { CONFIRM_EVERY } else { LOOK_EVERY });
        }
    }
    Ok(())
}

/// Sends what was received.
fn take(inlet: &mut Inlet<'_>, device: &Device, stream: &mut Stream<'_>) -> Result<(), Ended> {
    let lane = inlet.lane;
    let sends = device
        .open_channels()
        .iter()
        .any(|(channel, config)| *channel == lane.channel && config.mode != Mode::ListenOnly);
    if !sends {
        lane.refuse_listening(inlet.raw.len())?;
        return Ok(());
    }
    let (mut refused, mut refused_fd) = (0, 0);
    for raw in &inlet.raw {
        let Some(frame) = raw.frame() else {
            refused += 1;
            continue;
        };
        if frame.is_fd() && !device.hello().sends_fd() {
            refused_fd += 1;
            continue;
        }
        // This must come before it can be confirmed.
        lane.sends(frame);
        // There is room, so it does not wait.
        match stream.push(lane.channel, frame, None, |_| true)? {
            Some(tag) => drop(inlet.under_way.insert(tag, frame)),
            None => refused += 1,
        }
    }
    if refused_fd > 0 {
        lane.refuse_fd(refused_fd, &fd_advice(device.hello()))?;
    }
    Ok(lane.refuse(refused)?)
}

/// Waits until a program has written, at most this long.
fn wait_for<'i, 'l: 'i>(inlets: impl Iterator<Item = &'i Inlet<'l>>, timeout: Duration) {
    let sockets: Vec<BorrowedFd<'_>> = inlets.filter_map(|inlet| inlet.lane.port.as_fd()).collect();
    let mut waiting: Vec<PollFd<'_>> =
        sockets.iter().map(|socket| PollFd::new(socket, PollFlags::IN)).collect();
    let limit = rustix::event::Timespec { tv_sec: 0, tv_nsec: timeout.subsec_nanos().into() };
    if waiting.is_empty() || poll(&mut waiting, Some(&limit)).is_err() {
        std::thread::sleep(CONFIRM_EVERY);
    }
}
