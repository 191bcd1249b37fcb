//! Lines as adapters send them and terminals save them.

use super::super::tests;
use crate::{Format, ReadOptions, TraceReader};
use proptest::prelude::*;

/// The frames, what is wrong, and what was counted.
fn read(file: &str) -> (String, Vec<String>, Vec<(&'static str, u64)>) {
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Slcan), "{file}");
    let (log, issues) = tests::as_log(Format::Slcan, file);
    let source = std::io::Cursor::new(file.to_owned());
    let mut reader = TraceReader::from_source("t", source, Format::Slcan, &ReadOptions::default()).unwrap();
    reader.by_ref().for_each(drop);
    let counted = reader.notes().iter().chain(reader.left_out().iter()).collect();
    (log, issues, counted)
}

#[test]
fn frames_of_all_kinds_are_read_whatever_ends_the_lines() {
    let log = "(0.000000) can0 123#0102030405060708\n(0.000000) can0 18FEF100#1A2B\n(0.000000) can0 7FF#R3\n\
               (0.000000) can0 00000001#R\n(0.000000) can0 100#\n(0.000000) can0 100##0000102030405060708090A0B\n\
               (0.000000) can0 18DAF110##111\n";
    for end in ["\r", "\n", "\r\n"] {
        let lines = [
            "t12380102030405060708",
            "T18FEF10021a2b",
            "r7FF3",
            "R000000010",
            "t1000",
            "d1009000102030405060708090A0B",
            "B18DAF110111",
        ];
        let file: String = lines.iter().flat_map(|line| [line, end]).collect();
        let (read, issues, counted) = read(&file);
        assert_eq!((read.as_str(), issues), (log, Vec::new()), "{end:?}");
        assert_eq!(counted, [(super::NO_TIMES, 1)]);
    }
}

#[test]
fn stamps_of_milliseconds_go_on_past_a_minute() {
    let (log, issues, counted) = read("t1230EA5E\rt1230EA5F\rt12300001\rt12300002\r");
    assert_eq!(
        log,
        "(59.998000) can0 123#\n(59.999000) can0 123#\n(60.001000) can0 123#\n(60.002000) can0 123#\n"
    );
    assert_eq!((issues, counted), (vec![], vec![(super::OF_A_MINUTE, 1)]));
    // An adapter that counts in sixteen bits.
    let (log, ..) = read("t1230FFFE\rt12300001\r");
    assert_eq!(log, "(65.534000) can0 123#\n(65.537000) can0 123#\n");
}

#[test]
fn stamps_of_eight_digits_are_microseconds_unless_frames_would_be_closer_than_a_bus_lets_them() {
    let (log, _, counted) = read("t1230FFFFFF00\rt123000000064\r");
    assert_eq!(log, "(4294.967040) can0 123#\n(4294.967396) can0 123#\n");
    assert_eq!(counted, [(super::LONG_US, 1)]);
    let (log, _, counted) = read("t123000000064\rt123000000064\rt123000000065\r");
    assert_eq!(log, "(0.100000) can0 123#\n(0.100000) can0 123#\n(0.101000) can0 123#\n");
    assert_eq!(counted, [(super::LONG_MS, 1)]);
}

#[test]
fn a_terminals_clock_is_the_time_and_reports_are_events() {
    let file = "12:00:00.500 -> V1013\n12:00:00.600 -> t1230\n12:00:00.700 -> e3ooo\n12:00:00.800 -> e1c\n\
                12:00:00.900 -> sp000130\n12:00:01.000 -> e1O\n12:00:01.100 -> \x07t124111\n12:00:01.200 -> z\n";
    let (log, issues, counted) = read(file);
    let frames: Vec<_> = log.lines().filter(|line| !line.starts_with('#')).collect();
    assert!(frames[0].starts_with("(43200.600000) can0 123#"), "{log}");
    assert!(log.contains("(43201.100000) can0 124#11\n"), "{log}");
    let (records, _) = tests::read(Format::Slcan, file);
    let events: Vec<_> = records.iter().map(|record| record.event.to_string()).collect();
    assert_eq!(
        events[1..4],
        ["at least 1 frame lost (unknown)", "bus error: crc", "controller passive, counters 130 / 0"]
    );
    assert_eq!((issues, counted), (vec![], vec![(super::OTHERS, 2), (super::REFUSED, 1)]));
}

#[test]
fn broken_lines_are_named_and_a_cut_one_is_no_frame() {
    let good = "t1230\r".repeat(8);
    let file = format!("{good}t12381122\rt8000\rT200000000\rt1230123\rt12G0\rhello\rt1232AA");
    let (log, issues, _) = read(&file);
    assert_eq!(log.lines().count(), 8, "{log}");
    assert_eq!(issues.len(), 7, "{issues:#?}");
    assert!(issues[0].contains("line 9: expected 8 data bytes"), "{issues:#?}");
    // Whether a stamp is missing shows in the others.
    let (log, issues, _) = read("t12300001\rt12300002\rt1230");
    assert_eq!((log.lines().count(), issues.len()), (2, 1), "{issues:#?}");
    let (log, issues, _) = read("t1230\rt1230\rt1230");
    assert_eq!((log.lines().count(), issues.len()), (3, 0), "{issues:#?}");
}

proptest! {
    #[test]
    fn no_text_ends_the_reader(text in "[tTrRdDbBzesVSO0-9A-Fa-f\r\n\x07 >:-]{0,200}") {
        let _ = Format::of_content(text.as_bytes());
        tests::read(Format::Slcan, &text);
    }
}
