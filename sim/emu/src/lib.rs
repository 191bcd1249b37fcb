#![doc = include_str!("../README.md")]
//!
//! It knows nothing about what the program is for. What it must know is in [`Setup`]: the core's clock, the board's crystal, the
//! interrupts whose masking is to be measured. Time is core cycles everywhere ([`Clock`]); nothing here looks at the host's clock,
//! so the same inputs give the same run, byte for byte. How long the core waits for its memories is one of two bounds ([`timing`]).

#![forbid(unsafe_code)]

pub mod bus;
pub mod can;
mod clock;
pub mod cpu;
pub mod elf;
pub mod hostile;
pub mod machine;
pub mod memory_map;
pub mod otg;
pub mod peripheral;
pub mod probe;
pub mod profile;
pub mod recording;
pub mod rom;
pub mod soc;
pub mod stop;
pub mod timing;
pub mod trace;
pub mod traffic;
pub mod usb;
pub mod usb_host;

pub use clock::Clock;
pub use elf::{ElfError, Image};
pub use hostile::Hostile;
pub use machine::{Machine, Setup};
pub use peripheral::Peripheral;
pub use stop::{Reason, Stopped};
