#![doc = include_str!("../README.md")]
//!
//! [`Device`] is the starting point. It talks through a [`device::Link`], a byte stream made by a serial port or by a device
//! without a board. [`transmit`] sends many frames and accounts for each, [`replay`] sends them with a trace's own timing,
//! [`periodic`] checks what the device is asked to repeat, [`hw_filter`] has it drop unwanted frames, [`autobaud`] finds a
//! bus's bit rate by listening, [`recovery`] brings a channel back from bus-off, and [`unsent`] says why something was not
//! sent. [`listener`] is a session for programs without threads. [`session`] is what [`Device`] and the
//! server of a shared board have in common, and [`responder`] is the other side: for programs that answer as a device does.

#![forbid(unsafe_code)]

pub mod autobaud;
pub mod bit_timing;
pub mod device;
pub mod hw_filter;
pub mod listener;
pub mod periodic;
pub mod recovery;
pub mod replay;
pub mod responder;
pub mod session;
pub mod transmit;
pub mod unsent;

pub use cantap_trace::{
    Channel, DeviceNs, Direction, FdBits, FdFrame, Frame, FrameBits, Id, TraceEvent, TraceFrame, TraceRecord,
    bits_on_bus,
};
pub use cantap_wire as wire;
pub use device::{Device, DeviceError};
