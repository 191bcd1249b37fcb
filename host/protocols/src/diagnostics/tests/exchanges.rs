//! Requests with their responses, and what stands in them.

use super::*;

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
    let gap = TraceRecord { time_ns: 1_000_000, device_ns: None, channel: 1, event: TraceEvent::GAP };
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
