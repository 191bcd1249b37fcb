//! The analyser's logic, free of hardware: it runs on the board, in tests on the host, and in the
//! virtual device.
//!
//! A received frame's way: an interrupt stamps it, [`bus::capture`] takes it out of the controller's FIFO, [`bus::recorder`] writes it
//! with its time and what was lost before it, [`bus::queue`] holds it, [`port::sender`] packs it into batches for USB.
//! A request's way: [`port::inbox`] finds it in what the host sends, [`port::session`] decides whether it may be done,
//! [`port::command`] does it, [`bus::transmit`] puts frames on the bus. What the hardware must provide is in [`ports`], and all of
//! it together, as commands see it, in [`port::board`].
#![cfg_attr(not(test), no_std)]

pub mod bus;
pub mod failures;
pub mod lights;
pub mod port;
pub mod ports;
pub mod saved;

/// Rate of the stamp timer and of every time on the wire: 12 ticks per microsecond.
pub const TICK_HZ: u32 = 12_000_000;
/// Ticks per microsecond.
pub const TICKS_PER_US: u32 = TICK_HZ / 1_000_000;
/// Ticks per millisecond.
pub const TICKS_PER_MS: u32 = TICK_HZ / 1_000;

/// Clock of the CAN controllers, in Hz: APB1 at SYSCLK 144 MHz / 4. It divides to every bit rate that CiA
/// lists, 800 kbit/s included, which the 42 MHz of a chip at full speed do not.
pub const CAN_CLOCK_HZ: u32 = 36_000_000;

/// Size of the record queue in bytes. A standard frame without data takes 5 bytes and 48 µs at
/// 1 Mbit/s at least, so this holds 98 304 / 5 × 48 µs = 0.94 s of one saturated channel.
pub const QUEUE_BYTES: usize = 96 * 1024;
