//! The collector as a whole.

use super::*;
use cantap_can::{BusErrorKind, ErrorState, LossStage};
use cantap_trace::{Direction, TraceEvent};

fn at(time_us: i64, channel: u8, event: TraceEvent) -> TraceRecord {
    TraceRecord { time_ns: time_us * 1000, device_ns: None, channel, event }
}

fn frame(time_us: i64, channel: u8, text: &str) -> TraceRecord {
    let frame = text.parse().unwrap();
    at(time_us, channel, TraceEvent::Frame { frame, direction: Direction::Rx, late: false })
}

fn at_1_mbit() -> Statistics {
    Statistics::new(Options { bitrate_bps: Some(1_000_000), ..Options::default() }).unwrap()
}

#[test]
fn the_golden_burst_of_ten_frames_agrees() {
    let mut statistics = at_1_mbit();
    // ID 0, DLC 1, data 0x55: 58 µs per frame.
    for n in 0..10 {
        statistics.push(&frame(n * 58, 1, "000#55"));
    }
    let summary = statistics.summary();
    let channel = &summary.channels[0];
    assert_eq!((channel.bits, channel.bus_load_pct), (580, Some(100.0)));
    assert!((channel.bits_per_s - 1e6).abs() < 1e-6);
    assert!((channel.frames_per_s - 1e6 / 58.0).abs() < 1e-6);
}

#[test]
fn a_loss_counts_by_stage_and_interrupts_load_and_period() {
    let mut statistics = at_1_mbit();
    statistics.push(&frame(0, 1, "000#55"));
    statistics.push(&frame(116, 1, "000#55"));
    statistics.push(&at(
        5000,
        1,
        TraceEvent::Lost { stage: Some(LossStage::Queue), count: 80, at_least: false },
    ));
    statistics.push(&at(5000, 1, TraceEvent::Lost { stage: None, count: 3, at_least: true }));
    statistics.push(&frame(5058, 1, "000#55"));
    statistics.push(&frame(5174, 1, "000#55"));
    let summary = statistics.summary();
    let channel = &summary.channels[0];
    assert_eq!((summary.lost, channel.lost.queue, channel.lost.unknown, channel.lost.gaps), (83, 80, 3, 2));
    assert!(channel.lost.at_least);
    assert_eq!(channel.bus_load_pct, Some(50.0));
    assert_eq!(channel.ids[0].period_max_ms, Some(0.116));
}

#[test]
fn errors_and_states_are_counted_by_kind() {
    let mut statistics = at_1_mbit();
    let error = TraceEvent::BusError { kind: Some(BusErrorKind::Stuff), counters: Some((0, 9)) };
    statistics.push(&at(0, 2, error));
    statistics.push(&at(1, 2, TraceEvent::ErrorsSuppressed { count: 41 }));
    statistics.push(&at(2, 2, TraceEvent::State { state: ErrorState::Passive, counters: None }));
    let summary = statistics.summary();
    let channel = &summary.channels[0];
    assert_eq!((channel.channel, channel.errors.total, channel.errors.stuff), (2, 42, 1));
    assert_eq!((channel.state, channel.error_counters), (Some("passive"), Some((0, 9))));
    assert_eq!(channel.bus_load_pct, None);
}

#[test]
fn each_channel_has_its_own_bit_rate_and_shares_the_window_grid() {
    let options = Options {
        bitrate_bps: Some(1_000_000),
        channel_bitrate_bps: vec![(2, 500_000)],
        window: Duration::from_millis(1),
        ..Options::default()
    };
    let mut statistics = Statistics::new(options).unwrap();
    let mut starts = Vec::new();
    for n in 0..20 {
        statistics.push_with(&frame(55 + n * 116, 1, "000#55"), |window| starts.push(window.start_ns));
        statistics.push_with(&frame(60 + n * 116, 2, "000#55"), |window| starts.push(window.start_ns));
    }
    assert_eq!(starts, [0, 0, 1_000_000, 1_000_000]);
    let loads: Vec<_> = statistics.summary().channels.iter().map(|channel| channel.bus_load_pct).collect();
    assert_eq!(loads, [Some(50.0), Some(100.0)]);
}

#[test]
fn options_that_cannot_work_are_refused_with_the_reason() {
    let slow = Options { bitrate_bps: Some(10_000), window: Duration::from_millis(10), ..Options::default() };
    let reason = Statistics::new(slow).unwrap_err();
    assert_eq!(reason, BadOptions::WindowTooShort { bitrate_bps: 10_000, shortest_us: 16_000 });
    let zero = Options { channel_bitrate_bps: vec![(1, 0)], ..Options::default() };
    assert_eq!(Statistics::new(zero).unwrap_err(), BadOptions::ZeroBitrate);
}

#[test]
fn an_interruption_counts_for_neither_load_nor_period() {
    let mut statistics = at_1_mbit();
    for time_us in [0, 116, 232] {
        statistics.push(&frame(time_us, 1, "000#55"));
    }
    statistics.interrupt();
    for time_us in [900_000, 900_116] {
        statistics.push(&frame(time_us, 1, "000#55"));
    }
    let channel = &statistics.summary().channels[0];
    assert_eq!((channel.bus_load_pct, channel.ids[0].period_max_ms), (Some(50.0), Some(0.116)));
    assert_eq!(channel.lost.total, 0);
}

#[test]
fn no_window_and_no_rate_spans_an_interruption() {
    let mut statistics = at_1_mbit();
    let mut windows = Vec::new();
    let second = |statistics: &mut Statistics, second: i64, windows: &mut Vec<Window>| {
        for n in 0..10 {
            let record = frame(second * 1_000_000 + n * 100_000, 1, "000#55");
            statistics.push_with(&record, |window| windows.push(*window));
        }
    };
    for n in 0..3 {
        second(&mut statistics, n, &mut windows);
    }
    statistics.interrupt();
    // Time that passes while interrupted makes no empty windows.
    statistics.advance_with(50_000_000_000, |window| windows.push(*window));
    for n in 100..103 {
        second(&mut statistics, n, &mut windows);
    }
    statistics.finish_with(|window| windows.push(*window));
    assert!(windows.iter().all(|window| window.frames >= 9), "{windows:?}");
    let channel = &statistics.channels()[0];
    assert!((channel.frames_per_s() - 10.0).abs() < 0.5, "{}", channel.frames_per_s());
    assert!(channel.window_least_and_mean_pct().unwrap().0 > 0.05);
    // Interrupted and never resumed.
    statistics.interrupt();
    statistics.finish_with(|window| panic!("{window:?}"));
}

#[test]
fn time_that_comes_late_without_a_record_changes_nothing() {
    let mut statistics = at_1_mbit();
    let mut windows = 0;
    for second in 0..5 {
        statistics.push_with(&frame(second * 1_000_000, 1, "000#55"), |_| windows += 1);
        statistics.advance_with(second * 1_000_000_000 - 3_000_000_000, |_| windows += 1);
    }
    assert_eq!(windows, 4);
    statistics.advance_with(9_500_000_000, |_| windows += 1);
    assert_eq!(windows, 8);
}

/// Files may contain anything.
#[test]
fn no_time_however_wild_makes_it_panic() {
    let mut statistics = at_1_mbit();
    for time_ns in [0, i64::MAX, i64::MIN, -1, i64::MAX - 1, i64::MIN + 1, 5_000_000_000, 0] {
        statistics.push(&TraceRecord { time_ns, ..frame(0, 1, "000#55") });
        statistics.push(&TraceRecord { time_ns, ..frame(0, 200, "1FFFFFFF#R8") });
    }
    statistics.finish();
    assert_eq!(statistics.summary().frames, 16);
    // Nor any count.
    for event in [
        TraceEvent::ErrorsSuppressed { count: u32::MAX },
        TraceEvent::Lost { stage: None, count: u32::MAX, at_least: true },
    ] {
        for time_us in 0..20_000 {
            statistics.push(&at(time_us, 3, event));
        }
    }
    statistics.push(&frame(20_000, 3, "000#55"));
    statistics.finish();
}

#[test]
fn an_empty_trace_has_an_empty_summary() {
    let mut statistics = at_1_mbit();
    statistics.finish();
    let summary = statistics.summary();
    assert_eq!((summary.frames, summary.first_s, summary.channels.len()), (0, None, 0));
    assert_eq!(statistics.last_ns(), None);
}

#[test]
fn a_channel_of_which_frames_are_not_wholly_known_has_a_bit_rate_and_no_load() {
    let options = Options { bitrate_bps: Some(1_000_000), without_load: vec![2], ..Options::default() };
    let mut statistics = Statistics::new(options).unwrap();
    let mut loads = Vec::new();
    for n in 0..60 {
        let record = frame(n * 50_000, n as u8 % 2 + 1, "123#00");
        statistics.push_with(&record, |window| loads.push((window.channel, window.load_pct.is_some())));
    }
    assert!(loads.contains(&(1, true)) && loads.contains(&(2, false)), "{loads:?}");
    assert!(!loads.contains(&(2, true)), "{loads:?}");
    assert!(statistics.channels().iter().all(|channel| channel.bitrate_bps == Some(1_000_000)));
    let summary = statistics.summary();
    let known: Vec<bool> = summary.channels.iter().map(|channel| channel.bus_load_pct.is_some()).collect();
    assert_eq!(known, [true, false]);
}

/// Whole seconds, as some loggers stamp: 100 frames share each stamp, and of ten windows of a tenth of a second nine
/// are empty.
#[test]
fn stamps_coarser_than_the_frames_are_noticed() {
    let of = |window: Duration, step_us: i64| {
        let options = Options { bitrate_bps: Some(500_000), window, ..Options::default() };
        let mut statistics = Statistics::new(options).unwrap();
        for n in 0..1000i64 {
            statistics.push(&frame(n * 10_000 / step_us * step_us, 1, "123#1122334455667788"));
        }
        statistics.summary().channels.remove(0)
    };
    let tenths = of(Duration::from_millis(100), 1_000_000);
    assert_eq!(tenths.stamp_step_s, Some(1.0));
    let load = tenths.load.unwrap();
    assert_eq!((load.window_min_pct, load.window_mean_pct, load.window_max_pct), (None, None, None));
    // Windows of several steps are unaffected.
    let longer = of(Duration::from_secs(2), 1_000_000);
    assert_eq!(longer.stamp_step_s, Some(1.0));
    assert!(longer.load.unwrap().window_mean_pct.is_some());
    let fine = of(Duration::from_millis(100), 10_000);
    assert_eq!(fine.stamp_step_s, None);
    assert!(fine.load.unwrap().window_mean_pct.is_some());
}

/// A log whose stamps went back thousands of times once lasted as long as all ways forward together, and its bus was nearly idle.
#[test]
fn stamps_out_of_order_add_no_time_and_a_clock_that_is_set_back_does() {
    let mut statistics = at_1_mbit();
    for n in 0..100 {
        statistics.push(&frame(10_001_000 + n * 1000, 1, "123#"));
        statistics.push(&frame(10_000_200 + n * 1000, 1, "124#"));
    }
    let duration_s = |statistics: &Statistics| statistics.summary().channels[0].duration_s;
    assert!((duration_s(&statistics) - 0.099).abs() < 1e-9, "{}", duration_s(&statistics));
    statistics.push(&frame(5_000_000, 1, "123#"));
    statistics.push(&frame(5_500_000, 1, "123#"));
    assert!((duration_s(&statistics) - 0.599).abs() < 1e-9, "{}", duration_s(&statistics));
}

/// Times since 1970 have more digits than a float.
#[test]
fn the_first_and_last_time_are_told_to_the_nanosecond() {
    let mut statistics = at_1_mbit();
    let first = frame(0, 1, "123#");
    statistics.push(&TraceRecord { time_ns: 1_800_000_000_123_456_789, ..first });
    statistics.push(&TraceRecord { time_ns: 1_800_000_001_123_456_788, ..first });
    let summary = statistics.summary();
    assert_eq!(
        (summary.first_ns, summary.last_ns),
        (Some(1_800_000_000_123_456_789), Some(1_800_000_001_123_456_788))
    );
    let nearest: f64 = "1800000000.123456789".parse().unwrap();
    assert!((summary.first_s.unwrap() - nearest).abs() <= 2.5e-7, "{:?}", summary.first_s);
}

#[test]
fn a_bus_that_stopped_has_its_load_over_a_part_of_what_was_watched() {
    let mut statistics =
        Statistics::new(Options { bitrate_bps: Some(500_000), ..Options::default() }).unwrap();
    for n in 0..11 {
        statistics.push(&frame(n * 200_000, 1, "123#11"));
    }
    let summary = statistics.summary();
    assert!(!is_of_a_part(summary.channels[0].duration_s, summary.observed_s), "{}", summary.observed_s);
    // Nothing came for eight seconds.
    statistics.advance_with(10_000_000_000, |_| {});
    let summary = statistics.summary();
    assert!((summary.channels[0].duration_s - 2.0).abs() < 1e-9);
    assert!((summary.observed_s - 10.0).abs() < 0.001, "{}", summary.observed_s);
    assert!(is_of_a_part(summary.channels[0].duration_s, summary.observed_s));
    assert!(!is_of_a_part(0.0, 10.0), "there is no load of no time");
}

#[test]
fn a_bit_rate_that_the_trace_says_is_known_as_such() {
    let mut statistics = Statistics::new(Options::default()).unwrap();
    statistics.learn_bitrate(1, 500_000);
    statistics.push(&frame(0, 1, "123#11"));
    let channel = &statistics.summary().channels[0];
    assert_eq!((channel.bitrate, channel.bitrate_from_trace), (Some(500_000), true));
    let mut given = Statistics::new(Options { bitrate_bps: Some(250_000), ..Options::default() }).unwrap();
    given.learn_bitrate(1, 500_000);
    given.push(&frame(0, 1, "123#11"));
    let channel = &given.summary().channels[0];
    assert_eq!((channel.bitrate, channel.bitrate_from_trace), (Some(250_000), false));
}
