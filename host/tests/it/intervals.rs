//! By whose clock intervals are.

use std::time::Duration;

use cantap::replay::{Pace, Replay};
use cantap::{Channel, Frame};

const CAN1: Channel = Channel::Can1;

/// How far intervals between sent frames are from those of the device's ticks, at most, in nanoseconds. The device's crystal is 250 ppm fast.
fn most_off_ns(keeps_intervals: bool) -> f64 {
    let device = cantap_virtual::open("load=0,ppm=250".parse().unwrap()).unwrap();
    if keeps_intervals {
        device.keep_intervals();
    }
    device.join(CAN1, 500_000).unwrap();
    let mut replay = Replay::new(&device, Pace::default(), [500_000; 2]).unwrap();
    let frame: Frame = "123#11".parse().unwrap();
    for number in 0..30 {
        assert!(replay.push(number * 50_000_000, CAN1, frame, |_| true).unwrap());
    }
    assert!(replay.finish(|since| since < Duration::from_mins(1)).unwrap());
    let ended = replay.take_ended();
    assert_eq!(ended.len(), 30);
    let ns_per_tick = 1e9 / f64::from(device.hello().tick_hz);
    let off = ended.windows(2).map(|pair| {
        let interval_ns = (pair[1].time_ns - pair[0].time_ns) as f64;
        (interval_ns - (pair[1].ticks - pair[0].ticks) as f64 * ns_per_tick).abs()
    });
    off.fold(0.0, f64::max)
}

#[test]
fn intervals_are_the_devices_own_if_that_is_wanted() {
    // A nanosecond's rounding at either end, and at a bend.
    let kept = most_off_ns(true);
    assert!(kept <= 3.0, "{kept}");
    // Towards UTC, by up to 100 ppm of 50 ms, and up to 250 ppm once the drift is known.
    let followed = most_off_ns(false);
    assert!(followed > 100.0, "{followed}");
}
