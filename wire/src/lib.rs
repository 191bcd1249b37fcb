#![doc = include_str!("../README.md")]
//!
//! Everything here is defined only once: the firmware, the host library and the emulator all use it.

#![forbid(unsafe_code)]
#![cfg_attr(not(test), no_std)]

pub mod batch;
pub mod decoder;
pub mod framing;
pub mod image;
pub mod message;
mod packed;
mod packed_fd;
pub mod record;
mod varint;

pub use cantap_can::{BitTiming, CHANNELS, Channel, FdFrame, Frame, Id, frame, timing};
pub use decoder::{Corruption, Decoded, Decoder};
pub use message::{Command, Hello, Refusal, Reply, Request, Response};
pub use record::{Event, Received, ReceivedFd, Record, Stamp, TransmittedFd};

/// Version of everything this crate defines. A device and a host with different versions refuse
/// each other with a message that says which side to update.
pub const PROTOCOL_VERSION: u16 = 7;

/// Name of the ELF symbol that holds [`PROTOCOL_VERSION`] as a little-endian `u16` in the
/// firmware, so that a program that loads the ELF can refuse a mismatch before it runs it.
pub const PROTOCOL_SYMBOL: &str = "CANTAP_PROTOCOL_VERSION";

/// Name of the ELF symbol that says where each channel's RX is: two bytes per channel, the port (0 is A) and the pin, so that a program
/// that loads the ELF can connect the buses.
pub const RECEIVE_PINS_SYMBOL: &str = "CANTAP_RECEIVE_PINS";

/// USB vendor and product ID. These are pid.codes' test IDs, for use until a product ID is assigned;
/// they may not be shipped in a product.
pub const USB_VID: u16 = 0x1209;
/// See [`USB_VID`].
pub const USB_PID: u16 = 0x0001;
