//! Which rates a controller reaches, and which of them and with what timing are worth listening to.

use cantap_wire::BitTiming;
use cantap_wire::timing::{MAX_BITRATE_BPS, MIN_BITRATE_BPS};

use super::hearing::Bounds;

/// Bit rates in use, in bit/s, those of CiA and of vehicles, the likeliest first.
pub const COMMON_BPS: [u32; 14] = [
    500_000, 250_000, 125_000, 1_000_000, 100_000, 50_000, 83_333, 33_333, 800_000, 20_000, 10_000, 5_000,
    95_238, 62_500,
];

/// Rates nearer than this cannot be told apart by listening, and need not be.
pub(super) const SAME: f64 = 0.005;

/// The scan's step: near enough that one of two neighbours is heard.
const SCAN_STEP: f64 = 1.007;

/// Every reachable rate, thinned to one in each [`SCAN_STEP`], from the fastest down.
pub(super) fn scan_rates(clock_hz: u32) -> Vec<u32> {
    let mut rates: Vec<u32> = Vec::new();
    for clocks in (clock_hz / MAX_BITRATE_BPS).max(1)..=clock_hz / MIN_BITRATE_BPS {
        let rate = f64::from(clock_hz) / f64::from(clocks);
        let far = rates.last().is_none_or(|last| f64::from(*last) / rate >= SCAN_STEP);
        if far && BitTiming::of_clocks(clocks).next().is_some() {
            rates.push(rate.round() as u32);
        }
    }
    rates
}

/// Controller clocks per bit, rounded.
pub(super) fn clocks_of(clock_hz: u32, rate: f64) -> u32 {
    (f64::from(clock_hz) / rate).round() as u32
}

/// The rates between the bounds that the clock reaches exactly and that are whole kilobits, except for the common ones: what leads
/// here is none of those.
pub(super) fn round_rates(clock_hz: u32, bounds: &Bounds) -> impl Iterator<Item = u32> {
    let least = bounds.least_bps.max(f64::from(MIN_BITRATE_BPS)) as u32 / 1000;
    let most = bounds.most_bps.min(f64::from(MAX_BITRATE_BPS)) as u32 / 1000;
    let inside = bounds.least_bps..=bounds.most_bps;
    (least..=most)
        .map(|kbps| kbps * 1000)
        .filter(move |bps| inside.contains(&f64::from(*bps)) && !COMMON_BPS.contains(bps))
        .filter(move |bps| {
            clock_hz.is_multiple_of(*bps) && BitTiming::of_clocks(clock_hz / bps).next().is_some()
        })
}

/// The timing that takes the least of other rates: the latest sample point for a bus that is faster, and the shortest jump for one
/// that is slower.
pub(super) fn sharpest(clocks: u32) -> Option<BitTiming> {
    BitTiming::of_clocks(clocks)
        .max_by_key(|timing| (timing.sample_point_permille(), timing.quanta()))
        .map(|timing| BitTiming { jump_width: 1, ..timing })
}

/// The reachable rate, in clocks per bit, that tells most: the one nearest to the middle of the bounds and not too near
/// to one that was studied.
pub(super) fn next_to_study(clock_hz: u32, bounds: &Bounds, tried: &[u32]) -> Option<u32> {
    let middle = bounds.middle_bps()?;
    let rate = |clocks: u32| f64::from(clock_hz) / f64::from(clocks);
    let most = bounds.most_bps.min(f64::from(MAX_BITRATE_BPS));
    let least = bounds.least_bps.max(f64::from(MIN_BITRATE_BPS));
    (clocks_of(clock_hz, most).max(1)..=clocks_of(clock_hz, least))
        .filter(|clocks| {
            (least..=most).contains(&rate(*clocks)) && BitTiming::of_clocks(*clocks).next().is_some()
        })
        .filter(|clocks| tried.iter().all(|near| (rate(*near) / rate(*clocks) - 1.0).abs() > SAME / 2.0))
        .min_by(|a, b| (rate(*a) - middle).abs().total_cmp(&(rate(*b) - middle).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scan_leaves_no_gap_that_a_rate_could_hide_in() {
        let rates = scan_rates(36_000_000);
        assert_eq!(rates.first(), Some(&1_000_000));
        assert!(rates.iter().all(|rate| (5_000..=1_000_000).contains(rate)));
        // Fast rates have few dividers: there the clock itself sets the steps.
        for pair in rates.windows(2).filter(|pair| pair[0] < 300_000) {
            assert!(f64::from(pair[0]) / f64::from(pair[1]) < 1.03, "{pair:?}");
        }
        assert!(rates.len() < 800, "{}", rates.len());
    }
}
