//! The emulated board as a USB/IP server: a real kernel attaches it, so that this kernel's USB core, driver and terminal layer,
//! none of which this project wrote, drive the firmware.
//!
//! A kernel's requests (`protocol.rs`; by way of QEMU's own host controllers, `redir.rs`) become transactions on the emulated bus (`urbs.rs`) in the
//! board's own time (`board.rs`), which never runs ahead of the wall clock. Over a second socket a test that drives the kernel controls the buses and
//! the cable and reads the figures (`script.rs`).
//!
//! USB/IP does not carry everything: bus timing, retries after NAK, toggles, SET_ADDRESS, resets of the port and suspension are
//! handled on this side. See `docs/testing.md` for what that leaves untested.

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
