//! Where a device is: `/dev/ttyACM0`, `COM5`, `virtual:load=50`, `emu:firmware.elf`; at a server: `unix:`, `tcp://HOST`; another
//! maker's adapter: `can0`, `slcan:PORT`, `socketcand://HOST/can0`.

use std::borrow::Borrow;
use std::fmt;
use std::io;
use std::ops::Deref;
use std::path::Path;
use std::str::FromStr;

use cantap::device::Link;
use cantap::wire::CHANNELS;
use cantap::{Channel, Device, DeviceError};
use cantap_virtual::Options;

use crate::server::{Server, ServerError};

/// The bit rate of the virtual device's buses is set by the program that opens a channel; this is the one assumed
/// otherwise.
const VIRTUAL_BITRATE_BPS: u32 = 500_000;

/// The address of a device, as users type it after `-d`.
#[derive(Clone, Debug)]
pub struct Address {
    /// As typed.
    text: String,
    place: Place,
}

/// What an address names.
#[derive(Clone, Debug)]
enum Place {
    /// The serial port of that name.
    Serial,
    /// A server that shares a board.
    Server(Server),
    /// Another maker's adapter.
    Adapter(cantap_adapters::Place),
    /// The virtual device.
    Virtual(Box<Options>),
    /// A firmware ELF on the emulated board.
    #[cfg(feature = "emu")]
    Emulated(Box<cantap_sim::address::Address>),
}

/// Why a text is not a device address.
#[derive(Debug, thiserror::Error)]
pub enum AddressError {
    /// It is not an address.
    #[error("'{address}' is not a device address: {reason}")]
    Bad {
        /// As given.
        address: String,
        /// What is wrong with it and what would be right.
        reason: String,
    },
    /// The device has no such option.
    #[error("'{address}' is not a device address: {reason}")]
    Option {
        /// As given.
        address: String,
        /// What is wrong with it and what would be right.
        reason: String,
    },
    /// This build does not support it.
    #[cfg(not(feature = "emu"))]
    #[error("this build of cantap has no support for '{0}'; build it with the feature `emu`")]
    NotBuilt(String),
}

/// Why a device cannot be reached.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// The port cannot be opened, or what is there is not cantap.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The server cannot be used.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// The adapter cannot be used.
    #[error(transparent)]
    Adapter(cantap_adapters::OpenError),
    /// The virtual device's thread could not be started.
    #[error("the system refused a thread; close other programs and try again")]
    Virtual(#[source] io::Error),
    /// The firmware's ELF is unusable, or does not start.
    #[cfg(feature = "emu")]
    #[error("the emulated board at '{address}' does not start")]
    Emulated {
        /// As given.
        address: String,
        /// The reason.
        source: cantap_sim::address::AddressError,
    },
}

/// Why [`open`] gives no device.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The text is no address.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// The device cannot be reached.
    #[error(transparent)]
    Link(#[from] LinkError),
}

/// Begins a session with the device at an address: `/dev/ttyACM0`, `virtual:load=50`, `tcp://HOST` and the others.
pub fn open(address: &str) -> Result<OpenDevice, OpenError> {
    Ok(address.parse::<Address>()?.open()?)
}

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bad = |reason: &str| AddressError::Bad { address: text.to_owned(), reason: reason.to_owned() };
        let option =
            |reason: &str| AddressError::Option { address: text.to_owned(), reason: reason.to_owned() };
        let place = match text.split_once(':') {
            _ if text.is_empty() => {
                return Err(bad("it is empty; `cantap list` shows devices, `virtual` needs none"));
            }
            None if text == "virtual" => Place::Virtual(Box::default()),
            Some(("virtual", options)) => {
                let options =
                    options.parse().map_err(|error: cantap_virtual::BadOption| option(&error.to_string()))?;
                Place::Virtual(Box::new(options))
            }
            Some(("emu", "")) => return Err(bad("name the firmware, as in emu:firmware.elf")),
            None if text == "emu" => return Err(bad("name the firmware, as in emu:firmware.elf")),
            #[cfg(feature = "emu")]
            Some(("emu", file)) => {
                let board = file
                    .parse()
                    .map_err(|error: cantap_sim::address::AddressError| option(&error.to_string()))?;
                Place::Emulated(Box::new(board))
            }
            #[cfg(not(feature = "emu"))]
            Some(("emu", _)) => return Err(AddressError::NotBuilt(text.to_owned())),
            _ if Server::is_meant(text) => {
                Place::Server(Server::parse(text).map_err(|reason| option(&reason))?)
            }
            _ if cantap_adapters::Place::is_meant(text) => Place::Adapter(
                text.parse().map_err(|error: cantap_adapters::BadPlace| option(&error.to_string()))?,
            ),
            _ => Place::Serial,
        };
        Ok(Self { text: if text == "virtual:" { "virtual" } else { text }.to_owned(), place })
    }
}

impl Address {
    /// The virtual device with default options, without an address typed by the user.
    pub fn of_virtual_device() -> Self {
        Self { text: "virtual".to_owned(), place: Place::Virtual(Box::default()) }
    }

    /// Whether a device there can have a stored configuration; a virtual one cannot unless a file is given for it.
    pub fn may_have_saved(&self) -> bool {
        match &self.place {
            Place::Virtual(options) => options.settings.is_some(),
            Place::Adapter(_) => false,
            _ => true,
        }
    }

    /// The serial port's path or name, if a cantap board is expected at one.
    pub fn serial_port(&self) -> Option<&str> {
        matches!(self.place, Place::Serial).then_some(self.text.as_str())
    }

    /// Whether a text can only mean a device that needs no port.
    pub fn is_no_port(text: &str) -> bool {
        text == "virtual" || text.starts_with("virtual:") || text.starts_with("emu:")
    }

    /// Whether an argument that can be either a trace or a device means a device: one that needs no port, one at a server, or a
    /// serial port. An existing file is a trace.
    pub fn is_meant_by(path: &Path) -> bool {
        if let Ok(there) = path.metadata() {
            return is_port(&there);
        }
        let text = path.to_str().unwrap_or_default();
        let is_com = |text: &str| {
            let digits = text.strip_prefix("COM");
            digits
                .is_some_and(|digits| !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()))
        };
        Self::is_no_port(text)
            || Server::is_meant(text)
            || cantap_adapters::Place::is_meant(text)
            || text.starts_with("/dev/")
            || is_com(text)
    }

    /// Whether the virtual device simulates a vehicle, which has its own database.
    pub fn is_car(&self) -> bool {
        matches!(&self.place, Place::Virtual(options) if options.car)
    }

    /// Whether the bit rate of a bus there is set by somebody else: a simulated vehicle, a CAN interface's owner, a program that writes a trace.
    pub fn has_bit_rate(&self) -> bool {
        self.is_car() || matches!(&self.place, Place::Adapter(adapter) if !adapter.sets_bit_rate())
    }

    /// Whether a device there can go and come back; one inside this process cannot.
    pub const fn may_come_back(&self) -> bool {
        matches!(self.place, Place::Serial | Place::Server(_))
            || matches!(&self.place, Place::Adapter(adapter) if adapter.may_come_back())
    }

    /// Begins a session with the board of a serial number at its current port, if the system can find it; otherwise with
    /// whatever is at the address.
    pub fn open_again(&self, serial_number: Option<&str>) -> Result<OpenDevice, LinkError> {
        Ok(self.over(self.link(serial_number)?)?)
    }

    /// Begins a session with the device through a link that the caller has: one to a server in its own process.
    pub fn over(&self, link: Link) -> Result<OpenDevice, DeviceError> {
        let device = Device::over(link, &self.text)?;
        if let Place::Adapter(adapter) = &self.place
            && let Some(bitrate_bps) = adapter.data_bitrate()
        {
            let numbers = Channel::ALL.into_iter().take(device.hello().channels.into());
            numbers.for_each(|channel| device.set_data_bitrate(channel, Some(bitrate_bps)));
        }
        Ok(OpenDevice { device, address: self.clone(), bitrates: self.bitrates_of_buses() })
    }

    /// Begins a session with the device.
    pub fn open(&self) -> Result<OpenDevice, LinkError> {
        self.open_again(None)
    }

    /// Connects to the device; if a serial number is given, to that board at its current port, if the system
    /// can find it.
    pub fn link(&self, serial_number: Option<&str>) -> Result<Link, LinkError> {
        Ok(match &self.place {
            Place::Serial => {
                let port = serial_number.and_then(cantap::device::port_of);
                cantap::device::open_port(port.as_deref().unwrap_or(&self.text))?
            }
            Place::Server(server) => server.link()?,
            Place::Adapter(adapter) => cantap_adapters::open(adapter).map_err(|error| match error {
                cantap_adapters::OpenError::Device(error) => LinkError::Device(error),
                other => LinkError::Adapter(other),
            })?,
            Place::Virtual(options) => {
                cantap_virtual::start((**options).clone()).map_err(LinkError::Virtual)?.into_link()
            }
            #[cfg(feature = "emu")]
            Place::Emulated(board) => {
                let port = (**board)
                    .clone()
                    .open()
                    .map_err(|source| LinkError::Emulated { address: self.to_string(), source })?;
                Link::new(port.reader, port.writer).keeping(port.device)
            }
        })
    }

    /// The bit rates of the buses in bit/s, if they are known without listening.
    pub fn bitrates_of_buses(&self) -> [Option<u32>; CHANNELS] {
        match &self.place {
            Place::Virtual(options) => Channel::ALL
                .map(|channel| options.bitrate_of_bus(channel.index()).or(Some(VIRTUAL_BITRATE_BPS))),
            Place::Adapter(adapter) => [adapter.bitrate(), None],
            _ => [None; CHANNELS],
        }
    }
}

#[cfg(unix)]
fn is_port(there: &std::fs::Metadata) -> bool {
    use std::os::unix::fs::FileTypeExt;
    there.file_type().is_char_device()
}

#[cfg(not(unix))]
fn is_port(_: &std::fs::Metadata) -> bool {
    false
}

impl PartialEq for Address {
    fn eq(&self, other: &Self) -> bool {
        self.text == other.text
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// A device in a session, with what only its address says about it.
pub struct OpenDevice {
    device: Device,
    address: Address,
    /// Its buses' bit rates in bit/s, if known.
    bitrates: [Option<u32>; CHANNELS],
}

impl OpenDevice {
    /// The bit rate of a channel's bus in bit/s, if it is known without listening.
    pub const fn bitrate_of_bus(&self, channel: Channel) -> Option<u32> {
        self.bitrates[channel.index()]
    }

    /// Why a channel cannot be opened at a bit rate: the device's owner has set another one, which is not changed without being asked.
    pub fn rate_conflict(&self, bitrate_bps: u32) -> Option<String> {
        match &self.address.place {
            Place::Adapter(adapter) => adapter.rate_conflict(bitrate_bps),
            _ => None,
        }
    }
}

impl Borrow<Device> for OpenDevice {
    fn borrow(&self) -> &Device {
        &self.device
    }
}

impl Deref for OpenDevice {
    type Target = Device;

    fn deref(&self) -> &Device {
        &self.device
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_round_trip_and_bad_ones_say_what_would_be_right() {
        for text in [
            "/dev/ttyACM0",
            "COM5",
            "virtual",
            "virtual:load=50",
            "tcp://[::1]:5",
            "ssh://a@b/virtual:car",
            "slcan:COM3",
            "can0",
            "socketcan:bus7",
        ] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        assert_eq!("virtual:".parse::<Address>().unwrap().to_string(), "virtual");
        for text in [
            "",
            "emu",
            "emu:",
            "tcp:1.2.3.4",
            "virtual:speed=9",
            "tcp://",
            "ssh://-oX",
            "slcan:",
            "socketcand:pi",
        ] {
            assert!(text.parse::<Address>().is_err(), "{text}");
        }
    }

    #[test]
    fn what_stands_where_a_trace_can_stand_may_be_a_device() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("virtual");
        std::fs::write(&file, "").unwrap();
        assert!(!Address::is_meant_by(&file));
        for (text, is_device) in [
            ("virtual", true),
            ("virtual:car", true),
            ("emu:a.elf", true),
            ("COM5", true),
            ("slcan:/dev/ttyACM0", true),
            ("candump:-", true),
            ("vcan0", true),
            ("socketcan:can0", true),
            ("can0.log", false),
            ("/dev/ttyACM17", true),
            ("tcp://bench:4000", true),
            ("drive.log", false),
            ("COMmon.log", false),
            ("-", false),
        ] {
            assert_eq!(Address::is_meant_by(Path::new(text)), is_device, "{text}");
        }
        #[cfg(unix)]
        assert!(Address::is_meant_by(Path::new("/dev/null")));
    }

    #[cfg(feature = "emu")]
    #[test]
    fn an_emulated_address_round_trips() {
        assert_eq!("emu:a.elf,load=5".parse::<Address>().unwrap().to_string(), "emu:a.elf,load=5");
    }

    #[test]
    fn only_a_virtual_device_with_a_file_for_it_has_saved_anything() {
        let may = |text: &str| text.parse::<Address>().unwrap().may_have_saved();
        assert!(may("/dev/ttyACM0") && may("virtual:settings=a.bin"));
        assert!(!may("virtual") && !may("virtual:load=5"));
    }
}
