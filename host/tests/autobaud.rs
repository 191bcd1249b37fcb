//! The search for a bit rate on the virtual device, which hears whatever is within one per cent.

use std::time::{Duration, Instant};

use cantap::Channel;
use cantap::autobaud::{COMMON_BPS, Limits, Outcome, search};

fn search_on(options: &str) -> (Outcome, Duration) {
    let device = cantap_virtual::open(options.parse().unwrap()).unwrap();
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

/// The clock does not reach 253.97 kbit/s itself.
#[test]
fn an_odd_rate_is_not_taken_for_its_common_neighbour() {
    for bitrate in [253_968, 255_319, 480_000, 117_647] {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=60"));
        let Outcome::Found { bitrate_bps, .. } = outcome else { panic!("{bitrate}: {outcome:?}") };
        let off = f64::from(bitrate_bps) / f64::from(bitrate) - 1.0;
        assert!(off.abs() < 0.01 && !COMMON_BPS.contains(&bitrate_bps), "{bitrate}: {bitrate_bps}");
    }
}

/// Ten milliseconds for each of the common rates are the first round, and more than the limit the second.
#[test]
fn a_silent_bus_is_given_up_in_time() {
    let device = cantap_virtual::open("load=0".parse().unwrap()).unwrap();
    let limits = Limits { dwell: Duration::from_millis(10), silence: Duration::from_millis(400) };
    let from = device.time().unwrap();
    let outcome = search(&device, Channel::Can1, &limits, &mut |_| true).unwrap();
    let taken = device.time().unwrap() - from;
    assert_eq!(outcome, Outcome::NoTraffic);
    let [least, most] = [400, 700].map(|ms| ms * u64::from(device.hello().tick_hz) / 1000);
    assert!((least..most).contains(&taken), "{taken} ticks");
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
