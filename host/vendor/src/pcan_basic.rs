//! PEAK's PCANBasic: channels of PCAN adapters on Windows, on Linux with PEAK's own driver, and on macOS through the compatible PCBUSB.
//!
//! Names and numbers are those of PEAK's `PCANBasic.h`.

use std::ffi::{c_char, c_void};
use std::fmt;
use std::path::Path;
use std::str::FromStr;

use crate::LoadError;
use crate::library::{Loaded, text};

#[cfg(windows)]
const SYSTEM_NAME: &str = "PCANBasic.dll";
#[cfg(target_os = "macos")]
const SYSTEM_NAME: &str = "libPCBUSB.dylib";
#[cfg(not(any(windows, target_os = "macos")))]
const SYSTEM_NAME: &str = "libpcanbasic.so";

#[cfg(target_os = "macos")]
const ADVICE: &str = "install PCBUSB from mac-can.com";
#[cfg(not(target_os = "macos"))]
const ADVICE: &str = "install PCAN-Basic from peak-system.com";

/// Letters of the longest text.
const TEXT: usize = 256;
/// English.
const LANGUAGE: u16 = 0x09;

/// A channel's handle (`TPCANHandle`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Channel(u16);

/// Kinds of hardware: the name, the handle of the first channel, and how many there are. From the ninth on, handles continue at 16 times the
/// first handle's plus 9.
const KINDS: [(&str, u16, u16); 3] = [("USB", 0x51, 16), ("PCI", 0x41, 16), ("LAN", 0x801, 16)];

impl Channel {
    /// No channel: parameters of the library itself.
    pub const NONE: Self = Self(0);

    /// Every channel that the library knows, in the order in which most people have them.
    pub fn all() -> impl Iterator<Item = Self> {
        KINDS.iter().flat_map(|(_, first, count)| (0..*count).map(|index| Self::nth(*first, index)))
    }

    const fn nth(first: u16, index: u16) -> Self {
        // `PCAN_USBBUS9` is 0x509, and `PCAN_LANBUS9` 0x809.
        if index < 8 || first > 0xFF { Self(first + index) } else { Self((first & 0xF0) * 16 + index + 1) }
    }
}

impl fmt::Display for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, first, count) in KINDS {
            if let Some(index) = (0..count).find(|index| Self::nth(first, *index) == *self) {
                return write!(f, "PCAN_{name}BUS{}", index + 1);
            }
        }
        write!(f, "{:#X}", self.0)
    }
}

/// A text names no channel.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "'{0}' is no channel of PCAN-Basic; write PCAN_USBBUS1 to PCAN_USBBUS16, PCAN_PCIBUS1 or PCAN_LANBUS1"
)]
pub struct BadChannel(String);

impl FromStr for Channel {
    type Err = BadChannel;

    fn from_str(text: &str) -> Result<Self, BadChannel> {
        let upper = text.to_ascii_uppercase();
        let name = if upper.starts_with("PCAN_") { upper } else { format!("PCAN_{upper}") };
        Self::all().find(|channel| channel.to_string() == name).ok_or_else(|| BadChannel(text.to_owned()))
    }
}

/// What a function returns (`TPCANStatus`): 0, an error, or several bits about the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status(pub u32);

/// Bits and values of [`Status`].
pub mod status {
    /// The controller's transmit buffer is full.
    pub const TRANSMIT_FULL: u32 = 0x1;
    /// The controller was read too late: it lost frames.
    pub const OVERRUN: u32 = 0x2;
    /// An error counter has reached the lower limit.
    pub const BUS_LIGHT: u32 = 0x4;
    /// An error counter has reached the warning limit.
    pub const BUS_HEAVY: u32 = 0x8;
    /// Bus-off.
    pub const BUS_OFF: u32 = 0x10;
    /// The receive queue is empty.
    pub const RECEIVE_EMPTY: u32 = 0x20;
    /// The receive queue was read too late: frames are lost.
    pub const QUEUE_OVERRUN: u32 = 0x40;
    /// The transmit queue is full.
    pub const QUEUE_FULL: u32 = 0x80;
    /// Another program has the hardware, or has set it up in another way.
    pub const IN_USE: u32 = 0x400 | 0x800;
    /// The device has no such parameter.
    pub const BAD_PARAMETER: u32 = 0x4000;
    /// Error-passive.
    pub const BUS_PASSIVE: u32 = 0x4_0000;
    /// It was done, but not as asked.
    pub const CAUTION: u32 = 0x200_0000;
    /// All that describe a bus, not a failure.
    pub const OF_THE_BUS: u32 = TRANSMIT_FULL
        | OVERRUN
        | BUS_LIGHT
        | BUS_HEAVY
        | BUS_OFF
        | RECEIVE_EMPTY
        | QUEUE_OVERRUN
        | QUEUE_FULL
        | BUS_PASSIVE;
}

impl Status {
    /// Whether any of these bits is set.
    pub const fn has(self, bits: u32) -> bool {
        self.0 & bits != 0
    }

    /// Success, without a word about the bus.
    pub const fn is_ok(self) -> bool {
        self.0 == 0
    }

    /// An error of the device or its driver, whatever is said about the bus beside it.
    pub const fn is_failure(self) -> bool {
        self.0 & !status::OF_THE_BUS != 0
    }

    const fn ok(self) -> Result<(), Self> {
        if self.is_ok() { Ok(()) } else { Err(self) }
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PCAN-Basic's error {:#X}", self.0)
    }
}

impl std::error::Error for Status {}

/// Parameters of [`PcanBasic::set`] and [`PcanBasic::get`] (`TPCANParameter`).
pub mod parameter {
    /// The number that its owner has given to a device.
    pub const DEVICE_ID: u8 = 0x01;
    /// The version of the library.
    pub const API_VERSION: u8 = 0x05;
    /// Whether to rejoin the bus after bus-off.
    pub const BUS_OFF_AUTORESET: u8 = 0x07;
    /// Whether to be silent. Set before a channel is initialised, it holds from the beginning.
    pub const LISTEN_ONLY: u8 = 0x08;
    /// Whether a channel is there and free: bit 0 it is there, bit 1 a program has it.
    pub const CHANNEL_CONDITION: u8 = 0x0D;
    /// The device's name.
    pub const HARDWARE_NAME: u8 = 0x0E;
    /// Whether frames are put into the receive queue.
    pub const RECEIVE_STATUS: u8 = 0x0F;
    /// Whether the device blinks.
    pub const IDENTIFYING: u8 = 0x15;
    /// What a channel can do: bit 0 is CAN FD.
    pub const CHANNEL_FEATURES: u8 = 0x16;
    /// Whether status messages are put into the receive queue.
    pub const ALLOW_STATUS_FRAMES: u8 = 0x1E;
    /// Whether remote frames are.
    pub const ALLOW_REMOTE_FRAMES: u8 = 0x1F;
    /// Whether error frames are.
    pub const ALLOW_ERROR_FRAMES: u8 = 0x20;
    /// How many channels are attached.
    pub const ATTACHED_CHANNELS_COUNT: u8 = 0x2A;
    /// What they are.
    pub const ATTACHED_CHANNELS: u8 = 0x2B;
    /// Whether frames that were sent are, once they were on the bus.
    pub const ALLOW_ECHO_FRAMES: u8 = 0x2C;
}

/// Bits of [`PcanMessage::kind`] (`TPCANMessageType`).
pub mod kind {
    /// A remote frame.
    pub const REMOTE: u8 = 0x01;
    /// An identifier of 29 bits.
    pub const EXTENDED: u8 = 0x02;
    /// CAN FD.
    pub const FD: u8 = 0x04;
    /// With a switched bit rate.
    pub const BRS: u8 = 0x08;
    /// From a node that is error-passive.
    pub const ESI: u8 = 0x10;
    /// A frame that this channel has sent.
    pub const ECHO: u8 = 0x20;
    /// An error frame.
    pub const ERROR: u8 = 0x40;
    /// A status message.
    pub const STATUS: u8 = 0x80;
}

/// What is received and sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PcanMessage {
    /// The identifier, 11 or 29 bits; of an error frame, which error.
    pub id: u32,
    /// See [`kind`].
    pub kind: u8,
    /// The length code on the bus, 0 to 15. What is larger was received so from the library.
    pub dlc: u8,
    /// The data; what is beyond the length is of no meaning.
    pub data: [u8; 64],
}

#[repr(C)]
#[derive(Clone, Copy)]
struct ClassicMessage {
    id: u32,
    kind: u8,
    len: u8,
    data: [u8; 8],
}

#[repr(C)]
#[derive(Clone, Copy, Default)]
struct ClassicStamp {
    millis: u32,
    millis_overflow: u16,
    micros: u16,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct FdMessage {
    id: u32,
    kind: u8,
    dlc: u8,
    data: [u8; 64],
}

/// A channel that is attached (`TPCANChannelInformation`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attached {
    /// The channel.
    pub channel: Channel,
    /// The name of its hardware.
    pub name: String,
    /// The number that its owner has given to the device.
    pub device_id: u32,
    /// Whether it has CAN FD.
    pub has_fd: bool,
    /// Whether a program has it.
    pub is_in_use: bool,
}

/// Letters of a hardware's name in [`ChannelInformation`], with its end.
const HARDWARE_NAME: usize = 33;
/// Most channels that a library is believed to have.
const MOST_ATTACHED: u32 = 256;

#[repr(C)]
#[derive(Clone, Copy)]
struct ChannelInformation {
    handle: u16,
    device: u8,
    controller: u8,
    features: u32,
    name: [u8; HARDWARE_NAME],
    device_id: u32,
    condition: u32,
}

impl ChannelInformation {
    const NONE: Self = Self {
        handle: 0,
        device: 0,
        controller: 0,
        features: 0,
        name: [0; HARDWARE_NAME],
        device_id: 0,
        condition: 0,
    };
}

/// Bits of a channel's condition: it is there; a program has it.
const CONDITION: (u32, u32) = (1, 2);

/// Microseconds after which a stamp begins again.
pub const STAMP_PERIOD_US: u64 = (1 << 48) * 1000;

impl ClassicStamp {
    fn micros(self) -> u64 {
        let millis = u64::from(self.millis) | u64::from(self.millis_overflow) << 32;
        millis * 1000 + u64::from(self.micros)
    }
}

/// The functions, as the header declares them. `__stdcall` on Windows, which is what "system" means there.
struct Functions {
    initialize: unsafe extern "system" fn(u16, u16, u8, u32, u16) -> u32,
    initialize_fd: unsafe extern "system" fn(u16, *const c_char) -> u32,
    uninitialize: unsafe extern "system" fn(u16) -> u32,
    get_status: unsafe extern "system" fn(u16) -> u32,
    read: unsafe extern "system" fn(u16, *mut ClassicMessage, *mut ClassicStamp) -> u32,
    read_fd: unsafe extern "system" fn(u16, *mut FdMessage, *mut u64) -> u32,
    write: unsafe extern "system" fn(u16, *mut ClassicMessage) -> u32,
    write_fd: unsafe extern "system" fn(u16, *mut FdMessage) -> u32,
    get_value: unsafe extern "system" fn(u16, u8, *mut c_void, u32) -> u32,
    set_value: unsafe extern "system" fn(u16, u8, *mut c_void, u32) -> u32,
    get_error_text: unsafe extern "system" fn(u32, u16, *mut c_char) -> u32,
}

/// The library.
pub struct PcanBasic {
    functions: Functions,
    /// Unloaded when nobody can call its functions any more.
    _library: Loaded,
}

impl PcanBasic {
    /// Loads it: the one at a path that begins with the root, or the system's.
    pub fn load(path: Option<&Path>) -> Result<Self, LoadError> {
        let library = Loaded::load(path, SYSTEM_NAME, ADVICE)?;
        // SAFETY: each field has the type that PEAK's header declares for that function.
        let functions = unsafe {
            Functions {
                initialize: library.function("CAN_Initialize")?,
                initialize_fd: library.function("CAN_InitializeFD")?,
                uninitialize: library.function("CAN_Uninitialize")?,
                get_status: library.function("CAN_GetStatus")?,
                read: library.function("CAN_Read")?,
                read_fd: library.function("CAN_ReadFD")?,
                write: library.function("CAN_Write")?,
                write_fd: library.function("CAN_WriteFD")?,
                get_value: library.function("CAN_GetValue")?,
                set_value: library.function("CAN_SetValue")?,
                get_error_text: library.function("CAN_GetErrorText")?,
            }
        };
        Ok(Self { functions, _library: library })
    }

    /// Takes part in a bus with the bit timing registers of an SJA1000 at 8 MHz: BTR0 in the upper byte, BTR1 in the lower.
    pub fn initialize(&self, channel: Channel, btr0btr1: u16) -> Result<(), Status> {
        // SAFETY: numbers alone. The last three are for hardware that is not plug and play.
        Status(unsafe { (self.functions.initialize)(channel.0, btr0btr1, 0, 0, 0) }).ok()
    }

    /// The same for CAN FD, with a text such as `f_clock_mhz=80,nom_brp=2,…`.
    pub fn initialize_fd(&self, channel: Channel, timing: &std::ffi::CStr) -> Result<(), Status> {
        // SAFETY: the text ends with a NUL and is only read.
        Status(unsafe { (self.functions.initialize_fd)(channel.0, timing.as_ptr()) }).ok()
    }

    /// Leaves a bus; what is in the receive queue is gone.
    pub fn uninitialize(&self, channel: Channel) -> Result<(), Status> {
        // SAFETY: a number alone.
        Status(unsafe { (self.functions.uninitialize)(channel.0) }).ok()
    }

    /// What is known about the bus.
    pub fn status(&self, channel: Channel) -> Status {
        // SAFETY: a number alone.
        Status(unsafe { (self.functions.get_status)(channel.0) })
    }

    /// The next message of a classical channel, with its stamp in microseconds. The status may have something to report in its place.
    pub fn read(&self, channel: Channel) -> Result<(PcanMessage, u64), Status> {
        let mut message = ClassicMessage { id: 0, kind: 0, len: 0, data: [0; 8] };
        let mut stamp = ClassicStamp::default();
        // SAFETY: both are as the header lays them out, and live until the call returns.
        Status(unsafe { (self.functions.read)(channel.0, &raw mut message, &raw mut stamp) }).ok()?;
        let mut data = [0; 64];
        data[..8].copy_from_slice(&message.data);
        Ok((PcanMessage { id: message.id, kind: message.kind, dlc: message.len, data }, stamp.micros()))
    }

    /// The same for a channel with CAN FD.
    pub fn read_fd(&self, channel: Channel) -> Result<(PcanMessage, u64), Status> {
        let mut message = FdMessage { id: 0, kind: 0, dlc: 0, data: [0; 64] };
        let mut stamp = 0;
        // SAFETY: as above.
        Status(unsafe { (self.functions.read_fd)(channel.0, &raw mut message, &raw mut stamp) }).ok()?;
        let FdMessage { id, kind, dlc, data } = message;
        Ok((PcanMessage { id, kind, dlc, data }, stamp))
    }

    /// Puts a classical frame into the transmit queue of a classical channel. Its length is 8 at most.
    pub fn write(&self, channel: Channel, message: &PcanMessage) -> Result<(), Status> {
        let mut eight = [0; 8];
        eight.copy_from_slice(&message.data[..8]);
        let len = message.dlc.min(8);
        let mut message = ClassicMessage { id: message.id, kind: message.kind, len, data: eight };
        // SAFETY: as the header lays it out; it lives until the call returns.
        Status(unsafe { (self.functions.write)(channel.0, &raw mut message) }).ok()
    }

    /// The same for a channel with CAN FD.
    pub fn write_fd(&self, channel: Channel, message: &PcanMessage) -> Result<(), Status> {
        let &PcanMessage { id, kind, dlc, data } = message;
        let mut message = FdMessage { id, kind, dlc, data };
        // SAFETY: as above.
        Status(unsafe { (self.functions.write_fd)(channel.0, &raw mut message) }).ok()
    }

    /// A parameter that is a number.
    pub fn get(&self, channel: Channel, parameter: u8) -> Result<u32, Status> {
        let mut value = 0u32;
        // SAFETY: four bytes, as the last argument says.
        Status(unsafe { (self.functions.get_value)(channel.0, parameter, (&raw mut value).cast(), 4) })
            .ok()?;
        Ok(value)
    }

    /// A parameter that is a text.
    pub fn text(&self, channel: Channel, parameter: u8) -> Result<String, Status> {
        let mut buffer = [0u8; TEXT];
        let room = buffer.len() as u32;
        // SAFETY: as many bytes as the last argument says.
        Status(unsafe { (self.functions.get_value)(channel.0, parameter, buffer.as_mut_ptr().cast(), room) })
            .ok()?;
        Ok(text(&buffer))
    }

    /// The channels that are attached, none of which is opened for it.
    pub fn attached(&self) -> Result<Vec<Attached>, Status> {
        let count = match self.get(Channel::NONE, parameter::ATTACHED_CHANNELS_COUNT) {
            Ok(count) => count.min(MOST_ATTACHED),
            // Libraries before 4.4, and PCBUSB, know only the condition of one channel.
            Err(_) => return Ok(Channel::all().filter_map(|channel| self.one_attached(channel)).collect()),
        };
        let mut buffer = vec![ChannelInformation::NONE; count as usize];
        let room = size_of_val(&buffer[..]) as u32;
        if count > 0 {
            let buffer = buffer.as_mut_ptr().cast();
            // SAFETY: as many bytes as the last argument says, of a type that is any bytes.
            Status(unsafe { (self.functions.get_value)(0, parameter::ATTACHED_CHANNELS, buffer, room) })
                .ok()?;
        }
        let there = buffer.iter().filter(|channel| channel.handle != 0);
        Ok(there
            .map(|information| Attached {
                channel: Channel(information.handle),
                name: text(&information.name),
                device_id: information.device_id,
                has_fd: information.features & 1 != 0,
                is_in_use: information.condition & CONDITION.1 != 0,
            })
            .collect())
    }

    fn one_attached(&self, channel: Channel) -> Option<Attached> {
        let condition = self.get(channel, parameter::CHANNEL_CONDITION).unwrap_or(0);
        (condition & (CONDITION.0 | CONDITION.1) != 0).then(|| Attached {
            channel,
            name: self.text(channel, parameter::HARDWARE_NAME).unwrap_or_default(),
            device_id: self.get(channel, parameter::DEVICE_ID).unwrap_or(0),
            has_fd: self.get(channel, parameter::CHANNEL_FEATURES).is_ok_and(|bits| bits & 1 != 0),
            is_in_use: condition & CONDITION.1 != 0,
        })
    }

    /// Sets a parameter that is a number.
    pub fn set(&self, channel: Channel, parameter: u8, mut value: u32) -> Result<(), Status> {
        // SAFETY: four bytes, as the last argument says.
        Status(unsafe { (self.functions.set_value)(channel.0, parameter, (&raw mut value).cast(), 4) }).ok()
    }

    /// What the library says about an error, in English.
    pub fn describe(&self, status: Status) -> String {
        // The header asks for 256 bytes; a library that writes more finds room.
        let mut buffer = [0u8; 4 * TEXT];
        // SAFETY: four times the room that the header asks for.
        let said = unsafe { (self.functions.get_error_text)(status.0, LANGUAGE, buffer.as_mut_ptr().cast()) };
        if said == 0 { text(&buffer) } else { status.to_string() }
    }
}

#[cfg(test)]
mod tests;
