//! The search on the virtual device, which hears whatever is within one per cent.

use super::*;
use crate::Address;
use std::time::Instant;

fn search_on(options: &str) -> (Outcome, Duration) {
    let device = Device::open(&format!("virtual:{options}").parse::<Address>().unwrap()).unwrap();
    let started = Instant::now();
    let limits = Limits { silence: Duration::from_millis(500), ..Limits::default() };
    let outcome = search(&device, Channel::Can1, &limits, &mut |_| true).unwrap();
    let taken = started.elapsed();
    assert!(device.status().unwrap().channels[0].open.is_none());
    assert_eq!(device.status().unwrap().channels[0].transmitted, 0);
    (outcome, taken)
}

#[test]
fn every_common_rate_is_found() {
    for bitrate in COMMON_BPS {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=50"));
        assert!(
            matches!(outcome, Outcome::Found { bitrate_bps, .. } if bitrate_bps == bitrate),
            "{bitrate}: {outcome:?}"
        );
    }
}

/// 16 kbit/s of load at 125 kbit/s are about 50 frames a second, each in its own time.
#[test]
fn fifty_frames_a_second_are_enough_for_an_answer_within_a_second() {
    let (outcome, taken) = search_on("bitrate=125k,burst=1/20ms");
    assert!(matches!(outcome, Outcome::Found { bitrate_bps: 125_000, .. }), "{outcome:?}");
    assert!(taken < Duration::from_secs(1), "{taken:?}");
}

/// The clock does not reach 253.97 kbit/s itself; the simulated controller hears what is within 1 %.
#[test]
fn an_odd_rate_is_not_taken_for_its_common_neighbour() {
    for bitrate in [253_968, 255_319, 480_000, 117_647] {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=60"));
        let Outcome::Found { bitrate_bps, .. } = outcome else { panic!("{bitrate}: {outcome:?}") };
        let off = f64::from(bitrate_bps) / f64::from(bitrate) - 1.0;
        assert!(off.abs() < 0.01 && !COMMON_BPS.contains(&bitrate_bps), "{bitrate}: {bitrate_bps}");
    }
}

#[test]
fn a_bus_on_which_frames_are_destroyed_is_found_all_the_same() {
    for seed in 1..=20 {
        let (outcome, _) = search_on(&format!("bitrate=250k,load=50,errors=4,seed={seed}"));
        assert!(matches!(outcome, Outcome::Found { bitrate_bps: 250_000, .. }), "{seed}: {outcome:?}");
    }
}

#[test]
fn silence_and_noise_are_told_apart() {
    assert_eq!(search_on("load=0").0, Outcome::NoTraffic);
    let (outcome, _) = search_on("bitrate=500k,load=80,errors=100");
    assert!(matches!(outcome, Outcome::NoMatch { errors: 1.., about_bps: None }), "{outcome:?}");
}
