//! Bootloaders on USB.

use std::time::{Duration, Instant};

use nusb::descriptors::language_id::US_ENGLISH;
use nusb::transfer::{ControlIn, ControlOut, ControlType, Recipient};
use nusb::{DeviceId, DeviceInfo, ErrorKind, Interface, MaybeFuture};

use super::{Layout, Port, PortError};

/// The ROM bootloader of STM32 chips.
pub const VENDOR: u16 = 0x0483;
/// The same.
pub const PRODUCT: u16 = 0xDF11;
/// The interface, and its setting that is the flash.
const INTERFACE: u8 = 0;
/// A request's answer takes no longer.
const TIMEOUT: Duration = Duration::from_secs(5);
/// How often to look for a bootloader.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// DFU's functional descriptor (USB DFU 1.1, 4.1.3): its type, and where the transfer size is.
const FUNCTIONAL: u8 = 0x21;
const TRANSFER_SIZE_AT: usize = 5;

/// Why there is no way to a bootloader.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UsbError {
    /// The system does not list its USB devices.
    #[error("the system does not list USB devices: {0}")]
    List(#[source] nusb::Error),
    /// None came.
    #[error("no bootloader (0483:df11) came within {seconds} s")]
    NoneCame {
        /// How long it was waited for.
        seconds: u64,
    },
    /// There are several.
    #[error("{0} bootloaders (0483:df11) are connected; leave one")]
    Several(usize),
    /// It cannot be opened.
    #[error("the bootloader cannot be opened: {source}{advice}")]
    Open {
        /// What to do.
        advice: &'static str,
        /// Why.
        source: nusb::Error,
    },
    /// Its descriptors are not those of ST's bootloader.
    #[error("the device at 0483:df11 does not describe its flash as ST's bootloader does")]
    Unknown,
}

/// The bootloaders that are connected.
#[derive(Clone, Debug)]
pub struct Bootloaders {
    devices: Vec<DeviceInfo>,
}

impl Bootloaders {
    /// Those of now.
    pub fn list() -> Result<Self, UsbError> {
        let all = nusb::list_devices().wait().map_err(UsbError::List)?;
        let devices = all.filter(|device| (device.vendor_id(), device.product_id()) == (VENDOR, PRODUCT));
        Ok(Self { devices: devices.collect() })
    }

    /// Waits for one that is not among these.
    pub fn wait_for_another(&self, most: Duration) -> Result<UsbPort, UsbError> {
        let known: Vec<DeviceId> = self.devices.iter().map(DeviceInfo::id).collect();
        let deadline = Instant::now() + most;
        loop {
            let new: Vec<DeviceInfo> =
                Self::list()?.devices.into_iter().filter(|device| !known.contains(&device.id())).collect();
            match &new[..] {
                [] if Instant::now() >= deadline => {
                    return Err(UsbError::NoneCame { seconds: most.as_secs() });
                }
                [] => std::thread::sleep(LOOK_EVERY),
                [only] => match UsbPort::open(only) {
                    // The system's own rules may give the right to open it a moment later.
                    Err(UsbError::Open { .. }) if Instant::now() < deadline => std::thread::sleep(LOOK_EVERY),
                    opened => return opened,
                },
                several => return Err(UsbError::Several(several.len())),
            }
        }
    }

    /// The only one.
    pub fn only(&self) -> Result<UsbPort, UsbError> {
        match &self.devices[..] {
            [] => Err(UsbError::NoneCame { seconds: 0 }),
            [only] => UsbPort::open(only),
            several => Err(UsbError::Several(several.len())),
        }
    }
}

/// An open bootloader.
pub struct UsbPort {
    interface: Interface,
    layout: Layout,
    transfer_bytes: usize,
}

impl UsbPort {
    fn open(device: &DeviceInfo) -> Result<Self, UsbError> {
        let failed = |source: nusb::Error| UsbError::Open { advice: advice(source.kind()), source };
        let device = device.open().wait().map_err(failed)?;
        let interface = device.claim_interface(INTERFACE).wait().map_err(failed)?;
        let configuration = device.active_configuration().map_err(|_| UsbError::Unknown)?;
        let mut settings = configuration.interface_alt_settings();
        let flash = settings
            .find(|setting| (setting.interface_number(), setting.alternate_setting()) == (INTERFACE, 0));
        let name = flash.and_then(|setting| setting.string_index()).ok_or(UsbError::Unknown)?;
        let name =
            device.get_string_descriptor(name, US_ENGLISH, TIMEOUT).wait().map_err(|_| UsbError::Unknown)?;
        let layout = Layout::parse(&name).ok_or(UsbError::Unknown)?;
        let transfer_bytes = transfer_bytes(configuration.as_bytes()).ok_or(UsbError::Unknown)?;
        Ok(Self { interface, layout, transfer_bytes })
    }
}

/// What to do about a device that cannot be opened.
const fn advice(kind: ErrorKind) -> &'static str {
    match kind {
        ErrorKind::PermissionDenied if cfg!(target_os = "linux") => {
            "; install packaging/60-cantap.rules into /etc/udev/rules.d, or run this as root"
        }
        ErrorKind::Busy => "; another program has it, perhaps dfu-util",
        _ if cfg!(windows) => {
            "; give the device \"STM32 BOOTLOADER\" the driver WinUSB, for example with Zadig"
        }
        _ => "",
    }
}

/// The most bytes of a transfer, by the descriptors of a configuration.
fn transfer_bytes(mut descriptors: &[u8]) -> Option<usize> {
    while let [length, kind, ..] = *descriptors {
        let descriptor = descriptors.get(..usize::from(length)).filter(|_| length >= 2)?;
        if kind == FUNCTIONAL {
            let [low, high] = *descriptor.get(TRANSFER_SIZE_AT..TRANSFER_SIZE_AT + 2)? else { return None };
            return Some(usize::from(u16::from_le_bytes([low, high]))).filter(|bytes| *bytes > 0);
        }
        descriptors = &descriptors[usize::from(length)..];
    }
    None
}

impl Port for UsbPort {
    fn send(&mut self, request: u8, value: u16, data: &[u8]) -> Result<(), PortError> {
        let setup = ControlOut {
            control_type: ControlType::Class,
            recipient: Recipient::Interface,
            request,
            value,
            index: INTERFACE.into(),
            data,
        };
        Ok(self.interface.control_out(setup, TIMEOUT).wait()?)
    }

    fn receive(&mut self, request: u8, value: u16, length: usize) -> Result<Vec<u8>, PortError> {
        let setup = ControlIn {
            control_type: ControlType::Class,
            recipient: Recipient::Interface,
            request,
            value,
            index: INTERFACE.into(),
            length: u16::try_from(length)?,
        };
        Ok(self.interface.control_in(setup, TIMEOUT).wait()?)
    }

    fn pause(&mut self, time: Duration) {
        std::thread::sleep(time);
    }

    fn transfer_bytes(&self) -> usize {
        self.transfer_bytes
    }

    fn layout(&self) -> &Layout {
        &self.layout
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A configuration as the STM32F405's ROM has it, shortened to one setting.
    #[test]
    fn the_transfer_size_is_found_behind_the_interface() {
        let configuration = [
            9, 2, 27, 0, 1, 1, 0, 0xC0, 50, 9, 4, 0, 0, 0, 0xFE, 1, 2, 4, 9, 0x21, 0x0B, 255, 0, 0, 8, 0x1A,
            1,
        ];
        assert_eq!(transfer_bytes(&configuration), Some(2048));
        for end in 0..configuration.len() {
            assert_eq!(transfer_bytes(&configuration[..end]), None, "{end}");
        }
        assert_eq!(transfer_bytes(&[0, 0, 0]), None);
    }
}
