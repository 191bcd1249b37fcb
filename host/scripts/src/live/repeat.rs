//! A frame that this program sends periodically, because the device does not.

use cantap_can::{Channel, Frame};

/// A frame that is sent again and again from here.
pub struct Repeat {
    /// Its script and handle.
    pub of: (usize, u32),
    pub channel: Channel,
    pub frame: Frame,
    pub period_ns: u64,
    /// When it is sent next.
    pub due_ns: u64,
}
