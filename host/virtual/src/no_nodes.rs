//! In place of `nodes.rs` in a build without the feature `nodes`.

use crate::simbus::Schedule;

/// Why this build has none.
pub const MISSING: Option<&str> = Some("this build has no nodes; build it with the feature `nodes`");

/// The board that the device names.
pub const fn board(_: bool) -> &'static str {
    "virtual"
}

/// There is no vehicle.
pub const fn bitrate_in_car(_: usize) -> Option<u32> {
    None
}

/// There is no vehicle.
pub const fn car(_: usize, _: u64) -> Schedule {
    Schedule::Silent
}

/// There are no nodes.
pub const fn canopen(_: usize) -> Schedule {
    Schedule::Silent
}

/// There is no ECU.
pub const fn ecu(_: usize) -> Schedule {
    Schedule::Silent
}
