//! Requests, responses and the values they carry. Everything is postcard's ordinary encoding of
//! these types. The order of enum variants and struct fields is the wire format.

use heapless::{String, Vec};
use serde::{Deserialize, Serialize};

use crate::{CHANNELS, Channel};

mod bytes;
mod channel;
#[cfg(any(feature = "disturb", not(target_os = "none")))]
mod disturbance;
mod edges;
mod gateway;
mod sharing;
mod status;
mod transmission;

pub use bytes::{read_send, why_unreadable, write_response};
pub use channel::{ChannelConfig, Filter, FrameKind, Mode};
#[cfg(any(feature = "disturb", not(target_os = "none")))]
pub use disturbance::{
    DISTURBANCE_LEAD_TICKS, DISTURBANCE_PAUSE_TICKS, DISTURBANCE_WORD, MAX_DISTURBANCE_BITS,
};
pub use edges::{Edge, Edges, MAX_EDGES};
pub use gateway::{
    GATEWAY_TAG, GatewayEnd, GatewayRule, GatewayState, GatewayStatus, MAX_GATEWAY_RULES, MAX_RULE_COUNTS,
    MAX_RULE_MODIFIERS, Pass, RuleCounts,
};
pub use sharing::Role;
pub use status::{ChannelStatus, Failures, MAX_FAILURE_TEXT, RegisterSet, Registers, Status};
pub use transmission::{
    Checksum, DEVICE_TAG, MAX_MODIFIERS, Modifier, OTHERS_TAG, Periodic, TRIGGER_TAG, Trigger, TxFdFrame,
    TxFrame,
};

/// Most filters that one channel takes; the hardware's banks may be exhausted earlier.
pub const MAX_FILTERS: usize = 56;
/// Most frames in one [`Command::Send`].
pub const MAX_SEND: usize = 20;
/// Most frames in one [`Command::SendFd`].
pub const MAX_SEND_FD: usize = 8;

/// Host → device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Request {
    /// Returned in the response.
    pub id: u16,
    /// What to do.
    pub command: Command,
}

/// Precedes a batch's records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BatchHeader {
    /// Counts batches from 0 at `Hello`; wraps.
    pub sequence: u32,
    /// Absolute device time, in ticks, to which the first record's time difference is added.
    pub base_ticks: u64,
    /// Received-frame records in all batches before this one since `Hello`, per channel; wraps.
    /// From this the host knows how many frames were lost with a batch.
    pub frames_before: [u32; CHANNELS],
}

/// Device → host.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum DeviceMessage {
    /// Records follow the header.
    Batch(BatchHeader),
    /// An answer.
    Response(Response),
    /// The device has ended the session.
    Ended(SessionEnd),
}

/// Sent after everything else of a session that the device has ended on its own. From then on every request except
/// `Hello` is refused with [`Refusal::NoSession`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SessionEnd {
    /// Why.
    pub reason: EndReason,
    /// The header that the next batch would have had; its base is the time at which both channels were off their buses. A host
    /// that has decoded less knows exactly how much it has lost.
    pub header: BatchHeader,
}

/// Why a device ended a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum EndReason {
    /// The host suspended the bus, and woke it again without having closed the port.
    Suspended,
    /// Never from a device: the server of a shared board has lost it.
    BoardLost,
    /// Never from a device: the server of a shared board has ended.
    ServerEnded,
    /// The host reconfigured the device (USB 2.0, 9.4.7) without having closed the port. Sent only if a program that does not know
    /// this makes a request: a program that opens the port in the meantime is a new one.
    Configured,
}

/// The one answer that every request gets.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Response {
    /// The request's.
    pub id: u16,
    /// A value or a reason. After a refusal nothing has changed.
    pub result: Result<Reply, Refusal>,
}

/// What a host may request.
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
    /// Requests [`Status`].
    Status,
    /// Requests the device's time.
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
    /// Requests the controller's registers.
    Registers {
        /// Which.
        channel: Channel,
    },
    /// Leaves bus-off if recovery is manual.
    Recover {
        /// Which.
        channel: Channel,
    },
    /// Shows an LED pattern, to find the device among others.
    Identify {
        /// For this long.
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
        /// The configuration that [`Command::SaveDefaults`] stores.
        config: ChannelConfig,
    },
    /// Requests what is stored for a channel. Nothing is opened, and nothing changes.
    Defaults {
        /// Which.
        channel: Channel,
    },
    /// Requests [`Failures`]. They stay until the device loses power.
    Failures,
    /// Watches the receive pin of a closed channel from now on, in place of any watched before; its controller stays off the bus.
    /// Earlier measurements are discarded. It ends when the channel is opened, and with the session.
    MeasureEdges {
        /// Which; `None` ends it.
        channel: Option<Channel>,
    },
    /// Requests the [`Edges`] measured since the last answer.
    Edges,
    /// Sets a rule of the gateway. It must not be running. A session begins without rules.
    SetGatewayRule {
        /// The channel that receives the frames; the other sends them.
        from: Channel,
        /// Which rule, from 0: at most the number of those set already.
        slot: u8,
        /// `None` removes this rule and all after it.
        rule: Option<GatewayRule>,
    },
    /// Passes frames on between the channels, both of which must be open in normal mode. Counts begin at zero.
    StartGateway,
    /// Ends that. What waits to be sent is dropped and counted. Stopping a gateway that does not run succeeds.
    StopGateway,
    /// Requests a [`GatewayStatus`].
    GatewayStatus {
        /// The channel that receives the frames.
        from: Channel,
        /// The slot of the first rule whose counts are wanted.
        first: u8,
    },
    /// Requests a rule of the gateway.
    GatewayRule {
        /// The channel that receives the frames.
        from: Channel,
        /// Which rule, from 0.
        slot: u8,
    },
    /// As [`Command::SaveDefaults`], and stores this session's rules with it. From its next start on, the device opens both channels and
    /// runs the gateway on its own, whether there is a host or not, until the session that [`Command::StopGateway`] is sent in, or
    /// [`Command::ClearDefaults`]. Both channels must be closed, and configured for normal mode.
    SaveGateway,
    /// Queues CAN FD frames for transmission, all or none, in one queue with those of [`Command::Send`]. A board of ours, whose controllers are
    /// classical, refuses it: see [`capability::FD_TRANSMIT`].
    SendFd {
        /// Where.
        channel: Channel,
        /// In this order.
        frames: Vec<TxFdFrame, MAX_SEND_FD>,
    },
    /// Permits [`Command::Disturb`] until the session ends: see [`capability::DISTURB`].
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    UnlockDisturbance {
        /// [`DISTURBANCE_WORD`].
        word: u32,
    },
    /// Drives the bus dominant for a while, so that an error frame arises. The channel must be open in normal mode. There is one
    /// disturbance at a time, and at most one in [`DISTURBANCE_PAUSE_TICKS`]; each is recorded as [`crate::Event::Disturbed`].
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    Disturb {
        /// Where.
        channel: Channel,
        /// Device time at which the level begins: at least [`DISTURBANCE_LEAD_TICKS`] ahead.
        at_ticks: u64,
        /// For how many bits of the channel's bit rate: 1 to [`MAX_DISTURBANCE_BITS`].
        bits: u8,
    },
}

/// A value that answers a request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "no allocation on the device")]
pub enum Reply {
    /// To [`Command::Hello`].
    Hello(Hello),
    /// Done; there is no value.
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
    /// To [`Command::Send`] and [`Command::SendFd`]: free places left in the channel's transmit queue.
    Queued {
        /// Frames.
        free: u16,
    },
    /// To [`Command::Registers`].
    Registers(Registers),
    /// To [`Command::Defaults`].
    Defaults(Defaults),
    /// To [`Command::Failures`].
    Failures(Failures),
    /// To [`Command::Edges`].
    Edges(Edges),
    /// To [`Command::GatewayStatus`].
    Gateway(GatewayStatus),
    /// To [`Command::GatewayRule`].
    GatewayRule(GatewayRule),
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
    /// A DLC is above 15, or the data is not as long as it says.
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
        /// Banks available.
        available: u8,
    },
    /// It cannot be done without disturbing the other channel, which is open.
    WouldDisturb,
    /// The target time is too far ahead.
    TooFarAhead,
    /// The controller did not respond (is there a clock, a transceiver, a stuck bus?).
    Hardware,
    /// There is nothing saved on the device.
    NothingSaved,
    /// The controller is not bus-off.
    NotBusOff,
    /// No receive pin is watched.
    NotMeasuring,
    /// Never from a device: the server of a shared board does not let this client do that.
    NotGranted {
        /// The role that it would have to be granted.
        needs: Role,
    },
    /// Never from a device: another client of the server holds the right to configure.
    Held,
    /// Never from a device: other clients of the server have the channel open with another bit timing or mode.
    OtherSettings,
    /// Never from a device: the server has no board at the moment.
    NoBoard,
    /// A gateway needs both channels in [`Mode::Normal`], and a disturbance needs its own.
    NotNormal,
    /// The gateway must be stopped first.
    GatewayRunning,
    /// [`Command::UnlockDisturbance`], with its word, must come first.
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    DisturbanceLocked,
    /// A disturbance is already planned, or the last one was too short a time before.
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    TooOften,
    /// The target time has passed, or is too near.
    #[cfg(any(feature = "disturb", not(target_os = "none")))]
    TooLate,
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

impl Hello {
    /// Whether it transmits CAN FD frames, too.
    pub const fn sends_fd(&self) -> bool {
        self.capabilities & capability::FD_TRANSMIT != 0
    }

    /// Whether it disturbs a bus on purpose.
    pub const fn disturbs(&self) -> bool {
        self.capabilities & capability::DISTURB != 0
    }

    /// Whether every loss is counted by somebody, if only as "at least one".
    pub const fn counts_losses(&self) -> bool {
        self.capabilities & capability::UNCOUNTED_LOSSES == 0
    }
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
    /// Measures edges of its receive pins.
    pub const EDGES: u32 = 1 << 5;
    /// Never of a board of ours: another maker's adapter, whose kind is the board's name. What it cannot know is not told.
    pub const ADAPTER: u32 = 1 << 6;
    /// Never of a board of ours: cannot listen without acknowledging frames.
    pub const ALWAYS_ACKNOWLEDGES: u32 = 1 << 7;
    /// Never of a board of ours: there is no bus behind it whose bit rate is known, so frames' lengths say nothing about their times.
    pub const NO_BIT_RATE: u32 = 1 << 8;
    /// Never of a board of ours: frames may be missing that nobody counted, so that no sum of losses is the whole.
    pub const UNCOUNTED_LOSSES: u32 = 1 << 9;
    /// Can be a gateway between its channels.
    pub const GATEWAY: u32 = 1 << 10;
    /// Never of a board of ours: can transmit CAN FD frames.
    pub const FD_TRANSMIT: u32 = 1 << 11;
    /// Disturbs a bus on purpose, on those channels whose TX pin has a timer. Never of a released build.
    pub const DISTURB: u32 = 1 << 12;
}
