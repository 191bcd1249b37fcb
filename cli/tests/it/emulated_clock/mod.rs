//! Device time and UTC, and two boards on one clock, with the firmware's ELF.
#![cfg(feature = "emu")]

use crate::common;
mod measure;

use cantap::device::ClockSource;

/// Two boards whose crystals are 80 ppm apart, on one computer.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn two_boards_80_ppm_apart_are_on_one_clock_and_on_utc() {
    let image = common::firmware();
    let clocks = measure::measure(&image, [40.0, -40.0], 16, 8).unwrap();
    println!("{clocks:#?}");
    assert!(
        clocks.by_utc.median_us > 10.0,
        "round trips alone cannot have been so good: {:?}",
        clocks.by_utc
    );
    let common = clocks.common.unwrap();
    assert!(common.worst_us < 1.0, "{common:?}");
    assert!(common.worst_us < clocks.by_utc.worst_us / 10.0, "{common:?}, by UTC {:?}", clocks.by_utc);
    // While both run, each second is placed by the marks before it.
    assert!(clocks.live.worst_us < 1.5, "{:?}", clocks.live);
    let (errors, report) = clocks.frames;
    assert_eq!(report.source, ClockSource::Frames);
    // How long the way there takes and the way back, frames cannot tell: answers are looked for every 20 us, and where in these they come
    // differs with the firmware's build.
    assert!(errors.worst_us < 80.0, "{errors:?}");
    assert!(errors.worst_us * 1e3 < report.uncertainty_ns.unwrap() as f64, "{errors:?}, {report:?}");
    // Compared with a computer that is 25 ppm fast.
    assert!((report.drift_ppm.unwrap() - 15.0).abs() < 5.0, "{report:?}");
    assert!(matches!(clocks.alone.1.source, ClockSource::RoundTrips(_)));
}
