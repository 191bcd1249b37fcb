//! Checks periodic frames before they are sent to a device: the device only refuses a wrong one, this module says what is
//! wrong with it.

use std::time::Duration;

use cantap_wire::Frame;
use cantap_wire::message::Modifier;

/// Shortest period that a device takes, in µs: no frame is shorter (docs/wire-protocol.md, "Periodic").
pub const SHORTEST_PERIOD_US: u64 = 47;
/// The same as a duration.
pub const SHORTEST_PERIOD: Duration = Duration::from_micros(SHORTEST_PERIOD_US);

/// Why a frame cannot be sent periodically as it is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BadPeriodic {
    /// Below [`SHORTEST_PERIOD`].
    #[error(
        "a period of {period:?} is too short: no frame is shorter than {SHORTEST_PERIOD:?}; give at least that"
    )]
    TooShort {
        /// The requested period.
        period: Duration,
    },
    /// It exceeds the device's tick counter.
    #[error("a period of {period:?} is too long; give at most {longest:?}")]
    TooLong {
        /// The requested period.
        period: Duration,
        /// The longest that the device accepts.
        longest: Duration,
    },
    /// A modifier changes a byte that the frame does not have.
    #[error("a modifier changes byte {byte} of '{frame}', which has {len} bytes of data; bytes count from 0")]
    OutsideData {
        /// The byte, from 0.
        byte: u8,
        /// The frame.
        frame: Frame,
        /// Its length in bytes.
        len: usize,
    },
    /// A counter's bits do not fit a byte.
    #[error("a counter of {bits} bits from bit {low_bit} does not fit a byte; its bits are 0 to 7")]
    OutsideByte {
        /// The counter's lowest bit.
        low_bit: u8,
        /// Its width in bits.
        bits: u8,
    },
}

/// A period in ticks of a device.
pub fn period_ticks(period: Duration, tick_hz: u32) -> Result<u32, BadPeriodic> {
    if period < SHORTEST_PERIOD {
        return Err(BadPeriodic::TooShort { period });
    }
    let ticks = (period.as_secs_f64() * f64::from(tick_hz)).round();
    if ticks > f64::from(u32::MAX) {
        let longest = Duration::from_secs(u64::from(u32::MAX / tick_hz.max(1)));
        return Err(BadPeriodic::TooLong { period, longest });
    }
    Ok(ticks as u32)
}

/// Checks whether modifiers can change a frame.
pub fn check_modifiers(frame: &Frame, modifiers: &[Modifier]) -> Result<(), BadPeriodic> {
    let len = frame.data_len();
    for modifier in modifiers {
        let (Modifier::Counter { byte, .. } | Modifier::Checksum { byte, .. } | Modifier::Random { byte }) =
            *modifier;
        if usize::from(byte) >= len {
            return Err(BadPeriodic::OutsideData { byte, frame: *frame, len });
        }
        if let Modifier::Counter { low_bit, bits, .. } = *modifier
            && !(low_bit < 8 && (1..=8 - low_bit).contains(&bits))
        {
            return Err(BadPeriodic::OutsideByte { low_bit, bits });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TICK_HZ: u32 = 12_000_000;

    #[test]
    fn periods_are_refused_with_the_reason() {
        let ticks = |period| period_ticks(period, TICK_HZ).map_err(|error| error.to_string());
        assert_eq!(ticks(SHORTEST_PERIOD), Ok(47 * 12));
        assert_eq!(ticks(Duration::from_secs(357)), Ok(357 * TICK_HZ));
        let short = ticks(Duration::from_micros(46)).unwrap_err();
        assert!(short.contains("46µs is too short") && short.contains("47µs"), "{short}");
        let long = ticks(Duration::from_mins(10)).unwrap_err();
        assert!(long.contains("too long") && long.contains("357s"), "{long}");
    }

    #[test]
    fn modifiers_stay_inside_the_data_and_the_byte() {
        let frame: Frame = "123#0011".parse().unwrap();
        let counter = |byte, low_bit, bits| Modifier::Counter { byte, low_bit, bits };
        assert_eq!(check_modifiers(&frame, &[counter(1, 0, 8), counter(0, 7, 1)]), Ok(()));
        for (modifier, part) in [
            (counter(2, 0, 8), "byte 2 of '123#0011'"),
            (Modifier::Random { byte: 9 }, "byte 9"),
            (counter(0, 4, 5), "5 bits from bit 4"),
            (counter(0, 8, 1), "from bit 8"),
            (counter(0, 0, 0), "of 0 bits"),
        ] {
            let error = check_modifiers(&frame, &[modifier]).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
