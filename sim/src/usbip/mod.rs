//! The emulated board as a USB/IP server: a real kernel attaches it, and that kernel's USB core, driver and terminal layer, which
//! nobody of this project wrote, drive the firmware.
//!
//! A kernel's requests (`protocol.rs`; by way of QEMU's own host controllers, `redir.rs`) become transactions on the emulated bus
//! (`urbs.rs`) in the board's own time (`board.rs`), which never runs ahead of the wall clock. A test that drives the kernel says over a second socket
//! what happens to the buses and the cable, and reads the figures (`script.rs`).
//!
//! USB/IP does not carry everything: bus timing, retries after NAK, toggles, SET_ADDRESS, resets of the port and suspension are
//! this side's. See `docs/testing.md` for what that leaves unseen.

mod board;
mod error;
mod exported;
mod protocol;
mod redir;
mod script;
mod server;
mod urb;
mod urbs;

pub use error::Error;
pub use server::serve;
