//! What is needed of the system: by the driver, and to set an interface up.

use std::io;
use std::time::Duration;

use super::link::Link;
use crate::raw_can::{Message, RawFdFrame, RawFrame};

/// The system's side: another one in tests, where there are no CAN interfaces.
pub(super) trait Interface: Send {
    /// What the kernel says about the interface.
    fn look(&mut self) -> io::Result<Link>;
    /// Opens a socket on it.
    fn open(&mut self) -> io::Result<()>;
    fn close(&mut self);
    /// Waits until something has arrived.
    fn wait(&mut self, wait: Duration);
    /// Adds what has arrived, without waiting.
    fn receive(&mut self, messages: &mut Vec<Message>) -> io::Result<()>;
    fn send(&mut self, frame: &RawFrame) -> io::Result<()>;
    fn send_fd(&mut self, frame: &RawFdFrame) -> io::Result<()>;
    /// How many messages the socket has dropped, if the kernel says so.
    fn dropped(&mut self) -> Option<u32>;
}

/// The kernel, where an interface is set up: another one in tests.
pub(super) trait Kernel {
    /// What it says about the interface.
    fn look(&mut self) -> io::Result<Link>;
    /// Asks for a change, and waits for the answer.
    fn change(&mut self, message: &[u8]) -> io::Result<()>;
    /// Through which of its protocols programs receive from the interface.
    fn receivers(&self) -> Vec<String>;
}
