#![doc = include_str!("../README.md")]
//!
//! A [`TraceRecord`] is one entry of a trace. [`filter`] selects among them, [`playback`] hands them out at their original times, [`diff`] compares
//! two traces, [`bits`] computes how long a frame is on the bus, [`levels`] what it looks like there, [`formula`] reads what
//! conversions compute, and [`socketcan`] represents events as Linux does.

#![forbid(unsafe_code)]

pub mod clean;
mod counted;
mod device_time;
pub mod diff;
pub mod event_text;
mod fd_bits;
pub mod filter;
pub mod formula;
mod frame;
pub mod grammar;
mod id_filter;
mod interface;
mod length;
pub mod levels;
mod lin;
pub mod packed;
mod plain;
pub mod playback;
mod record;
mod seconds;
pub mod socketcan;
#[cfg(any(test, feature = "proptest"))]
pub mod testing;

pub use cantap_can::{
    BusErrorKind, Channel, ErrorState, Frame, FrameBits, Id, LossStage, TransmitFailure, bits, bits_on_bus,
    fd,
};
pub use counted::counted;
pub use device_time::{DeviceNs, Interval, Moment};
pub use fd::FdFrame;
pub use fd_bits::FdBits;
pub use frame::{ParseTraceFrameError, TraceFrame};
pub use interface::{CHANNEL_0, Interface};
pub use length::BusBits;
pub use lin::{LinFault, LinFrame};
pub use plain::PlainFrame;
pub use record::{Direction, TraceEvent, TraceRecord};
pub use seconds::Seconds;
