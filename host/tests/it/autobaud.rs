//! The search for a bit rate on the virtual device: its pins show bits with a crystal's error and unequally delayed
//! edges.

use std::time::Duration;

use cantap::Channel;
use cantap::autobaud::{COMMON_BPS, Limits, Outcome, search};

/// The outcome, and how many seconds of the device's time it took.
fn search_within(silence: Duration, options: &str) -> (Outcome, f64) {
    let device = cantap_virtual::open(options.parse().unwrap()).unwrap();
    let started = device.time().unwrap();
    let outcome = search(&device, Channel::Can1, &Limits { silence }, &mut |_| true).unwrap();
    let seconds = (device.time().unwrap() - started) as f64 / f64::from(device.hello().tick_hz);
    assert!(device.status().unwrap().channels[0].open.is_none());
    assert_eq!(device.status().unwrap().channels[0].transmitted, 0);
    (outcome, seconds)
}

fn search_on(options: &str) -> (Outcome, f64) {
    search_within(Duration::from_secs(3), options)
}

#[test]
fn every_common_rate_is_found() {
    for bitrate in COMMON_BPS {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=50,ppm=60"));
        assert!(
            matches!(outcome, Outcome::Found { bitrate_bps, .. } if bitrate_bps == bitrate),
            "{bitrate}: {outcome:?}"
        );
    }
}

/// The search once missed these entirely while it guessed: it takes traffic to recognise a wrong guess.
#[test]
fn a_sparse_bus_is_found_within_two_frames() {
    for (options, most_s) in [
        ("bitrate=500k,burst=3/1s", 2.0),
        ("bitrate=500k,burst=1/500ms", 2.0),
        ("bitrate=125k,burst=1/20ms", 2.0),
        ("bitrate=10k,burst=1/1s", 3.5),
    ] {
        let (outcome, seconds) = search_on(options);
        assert!(matches!(outcome, Outcome::Found { .. }), "{options}: {outcome:?}");
        assert!(seconds < most_s, "{options}: {seconds} s");
    }
}

#[test]
fn odd_rates_are_named_right_and_never_taken_for_a_neighbour() {
    for (bitrate, expected) in [
        ("33333", 33_333),
        ("47619", 47_619),
        ("83333", 83_333),
        ("480k", 480_000),
        ("117647", 117_647),
        ("255319", 255_319),
    ] {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=60"));
        let Outcome::Found { bitrate_bps, measured_bps, .. } = outcome else {
            panic!("{bitrate}: {outcome:?}")
        };
        assert_eq!(bitrate_bps, expected);
        assert!((measured_bps / f64::from(expected) - 1.0).abs() < 0.001, "{measured_bps}");
    }
}

#[test]
fn a_rate_that_the_clock_does_not_reach_is_named_and_is_no_success() {
    for bitrate in [615_384_u32, 253_968, 246_154] {
        let (outcome, _) = search_on(&format!("bitrate={bitrate},load=60"));
        let Outcome::Unreachable { measured_bps, nearest_bps: Some(nearest) } = outcome else {
            panic!("{bitrate}: {outcome:?}")
        };
        assert!((measured_bps / f64::from(bitrate) - 1.0).abs() < 0.001, "{bitrate}: {measured_bps}");
        let off = (f64::from(nearest) / f64::from(bitrate) - 1.0).abs();
        assert!((0.005..0.03).contains(&off), "{bitrate}: {nearest}");
    }
}

/// Two frames must be enough. The first was once forgotten while waiting for the second, so that it took three.
#[test]
fn a_rate_beyond_reach_is_named_after_two_frames() {
    let (outcome, seconds) = search_on("bitrate=615384,burst=1/700ms");
    assert!(matches!(outcome, Outcome::Unreachable { .. }), "{outcome:?}");
    assert!(seconds < 1.2, "{seconds} s");
}

#[test]
fn a_silent_bus_is_given_up_in_time() {
    let (outcome, seconds) = search_within(Duration::from_millis(400), "load=0");
    assert_eq!(outcome, Outcome::NoTraffic);
    assert!((0.4..0.9).contains(&seconds), "{seconds} s");
}

#[test]
fn a_bus_on_which_frames_are_destroyed_is_found_all_the_same() {
    for seed in 1..=20 {
        let (outcome, _) = search_on(&format!("bitrate=250k,load=50,errors=30,seed={seed}"));
        assert!(matches!(outcome, Outcome::Found { bitrate_bps: 250_000, .. }), "{seed}: {outcome:?}");
    }
}

/// Some are destroyed after their CRC and can still be measured.
#[test]
fn a_bus_without_one_good_frame_is_no_success() {
    let (outcome, _) = search_within(Duration::from_millis(600), "bitrate=500k,load=80,errors=100");
    assert!(
        matches!(outcome, Outcome::Unreadable { .. } | Outcome::Unconfirmed { errors: 1.., .. }),
        "{outcome:?}"
    );
}

#[test]
fn a_sender_that_nobody_acknowledges_is_measured_and_reported() {
    let (outcome, _) = search_within(Duration::from_millis(600), "bitrate=250k,load=50,ack=no");
    assert!(
        matches!(outcome, Outcome::Unconfirmed { bitrate_bps: 250_000, acknowledged: false, .. }),
        "{outcome:?}"
    );
}
