//! Nodes that take the place of made-up frames.

use crate::canopen::CanOpenBus;
use crate::car::{self, CarBus};
use crate::ecu::EcuBus;
use crate::simbus::Schedule;

/// Why this build has none.
pub const MISSING: Option<&str> = None;

/// The board that a device on these buses names.
pub const fn board(car: bool) -> &'static str {
    if car { car::BOARD } else { "virtual" }
}

/// The bit rate of a channel's bus in the vehicle, in bit/s.
pub fn bitrate_in_car(channel: usize) -> Option<u32> {
    car::BITRATES_BPS.get(channel).copied()
}

/// What the vehicle sends on a channel's bus.
pub fn car(channel: usize, seed: u64) -> Schedule {
    Schedule::Nodes(Box::new(CarBus::new(channel, seed)))
}

/// What the CANopen nodes send on a channel's bus: they are on the first.
pub fn canopen(channel: usize) -> Schedule {
    if channel == 0 { Schedule::Nodes(Box::new(CanOpenBus::in_use())) } else { Schedule::Silent }
}

/// What the ECU that is measured and calibrated sends on a channel's bus: it is on the first.
pub fn ecu(channel: usize) -> Schedule {
    if channel == 0 { Schedule::Nodes(Box::new(EcuBus::in_use())) } else { Schedule::Silent }
}
