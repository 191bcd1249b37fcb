//! Scripts that are learnt from a trace: what was put into it is found, and a run of them is like it.

use cantap_can::{Frame, Id};
use cantap_scripts::twin::{Distance, Learner, Model, Observed, Role, Timing, compare};
use cantap_scripts::{Outcome, Script};
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use proptest::prelude::*;

use super::{SECOND_NS, bench, run, run_on, script};

const RATES: [u32; 2] = [500_000; 2];

fn record(at_ns: u64, text: &str) -> TraceRecord {
    of_frame(at_ns, text.parse().unwrap())
}

fn of_frame(at_ns: u64, frame: Frame) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.into(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns: at_ns as i64, device_ns: None, channel: 1, event }
}

fn observe(records: &[TraceRecord]) -> Observed {
    let mut learner = Learner::new(RATES);
    for record in records {
        learner.push(record);
    }
    learner.finish()
}

fn scripts(model: &Model) -> Vec<Script> {
    let twin = script("twin", &model.twin("a trace", &|_, _| None));
    let tester = model.tester("a trace", &|_, _| None).map(|source| script("tester", &source));
    [twin].into_iter().chain(tester).collect()
}

/// Learns from records, plays what was learnt, and compares.
fn round_trip(records: &[TraceRecord]) -> (Model, Vec<Script>, Distance) {
    let trace = observe(records);
    let model = Model::learn(&trace);
    let scripts = scripts(&model);
    let duration_ns = trace.duration_ns.clamp(SECOND_NS / 10, 60 * SECOND_NS);
    let mut bench = bench("load=0", 1);
    bench.duration_ns = duration_ns;
    let (report, played, _) = run_on(&bench, &scripts);
    assert!(report.is_success(), "{report:?}\n{}", scripts[0].source);
    let distance = compare(&model, &trace, &observe(&played), duration_ns, RATES);
    (model, scripts, distance)
}

/// What a sender's data are in the n-th frame.
type Data = fn(u64) -> Vec<u8>;

fn sender(id: u32, period_ns: u64, frames: u64, data: Data) -> Vec<TraceRecord> {
    let id = Id::standard(id).unwrap();
    let at = |number: u64| 1_000_000 + number * period_ns + u64::from(id.raw() / 16 % 16) * 300_000;
    (0..frames).map(|number| of_frame(at(number), Frame::data_frame(id, &data(number)).unwrap())).collect()
}

fn sorted(streams: &[Vec<TraceRecord>]) -> Vec<TraceRecord> {
    let mut all = streams.concat();
    all.sort_by_key(|record| record.time_ns);
    all
}

fn crc_2f(bytes: &[u8]) -> u8 {
    crc(bytes, 0x2F)
}

fn crc_j1850(bytes: &[u8]) -> u8 {
    crc(bytes, 0x1D)
}

/// CRC-8 bit by bit and by itself.
fn crc(bytes: &[u8], polynomial: u8) -> u8 {
    let mut crc = 0xFF_u8;
    for byte in bytes {
        crc ^= byte;
        for _ in 0..8 {
            crc = if crc & 0x80 == 0 { crc << 1 } else { (crc << 1) ^ polynomial };
        }
    }
    !crc
}

#[test]
fn periods_counters_and_checksums_that_were_put_in_are_found_and_played() {
    let plain: Data = |_| vec![1, 2, 3];
    let to_14: Data = |number| {
        let mut data = vec![0, (number % 15) as u8 | 0x50, (number / 7) as u8, (number / 9) as u8];
        data[0] = data[1..].iter().fold(0x5A, |sum, byte| sum ^ byte);
        data
    };
    let with_crc: Data = |number| {
        let mut data = vec![(number % 16) as u8, (number / 5) as u8, (number / 3 % 251) as u8, 0x77];
        data.push(crc_2f(&data));
        data
    };
    // As AUTOSAR's profile 2: a byte of a table for the counter follows the data.
    let profile_2: Data = |number| {
        let counter = number % 16;
        let mut data = vec![counter as u8, (number / 5) as u8, (number * 13 / 4) as u8];
        let crc = crc_2f(&[&data[..], &[(counter * 37 + 11) as u8]].concat());
        data.insert(0, crc);
        data
    };
    // As Honda's: half bytes, with the identifier's; the counter has two bits of the same byte.
    let nibbles: Data = |number| {
        let mut data = vec![(number / 3) as u8, (number * 5 / 7) as u8, ((number % 4) as u8) << 4];
        let sum: u32 = data.iter().map(|byte| u32::from(byte >> 4) + u32::from(byte & 15)).sum();
        data[2] |= (8 - 3 - sum as i32).rem_euclid(16) as u8;
        data
    };
    let little: Data = |number| ((number * 3 + 65_000) as u16).to_le_bytes().to_vec();
    let records = sorted(&[
        sender(0x100, 10_000_000, 1000, plain),
        sender(0x110, 20_000_000, 500, to_14),
        sender(0x120, 10_000_000, 1000, with_crc),
        sender(0x130, 20_000_000, 500, profile_2),
        sender(0x140, 10_000_000, 1000, nibbles),
        sender(0x150, 100_000_000, 100, little),
    ]);
    let (model, scripts, distance) = round_trip(&records);
    let source = &scripts[0].source;
    assert_eq!((scripts.len(), model.streams.len()), (1, 6));
    for (stream, period_ms) in model.streams.iter().zip([10.0, 20.0, 10.0, 20.0, 10.0, 100.0]) {
        let Timing::Periodic { period, until_ns: None } = &stream.timing else { panic!("{stream:?}") };
        assert!((period.mean_ns / 1e6 - period_ms).abs() < 1e-6, "{period:?}");
    }
    for part in [
        "periodic(1, frame(\"100#010203\"), \"10ms\")",
        "counter = (counter + 1) % 15;",
        "data[0] = (xor8(without(data, 0)) ^ 0x5A) & 0xFF;",
        "data[4] = (crc8(without(data, 4), 0x2F, 0xFF, 0xFF)) & 0xFF;",
        "(crc8(without(data, 0) + bytes(\"00\"), 0x2F) ^ constants[counter]) & 0xFF;",
        "data[2] = data[2] | (counter << 4);",
        "(0x05 - nibble_sum(data)) & 0x0F",
        "counter = (counter + 3) % 65536;",
    ] {
        assert!(source.contains(part), "{part} is not in\n{source}");
    }
    assert_eq!(distance.frames[0].abs_diff(distance.frames[1]), 0, "{distance:?}");
    for stream in &distance.streams {
        let is_right = |pct: Option<f64>| pct.is_none_or(|pct| pct >= 100.0);
        assert!(is_right(stream.known_rest_pct), "{stream:?}");
        assert!(
            stream.counters_right_pct.into_iter().chain(stream.checksums_right_pct).all(is_right),
            "{stream:?}"
        );
    }
    let with = |has: fn(&cantap_scripts::twin::StreamDistance) -> bool| {
        distance.streams.iter().filter(|s| has(s)).count()
    };
    assert_eq!(with(|stream| stream.counters_right_pct[1].is_some()), 5);
    assert_eq!(with(|stream| stream.checksums_right_pct[1].is_some()), 4);
}

#[test]
fn jitter_is_measured_and_played() {
    let mut random = 1_u64;
    let mut late = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (random >> 33) % 4_000_000
    };
    let records: Vec<TraceRecord> =
        (0..3000_u64).map(|number| record(number * 20_000_000 + late(), "123#00")).collect();
    let (_, _, distance) = round_trip(&records);
    let [trace, twin] = distance.streams[0].jitter_ns.map(Option::unwrap);
    // Uniform up to 4 ms: the interval of two has 4 ms divided by the root of six.
    assert!(
        (trace - 4e6 / 6_f64.sqrt()).abs() < 50_000.0 && (twin - trace).abs() < 50_000.0,
        "{trace} {twin}"
    );
}

#[test]
fn what_varies_in_no_known_way_has_no_checksum_and_is_played_as_recorded() {
    // The last byte is no checksum of a kind that is looked for, and changes with the counter: both are played as recorded.
    let odd: Data = |number| {
        let counter = number % 16;
        vec![
            counter as u8,
            7,
            (counter * counter * 31 + number / 16 % 3 * 77 + counter * (number / 16 % 3)) as u8,
        ]
    };
    let constant: Data = |number| vec![(number / 100 % 2) as u8, 0, 0xFF];
    let (model, _, distance) = round_trip(&sorted(&[
        sender(0x100, 10_000_000, 2000, odd),
        sender(0x200, 10_000_000, 2000, constant),
    ]));
    assert!(
        model.streams[0].content.checksum.is_none() && model.streams[0].content.counters.is_empty(),
        "{:?}",
        model.streams[0].content
    );
    assert!(model.streams[1].content.checksum.is_none());
    assert!(distance.streams.iter().all(|stream| stream.known_rest_pct == Some(100.0)), "{distance:?}");
}

#[test]
fn a_transfer_with_flow_control_is_answered_by_the_last_two_requests() {
    let mut records = Vec::new();
    for round in 0..20_u64 {
        let at = round * 500_000_000;
        let (did, first) = if round % 2 == 0 { ("F190", "1462F190") } else { ("F187", "1462F187") };
        let middle = if round % 2 == 0 { "214141414141" } else { "214242424242" };
        records.push(record(at, &format!("7E0#0322{did}")));
        records.push(record(at + 3_000_000, &format!("7E8#10{first}4142")));
        records.push(record(at + 4_000_000, "7E0#300000"));
        records.push(record(at + 6_000_000, &format!("7E8#{middle}")));
        records.push(record(at + 8_000_000, "7E8#2243"));
    }
    let (model, scripts, distance) = round_trip(&records);
    assert_eq!(scripts.len(), 2, "{}", scripts[0].source);
    assert_eq!(
        model.streams.iter().map(|stream| stream.role).collect::<Vec<_>>(),
        [Role::Request, Role::Answer]
    );
    assert!(
        distance.apart_pct < 3.0
            && distance.streams.iter().all(|stream| stream.known_rest_pct == Some(100.0)),
        "{distance:?}"
    );
    // Somebody else who asks gets the right one, too.
    let asks = script(
        "asks",
        "fn test_one() { wait(\"3ms\"); send(\"7E0#0322F187\"); expect(\"7E8\", \"10ms\"); send(\"7E0#300000\"); \
         let f = expect(\"7E8\", \"10ms\"); check(f.to_string() == \"7E8#214242424242\", f.to_string()); }",
    );
    let (report, ..) = run(1, &[scripts[0].clone(), asks]);
    assert_eq!(report.tests[0].outcome, Outcome::Passed, "{}", scripts[0].source);
}

#[test]
fn the_virtual_vehicle_has_a_twin() {
    let tester = script(
        "tester",
        "fn test_all() { for round in 0..12 { send(\"7DF#02010C5555555555\"); wait(\"400ms\"); request(\"7E0\", \"7E8\", [0x22, 0xF1, 0x90]); wait(\"600ms\"); } }",
    );
    let (report, records, _) = run_on(&bench("car", 60), &[tester]);
    assert!(report.is_success(), "{report:?}");
    let (model, scripts, distance) = round_trip(&records);
    let checksums = model.streams.iter().filter(|stream| stream.content.checksum.is_some()).count();
    assert!(checksums >= 2 && !model.exchanges.is_empty(), "{checksums}\n{}", scripts[0].source);
    assert!(distance.apart_pct < 2.0, "{distance:?}");
    // What its database says of checksums, and of frames without any.
    let (_, first, _) = run_on(&bench("load=0", 20), &scripts);
    for record in &first {
        let TraceEvent::Frame { frame, .. } = &record.event else { continue };
        let data = frame.data();
        let expected = match (record.channel, frame.id().raw()) {
            (1, 0x0C0 | 0x0D0 | 0x130 | 0x1A1 | 0x1B0 | 0x2A0) => crc_j1850(&data[..7]),
            (1, 0x0B0) => data[..7].iter().fold(0, |sum, byte| sum ^ byte),
            _ => continue,
        };
        assert_eq!(data[7], expected, "{frame}");
    }
    let trip = model.streams.iter().find(|stream| stream.key.id.raw() == 0x400).unwrap();
    assert!(trip.content.checksum.is_none(), "two bytes that change alike are no checksum");
    let airbag = distance.streams.iter().find(|stream| stream.key.id.raw() == 0x2A0).unwrap();
    assert!(airbag.known_pct.unwrap() > 80.0, "{airbag:?}");
    let (_, first, _) = run_on(&bench("load=0", 5), &scripts);
    let (_, again, _) = run_on(&bench("load=0", 5), &scripts);
    assert!(first.len() > 1000 && first == again);
}

/// As J1939's broadcasts in several packets are.
#[test]
fn a_node_does_not_answer_itself() {
    let mut records = Vec::new();
    for round in 0..20_u64 {
        let at = round * 3_000_000_000;
        records.push(record(at, "1CECFF00#20120003FFECFE00"));
        for part in 1..4 {
            records.push(record(at + part * 50_000_000, &format!("1CEBFF00#0{part}57435443414E54")));
        }
    }
    let (model, scripts, _) = round_trip(&records);
    assert!(model.exchanges.is_empty() && scripts.len() == 1, "{}", scripts[0].source);
}

/// A list that is cut off goes on at once: the mean rate stays.
#[test]
fn what_is_not_periodic_and_long_is_played_again_at_its_rate() {
    let mut at = 0;
    let records: Vec<TraceRecord> = (0..2000_u64)
        .map(|number| {
            at += 1_000_000 + number * number * 7919 % 29 * 1_000_000;
            record(at, &format!("123#{number:04X}"))
        })
        .collect();
    let (model, _, distance) = round_trip(&records);
    assert!(matches!(&model.streams[0].timing, Timing::Recorded(list) if list.len() == 500));
    assert!(distance.apart_pct < 5.0, "{distance:?}");
}

/// What nobody planned for: each has scripts in the language that do not end with an error.
#[test]
fn strange_traces_have_scripts_that_run() {
    let mut random = 7_u64;
    let mut next = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        random >> 24
    };
    let fuzz: Vec<TraceRecord> = (0..20_000_u64)
        .map(|number| {
            let data = next().to_le_bytes();
            let frame =
                Frame::from_bus(Id::extended_truncated(next() as u32), next() % 9 == 0, next() as u8, data);
            of_frame(number * 300_000, frame)
        })
        .collect();
    let still: Vec<TraceRecord> =
        (0..9_000).map(|number| record(0, &format!("{:03X}#{:04X}", number % 300, number))).collect();
    let back: Vec<TraceRecord> = (0..500_u64)
        .map(|number| record(900_000_000_000 - number * 700_000_000, &format!("123#{:02X}", number % 256)))
        .collect();
    let lost = |number: u64| TraceRecord {
        time_ns: (number * 10_000_000) as i64,
        device_ns: None,
        channel: 1,
        event: TraceEvent::Lost { stage: None, count: 1, at_least: true },
    };
    let losses: Vec<TraceRecord> =
        (0..500_u64).flat_map(|number| [lost(number), record(number * 10_000_000, "123#00")]).collect();
    let coarse: Vec<TraceRecord> = (0..9000_u64)
        .map(|number| record(number / 3000 * SECOND_NS, &format!("{:03X}#", number % 50)))
        .collect();
    let remote: Vec<TraceRecord> = (0..100_u64)
        .flat_map(|number| {
            [
                record(number * 10_000_000, "123#R4"),
                record(number * 10_000_000 + 300_000, "123#1122334455667788_9"),
            ]
        })
        .collect();
    for (what, records) in [
        ("one frame", vec![record(5, "123#")]),
        ("fuzz", fuzz),
        ("still", still),
        ("back", back),
        ("losses", losses),
        ("coarse", coarse),
        ("remote", remote),
    ] {
        let (model, scripts, _) = round_trip(&records);
        assert!(
            model.streams.len() <= 1024 && scripts[0].source.len() < 4 << 20,
            "{what}: {}",
            scripts[0].source.len()
        );
    }
    let (report, ..) = run(1, &scripts(&Model::learn(&observe(&[]))));
    assert!(report.is_success(), "{report:?}");
}

#[test]
fn identifiers_beyond_the_limit_are_counted_and_memory_is_bounded() {
    let records = (0..1_000_000_u64).map(|number| {
        of_frame(number * 100_000, Frame::data_frame(Id::extended_truncated(number as u32), &[]).unwrap())
    });
    let mut learner = Learner::new(RATES);
    records.for_each(|record| learner.push(&record));
    let trace = learner.finish();
    let model = Model::learn(&trace);
    let counted = trace.left_out.values().sum::<u64>() + model.omitted.1 as u64 + model.streams.len() as u64;
    assert_eq!((trace.streams.len(), counted), (8192, 1_000_000));
    assert!(scripts(&model)[0].tests().is_ok());
}

#[test]
fn names_from_outside_stay_in_their_comment() {
    let records = sender(0x100, 10_000_000, 50, |_| vec![1]);
    let model = Model::learn(&observe(&records));
    let evil = "x\nfail(\"escaped\"); /* \u{1b}[2J";
    let source = model.twin(evil, &|_, _| Some(evil.to_owned()));
    assert!(!source.contains('\u{1b}'));
    let (report, played, _) = run(1, &[script("twin", &source)]);
    assert!(report.is_success() && played.len() > 90, "{report:?}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// A counter and a CRC of any kind, with frames that nobody noticed are missing.
    #[test]
    fn counters_and_crcs_that_were_put_in_are_found(
        seed in any::<u64>(), low in 0_u32..5, width in 3_u32..5, step in 1_u64..4, polynomial in any::<u8>(),
        xor_out in any::<u8>(), place in 0_usize..5, missing in 11_u64..60,
    ) {
        prop_assume!(step % 2 == 1 && polynomial % 2 == 1);
        let low = low.min(8 - width);
        let mut random = seed | 1;
        let mut records = Vec::new();
        for number in 0..400_u64 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
            let counter = (number * step % (1 << width)) as u8;
            let mut data = vec![counter << low, (random >> 40) as u8, (number / 9) as u8, (random >> 48) as u8];
            let crc = data.iter().fold(0_u8, |crc, byte| {
                (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 == 0 { crc << 1 } else { (crc << 1) ^ polynomial })
            });
            data.insert(place.min(4), crc ^ xor_out);
            if number % missing != 3 {
                records.push(of_frame(number * 10_000_000, Frame::data_frame(Id::standard(0x321).unwrap(), &data).unwrap()));
            }
        }
        // Learnt from the first half, it holds in the second.
        let model = Model::learn(&observe(&records[..200]));
        let content = &model.streams[0].content;
        prop_assert_eq!(content.counters.len(), 1, "{:?}", content.counters);
        let counter = content.counters[0];
        prop_assert_eq!((counter.field.width(), counter.modulus as u64, counter.step as u64), (width, 1 << width, step));
        let checksum = content.checksum.as_ref().unwrap();
        for record in &records[200..] {
            let TraceEvent::Frame { frame, .. } = &record.event else { unreachable!() };
            prop_assert!(checksum.is_right(frame.classic().unwrap().padded_data(), 5, Some(&counter)), "{:?}", checksum);
        }
    }
}
