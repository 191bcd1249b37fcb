//! Finding and opening an adapter on USB.

use nusb::{DeviceInfo, ErrorKind, Interface, MaybeFuture};

use crate::driver::OpenError;

/// A kind of adapter.
pub(crate) struct Kind {
    /// What its addresses begin with, without the colon.
    pub scheme: &'static str,
    /// For people.
    pub what: &'static str,
    /// Whether a device is one.
    pub is_one: fn(&DeviceInfo) -> bool,
    /// The kernel's driver of these adapters on Linux, if there is one.
    pub kernel_driver: Option<&'static str>,
}

impl Kind {
    /// Opens the adapter with a serial number, or the only one if that is empty, and claims its first interface. Returns the number, too.
    pub fn open(&self, serial: &str, address: &str) -> Result<(DeviceInfo, Interface, String), OpenError> {
        let failed = |error| self.failed(&error, address);
        let all = nusb::list_devices().wait().map_err(failed)?;
        let known: Vec<DeviceInfo> = all.filter(self.is_one).collect();
        let serials: Vec<String> = known.iter().map(serial_of).collect();
        let mut fitting =
            known.iter().zip(&serials).filter(|(_, number)| serial.is_empty() || *number == serial);
        let (Some((device, number)), None) = (fitting.next(), fitting.next()) else {
            let there = match &serials[..] {
                [] => "there is none".to_owned(),
                serials => format!("there are {}", serials.join(", ")),
            };
            let (address, what, scheme) = (address.to_owned(), self.what, self.scheme);
            return Err(OpenError::NoUsbAdapter { address, what, there, scheme });
        };
        let interface =
            device.open().wait().and_then(|device| device.claim_interface(0).wait()).map_err(failed)?;
        Ok((device.clone(), interface, number.clone()))
    }

    /// What an error means for whoever wants to use the adapter.
    pub fn failed(&self, error: &nusb::Error, address: &str) -> OpenError {
        OpenError::Usb {
            address: address.to_owned(),
            reason: error.to_string(),
            advice: self.advice(error.kind()),
        }
    }

    fn advice(&self, kind: ErrorKind) -> String {
        match (kind, self.kernel_driver) {
            (ErrorKind::Busy, Some(driver)) if cfg!(target_os = "linux") => format!(
                "; the kernel's driver has it: use its interface (-d can0), or as root: rmmod {driver}"
            ),
            (ErrorKind::Busy, _) => "; another program has it".to_owned(),
            (ErrorKind::PermissionDenied, _) if cfg!(target_os = "linux") => {
                "; give your user the right with a udev rule, or run this as root".to_owned()
            }
            _ if cfg!(windows) => "; give the device the driver WinUSB, for example with Zadig".to_owned(),
            _ => String::new(),
        }
    }
}

/// A serial number as people see it, and type it.
fn serial_of(device: &DeviceInfo) -> String {
    device.serial_number().unwrap_or_default().chars().filter(char::is_ascii_graphic).collect()
}

/// Why there is no more to come.
pub(crate) fn reason(error: nusb::transfer::TransferError) -> String {
    use nusb::transfer::TransferError;
    match error {
        TransferError::Disconnected => "it was unplugged".to_owned(),
        TransferError::Stall => "it refuses transfers; unplug it and plug it in again".to_owned(),
        other => other.to_string(),
    }
}
