#![doc = include_str!("../README.md")]
//!
//! [`Device`] is where everything begins. It speaks through a [`device::Link`], a byte stream that a serial port makes, or a
//! device without a board. [`transmit`] sends many frames and accounts for each, [`replay`] sends them at a trace's own times,
//! [`periodic`] checks what the device is to repeat, [`hw_filter`] has it drop what is not wanted, [`autobaud`] finds a bus's
//! bit rate by listening, [`recovery`] brings it back from bus-off, and [`unsent`] says why something was not sent.

#![forbid(unsafe_code)]

pub mod autobaud;
pub mod bit_timing;
pub mod device;
pub mod hw_filter;
pub mod periodic;
pub mod recovery;
pub mod replay;
pub mod transmit;
pub mod unsent;

pub use cantap_trace::{
    Channel, Direction, FdBits, FdFrame, Frame, FrameBits, Id, TraceEvent, TraceFrame, TraceRecord,
    bits_on_bus,
};
pub use cantap_wire as wire;
pub use device::{Device, DeviceError};
