//! What the `cantap` command does with buses and traces, without its arguments and its texts, for other programs.

#![forbid(unsafe_code)]

#[cfg(feature = "dfu")]
pub mod dfu;
pub mod interrupt;
mod losses;
mod meter;

pub use cantap_trace::grammar::{duration, positive_duration};
pub use losses::{Losses, lost_frames};
pub use meter::{Meter, rounded};
