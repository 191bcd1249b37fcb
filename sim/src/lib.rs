//! The emulated board: an STM32F405 that runs the unmodified firmware ELF instruction by instruction,
//! with two CAN buses and a USB host attached.
//!
//! It depends on the wire protocol's types and never on the firmware's library: it is an independent
//! witness that sees only the ELF. Time is core cycles everywhere ([`CYCLES_PER_SECOND`]); nothing
//! here looks at the host's clock, so the same seed gives the same run, byte for byte. How long the core waits for
//! its memories is one of two bounds ([`timing`]).

#![forbid(unsafe_code)]

pub mod address;
pub mod bus;
pub mod can;
pub mod capture;
pub mod cpu;
pub mod drive;
pub mod elf;
pub mod link;
pub mod machine;
pub mod memory_map;
pub mod otg;
pub mod peripheral;
pub mod probe;
pub mod profile;
#[cfg(unix)]
pub mod pty;
pub mod rig;
pub mod run;
pub mod soc;
pub mod stop;
pub mod stream;
pub mod timing;
pub mod trace;
pub mod traffic;
pub mod usb;
pub mod usb_host;
pub mod usbip;

pub use elf::{ElfError, Image};
pub use machine::{Machine, Setup};
pub use peripheral::Peripheral;
pub use stop::{Reason, Stopped};

/// Core cycles per emulated second: the firmware's SYSCLK of 144 MHz. The few microseconds before the
/// firmware switches to its PLL are counted in the same unit.
pub const CYCLES_PER_SECOND: u64 = 144_000_000;
/// Core cycles per emulated microsecond.
pub const CYCLES_PER_US: u64 = CYCLES_PER_SECOND / 1_000_000;
