#![doc = include_str!("../README.md")]
//!
//! # Why the firmware runs here
//!
//! An adapter stands behind a [`Link`](cantap::device::Link) as a board does, and speaks the native protocol. Two ways lead there: a device side written
//! anew, or the firmware's own library with the adapter in place of its controllers. The second was chosen. Sessions, periodic frames with their
//! modifiers, replies, send queues, filters, the accounting of losses and the order of closing a channel are the firmware's, tested there;
//! written again they would be a second copy of some three thousand lines. The firmware had to learn only two things: to take a frame with a
//! stamp that is not its own, and to describe hardware that is not its own (`bus/capture/foreign.rs`, `port/board.rs`).
//!
//! A driver turns an adapter's bytes into events; the engine is the thread in which firmware and driver run.
//! What each kind of adapter can tell is a [`Row`], found by the board's name that it answers to `Hello`.

#![forbid(unsafe_code)]

mod adapter_clock;
mod bit_limits;
mod board;
mod can_fd;
mod canalyst_ii;
mod cannelloni;
mod cannelloni_tcp;
mod driver;
mod elm327;
mod engine;
mod error_frames;
mod fd_advice;
mod gs_usb;
mod gvret;
mod in_order;
mod interface_name;
mod kvaser;
mod library_channel;
mod line;
mod loss_rows;
mod mailboxes;
mod maker_channels;
mod maker_options;
mod pcan;
mod place;
pub mod raw_can;
mod rows;
mod slcan;
#[cfg(target_os = "linux")]
mod socketcan;
mod socketcand;
mod source;
#[cfg(test)]
mod testing;
mod text_lines;
mod trace_pipe;
mod under_way;
mod usb_can_a;
mod usb_device;

pub use can_fd::{CanFd, can_fd};
pub use driver::OpenError;
pub use fd_advice::fd_advice;
pub use maker_channels::{Maker, MakerChannel, MakerChannels, MakerError, maker_channels};
pub use place::{BadPlace, Place, can_interfaces, open};
pub use rows::{Confirmation, ListenOnly, Losses, ROWS, Row, Stamps, row};
#[cfg(target_os = "linux")]
pub use socketcan::{
    CanInterface, InterfaceError, InterfaceSettings, can_interface, restart_can_interface, set_can_interface,
    take_down_can_interface,
};
