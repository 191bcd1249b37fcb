//! Devices on serial ports.

use std::time::{Duration, Instant};

use cantap_wire::{USB_PID, USB_VID};
use serialport::{ErrorKind, SerialPortType};

use super::{DeviceError, Link};

/// A read returns after this time at the latest.
const READ_TIMEOUT: Duration = Duration::from_millis(50);
/// CDC-ACM has no line speed; the number only has to be valid.
const NOMINAL_BAUD: u32 = 115_200;

/// Whoever holds a port for no longer than this does not make it busy: a program that is being started anywhere in this one holds a copy of
/// every port that is open meanwhile, with its lock, until it runs.
const LAST_HOLDER: Duration = Duration::from_millis(300);

/// A serial port with a cantap board behind it, judged by its USB IDs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Board {
    /// The port's path or name.
    pub port: String,
    /// The board's serial number, if the system knows it.
    pub serial_number: Option<String>,
    /// The board's product name, if the system knows it.
    pub product: Option<String>,
}

/// Finds connected boards by their USB IDs. On a system that does not report IDs, it finds none.
pub fn list() -> Result<Vec<Board>, DeviceError> {
    let ports = serialport::available_ports()
        .map_err(|error| DeviceError::Open { address: "serial ports".to_owned(), source: error.into() })?;
    Ok(ports
        .into_iter()
        .filter_map(|port| match port.port_type {
            SerialPortType::UsbPort(usb) if (usb.vid, usb.pid) == (USB_VID, USB_PID) => {
                Some(Board { port: port.port_name, serial_number: usb.serial_number, product: usb.product })
            }
            _ => None,
        })
        .collect())
}

/// The current port of the board with a serial number, if the system knows it.
pub fn port_of(serial_number: &str) -> Option<String> {
    let board =
        list().ok()?.into_iter().find(|board| board.serial_number.as_deref() == Some(serial_number))?;
    Some(board.port)
}

/// Opens a port exclusively, in raw mode, and raises DTR.
pub fn open(port: &str) -> Result<Link, DeviceError> {
    open_at(port, NOMINAL_BAUD)
}

/// The same, for a line that has a speed, in baud.
pub fn open_at(port: &str, baud: u32) -> Result<Link, DeviceError> {
    let until = Instant::now() + LAST_HOLDER;
    let reader = loop {
        let open = serialport::new(port, baud).timeout(READ_TIMEOUT).dtr_on_open(true).open();
        match open.map_err(|error| translate(port, error)) {
            Err(DeviceError::Busy { .. }) if Instant::now() < until => std::thread::sleep(LAST_HOLDER / 20),
            other => break other?,
        }
    };
    let writer = reader.try_clone().map_err(|error| translate(port, error))?;
    Ok(Link { reader: Box::new(reader), writer: Box::new(writer), keep_alive: Box::new(()) })
}

fn translate(port: &str, error: serialport::Error) -> DeviceError {
    let address = port.to_owned();
    let said = error.to_string();
    let busy = said.contains("lock") || said.contains("busy");
    match error.kind {
        _ if busy => DeviceError::Busy { address },
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) if cfg!(windows) => DeviceError::Busy { address },
        ErrorKind::Io(std::io::ErrorKind::PermissionDenied) => DeviceError::Forbidden { address },
        ErrorKind::NoDevice | ErrorKind::Io(std::io::ErrorKind::NotFound) => {
            DeviceError::NotFound { address }
        }
        _ => DeviceError::Open { address, source: error.into() },
    }
}
