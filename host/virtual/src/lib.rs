#![doc = include_str!("../README.md")]
//!
//! It proves the logic and the host, in real time or as fast as possible. It does not prove interrupts,
//! registers or USB: every interrupt is served immediately, so stamps are exact and the controllers' FIFOs
//! never overrun. USB is a pipe that carries no more than the bus would.
//!
//! Model time never depends on when the operating system runs the thread: bus, firmware and USB advance
//! together, in steps that follow the wall clock. A delayed thread catches up, and also gives the host the
//! time to read that it missed.

#![forbid(unsafe_code)]

#[cfg(test)]
mod any_commands;
mod board;
#[cfg(feature = "nodes")]
pub mod canopen;
#[cfg(feature = "nodes")]
pub mod car;
mod check;
mod controller;
#[cfg(feature = "nodes")]
pub mod ecu;
mod edges;
mod flash;
#[cfg(feature = "nodes")]
mod log;
#[cfg(not(feature = "nodes"))]
#[path = "no_log.rs"]
mod log;
mod machine;
#[cfg(feature = "nodes")]
mod nodes;
#[cfg(not(feature = "nodes"))]
#[path = "no_nodes.rs"]
mod nodes;
mod options;
#[cfg(unix)]
mod pty;
mod runner;
pub mod simbus;

pub use check::SequenceCheck;
pub use machine::{BusActivity, Witness};
pub use options::{BadOption, Options, Pace};
#[cfg(unix)]
pub use pty::{Terminal, TerminalError, open_terminal};
pub use runner::{Connection, VirtualDevice, open, start};
