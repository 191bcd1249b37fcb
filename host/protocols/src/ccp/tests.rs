//! Sessions of CCP, as masters and slaves have them.

use super::*;
use crate::Protocol;
use crate::calibration::Known;
use crate::testing::{event_lines, found};

const SESSION: [(f64, &str); 22] = [
    (0.0, "700#0100000200000000"),
    (1.0, "701#FF00000000000000"),
    (2.0, "700#1B01020100000000"),
    (3.0, "701#FF00010201000000"),
    (4.0, "700#0202000020001000"),
    (5.0, "701#FF00020000000000"),
    (6.0, "700#0403040000000000"),
    (7.0, "701#FF0003DEADBEEF00"),
    (8.0, "700#1404000000000702"),
    (9.0, "701#FF00040220000000"),
    (10.0, "700#1505000000000000"),
    (11.0, "701#FF00050000000000"),
    (12.0, "700#1606020020001000"),
    (13.0, "701#FF00060000000000"),
    (14.0, "700#0607010001000100"),
    (15.0, "701#FF00070000000000"),
    (16.0, "702#2012340000000000"),
    (17.0, "702#2112340000000000"),
    (18.0, "700#0308020102000000"),
    (19.0, "701#FF33080000000000"),
    (20.0, "700#0709010000020000"),
    (21.0, "701#FF00090000000000"),
];

#[test]
fn a_session_is_found_by_its_counters_and_read() {
    let all = event_lines(Ccp::new(Known::default()), &SESSION);
    assert_eq!(
        all,
        [
            "ccp 700 > 701 CONNECT: command 0x01, counter 0, station 0x0200, after 1 ms",
            "ccp 700 > 701 GET_CCP_VERSION: command 0x1B, counter 1, main_version 2, release 1, main_version 2, release 1, after 1 ms",
            "ccp 700 > 701 SET_MTA: command 0x02, counter 2, mta 0, extension 0, address 0x20001000, after 1 ms",
            "ccp 700 > 701 UPLOAD: command 0x04, counter 3, elements 4, extension 0, address 0x20001000, value DE AD BE EF, after 1 ms",
            "ccp 700 > 701 GET_DAQ_SIZE: command 0x14, counter 4, daq 0, can_id 0x00000702, odts 2, first_pid 0x20, after 1 ms",
            "ccp 700 > 701 SET_DAQ_PTR: command 0x15, counter 5, daq 0, odt 0, entry 0, after 1 ms",
            "ccp 700 > 701 WRITE_DAQ: command 0x16, counter 6, size 2, extension 0, address 0x20001000, after 1 ms",
            "ccp 700 > 701 START_STOP: command 0x06, counter 7, mode 0x01 (start), daq 0, last_odt 1, event 0, prescaler 256, after 1 ms",
            "ccp 701 > 700 DAQ: daq 0, odt 0, 20001000 12 34",
            "ccp 701 > 700 DAQ: pid 0x21, data 12 34 00 00 00 00 00, list \"not heard set up\"",
            "ccp 700 > 701 DNLOAD: command 0x03, counter 8, elements 2, extension 0, address 0x20001004, error 0x33 (access denied), after 1 ms",
            "ccp 700 > 701 DISCONNECT: command 0x07, counter 9, mode 0x01 (end of session), station 0x0200, after 1 ms",
        ]
    );
}

#[test]
fn it_is_found_without_being_named() {
    assert_eq!(found(&SESSION), [Protocol::Ccp]);
}

/// Frames that count, and one that looks like an answer.
#[test]
fn other_traffic_is_not_taken_for_it() {
    assert_eq!(
        found(&[
            (0.0, "100#0100000000000000"),
            (1.0, "200#FF00000000000000"),
            (10.0, "100#0101000000000000"),
            (11.0, "200#FF00000000000000"),
            (20.0, "100#0102000000000000"),
            (21.0, "200#FF00000000000000"),
        ]),
        []
    );
}
