//! The virtual device behind a pseudo terminal, so that any program that opens serial ports can use it.

use std::io::{ErrorKind, Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};

use super::options::Options;
use super::runner::{After, VirtualDevice, start_with};
use crate::device::{DeviceError, PipeReader, PipeWriter};

/// How often a terminal that nobody has open is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// A pseudo terminal with a virtual device behind it, until it is dropped. A reset starts its firmware
/// again behind the same path; the program that has it open finds no session any more.
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

    /// False once the firmware has left for the bootloader, which the virtual device does not have.
    pub fn is_running(&self) -> bool {
        self.device.as_ref().is_some_and(VirtualDevice::is_running)
    }
}

/// Starts a virtual device behind a new pseudo terminal.
pub fn open_terminal(options: Options) -> Result<Terminal, DeviceError> {
    let failed = |error: serialport::Error| DeviceError::Open {
        address: "pseudo terminal".to_owned(),
        reason: error.to_string(),
    };
    // The pair sets raw mode. Once its other end was open and is closed, the system tells when a program opens it.
    let (mut master, other) = TTYPort::pair().map_err(failed)?;
    let path = other.name().unwrap_or_default();
    drop(other);
    master.set_timeout(LOOK_EVERY).map_err(failed)?;
    let writer = master.try_clone_native().map_err(failed)?;
    // A board's port comes back under the same name.
    let connection = start_with(options, After::Restart)?;
    connection.open.store(false, Ordering::Relaxed);
    let quit = Arc::new(AtomicBool::new(false));
    let (open, to_device, from_device) = (connection.open, connection.writer, connection.reader);
    let (quit_in, quit_out) = (Arc::clone(&quit), Arc::clone(&quit));
    let is_open = Arc::clone(&open);
    let spawn = |name: &str, body: Box<dyn FnOnce() + Send>| {
        std::thread::Builder::new().name(name.to_owned()).spawn(body).map_err(DeviceError::Thread)
    };
    let inward = spawn("cantap-pty-in", Box::new(move || carry_in(master, to_device, &open, &quit_in)))?;
    let outward =
        spawn("cantap-pty-out", Box::new(move || carry_out(from_device, writer, &is_open, &quit_out)))?;
    Ok(Terminal { path, quit, threads: vec![inward, outward], device: Some(connection.device) })
}

/// From the program to the device. The system reports a terminal that no program has open as broken.
fn carry_in(mut terminal: TTYPort, mut device: PipeWriter, open: &AtomicBool, quit: &AtomicBool) {
    let mut bytes = [0; 4096];
    while !quit.load(Ordering::Relaxed) && !device.is_closed() {
        match terminal.read(&mut bytes) {
            Ok(len) if len > 0 => {
                open.store(true, Ordering::Relaxed);
                // What finds no room within the pipe's patience is lost, as on a port that is not read.
                let _ = device.write_all(&bytes[..len]);
            }
            Err(error) if error.kind() == ErrorKind::TimedOut => open.store(true, Ordering::Relaxed),
            _ => {
                open.store(false, Ordering::Relaxed);
                std::thread::sleep(LOOK_EVERY);
            }
        }
    }
}

/// From the device to the program.
fn carry_out(mut device: PipeReader, mut terminal: TTYPort, open: &AtomicBool, quit: &AtomicBool) {
    let mut bytes = [0; 4096];
    while !quit.load(Ordering::Relaxed) && !device.is_closed() {
        let Ok(len) = device.read(&mut bytes) else { continue };
        let mut rest = &bytes[..len];
        while !rest.is_empty() && open.load(Ordering::Relaxed) && !quit.load(Ordering::Relaxed) {
            match terminal.write(rest) {
                Ok(len) => rest = &rest[len..],
                Err(error) if error.kind() == ErrorKind::TimedOut => {}
                // Nobody has it open any more.
                Err(_) => break,
            }
        }
    }
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
