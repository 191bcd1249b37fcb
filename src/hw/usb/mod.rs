//! The USB virtual COM port: OTG_FS as a full-speed device with one CDC-ACM function, driving the unmodified usb-device and
//! usbd-serial.
//!
//! The controller's driver is our own (`docs/architecture.md` says why). All of it runs at priority 2, so nothing is masked, and
//! nothing touches the controller from above: writes to a FIFO from two priorities would mix.
//!
//! | file | |
//! |---|---|
//! | `registers.rs` | offsets, bits, the manual's order of disabling |
//! | `fifo.rs` | how the FIFO RAM is divided |
//! | `control.rs` | endpoint 0 |
//! | `bulk_in.rs`, `bulk_out.rs` | the data endpoints |
//! | `bus.rs` | resets, suspend, configurations; usb-device's `UsbBus` |
//! | `requests.rs` | requests that usb-device does not pass on |
//! | `port.rs` | the logic's `Port` |

mod bulk_in;
mod bulk_out;
mod bus;
mod control;
mod fifo;
mod port;
mod registers;
mod requests;

pub use port::{Memory, UsbPort};

/// The notification endpoint, which usbd-serial declares and never uses.
const NOTIFY_IN: usize = 1;
/// Data to the host.
const BULK_IN: usize = 2;
/// Data from the host.
const BULK_OUT: usize = 1;
