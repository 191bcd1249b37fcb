//! Turns a measured bit rate into one that the controller's clock can reach.

use cantap_wire::BitTiming;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};

/// Bit rates in use, in bit/s: those of CiA and those of vehicles.
pub const COMMON_BPS: [u32; 14] = [
    500_000, 250_000, 125_000, 1_000_000, 100_000, 50_000, 83_333, 33_333, 800_000, 20_000, 10_000, 5_000,
    95_238, 62_500,
];

/// The largest difference between two crystals: 100 ppm each, plus what a warm device adds.
const CRYSTALS: f64 = 0.000_3;
/// A receiver this far off the bus's rate still takes every frame, whatever its sample point: over the ten bits that may pass without an
/// edge to synchronise on, it amounts to a twentieth of a bit.
const REACH: f64 = 0.005;

/// What a controller can do with a measured bit rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Reached {
    /// It reaches this rate, in bit/s.
    At { bitrate_bps: u32 },
    /// Its clock reaches no rate that is near enough; this one is the nearest.
    Not { nearest_bps: Option<u32> },
}

/// Finds the bit rate that a controller with this clock should use for a measured one. `error` is the measurement's
/// standard error, as a fraction.
///
/// A common rate is preferred if the measurement allows it. Below 100 kbit/s the clock's own rates are less than a thousandth apart.
pub(super) fn reach(clock_hz: u32, measured_bps: f64, error: f64) -> Reached {
    let off = |bps: u32| (f64::from(bps) / measured_bps - 1.0).abs();
    let allowed = 3.0 * error + CRYSTALS;
    let is_reached =
        |bps: &u32| clock_hz.div_ceil(*bps) > 0 && BitTiming::all(clock_hz, *bps).next().is_some();
    let nearest = |rates: &mut dyn Iterator<Item = u32>| rates.min_by(|a, b| off(*a).total_cmp(&off(*b)));
    let common = &mut COMMON_BPS.into_iter().filter(|bps| off(*bps) <= allowed).filter(is_reached);
    if let Some(bitrate_bps) = nearest(common) {
        return Reached::At { bitrate_bps };
    }
    let clocks = (f64::from(clock_hz) / measured_bps).round() as u32;
    // At high rates one number of clocks in three or four has a timing, at low rates nearly every one.
    let around = clocks.saturating_sub(8).max(1)..=clocks + 8;
    let rates = around
        .filter(|clocks| BitTiming::of_clocks(*clocks).next().is_some())
        .map(|clocks| (f64::from(clock_hz) / f64::from(clocks)).round() as u32)
        .filter(|bps| (MIN_BITRATE_BPS..=MAX_BITRATE_BPS).contains(bps));
    match nearest(&mut { rates }) {
        Some(bitrate_bps) if off(bitrate_bps) <= REACH => Reached::At { bitrate_bps },
        nearest_bps => Reached::Not { nearest_bps },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLOCK_HZ: u32 = 36_000_000;

    #[test]
    fn every_rate_that_the_clock_reaches_is_found_through_its_crystal_s_error() {
        let mut rates = 0;
        for clocks in 36..=7200_u32 {
            if BitTiming::of_clocks(clocks).next().is_none() {
                continue;
            }
            let exact = f64::from(CLOCK_HZ) / f64::from(clocks);
            rates += 1;
            for ppm in [-60.0, 0.0, 60.0] {
                let Reached::At { bitrate_bps } = reach(CLOCK_HZ, exact * (1.0 + ppm / 1e6), 0.000_02) else {
                    panic!("{exact}")
                };
                // If the measurement cannot tell two neighbours apart, prefer the common one.
                let off = (f64::from(bitrate_bps) / exact - 1.0).abs();
                assert!(off <= 0.000_45, "{exact} by {ppm} ppm: {bitrate_bps}");
            }
        }
        assert!(rates > 2000, "{rates}");
    }

    #[test]
    fn common_rates_are_taken_where_the_measurement_allows_it_and_not_else() {
        for bps in COMMON_BPS {
            for ppm in [-250.0, 0.0, 250.0] {
                let measured = f64::from(bps) * (1.0 + ppm / 1e6);
                assert_eq!(reach(CLOCK_HZ, measured, 0.000_1), Reached::At { bitrate_bps: bps });
            }
        }
        // 36 MHz / 1078.
        assert_eq!(reach(CLOCK_HZ, 33_400.0, 0.000_05), Reached::At { bitrate_bps: 33_395 });
    }

    #[test]
    fn odd_rates_have_their_names_and_what_is_between_two_has_none() {
        for (measured, bitrate_bps) in [(33_333.3, 33_333), (47_619.0, 47_619), (83_333.3, 83_333)] {
            assert_eq!(reach(CLOCK_HZ, measured, 0.000_1), Reached::At { bitrate_bps });
        }
        // 36 MHz / 58.5: 57 and 60 clocks have timings.
        let far = reach(CLOCK_HZ, 615_384.0, 0.000_5);
        assert_eq!(far, Reached::Not { nearest_bps: Some(600_000) });
    }
}
