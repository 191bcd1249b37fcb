//! Actisense's binary logs and what its gateways send.

use super::super::tests;
use super::*;
use crate::Format;

/// 2023-11-14 22:13:20, in tenths of microseconds since 1601.
const TICKS: u64 = 116_444_736_000_000_000 + 1_700_000_000 * 10_000_000;

fn doubled(bytes: &[u8], escape: u8) -> Vec<u8> {
    bytes.iter().flat_map(|byte| std::iter::repeat_n(*byte, if *byte == escape { 2 } else { 1 })).collect()
}

fn tag(kind: u8, content: &[u8]) -> Vec<u8> {
    [&[ESC, SOH, kind], doubled(content, ESC).as_slice(), &[ESC, LF]].concat()
}

fn time(after_ms: u64) -> Vec<u8> {
    tag(3, &(TICKS + after_ms * 10_000).to_le_bytes())
}

/// As a gateway sends it.
fn sent(message: &[u8]) -> Vec<u8> {
    let sum = message.iter().fold(0_u8, |sum, byte| sum.wrapping_sub(*byte));
    let message = [message, &[sum]].concat();
    [&[DLE, STX], doubled(&message, DLE).as_slice(), &[DLE, ETX]].concat()
}

/// A frame of the kind that W2K-1 logs; the identifier's upper bits are the clock's and the direction.
fn frame(stamp: u16, word: u32, data: &[u8]) -> Vec<u8> {
    [&[0x95, 6 + data.len() as u8], &stamp.to_le_bytes()[..], &word.to_le_bytes(), data].concat()
}

/// A message of NGT-1.
fn received(stamp: u32, group: [u8; 3], data: &[u8]) -> Vec<u8> {
    let head = [0x93, 11 + data.len() as u8, 2, group[0], group[1], group[2], 0xFF, 0x0B];
    [&head[..], &stamp.to_le_bytes(), &[data.len() as u8], data].concat()
}

#[test]
fn frames_in_tags_are_at_the_tags_time_and_as_much_later_as_their_stamps() {
    let file = [
        time(0),
        tag(1, &1002_u32.to_le_bytes()),
        tag(7, &frame(65_530, 0x09F8_0100, &[ESC, 1, DLE, 2, 5, 6, 7, 8])),
        // Over the end of the stamp; with a checksum, and sent.
        tag(7, &frame(4, 0x09F8_0100 | 1 << 31, &[])),
        // A little older than the one before it.
        tag(7, &frame(2, 0x1DEF_FF0A, &[9])),
        time(70_000),
        tag(7, &frame(4_500, 0x1DEF_FF0A, &[10])),
        tag(0x21, b"of a later version"),
    ]
    .concat();
    assert_eq!(Format::of_content(&file), Some(Format::Actisense));
    let (log, issues) = tests::as_log(Format::Actisense, &file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(1700000000.000000) can0 09F80100#1B01100205060708\n(1700000000.010000) can0 09F80100# T\n\
         (1700000000.008000) can0 1DEFFF0A#09\n(1700000070.000000) can0 1DEFFF0A#0A\n"
    );
}

#[test]
fn messages_between_tags_are_frames_where_their_group_has_one_and_are_counted_otherwise() {
    let single = received(1000, [2, 0xF8, 1], &[ESC, DLE, 3, 4, 5, 6, 7, 8]);
    let escaped = |message: &[u8]| doubled(&sent(message), ESC);
    let whole = escaped(&received(1005, [2, 0xF8, 1], &[1]));
    // A writer may put the time into the middle of a message.
    let (before, after) = whole.split_at(9);
    let file = [
        time(0),
        escaped(&single),
        [before, &time(2000), after].concat(),
        escaped(&received(1007, [2, 0xF8, 1], &[2])),
        // A fast packet, a message to the gateway and one of its own, and what it prints.
        escaped(&received(1010, [0x05, 0xF8, 1], &[0; 43])),
        escaped(&[0x94, 3, 1, 2, 3]),
        escaped(&[0xA0, 1, 0xF2]),
        b"hello".to_vec(),
        // D0, one packet and several.
        escaped(&[0xD0, 14, 0, 0xFF, 7, 0x02, 0xF8, 0x09, 0, 0xF2, 3, 0, 0, 0xAA]),
        escaped(&[0xD0, 14, 0, 0x20, 7, 0x20, 0xEA, 0x18, 9, 0xF2, 3, 0, 0, 0xAA]),
        tag(5, &[1]),
        escaped(&[0xD0, 14, 0, 0x20, 7, 0x20, 0xEA, 0x18, 0, 0xF7, 3, 0, 0, 0xAB]),
    ]
    .concat();
    let (log, issues) = tests::as_log(Format::Actisense, &file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(1700000000.000000) can0 09F8020B#1B10030405060708\n(1700000000.005000) can0 09F8020B#01\n\
         (1700000002.000000) can0 09F8020B#02\n(1700000002.003000) can0 09F80207#AA\n\
         (1700000002.008000) can0 18EA2007#AB T\n"
    );
    let options = crate::ReadOptions { format: Some(Format::Actisense), ..Default::default() };
    let source = io::Cursor::new(file);
    let mut reader = crate::TraceReader::from_source("test", source, Format::Actisense, &options).unwrap();
    while reader.next().is_some() {}
    let left_out: u64 = reader.left_out().iter().map(|(_, count)| count).sum();
    assert_eq!(left_out, 5, "{:?}", reader.left_out().iter().collect::<Vec<_>>());
}

#[test]
fn what_a_gateway_sent_is_read_without_a_log_and_may_begin_inside_a_message() {
    let file = [
        vec![3, 0xF1, DLE, ETX],
        sent(&frame(100, 0x09F8_0100, &[ESC, 1, 2])),
        sent(&frame(110, 0x09F8_0100, &[ESC, ESC])),
        // A clock of hundredths of a millisecond.
        sent(&frame(10, 0x09F8_0100 | 2 << 29, &[1])),
        sent(&frame(20, 0x09F8_0100 | 2 << 29, &[2])),
    ]
    .concat();
    assert_eq!(Format::of_content(&file), Some(Format::Actisense));
    let (log, issues) = tests::as_log(Format::Actisense, &file);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(
        log,
        "(0.100000) can0 09F80100#1B0102\n(0.110000) can0 09F80100#1B1B\n(0.110000) can0 09F80100#01\n\
         (0.110100) can0 09F80100#02\n"
    );
    assert_eq!(Format::of_content(&sent(&frame(1, 0x09F8_0100, &[]))), None);
}

/// The last time that there is, and stamps behind it.
#[test]
fn a_time_at_the_end_of_all_times_goes_no_further() {
    let last = 116_444_736_000_000_000 + i64::MAX as u64 / 100;
    let file = [
        tag(3, &last.to_le_bytes()),
        tag(7, &frame(1, 0x09F8_0100, &[1])),
        tag(7, &frame(2, 0x09F8_0100, &[2])),
        tag(3, &u64::MAX.to_le_bytes()),
    ];
    let (records, issues) = tests::read(Format::Actisense, file.concat());
    assert_eq!(records.iter().map(|record| record.time_ns).max(), Some(i64::MAX));
    assert_eq!((records.len(), issues.len()), (2, 1), "{issues:?}");
}

#[test]
fn damage_costs_what_it_hit_and_a_cut_end_is_named() {
    let good = tag(7, &frame(1, 0x09F8_0100, &[1]));
    let mut wrong_sum = sent(&frame(1, 0x09F8_0100, &[1]));
    wrong_sum[5] ^= 1;
    let mut too_long = frame(1, 0x09F8_0100, &[1; 9]);
    too_long[1] = 15;
    let cut = &good[..good.len() - 3];
    let file = [
        &time(0),
        &good,
        &wrong_sum,
        &tag(7, &too_long),
        &tag(3, &[1, 2]),
        &tag(7, &[0x95]),
        cut,
        &good,
        &[DLE, STX, 0x95],
        &sent(&frame(1, 0x09F8_0100, &[1])),
        cut,
    ]
    .concat();
    let (records, issues) = tests::read(Format::Actisense, &file);
    assert_eq!(records.len(), 3, "{issues:#?}");
    assert_eq!(issues.len(), 7, "{issues:#?}");
    assert!(issues[6].contains("the file ends inside"), "{issues:#?}");
}

proptest::proptest! {
    #[test]
    fn anything_is_read_to_its_end(bytes in proptest::collection::vec(
        proptest::prop_oneof![proptest::sample::select(vec![ESC, SOH, LF, DLE, STX, ETX, 0x93, 0x95, 7]), proptest::num::u8::ANY],
        0..300,
    )) {
        let (_, _) = tests::read(Format::Actisense, &bytes);
    }
}
