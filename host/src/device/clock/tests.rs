//! The clock on simulated devices, whose true time is known.

use super::*;

const TICK_HZ: u32 = 12_000_000;
const START_NS: i64 = 1_700_000_000_000_000_000;
/// Nanoseconds of a second.
const S: i64 = 1_000_000_000;

fn utc(after_start_ns: i64) -> UtcNs {
    UtcNs(START_NS + after_start_ns)
}

/// A pseudo-random number from 0 to 1.
fn even(number: i64) -> f64 {
    let bits = (number as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    ((bits ^ bits >> 32).wrapping_mul(0xD6E8_FEB8_6659_FD93) >> 11) as f64 / (1_u64 << 53) as f64
}

/// A device on a USB host controller.
#[derive(Clone, Copy)]
struct Simulated {
    /// How much too fast its crystal is, in parts per million, and how much that increases over a minute or so.
    ppm: f64,
    warm_up_ppm: f64,
    /// How much too fast the controller's frames are.
    frames_ppm: f64,
    /// Frame 0 of the controller started this long after the start.
    frames_from_ns: i64,
    /// A SOF is early or late by at most this.
    jitter_ns: f64,
}

const EXACT: Simulated =
    Simulated { ppm: 0.0, warm_up_ppm: 0.0, frames_ppm: 0.0, frames_from_ns: 300_123, jitter_ns: 0.0 };

impl Simulated {
    /// Its timer, this long after the start.
    fn ticks(&self, ns: i64) -> Ticks {
        const MINUTE_S: f64 = 60.0;
        let seconds = ns as f64 / 1e9;
        // The integral of a rate that approaches its end value exponentially.
        let warmed_us = self.warm_up_ppm * (seconds - MINUTE_S * (1.0 - (-seconds / MINUTE_S).exp()));
        let ahead_us = self.ppm * seconds + warmed_us;
        Ticks((i128::from(ns) * 12 / 1000) as u64 + 5_000_000).plus((ahead_us * 12.0).floor() as i64)
    }

    /// When a frame started.
    fn frame_start_ns(&self, frame: i64) -> i64 {
        let jitter = (2.0 * even(frame) - 1.0) * self.jitter_ns;
        self.frames_from_ns + (frame as f64 * 1e6 / (1.0 + self.frames_ppm * 1e-6) + jitter) as i64
    }

    /// The mark of the last frame before a moment.
    fn mark(&self, ns: i64) -> SofMark {
        let mut frame = ((ns - self.frames_from_ns) as f64 * (1.0 + self.frames_ppm * 1e-6) / 1e6) as i64;
        while self.frame_start_ns(frame) > ns {
            frame -= 1;
        }
        let at = self.ticks(self.frame_start_ns(frame));
        SofMark { frame: (frame % 2048) as u16, at, doubled: 0 }
    }
}

/// A device's map, updated once a second for this many seconds; `delays` gives the duration of question and answer for each second, and `marks`
/// decides what happens to each second's mark. Also returns the worst error in microseconds after the first minute, and whether time ran backwards.
fn follow(
    device: &Simulated,
    seconds: i64,
    delays: impl Fn(i64) -> (i64, i64),
    marks: impl Fn(i64, SofMark) -> Option<SofMark>,
) -> (ClockMap, f64, bool) {
    let mut map = ClockMap::new(TICK_HZ, utc(0));
    let (mut worst_us, mut backwards, mut previous) = (0.0_f64, false, UtcNs(i64::MIN));
    for second in 0..seconds {
        let asked_ns = second * S + 2_000_000;
        if let Some(mark) = marks(second, device.mark(asked_ns)) {
            map.mark(mark);
        }
        let (to_ns, back_ns) = delays(second);
        map.add(device.ticks(asked_ns + to_ns), utc(asked_ns), utc(asked_ns + to_ns + back_ns));
        if second == 0 {
            map.settle();
        }
        for step in 0..10 {
            let truth_ns = asked_ns + to_ns + back_ns + step * 90_000_000;
            let mapped = map.utc(device.ticks(truth_ns));
            backwards |= mapped < previous;
            previous = mapped;
            if second > 60 {
                worst_us = worst_us.max(mapped.since(utc(truth_ns)).abs() as f64 / 1e3);
            }
        }
    }
    (map, worst_us, backwards)
}

/// Up to 1.8 ms for the answer, 0.1 ms for the question.
fn usual(second: i64) -> (i64, i64) {
    (100_000, 100_000 + second * 7919 % 10 * 200_000)
}

fn no_marks(_: i64, _: SofMark) -> Option<SofMark> {
    None
}

#[expect(clippy::unnecessary_wraps, reason = "what becomes of marks may be nothing")]
fn all_marks(_: i64, mark: SofMark) -> Option<SofMark> {
    Some(mark)
}

/// What happens to the mark of each second.
type Marking = fn(i64, SofMark) -> Option<SofMark>;

#[test]
fn a_drifting_clock_is_measured_and_followed_without_running_backwards() {
    for ppm in [-80.0, 0.0, 37.0, 250.0] {
        let (map, worst_us, backwards) = follow(&Simulated { ppm, ..EXACT }, 300, usual, no_marks);
        let report = map.report();
        let measured = report.drift_ppm.unwrap();
        assert!((measured - ppm).abs() < 2.0, "{measured} ppm for {ppm}");
        assert_eq!(report.source, ClockSource::RoundTrips(FrameDoubt::NoMarks));
        assert!(worst_us < 40.0, "{worst_us} us off at {ppm} ppm");
        assert!(!backwards);
    }
}

#[test]
fn frames_follow_a_crystal_that_warms_up() {
    let device = Simulated { ppm: 40.0, warm_up_ppm: 8.0, frames_ppm: -25.0, jitter_ns: 500.0, ..EXACT };
    let delays = |second: i64| {
        let delay = |n: i64| 60_000 - ((1.0 - even(n)).ln() * 100_000.0) as i64;
        (delay(2 * second), delay(2 * second + 1))
    };
    let (by_round_trips, worst_us, _) = follow(&device, 300, delays, no_marks);
    let (by_frames, worst_by_frames_us, backwards) = follow(&device, 300, delays, all_marks);
    assert_eq!(by_frames.report().source, ClockSource::Frames);
    assert!(worst_by_frames_us < 12.0, "{worst_by_frames_us} us off by frames");
    assert!(worst_by_frames_us < worst_us / 2.0, "{worst_by_frames_us} and {worst_us} us off");
    assert!(!backwards);
    let report = by_frames.report();
    assert!((report.frames_ppm.unwrap() + 25.0).abs() < 0.2, "{report:?}");
    assert!((report.drift_ppm.unwrap() - 48.0).abs() < 0.3, "{report:?}");
    // The bound must hold and must also be tight.
    let (by_frames_ns, alone_ns) =
        (report.uncertainty_ns.unwrap(), by_round_trips.report().uncertainty_ns.unwrap());
    assert!(
        f64::from(by_frames_ns as i32) > worst_by_frames_us * 1e3 && by_frames_ns < alone_ns,
        "{report:?}, {alone_ns}"
    );
}

#[test]
fn a_busy_computer_does_not_stretch_the_time_between_frames() {
    // The answer takes up to 300 ms, and the device reads its clock anywhere during that time.
    let delays = |second: i64| {
        let delay = 1_000_000 + (second * 7919 % 13) * 23_000_000;
        let to = delay * (second * 31 % 11) / 11;
        (to, delay - to)
    };
    let (map, ..) = follow(&EXACT, 60, delays, no_marks);
    let spacing = |from: i64| map.utc(EXACT.ticks((from + 12) * S)).since(map.utc(EXACT.ticks(from * S)));
    for from in 0..48 {
        let off_ns = (spacing(from) - 12 * S).abs();
        assert!(off_ns < 12_000 * 300, "{off_ns} ns in 12 s");
    }
}

#[test]
fn a_device_in_its_own_time_keeps_its_spacing() {
    // An emulated board that runs at a tenth of real time, frames and all.
    let slow = Simulated { ppm: -900_000.0, frames_ppm: -900_000.0, ..EXACT };
    let (map, _, backwards) = follow(&slow, 100, usual, all_marks);
    let report = map.report();
    assert_eq!((report.drift_ppm, report.uncertainty_ns), (None, None));
    assert!(!backwards);
    let from = slow.ticks(50 * S);
    assert_eq!(map.utc(from.plus(120_000_000)).since(map.utc(from)), 10 * S);
}

#[test]
fn a_program_that_asks_often_knows_no_less() {
    let device = Simulated { ppm: 37.0, ..EXACT };
    let after = |per_second: i64| {
        let mut map = ClockMap::new(TICK_HZ, utc(0));
        for number in 0..300 * per_second {
            let (asked_ns, (to_ns, back_ns)) = (number * S / per_second, usual(number));
            map.add(device.ticks(asked_ns + to_ns), utc(asked_ns), utc(asked_ns + to_ns + back_ns));
            if number == 0 {
                map.settle();
            }
        }
        let report = map.report();
        assert!((report.drift_ppm.unwrap() - 37.0).abs() < 2.0, "{report:?}");
        report.uncertainty_ns.unwrap()
    };
    let (seldom, often) = (after(2), after(50));
    assert!(often <= seldom + 20_000, "{often} and {seldom} ns");
}

#[test]
fn intervals_that_are_kept_are_the_crystals_and_how_far_that_leads_from_utc_is_known() {
    let device = Simulated { ppm: 37.0, ..EXACT };
    let mut map = ClockMap::new(TICK_HZ, utc(0));
    let mut ends = Vec::new();
    for second in 0..300 {
        let (asked_ns, (to_ns, back_ns)) = (second * S, usual(second));
        map.add(device.ticks(asked_ns + to_ns), utc(asked_ns), utc(asked_ns + to_ns + back_ns));
        if second == 0 {
            map.settle();
            // Tick 0 is long before anything that was asked: the line must not be drawn from there.
            let (settled, before) = (device.ticks(to_ns), map.utc(device.ticks(to_ns)));
            map.keep_intervals(Ticks(0));
            assert_eq!(map.utc(settled), before);
        }
        let now = device.ticks(asked_ns + S / 2);
        ends.push((now, map.utc(now)));
    }
    for pair in ends.windows(2) {
        let by_ticks_ns = pair[1].0.since(pair[0].0) as f64 * 1e9 / f64::from(TICK_HZ);
        assert!((pair[1].1.since(pair[0].1) as f64 - by_ticks_ns).abs() <= 2.0);
    }
    let report = map.report();
    assert!((report.drift_ppm.unwrap() - 37.0).abs() < 2.0, "{report:?}");
    // 37 us in each of 300 s.
    let (off_ns, unsure_ns) = (ends[299].1.since(utc(299 * S + S / 2)), report.uncertainty_ns.unwrap());
    assert!((10_900_000..11_300_000).contains(&off_ns), "{off_ns}");
    assert!((off_ns..off_ns + 1_000_000).contains(&unsure_ns), "{unsure_ns} for {off_ns}");
}

#[test]
fn a_clock_that_is_moved_is_followed_again() {
    // The computer sleeps for 40 ms, which the device's clock counts and its own does not.
    let mut map = ClockMap::new(TICK_HZ, utc(0));
    for second in 0..200 {
        let slept = if second < 100 { 0 } else { 40_000_000 };
        let asked_ns = second * S;
        let (to_ns, back_ns) = usual(second);
        let at = EXACT.ticks(asked_ns + to_ns + slept);
        map.add(at, utc(asked_ns), utc(asked_ns + to_ns + back_ns));
    }
    // 100 ppm for 100 s can make up for 10 ms; then it continues.
    let truth_ns = 200 * S;
    let left_ns = map.utc(EXACT.ticks(truth_ns + 40_000_000)).since(utc(truth_ns)).abs();
    assert!(left_ns < 31_000_000, "{left_ns} ns off");
    assert!(map.report().uncertainty_ns.is_some());
}

#[test]
fn a_time_can_be_mapped_back() {
    let device = Simulated { ppm: 40.0, warm_up_ppm: 8.0, jitter_ns: 200.0, ..EXACT };
    let (map, ..) = follow(&device, 100, usual, all_marks);
    for ms in (0..101_000).step_by(77) {
        let ticks = device.ticks(ms * 1_000_000 + 5_000_000);
        let back = map.ticks(map.utc(ticks));
        assert!(back.since(ticks).abs() <= 1, "{back:?} for {ticks:?}");
        let frames = map.frames();
        let back = frames.ticks_at(frames.at(ticks).unwrap()).unwrap();
        assert!(back.since(ticks).abs() <= 1, "{back:?} for {ticks:?} by frames");
    }
}

/// What happens to marks that cannot be true.
#[test]
fn marks_that_cannot_be_are_not_built_on() {
    let cases: [(&str, Marking, FrameDoubt); 4] = [
        ("twice a millisecond", |_, mark| Some(SofMark { doubled: 990, ..mark }), FrameDoubt::Doubled),
        // Every other mark is half a frame late: two SOFs per frame that nobody counted.
        (
            "half a frame off",
            |second, mark| Some(SofMark { at: mark.at.plus(second % 2 * 6_000), ..mark }),
            FrameDoubt::Disagree,
        ),
        (
            "numbers from nowhere",
            |second, mark| Some(SofMark { frame: (second * 577 % 2048) as u16, ..mark }),
            FrameDoubt::Disagree,
        ),
        ("two of them", |second, mark| (second < 2).then_some(mark), FrameDoubt::TooFew),
    ];
    for (name, marks, doubt) in cases {
        let device = Simulated { ppm: 80.0, ..EXACT };
        let (map, worst_us, backwards) = follow(&device, 100, usual, marks);
        assert_eq!(map.report().source, ClockSource::RoundTrips(doubt), "{name}");
        assert_eq!(map.report().frames_ppm, None, "{name}");
        assert!(worst_us < 40.0 && !backwards, "{name}: {worst_us} us");
    }
}

#[test]
fn a_suspended_bus_is_noticed_and_what_follows_begins_anew() {
    let device = Simulated { ppm: -30.0, ..EXACT };
    let before = |second: i64| second < 50;
    let (map, ..) = follow(&device, 70, usual, |second, mark| before(second).then_some(mark));
    assert_eq!(map.report().source, ClockSource::RoundTrips(FrameDoubt::Silent));
    // The controller counts from a different number when it is back.
    let marks = |second: i64, mark: SofMark| match second {
        0..50 => Some(mark),
        50..60 => None,
        _ => Some(SofMark { frame: (mark.frame + 777) % 2048, ..mark }),
    };
    let (map, worst_us, backwards) = follow(&device, 200, usual, marks);
    assert_eq!(map.report().source, ClockSource::Frames);
    assert!(worst_us < 20.0 && !backwards, "{worst_us} us");
}

#[test]
fn a_single_false_mark_is_left_out() {
    let marks = |second: i64, mark: SofMark| {
        Some(if second == 30 { SofMark { frame: (mark.frame + 1) % 2048, ..mark } } else { mark })
    };
    let (map, worst_us, _) = follow(&EXACT, 100, usual, marks);
    assert_eq!(map.frames().marks().count(), 99);
    assert!(worst_us < 20.0, "{worst_us} us");
}

/// The acceptance of the common clock: 80 ppm apart, each warming up differently, marked at different frames.
#[test]
fn two_devices_on_a_controller_are_on_one_clock_to_a_microsecond() {
    let controller = Simulated { frames_ppm: 35.0, jitter_ns: 100.0, ..EXACT };
    let first = Simulated { ppm: 40.0, warm_up_ppm: 5.0, ..controller };
    let second = Simulated { ppm: -40.0, warm_up_ppm: -3.0, ..controller };
    let late = |device: &Simulated, from: i64| {
        let marks = move |n: i64, mark: SofMark| (n >= from).then_some(mark);
        follow(device, 400, |n| (100_000 + (even(n * from) * 400_000.0) as i64, 200_000), marks).0
    };
    // One began to mark some wraps of the frame number after the other.
    let (first_map, second_map) = (late(&first, 1), late(&second, 14));
    let common = CommonClock::between(&first_map, &second_map).unwrap();
    let mut worst_ns = 0;
    for ms in (20_000..400_000).step_by(97) {
        let ns = ms * 1_000_000 + 123_456;
        let (one, other) = (first.ticks(ns), second.ticks(ns));
        let mapped = common.to_second(first_map.frames(), one, second_map.frames()).unwrap();
        worst_ns = worst_ns.max(mapped.since(other).abs() * 1000 / 12);
        let back = common.to_first(first_map.frames(), other, second_map.frames()).unwrap();
        worst_ns = worst_ns.max(back.since(one).abs() * 1000 / 12);
    }
    assert!(worst_ns < 400, "{worst_ns} ns");
}

#[test]
fn devices_on_two_controllers_are_not_put_on_one_clock() {
    let map = |device: &Simulated| follow(device, 100, usual, all_marks).0;
    let here = map(&Simulated { ppm: 40.0, ..EXACT });
    // Another phase of the frames, another number, another rate.
    for (frames_from_ns, frames_ppm) in
        [(EXACT.frames_from_ns - 4_000_000, 0.0), (-700_000_000, 0.0), (300_123, 60.0)]
    {
        let there = map(&Simulated { ppm: -40.0, frames_from_ns, frames_ppm, ..EXACT });
        let found = CommonClock::between(&here, &there);
        assert!(
            matches!(found, Err(NotCommon::Controllers { .. })),
            "{frames_from_ns} {frames_ppm}: {found:?}"
        );
    }
    let (silent, ..) = follow(&EXACT, 100, usual, no_marks);
    assert_eq!(CommonClock::between(&here, &silent), Err(NotCommon::Doubt(FrameDoubt::NoMarks)));
}

/// A computer that was busy in the first seconds did not know UTC well at that time. What it learns minutes later does not improve
/// those times, and they must not be compared with it.
#[test]
fn a_bad_beginning_does_not_put_two_devices_on_two_controllers() {
    let controller = Simulated { frames_ppm: 35.0, jitter_ns: 100.0, ..EXACT };
    let map = |ppm: f64, busy_s: i64| {
        let delays =
            move |second: i64| if second < busy_s { (100_000, 20_000_000) } else { (100_000, 200_000) };
        follow(&Simulated { ppm, ..controller }, 200, delays, all_marks).0
    };
    let (first, second) = (map(40.0, 0), map(-40.0, 5));
    let common = CommonClock::between(&first, &second).unwrap();
    assert!(common.disagreement_ns() > 5_000_000, "{common:?}: it begins 10 ms off");
    assert_eq!(common.outliers(), 0, "{common:?}");
}

/// One device's UTC was wrong for three seconds, as after an answer that was late undetectably, and one mark was as late as marks may be.
/// Both are counted and do not undo what minutes have shown.
#[test]
fn a_time_that_is_false_once_is_counted_and_decides_nothing() {
    let controller = Simulated { frames_ppm: 35.0, jitter_ns: 100.0, ..EXACT };
    let here = follow(&Simulated { ppm: 40.0, ..controller }, 300, usual, all_marks).0;
    let late_mark = |second: i64, mark: SofMark| {
        Some(if second == 290 { SofMark { at: mark.at.plus(55), ..mark } } else { mark })
    };
    let mut there = follow(&Simulated { ppm: -40.0, ..controller }, 300, usual, late_mark).0;
    let quiet = CommonClock::between(&here, &there).unwrap();
    assert_eq!(quiet.outliers(), 0, "{quiet:?}");
    for bend in there.bends.iter_mut().skip(280).take(3) {
        bend.utc = bend.utc.plus(5_000_000);
    }
    let common = CommonClock::between(&here, &there).unwrap();
    assert_eq!(common.outliers(), 3, "{common:?}");
    let mapped =
        |common: CommonClock| common.to_second(here.frames(), here.ticks(utc(200 * S)), there.frames());
    assert_eq!(mapped(common), mapped(quiet));
    assert!(common.disagreement_ns() >= 4_000_000, "{common:?}: not hidden");
}

/// Two controllers that happen to count alike: their crystals drift apart, and the last seconds decide, not the minutes
/// before.
#[test]
fn frames_that_run_apart_are_noticed_within_seconds() {
    let first = Simulated { ppm: 40.0, ..EXACT };
    let second = Simulated { ppm: -40.0, frames_ppm: 10.0, ..EXACT };
    let known_ns = |seconds: i64| {
        let map = |device: &Simulated| follow(device, seconds, |_| (100_000, 200_000), all_marks).0;
        let (here, there) = (map(&first), map(&second));
        let unsure = |map: &ClockMap| map.report().uncertainty_ns.unwrap();
        (CommonClock::between(&here, &there), 500_000 + unsure(&here) + unsure(&there))
    };
    let mut noticed = None;
    for seconds in (20..250).step_by(3) {
        let (common, known_ns) = known_ns(seconds);
        // 10 µs a second.
        let apart_ns = seconds * 10_000;
        if let Err(reason) = common {
            assert!(matches!(reason, NotCommon::Controllers { .. }), "{reason}");
            assert!(apart_ns > known_ns, "at {seconds} s: {apart_ns} of {known_ns} ns");
            noticed = noticed.or(Some((seconds, apart_ns - known_ns)));
        } else {
            assert_eq!(noticed, None, "at {seconds} s");
        }
    }
    let (seconds, late_ns) = noticed.expect("noticed");
    assert!(late_ns < 100_000, "only at {seconds} s, {late_ns} ns beyond what is known");
}
