//! What the `cantap` command does with buses and traces, without its arguments and its texts, for other programs.

#![forbid(unsafe_code)]

pub mod interrupt;
mod losses;
mod meter;
mod time;

pub use losses::{Losses, lost_frames};
pub use meter::{Meter, rounded};
pub use time::{duration, positive_duration};
