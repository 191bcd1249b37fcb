//! Bit timing: what a controller is set to, and every way to reach a bit rate.
//!
//! Ranges are bxCAN's (RM0090, "CAN bit timing register"): prescaler 1 to 1024, bit segment 1
//! (propagation and phase segment 1) 1 to 16, bit segment 2 1 to 8, jump width 1 to 4 quanta. A bit
//! is one synchronisation quantum and both segments long.

use core::fmt;

/// Slowest bit rate supported, in bit/s.
pub const MIN_BITRATE_BPS: u32 = 5_000;
/// Fastest bit rate of classical CAN, in bit/s.
pub const MAX_BITRATE_BPS: u32 = 1_000_000;

/// One configuration of a bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BitTiming {
    /// Controller clocks per time quantum: 1 to 1024.
    pub prescaler: u16,
    /// Quanta of propagation segment and phase segment 1: 1 to 16.
    pub segment1: u8,
    /// Quanta of phase segment 2: 1 to 8.
    pub segment2: u8,
    /// Resynchronisation jump width in quanta: 1 to 4, at most `segment2`.
    pub jump_width: u8,
}

/// Why there is no timing for a bit rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum NoTiming {
    /// Outside [`MIN_BITRATE_BPS`] to [`MAX_BITRATE_BPS`].
    OutOfRange,
    /// This clock cannot be divided to that bit rate; the nearest rates below and above, in bit/s,
    /// rounded.
    Unreachable {
        /// Nearest below.
        below_bps: Option<u32>,
        /// Nearest above.
        above_bps: Option<u32>,
    },
}

impl fmt::Display for NoTiming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::OutOfRange => write!(f, "bit rates go from {MIN_BITRATE_BPS} to {MAX_BITRATE_BPS} bit/s"),
            Self::Unreachable { below_bps: Some(below), above_bps: Some(above) } => {
                write!(
                    f,
                    "the clock cannot be divided to it; the nearest rates are {below} and {above} bit/s"
                )
            }
            Self::Unreachable { below_bps: Some(nearest), .. }
            | Self::Unreachable { above_bps: Some(nearest), .. } => {
                write!(f, "the clock cannot be divided to it; the nearest rate is {nearest} bit/s")
            }
            Self::Unreachable { .. } => f.write_str("the clock cannot be divided to any bit rate of CAN"),
        }
    }
}

impl core::error::Error for NoTiming {}

impl BitTiming {
    /// That of a bus whose bit rate somebody else has set, and nobody here knows: only for a device with no bit rate of its own, such as a
    /// virtual interface or a trace that goes on. No controller can be set to it.
    pub const UNKNOWN: Self = Self { prescaler: 0, segment1: 0, segment2: 0, jump_width: 0 };

    /// Whether every field is in the controller's range.
    pub const fn is_valid(&self) -> bool {
        matches!(self.prescaler, 1..=1024)
            && matches!(self.segment1, 1..=16)
            && matches!(self.segment2, 1..=8)
            && matches!(self.jump_width, 1..=4)
            && self.jump_width <= self.segment2
    }

    /// Quanta per bit: 3 to 25.
    pub const fn quanta(&self) -> u32 {
        1 + self.segment1 as u32 + self.segment2 as u32
    }

    /// Controller clocks per bit.
    pub const fn clocks_per_bit(&self) -> u32 {
        self.prescaler as u32 * self.quanta()
    }

    /// The bit rate in bit/s, rounded, unless it is [`Self::UNKNOWN`].
    pub const fn known_bitrate_bps(&self, clock_hz: u32) -> Option<u32> {
        let clocks = self.clocks_per_bit();
        if clocks == 0 { None } else { Some(rate_of(clock_hz, clocks)) }
    }

    /// The bit rate in bit/s, rounded; 0 if it is [`Self::UNKNOWN`].
    pub const fn bitrate_bps(&self, clock_hz: u32) -> u32 {
        match self.known_bitrate_bps(clock_hz) {
            Some(rate) => rate,
            None => 0,
        }
    }

    /// The sample point in per mille of the bit.
    pub const fn sample_point_permille(&self) -> u32 {
        (1 + self.segment1 as u32) * 1000 / self.quanta()
    }

    /// The sample point that CiA recommends for a bit rate, in per mille (CiA 301, bit rates; the
    /// Linux kernel's defaults for the rates between).
    pub const fn recommended_sample_point_permille(bitrate_bps: u32) -> u32 {
        if bitrate_bps > 800_000 {
            750
        } else if bitrate_bps > 500_000 {
            800
        } else {
            875
        }
    }

    /// Every timing whose bit rate, rounded to whole bit/s, is `bitrate_bps` (so that 83 333 is 83
    /// 333.3), from the most quanta down, each with the widest jump that it allows.
    pub fn all(clock_hz: u32, bitrate_bps: u32) -> impl Iterator<Item = BitTiming> {
        // An adapter may claim any clock.
        let clocks = clock_hz.saturating_add(bitrate_bps / 2).checked_div(bitrate_bps).unwrap_or(0);
        let exact = clocks > 0 && rate_of(clock_hz, clocks) == bitrate_bps;
        Self::of_clocks(if exact { clocks } else { 0 })
    }

    /// Every timing of a bit that is `clocks` controller clocks long.
    pub fn of_clocks(clocks: u32) -> impl Iterator<Item = BitTiming> {
        (3..=25u32)
            .rev()
            .filter(move |quanta| clocks > 0 && clocks.is_multiple_of(*quanta) && clocks / quanta <= 1024)
            .flat_map(move |quanta| {
                (1..=8u32).filter_map(move |segment2| {
                    let segment1 = quanta.checked_sub(1 + segment2)?;
                    matches!(segment1, 1..=16).then(|| BitTiming {
                        prescaler: (clocks / quanta) as u16,
                        segment1: segment1 as u8,
                        segment2: segment2 as u8,
                        jump_width: segment2.min(4) as u8,
                    })
                })
            })
    }

    /// The timing for a bit rate: nearest to the wanted sample point, then with the most quanta. If no
    /// sample point is given, CiA's is used. The jump width is one quantum for every eight of the bit,
    /// at least one: enough for crystals, and no more sensitive to noise than necessary.
    pub fn choose(
        clock_hz: u32,
        bitrate_bps: u32,
        sample_point_permille: Option<u32>,
    ) -> Result<Self, NoTiming> {
        if !(MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&bitrate_bps) {
            return Err(NoTiming::OutOfRange);
        }
        let wanted = sample_point_permille.unwrap_or(Self::recommended_sample_point_permille(bitrate_bps));
        let mut best: Option<BitTiming> = None;
        for timing in Self::all(clock_hz, bitrate_bps) {
            let distance = |timing: &BitTiming| timing.sample_point_permille().abs_diff(wanted);
            if best.is_none_or(|best| distance(&timing) < distance(&best)) {
                best = Some(timing);
            }
        }
        match best {
            Some(best) => {
                let jump_width = (best.quanta() / 8).clamp(1, best.jump_width as u32) as u8;
                Ok(BitTiming { jump_width, ..best })
            }
            None => Err(Self::nearest(clock_hz, bitrate_bps)),
        }
    }

    fn nearest(clock_hz: u32, bitrate_bps: u32) -> NoTiming {
        let exact = clock_hz / bitrate_bps;
        let reachable = |clocks: &u32| {
            let rate = clock_hz / clocks;
            (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(&rate) && Self::of_clocks(*clocks).next().is_some()
        };
        let rounded = |clocks| rate_of(clock_hz, clocks);
        let slowest = clock_hz / MIN_BITRATE_BPS;
        let fastest = (clock_hz / MAX_BITRATE_BPS).max(1);
        NoTiming::Unreachable {
            below_bps: (exact + 1..=slowest).find(reachable).map(rounded),
            above_bps: (fastest..=exact).rev().find(reachable).map(rounded),
        }
    }
}

/// The bit rate of a bit that is `clocks` controller clocks long, rounded to whole bit/s.
const fn rate_of(clock_hz: u32, clocks: u32) -> u32 {
    clock_hz.saturating_add(clocks / 2) / clocks
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The CAN clock of cantap's boards. It divides into every bit rate that CiA lists; the 42 MHz of
    /// an STM32F405 at full speed does not reach 800 kbit/s.
    const CLOCK: u32 = 36_000_000;

    #[test]
    fn a_rate_that_is_not_reached_says_what_is() {
        let words = |clock, rate| BitTiming::choose(clock, rate, None).unwrap_err().to_string();
        assert_eq!(words(CLOCK, 4_999), "bit rates go from 5000 to 1000000 bit/s");
        assert_eq!(
            words(42_000_000, 800_000),
            "the clock cannot be divided to it; the nearest rates are 777778 and 807692 bit/s"
        );
        assert_eq!(words(1, 500_000), "the clock cannot be divided to any bit rate of CAN");
    }

    /// An adapter says which clock it has.
    #[test]
    fn no_clock_is_too_fast_to_be_refused() {
        for clock in [u32::MAX, u32::MAX - 250_000] {
            for rate in [5_000, 500_000, 1_000_000, u32::MAX] {
                assert!(BitTiming::all(clock, rate).all(|timing| timing.is_valid()), "{clock} {rate}");
            }
        }
    }

    #[test]
    fn every_cia_rate_is_reached_near_its_sample_point() {
        for (rate, prescaler, segment1, segment2, jump_width) in [
            (1_000_000, 3, 8, 3, 1),
            (800_000, 3, 11, 3, 1),
            (500_000, 9, 6, 1, 1),
            (250_000, 9, 13, 2, 2),
            (125_000, 18, 13, 2, 2),
            (100_000, 45, 6, 1, 1),
            (83_333, 27, 13, 2, 2),
            (50_000, 45, 13, 2, 2),
            (33_333, 135, 6, 1, 1),
            (20_000, 225, 6, 1, 1),
            (10_000, 225, 13, 2, 2),
            (5_000, 450, 13, 2, 2),
        ] {
            let timing = BitTiming { prescaler, segment1, segment2, jump_width };
            assert_eq!(BitTiming::choose(CLOCK, rate, None), Ok(timing));
            assert!(timing.is_valid());
            assert_eq!(timing.bitrate_bps(CLOCK), rate);
        }
    }

    #[test]
    fn an_unreachable_rate_names_its_neighbours() {
        assert_eq!(
            BitTiming::choose(CLOCK, 999_999, None),
            Err(NoTiming::Unreachable { below_bps: Some(947_368), above_bps: Some(1_000_000) })
        );
        assert_eq!(BitTiming::choose(CLOCK, 1_000_001, None), Err(NoTiming::OutOfRange));
    }

    #[test]
    fn an_unknown_bit_rate_is_none_and_no_controller_takes_it() {
        let unknown = BitTiming::UNKNOWN;
        assert_eq!(
            (unknown.is_valid(), unknown.known_bitrate_bps(CLOCK), unknown.bitrate_bps(CLOCK)),
            (false, None, 0)
        );
        let known = BitTiming::choose(CLOCK, 500_000, None).unwrap();
        assert_eq!(known.known_bitrate_bps(CLOCK), Some(500_000));
    }

    #[test]
    fn only_what_a_controller_can_be_set_to_is_valid() {
        let timing = |prescaler, segment1, segment2, jump_width| {
            BitTiming { prescaler, segment1, segment2, jump_width }.is_valid()
        };
        assert!(timing(1, 1, 1, 1) && timing(1024, 16, 8, 4) && timing(1, 1, 2, 2));
        for (prescaler, segment1, segment2, jump_width) in [
            (0, 1, 1, 1),
            (1025, 1, 1, 1),
            (1, 0, 1, 1),
            (1, 17, 1, 1),
            (1, 1, 0, 1),
            (1, 1, 9, 1),
            (1, 1, 1, 0),
            (1, 1, 8, 5),
            // The jump would be longer than the segment that it shortens.
            (1, 1, 1, 2),
        ] {
            assert!(
                !timing(prescaler, segment1, segment2, jump_width),
                "{prescaler} {segment1} {segment2} {jump_width}"
            );
        }
    }

    #[test]
    fn a_timing_says_how_long_its_bit_is_and_where_it_is_sampled() {
        let timing = BitTiming { prescaler: 9, segment1: 13, segment2: 2, jump_width: 2 };
        assert_eq!((timing.quanta(), timing.clocks_per_bit(), timing.bitrate_bps(CLOCK)), (16, 144, 250_000));
        assert_eq!(timing.sample_point_permille(), 875);
        let rates = [1_000_000, 800_001, 800_000, 500_001, 500_000, 5_000];
        assert_eq!(rates.map(BitTiming::recommended_sample_point_permille), [750, 750, 800, 800, 875, 875]);
    }

    #[test]
    fn the_wanted_sample_point_is_met_as_nearly_as_the_clock_allows() {
        let point = |wanted| BitTiming::choose(CLOCK, 500_000, Some(wanted)).unwrap().sample_point_permille();
        assert_eq!([500, 600, 700, 750, 800, 875].map(point), [500, 611, 708, 750, 777, 875]);
    }

    /// For a search, which tries them all.
    #[test]
    fn every_way_to_a_rate_is_listed_once_from_the_most_quanta_down() {
        let all: Vec<BitTiming> = BitTiming::all(CLOCK, 500_000).collect();
        assert!(all.iter().all(|timing| timing.is_valid() && timing.bitrate_bps(CLOCK) == 500_000));
        assert!(all.iter().all(|timing| timing.jump_width == timing.segment2.min(4)));
        assert!(all.is_sorted_by(|a, b| (b.quanta(), a.segment2) < (a.quanta(), b.segment2)));
        // 72 clocks: 24, 18, 12, 9, 8, 6, 4 and 3 quanta.
        let by_hand = |clocks: u32| {
            let ways = (1..=16).flat_map(|one| (1..=8).map(move |two| 1 + one + two));
            ways.filter(|quanta| clocks.is_multiple_of(*quanta) && (1..=1024).contains(&(clocks / quanta)))
                .count()
        };
        assert_eq!(all.len(), by_hand(72));
        for clocks in [0, 1, 2, 3, 25, 26, 3 * 1024, 3 * 1025, 25 * 1024, 25 * 1024 + 1] {
            assert_eq!(BitTiming::of_clocks(clocks).count(), by_hand(clocks), "{clocks}");
        }
        assert_eq!((BitTiming::all(CLOCK, 0).count(), BitTiming::all(0, 500_000).count()), (0, 0));
        // No whole number of clocks, but rounded, up or down, it is the rate.
        assert!(BitTiming::all(CLOCK, 734_694).all(|timing| timing.clocks_per_bit() == 49));
        assert!(BitTiming::all(CLOCK, 734_694).count() > 0 && BitTiming::all(CLOCK, 734_693).count() == 0);
        assert!(BitTiming::all(CLOCK, 83_333).count() > 0 && BitTiming::all(CLOCK, 83_334).count() == 0);
    }

    #[test]
    fn what_is_near_an_unreachable_rate_is_said_as_far_as_there_is_something() {
        let words = |clock, rate| BitTiming::choose(clock, rate, None).unwrap_err().to_string();
        assert_eq!(
            words(2_999_997, 999_998),
            "the clock cannot be divided to it; the nearest rates are 749999 and 999999 bit/s"
        );
        assert_eq!(
            words(2_999_997, 1_000_000),
            "the clock cannot be divided to it; the nearest rate is 999999 bit/s"
        );
        assert_eq!(
            words(400_000_000, 5_000),
            "the clock cannot be divided to it; the nearest rate is 15625 bit/s"
        );
    }
}
