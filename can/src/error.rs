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

    /// Its name in texts, JSON and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Stuff => "stuff",
            Self::Form => "form",
            Self::Acknowledgment => "acknowledgment",
            Self::BitRecessive => "bit-recessive",
            Self::BitDominant => "bit-dominant",
            Self::Crc => "crc",
        }
    }

    /// The error of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }

    /// Its letter in the error reports of slcan, as Linux's driver reads them since version 6.0 (`drivers/net/can/slcan/slcan-core.c`). It names a
    /// bit as it was sent: `B` is a recessive one.
    pub const fn slcan_letter(self) -> u8 {
        match self {
            Self::Stuff => b's',
            Self::Form => b'f',
            Self::Acknowledgment => b'a',
            Self::BitRecessive => b'B',
            Self::BitDominant => b'b',
            Self::Crc => b'c',
        }
    }

    /// The error with that letter.
    pub fn from_slcan_letter(letter: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.slcan_letter() == letter)
    }
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

impl ErrorState {
    /// All of them, from the best to the worst.
    pub const ALL: [Self; 4] = [Self::Active, Self::Warning, Self::Passive, Self::BusOff];

    /// The state that follows from the transmit and the receive error counter of a controller that is on the bus. Never [`BusOff`](Self::BusOff): the
    /// counters are told as bytes, which do not reach 256.
    pub const fn of_counters(transmit: u8, receive: u8) -> Self {
        let greater = if transmit > receive { transmit } else { receive };
        match greater {
            0..96 => Self::Active,
            96..128 => Self::Warning,
            128.. => Self::Passive,
        }
    }

    /// Its name in texts, JSON and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Active => "active",
            Self::Warning => "warning",
            Self::Passive => "passive",
            Self::BusOff => "bus-off",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }

    /// Its letter in the state reports of slcan, as [`BusErrorKind::slcan_letter`].
    pub const fn slcan_letter(self) -> u8 {
        match self {
            Self::Active => b'a',
            Self::Warning => b'w',
            Self::Passive => b'p',
            Self::BusOff => b'b',
        }
    }

    /// The state with that letter.
    pub fn from_slcan_letter(letter: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.slcan_letter() == letter)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn either_counter_makes_the_state_worse() {
        for (count, state) in [
            (0, ErrorState::Active),
            (95, ErrorState::Active),
            (96, ErrorState::Warning),
            (127, ErrorState::Warning),
            (128, ErrorState::Passive),
            (255, ErrorState::Passive),
        ] {
            assert_eq!([ErrorState::of_counters(count, 0), ErrorState::of_counters(0, count)], [state; 2]);
        }
    }

    #[test]
    fn every_name_is_that_of_one() {
        for kind in BusErrorKind::ALL {
            assert_eq!(BusErrorKind::from_name(kind.name()), Some(kind));
            assert_eq!(BusErrorKind::from_slcan_letter(kind.slcan_letter()), Some(kind));
        }
        for state in ErrorState::ALL {
            assert_eq!(ErrorState::from_name(state.name()), Some(state));
            assert_eq!(ErrorState::from_slcan_letter(state.slcan_letter()), Some(state));
        }
        assert_eq!((BusErrorKind::from_name("bit"), ErrorState::from_name("error active")), (None, None));
    }
}
