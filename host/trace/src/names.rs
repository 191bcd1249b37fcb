//! Names for everything that is not a frame, as used in text files and tables: `queue`, `bit-recessive`,
//! `bus-off`.

use cantap_wire::record::{BusErrorKind, ErrorState, LossStage, TransmitFailure};

/// Where frames were lost.
pub const LOSS_STAGES: [(LossStage, &str); 4] = [
    (LossStage::Controller, "controller"),
    (LossStage::Queue, "queue"),
    (LossStage::Link, "link"),
    (LossStage::Host, "host"),
];
/// Errors on the bus.
pub const BUS_ERRORS: [(BusErrorKind, &str); 6] = [
    (BusErrorKind::Stuff, "stuff"),
    (BusErrorKind::Form, "form"),
    (BusErrorKind::Acknowledgment, "acknowledgment"),
    (BusErrorKind::BitRecessive, "bit-recessive"),
    (BusErrorKind::BitDominant, "bit-dominant"),
    (BusErrorKind::Crc, "crc"),
];
/// A controller's fault confinement.
pub const ERROR_STATES: [(ErrorState, &str); 4] = [
    (ErrorState::Active, "active"),
    (ErrorState::Warning, "warning"),
    (ErrorState::Passive, "passive"),
    (ErrorState::BusOff, "bus-off"),
];
/// Why a frame was not sent. [`TransmitFailure::Overtaken`], which carries a number, has the name
/// [`OVERTAKEN`].
pub const TRANSMIT_FAILURES: [(TransmitFailure, &str); 5] = [
    (TransmitFailure::ArbitrationLost, "arbitration-lost"),
    (TransmitFailure::BusError, "bus-error"),
    (TransmitFailure::Aborted, "aborted"),
    (TransmitFailure::Closed, "closed"),
    (TransmitFailure::BusOff, "bus-off"),
];
/// The name of [`TransmitFailure::Overtaken`].
pub const OVERTAKEN: &str = "overtaken";

/// An item's name in one of these tables; empty if it has none there.
pub fn name<T: PartialEq>(names: &[(T, &'static str)], item: &T) -> &'static str {
    names.iter().find(|(known, _)| known == item).map_or("", |(_, name)| *name)
}

/// The item with a name in one of these tables.
pub fn item<T: Copy>(names: &[(T, &str)], name: &str) -> Option<T> {
    names.iter().find(|(_, known)| *known == name).map(|(item, _)| *item)
}
