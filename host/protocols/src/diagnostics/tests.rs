use cantap_trace::{TraceEvent, TraceRecord};

use super::*;
use crate::EventKind;
use crate::testing::{self, at, hex};

fn diagnostics() -> Diagnostics {
    Diagnostics::new(&[], true)
}

fn event_lines(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(diagnostics(), frames)
}

fn events(records: &[TraceRecord]) -> Vec<Event> {
    testing::events(diagnostics(), records)
}

#[test]
fn a_request_and_its_response_are_one_event() {
    for (frames, expected) in [
        (
            &[
                (0.0, "7E0#0322F190"),
                (2.5, "7E8#101462F190575657"),
                (3.0, "7E0#300000"),
                (4.0, "7E8#215A5A5A314B5A41"),
                (5.0, "7E8#2257303030303031"),
            ][..],
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), value \"WVWZZZ1KZAW000001\", after 2.5 ms",
        ),
        (
            &[(0.0, "7E0#021003"), (1.0, "7E8#065003003201F4")],
            "uds 7E0 > 7E8 DiagnosticSessionControl: sid 0x10, sub_function 0x03 (extended), p2_ms 50, p2_star_ms 5000, after 1 ms",
        ),
        (
            &[(0.0, "18DA10F1#0427110000"), (1.0, "18DAF110#037F2733")],
            "uds 18DA10F1 > 18DAF110 SecurityAccess: sid 0x27, sub_function 0x11 (request seed), parameters 00 00, \
             nrc 0x33 (securityAccessDenied), after 1 ms",
        ),
        (
            &[(0.0, "7E0#0431010203"), (1.0, "7E8#037F3178"), (3000.0, "7E8#057101020300")],
            "uds 7E0 > 7E8 RoutineControl: sid 0x31, sub_function 0x01 (start), routine 0x0203, status 00, pending 1 times, \
             after 3000 ms",
        ),
        (
            &[(0.0, "7E0#03190209"), (1.0, "7E8#0759020901231108")],
            "uds 7E0 > 7E8 ReadDTCInformation: sid 0x19, sub_function 0x02 (DTCs by status mask), status_mask 0x09, \
             available_mask 0x09, trouble_codes 1, codes \"P0123-11 (confirmed)\", after 1 ms",
        ),
        (
            &[(0.0, "7DF#02010C"), (1.0, "7E8#04410C1AF8")],
            "obd 7DF > 7E8 current data: sid 0x01, pid 0x0C (engine_speed), engine_speed 1726 rpm, asked \"all\", after 1 ms",
        ),
        (
            &[(0.0, "7E0#021A90"), (1.0, "7E8#065A9041424344")],
            "kwp2000 7E0 > 7E8 readECUIdentification: sid 0x1A, local_identifier 0x90, value \"ABCD\", after 1 ms",
        ),
        (
            &[(0.0, "7E0#023E80")],
            "uds 7E0 > 7E8 TesterPresent: sid 0x3E, sub_function 0x00 (zero), response \"not wanted\"",
        ),
        (
            &[(0.0, "7E8#037E0000")],
            "uds 7E8 > 7E0 TesterPresent: sid 0x3E, sub_function 0x00 (zero), value 00, request \"not heard\"",
        ),
        (
            &[(0.0, "7E0#0622F18CF187FF"), (1.0, "7E8#037F2213")],
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF18C (ECU serial number), did 0xF187 (spare part number), \
             rest FF, nrc 0x13 (incorrectMessageLengthOrInvalidFormat), after 1 ms",
        ),
    ] {
        assert_eq!(event_lines(frames), [expected], "{frames:?}");
    }
}

#[test]
fn several_servers_answer_a_request_to_all() {
    let frames = [(0.0, "7DF#020105"), (1.0, "7E8#03410528"), (2.0, "7E9#0341057B"), (9000.0, "123#")];
    let said = event_lines(&frames);
    assert_eq!(said.len(), 2, "{said:?}");
    assert!(said[1].starts_with("obd 7DF > 7E9 current data"), "{said:?}");
    assert!(said[1].ends_with("asked \"all\", after 2 ms"), "{said:?}");
}

#[test]
fn silence_is_said_and_a_loss_meanwhile_too() {
    let all = events(&[at(0.0, "7E0#023E00"), at(2500.0, "123#")]);
    assert_eq!((all[0].kind, all[0].time_ns), (EventKind::NoResponse, 2_000_000_000));
    assert_eq!(all[0].trouble, Some(Trouble::Timeout { after_ms: 2000 }));
    let gap = TraceRecord { time_ns: 1_000_000, channel: 1, event: TraceEvent::GAP };
    let all = events(&[at(0.0, "7E0#023E00"), gap, at(2500.0, "123#")]);
    assert!(all[0].frames_lost, "{all:?}");
    let all = events(&[at(0.0, "7E0#023E00"), at(10.0, "7E0#021001"), at(11.0, "7E8#025001")]);
    let kinds: Vec<_> = all.iter().map(|event| (event.kind, event.trouble)).collect();
    assert_eq!(kinds, [(EventKind::NoResponse, Some(Trouble::Overlapped)), (EventKind::Exchange, None)]);
    assert_eq!(events(&[at(0.0, "7E0#023E00")])[0].trouble, Some(Trouble::Unfinished));
}

/// Whatever the bytes, nothing panics and memory does not grow.
#[test]
fn any_bytes_are_taken() {
    let mut random = fastrand::Rng::with_seed(14_229);
    let mut diagnostics = diagnostics();
    let mut events = Vec::new();
    for number in 0..300_000_u32 {
        let id = random.choice([0x7DF, 0x7E0, 0x7E8, 0x7E1, 0x7E9, 0x123]).unwrap();
        let length = random.usize(0..=8);
        let mut bytes: Vec<u8> = (0..length).map(|_| random.u8(..)).collect();
        if let Some(first) = bytes.first_mut()
            && random.u8(0..4) > 0
        {
            *first = random.choice([1, 2, 3, 4, 5, 6, 7, 0x10, 0x21, 0x22, 0x30]).unwrap();
        }
        diagnostics.take(&at(f64::from(number) / 5.0, &format!("{id:03X}#{}", hex(&bytes))), &mut events);
        assert!(diagnostics.waiting.len() <= MOST_WAITING);
        for event in events.drain(..) {
            let _ = event.to_string();
        }
    }
}

#[test]
fn what_wanted_no_response_may_still_be_refused() {
    assert_eq!(
        event_lines(&[(0.0, "7E0#023E80"), (1.0, "7E8#037F3E12")]),
        [
            "uds 7E0 > 7E8 TesterPresent: sid 0x3E, sub_function 0x00 (zero), response \"not wanted\"",
            "uds 7E0 > 7E8 TesterPresent: sid 0x3E, sub_function 0x00 (zero), nrc 0x12 (subFunctionNotSupported), after 1 ms",
        ]
    );
    // Once it is pending, the response comes.
    let pending = event_lines(&[(0.0, "7E0#021083"), (1.0, "7E8#037F1078"), (2.0, "7E8#065003003201F4")]);
    assert_eq!(pending.len(), 2, "{pending:?}");
    assert!(pending[1].contains("p2_ms 50") && pending[1].contains("pending 1 times"), "{pending:?}");
    // It does not end a request that is waiting for its response meanwhile.
    let between = event_lines(&[
        (0.0, "7E0#0431010203"),
        (1.0, "7E8#037F3178"),
        (2000.0, "7E0#023E80"),
        (4000.0, "7E0#023E80"),
        (5000.0, "7E8#057101020300"),
    ]);
    assert_eq!(between.len(), 3, "{between:?}");
    assert!(between[2].contains("RoutineControl") && between[2].contains("status 00"), "{between:?}");
    // KWP2000 expresses it differently.
    assert_eq!(
        event_lines(&[
            (0.0, "7E0#021A90"),
            (1.0, "7E8#065A9041424344"),
            (2.0, "7E0#023E02"),
            (4000.0, "100#")
        ])[1],
        "kwp2000 7E0 > 7E8 testerPresent: sid 0x3E, parameters 02, response \"not wanted\""
    );
}

/// If several servers are asked at once, each is reported separately.
#[test]
fn who_said_pending_and_fell_silent_is_named() {
    let said = event_lines(&[
        (0.0, "7DF#0322F190"),
        (1.0, "7E8#037F2278"),
        (2.0, "7E8#037F2278"),
        (3.0, "7E9#0562F1904142"),
        (12_000.0, "100#"),
    ]);
    assert_eq!(
        said,
        [
            "uds 7DF > 7E9 ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), value 41 42, asked \"all\", after 3 ms",
            "uds 7DF > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), response \"none\", pending 2 times, asked \"all\"; \
             nothing came for 10000 ms",
        ]
    );
}

/// An address of four bytes and a size of eight: the byte with the two lengths is above 127.
#[test]
fn memory_has_addresses_and_sizes_of_any_length() {
    for lengths in 0..=0xFF {
        for length in [0, 1, 4, 8, 12, 16, 17] {
            let mut fields = Vec::new();
            uds::request(&[&[0x34, 0, lengths][..], &vec![0x11; length]].concat(), &mut fields);
            assert!(fields.len() >= 2, "{lengths:02X} {length}");
            let address = fields.iter().find(|field| field.name == "address");
            if let (Some(field), 1..=8) = (address, lengths & 15) {
                assert_eq!(field.to_string().len(), "address 0x".len() + 2 * usize::from(lengths & 15));
            }
        }
    }
}

#[test]
fn services_have_their_own_fields() {
    for (frames, expected) in [
        (["7E0#0422F1F186", ""], "did 0xF1F1, rest 86"),
        (
            ["7E0#03280301", "7E8#026803"],
            "sub_function 0x03 (disable receiving and sending), communication_type 0x01 (normal), after",
        ),
        (
            ["7E0#042A01F2F3", "7E8#016A"],
            "mode 0x01 (slow), did 0xF2F2 (periodic), did 0xF2F3 (periodic), after",
        ),
        (["7E0#043101FF00", "7E8#057101FF0000"], "routine 0xFF00 (erase memory), status 00"),
        (
            ["7E0#028301", "7E8#02C301"],
            "uds 7E0 > 7E8 AccessTimingParameter: sid 0x83, sub_function 0x01 (read extended timing)",
        ),
        (["", "7E8#056FF1900355"], "did 0xF190 (VIN), control 0x03 (short term adjustment), status 55"),
        (["7E0#042701AABB", "7E8#0467011122"], "(request seed), parameters AA BB, seed 11 22, after"),
        (["7E0#04270233CC", "7E8#026702"], "(send key), key 33 CC, after"),
        (["7E0#021104", "7E8#0351040F"], "(enable rapid power shutdown), power_down_time 15 s, after"),
        (["", "7E8#035104FF"], "(enable rapid power shutdown), power_down_time not available, request"),
        (
            ["7E0#0528041200AA", "7E8#026804"],
            "communication_type 0x12 (network management, on subnet 1), node 0x00AA, after",
        ),
        (
            ["7E0#0387 01 12", "7E8#02C701"],
            "(verify mode transition with fixed parameter), link_mode 0x12 (500 kbit/s), after",
        ),
        (["7E0#05870207A120", "7E8#02C702"], "bit_rate 500000 bit/s, after"),
        (
            ["7E0#078643 02 F190 22F1", "7E8#05C643010201"],
            "sub_function 0x43 (on change of data identifier, stored), event_window 0x02 (infinite), did 0xF190 (VIN), \
             response_service 0x22 (ReadDataByIdentifier), parameters F1, identified_events 1, after",
        ),
        (["7E0#028604", "7E8#07C604010102 0E 19"], "activated_events 1, value 01 02 0E 19, after"),
        (["", "7E8#066C02F2001234"], "did 0xF200 (periodic), value 12 34, request"),
        (
            ["7E0#072C02F2001220 00", "7E8#046C02F200"],
            "(define by memory address), did 0xF200 (periodic), lengths 0x12, parameters 20 00, after",
        ),
        (["", "7E8#057D 12 2000 08"], "address 0x2000, size 8 bytes, request"),
        (
            ["", "7E8#0664F19001A130"],
            "did 0xF190 (VIN), scaling 0x01 (unsigned, 1 bytes), scaling 0xA1 (unit or format), unit 0x30 (km/h), request",
        ),
        (["", "7E8#0678010200F011"], "(add file), block_length 240 bytes, data_format 0x11, request"),
        (
            ["", "7E8#0469 04 13 AA"],
            "(transmit certificate), result 0x13 (certificate verified), value AA, request",
        ),
    ] {
        let frames = frames.iter().enumerate().filter(|(_, frame)| !frame.is_empty());
        let frames: Vec<_> = frames.map(|(at, frame)| (at as f64, frame.replace(' ', ""))).collect();
        let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
        let said = event_lines(&frames);
        assert!(said[0].contains(expected), "{said:?}");
    }
}

/// Random bytes sent through ISO 15765-2 rarely get as far as a service's own fields.
#[test]
fn requests_and_responses_of_any_bytes_are_taken() {
    let seed = fastrand::u64(..);
    eprintln!("seed {seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    for round in 0..100_000_u32 {
        let bytes: Vec<u8> = (0..random.usize(1..20)).map(|_| random.u8(..)).collect();
        let (asked, answer) =
            ([&[round as u8], &bytes[..]].concat(), [&[round as u8 | 0x40], &bytes[..]].concat());
        let mut fields = Vec::new();
        uds::request(&asked, &mut fields);
        uds::response(random.bool().then_some(&asked), &answer, &mut fields);
        uds::kwp_request(&asked, &mut fields);
        uds::kwp_response(random.bool(), &answer, &mut fields);
        obd::request(round as u8 & 15, &bytes, &mut fields);
        obd::response(round as u8 & 15, &bytes, &mut fields);
        assert!(fields.iter().all(|field| !field.to_string().is_empty()));
    }
}

/// A response says what it is to; the one that came next is not necessarily the right one.
#[test]
fn a_response_to_something_else_is_not_the_response() {
    assert_eq!(
        event_lines(&[
            (0.0, "7E0#0322F190"),
            (1.0, "7E8#0562F1914142"),
            (2.0, "7E8#0562F1904344"),
            (9000.0, "123#")
        ]),
        [
            "uds 7E8 > 7E0 ReadDataByIdentifier: sid 0x22, did 0xF191 (ECU hardware number), value 41 42, request \"not heard\"",
            "uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), value 43 44, after 2 ms",
        ]
    );
    // One that comes after its request was given up.
    let late = event_lines(&[
        (0.0, "7E0#0322F190"),
        (500.0, "7E0#0322F191"),
        (510.0, "7E8#0562F1904142"),
        (520.0, "7E8#0562F1914344"),
    ]);
    assert_eq!(late.len(), 3, "{late:?}");
    assert!(late[1].ends_with("did 0xF190 (VIN), value 41 42, request \"given up before\""), "{late:?}");
    assert!(late[2].ends_with("did 0xF191 (ECU hardware number), value 43 44, after 20 ms"), "{late:?}");
    let late =
        event_lines(&[(0.0, "7E0#021003"), (2500.0, "7E8#065003003201F4"), (2600.0, "7E8#065003003201F4")]);
    assert!(late[0].ends_with("nothing came for 2000 ms"), "{late:?}");
    assert!(
        late[1].ends_with("request \"given up before\"") && late[2].ends_with("\"not heard\""),
        "{late:?}"
    );
    let late = event_lines(&[(0.0, "7E0#0322F190"), (2500.0, "7E8#037F2210")]);
    assert!(late[1].ends_with("nrc 0x10 (generalReject), request \"given up before\""), "{late:?}");
}

/// Of several identifiers a server answers those that it has.
#[test]
fn values_belong_to_the_identifiers_that_came() {
    let said = event_lines(&[(0.0, "7E0#0722F190F18CF191"), (1.0, "7E8#0762F18C41F19142")]);
    assert!(said[0].contains("value_F18C 41, value_F191 42, after 1 ms"), "{said:?}");
}

/// With a separation of 127 ms, 200 bytes take longer than a response may.
#[test]
fn a_response_that_has_begun_is_waited_for() {
    let mut frames = vec![(0.0, "7E0#03221234".to_owned()), (10.0, "7E8#10C8621234000000".to_owned())];
    frames.push((11.0, "7E0#30007F".to_owned()));
    for number in 1..=28 {
        frames.push((11.0 + f64::from(number) * 127.0, format!("7E8#2{:X}01020304050607", number & 15)));
    }
    let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
    let whole = event_lines(&frames);
    assert_eq!(whole.len(), 1, "{whole:?}");
    assert!(whole[0].ends_with("after 10 ms"), "{whole:?}");
    // Of one that breaks off, both are said.
    let broken = event_lines(&[&frames[..20], &[(9000.0, "123#")]].concat());
    assert_eq!(broken.len(), 2, "{broken:?}");
    // To all, too.
    let mut to_all = frames.clone();
    to_all[0].1 = "7DF#03221234";
    let whole = event_lines(&to_all);
    assert_eq!(whole.len(), 1, "{whole:?}");
}

/// Their first byte is no service: 01 would be OBD-II's current data.
#[test]
fn periodic_data_are_known_by_what_was_asked() {
    let frames = [
        (0.0, "7E0#042A0101E3"),
        (1.0, "7E8#016A"),
        (100.0, "7E8#0401AABBCC"),
        (150.0, "7E8#03E31234"),
        (160.0, "7E0#0201E3"),
        (161.0, "7E8#0341E300"),
        (200.0, "7E0#032A04E3"),
        (201.0, "7E8#016A"),
        (250.0, "7E8#0401AABBCD"),
        (260.0, "7E8#03E31234"),
    ];
    let said = event_lines(&frames);
    assert_eq!(
        said[1..3],
        [
            "uds 7E8 > 7E0 periodic data: did 0xF201 (periodic), value AA BB CC",
            "uds 7E8 > 7E0 periodic data: did 0xF2E3 (periodic), value 12 34",
        ]
    );
    assert!(said[3].starts_with("obd 7E0 > 7E8 current data"), "{said:?}");
    assert_eq!(said[5], "uds 7E8 > 7E0 periodic data: did 0xF201 (periodic), value AA BB CD");
    assert!(said[6].starts_with("isotp"), "{said:?}");
}

/// Only the response to a session says that its highest bit was part of the number.
#[test]
fn a_session_above_80_is_one_of_kwp2000() {
    let said = event_lines(&[(0.0, "7E0#021089"), (1.0, "7E8#025089"), (2.0, "7E0#013E"), (3.0, "7E8#017E")]);
    assert_eq!(
        said[1],
        "kwp2000 7E0 > 7E8 startDiagnosticSession: sid 0x10, mode 0x89, value 89, after 1 ms"
    );
    assert!(said[2].starts_with("kwp2000 7E0 > 7E8 testerPresent"), "{said:?}");
}

/// Somebody whose ECU is silent wants to see just that.
#[test]
fn requests_without_answers_show_what_is_spoken() {
    let found = |frames: &[&str]| {
        let mut survey = crate::survey::Survey::new(&[], None);
        for (number, frame) in (0_u32..).zip(frames) {
            survey.take(&at(f64::from(number) * 100.0, frame));
        }
        survey.found().into_iter().map(|found| found.protocol).collect::<Vec<_>>()
    };
    assert_eq!(found(&["7E0#0322F190", "7E0#0322F190", "7E0#023E00", "100#00"]), [Protocol::Uds]);
    assert_eq!(
        found(&["7E0#0322F190", "7E8#0462F19141", "7E0#021003", "7E8#065001003201F4"]),
        [Protocol::Uds]
    );
    // Layer setting services of CANopen, and anything.
    assert_eq!(found(&["7E5#0401000000000000", "7E4#0401000000000000", "7E5#0400000000000000"]), []);
    assert_eq!(
        found(&["7E1#0822F19000000000", "7E1#0922F190FF", "7E1#0322F190", "7E1#0322F191", "7E1#0422"]),
        []
    );
    assert_eq!(found(&["7E0#023E00", "100#0322F190"]), []);
}

/// Loggers that ask by OBD-II often record only what the vehicle responds.
#[test]
fn responses_of_obd_without_requests_show_what_is_spoken() {
    let found = |frames: &[&str]| {
        let mut survey = crate::survey::Survey::new(&[], None);
        for (number, frame) in (0_u32..).zip(frames) {
            survey.take(&at(f64::from(number) * 100.0, frame));
        }
        survey.found().into_iter().map(|found| found.protocol).collect::<Vec<_>>()
    };
    let speed = "7E8#03410D2A00000000";
    let revolutions = "18DAF110#04410C1AF8000000";
    assert_eq!(found(&[speed, speed, speed, "100#00"]), [Protocol::Obd]);
    assert_eq!(found(&[revolutions, revolutions, revolutions]), [Protocol::Obd]);
    assert_eq!(found(&[speed, speed]), []);
    // Anything else with these identifiers.
    assert_eq!(found(&[speed, speed, speed, "7E8#0211"]), []);
}

#[test]
fn a_service_that_no_standard_names_is_refused_as_it_was_asked_for() {
    // As a scan of all services goes.
    assert_eq!(
        event_lines(&[
            (0.0, "7E0#02BF01"),
            (1.0, "7E8#037FBF11"),
            (10.0, "7E0#013F"),
            (11.0, "7E8#037F3F11")
        ]),
        [
            "isotp 7E0 > 7E8 transfer: length 2 bytes, data BF 01",
            "uds 7E0 > 7E8 service BF: sid 0xBF, parameters 01, nrc 0x11 (serviceNotSupported), after 1 ms",
            "isotp 7E0 > 7E8 transfer: length 1 bytes, data 3F",
            "uds 7E0 > 7E8 service 3F: sid 0x3F, nrc 0x11 (serviceNotSupported), after 1 ms",
        ]
    );
    // One that asks for time first, and answers.
    assert_eq!(
        event_lines(&[(0.0, "7E0#02A501"), (1.0, "7E8#037FA578"), (3000.0, "7E8#02E501")]),
        [
            "isotp 7E0 > 7E8 transfer: length 2 bytes, data A5 01",
            "uds 7E0 > 7E8 service A5: sid 0xA5, parameters 01, value 01, pending 1 times, after 3000 ms",
        ]
    );
    // Too late, another service, or another server: its request was not heard.
    for (frames, heard) in [
        (&[(0.0, "7E0#02BF01"), (2001.0, "7E8#037FBF11")][..], false),
        (&[(0.0, "7E0#02BF01"), (1.0, "7E8#037FB911")], false),
        (&[(0.0, "7E0#02BF01"), (1.0, "7E9#037FBF11")], false),
        (&[(0.0, "7DF#02BF01"), (1.0, "7E9#037FBF11")], true),
    ] {
        let said = event_lines(frames);
        assert_eq!(!said[1].contains("not heard"), heard, "{said:?}");
    }
}

#[test]
fn services_of_the_system_supplier_are_requests_too() {
    assert_eq!(
        event_lines(&[
            (0.0, "7E0#03BA1205"),
            (1.0, "7E8#02FA05"),
            (10.0, "7E0#02BE01"),
            (11.0, "7E8#037FBE31")
        ]),
        [
            "uds 7E0 > 7E8 system supplier specific: sid 0xBA, parameters 12 05, value 05, after 1 ms",
            "uds 7E0 > 7E8 system supplier specific: sid 0xBE, parameters 01, nrc 0x31 (requestOutOfRange), after 1 ms",
        ]
    );
}

#[test]
fn a_scan_of_all_services_does_not_make_a_server_one_of_kwp2000() {
    let read = (20.0, "7E0#0322F190");
    let value = (21.0, "7E8#0562F1904142");
    for (answer, expected) in [
        ("7E8#037F2111", "uds 7E0 > 7E8 ReadDataByIdentifier"),
        ("7E8#037F217F", "uds 7E0 > 7E8 ReadDataByIdentifier"),
        // It has the service.
        ("7E8#037F2131", "kwp2000 7E0 > 7E8 readDataByCommonIdentifier"),
        ("7E8#03610141", "kwp2000 7E0 > 7E8 readDataByCommonIdentifier"),
    ] {
        let said = event_lines(&[(0.0, "7E0#022101"), (1.0, answer), read, value]);
        assert!(said[0].starts_with("kwp2000 7E0 > 7E8 readDataByLocalIdentifier"), "{said:?}");
        assert!(said[1].starts_with(expected), "{said:?}");
    }
    // Nor does a refusal make a server of KWP2000 one of UDS.
    let said = event_lines(&[
        (0.0, "7E0#021A90"),
        (1.0, "7E8#035A9041"),
        (10.0, "7E0#022101"),
        (11.0, "7E8#037F2111"),
        read,
        value,
    ]);
    assert!(said[2].starts_with("kwp2000"), "{said:?}");
}

#[test]
fn services_of_kwp2000_have_its_names_where_uds_has_others() {
    let mut frames = vec![(0.0, "7E0#021A90".to_owned()), (1.0, "7E8#035A9041".to_owned())];
    let names = [
        (0x28, "disableNormalMessageTransmission"),
        (0x29, "enableNormalMessageTransmission"),
        (0x2C, "dynamicallyDefineLocalIdentifier"),
        (0x3A, "requestRoutineResultsByAddress"),
    ];
    for (number, (sid, _)) in names.iter().enumerate() {
        let time = 10.0 * (number + 1) as f64;
        frames.push((time, format!("7E0#02{sid:02X}01")));
        frames.push((time + 1.0, format!("7E8#02{:02X}01", sid | 0x40)));
    }
    let frames: Vec<_> = frames.iter().map(|(time, frame)| (*time, frame.as_str())).collect();
    let said = event_lines(&frames);
    for (event, (_, name)) in said[1..].iter().zip(names) {
        assert!(event.starts_with(&format!("kwp2000 7E0 > 7E8 {name}: ")), "{said:?}");
    }
    assert_eq!(said.len(), 5);
}

/// Its tester first ends a session as testers of KWP2000 do, which the server still answers; and it refuses another old service.
#[test]
fn a_server_of_uds_that_keeps_an_old_service_stays_one() {
    let said = event_lines(&[
        (0.0, "7E4#0120000000000000"),
        (10.0, "7EC#0160AAAAAAAAAAAA"),
        (1000.0, "7E4#0210030000000000"),
        (1010.0, "7EC#065003003201F4AA"),
        (1100.0, "7E4#0319020800000000"),
        (1110.0, "7EC#075902FF01281108"),
        (1200.0, "7E4#0322F18600000000"),
        (1210.0, "7EC#0462F18603AAAAAA"),
        (1300.0, "7E4#0318000000000000"),
        (1310.0, "7EC#037F1811AAAAAAAA"),
        (1400.0, "7E4#0227010000000000"),
        (1410.0, "7EC#06670111223344AA"),
    ]);
    let titles: Vec<_> = said.iter().map(|line| line.split(':').next().unwrap()).collect();
    assert_eq!(
        titles,
        [
            "kwp2000 7E4 > 7EC stopDiagnosticSession",
            "uds 7E4 > 7EC DiagnosticSessionControl",
            "uds 7E4 > 7EC ReadDTCInformation",
            "uds 7E4 > 7EC ReadDataByIdentifier",
            "kwp2000 7E4 > 7EC readDiagnosticTroubleCodesByStatus",
            "uds 7E4 > 7EC SecurityAccess",
        ]
    );
}

/// What was claimed by one old service is taken back by one that only UDS has.
#[test]
fn a_claim_of_kwp2000_is_taken_back_by_what_contradicts_it() {
    let said = event_lines(&[
        (0.0, "7E0#022101"),
        (1.0, "7E8#03610141"),
        (10.0, "7E0#0322F190"),
        (11.0, "7E8#0562F1904142"),
        (20.0, "7E0#03190208"),
        (21.0, "7E8#035902FF"),
        (30.0, "7E0#0322F190"),
        (31.0, "7E8#0562F1904142"),
    ]);
    assert!(said[1].starts_with("kwp2000 7E0 > 7E8 readDataByCommonIdentifier"), "{said:?}");
    assert!(said[3].starts_with("uds 7E0 > 7E8 ReadDataByIdentifier"), "{said:?}");
}

/// A tester of BMW's talks to one ECU after the other by the same identifier: the address says to which.
#[test]
fn every_server_behind_one_identifier_is_read_from_its_first_frame_on() {
    let mut frames = Vec::new();
    let mut now = 0.0;
    for ecu in [0x12, 0x18, 0x40, 0x60, 0x72] {
        for (from, rest) in [
            ("6F1", "0322F190"),
            ("", "101462F1905742"),
            ("6F1", "300000"),
            ("", "21415A5A5A3132"),
            ("", "22333435363738"),
            ("", "2339303132FFFF"),
        ] {
            now += 5.0;
            let frame = match from {
                "" => format!("6{ecu:02X}#F1{rest}"),
                from => format!("{from}#{ecu:02X}{rest}"),
            };
            frames.push((now, frame));
        }
        now += 200.0;
    }
    let vins: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
    let lines = event_lines(&vins);
    assert_eq!(lines.len(), 5, "{lines:?}");
    for (line, ecu) in lines.iter().zip(["12", "18", "40", "60", "72"]) {
        assert!(line.starts_with(&format!("uds 6F1/{ecu} > 6{ecu}/F1 ReadDataByIdentifier: ")), "{line}");
        assert!(line.ends_with("value \"WBAZZZ12345678901\", after 5 ms"), "{line}");
    }
    // One that is not there, and one request to all of them.
    let silent = [
        &vins[..12],
        &[(9000.0, "6F1#2903 22F190"), (20_000.0, "6F1#EF 02 3E00"), (20_001.0, "612#F1027E00")],
        &[(20_002.0, "618#F1027E00"), (30_000.0, "123#")],
    ]
    .concat();
    let silent: Vec<_> = silent.iter().map(|(at, frame)| (*at, frame.replace(' ', ""))).collect();
    let silent: Vec<_> = silent.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
    let lines = event_lines(&silent);
    assert_eq!(lines.len(), 5, "{lines:?}");
    assert!(
        lines[2].starts_with("uds 6F1/29 > 629/F1 ") && lines[2].ends_with("nothing came for 2000 ms"),
        "{lines:?}"
    );
    assert!(
        lines[3].starts_with("uds 6F1/EF > 612/F1 TesterPresent") && lines[3].contains("asked \"all\""),
        "{lines:?}"
    );
    assert!(lines[4].starts_with("uds 6F1/EF > 618/F1 TesterPresent"), "{lines:?}");
    let end = event_lines(&silent[..13]);
    assert!(end[2].starts_with("uds 6F1/29 > 629/F1 ") && end[2].ends_with("the trace ends here"), "{end:?}");
}

/// Toyota's gateway repeats the address of the ECU behind it.
#[test]
fn addresses_that_answers_repeat_are_conversations_of_their_own() {
    let mut frames = Vec::new();
    for (number, address) in ["40", "6D", "A7"].into_iter().enumerate() {
        for (ms, from, rest) in [
            (0.0, "750", "0210030000000000"),
            (4.0, "758", "06500300320 1F4"),
            (8.0, "750", "0322F19000000000"),
            (12.0, "758", "101462F1905742"),
            (16.0, "750", "300000"),
            (20.0, "758", "21415A5A5A3132"),
            (24.0, "758", "22333435363738"),
            (28.0, "758", "23393031"),
            (32.0, "750", "0319020000000000"),
            (36.0, "758", "037F1978"),
            (40.0, "758", "037F1912"),
        ] {
            let rest: String = rest.chars().filter(|letter| *letter != ' ').take(14).collect();
            frames.push((number as f64 * 1000.0 + ms, format!("{from}#{address}{rest}")));
        }
    }
    let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
    let lines = event_lines(&frames);
    assert_eq!(lines.len(), 9, "{lines:?}");
    for (line, place) in lines.iter().zip(0..) {
        let address = ["40", "6D", "A7"][place / 3];
        assert!(line.starts_with(&format!("uds 750/{address} > 758/{address} ")), "{line}");
    }
}

/// What explains nothing by itself: the request of a long answer on identifiers of a maker.
#[test]
fn a_long_answer_has_the_request_that_came_before_its_pair_was_known() {
    for [a, b] in [["713", "77D"], ["123", "345"], ["17FC007B", "17FE007B"], ["10203040", "10203041"]] {
        let frames = [
            (100_000.0, format!("{a}#0322F19055555555")),
            (100_010.0, format!("{b}#101462F190575657")),
            (100_011.0, format!("{a}#3000000000000000")),
            (100_020.0, format!("{b}#215A5A5A314B5A41")),
            (100_030.0, format!("{b}#2257303030303031")),
        ];
        let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
        assert_eq!(
            event_lines(&frames),
            [format!(
                "uds {a} > {b} ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), value \"WVWZZZ1KZAW000001\", after 10 ms"
            )]
        );
    }
}

/// Identifiers of 33 makers, with nothing but single frames: every exchange is there once, with its request.
#[test]
fn pairs_are_found_by_single_frames_and_nothing_before_is_missing() {
    const PAIRS: &str = "\
        713:77D 710:77A 7E0:7E8 714:77E 7B0:7B8 750:758 745:765 7E4:7EC 743:763 79B:7BB 6B6:696 \
        752:652 241:641 726:72E 760:768 18DA10F1:18DAF110 7C4:7CC 61C:61D 602:482 \
        18DA40F1:18DAF140 680:690 620:504 787:78F 24C:64C 18DB33F1:18DAF100 70E:778 61A:483 \
        781:789 7E7:7EF 6F1:610 18DADBF1:18DAF1DB 17FC0076:17FE0076 123:567";
    for pair in PAIRS.split(' ') {
        let (a, b) = pair.split_once(':').unwrap();
        let mut frames = Vec::new();
        for round in 0..5 {
            let lines = [
                (a, "023E000000000000"),
                (b, "027E00AAAAAAAAAA"),
                (a, "0210030000000000"),
                (b, "065003003201F4AA"),
                (a, "0322F19100000000"),
                (b, "0562F19101020000"),
            ];
            for (number, (id, data)) in lines.into_iter().enumerate() {
                frames.push((f64::from(round) * 200.0 + number as f64 * 10.0, format!("{id}#{data}")));
            }
        }
        let frames: Vec<_> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
        let lines = event_lines(&frames);
        assert_eq!(lines.len(), 15, "{pair}: {lines:?}");
        for line in &lines {
            assert!(
                line.starts_with(&format!("uds {a} > {b} ")) && line.contains("after 10 ms"),
                "{pair}: {line}"
            );
        }
    }
}

/// Frames were lost between a request and its answer, before anybody knew that they are a pair.
#[test]
fn a_loss_before_a_pair_is_known_is_said_of_what_it_touched() {
    let all = events(&[
        at(0.0, "123#023E0000"),
        at(1.0, "456#027E0000"),
        at(10.0, "123#023E0000"),
        testing::lost(10.5),
        at(11.0, "456#027E0000"),
        at(20.0, "123#023E0000"),
        at(21.0, "456#027E0000"),
    ]);
    let all: Vec<_> =
        all.iter().map(|event| (event.kind, event.time_ns / 1_000_000, event.frames_lost)).collect();
    assert_eq!(
        all,
        [(EventKind::Exchange, 1, false), (EventKind::Exchange, 11, true), (EventKind::Exchange, 21, false)]
    );
}

/// One identifier asks several servers, each of which has a tester's identifier of its own.
#[test]
fn requests_to_all_by_a_makers_identifier_have_every_answer() {
    let lines = event_lines(&[
        (0.0, "713#0322F19000000000"),
        (1.0, "77D#0462F19041000000"),
        (10.0, "714#0322F19000000000"),
        (11.0, "77E#0462F19042000000"),
        (20.0, "700#0322F19100000000"),
        (21.0, "77D#0462F19143000000"),
        (22.0, "77E#0462F19144000000"),
        (30.0, "713#0322F18C00000000"),
        (31.0, "77D#0462F18C45000000"),
    ]);
    let who: Vec<_> = lines.iter().map(|line| line.split(" ReadData").next().unwrap()).collect();
    assert_eq!(
        who,
        ["uds 713 > 77D", "uds 714 > 77E", "uds 700 > 77D", "uds 700 > 77E", "uds 713 > 77D"],
        "{lines:?}"
    );
    // It is heard first, and in no maker's table.
    let lines = event_lines(&[
        (20.0, "222#0322F19100000000"),
        (21.0, "333#0462F19143000000"),
        (22.0, "444#0462F19144000000"),
        (23.0, "555#037F223100000000"),
        (40.0, "222#0322F18C00000000"),
        (41.0, "333#0462F18C45000000"),
        (42.0, "444#0462F18C46000000"),
    ]);
    let who: Vec<_> = lines.iter().map(|line| line.split(" ReadData").next().unwrap()).collect();
    assert_eq!(
        who,
        ["uds 222 > 333", "uds 222 > 444", "uds 222 > 555", "uds 222 > 333", "uds 222 > 444"],
        "{lines:?}"
    );
    // It is heard first.
    let lines = event_lines(&[
        (20.0, "700#0322F19100000000"),
        (21.0, "77D#0462F19143000000"),
        (22.0, "77E#0462F19144000000"),
        (30.0, "713#0322F18C00000000"),
        (31.0, "77D#0462F18C45000000"),
        (40.0, "714#0322F18C00000000"),
        (41.0, "77E#0462F18C45000000"),
    ]);
    let who: Vec<_> = lines.iter().map(|line| line.split(" ReadData").next().unwrap()).collect();
    assert_eq!(who, ["uds 700 > 77D", "uds 700 > 77E", "uds 713 > 77D", "uds 714 > 77E"], "{lines:?}");
}

/// A maker's name stands for all of its pairs, a server that does not answer included.
#[test]
fn a_makers_pairs_need_no_evidence() {
    let event_lines = |maker: &str, frames: &[(f64, &str)]| {
        testing::event_lines(Diagnostics::new(&[maker.parse().unwrap()], true), frames)
    };
    let lines = event_lines(
        "vag",
        &[(0.0, "715#023E0000"), (3000.0, "715#0322F190"), (3001.0, "77F#0462F19041"), (9000.0, "123#")],
    );
    assert_eq!(lines.len(), 2, "{lines:?}");
    assert!(
        lines[0].starts_with("uds 715 > 77F TesterPresent") && lines[0].contains("nothing came"),
        "{lines:?}"
    );
    let lines = event_lines("BMW", &[(0.0, "6F1#29023E00"), (3000.0, "6F1#EF023E80"), (9000.0, "123#")]);
    assert!(lines[0].starts_with("uds 6F1/29 > 629/F1 TesterPresent"), "{lines:?}");
    assert!(lines[1].starts_with("uds 6F1/EF > all TesterPresent"), "{lines:?}");
}

/// Cyclic traffic of every shape, with identifiers anywhere but where the standard has its own: nothing is taken for an exchange.
#[test]
fn cyclic_traffic_makes_no_pair() {
    let mut random = fastrand::Rng::with_seed(2);
    for round in 0..48_u32 {
        let shape = round % 6;
        let ids: Vec<_> = (0..[20, 100, 400][random.usize(0..3)])
            .map(|_| {
                let id = match round / 6 % 3 {
                    0 => format!("{:03X}", random.u32(..0x7DF)),
                    1 => format!("{:08X}", random.u32(..1 << 29) & !0x00F0_0000),
                    _ => format!("{:03X}", random.u32(0x600..0x7DF)),
                };
                let bytes: Vec<u8> = (0..random.usize(1..9)).map(|_| random.u8(..)).collect();
                (id, bytes, random.u32(1..20))
            })
            .collect();
        let (mut diagnostics, mut events) = (diagnostics(), Vec::new());
        for tick in 0..500_u32 {
            for (id, own, every) in ids.iter().filter(|(.., every)| tick % every == 0) {
                let count = tick / every;
                let bytes: Vec<u8> = match shape {
                    0 => own.iter().map(|_| random.u8(..)).collect(),
                    1 => own.clone(),
                    2 => vec![own[0]; own.len()],
                    3 => vec![count as u8; own.len()],
                    // A counter, states, and zeros: as most signals are.
                    4 => own
                        .iter()
                        .enumerate()
                        .map(|(at, byte)| if at == 0 { count as u8 & 15 } else { byte & 3 })
                        .collect(),
                    _ => own
                        .iter()
                        .map(|byte| if random.u8(0..8) == 0 { random.u8(..8) } else { byte & 0x73 })
                        .collect(),
                };
                let at_ms = f64::from(tick) * 10.0 + f64::from(*every) / 100.0;
                diagnostics.take(&at(at_ms, &format!("{id}#{}", hex(&bytes))), &mut events);
            }
        }
        diagnostics.finish(&mut events);
        let claimed: Vec<_> = events.iter().filter(|event| event.protocol != Protocol::IsoTp).collect();
        let claimed: Vec<_> = claimed.iter().map(ToString::to_string).collect();
        assert!(claimed.is_empty(), "round {round}: {claimed:?}");
    }
}

/// A cyclic frame that looks like a request is not taken for one because a server answers its own tester at that time.
#[test]
fn another_identifier_with_the_same_bytes_does_not_ask() {
    let frames = [
        (0.0, "7E0#023E000000000000"),
        (1.0, "123#023E000000000000"),
        (2.0, "7E8#027E00AAAAAAAAAA"),
        (100.0, "123#023E000000000000"),
        (200.0, "7E0#023E000000000000"),
        (201.0, "123#023E000000000000"),
        (202.0, "7E8#027E00AAAAAAAAAA"),
    ];
    let lines = event_lines(&frames);
    assert_eq!(lines.len(), 2, "{lines:?}");
    assert!(lines.iter().all(|line| line.starts_with("uds 7E0 > 7E8 TesterPresent")), "{lines:?}");
}

/// Stamps of a coarse clock: a request and its answer have the same one.
#[test]
fn what_is_read_later_is_in_the_order_in_which_it_was_heard() {
    let lines = event_lines(&[
        (0.0, "456#027E000000000000"),
        (10.0, "123#023E000000000000"),
        (10.0, "456#027E000000000000"),
        (20.0, "123#021003"),
        (20.0, "456#065003003201F4"),
    ]);
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert!(
        lines[1].starts_with("uds 123 > 456 TesterPresent") && lines[1].ends_with("after 0 ms"),
        "{lines:?}"
    );
    assert!(lines[2].starts_with("uds 123 > 456 DiagnosticSessionControl"), "{lines:?}");
}

/// OBD-II over UDS: values of known length, so that a value with the next identifier's bytes in it is read, too.
#[test]
fn parameters_read_by_identifier_have_their_values() {
    let lines = event_lines(&[
        (0.0, "7E0#0322F40CAAAAAAAA"),
        (0.01, "7E8#0562F40C1AF8AAAA"),
        (0.1, "7E0#0522F40CF405AAAA"),
        (0.11, "7E8#100862F40CF405F4"),
        (0.12, "7E0#300000AAAAAAAAAA"),
        (0.13, "7E8#21057BAAAAAAAAAA"),
    ]);
    assert_eq!(lines.len(), 2, "{lines:#?}");
    assert!(lines[0].contains("did 0xF40C (engine_speed), engine_speed 1726 rpm"), "{}", lines[0]);
    assert!(lines[1].contains("engine_speed 15617.25 rpm, coolant_temperature 83 °C"), "{}", lines[1]);
}
