use cantap_can::{Frame, Id};
use proptest::prelude::*;

use super::*;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

/// A frame on a bus with a few identifiers; `content` is what changes.
pub(super) fn record(time_ns: i64, channel: u8, id: u16, content: u64) -> TraceRecord {
    let frame = Frame::data_frame(Id::standard(id.into()).unwrap(), &content.to_le_bytes()).unwrap();
    TraceRecord {
        time_ns,
        device_ns: None,
        channel,
        event: TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false },
    }
}

/// A second clock: with a different setting and rate, and read with an error of up to `jitter_ns`.
#[derive(Clone, Copy)]
pub(super) struct Clock {
    pub ahead_ns: i64,
    pub ppm: f64,
    pub jitter_ns: i64,
}

impl Clock {
    fn read(&self, true_ns: i64, random: &mut fastrand::Rng) -> i64 {
        let gained = (true_ns as f64 * self.ppm * 1e-6).round() as i64;
        true_ns + gained + self.ahead_ns + random.i64(0..=self.jitter_ns)
    }
}

/// `count` frames, 500 µs apart on average, whose content never repeats.
pub(super) fn bus(count: usize, seed: u64) -> Vec<TraceRecord> {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut time_ns = 1_700_000_000_000_000_000;
    (0..count)
        .map(|_| {
            time_ns += random.i64(100_000..900_000);
            record(time_ns, 1, random.u16(0x100..0x110), random.u64(..))
        })
        .collect()
}

pub(super) fn heard(records: &[TraceRecord], channel: u8, clock: Clock, seed: u64) -> Vec<TraceRecord> {
    let mut random = fastrand::Rng::with_seed(seed);
    let start = records[0].time_ns;
    records
        .iter()
        .map(|record| TraceRecord {
            time_ns: start + clock.read(record.time_ns - start, &mut random),
            device_ns: None,
            channel,
            event: record.event,
        })
        .collect()
}

fn sketch(records: &[TraceRecord]) -> Sketch {
    let mut sketch = Sketch::new(RUN_LENGTHS[0]);
    for record in records {
        sketch.add(record);
    }
    sketch
}

fn verify(first: &[TraceRecord], second: &[TraceRecord], alignment: &Alignment) -> Agreement {
    let mut verifier = Verifier::new(alignment);
    let mut second = second.iter().map(|record| {
        let time_ns = alignment.map.to_first(record.time_ns);
        TraceRecord { time_ns, ..*record }
    });
    let mut next = second.next();
    for record in first {
        while let Some(other) = next.filter(|other| other.time_ns < record.time_ns) {
            verifier.second(&other);
            next = second.next();
        }
        verifier.first(record);
    }
    for record in next.into_iter().chain(second) {
        verifier.second(&record);
    }
    verifier.finish()
}

pub(super) const CLOCK: Clock = Clock { ahead_ns: -3_600_000_000_000, ppm: 80.0, jitter_ns: 1_000 };

#[test]
fn clocks_an_hour_and_80_ppm_apart_are_set_on_one() {
    let bus = bus(40_000, 1);
    let second = heard(&bus, 3, CLOCK, 2);
    let alignment = align(&sketch(&bus), &sketch(&second)).unwrap();
    assert_eq!(alignment.channels, [(1, 3)]);
    assert!((alignment.map.drift_ppm() + 80.0).abs() < 0.1, "{}", alignment.map.drift_ppm());
    let agreement = verify(&bus, &second, &alignment);
    assert_eq!((agreement.both, agreement.only_first, agreement.only_second), (40_000, 0, 0));
    // The stamps' own error is uniform between 0 and 1 µs, and its mean becomes part of the offset.
    assert!(agreement.median_ns < 300 && agreement.worst_ns < 750, "{agreement:?}");
}

#[test]
fn frames_that_only_one_of_them_has_are_counted() {
    let bus = bus(20_000, 3);
    let mut second = heard(&bus, 1, CLOCK, 4);
    let mut first = bus;
    first.drain(5_000..5_010);
    second.drain(9_000..9_003);
    let alignment = align(&sketch(&first), &sketch(&second)).unwrap();
    let agreement = verify(&first, &second, &alignment);
    assert_eq!((agreement.only_first, agreement.only_second), (3, 10));
}

#[test]
fn a_recorder_that_came_an_hour_later_is_found() {
    let bus = bus(60_000, 5);
    let second = heard(&bus[50_000..], 1, CLOCK, 6);
    let alignment = align(&sketch(&bus[..55_000]), &sketch(&second)).unwrap();
    let agreement = verify(&bus[..55_000], &second, &alignment);
    assert!(agreement.both >= 4_990, "{agreement:?}");
    assert_eq!((agreement.only_first, agreement.only_second), (0, 0));
}

#[test]
fn a_clock_that_is_set_meanwhile_is_followed() {
    let bus = bus(40_000, 7);
    let mut second = heard(&bus, 1, CLOCK, 8);
    second[20_000..].iter_mut().for_each(|record| record.time_ns += 2_500_000_000);
    let alignment = align(&sketch(&bus), &sketch(&second)).unwrap();
    assert_eq!(alignment.map.steps(), 1);
    let agreement = verify(&bus, &second, &alignment);
    assert!(agreement.both > 39_980 && agreement.most_ns < 750, "{agreement:?}");
}

#[test]
fn stamps_of_milliseconds_are_enough() {
    let bus = bus(40_000, 9);
    let mut second = heard(&bus, 1, Clock { jitter_ns: 5_000_000, ..CLOCK }, 10);
    for record in &mut second {
        record.time_ns -= record.time_ns % 1_000_000;
    }
    let alignment = align(&sketch(&bus), &sketch(&second)).unwrap();
    // The stamps are late by 0 to 5 ms, and truncated by half a millisecond on average.
    let off = alignment.map.to_first(second[30_000].time_ns) - bus[30_000].time_ns;
    assert!(off.abs() < 4_000_000, "{off}");
    assert!((alignment.map.drift_ppm() + 80.0).abs() < 50.0, "{}", alignment.map.drift_ppm());
}

#[test]
fn traces_of_different_buses_are_refused() {
    let error = align(&sketch(&bus(10_000, 11)), &sketch(&bus(10_000, 12))).unwrap_err();
    assert_eq!(error, AlignError::NothingInCommon);
}

#[test]
fn traffic_that_repeats_itself_is_refused() {
    let cycle = |count: i64| (0..count).map(|at| record(at * 1_000_000, 1, 0x100 + (at % 10) as u16, 0));
    let records: Vec<_> = cycle(10_000).collect();
    let error = align(&sketch(&records), &sketch(&records[3..])).unwrap_err();
    assert_eq!(error, AlignError::NothingInCommon);
}

#[test]
fn both_buses_of_two_boards_are_paired() {
    let (one, two) = (bus(10_000, 13), bus(10_000, 14));
    let mut first = one.clone();
    first.extend(heard(&two, 2, Clock { ahead_ns: 0, ppm: 0.0, jitter_ns: 0 }, 0));
    first.sort_by_key(|record| record.time_ns);
    // The second board is wired the other way round.
    let mut second = heard(&one, 2, CLOCK, 15);
    second.extend(heard(&two, 1, CLOCK, 16));
    second.sort_by_key(|record| record.time_ns);
    let alignment = align(&sketch(&first), &sketch(&second)).unwrap();
    assert_eq!(alignment.channels, [(1, 2), (2, 1)]);
    let agreement = verify(&first, &second, &alignment);
    assert!(agreement.both > 19_900 && agreement.worst_ns < 750, "{agreement:?}");
}

#[test]
fn stamps_that_are_only_bounds_neither_lead_nor_count() {
    let bus = bus(20_000, 17);
    let mut second = heard(&bus, 1, CLOCK, 18);
    for record in second.iter_mut().step_by(3) {
        record.time_ns += 400_000;
        if let TraceEvent::Frame { late, .. } = &mut record.event {
            *late = true;
        }
    }
    second.sort_by_key(|record| record.time_ns);
    let alignment = align(&sketch(&bus), &sketch(&second)).unwrap();
    let agreement = verify(&bus, &second, &alignment);
    assert!(agreement.worst_ns < 750, "{agreement:?}");
}

#[test]
fn a_long_trace_keeps_only_so_many_runs_and_is_still_found() {
    let bus = bus(700_000, 19);
    let second = heard(&bus[300_000..], 1, CLOCK, 20);
    let (first, second_sketch) = (sketch(&bus), sketch(&second));
    let alignment = align(&first, &second_sketch).unwrap();
    assert!(alignment.moments > 50_000 && alignment.moments < 400_000, "{}", alignment.moments);
    let agreement = verify(&bus, &second, &alignment);
    assert!(agreement.both > 399_900 && agreement.worst_ns < 750, "{agreement:?}");
}

proptest! {
    /// Whatever the records, there is a result or a refusal, and times keep their order of magnitude.
    #[test]
    fn any_records_are_taken(
        times in prop::collection::vec((any::<i64>(), 0_u8..4, 0_u64..3), 0..400),
        probe in any::<i64>(),
    ) {
        let records: Vec<_> =
            times.iter().map(|&(time, channel, content)| record(time / 4, channel, 0x123, content)).collect();
        let mut sketches = [Sketch::new(2), Sketch::new(2)];
        for (at, record) in records.iter().enumerate() {
            sketches[at % 2].add(record);
            sketches[1 - at % 2].add(record);
        }
        if let Ok(alignment) = align(&sketches[0], &sketches[1]) {
            let _ = alignment.map.to_first(probe / 4);
        }
    }
}
