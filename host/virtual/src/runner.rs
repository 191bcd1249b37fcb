//! The thread of a virtual device, and how its time follows the wall clock.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::board::{Dtr, Ending, VirtualPort};
use super::machine::{Machine, Memory, Witness, World};
use super::options::{Options, Pace};
use cantap::device::{Link, PipeReader, PipeWriter, pipe};
use cantap::{Device, DeviceError};

/// Bytes on their way to the host: about what an operating system's serial driver buffers.
const TO_HOST_BYTES: usize = 32 * 1024;
/// Bytes on their way to the device.
const FROM_HOST_BYTES: usize = 16 * 1024;
/// Model time advances in steps of this length.
const STEP: Duration = Duration::from_millis(1);
/// A thread that wakes up later than this was delayed by other programs.
const HELD_UP: Duration = Duration::from_millis(3);
/// The most lateness for which the host is compensated.
const MAX_OWED: Duration = Duration::from_millis(500);
/// The host is given time when the pipe has less room than one step can fill at full USB speed.
const LITTLE_ROOM: usize = 2 * 1024;
/// The length of a single wait.
const WAIT: Duration = Duration::from_millis(5);

/// When the USB host of all virtual devices started its frames.
static USB_HOST: OnceLock<Instant> = OnceLock::new();

/// A running virtual device. It ends when this is dropped or the host closes its pipe.
pub struct VirtualDevice {
    quit: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Its connection, and what the bus knows.
pub struct Connection {
    /// From the device.
    pub reader: PipeReader,
    /// To the device.
    pub writer: PipeWriter,
    /// What the bus really carried.
    pub witness: Arc<Witness>,
    /// The device.
    pub device: VirtualDevice,
    /// Whether the device sees its port as open; initially it does.
    pub open: Arc<Dtr>,
}

impl Connection {
    /// Converts it to a device's link.
    pub fn into_link(self) -> Link {
        Link::new(self.reader, self.writer).keeping(self.device)
    }
}

/// How the host sees a reset of the firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum After {
    /// The port vanishes, as when a board enumerates again; opening a virtual device again gives a new one.
    Vanish,
    /// The firmware starts again behind the same port.
    #[cfg(unix)]
    Restart,
}

/// Starts a virtual device. Its port vanishes when the firmware is reset.
pub fn start(options: Options) -> std::io::Result<Connection> {
    start_with(options, After::Vanish)
}

/// Starts a virtual device and begins a session with it.
pub fn open(options: Options) -> Result<Device, DeviceError> {
    let connection = start(options).map_err(DeviceError::Thread)?;
    Device::over(connection.into_link(), "virtual")
}

pub(super) fn start_with(options: Options, after: After) -> std::io::Result<Connection> {
    let (reader, to_host) = pipe(TO_HOST_BYTES);
    let (from_host, writer) = pipe(FROM_HOST_BYTES);
    let (quit, open) = (Arc::new(AtomicBool::new(false)), Arc::new(Dtr::new(true)));
    let witness = Arc::new(Witness::default());
    let port = VirtualPort::new(from_host, to_host, Arc::clone(&open));
    let (for_thread, seen) = (Arc::clone(&quit), Arc::clone(&witness));
    let thread = std::thread::Builder::new()
        .name("cantap-virtual".to_owned())
        .spawn(move || run(options, port, seen, after, &for_thread))?;
    let device = VirtualDevice { quit, thread: Some(thread) };
    Ok(Connection { reader, writer, witness, device, open })
}

impl VirtualDevice {
    /// Whether the device is still there.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }
}

impl Drop for VirtualDevice {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn run(mut options: Options, port: VirtualPort, witness: Arc<Witness>, after: After, quit: &AtomicBool) {
    let pace = options.pace;
    let mut world = World::new(&mut options, port, witness);
    loop {
        let mut memory = Memory::new();
        let mut machine = Machine::power_up(&mut memory, world);
        let is_over = |machine: &Machine<'_>| {
            quit.load(Ordering::Relaxed) || machine.ending().is_some() || machine.port().to_host.is_closed()
        };
        match pace {
            Pace::RealTime => follow_the_wall_clock(&mut machine, is_over),
            Pace::Fast => follow_the_host(&mut machine, is_over),
        }
        if after == After::Vanish || machine.ending() != Some(Ending::Restart) {
            return;
        }
        world = machine.power_down();
    }
}

/// Model time follows wall time in steps.
fn follow_the_wall_clock(machine: &mut Machine<'_>, is_over: impl Fn(&Machine<'_>) -> bool) {
    let (started, started_ns) = (Instant::now(), machine.now_ns());
    // All virtual devices of a program are on one USB host, which started with the first of them.
    let usb_ns = started.saturating_duration_since(*USB_HOST.get_or_init(|| started)).as_nanos() as u64;
    machine.plug_in(usb_ns.saturating_sub(started_ns));
    let mut slept_at = started;
    // Time during which the host could not read because this thread, and so perhaps the host too, was
    // delayed.
    let mut owed = Duration::ZERO;
    while !is_over(machine) {
        let late = slept_at.elapsed();
        if late > HELD_UP {
            owed = (owed + late).min(MAX_OWED);
        }
        while let Some(behind) =
            started.elapsed().checked_sub(Duration::from_nanos(machine.now_ns() - started_ns))
            && behind >= STEP
        {
            if machine.port().to_host.room() < LITTLE_ROOM && !owed.is_zero() {
                let waited = Instant::now();
                machine.port().to_host.wait_for_room(LITTLE_ROOM, owed.min(WAIT));
                owed = owed.saturating_sub(waited.elapsed());
            }
            machine.advance(machine.now_ns() + STEP.as_nanos() as u64);
            if is_over(machine) {
                return;
            }
        }
        owed = Duration::ZERO;
        slept_at = Instant::now();
        std::thread::sleep(STEP);
    }
}

/// Model time runs as fast as the host reads.
fn follow_the_host(machine: &mut Machine<'_>, is_over: impl Fn(&Machine<'_>) -> bool) {
    while !is_over(machine) {
        if machine.port().to_host.wait_for_room(LITTLE_ROOM, WAIT) {
            machine.advance(machine.now_ns() + STEP.as_nanos() as u64);
        }
    }
}
