//! The virtual device behind a pseudo-terminal, so that any program that opens serial ports can use it.

use std::io::{self, ErrorKind, Write};
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::termios::{OptionalActions, QueueSelector};
use rustix_openpty::{Pty, openpty};

use super::board::Dtr;
use super::options::Options;
use super::runner::{After, VirtualDevice, start_with};
use cantap::device::{PipeReader, PipeWriter};

/// How often to check whether a terminal is still, or again, in use.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// A pseudo-terminal with a virtual device behind it, until it is dropped. After a reset its firmware starts
/// again at the same path; a program that has it open finds that there is no session any more.
pub struct Terminal {
    path: String,
    quit: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    device: Option<VirtualDevice>,
}

impl Terminal {
    /// The path to open.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// False once the firmware has entered the bootloader, which the virtual device does not have.
    pub fn is_running(&self) -> bool {
        self.device.as_ref().is_some_and(VirtualDevice::is_running)
    }
}

/// Why a virtual device behind a pseudo-terminal could not be started.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TerminalError {
    /// The system provided no pseudo-terminal.
    #[error("cannot open a pseudo terminal: {0}")]
    Terminal(#[source] io::Error),
    /// The system could not start a thread.
    #[error("the system refused a thread: {0}; close other programs and try again")]
    Thread(#[from] io::Error),
}

/// Starts a virtual device behind a new pseudo-terminal.
pub fn open_terminal(options: Options) -> Result<Terminal, TerminalError> {
    let (terminal, path) = new_terminal().map_err(TerminalError::Terminal)?;
    // A board's port comes back with the same name.
    let connection = start_with(options, After::Restart)?;
    connection.open.set(false);
    let quit = Arc::new(AtomicBool::new(false));
    let line = Arc::new(Line {
        terminal,
        path: path.clone(),
        dtr: connection.open,
        from_device: connection.reader,
        in_hand: Mutex::new(()),
        quit: Arc::clone(&quit),
    });
    let to_device = connection.writer;
    let spawn = |name: &str, body: Box<dyn FnOnce() + Send>| {
        std::thread::Builder::new().name(name.to_owned()).spawn(body)
    };
    let for_inward = Arc::clone(&line);
    let inward = spawn("cantap-pty-in", Box::new(move || for_inward.carry_in(to_device)))?;
    let outward = spawn("cantap-pty-out", Box::new(move || line.carry_out()))?;
    Ok(Terminal { path, quit, threads: vec![inward, outward], device: Some(connection.device) })
}

/// Between the terminal and the device.
struct Line {
    terminal: OwnedFd,
    path: String,
    dtr: Arc<Dtr>,
    from_device: PipeReader,
    /// Held while bytes are on their way to the program.
    in_hand: Mutex<()>,
    quit: Arc<AtomicBool>,
}

impl Line {
    fn is_over(&self) -> bool {
        self.quit.load(Ordering::Relaxed) || self.from_device.is_closed()
    }

    /// From the program to the device.
    fn carry_in(&self, mut device: PipeWriter) {
        let mut bytes = [0; 4096];
        while !self.is_over() {
            let events = self.wait_for(PollFlags::IN, LOOK_EVERY);
            if events.contains(PollFlags::HUP) {
                // What a program wrote before it closed the port is its own, not the next program's.
                if events.contains(PollFlags::IN) {
                    self.open();
                    while let Ok(len @ 1..) = rustix::io::read(&self.terminal, &mut bytes[..]) {
                        self.hand_in(&bytes[..len], &mut device);
                    }
                }
                self.close();
                std::thread::sleep(LOOK_EVERY);
                continue;
            }
            // This must come before reading: the firmware drops what it finds while the port is closed.
            self.open();
            if let Ok(len) = rustix::io::read(&self.terminal, &mut bytes[..]) {
                self.hand_in(&bytes[..len], &mut device);
            }
        }
    }

    /// A device that makes the host wait makes the program wait: nothing is lost unless it closes the port.
    fn hand_in(&self, mut bytes: &[u8], device: &mut PipeWriter) {
        while !bytes.is_empty() && !self.is_over() {
            match device.write(bytes) {
                Ok(len) => bytes = &bytes[len..],
                Err(error) if error.kind() == ErrorKind::TimedOut => {
                    if self.wait_for(PollFlags::IN, Duration::ZERO).contains(PollFlags::HUP) {
                        return;
                    }
                }
                Err(_) => return,
            }
        }
    }

    /// Waits until the terminal is ready, or no program has it open, which shows as a hang-up.
    fn wait_for(&self, what: PollFlags, timeout: Duration) -> PollFlags {
        let mut fds = [PollFd::new(&self.terminal, what)];
        let timeout = Timespec { tv_sec: 0, tv_nsec: timeout.subsec_nanos().into() };
        // Interrupted, or nothing in time: the caller tries again.
        let _ = poll(&mut fds, Some(&timeout));
        fds[0].revents()
    }

    fn open(&self) {
        if !self.dtr.is_up() {
            self.dtr.set(true);
            self.wait_until_seen();
        }
    }

    /// The program has closed the port: nothing that the device still had for it may reach the next program.
    fn close(&self) {
        if self.dtr.is_up() {
            self.dtr.set(false);
            self.wait_until_seen();
            let _in_hand = self.in_hand.lock().unwrap_or_else(PoisonError::into_inner);
            while self.from_device.take(&mut [0; 4096]) > 0 {}
            // Only the other end can discard what is in the terminal.
            if let Ok(other) = other_end(&self.path) {
                let _ = rustix::termios::tcflush(other, QueueSelector::IFlush);
            }
        }
    }

    fn wait_until_seen(&self) {
        while !self.dtr.is_seen() && !self.is_over() {
            std::thread::sleep(Duration::from_micros(100));
        }
    }

    /// From the device to the program.
    fn carry_out(&self) {
        let mut bytes = [0; 4096];
        while !self.is_over() {
            if !self.from_device.wait_for_bytes(LOOK_EVERY) {
                continue;
            }
            let _in_hand = self.in_hand.lock().unwrap_or_else(PoisonError::into_inner);
            let len = self.from_device.take(&mut bytes);
            let mut rest = &bytes[..len];
            while !rest.is_empty() && self.dtr.is_up() && !self.is_over() {
                match rustix::io::write(&self.terminal, rest) {
                    Ok(len) => rest = &rest[len..],
                    Err(_) => {
                        self.wait_for(PollFlags::OUT, LOOK_EVERY);
                    }
                }
            }
        }
    }
}

/// A pseudo-terminal in raw mode, and the path of its other end. That end has been opened and closed once, so that the system
/// reports when a program opens it.
fn new_terminal() -> io::Result<(OwnedFd, String)> {
    let Pty { controller, user } = openpty(None, None)?;
    let mut settings = rustix::termios::tcgetattr(&user)?;
    settings.make_raw();
    rustix::termios::tcsetattr(&user, OptionalActions::Now, &settings)?;
    let path = rustix::termios::ttyname(&user, Vec::new())?;
    let path = path.into_string().map_err(|_| io::Error::other("its name is not text"))?;
    let flags = rustix::fs::fcntl_getfl(&controller)?;
    rustix::fs::fcntl_setfl(&controller, flags | OFlags::NONBLOCK)?;
    Ok((controller, path))
}

fn other_end(path: &str) -> io::Result<OwnedFd> {
    Ok(rustix::fs::open(path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?)
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.quit.store(true, Ordering::Relaxed);
        self.device = None;
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}
