//! Raw CAN sockets of Linux: what crosses them, and, on Linux itself, the socket with what it says about each message.

mod frame;
#[cfg(target_os = "linux")]
mod socket;

pub use frame::{RawFdFrame, RawFrame, fd_frame_of, frame_of, raw_error, raw_fd_frame, raw_frame};
#[cfg(target_os = "linux")]
pub use socket::{BATCH, Message, Options, RawSocket};
