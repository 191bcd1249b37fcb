use cantap_trace::{DeviceNs, Direction, LossStage, TraceEvent, TraceFrame, TraceRecord};
use proptest::prelude::*;

use super::{DelayOptions, Expected, Matching, Outcome};

const MS: i64 = 1_000_000;
const OPTIONS: DelayOptions = DelayOptions { from: 1, to: 2, within_ns: 100 * MS };

/// A frame on a channel, at a time in milliseconds.
fn on(channel: u8, ms: i64, frame: &str) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns: ms * MS, device_ns: None, channel, event }
}

fn lost(channel: u8, ms: i64, stage: LossStage) -> TraceRecord {
    let event = TraceEvent::Lost { stage: Some(stage), count: 3, at_least: false };
    TraceRecord { time_ns: ms * MS, device_ns: None, channel, event }
}

#[allow(clippy::unnecessary_wraps, reason = "as a map is")]
fn unchanged(frame: &TraceFrame) -> Option<Expected> {
    Some(Expected::unchanged(*frame))
}

fn outcome(records: &[TraceRecord], map: impl FnMut(&TraceFrame) -> Option<Expected>) -> Outcome {
    let mut matching = Matching::new(OPTIONS, map);
    for record in records {
        matching.push(record, true);
    }
    matching.finish()
}

/// Something long before and long after, so that neither end explains anything.
fn framed(records: &[TraceRecord]) -> Vec<TraceRecord> {
    [&[on(3, -1000, "7FF#")], records, &[on(3, 10_000, "7FF#")]].concat()
}

fn analyse(records: &[TraceRecord]) -> Outcome {
    outcome(&framed(records), unchanged)
}

#[test]
fn matched_missing_and_extra_frames_are_told_apart() {
    let found = analyse(&[
        on(1, 0, "123#01"),
        on(2, 3, "123#01"),
        on(1, 10, "123#02"),
        on(1, 20, "123#03"),
        on(2, 25, "123#03"),
        on(2, 26, "124#03"),
    ]);
    let total = &found.total;
    assert_eq!((total.matched, total.missing, total.extra, total.undecided.total()), (2, 1, 1, 0));
    let delays = &total.delays;
    assert_eq!(
        (delays.min_ns(), delays.mean_ns(), delays.max_ns()),
        (Some(3_000_000), Some(4e6), Some(5_000_000))
    );
    let ids: Vec<_> =
        found.ids.iter().map(|(id, row)| (id.raw(), row.matched, row.missing, row.extra)).collect();
    assert_eq!(ids, [(0x123, 2, 1, 0), (0x124, 0, 0, 1)]);
    assert_eq!(found.step_ns, Some(1_000_000));
}

/// UTC is corrected while a trace is recorded; the device, 400 ppm fast, measures all the same.
#[test]
fn a_delay_is_the_devices_where_it_stamped_both_frames() {
    let by_device = |record: TraceRecord, ns| TraceRecord { device_ns: DeviceNs::new(ns), ..record };
    let ns = |ms: u64| 9_000_000_000 + ms * 1_000_400;
    let mut records = vec![
        by_device(on(1, 0, "123#01"), ns(0)),
        by_device(on(2, 50, "123#01"), ns(50)),
        by_device(on(1, 100, "123#02"), ns(100)),
        by_device(on(2, 150, "123#02"), ns(150)),
    ];
    let found = analyse(&records).total;
    assert_eq!((found.delays.min_ns(), found.delays.max_ns()), (Some(50_020_000), Some(50_020_000)));
    assert_eq!((found.by_device, found.shortest_repeat_ns), (2, None));
    // Another board stamped the second bus.
    records[1].device_ns = DeviceNs::new(700_000_000);
    records[3].device_ns = None;
    let found = analyse(&records).total;
    assert_eq!((found.delays.min_ns(), found.delays.max_ns()), (Some(50_000_000), Some(50_000_000)));
    assert_eq!(found.by_device, 0);
}

#[test]
fn a_frame_counts_only_within_the_window() {
    let found = analyse(&[on(1, 0, "001#"), on(2, 100, "001#"), on(1, 1000, "001#"), on(2, 1101, "001#")]);
    assert_eq!((found.total.matched, found.total.missing, found.total.extra), (1, 1, 1));
}

/// One of them lost must not shift all that follow.
#[test]
fn a_lost_one_of_equal_frames_is_missing_and_leaves_the_others_their_delays() {
    let mut records = vec![on(1, 0, "001#AA")];
    for ms in (10..1000).step_by(10) {
        records.extend([on(1, ms, "001#AA"), on(2, ms + 2, "001#AA")]);
    }
    let total = analyse(&records).total;
    assert_eq!((total.matched, total.missing, total.extra), (99, 1, 0));
    // Until it is clear that the first is missing, each of the others could be it.
    assert!((19..=22).contains(&total.ambiguous), "{}", total.ambiguous);
    assert_eq!((total.delays.min_ns(), total.delays.max_ns()), (Some(2_000_000), Some(2_000_000)));
    assert_eq!((total.repeated, total.shortest_repeat_ns), (99, Some(10 * MS)));
}

#[test]
fn equal_frames_that_all_arrive_are_paired_in_order() {
    let records =
        [0, 1, 2].map(|ms| on(1, ms, "001#AA")).into_iter().chain([5, 6, 7].map(|ms| on(2, ms, "001#AA")));
    let total = analyse(&records.collect::<Vec<_>>()).total;
    assert_eq!((total.matched, total.ambiguous), (3, 0));
    assert_eq!((total.delays.min_ns(), total.delays.max_ns()), (Some(5_000_000), Some(5_000_000)));
}

/// If a reading of the trace explains every frame, none is missing; but which delay is whose is then unknown.
#[test]
fn equal_frames_that_take_longer_than_they_are_apart_are_not_called_missing() {
    let total = analyse(&[on(1, 0, "001#"), on(1, 90, "001#"), on(2, 95, "001#"), on(2, 185, "001#")]).total;
    assert_eq!((total.matched, total.missing, total.extra, total.ambiguous), (2, 0, 0, 2));
}

#[test]
fn what_the_traces_ends_may_explain_is_undecided() {
    let found =
        outcome(&[on(2, 0, "001#"), on(2, 99, "002#"), on(2, 101, "003#"), on(1, 500, "004#")], unchanged);
    let undecided = found.total.undecided;
    assert_eq!((undecided.start, undecided.end, undecided.loss), (2, 1, 0));
    assert_eq!((found.total.missing, found.total.extra), (0, 1));
}

#[test]
fn what_a_loss_may_explain_is_undecided_but_not_what_the_gateway_lost() {
    let at = |channel, stage| {
        let records = [
            on(1, 0, "005#"),
            on(2, 1, "005#"),
            on(1, 10, "001#"),
            on(2, 11, "002#"),
            lost(channel, 12, stage),
            on(1, 20, "006#"),
            on(2, 21, "006#"),
        ];
        let total = analyse(&records).total;
        (total.missing, total.extra, total.undecided.loss, total.matched)
    };
    assert_eq!(at(2, LossStage::Queue), (0, 1, 1, 2));
    assert_eq!(at(1, LossStage::Controller), (1, 0, 1, 2));
    assert_eq!(at(3, LossStage::Queue), (1, 1, 0, 2));
    assert_eq!(at(2, LossStage::Gateway), (1, 1, 0, 2));
}

/// 123 becomes 456; the lower half of byte 0 is a counter of the gateway's.
fn mapped(frame: &TraceFrame) -> Option<Expected> {
    let text = frame.to_string();
    let frame: TraceFrame = text.strip_prefix("123").map(|rest| format!("456{rest}"))?.parse().unwrap();
    Some(Expected { unknown: [0x0F, 0, 0, 0, 0, 0, 0, 0], period_ns: 50 * MS, ..Expected::unchanged(frame) })
}

#[test]
fn a_map_changes_frames_leaves_bits_open_and_expects_nothing_of_others() {
    let records =
        framed(&[on(1, 0, "123#A001"), on(1, 1, "124#A0"), on(2, 2, "456#A701"), on(2, 3, "456#B701")]);
    let found = outcome(&records, mapped);
    assert_eq!(
        (found.total.matched, found.total.extra, found.total.missing, found.not_expected),
        (1, 1, 0, 1)
    );
}

#[test]
fn a_newer_frame_of_its_rule_within_the_period_replaces_one() {
    let records = [
        on(1, 0, "123#A0"),
        on(1, 10, "123#B0"),
        on(2, 50, "456#B0"),
        on(1, 300, "123#C0"),
        on(1, 400, "123#D0"),
    ];
    let total = outcome(&framed(&records), mapped).total;
    assert_eq!((total.matched, total.replaced, total.missing), (1, 1, 2));
}

#[test]
fn a_trace_that_is_a_little_out_of_order_is_read_all_the_same() {
    let total = analyse(&[on(2, 5, "001#"), on(1, 4, "001#")]).total;
    assert_eq!((total.matched, total.extra, total.delays.min_ns()), (1, 0, Some(1_000_000)));
}

#[test]
fn nothing_is_expected_across_a_clock_that_was_set_back() {
    let found =
        outcome(&[on(1, 5000, "001#"), on(2, 0, "001#"), on(1, 10, "002#"), on(2, 11, "002#")], unchanged);
    assert_eq!((found.breaks, found.total.matched, found.total.undecided.total()), (1, 1, 2));
}

#[test]
fn a_hidden_frame_is_neither_expected_nor_extra_but_can_be_what_another_became() {
    let mut matching = Matching::new(OPTIONS, mapped);
    for (record, counts) in framed(&[on(1, 0, "123#00"), on(2, 2, "456#00"), on(2, 3, "457#00")])
        .iter()
        .zip([true, true, false, false, true])
    {
        matching.push(record, counts);
    }
    let total = matching.finish().total;
    assert_eq!((total.matched, total.extra), (1, 0));
}

#[test]
fn memory_is_bounded_by_the_window() {
    let mut matching = Matching::new(OPTIONS, unchanged);
    for number in 0..50_000 {
        matching.push(&on(1, number, &format!("123#{number:08X}")), true);
        matching.push(&on(2, number, &format!("321#{number:08X}")), true);
        if number % 2 == 0 {
            matching.push(&on(2, number + 1, &format!("123#{number:08X}")), true);
        }
        assert!(matching.remembered() < 1_000, "{number}: {}", matching.remembered());
    }
}

proptest! {
    /// Bursts of equal frames, however they overlap with what comes out, are all found.
    #[test]
    fn bursts_of_equal_frames_are_all_found(
        bursts in prop::collection::vec(prop::collection::vec((0_i64..15, 1_i64..90), 1..10), 1..4),
    ) {
        let (mut records, mut frames) = (Vec::new(), 0);
        for (burst, start) in bursts.iter().zip((0..).step_by(1000)) {
            let (mut now, mut out) = (start, 0);
            for (pause, delay) in burst {
                now += pause;
                out = out.max(now + delay);
                frames += 1;
                records.extend([on(1, now, "001#"), on(2, out, "001#")]);
            }
        }
        records.sort_by_key(|record| (record.time_ns, record.channel));
        let total = analyse(&records).total;
        prop_assert_eq!((total.matched, total.missing, total.extra), (frames, 0, 0));
    }

    /// Whatever is delayed by less than the window is found, with its delay, if no two are alike.
    #[test]
    fn every_delayed_frame_is_found(frames in prop::collection::vec((0_i64..30, 0_i64..90, any::<bool>()), 1..60)) {
        let (mut now, mut records, mut lost, mut sum) = (0, Vec::new(), 0, 0);
        for (number, (pause, delay, passes)) in frames.iter().enumerate() {
            now += pause;
            let text = format!("123#{number:04X}");
            records.push(on(1, now, &text));
            if *passes {
                records.push(on(2, now + delay, &text));
                sum += delay * MS;
            } else {
                lost += 1;
            }
        }
        records.sort_by_key(|record| (record.time_ns, record.channel));
        let total = analyse(&records).total;
        prop_assert_eq!((total.missing, total.extra, total.ambiguous), (lost, 0, 0));
        prop_assert_eq!(total.matched, frames.len() as u64 - lost);
        if total.matched > 0 {
            prop_assert!((total.delays.mean_ns().unwrap() * total.matched as f64 - sum as f64).abs() < 1.0);
        }
    }
}
