use cantap_can::Frame;
use cantap_trace::{TraceEvent, TraceRecord};
use proptest::prelude::*;

use super::tests::{Clock, bus, heard, record};
use super::*;

/// On one computer, as two devices' clocks are when they are placed there: 40 µs late, with an error of 20 µs.
const NEAR: Clock = Clock { ahead_ns: 40_000, ppm: 0.0, jitter_ns: 20_000 };

fn without(records: &[TraceRecord], lost: impl Fn(usize) -> bool) -> Vec<TraceRecord> {
    let kept = records.iter().enumerate().filter(|(at, _)| !lost(*at));
    kept.map(|(_, record)| *record).collect()
}

/// What each missed, and what each has more often.
fn missed_and_surplus(found: &Comparison) -> ([u64; 2], [u64; 2]) {
    (found.sides.map(|side| side.missed), found.sides.map(|side| side.surplus))
}

/// Every frame is in exactly one place of the result.
fn assert_counted(found: &Comparison, records: [&[TraceRecord]; 2]) {
    for (side, records) in records.into_iter().enumerate() {
        let Side { surplus, before, after, other_bus, .. } = found.sides[side];
        let counted = found.both + found.sides[1 - side].missed + surplus + before + after + other_bus;
        assert_eq!(counted, records.len() as u64, "{found:?}");
    }
}

fn compared(first: &[TraceRecord], second: &[TraceRecord]) -> Comparison {
    let found = compare(first, second).unwrap();
    assert_counted(&found, [first, second]);
    found
}

#[test]
fn one_that_loses_every_tenth_frame_missed_exactly_those() {
    let bus = bus(5_000, 21);
    let second = heard(&without(&bus, |at| at % 10 == 5), 1, NEAR, 22);
    let found = compared(&bus, &second);
    assert_eq!(missed_and_surplus(&found), ([0, 500], [0, 0]), "{found:?}");
    assert_eq!((found.both, found.ambiguous, found.out_of_order), (4_500, 0, 0));
    assert!(found.differences.unwrap().max_ns < 25_000, "{found:?}");
}

#[test]
fn one_that_has_only_every_other_frame_is_still_compared() {
    let bus = bus(5_000, 23);
    let second = heard(&without(&bus, |at| at % 2 == 1), 1, NEAR, 24);
    let found = compared(&bus, &second);
    assert_eq!(missed_and_surplus(&found), ([0, 2_499], [0, 0]), "{found:?}");
}

#[test]
fn one_that_hands_frames_over_twice_is_not_taken_for_another_that_missed_them() {
    let bus = bus(3_000, 25);
    let doubled = |share: usize| {
        let twice = |(at, record)| std::iter::repeat_n(record, 1 + usize::from(at % share == share / 2));
        bus.iter().enumerate().flat_map(move |(at, record)| twice((at, *record))).collect::<Vec<_>>()
    };
    for share in [1, 10] {
        let second = heard(&doubled(share), 1, Clock { jitter_ns: 0, ..NEAR }, 0);
        let found = compared(&bus, &second);
        assert_eq!(missed_and_surplus(&found), ([0, 0], [0, 3_000 / share as u64]), "{share}: {found:?}");
        assert_eq!(found.ambiguous, 3_000 / share as u64);
        // Nothing is said of stamps of which nobody knows whose they are.
        assert_eq!(found.differences.is_none(), share == 1);
    }
}

#[test]
fn a_clock_that_gains_200_ppm_has_that_drift_and_no_jitter() {
    let bus = bus(10_000, 27);
    let second = heard(&bus, 1, Clock { ppm: 200.0, ..NEAR }, 28);
    let found = compared(&bus, &second);
    assert!((-found.map.drift_ppm() - 200.0).abs() < 5.0, "{}", found.map.drift_ppm());
    assert_eq!(missed_and_surplus(&found), ([0, 0], [0, 0]));
    assert!(found.differences.unwrap().p99_ns < 25_000, "{found:?}");
}

#[test]
fn a_clock_that_jumps_makes_no_frame_missing() {
    let bus = bus(10_000, 29);
    for jump_ns in [300_000_000, 3_000_000_000] {
        let mut second = heard(&bus, 1, NEAR, 30);
        second[5_000..].iter_mut().for_each(|record| record.time_ns += jump_ns);
        let found = compared(&bus, &second);
        assert_eq!(missed_and_surplus(&found), ([0, 0], [0, 0]), "{jump_ns}: {found:?}");
        assert_eq!(found.map.steps(), 1, "{jump_ns}");
    }
}

#[test]
fn one_that_stalls_is_late_and_has_missed_nothing() {
    let bus = bus(10_000, 31);
    let mut second = heard(&bus, 1, NEAR, 32);
    // 150 frames arrive together, 75 ms after the first of them was on the bus.
    let end_ns = second[5_150].time_ns;
    second[5_000..5_150].iter_mut().for_each(|record| record.time_ns = end_ns);
    let found = compared(&bus, &second);
    assert_eq!((missed_and_surplus(&found), found.out_of_order), (([0, 0], [0, 0]), 0), "{found:?}");
    assert!(found.differences.unwrap().max_ns > 50_000_000, "{found:?}");
}

/// One frame in ten never changes, as a switch that nobody touches.
fn bus_with_constants(count: usize, seed: u64) -> Vec<TraceRecord> {
    let mut bus = bus(count, seed);
    for at in (0..count).step_by(10) {
        bus[at].event = record(0, 1, 0x200, 0).event;
    }
    bus
}

#[test]
fn a_frame_that_never_changes_is_missed_where_it_is_missing() {
    let bus = bus_with_constants(5_000, 33);
    let second = heard(&without(&bus, |at| at == 2_000), 1, NEAR, 34);
    let found = compared(&bus, &second);
    assert_eq!((missed_and_surplus(&found), found.out_of_order), (([0, 1], [0, 0]), 0), "{found:?}");
    assert_eq!(found.ambiguous, 0);
    assert!(found.differences.unwrap().max_ns < 25_000, "{found:?}");
}

#[test]
fn equal_frames_in_a_burst_are_counted_and_not_guessed() {
    let mut bus = bus(5_000, 35);
    // Four at a time, 60 µs apart; stamps are only good to 400 µs.
    for at in (100..4_900).step_by(100) {
        let begin_ns = bus[at].time_ns;
        for number in 0..4 {
            bus[at + number] = record(begin_ns + number as i64 * 60_000, 1, 0x200, 0);
        }
    }
    let second =
        heard(&without(&bus, |at| at == 2_001), 1, Clock { ahead_ns: 0, ppm: 0.0, jitter_ns: 400_000 }, 36);
    let found = compared(&bus, &second);
    assert_eq!(missed_and_surplus(&found), ([0, 0], [1, 0]), "{found:?}");
    assert_eq!(found.ambiguous, 48 * 4 - 1);
    assert!(found.differences.unwrap().max_ns < 450_000, "{found:?}");
}

#[test]
fn what_changes_places_is_out_of_order_and_not_missing() {
    let bus = bus(2_000, 37);
    let mut second = heard(&bus, 1, Clock { jitter_ns: 0, ..NEAR }, 0);
    for at in [500, 1_500] {
        let (one, next) = (second[at].event, second[at + 1].event);
        (second[at].event, second[at + 1].event) = (next, one);
    }
    let found = compared(&bus, &second);
    assert_eq!((missed_and_surplus(&found), found.out_of_order), (([0, 0], [0, 0]), 2), "{found:?}");
}

#[test]
fn one_that_begins_later_and_falls_silent_earlier_is_compared_in_between() {
    let bus = bus(10_000, 39);
    let second = heard(&bus[1_000..6_000], 1, NEAR, 40);
    let found = compared(&bus, &second);
    let [first, second] = found.sides;
    assert_eq!((first.before, first.after, second.before, second.after), (1_000, 4_000, 0, 0));
    assert!((1_900_000_000..2_100_000_000).contains(&first.after_ns), "{found:?}");
    assert_eq!(missed_and_surplus(&found), ([0, 0], [0, 0]));
}

/// The same digits are another frame with 29 bits, or as a remote frame.
#[test]
fn identifiers_of_29_bits_and_remote_frames_are_their_own() {
    let mut bus = bus(3_000, 41);
    let event = |text: &str| TraceEvent::Frame {
        frame: text.parse::<Frame>().unwrap().into(),
        direction: cantap_trace::Direction::Rx,
        late: false,
    };
    bus[1_000].event = event("123#");
    bus[2_000].event = event("00000123#R8");
    let mut second = heard(&bus, 1, NEAR, 42);
    assert_eq!(missed_and_surplus(&compared(&bus, &second)), ([0, 0], [0, 0]));
    second[1_000].event = event("00000123#");
    second[2_000].event = event("00000123#R4");
    let found = compared(&bus, &second);
    assert_eq!(missed_and_surplus(&found), ([2, 2], [0, 0]));
    assert_eq!(found.sides.map(|side| side.missed_remote), [1, 1]);
}

#[test]
fn a_second_bus_that_only_one_has_is_counted_apart() {
    let one = bus(3_000, 43);
    let mut first = one.clone();
    first.extend(heard(&bus(700, 44), 2, NEAR, 45));
    first.sort_by_key(|record| record.time_ns);
    let second = heard(&one, 2, NEAR, 46);
    let found = compared(&first, &second);
    assert_eq!((found.channels.as_slice(), found.sides[0].other_bus), ([(1, 2)].as_slice(), 700));
}

#[test]
fn stamps_that_are_only_bounds_are_compared() {
    let bus = bus(3_000, 47);
    let mut second = heard(&bus, 1, NEAR, 48);
    for record in &mut second {
        if let TraceEvent::Frame { late, .. } = &mut record.event {
            *late = true;
        }
    }
    assert_eq!(compared(&bus, &second).both, 3_000);
}

#[test]
fn different_buses_and_traffic_that_repeats_itself_are_refused() {
    let refused = |first: &[TraceRecord], second: &[TraceRecord]| compare(first, second).unwrap_err();
    assert_eq!(refused(&bus(3_000, 49), &bus(3_000, 50)), AlignError::NothingInCommon);
    let cycle: Vec<_> = (0..3_000).map(|at| record(at * 1_000_000, 1, 0x100 + (at % 10) as u16, 0)).collect();
    assert_eq!(refused(&cycle, &cycle[3..]), AlignError::NothingInCommon);
    assert_eq!(refused(&cycle, &[]), AlignError::NothingInCommon);
}

proptest! {
    /// Whatever the records, each frame is counted in one place, or the comparison is refused.
    #[test]
    fn every_frame_is_counted_once(
        lists in prop::array::uniform2(prop::collection::vec((-2_000_000_000..2_000_000_000_i64, 1_u8..4, 0_u64..40), 0..200)),
        shared in prop::collection::vec((0..2_000_000_000_i64, 1_u8..3, 0_u64..400), 0..100),
    ) {
        let [first, second] = lists.map(|own| {
            let mut records: Vec<_> = own.iter().chain(&shared).map(|&(time, channel, content)| record(time, channel, 0x123, content)).collect();
            records.sort_by_key(|record| record.time_ns);
            records
        });
        if let Ok(found) = compare(&first, &second) {
            assert_counted(&found, [&first, &second]);
        }
    }

    #[test]
    fn no_times_are_too_far_apart(times in prop::collection::vec(any::<i64>(), 0..100)) {
        let records: Vec<_> =
            times.iter().enumerate().map(|(at, &time)| record(time / 4, 1, 0x123, at as u64)).collect();
        let _ = compare(&records, &records);
    }
}
