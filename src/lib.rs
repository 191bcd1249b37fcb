//! The analyser's logic, free of hardware: it runs on the board, in tests on the host, and in the
//! virtual device.
//!
//! The path of a received frame: an interrupt stamps it, [`bus::capture`] takes it out of the controller's FIFO, [`bus::recorder`]
//! writes it with its time, after a record of any loss before it, [`bus::queue`] holds it, [`port::sender`] packs it into batches for
//! USB. The path of a request: [`port::inbox`] finds it in what the host sends, [`port::session`] decides whether it is allowed,
//! [`port::command`] carries it out, [`bus::transmit`] puts frames on the bus. [`ports`] has what the hardware must provide, and
//! [`port::board`] all of it together, as commands see it.
#![cfg_attr(not(test), no_std)]

pub mod bus;
pub mod failures;
pub mod lights;
pub mod oddities;
pub mod port;
pub mod ports;
pub mod revision;
pub mod saved;

/// Rate of the stamp timer and of every time on the wire: 12 ticks per microsecond.
pub const TICK_HZ: u32 = 12_000_000;
/// Ticks per microsecond.
pub const TICKS_PER_US: u32 = TICK_HZ / 1_000_000;
/// Ticks per millisecond.
pub const TICKS_PER_MS: u32 = TICK_HZ / 1_000;

/// Clock of the CAN controllers, in Hz: APB1 at SYSCLK 144 MHz / 4. It divides into every bit rate that
/// CiA lists, including 800 kbit/s, which the 42 MHz of a chip at full speed does not.
pub const CAN_CLOCK_HZ: u32 = 36_000_000;

/// Size of the record queue in bytes. A standard frame without data takes 5 bytes and, at 1 Mbit/s,
/// at least 48 µs, so this holds 98 304 / 5 × 48 µs = 0.94 s of one saturated channel.
pub const QUEUE_BYTES: usize = 96 * 1024;
