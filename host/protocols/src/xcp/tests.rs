//! Sessions of XCP, as masters and slaves on CAN have them.

use super::*;
use crate::Protocol;
use crate::calibration::Known;
use crate::testing::{at, event_lines, events, found, lost};

const CONNECT: [(f64, &str); 2] = [(0.0, "7F0#FF00"), (1.0, "7F1#FF05C00808000101")];

fn after_connect<'a>(frames: &[(f64, &'a str)]) -> Vec<(f64, &'a str)> {
    CONNECT.iter().chain(frames).copied().collect()
}

fn lines(frames: &[(f64, &str)]) -> Vec<String> {
    event_lines(Xcp::new(Known::default()), &after_connect(frames))[1..].to_vec()
}

fn given() -> Known {
    Known { xcp: vec!["7F0:7F1".parse().unwrap()], ..Known::default() }
}

#[test]
fn connecting_shows_what_the_slave_is() {
    let all = event_lines(Xcp::new(Known::default()), &CONNECT);
    assert_eq!(
        all,
        [
            "xcp 7F0 > 7F1 CONNECT: command 0xFF, mode 0x00 (normal), resources 0x05 (calibration, DAQ), comm_mode_basic 0xC0 \
             (slave block mode, more by GET_COMM_MODE_INFO), max_cto 8, max_dto 8, protocol_version 1, transport_version 1, after 1 ms"
        ]
    );
}

#[test]
fn commands_have_their_parts_and_errors_their_names() {
    let all = lines(&[
        (2.0, "7F0#F402000078563412"),
        (3.0, "7F1#FF3412"),
        (4.0, "7F0#E10004"),
        (5.0, "7F1#FE29"),
        (6.0, "7F0#FC"),
        (7.0, "7F1#FE00"),
        (8.0, "7F1#FD06"),
        (9.0, "7F1#FC01686900"),
        (10.0, "7F0#C2"),
        (11.0, "7F1#FF"),
    ]);
    assert_eq!(
        all,
        [
            "xcp 7F0 > 7F1 SHORT_UPLOAD: command 0xF4, elements 2, extension 0, address 0x12345678, value 34 12, after 1 ms",
            "xcp 7F0 > 7F1 WRITE_DAQ: command 0xE1, bit_offset 0x00, size 4, error 0x29 (ERR_SEQUENCE), after 1 ms",
            "xcp 7F0 > 7F1 SYNCH: command 0xFC, error 0x00 (ERR_CMD_SYNCH), after 1 ms",
            "xcp 7F1 > 7F0 EV_DAQ_OVERLOAD: event 0x06",
            "xcp 7F1 > 7F0 SERV_TEXT: service 0x01, text \"hi\"",
            "xcp 7F0 > 7F1 command C2: command 0xC2, after 1 ms",
        ]
    );
}

#[test]
fn bytes_have_the_order_that_the_slave_named() {
    let all = event_lines(
        Xcp::new(Known::default()),
        &[
            (0.0, "18FF0001#FF00000000000000"),
            (1.0, "18FF0002#FF15010800080101"),
            (2.0, "18FF0001#F600000012345678"),
            (3.0, "18FF0002#FF00000000000000"),
            (4.0, "18FF0001#F504000000000000"),
            (5.0, "18FF0002#FFAABBCCDD000000"),
        ],
    );
    assert!(all[0].contains("max_dto 8"), "{}", all[0]);
    assert_eq!(
        all[2],
        "xcp 18FF0001 > 18FF0002 UPLOAD: command 0xF5, elements 4, extension 0, address 0x12345678, value AA BB CC DD, after 1 ms"
    );
}

/// Upload of ten bytes in a block of two frames; download of ten in a block of two.
#[test]
fn blocks_are_one_event() {
    let all = lines(&[
        (2.0, "7F0#F600000000100000"),
        (3.0, "7F1#FF"),
        (4.0, "7F0#F50A"),
        (5.0, "7F1#FF01020304050607"),
        (6.0, "7F1#FF08090A"),
        (7.0, "7F0#F00A010203040506"),
        (8.0, "7F0#EF040708090A"),
        (9.0, "7F1#FF"),
    ]);
    assert!(all[1].contains("address 0x00001000, value 01 02 03 04 05 06 07 08 09 0A"), "{}", all[1]);
    assert!(all[2].contains("DOWNLOAD: command 0xF0, elements 10"), "{}", all[2]);
    assert!(all[2].contains("address 0x0000100A, value 01 02 03 04 05 06 07 08 09 0A"), "{}", all[2]);
    let mut records: Vec<_> = after_connect(&[
        (2.0, "7F0#F50A"),
        (3.0, "7F1#FF01020304050607"),
        (5.0, "7F1#FF08090A"),
        (6.0, "7F0#F501"),
        (7.0, "7F1#FF01"),
    ])
    .iter()
    .map(|(ms, frame)| at(*ms, frame))
    .collect();
    records.insert(4, lost(4.0));
    let all: Vec<_> = events(Xcp::new(Known::default()), &records).iter().map(ToString::to_string).collect();
    assert!(
        all[1].ends_with("received 01 02 03 04 05 06 07, after 1 ms; frames were lost meanwhile"),
        "{}",
        all[1]
    );
    assert!(all[2].contains("RES: value 08 09 0A, request \"not heard\""), "{}", all[2]);
}

/// A list as most masters set it up: two packets, with a stamp of two bytes in units of 10 us.
const SET_UP: [(f64, &str); 32] = [
    (10.0, "7F0#DA"),
    (10.1, "7F1#FF110000010000"),
    (10.2, "7F0#D9"),
    (10.3, "7F1#FF01070107420100"),
    (11.0, "7F0#D6"),
    (11.1, "7F1#FF"),
    (11.2, "7F0#D5000100"),
    (11.3, "7F1#FF"),
    (11.4, "7F0#D400000002"),
    (11.5, "7F1#FF"),
    (11.6, "7F0#D30000000002"),
    (11.7, "7F1#FF"),
    (11.8, "7F0#D30000000101"),
    (11.9, "7F1#FF"),
    (12.0, "7F0#E20000000000"),
    (12.1, "7F1#FF"),
    (12.2, "7F0#E1FF020000100020"),
    (12.3, "7F1#FF"),
    (12.4, "7F0#E1FF010002100020"),
    (12.5, "7F1#FF"),
    (12.6, "7F0#E20000000100"),
    (12.7, "7F1#FF"),
    (12.8, "7F0#E1FF040008100020"),
    (12.9, "7F1#FF"),
    (13.0, "7F0#E010000001000100"),
    (13.1, "7F1#FF"),
    (13.2, "7F0#DE020000"),
    (13.3, "7F1#FF00"),
    (13.4, "7F0#DD01"),
    (13.5, "7F1#FF"),
    (14.0, "7F1#006400E80319"),
    (14.1, "7F1#0101020304"),
];

#[test]
fn data_packets_are_taken_apart_by_the_lists_that_were_set_up() {
    let mut frames = SET_UP.to_vec();
    // A frame that is filled up is none that differs; a shorter one is.
    frames[31].1 = "7F1#0101020304000000";
    frames.push((14.2, "7F1#0101"));
    frames.push((14.3, "7F1#05AABB"));
    let all = lines(&frames);
    let data: Vec<_> = all.iter().filter(|line| line.contains("7F0 DAQ: ")).map(String::as_str).collect();
    assert_eq!(
        data,
        [
            "xcp 7F1 > 7F0 DAQ: daq 0, odt 0, stamp 1000 us, 20001000 E8 03, 20001002 19",
            "xcp 7F1 > 7F0 DAQ: daq 0, odt 1, 20001008 01 02 03 04",
            "xcp 7F1 > 7F0 DAQ: pid 0x01, data 01, list \"not as long as its list\"",
            "xcp 7F1 > 7F0 DAQ: pid 0x05, data AA BB, list \"not heard set up\"",
        ]
    );
}

#[test]
fn a_list_that_was_not_heard_set_up_stays_bytes() {
    let all = event_lines(Xcp::new(given()), &[(0.0, "7F1#006400E80319")]);
    assert_eq!(all, ["xcp 7F1 > 7F0 DAQ: pid 0x00, data 64 00 E8 03 19, list \"not heard set up\""]);
    // Something of the setting up was lost: nobody knows what it was.
    let mut records: Vec<_> = after_connect(&SET_UP[..]).iter().map(|(ms, frame)| at(*ms, frame)).collect();
    records.insert(18, lost(12.15));
    let all = events(Xcp::new(Known::default()), &records);
    let data: Vec<_> = all.iter().filter(|event| event.title == "DAQ").map(ToString::to_string).collect();
    // The second packet was set up after the loss, from its first entry on, and is as long as that.
    assert!(data[0].ends_with("list \"not heard set up\""), "{}", data[0]);
    assert!(data[1].ends_with("odt 1, 20001008 01 02 03 04"), "{}", data[1]);
    // While it runs, a lost frame does not make it another list.
    let mut records: Vec<_> = after_connect(&SET_UP[..]).iter().map(|(ms, frame)| at(*ms, frame)).collect();
    records.insert(33, lost(14.05));
    let all = events(Xcp::new(Known::default()), &records);
    assert_eq!(all.last().unwrap().field("odt").unwrap().to_string(), "odt 1");
}

#[test]
fn what_is_not_answered_is_reported() {
    let all = lines(&[
        (2.0, "7F0#FD"),
        (3.0, "7F0#FD"),
        (4.0, "7F1#FF0000000000"),
        (5.0, "7F0#FE"),
        (5000.0, "123#"),
    ]);
    assert!(
        all[0].ends_with("GET_STATUS: command 0xFD; the next one began before it was complete"),
        "{}",
        all[0]
    );
    assert!(all[1].contains("status 0x00"), "{}", all[1]);
    assert!(all[2].ends_with("DISCONNECT: command 0xFE; nothing came for 2000 ms"), "{}", all[2]);
}

/// Data packets begin with small numbers, as frames of ISO 15765-2 do.
#[test]
fn it_is_found_without_being_named_and_nothing_else_is() {
    let mut frames = after_connect(&SET_UP);
    for round in 0..200_u32 {
        let ms = 20.0 + f64::from(round) * 10.0;
        let pair: [&'static str; 2] = ["7F1#006400E80319", "7F1#0101020304"];
        frames.extend([(ms, pair[0]), (ms + 0.1, pair[1])]);
    }
    assert_eq!(found(&frames), [Protocol::Xcp]);
    // On the identifiers of diagnostics, too.
    let moved: Vec<_> = frames
        .iter()
        .map(|(ms, frame)| (*ms, frame.replace("7F0#", "7E0#").replace("7F1#", "7E8#")))
        .collect();
    let moved: Vec<_> = moved.iter().map(|(ms, frame)| (*ms, frame.as_str())).collect();
    assert_eq!(found(&moved), [Protocol::Xcp]);
}

/// A packet with the identifier 10 looks like the first frame of a long message, one with 21 like the next.
#[test]
fn packets_with_high_identifiers_are_no_transfers() {
    let mut frames = vec![(0.0, "7E0#FF00"), (1.0, "7E8#FF05C00808000101")];
    for round in 0..100_u32 {
        let ms = 20.0 + f64::from(round) * 10.0;
        frames.extend([
            (ms, "7E8#100A220000000000"),
            (ms + 1.0, "7E8#2122000000000000"),
            (ms + 2.0, "7E8#0350030000000000"),
        ]);
    }
    assert_eq!(found(&frames), [Protocol::Xcp]);
}

#[test]
fn diagnostics_are_not_taken_for_it() {
    let frames =
        [(0.0, "7E0#0210030000000000"), (1.0, "7E8#065003003201F400"), (2.0, "7E0#FF00"), (3.0, "7E8#FF00")];
    assert_eq!(found(&frames), [Protocol::Uds]);
}

/// Frames of CAN FD hold packets of up to 64 bytes, and are filled up to the next length that there is.
#[test]
fn packets_in_frames_of_can_fd_are_taken_apart() {
    let mut frames = vec![(0.0, "7F0##1FF00000000000000"), (1.0, "7F1##1FF050040400001010000000000")];
    let filled = |bytes: &str, length: usize| -> &'static str {
        let data = bytes.len() - bytes.find("##1").unwrap() - 3;
        Box::leak(format!("{bytes}{}", "0".repeat(2 * length - data)).into_boxed_str())
    };
    frames[1].1 = filled("7F1##1FF05004040000101", 12);
    frames.extend([
        (2.0, "7F0##1F414000000100020"),
        (3.0, filled("7F1##1FF0102030405060708090A0B0C0D0E0F1011121314", 24)),
        (4.0, "7F0##1E20000000000"),
        (4.1, "7F1##1FF"),
    ]);
    for (at, size, address) in [(5.0, 8, 0x10), (6.0, 4, 0x18), (7.0, 1, 0x1C)] {
        let line = format!("7F0##1E1FF{size:02X}00{address:02X}000020");
        frames.extend([(at, &*line.leak()), (at + 0.1, "7F1##1FF")]);
    }
    frames.extend([
        (8.0, "7F0##1E000000000000100"),
        (8.1, "7F1##1FF"),
        (8.2, "7F0##1DE010000"),
        (8.3, "7F1##1FF00"),
        (9.0, filled("7F1##1000102030405060708090A0B0C0D", 16)),
    ]);
    let all = event_lines(Xcp::new(Known::default()), &frames);
    assert!(all[0].contains("max_cto 64, max_dto 64"), "{}", all[0]);
    let value = "value 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F 10 11 12 13 14";
    assert!(all[1].contains(value), "{}", all[1]);
    assert_eq!(
        all.last().unwrap(),
        "xcp 7F1 > 7F0 DAQ: daq 0, odt 0, 20000010 01 02 03 04 05 06 07 08, 20000018 09 0A 0B 0C, 2000001C 0D"
    );
}
