//! Kvaser's CANlib: channels of Kvaser's adapters on Windows, and on Linux with Kvaser's own driver. Its virtual channels are channels like others.
//!
//! Names and numbers are those of Kvaser's `canlib.h` and `canstat.h`.

use std::ffi::{c_char, c_int, c_long, c_uint, c_ulong, c_void};
use std::fmt;
use std::path::Path;

use crate::LoadError;
use crate::library::{Loaded, text};

#[cfg(windows)]
const SYSTEM_NAME: &str = "canlib32.dll";
#[cfg(not(windows))]
const SYSTEM_NAME: &str = "libcanlib.so";

#[cfg(target_os = "macos")]
const ADVICE: &str = "kvaser.com has no drivers for macOS; use the adapter on Windows or Linux";
#[cfg(not(target_os = "macos"))]
const ADVICE: &str = "install Kvaser's drivers from kvaser.com";

/// Letters of the longest text.
const TEXT: usize = 256;

/// An error (`canStatus`): below 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Error(pub i32);

impl Error {
    /// There is no message.
    pub const NO_MESSAGE: Self = Self(-2);
    /// The transmit buffer is full.
    pub const TRANSMIT_FULL: Self = Self(-13);
    /// The device cannot do that.
    pub const NOT_SUPPORTED: Self = Self(-19);
    /// Another program has the channel.
    pub const NO_ACCESS: Self = Self(-31);
    /// The library cannot do that.
    pub const NOT_IMPLEMENTED: Self = Self(-32);

    fn check(status: c_int) -> Result<c_int, Self> {
        if status < 0 { Err(Self(status)) } else { Ok(status) }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CANlib's error {}", self.0)
    }
}

impl std::error::Error for Error {}

/// An open channel (`canHandle`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Handle(c_int);

/// Flags of [`CanLib::open`].
pub mod open {
    /// Virtual channels, too.
    pub const ACCEPT_VIRTUAL: i32 = 0x20;
    /// Only if bit rate and mode may be set.
    pub const REQUIRE_INIT_ACCESS: i32 = 0x80;
    /// With CAN FD.
    pub const CAN_FD: i32 = 0x400;
}

/// Bits of [`CanLib::capabilities`].
pub mod capability {
    /// There is no hardware behind it.
    pub const VIRTUAL: u32 = 0x1_0000;
    /// CAN FD.
    pub const CAN_FD: u32 = 0x8_0000;
}

/// How a channel drives its bus: [`CanLib::set_output_control`].
pub mod output {
    /// Nothing is driven, acknowledgements included.
    pub const SILENT: u32 = 1;
    /// As a node of the bus.
    pub const NORMAL: u32 = 4;
}

/// Flags of [`KvaserMessage::flags`].
pub mod flag {
    /// A remote frame.
    pub const REMOTE: u32 = 0x1;
    /// An identifier of 11 bits.
    pub const STANDARD: u32 = 0x2;
    /// An identifier of 29 bits.
    pub const EXTENDED: u32 = 0x4;
    /// An error frame.
    pub const ERROR_FRAME: u32 = 0x20;
    /// A frame of this channel was on the bus.
    pub const TRANSMITTED: u32 = 0x40;
    /// A frame of this channel was given to the controller.
    pub const TRANSMIT_REQUEST: u32 = 0x80;
    /// Frames before this one were lost, by the hardware or on their way.
    pub const HARDWARE_OVERRUN: u32 = 0x200;
    /// The same, in the driver's queue.
    pub const SOFTWARE_OVERRUN: u32 = 0x400;
    /// A stuff error.
    pub const STUFF: u32 = 0x800;
    /// A form error.
    pub const FORM: u32 = 0x1000;
    /// A CRC error.
    pub const CRC: u32 = 0x2000;
    /// Sent dominant, read recessive.
    pub const BIT0: u32 = 0x4000;
    /// Sent recessive, read dominant.
    pub const BIT1: u32 = 0x8000;
    /// CAN FD.
    pub const FD: u32 = 0x1_0000;
    /// With a switched bit rate.
    pub const BRS: u32 = 0x2_0000;
    /// From a node that is error-passive.
    pub const ESI: u32 = 0x4_0000;
}

/// Bits of [`CanLib::status`].
pub mod status {
    /// Error-passive.
    pub const PASSIVE: u32 = 0x1;
    /// Bus-off.
    pub const BUS_OFF: u32 = 0x2;
    /// An error counter has reached the warning limit.
    pub const WARNING: u32 = 0x4;
    /// The hardware has lost frames.
    pub const HARDWARE_OVERRUN: u32 = 0x200;
    /// The driver has lost frames.
    pub const SOFTWARE_OVERRUN: u32 = 0x400;
}

/// Functions of [`CanLib::control`].
pub mod control {
    /// The grain of stamps, in microseconds.
    pub const SET_TIMER_SCALE: u32 = 6;
    /// Whether frames that were on the bus come back.
    pub const SET_TRANSMIT_ACKNOWLEDGE: u32 = 7;
    /// Whether other handles of this computer on the same channel see what is sent.
    pub const SET_LOCAL_ECHO: u32 = 32;
}

/// What is received and sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KvaserMessage {
    /// The identifier, 11 or 29 bits.
    pub id: i64,
    /// See [`flag`].
    pub flags: u32,
    /// Bytes of data of a CAN FD frame; of a classical one the length code, 0 to 15. What is larger was received so from the library.
    pub len: u32,
    /// The data; what is beyond the length is of no meaning.
    pub data: [u8; 64],
    /// In microseconds, if [`control::SET_TIMER_SCALE`] was set to 1; its lower 32 bits, since no more of it is there on every system.
    pub stamp_us: u32,
}

/// A bit's segments, in quanta.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segments {
    /// Before the sample point, without the first quantum.
    pub first: u32,
    /// After it.
    pub second: u32,
    /// The jump width.
    pub jump_width: u32,
}

/// A bit rate as the functions take it.
#[allow(clippy::unnecessary_fallible_conversions, reason = "of 32 bits on Windows")]
fn rate(bitrate_bps: u32) -> c_long {
    c_long::try_from(bitrate_bps).unwrap_or(c_long::MAX)
}

type WithHandle = unsafe extern "system" fn(c_int) -> c_int;

/// The functions, as the header declares them. `__stdcall` on Windows, which is what "system" means there.
struct Functions {
    get_number_of_channels: unsafe extern "system" fn(*mut c_int) -> c_int,
    get_channel_data: unsafe extern "system" fn(c_int, c_int, *mut c_void, usize) -> c_int,
    open_channel: unsafe extern "system" fn(c_int, c_int) -> c_int,
    close: WithHandle,
    bus_on: WithHandle,
    bus_off: WithHandle,
    set_bus_params: unsafe extern "system" fn(c_int, c_long, c_uint, c_uint, c_uint, c_uint, c_uint) -> c_int,
    set_bus_params_fd: unsafe extern "system" fn(c_int, c_long, c_uint, c_uint, c_uint) -> c_int,
    set_bus_output_control: unsafe extern "system" fn(c_int, c_uint) -> c_int,
    get_bus_output_control: unsafe extern "system" fn(c_int, *mut c_uint) -> c_int,
    io_control: unsafe extern "system" fn(c_int, c_uint, *mut c_void, c_uint) -> c_int,
    read: unsafe extern "system" fn(
        c_int,
        *mut c_long,
        *mut c_void,
        *mut c_uint,
        *mut c_uint,
        *mut c_ulong,
    ) -> c_int,
    write: unsafe extern "system" fn(c_int, c_long, *mut c_void, c_uint, c_uint) -> c_int,
    read_status: unsafe extern "system" fn(c_int, *mut c_ulong) -> c_int,
    request_chip_status: WithHandle,
    read_error_counters: unsafe extern "system" fn(c_int, *mut c_uint, *mut c_uint, *mut c_uint) -> c_int,
    get_error_text: unsafe extern "system" fn(c_int, *mut c_char, c_uint) -> c_int,
}

/// The library.
pub struct CanLib {
    functions: Functions,
    /// Unloaded when nobody can call its functions any more.
    _library: Loaded,
}

impl CanLib {
    /// Loads it: the one at a path that begins with the root, or the system's.
    pub fn load(path: Option<&Path>) -> Result<Self, LoadError> {
        let library = Loaded::load(path, SYSTEM_NAME, ADVICE)?;
        // SAFETY: each field has the type that Kvaser's header declares for that function.
        let (initialize, functions) = unsafe {
            let initialize: unsafe extern "system" fn() = library.function("canInitializeLibrary")?;
            let functions = Functions {
                get_number_of_channels: library.function("canGetNumberOfChannels")?,
                get_channel_data: library.function("canGetChannelData")?,
                open_channel: library.function("canOpenChannel")?,
                close: library.function("canClose")?,
                bus_on: library.function("canBusOn")?,
                bus_off: library.function("canBusOff")?,
                set_bus_params: library.function("canSetBusParams")?,
                set_bus_params_fd: library.function("canSetBusParamsFd")?,
                set_bus_output_control: library.function("canSetBusOutputControl")?,
                get_bus_output_control: library.function("canGetBusOutputControl")?,
                io_control: library.function("canIoCtl")?,
                read: library.function("canRead")?,
                write: library.function("canWrite")?,
                read_status: library.function("canReadStatus")?,
                request_chip_status: library.function("canRequestChipStatus")?,
                read_error_counters: library.function("canReadErrorCounters")?,
                get_error_text: library.function("canGetErrorText")?,
            };
            (initialize, functions)
        };
        // SAFETY: it has no arguments, and may be called more than once.
        unsafe { initialize() };
        Ok(Self { functions, _library: library })
    }

    /// How many channels there are, virtual ones among them.
    pub fn channels(&self) -> Result<u32, Error> {
        let mut count = 0;
        // SAFETY: the number lives until the call returns.
        Error::check(unsafe { (self.functions.get_number_of_channels)(&raw mut count) })?;
        Ok(u32::try_from(count).unwrap_or(0))
    }

    /// A channel's name, such as `Kvaser Leaf Light v2 HS (channel 0)`.
    pub fn name(&self, channel: u32) -> Result<String, Error> {
        const NAME: c_int = 13;
        let mut buffer = [0u8; TEXT];
        self.channel_data(channel, NAME, &mut buffer)?;
        Ok(text(&buffer))
    }

    /// The serial number of a channel's card; 0 for virtual channels.
    pub fn serial(&self, channel: u32) -> Result<u64, Error> {
        const SERIAL: c_int = 7;
        let mut buffer = [0u8; 8];
        self.channel_data(channel, SERIAL, &mut buffer)?;
        Ok(u64::from_ne_bytes(buffer))
    }

    /// What a channel can do: see [`capability`].
    pub fn capabilities(&self, channel: u32) -> Result<u32, Error> {
        const CAPABILITIES: c_int = 1;
        let mut buffer = [0u8; 4];
        self.channel_data(channel, CAPABILITIES, &mut buffer)?;
        Ok(u32::from_ne_bytes(buffer))
    }

    fn channel_data(&self, channel: u32, item: c_int, buffer: &mut [u8]) -> Result<(), Error> {
        let channel = c_int::try_from(channel).unwrap_or(c_int::MAX);
        // SAFETY: as many bytes as the last argument says.
        let status = unsafe {
            (self.functions.get_channel_data)(channel, item, buffer.as_mut_ptr().cast(), buffer.len())
        };
        Error::check(status).map(|_| ())
    }

    /// Opens a channel, which is not on its bus yet. See [`open`].
    pub fn open(&self, channel: u32, flags: i32) -> Result<Handle, Error> {
        let channel = c_int::try_from(channel).unwrap_or(c_int::MAX);
        // SAFETY: numbers alone.
        Error::check(unsafe { (self.functions.open_channel)(channel, flags) }).map(Handle)
    }

    /// Closes a channel. Its handle is void afterwards.
    pub fn close(&self, handle: Handle) -> Result<(), Error> {
        // SAFETY: a number alone.
        Error::check(unsafe { (self.functions.close)(handle.0) }).map(|_| ())
    }

    /// Joins the bus.
    pub fn bus_on(&self, handle: Handle) -> Result<(), Error> {
        // SAFETY: a number alone.
        Error::check(unsafe { (self.functions.bus_on)(handle.0) }).map(|_| ())
    }

    /// Leaves the bus; what was received can still be read.
    pub fn bus_off(&self, handle: Handle) -> Result<(), Error> {
        // SAFETY: a number alone.
        Error::check(unsafe { (self.functions.bus_off)(handle.0) }).map(|_| ())
    }

    /// Sets the bit rate in bit/s, sampled once.
    pub fn set_bit_rate(&self, handle: Handle, bitrate_bps: u32, bit: Segments) -> Result<(), Error> {
        let Segments { first, second, jump_width } = bit;
        let bitrate = rate(bitrate_bps);
        // SAFETY: numbers alone.
        let status =
            unsafe { (self.functions.set_bus_params)(handle.0, bitrate, first, second, jump_width, 1, 0) };
        Error::check(status).map(|_| ())
    }

    /// The same for data phases of CAN FD frames.
    pub fn set_data_bit_rate(&self, handle: Handle, bitrate_bps: u32, bit: Segments) -> Result<(), Error> {
        let Segments { first, second, jump_width } = bit;
        let bitrate = rate(bitrate_bps);
        // SAFETY: numbers alone.
        let status =
            unsafe { (self.functions.set_bus_params_fd)(handle.0, bitrate, first, second, jump_width) };
        Error::check(status).map(|_| ())
    }

    /// Sets whether the bus is driven: see [`output`].
    pub fn set_output_control(&self, handle: Handle, output: u32) -> Result<(), Error> {
        // SAFETY: numbers alone.
        Error::check(unsafe { (self.functions.set_bus_output_control)(handle.0, output) }).map(|_| ())
    }

    /// Whether the bus is driven.
    pub fn output_control(&self, handle: Handle) -> Result<u32, Error> {
        let mut output = 0;
        // SAFETY: the number lives until the call returns.
        Error::check(unsafe { (self.functions.get_bus_output_control)(handle.0, &raw mut output) })?;
        Ok(output)
    }

    /// Sets a property that is a number: see [`control`].
    pub fn control(&self, handle: Handle, function: u32, mut value: u32) -> Result<(), Error> {
        // SAFETY: four bytes, as the last argument says.
        let status = unsafe { (self.functions.io_control)(handle.0, function, (&raw mut value).cast(), 4) };
        Error::check(status).map(|_| ())
    }

    /// The next message, or [`Error::NO_MESSAGE`].
    pub fn read(&self, handle: Handle) -> Result<KvaserMessage, Error> {
        let (mut id, mut len, mut flags, mut time) = (0, 0, 0, 0);
        let mut data = [0u8; 64];
        // SAFETY: the library writes as many bytes of data as a frame has, 64 at most, and a number into each of the others.
        let status = unsafe {
            (self.functions.read)(
                handle.0,
                &raw mut id,
                data.as_mut_ptr().cast(),
                &raw mut len,
                &raw mut flags,
                &raw mut time,
            )
        };
        Error::check(status)?;
        #[allow(clippy::useless_conversion, reason = "of 32 bits on Windows")]
        Ok(KvaserMessage { id: i64::from(id), flags, len, data, stamp_us: time as u32 })
    }

    /// Puts a frame into the transmit buffer.
    pub fn write(&self, handle: Handle, message: &KvaserMessage) -> Result<(), Error> {
        let mut data = message.data;
        let id = c_long::try_from(message.id).unwrap_or(c_long::MAX);
        // SAFETY: the library reads as many bytes of data as the length says, which is 64 at most.
        let status = unsafe {
            (self.functions.write)(handle.0, id, data.as_mut_ptr().cast(), message.len.min(64), message.flags)
        };
        Error::check(status).map(|_| ())
    }

    /// The state of a channel: see [`status`].
    pub fn status(&self, handle: Handle) -> Result<u32, Error> {
        // The device sends it some time after it was asked for: what is read is the answer to an earlier question.
        // SAFETY: a number alone.
        Error::check(unsafe { (self.functions.request_chip_status)(handle.0) })?;
        let mut flags = 0;
        // SAFETY: the number lives until the call returns.
        Error::check(unsafe { (self.functions.read_status)(handle.0, &raw mut flags) })?;
        Ok(flags as u32)
    }

    /// Transmit and receive error counter.
    pub fn error_counters(&self, handle: Handle) -> Result<(u32, u32), Error> {
        let (mut transmit, mut receive, mut overruns) = (0, 0, 0);
        // SAFETY: the numbers live until the call returns.
        Error::check(unsafe {
            (self.functions.read_error_counters)(
                handle.0,
                &raw mut transmit,
                &raw mut receive,
                &raw mut overruns,
            )
        })?;
        Ok((transmit, receive))
    }

    /// What the library says about an error.
    pub fn describe(&self, error: Error) -> String {
        let mut buffer = [0u8; TEXT];
        // SAFETY: as many bytes as the last argument says.
        let status = unsafe {
            (self.functions.get_error_text)(error.0, buffer.as_mut_ptr().cast(), buffer.len() as c_uint)
        };
        if status < 0 { error.to_string() } else { text(&buffer) }
    }
}
