//! Requests, responses and the values they carry. Everything is postcard's ordinary encoding of
//! these types. The order of enum variants and struct fields is the wire format.

use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

use crate::batch::BatchHeader;
use crate::frame::{Packed, take_packed};
use crate::record::{BusErrorKind, ErrorState};
use crate::varint::{take_u32, take_u64};
use crate::{BitTiming, CHANNELS, Channel, Frame, Id};

/// Most filters that one channel takes; the hardware's banks may be exhausted earlier.
pub const MAX_FILTERS: usize = 56;
/// Most frames in one [`Command::Send`].
pub const MAX_SEND: usize = 20;
/// Most modifiers of one periodic frame.
pub const MAX_MODIFIERS: usize = 4;
/// Tags from here up name frames that the device sends by itself: a periodic entry's slot, or
/// [`TRIGGER_TAG`] plus a trigger's slot.
pub const DEVICE_TAG: u32 = 0xFFFF_0000;
/// See [`DEVICE_TAG`].
pub const TRIGGER_TAG: u32 = 0xFFFF_8000;

/// Host → device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// Comes back in the response.
    pub id: u16,
    /// What to do.
    pub command: Command,
}

/// Device → host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum DeviceMessage {
    /// Records follow behind the header.
    Batch(BatchHeader),
    /// An answer.
    Response(Response),
}

/// The one answer that every request gets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Response {
    /// The request's.
    pub id: u16,
    /// A value or a reason. After a refusal nothing has changed.
    pub result: Result<Reply, Refusal>,
}

/// What a host may ask.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum Command {
    /// Starts a session: closes both channels, empties the queue, sets sequence numbers and counters
    /// to zero. Must be the first command. Its encoding never changes between versions.
    Hello {
        /// The host's protocol version.
        protocol: u16,
    },
    /// Opens a channel, with the configuration saved on the device if there is none here.
    Open {
        /// Which.
        channel: Channel,
        /// How.
        config: Option<ChannelConfig>,
    },
    /// Closes a channel; [`crate::Event::Stopped`] is the last record of it. Closing a closed channel succeeds.
    Close {
        /// Which.
        channel: Channel,
    },
    /// Asks for [`Status`].
    Status,
    /// Asks for the device's time.
    Time,
    /// Replaces all filters of a closed channel; none means that everything is received.
    SetFilters {
        /// Which.
        channel: Channel,
        /// A frame that matches any of them is received.
        filters: Vec<Filter, MAX_FILTERS>,
    },
    /// Queues frames for transmission, all or none.
    Send {
        /// Where.
        channel: Channel,
        /// In this order.
        frames: Vec<TxFrame, MAX_SEND>,
    },
    /// Drops everything queued for transmission, with a [`crate::Event::TransmitFailed`] for each frame.
    Abort {
        /// Which.
        channel: Channel,
    },
    /// Sets or clears a periodic transmission.
    SetPeriodic {
        /// Where.
        channel: Channel,
        /// Which entry, from 0.
        slot: u8,
        /// `None` clears it.
        entry: Option<Periodic>,
    },
    /// Sets or clears a reply that is sent when a matching frame is received.
    SetTrigger {
        /// Where.
        channel: Channel,
        /// Which entry, from 0.
        slot: u8,
        /// `None` clears it.
        entry: Option<Trigger>,
    },
    /// Asks for the controller's registers.
    Registers {
        /// Which.
        channel: Channel,
    },
    /// Leaves bus-off where recovery is manual.
    Recover {
        /// Which.
        channel: Channel,
    },
    /// Shows an LED pattern, to find the device among others.
    Identify {
        /// For so long.
        seconds: u8,
    },
    /// Restarts the firmware after the response is sent.
    Reset,
    /// Enters the chip's ROM bootloader (USB DFU) after the response is sent.
    Bootloader,
    /// Stores the configuration and filters that each channel has in this session, to be used by [`Command::Open`] without
    /// one. A channel that has no configuration yet keeps what is stored for it. Both channels must be closed.
    SaveDefaults,
    /// Erases what [`Command::SaveDefaults`] stored. Both channels must be closed.
    ClearDefaults,
    /// Gives a closed channel a configuration without opening it, for [`Command::SaveDefaults`].
    Configure {
        /// Which.
        channel: Channel,
        /// How [`Command::SaveDefaults`] says that it is to be opened.
        config: ChannelConfig,
    },
    /// Asks for what is stored for a channel. Nothing is opened, and nothing changes.
    Defaults {
        /// Which.
        channel: Channel,
    },
}

/// The index of [`Command::Send`], as the pinned bytes have it.
const SEND: u32 = 6;

/// Reads a request that is a [`Command::Send`] into `frames`, which is empty, and returns its id and channel. `None` if it is
/// another or cannot be read; what is in `frames` then means nothing.
///
/// It is what a streaming host sends thousands of times a second: as a [`Request`] it would be moved about with room for the
/// longest command.
pub fn read_send(request: &[u8], frames: &mut Vec<TxFrame, MAX_SEND>) -> Option<(u16, Channel)> {
    let ((id, command), rest) = postcard::take_from_bytes::<(u16, u32)>(request).ok()?;
    if command != SEND {
        return None;
    }
    let ((channel, count), mut rest) = postcard::take_from_bytes::<(Channel, usize)>(rest).ok()?;
    for _ in 0..count {
        let (tag, behind) = take_u32(rest)?;
        let (frame, behind) = take_packed(behind)?;
        let (at_ticks, behind) = match *behind {
            [0, ref behind @ ..] => (None, behind),
            [1, ref behind @ ..] => take_u64(behind).map(|(at, behind)| (Some(at), behind))?,
            _ => return None,
        };
        frames.push(TxFrame { tag, frame, at_ticks }).ok()?;
        rest = behind;
    }
    Some((id, channel))
}

/// Writes a [`DeviceMessage::Response`] to `out` and returns its length, `None` if there is no room. The answer stays where
/// it is: a [`Response`] that is moved about has room for the longest.
pub fn write_response(id: u16, result: &Result<Reply, Refusal>, out: &mut [u8]) -> Option<usize> {
    /// The variant's index, as the pinned bytes have it.
    const RESPONSE: u32 = 1;
    postcard::to_slice(&(RESPONSE, id, result), out).ok().map(|written| written.len())
}

/// Why a request, sealed as it was sent, cannot be read: [`Refusal::BadId`] or [`Refusal::BadDlc`] where it carries a frame
/// that cannot be, else [`Refusal::Malformed`].
pub fn why_unreadable(request: &[u8]) -> Refusal {
    // The indices of the other commands that carry frames, as the pinned bytes have them.
    const SET_PERIODIC: u32 = 8;
    const SET_TRIGGER: u32 = 9;
    type Head = (u16, u32, Channel);
    let fault = || {
        let ((_, command, _), rest) = postcard::take_from_bytes::<Head>(request).ok()?;
        match command {
            SEND => {
                type Frames = Vec<(u32, Packed, Option<u64>), MAX_SEND>;
                let (frames, _) = postcard::take_from_bytes::<Frames>(rest).ok()?;
                frames.iter().find_map(|(_, frame, _)| frame.frame().err())
            }
            SET_PERIODIC => postcard::take_from_bytes::<(u8, u8, Packed)>(rest).ok()?.0.2.frame().err(),
            SET_TRIGGER => {
                postcard::take_from_bytes::<(u8, u8, Filter, Packed)>(rest).ok()?.0.3.frame().err()
            }
            _ => None,
        }
    };
    fault().unwrap_or(Refusal::Malformed)
}

/// A value that answers a request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum Reply {
    /// To [`Command::Hello`].
    Hello(Hello),
    /// Done; there is nothing to say.
    Done,
    /// To [`Command::Open`]: what was applied.
    Opened(ChannelConfig),
    /// To [`Command::Status`].
    Status(Status),
    /// To [`Command::Time`]: ticks since the device started, read when the request was handled.
    Time(u64),
    /// To [`Command::SetFilters`]: hardware banks that the channel now uses.
    Filters {
        /// Banks of this channel in use.
        banks_used: u8,
        /// Banks that this channel could use.
        banks_total: u8,
    },
    /// To [`Command::Send`]: free places in the channel's transmit queue after it.
    Queued {
        /// Frames.
        free: u16,
    },
    /// To [`Command::Registers`].
    Registers(Registers),
    /// To [`Command::Defaults`].
    Defaults(Defaults),
}

/// What is stored for a channel over a power cycle.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Defaults {
    /// How it is opened.
    pub config: ChannelConfig,
    /// What it receives; none means everything.
    pub filters: Vec<Filter, MAX_FILTERS>,
}

/// Why a request was refused. Nothing has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Refusal {
    /// The device speaks another protocol version. This variant's encoding never changes.
    Protocol {
        /// The device's version.
        device: u16,
    },
    /// The request could not be read.
    Malformed,
    /// `Hello` must come first.
    NoSession,
    /// This device cannot do that.
    Unsupported,
    /// The bit timing is outside the controller's ranges, or the bit rate outside 5 kbit/s to 1 Mbit/s.
    BadTiming,
    /// An identifier or filter is out of range.
    BadId,
    /// A DLC is above 15, or the data are not as long as it says.
    BadDlc,
    /// A tag is in the device's own range.
    BadTag,
    /// A period of zero or more than the timer holds, or a modifier outside the frame.
    BadEntry,
    /// There is no such slot.
    BadSlot,
    /// The channel must be closed first.
    ChannelOpen,
    /// The channel must be open first.
    ChannelClosed,
    /// The channel's mode does not transmit.
    ListenOnly,
    /// The transmit queue has no room for all of the frames.
    QueueFull {
        /// Places that are free now.
        free: u16,
    },
    /// The filters need more banks than there are.
    BanksExhausted {
        /// Banks that they need.
        needed: u8,
        /// Banks that there are.
        available: u8,
    },
    /// It cannot be done without disturbing the other channel, which is open.
    WouldDisturb,
    /// The target time is too far ahead.
    TooFarAhead,
    /// The controller did not follow (is there a clock, a transceiver, a stuck bus?).
    Hardware,
    /// There is nothing saved on the device.
    NothingSaved,
    /// The controller is not bus-off.
    NotBusOff,
}

/// What a device is. The first field's encoding never changes between versions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Hello {
    /// The device's protocol version.
    pub protocol: u16,
    /// Firmware version, major.minor.patch.
    pub firmware: [u16; 3],
    /// Board name, such as `olimex-p405`.
    pub board: String<24>,
    /// The chip's unique ID in hexadecimal, or another serial number.
    pub serial: String<24>,
    /// Channels.
    pub channels: u8,
    /// Ticks per second of every time on the wire.
    pub tick_hz: u32,
    /// Clock of the CAN controllers, in Hz.
    pub can_clock_hz: u32,
    /// Size of the record queue, in bytes.
    pub queue_bytes: u32,
    /// Frames in a channel's transmit queue.
    pub tx_queue: u16,
    /// Periodic entries per channel.
    pub periodic_slots: u8,
    /// Trigger entries per channel.
    pub trigger_slots: u8,
    /// Filter banks, shared by the channels.
    pub filter_banks: u8,
    /// Capability bits: see [`capability`].
    pub capabilities: u32,
}

/// Bits of [`Hello::capabilities`].
pub mod capability {
    /// Can transmit.
    pub const TRANSMIT: u32 = 1 << 0;
    /// Sends at a target time.
    pub const TIMED_TRANSMIT: u32 = 1 << 1;
    /// Speaks slcan on the same port.
    pub const SLCAN: u32 = 1 << 2;
    /// Can save defaults.
    pub const DEFAULTS: u32 = 1 << 3;
    /// Can enter a bootloader.
    pub const BOOTLOADER: u32 = 1 << 4;
}

/// How a channel takes part in its bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Mode {
    /// Sends nothing at all, no acknowledge either.
    ListenOnly,
    /// Acknowledges, transmits.
    Normal,
    /// Sends and receives its own frames; hears nothing from the bus.
    Loopback,
    /// As [`Mode::Loopback`], but the bus sees nothing.
    SilentLoopback,
}

impl Mode {
    /// Whether frames can be sent in this mode.
    pub const fn transmits(self) -> bool {
        !matches!(self, Mode::ListenOnly)
    }
}

/// What [`Command::Open`] applies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ChannelConfig {
    /// Bit timing.
    pub timing: BitTiming,
    /// Mode.
    pub mode: Mode,
    /// No automatic retransmission.
    pub one_shot: bool,
    /// Leave bus-off only by [`Command::Recover`].
    pub manual_recovery: bool,
    /// Leave received frames' data bytes out of the stream.
    pub omit_data: bool,
    /// Leave received frames' stamps out of the stream.
    pub omit_stamps: bool,
}

impl ChannelConfig {
    /// Listen-only with this timing and nothing left out.
    pub const fn listen_only(timing: BitTiming) -> Self {
        Self {
            timing,
            mode: Mode::ListenOnly,
            one_shot: false,
            manual_recovery: false,
            omit_data: false,
            omit_stamps: false,
        }
    }
}

/// Which frames a filter lets through, beside the identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum FrameKind {
    /// Data frames.
    Data,
    /// Remote frames.
    Remote,
    /// Both.
    Any,
}

/// A frame passes if its identifier has the same length and agrees with `id` in every bit of `mask`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Filter {
    /// 29-bit identifiers rather than 11-bit ones.
    pub extended: bool,
    /// Data frames, remote frames or both.
    pub kind: FrameKind,
    /// Identifier.
    pub id: u32,
    /// Bits that count.
    pub mask: u32,
}

impl Filter {
    /// Whether identifier and mask have no more bits than identifiers of this length.
    pub const fn is_valid(&self) -> bool {
        let widest = if self.extended { Id::MAX_EXTENDED } else { Id::MAX_STANDARD };
        self.id <= widest && self.mask <= widest
    }

    /// Whether this filter lets `frame` pass.
    pub fn matches(&self, frame: &Frame) -> bool {
        let kind = match self.kind {
            FrameKind::Data => !frame.is_remote(),
            FrameKind::Remote => frame.is_remote(),
            FrameKind::Any => true,
        };
        kind && frame.id().is_extended() == self.extended && (frame.id().raw() ^ self.id) & self.mask == 0
    }
}

/// A frame to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct TxFrame {
    /// Comes back in [`crate::Event::Transmitted`] or [`crate::Event::TransmitFailed`]. Below [`DEVICE_TAG`].
    pub tag: u32,
    /// The frame.
    pub frame: Frame,
    /// Device time, in ticks, before which it is not sent. The queue keeps its order: a later frame
    /// waits for an earlier one.
    pub at_ticks: Option<u64>,
}

/// A frame that the device sends again and again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Periodic {
    /// The frame, before modifiers.
    pub frame: Frame,
    /// Ticks between two transmissions' due times. No drift: due times are multiples.
    pub period_ticks: u32,
    /// How many times; 0 means for ever.
    pub count: u32,
    /// Applied in this order before each transmission.
    pub modifiers: Vec<Modifier, MAX_MODIFIERS>,
}

/// Changes a periodic frame's data before each transmission.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Modifier {
    /// Counts up by one, in `bits` bits of byte `byte` from bit `low_bit` up, and wraps.
    Counter {
        /// Byte of the data, from 0.
        byte: u8,
        /// Lowest bit, 0 to 7.
        low_bit: u8,
        /// Width, 1 to 8 - `low_bit`.
        bits: u8,
    },
    /// A checksum over all other data bytes.
    Checksum {
        /// Byte of the data that holds it, from 0.
        byte: u8,
        /// How it is computed.
        algorithm: Checksum,
    },
    /// A new random value.
    Random {
        /// Byte of the data, from 0.
        byte: u8,
    },
}

/// A checksum over data bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Checksum {
    /// Exclusive or.
    Xor,
    /// Sum modulo 256.
    Sum,
    /// CRC-8 SAE-J1850: polynomial 0x1D, initial value and final exclusive-or 0xFF.
    Crc8J1850,
}

/// A frame that is sent when a matching one is received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Trigger {
    /// What starts it.
    pub filter: Filter,
    /// What is sent.
    pub reply: Frame,
    /// How many times; 0 means for ever.
    pub count: u32,
}

/// The state of the whole device. Counters run from `Hello` and wrap.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Device time, in ticks.
    pub ticks: u64,
    /// Bytes in the record queue.
    pub queue_bytes: u32,
    /// Most bytes that were ever in it since `Hello`.
    pub queue_high_water_bytes: u32,
    /// Requests that could not be read.
    pub bad_requests: u32,
    /// Temperature of the chip in 0.1 °C, where it can be measured.
    pub temperature_decicelsius: Option<i16>,
    /// Supply voltage of the chip in mV, where it can be measured.
    pub supply_millivolts: Option<u16>,
    /// Each channel.
    pub channels: [ChannelStatus; CHANNELS],
}

/// The state of one channel. Counters run from `Hello` and wrap.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelStatus {
    /// The configuration, if it is open.
    pub open: Option<ChannelConfig>,
    /// Fault confinement.
    pub state: ErrorState,
    /// Transmit error counter.
    pub tec: u8,
    /// Receive error counter.
    pub rec: u8,
    /// The last error.
    pub last_error: Option<BusErrorKind>,
    /// Frames taken from the controller, those that the queue lost included.
    pub frames: u32,
    /// Times the controller's FIFO overran: at least so many frames were lost.
    pub lost_controller: u32,
    /// Frames lost because the queue was full.
    pub lost_queue: u32,
    /// Bus errors, those not reported one by one included.
    pub bus_errors: u32,
    /// Frames sent.
    pub transmitted: u32,
    /// Frames not sent, for whatever reason.
    pub transmit_failures: u32,
    /// Frames waiting in the transmit queue.
    pub tx_pending: u16,
}

/// A controller's registers (RM0090, "bxCAN registers").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct RegisterSet {
    /// Master control.
    pub mcr: u32,
    /// Master status.
    pub msr: u32,
    /// Transmit status.
    pub tsr: u32,
    /// Receive FIFO 0.
    pub rf0r: u32,
    /// Interrupt enable.
    pub ier: u32,
    /// Error status.
    pub esr: u32,
    /// Bit timing.
    pub btr: u32,
}

/// To [`Command::Registers`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Registers {
    /// When the request was handled.
    pub now: RegisterSet,
    /// At the last error, if there was one since the channel was opened.
    pub at_last_error: Option<RegisterSet>,
}
