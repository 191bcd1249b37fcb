//! The chip around the core: its peripherals, interrupt lines, and the two CAN buses connected to it. `access.rs` says how the
//! core reaches them; an access to a register that no model knows is noted, never silently swallowed.

pub mod access;
mod board;
pub mod bootloader;
pub mod exti;
pub mod flash;
mod odd;
pub mod rcc;
pub mod small;
pub mod timer;
mod transmit_pins;

pub use board::{Board, CAN_IRQS, RECEIVE_PINS};
pub use odd::{OddAccess, Oddity};
