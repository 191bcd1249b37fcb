//! What a controller says about errors.

/// The error that a controller reports in its last-error code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum BusErrorKind {
    /// More than five equal bits in a row.
    Stuff,
    /// A fixed-form field had an illegal bit.
    Form,
    /// A transmitted frame was not acknowledged.
    Acknowledgment,
    /// Sent recessive, read dominant.
    BitRecessive,
    /// Sent dominant, read recessive.
    BitDominant,
    /// The CRC of a received frame was wrong.
    Crc,
}

impl BusErrorKind {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Stuff, Self::Form, Self::Acknowledgment, Self::BitRecessive, Self::BitDominant, Self::Crc];
}

/// The state of a controller's fault confinement (ISO 11898-1).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum ErrorState {
    /// Error active: both counters below 96.
    Active,
    /// A counter reached 96.
    Warning,
    /// Error passive: a counter passed 127.
    Passive,
    /// The transmit error counter passed 255; the controller is off the bus.
    BusOff,
}
