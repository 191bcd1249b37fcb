//! Channels as can-utils names them.

use std::fmt;

/// The name of channel 0, which some formats have: `can0` is channel 1, as users count.
pub const CHANNEL_0: &str = "channel0";

/// A channel's interface name: `can0` for channel 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Interface(pub u8);

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0.checked_sub(1) {
            Some(number) => write!(f, "can{number}"),
            None => f.write_str(CHANNEL_0),
        }
    }
}
