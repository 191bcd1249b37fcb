//! The state of a device and its channels.

use heapless::String;
use serde::{Deserialize, Serialize};

use super::ChannelConfig;
use crate::CHANNELS;
use crate::record::{BusErrorKind, ErrorState};

/// The state of the whole device. Counters run from `Hello` and wrap.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Device time, in ticks.
    pub ticks: u64,
    /// Bytes in the record queue.
    pub queue_bytes: u32,
    /// The most bytes in it at any time since `Hello`.
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
    /// Frames taken from the controller, including those that the queue lost.
    pub frames: u32,
    /// Times the controller's FIFO overran: at least this many frames were lost.
    pub lost_controller: u32,
    /// Frames lost because the queue was full.
    pub lost_queue: u32,
    /// Bus errors, including those not reported one by one.
    pub bus_errors: u32,
    /// Frames sent.
    pub transmitted: u32,
    /// Frames not sent, for whatever reason.
    pub transmit_failures: u32,
    /// Frames waiting in the transmit queue.
    pub tx_pending: u16,
}

/// Longest text of a failure, in bytes: a panic's place and a sentence.
pub const MAX_FAILURE_TEXT: usize = 200;

/// Failures of the firmware, each of which it started anew after: a panic, a fault, the watchdog, a clock that did not come up. And hardware that did not
/// do as its manual says, which the firmware lives with: recorded at most once a second.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failures {
    /// How many since power-on.
    pub count: u32,
    /// What the last one was, in words for a developer; empty if there was none.
    pub last: String<MAX_FAILURE_TEXT>,
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

/// To [`super::Command::Registers`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Registers {
    /// When the request was handled.
    pub now: RegisterSet,
    /// At the last error, if there was one since the channel was opened.
    pub at_last_error: Option<RegisterSet>,
}
