//! The cantap host library: devices, records, time, statistics; trace files and signals behind
//! features, so that a program that only captures stays small.

pub mod autobaud;
pub mod bit_timing;
pub mod bits;
#[cfg(feature = "signals")]
pub mod condition;
pub mod device;
pub mod diff;
pub mod filter;
#[cfg(feature = "formats")]
pub mod formats;
pub mod hw_filter;
pub mod periodic;
pub mod playback;
#[cfg(feature = "plot")]
pub mod plot;
pub mod recovery;
pub mod replay;
#[cfg(feature = "signals")]
pub mod search;
#[cfg(feature = "signals")]
pub mod signals;
#[cfg(feature = "virtual")]
pub mod simbus;
pub mod socketcan;
#[cfg(feature = "stats")]
pub mod stats;
#[cfg(test)]
mod testing;
pub mod trace;
pub mod transmit;
#[cfg(feature = "signals")]
pub mod trigger;
pub mod unsent;
#[cfg(feature = "virtual")]
pub mod virtual_device;
#[cfg(feature = "formats")]
pub mod window;

pub use bits::{FrameBits, bits_on_bus};
pub use cantap_wire as wire;
pub use cantap_wire::{Channel, Frame, Id};
pub use device::{Address, Device, DeviceError};
pub use trace::{Direction, TraceEvent, TraceRecord};
