use super::*;
use crate::Format;
use crate::tests::as_log;
use cantap_trace::Direction;

/// An event in a message of one segment.
fn event(mono_ns: u64, kind: u16, flags: u8, pointer: u64, rest: &[u64]) -> Vec<u8> {
    let words =
        [&[0x0001_0002_0000_0000, mono_ns, u64::from(kind) | u64::from(flags) << 16, pointer], rest].concat();
    let table = (words.len() as u64) << 32;
    std::iter::once(table).chain(words).flat_map(u64::to_le_bytes).collect()
}

fn init_data(mono_ns: u64, wall_ns: u64) -> Vec<u8> {
    event(mono_ns, kind::INIT_DATA, 0, 2 << 32, &[0, wall_ns])
}

/// `address`, `src`, data.
type CanData<'a> = (u32, u8, &'a [u8]);

/// Where a list of `CanData` begins, for its pointer: at the next word.
fn can_data_words(frames: &[CanData<'_>]) -> (u64, Vec<u64>) {
    let count = frames.len() as u64;
    let mut words = vec![count << 2 | 1 << 32 | 1 << 48];
    let mut data = Vec::new();
    for (number, (address, src, bytes)) in frames.iter().enumerate() {
        words.push(u64::from(*address) | 0xABCD << 32 | u64::from(*src) << 48);
        let offset = (2 * (frames.len() - number - 1) + data.len()) as u64;
        words.push(1 | offset << 2 | 2 << 32 | (bytes.len() as u64) << 35);
        data.extend(bytes.chunks(8).map(|chunk| {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            u64::from_le_bytes(word)
        }));
    }
    words.extend(data);
    (1 | 7 << 32 | (2 * count) << 35, words)
}

fn can(mono_ns: u64, kind: u16, frames: &[CanData<'_>]) -> Vec<u8> {
    let (pointer, words) = can_data_words(frames);
    event(mono_ns, kind, 0, pointer, &words)
}

fn log(bytes: &[u8]) -> (Vec<String>, Vec<String>) {
    let (text, issues) = as_log(Format::Rlog, bytes);
    (text.lines().map(str::to_owned).collect(), issues)
}

/// A log of three frames, as pycapnp with openpilot's schema reads it.
fn small() -> Vec<u8> {
    let frames: [CanData<'_>; 4] = [
        (0x2E4, 0, &[1, 2, 3, 4, 5]),
        (0x18DA_F110, 129, &[0xFF; 8]),
        (0x123, 4, &[7; 12]),
        (0x2E5, 192, &[1]),
    ];
    [
        init_data(5_000_000_000, 1_410_714_882_000_000_000),
        event(5_000_000_001, 20, 0, 0, &[]),
        can(6_000_000_000, kind::CAN, &frames),
        can(6_500_000_000, kind::SENDCAN, &frames[..1]),
        can(7_000_000_000, kind::CAN, &frames[..1]),
    ]
    .concat()
}

#[test]
fn frames_have_their_bus_and_direction_and_the_time_at_which_the_device_got_them() {
    let bytes = small();
    assert_eq!(Format::of_content(&bytes), Some(Format::Rlog));
    let (lines, issues) = log(&bytes);
    let frames: Vec<_> = lines.iter().filter(|line| line.contains('#')).collect();
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(frames.len(), 4, "{lines:?}");
    for (line, (time, frame)) in frames.iter().zip([
        ("1410714883.0", "can0 2E4#0102030405"),
        ("1410714883.0", "can1 18DAF110#FFFFFFFFFFFFFFFF"),
        ("1410714883.0", "can4 123##0070707070707070707070707"),
        ("1410714884.0", "can0 2E4#0102030405"),
    ]) {
        assert!(line.starts_with(&format!("({time}")) && line.contains(frame), "{line}");
    }
    let (records, _) = crate::tests::read(Format::Rlog, &bytes);
    let directions = [Direction::Rx, Direction::Tx, Direction::Rx, Direction::Rx];
    for (record, expected) in records.iter().zip(directions) {
        let TraceEvent::Frame { direction, late, .. } = record.event else { panic!("{record:?}") };
        assert_eq!((direction, late), (expected, true));
    }
}

#[test]
fn what_is_no_frame_on_the_bus_is_counted_and_a_log_without_a_date_says_so() {
    let notes = |bytes: &[u8]| {
        let source = io::Cursor::new(bytes.to_vec());
        let options = crate::ReadOptions::default();
        let mut reader = crate::TraceReader::from_source("t", source, Format::Rlog, &options).unwrap();
        let times: Vec<_> = reader.by_ref().map(|record| record.unwrap().time_ns).collect();
        let kinds = |kinds: &crate::LeftOut| kinds.iter().collect::<Vec<_>>();
        (times, kinds(reader.notes()), kinds(reader.left_out()))
    };
    let (_, noted, left_out) = notes(&small());
    assert_eq!(noted, [(REQUESTS_TO_SEND, 1)]);
    assert_eq!(left_out, [(REJECTED, 1), (OTHER_EVENTS, 2)]);
    let frames: [CanData<'_>; 1] = [(1, 0, &[])];
    let (pointer, words) = can_data_words(&frames);
    let old = [init_data(1, 0), can(5, kind::CAN, &frames), event(6, kind::CAN, 1, pointer, &words)];
    let (times, noted, _) = notes(&old.concat());
    assert_eq!(times, [5, 6]);
    assert_eq!(noted, [(UNHEALTHY, 1), (NO_DATE, 1)]);
}

/// The list lies in another segment, once behind a pointer to it and once behind two, as a growing event has them.
#[test]
fn a_list_in_another_segment_is_found() {
    let frames: [CanData<'_>; 2] = [(0x100, 0, &[1]), (0x101, 0, &[2, 3])];
    let (pointer, words) = can_data_words(&frames);
    let root = 0x0001_0002_0000_0000;
    let far = |segment: u64, at: u64, double: u64| 2 | double << 2 | at << 3 | segment << 32;
    let message = |segments: &[&[u64]]| {
        let mut bytes = (segments.len() as u32 - 1).to_le_bytes().to_vec();
        for words in segments {
            bytes.extend((words.len() as u32).to_le_bytes());
        }
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes.extend(segments.iter().copied().flatten().flat_map(|word| word.to_le_bytes()));
        bytes
    };
    let single =
        message(&[&[root, 9, u64::from(kind::CAN), far(1, 1, 0)], &[&[0, pointer][..], &words].concat()]);
    let double = message(&[&[root, 9, u64::from(kind::CAN), far(1, 0, 1)], &[far(2, 0, 0), pointer], &words]);
    for bytes in [single, double] {
        let (lines, issues) = log(&bytes);
        assert_eq!(issues, Vec::<String>::new());
        let text = lines.concat();
        assert!(text.contains("100#01") && text.contains("101#0203"), "{text}");
    }
}

#[test]
fn a_cut_log_gives_everything_before_and_says_that_it_was_cut() {
    let bytes = small();
    let whole = log(&bytes).0.len();
    let mut at_ends = 0;
    for len in 1..bytes.len() {
        let (lines, issues) = log(&bytes[..len]);
        assert!(lines.len() < whole && issues.len() <= 1, "{len} {issues:?}");
        at_ends += usize::from(issues.is_empty());
    }
    assert_eq!(at_ends, 4, "only a cut between two events cannot be seen");
}

#[test]
fn damage_costs_an_event_and_no_change_of_a_byte_is_a_panic() {
    let frames: [CanData<'_>; 1] = [(0x111, 0, &[1, 2, 3, 4, 5, 6, 7, 8])];
    let one = can(1, kind::CAN, &frames);
    let many: Vec<u8> = (0..20).flat_map(|_| one.clone()).collect();
    let count = |bytes: &[u8]| {
        let (records, issues) = crate::tests::read(Format::Rlog, bytes);
        (records.len(), issues.len())
    };
    let fifth = 5 * one.len();
    for lie in [0, 3, 9, 1000, u32::MAX] {
        let mut bytes = many.clone();
        bytes[fifth + 4..fifth + 8].copy_from_slice(&u32::to_le_bytes(lie));
        let (records, issues) = count(&bytes);
        assert!(records >= 18 && issues >= 1, "{lie}: {records} {issues}");
    }
    for at in 0..one.len() {
        for change in [1, 0x80, 0xFF] {
            let mut bytes = many.clone();
            bytes[fifth + at] ^= change;
            let (records, _) = count(&bytes);
            assert!((18..=20).contains(&records), "{at}: {records}");
        }
    }
    // A list of four hundred million structs, and one that points to itself.
    for (pointer, word) in [
        (1 | 7 << 32 | u64::from(u32::MAX) << 35, u64::from(u32::MAX)),
        (u64::MAX << 2 | 1 | 7 << 32 | 1 << 35, 0),
    ] {
        let bytes = [event(1, kind::CAN, 0, pointer, &[word]), one.clone()].concat();
        assert_eq!(count(&bytes), (1, 1));
    }
}
