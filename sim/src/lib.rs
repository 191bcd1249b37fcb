#![doc = include_str!("../README.md")]
//!
//! [`rig`] is a board with a capture host, which keeps books on every frame ([`capture`]); [`run`] is a whole run of it. [`drive`] and
//! [`stream`] send, [`address`] reads the addresses that the command understands, [`usbip`] serves the board to a Linux kernel.
//!
//! The board itself is `cantap-emu`'s and knows nothing about this product; [`board`] has what it must know about our boards. Nothing
//! here uses the firmware's library: this is an independent witness that sees only the ELF, and shares only the wire protocol's types
//! with it. Time is core cycles everywhere ([`CYCLES_PER_SECOND`]).

#![forbid(unsafe_code)]

pub mod address;
pub mod board;
pub mod capture;
pub mod drive;
pub mod firmware;
pub mod hostile;
pub mod link;
pub mod locks;
#[cfg(unix)]
pub mod pty;
pub mod rig;
pub mod run;
pub mod soak;
pub mod stream;
pub mod usbip;

/// Core cycles per emulated second.
pub const CYCLES_PER_SECOND: u64 = board::CLOCK.hz();
/// Core cycles per emulated microsecond.
pub const CYCLES_PER_US: u64 = board::CLOCK.us(1);
