//! Frames as scripts write them to JSON.

use super::super::tests;
use crate::{Format, ReadOptions, TraceReader};

fn as_log(file: &str) -> (String, Vec<String>) {
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Json), "{file}");
    tests::as_log(Format::Json, file)
}

fn counts(file: &str) -> (Vec<(String, u64)>, Vec<String>) {
    let source = std::io::Cursor::new(file.to_owned());
    let mut reader = TraceReader::from_source("test", source, Format::Json, &ReadOptions::default()).unwrap();
    reader.by_ref().count();
    let left_out = reader.left_out().iter().map(|(what, count)| (what.to_owned(), count)).collect();
    (left_out, reader.notes().iter().map(|(what, _)| what.to_owned()).collect())
}

#[test]
fn objects_of_different_programs_are_read_whole() {
    for (file, log) in [
        // A message of python-can with its attributes.
        (
            "{\"timestamp\": 1700000000.5, \"arbitration_id\": 291, \"is_extended_id\": false, \"is_remote_frame\": false, \
             \"is_rx\": true, \"dlc\": 2, \"data\": [17, 34]}\n\
             {\"timestamp\": 1700000000.6, \"arbitration_id\": 419361278, \"is_extended_id\": true, \"is_remote_frame\": false, \
             \"is_rx\": false, \"dlc\": 1, \"data\": [7]}\n\
             {\"timestamp\": 1700000000.7, \"arbitration_id\": 292, \"is_extended_id\": false, \"is_remote_frame\": true, \
             \"is_rx\": true, \"dlc\": 4, \"data\": []}\n",
            "(1700000000.500000) can0 123#1122\n(1700000000.600000) can0 18FEF1FE#07 T\n(1700000000.700000) can0 124#R4\n",
        ),
        // Digits, milliseconds, a channel; names of several objects in one line.
        (
            "{\"ts_ms\":1700000000500,\"id\":\"0x123\",\"channel\":\"can1\",\"data\":\"DE AD\"}{\"ts_ms\":1700000000600,\"id\":\"0x18FEF1FE\",\"channel\":\"can0\",\"data\":\"beef\"}",
            "(1700000000.500000) can1 123#DEAD\n(1700000000.600000) can0 18FEF1FE#BEEF\n",
        ),
        // An array over lines, with a stranger's keys around it.
        (
            "{\n  \"device\": \"logger\",\n  \"bus\": {\"bitrate\": 500000},\n  \"frames\": [\n    {\n      \"time\": 1.5,\n      \"can_id\": \"0x123\",\n      \
             \"data\": [\"0x11\", \"0x22\"]\n    },\n    {\"time\": 1.6, \"can_id\": \"0x124\", \"data\": []}\n  ],\n  \"count\": 2\n}\n",
            "(1.500000) can0 123#1122\n(1.600000) can0 124#\n",
        ),
        // Node's socketcan: two parts of a time, and a buffer; an MQTT bridge's frame inside of a message.
        (
            "{\"ts_sec\":1700000000,\"ts_usec\":500,\"id\":291,\"ext\":false,\"data\":{\"type\":\"Buffer\",\"data\":[1,2]}}\n",
            "(1700000000.000500) can0 123#0102\n",
        ),
        (
            "{\"topic\":\"can/rx\",\"payload\":{\"timestamp\":1.25,\"id\":\"7DF\",\"dlc\":2,\"data\":\"0201\"}}\n",
            "(1.250000) can0 7DF#0201\n",
        ),
        // WiCAN's messages: what stands around the frames is said of each, and `extd` is the driver's word for 29 bits.
        (
            "{\"bus\":\"0\",\"type\":\"rx\",\"ts\":34610,\"frame\":[{\"id\":123,\"dlc\":2,\"rtr\":false,\"extd\":true,\"data\":[7,8]},\
             {\"id\":124,\"dlc\":1,\"rtr\":false,\"extd\":false,\"data\":[9]}]}\n\
             {\"bus\":\"0\",\"type\":\"tx\",\"ts\":34710,\"frame\":[{\"id\":124,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"ts_ms\":34810,\"id\":124,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}\n",
            "(34.610000) can0 0000007B#0708\n(34.610000) can0 07C#09\n(34.710000) can0 07C# T\n(34.810000) can0 07C#\n",
        ),
        // Its stamps are milliseconds of a minute, and begin again; a message may come a little late.
        (
            "{\"bus\":\"0\",\"type\":\"rx\",\"ts\":59990,\"frame\":[{\"id\":1,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"bus\":\"0\",\"type\":\"rx\",\"ts\":10,\"frame\":[{\"id\":2,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"bus\":\"0\",\"type\":\"tx\",\"ts\":59995,\"frame\":[{\"id\":3,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"bus\":\"0\",\"type\":\"rx\",\"ts\":25000,\"frame\":[{\"id\":4,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"bus\":\"0\",\"type\":\"rx\",\"ts\":50000,\"frame\":[{\"id\":5,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
             {\"bus\":\"0\",\"type\":\"rx\",\"ts\":7,\"frame\":[{\"id\":6,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n",
            "(59.990000) can0 001#\n(60.010000) can0 002#\n(59.995000) can0 003# T\n(85.000000) can0 004#\n(110.000000) can0 005#\n\
             (120.007000) can0 006#\n",
        ),
        // `tshark -T ek`: a line about the index before each frame, the time twice, decimal identifiers in texts.
        (
            "{\"index\":{\"_index\":\"packets-2023-11-14\",\"_type\":\"doc\"}}\n\
             {\"timestamp\":\"1700000000500\",\"layers\":{\"frame\":{\"frame_frame_time_epoch\":\"1700000000.500001000\",\"frame_frame_len\":\"10\"},\
             \"can\":{\"can_can_id\":\"291\",\"can_can_flags_xtd\":false,\"can_can_flags_rtr\":false,\"can_can_flags_err\":false,\"can_can_len\":\"2\"},\
             \"data\":{\"data_data_data\":\"11:22\",\"data_data_len\":\"2\"}}}\n\
             {\"index\":{\"_index\":\"packets-2023-11-14\",\"_type\":\"doc\"}}\n\
             {\"timestamp\":\"1700000000600\",\"layers\":{\"frame\":{\"frame_frame_time_epoch\":\"1700000000.600000000\",\"frame_frame_len\":\"9\"},\
             \"can\":{\"can_can_id\":\"419361278\",\"can_can_flags_xtd\":true,\"can_can_flags_rtr\":false,\"can_can_flags_err\":false,\"can_can_len\":\"1\"},\
             \"data\":{\"data_data_data\":\"07\",\"data_data_len\":\"1\"}}}\n\
             {\"timestamp\":\"1700000000700\",\"layers\":{\"frame\":{\"frame_frame_time_epoch\":\"1700000000.700000000\",\"frame_frame_len\":\"8\"},\
             \"can\":{\"can_can_id\":\"2015\",\"can_can_flags_xtd\":false,\"can_can_flags_rtr\":false,\"can_can_flags_err\":false,\"can_can_len\":\"0\"}}}\n",
            "(1700000000.500001) can0 123#1122\n(1700000000.600000) can0 18FEF1FE#07\n(1700000000.700000) can0 7DF#\n",
        ),
        // Our own, with CAN FD.
        (
            "{\"time_s\":1.5,\"channel\":2,\"match\":true,\"id\":\"123\",\"frame\":\"123##10102\"}\n{\"summary\":{\"found\":1}}\n",
            "(1.500000) can1 123##10102\n",
        ),
    ] {
        let (read, issues) = as_log(file);
        assert_eq!((read.as_str(), issues.as_slice()), (log, &[][..]), "{file}");
    }
}

#[test]
fn what_is_no_frame_is_counted_and_what_is_broken_is_named_with_its_line() {
    let file = "{\"ts\": 1.5, \"id\": \"0x123\", \"data\": \"11\"}\n{\"event\": \"start\", \"list\": [1, {\"a\": 2}]}\n\
                {\"ts\": 1.6, \"id\": \"0x123\", \"da\n{\"ts\": 1.7, \"id\": \"0x123\", \"data\": \"12\"\n\
                {\"ts\": 1.8, \"id\": \"0x123\", \"data\": \"13\"}\nrubbish\n{\"ts\": 1.9, \"id\": \"0x123\", \"data\": \"1\"}\n\
                {\"ts\": 2.0, \"id\": \"0x123\", \"data\": \"14\"}\n{\"ts\": 2.1, \"id\": \"0x12";
    let (log, issues) = as_log(file);
    let lines = [
        "(1.500000) can0 123#11\n",
        "(1.800000) can0 123#13\n",
        "(1.900000) can0 123#01\n",
        "(2.000000) can0 123#14\n",
    ];
    assert_eq!(log, lines.concat());
    let lines: Vec<_> =
        issues.iter().map(|issue| issue.split([',', ':']).nth(1).unwrap_or_default().trim()).collect();
    assert_eq!(issues.len(), 4, "{issues:#?}");
    assert_eq!(lines, ["line 3", "line 4", "line 6", "line 9"], "{issues:#?}");
    assert_eq!(counts(file).0, [(super::NO_FRAMES.to_owned(), 1)]);
}

/// As `mosquitto_sub -v` prints messages, with a topic that may have blanks, and with a time if it was asked for.
#[test]
fn objects_behind_a_topic_are_read_and_the_topic_is_reported() {
    let file = "cars/a b/rx {\"ts\": 1.5, \"id\": \"0x123\", \"data\": \"11\"}\n\
                2023-11-14T22:13:20+0100 cars/rx {\"ts\": 1.6, \"id\": \"0x123\", \"data\": \"12\"}\n\
                cars/status online {yes}\n{\"ts\": 1.7, \"id\": \"0x123\", \"data\": \"13\"}\n\
                cars/rx {\n  \"ts\": 1.8, \"id\": \"0x123\", \"data\": \"14\"\n}\n";
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Json));
    let (log, issues) = as_log(file);
    assert_eq!(
        log,
        "(1.500000) can0 123#11\n(1.600000) can0 123#12\n(1.700000) can0 123#13\n(1.800000) can0 123#14\n"
    );
    assert_eq!(issues.len(), 1, "{issues:?}");
    assert!(issues[0].contains("line 3"), "{issues:?}");
    assert!(counts(file).1.contains(&super::TOPICS.to_owned()), "{:?}", counts(file));
    let file = "wican/1/rx {\"bus\":\"0\",\"type\":\"rx\",\"ts\":7,\"frame\":[{\"id\":1,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n\
                wican/1/rx {\"bus\":\"0\",\"type\":\"rx\",\"ts\":9,\"frame\":[{\"id\":2,\"dlc\":0,\"rtr\":false,\"extd\":false,\"data\":[]}]}\n";
    assert_eq!(Format::of_content(file.as_bytes()), Some(Format::Json));
    assert_eq!(as_log(file), ("(0.007000) can0 001#\n(0.009000) can0 002#\n".to_owned(), vec![]));
    assert!(counts(file).1.contains(&super::TOPICS.to_owned()), "{:?}", counts(file));
}

/// A key that only some objects have is no less one of a frame.
#[test]
fn names_that_come_later_count_from_then_on() {
    let file = "{\"ts\": 1.5, \"id\": 291, \"data\": [1]}\n{\"ts\": 1.6, \"id\": 291, \"data\": [], \"rtr\": true, \"dlc\": 3}\n";
    assert_eq!(as_log(file), ("(1.500000) can0 123#01\n(1.600000) can0 123#R3\n".to_owned(), vec![]));
    let file = "{\"ts\": 1.5, \"id\": 291, \"data\": [1], \"bus\": 1}\n{\"ts\": 1.6, \"id\": 419361278, \"data\": [], \"ext\": true}\n\
                {\"ts\": 1.7, \"id\": 419361278, \"data\": []}\n";
    let log = "(1.500000) can1 123#01\n(1.600000) can0 18FEF1FE#\n(1.700000) can0 18FEF1FE#\n";
    assert_eq!(as_log(file), (log.to_owned(), vec![]));
    let many = "{\"ts\": 1.5, \"id\": 291, \"data\": [1]}\n".repeat(20_000);
    let file = format!("{many}{{\"ts\": 1.6, \"id\": 291, \"data\": [], \"rtr\": true, \"dlc\": 3}}\n");
    let (log, issues) = as_log(&file);
    assert_eq!(
        (log.lines().count(), log.lines().last(), issues.len()),
        (20_001, Some("(1.600000) can0 123#R3"), 0)
    );
    assert!(
        counts("{\"id\": \"291\", \"data\": \"01\"}\n").1.iter().any(|note| note.contains("may be decimal"))
    );
}

#[test]
fn a_frame_in_a_long_object_and_columns_by_name_are_read() {
    let frames: Vec<_> = (0..9000)
        .map(|at| format!("{{\"t\": {at}, \"who\": \"0x1{:02X}\", \"what\": \"AA\"}}", at % 256))
        .collect();
    let file = format!("{{\"frames\": [{}], \"end\": {{\"x\": 1}}}}", frames.join(", "));
    let options = ReadOptions {
        format: Some(Format::Json),
        columns: Some("time=t:ms,id=who:hex,data=what".parse().unwrap()),
        ..ReadOptions::default()
    };
    let (records, issues) = tests::read_with(&options, &file);
    assert_eq!((records.len(), issues), (9000, vec![]));
    assert_eq!(tests::write(Format::Candump, &records[8999..]), "(8.999000) can0 127#AA\n");
}

proptest::proptest! {
    #[test]
    fn anything_is_read_to_its_end(text in "[{}\\[\\]\",:0-9a-z\\\\\n ]{0,200}") {
        let (_, _) = tests::as_log(Format::Json, &text);
        let _ = Format::of_content(text.as_bytes());
    }
}
