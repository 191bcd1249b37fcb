use super::*;
use crate::testing::{self, at, hex, lost};

fn event_lines(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(CanOpen::default(), frames)
}

#[test]
fn what_the_network_is_told_and_what_nodes_are() {
    assert_eq!(
        event_lines(&[
            (0.0, "705#00"),
            (1.0, "000#0105"),
            (2.0, "705#05"),
            (3.0, "000#8200"),
            (4.0, "085#308104000000000A"),
            (5.0, "100#00286C0A5034"),
            (6.0, "705#7F"),
        ]),
        [
            "canopen 5 boot-up",
            "canopen ? > 5 start: command 1",
            "canopen 5 operational: before \"boot-up\"",
            "canopen ? > all reset communication: command 130",
            "canopen 5 emergency: code 0x8130 (life guard or heartbeat error), register 0x04 (voltage), \
             manufacturer 00 00 00 00 0A",
            "canopen ? time: days_since_1984 13392, time_of_day_s 174860.288 s",
            "canopen 5 pre-operational: before \"operational\"",
        ]
        .map(str::to_owned)
    );
}

#[test]
fn a_heartbeat_that_stops_and_comes_back_is_said() {
    let beats = [
        (0.0, "705#05"),
        (100.0, "705#05"),
        (200.0, "705#05"),
        (600.0, "123#"),
        (700.0, "705#05"),
        (800.0, "705#05"),
    ];
    assert_eq!(
        event_lines(&beats),
        [
            "canopen 5 operational",
            "canopen 5 heartbeat missing: period_ms 100 ms; nothing came for 250 ms",
            "canopen ? RPDO1: data nothing",
            "canopen 5 heartbeat is back: operational",
        ]
        .iter()
        .filter(|line| !line.contains("RPDO"))
        .map(|line| (*line).to_owned())
        .collect::<Vec<_>>()
    );
    // Configured by SDO, it is known before the second heartbeat.
    let set =
        [(0.0, "605#2B17100032000000"), (1.0, "585#6017100000000000"), (2.0, "705#05"), (500.0, "200#")];
    assert_eq!(event_lines(&set)[2], "canopen 5 heartbeat missing: period_ms 50 ms; nothing came for 125 ms");
    // If frames were lost, heartbeats may be among them.
    let records =
        [at(0.0, "705#05"), at(100.0, "705#05"), lost(150.0), at(900.0, "705#05"), at(1000.0, "705#05")];
    let events = testing::events(CanOpen::default(), &records);
    assert_eq!(events.len(), 1, "{events:?}");
}

#[test]
fn guarding_is_followed() {
    let guard = [
        (0.0, "705#R1"),
        (1.0, "705#05"),
        (100.0, "705#R1"),
        (101.0, "705#85"),
        (200.0, "705#R1"),
        (201.0, "705#85"),
        (300.0, "705#R1"),
        (900.0, "200#"),
    ];
    assert_eq!(
        event_lines(&guard),
        [
            "canopen 5 operational: after 1 ms",
            "canopen 5 operational; frame 1 came instead of 0",
            "canopen 5 no answer to guarding; nothing came for 500 ms",
        ]
        .map(str::to_owned)
    );
}

#[test]
fn sdo_transfers_of_every_kind_are_one_event() {
    for (frames, expected) in [
        (
            &[(0.0, "605#4018100100000000"), (1.0, "585#4318100178563412")][..],
            "canopen ? > 5 SDO read 1018:01: index 0x1018 (identity object), sub 0x01, transport \"expedited\", value 0x12345678, after 1 ms",
        ),
        (
            &[(0.0, "605#2B171000E8030000"), (2.0, "585#6017100000000000")],
            "canopen ? > 5 SDO write 1017:00: index 0x1017 (producer heartbeat time), sub 0x00, transport \"expedited\", value 1000, after 2 ms",
        ),
        (
            &[(0.0, "605#4000200000000000"), (1.0, "585#8000200000000206")],
            "canopen ? > 5 SDO read 2000:00: index 0x2000, sub 0x00, abort 0x06020000 (object does not exist), after 1 ms; \
             aborted: object does not exist",
        ),
        (
            &[
                (0.0, "605#4008100000000000"),
                (1.0, "585#410810000A000000"),
                (2.0, "605#6000000000000000"),
                (3.0, "585#0054686520647269"),
                (4.0, "605#7000000000000000"),
                (5.0, "585#1976657200000000"),
            ],
            "canopen ? > 5 SDO read 1008:00: index 0x1008 (manufacturer device name), sub 0x00, transport \"segmented\", \
             value \"The driver\", after 1 ms",
        ),
        (
            &[(0.0, "605#4018100100000000")],
            "canopen ? > 5 SDO read 1018:01: index 0x1018 (identity object), sub 0x01, transport \"expedited\"; the trace ends here",
        ),
        (
            &[(0.0, "605#4018100100000000"), (3000.0, "200#")],
            "canopen ? > 5 SDO read 1018:01: index 0x1018 (identity object), sub 0x01, transport \"expedited\"; nothing came for 2000 ms",
        ),
    ] {
        assert_eq!(event_lines(frames), [expected], "{frames:?}");
    }
}

/// The toggle bit reveals a segment that is missing or comes twice.
#[test]
fn a_missing_segment_is_said() {
    let said = event_lines(&[
        (0.0, "605#4008100000000000"),
        (1.0, "585#410810000A000000"),
        (2.0, "605#6000000000000000"),
        (5.0, "585#1976657200000000"),
    ]);
    assert!(said[0].ends_with("frame 1 came instead of 0"), "{said:?}");
}

#[test]
fn blocks_are_put_together_with_what_is_sent_again() {
    let data: Vec<u8> = (0..40).collect();
    let mut frames = vec!["605#C600200028000000".to_owned(), "585#A400200004000000".to_owned()];
    let segment = |number: u8, last: bool, from: usize| {
        let mut bytes = data[from..data.len().min(from + 7)].to_vec();
        bytes.resize(7, 0);
        format!("605#{:02X}{}", number | if last { 0x80 } else { 0 }, hex(&bytes))
    };
    for number in 1..=4_u8 {
        frames.push(segment(number, false, usize::from(number - 1) * 7));
    }
    // The fourth was not received, and is sent again in a block of three.
    frames.push("585#A203030000000000".to_owned());
    frames.extend([segment(1, false, 21), segment(2, false, 28), segment(3, true, 35)]);
    frames.push("585#A203040000000000".to_owned());
    let crc = 0x81AF_u16;
    frames.push(format!("605#C9{}0000000000", hex(&crc.to_le_bytes())));
    frames.push("585#A100000000000000".to_owned());
    let records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
    let events = testing::events(CanOpen::default(), &records);
    assert_eq!(events.len(), 1, "{:?}", events.iter().map(ToString::to_string).collect::<Vec<_>>());
    assert_eq!(events[0].data[..], data);
    let text = events[0].to_string();
    assert!(text.contains("\"block\"") && events[0].trouble.is_none(), "{text}");
}

#[test]
fn pdos_carry_what_was_written_or_what_the_sheet_says() {
    let learned = [
        (0.0, "605#2F001A0002000000"),
        (1.0, "585#60001A0000000000"),
        (2.0, "605#23001A0110004160"),
        (3.0, "585#60001A0100000000"),
        (4.0, "605#23001A0220006460"),
        (5.0, "585#60001A0200000000"),
        (6.0, "605#2300180190010000"),
        (7.0, "585#6000180100000000"),
        (8.0, "190#3702785634120000"),
    ];
    assert_eq!(
        event_lines(&learned).last().unwrap(),
        "canopen 5 TPDO1: statusword 0x0237 (operation enabled), status_flags \"voltage enabled, remote\", \
         position actual value 305419896, rest 00 00"
    );
    let sheet = "[DeviceInfo]\n[1A00]\nObjectType=9\n[1A00sub0]\nDefaultValue=2\n[1A00sub1]\nDefaultValue=0x60410010\n\
        [1A00sub2]\nDefaultValue=0x60640020\n[6041]\nParameterName=Statusword\nDataType=6\n[6064]\nParameterName=Position\nDataType=4\n";
    let eds = Arc::new(Eds::parse(sheet.as_bytes()));
    assert_eq!(eds.issues, [] as [String; 0]);
    let with = CanOpen::new(vec![Sheet { node: None, eds }]);
    assert_eq!(
        testing::event_lines(with, &[(0.0, "185#3702FFFFFFFF")]),
        [
            "canopen 5 TPDO1: Statusword 0x0237 (operation enabled), status_flags \"voltage enabled, remote\", Position -1"
        ]
    );
}

/// By its words, its device type or its sheet; a node of another profile has other things there.
#[test]
fn the_words_of_a_drive_are_states_and_commands() {
    let talk = [
        (0.0, "605#2F60600001000000"),
        (1.0, "585#6060600000000000"),
        (2.0, "605#2B4060001F000000"),
        (3.0, "585#6040600000000000"),
        (4.0, "605#4041600000000000"),
        (5.0, "585#4B41600037120000"),
        (6.0, "605#4061600000000000"),
        (7.0, "585#4F61600001000000"),
        (8.0, "605#403F600000000000"),
        (9.0, "585#4B3F600011860000"),
        (10.0, "085#1186200000000000"),
        (11.0, "605#4064600000000000"),
        (12.0, "585#43646000FFFFFFFF"),
    ];
    let value = |line: &String| line.split("\"expedited\", ").nth(1).unwrap_or(line).to_owned();
    let lines: Vec<_> = event_lines(&talk).iter().map(value).collect();
    assert_eq!(
        lines,
        [
            "value 0x01, after 1 ms",
            "value 0x001F (enable operation), control_flags \"new set-point\", after 1 ms",
            "value 0x1237 (operation enabled), status_flags \"voltage enabled, remote, set-point acknowledged\", after 1 ms",
            "value 1 (profile position), after 1 ms",
            "value 0x8611 (following error), after 1 ms",
            "canopen 5 emergency: code 0x8611 (following error), register 0x20 (device profile), manufacturer 00 00 00 00 00",
            "value -1, after 1 ms",
        ]
    );
    // An input module (CiA 401) has filters there.
    let other = [
        (0.0, "605#4000100000000000"),
        (1.0, "585#4300100091010300"),
        (2.0, "605#4041600000000000"),
        (3.0, "585#4B41600037020000"),
        (4.0, "085#1186200000000000"),
    ];
    let lines = event_lines(&other);
    assert!(lines[1].ends_with("value 0x0237, after 1 ms"), "{lines:?}");
    assert!(lines[2].contains("0x8611 (reserved)"), "{lines:?}");
}

#[test]
fn layer_settings_and_sync_counters() {
    assert_eq!(
        event_lines(&[
            (0.0, "7E5#0401000000000000"),
            (1.0, "7E5#1107000000000000"),
            (2.0, "7E4#1100000000000000")
        ]),
        [
            "canopen ? LSS switch state global: mode 1 (configuration)",
            "canopen ? LSS configure node number: node 7",
            "canopen ? LSS configure node number: error 0 (success), device_error 0, after 1 ms",
        ]
        .map(str::to_owned)
    );
    assert_eq!(
        event_lines(&[(0.0, "080#01"), (1.0, "080#02"), (2.0, "080#04"), (3.0, "080#01")]),
        ["canopen ? SYNC: counter 1", "canopen ? SYNC: counter 4; frame 4 came instead of 3"]
            .map(str::to_owned)
    );
}

/// Any frames are accepted without a panic.
#[test]
fn any_frames_are_taken() {
    let mut random = fastrand::Rng::with_seed(301);
    let mut assembler = CanOpen::default();
    let mut events = Vec::new();
    for number in 0..300_000_u32 {
        let id = random
            .choice([0, 0x80, 0x85, 0x100, 0x185, 0x205, 0x585, 0x605, 0x605, 0x585, 0x705, 0x7E4, 0x7E5])
            .unwrap();
        let bytes: Vec<u8> =
            (0..if random.u8(0..4) == 0 { random.usize(0..=8) } else { 8 }).map(|_| random.u8(..)).collect();
        assembler.take(&at(f64::from(number) / 20.0, &format!("{id:03X}#{}", hex(&bytes))), &mut events);
        for event in events.drain(..) {
            let _ = event.to_string();
        }
    }
    assembler.finish(&mut events);
}

/// Nodes wait as long as they were configured to; a node whose life time has passed is no longer guarded.
#[test]
fn timeouts_are_those_that_were_set() {
    let told = event_lines(&[
        (0.0, "601#23161001C8000500"),
        (1.0, "581#6016100100000000"),
        (10.0, "705#05"),
        (110.0, "705#05"),
        (400.0, "080#"),
    ]);
    let missing = told.iter().find(|line| line.contains("heartbeat missing")).unwrap();
    assert!(missing.ends_with("nothing came for 200 ms"), "{told:?}");
    let guarded = event_lines(&[
        (0.0, "605#2B0C100064000000"),
        (1.0, "585#600C100000000000"),
        (2.0, "605#2F0D100003000000"),
        (3.0, "585#600D100000000000"),
        (10.0, "705#R1"),
        (11.0, "705#05"),
        (110.0, "705#R1"),
        (111.0, "705#85"),
        (300.0, "080#"),
        (500.0, "080#"),
        (900.0, "080#"),
    ]);
    let stopped: Vec<_> = guarded.iter().filter(|line| line.contains("guarding has stopped")).collect();
    assert_eq!(stopped.len(), 1, "{guarded:?}");
    assert!(stopped[0].ends_with("nothing came for 300 ms"), "{guarded:?}");
}

/// A drive whose sheet has its own identifiers, for its number (first) and for any number (second).
#[test]
fn a_sheet_says_which_identifiers_pdos_have() {
    const SHEET: &str = "[DeviceInfo]\n[1800]\nParameterName=T\nObjectType=9\n[1800sub1]\nDataType=7\nDefaultValue=$NODEID+0x400001A0\n\
        [1A00]\nParameterName=M\nObjectType=9\n[1A00sub0]\nDataType=5\nDefaultValue=2\n[1A00sub1]\nDataType=7\nDefaultValue=0x20000003\n\
        [1A00sub2]\nDataType=7\nDefaultValue=0x2001000D\n[1804]\nParameterName=T5\nObjectType=9\n[1804sub1]\nDataType=7\n\
        DefaultValue=0x80000000\n[1805]\nParameterName=T6\nObjectType=9\n[1805sub1]\nDataType=7\nDefaultValue=0x6A5\n\
        [2000]\nParameterName=Mode\nDataType=5\n[2001]\nParameterName=Speed\nDataType=6\n";
    let event_lines = |node: Option<u8>, frames: &[(f64, &str)]| {
        let sheet = Sheet { node, eds: Eds::parse(SHEET.as_bytes()).into() };
        testing::event_lines(CanOpen::new(vec![sheet]), frames)
    };
    // Three and thirteen bits: 5, and 0x123.
    for node in [Some(5), None] {
        assert_eq!(event_lines(node, &[(0.0, "1A5#1D09")]), ["canopen 5 TPDO1: Mode 5, Speed 291"]);
        assert_eq!(
            event_lines(node, &[(0.0, "1A5#1D")]),
            ["canopen 5 TPDO1: Mode 5, rest 03; malformed: shorter than what is mapped to it"]
        );
    }
    assert_eq!(event_lines(Some(5), &[(0.0, "6A5#01")]), ["canopen 5 TPDO6: data 01"]);
    assert_eq!(event_lines(None, &[(0.0, "6A5#01")]), [""; 0]);
}

#[test]
fn what_is_not_as_the_protocol_has_it_is_said() {
    let all = event_lines(&[
        (0.0, "000#01"),
        (1.0, "000#7705"),
        (2.0, "085#00"),
        (3.0, "100#00"),
        (4.0, "705#03"),
        (5.0, "7E5#99"),
    ]);
    for (line, expected) in all.iter().zip([
        "network management: data 01; malformed: a command has 2 bytes",
        "network management: data 77 05; malformed: an unknown command",
        "5 emergency: data 00; malformed: an emergency has 8 bytes",
        "time: data 00; malformed: a time has 6 bytes",
        "5 state: data 03; malformed: an unknown state",
        "LSS, unknown service: service 0x99, data nothing",
    ]) {
        assert!(line.ends_with(expected), "{line}");
    }
    assert_eq!(all.len(), 6, "{all:?}");
}

#[test]
fn a_transfer_that_another_one_leaves_behind_is_said() {
    // A block is being read when the client requests something else.
    let all = event_lines(&[
        (0.0, "605#A408100014000000"),
        (1.0, "585#C608100014000000"),
        (2.0, "605#A300000000000000"),
        (3.0, "585#0141414141414141"),
        (4.0, "605#4000100000000000"),
        (5.0, "585#4300100091010000"),
    ]);
    assert_eq!(all.len(), 2, "{all:?}");
    assert!(
        all[0].contains("SDO read 1008:00") && all[0].ends_with("the next one began before it was complete"),
        "{all:?}"
    );
    assert!(all[1].contains("value 0x00000191"), "{all:?}");
    // Segments without a beginning are reported once.
    let orphans = event_lines(&[
        (0.0, "605#0041414141414141"),
        (1.0, "585#2000000000000000"),
        (2.0, "605#1041414141414141"),
        (3.0, "585#3000000000000000"),
    ]);
    assert_eq!(orphans.len(), 1, "{orphans:?}");
    // A server that does not support blocks answers differently.
    let without = event_lines(&[
        (0.0, "605#A408100014000000"),
        (1.0, "585#4108100009000000"),
        (2.0, "605#6000000000000000"),
        (3.0, "585#0041424344454647"),
        (4.0, "605#7000000000000000"),
        (5.0, "585#1B48490000000000"),
    ]);
    assert!(without.len() == 1 && without[0].contains("value \"ABCDEFGHI\""), "{without:?}");
}

/// Written to a node, read from it, or told by its sheet: frames on its second channel are SDO and nothing else.
#[test]
fn sdo_servers_beyond_the_first_are_followed() {
    let set = [
        (0.0, "605#2301120145060000"),
        (1.0, "585#6001120100000000"),
        (2.0, "605#23011202C5050000"),
        (3.0, "585#6001120200000000"),
    ];
    let talk = [
        // Both channels at once: each has its own transfer.
        (10.0, "645#4008100000000000"),
        (10.5, "605#4018100100000000"),
        (11.0, "5C5#4108100009000000"),
        (11.5, "585#4318100178563412"),
        (12.0, "645#6000000000000000"),
        (13.0, "5C5#0041207365636F6E"),
        (14.0, "645#7000000000000000"),
        (15.0, "5C5#1B64210000000000"),
        (16.0, "645#4000300000000000"),
        (17.0, "5C5#8000300000000206"),
        (18.0, "645#4000300000000000"),
        (5000.0, "123#"),
    ];
    let lines = event_lines(&[&set[..], &talk].concat());
    let on_second: Vec<_> = lines.iter().filter(|line| line.contains("cob_id 0x645")).collect();
    assert_eq!(on_second.len(), 3, "{lines:?}");
    assert!(on_second[0].contains("transport \"segmented\", value \"A second!\""), "{lines:?}");
    assert!(on_second[1].contains("abort 0x06020000"), "{lines:?}");
    assert!(on_second[2].contains("nothing came for 2000 ms"), "{lines:?}");
    assert!(
        lines.iter().any(|line| line.contains("SDO read 1018:01") && !line.contains("cob_id")),
        "{lines:?}"
    );
    let sheet = "[1201]\nParameterName=Second\nObjectType=0x9\nSubNumber=3\n\
        [1201sub1]\nParameterName=In\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\nDefaultValue=$NODEID+0x640\n\
        [1201sub2]\nParameterName=Out\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\nDefaultValue=$NODEID+0x5C0\n";
    let eds = Arc::new(Eds::parse(sheet.as_bytes()));
    for node in [None, Some(5)] {
        let canopen = CanOpen::new(vec![Sheet { node, eds: eds.clone() }]);
        let lines = testing::event_lines(canopen, &talk);
        assert_eq!(
            lines
                .iter()
                .filter(|line| line.contains("> 5 SDO read") && line.contains("cob_id 0x645"))
                .count(),
            3,
            "{lines:?}"
        );
    }
}

/// Nothing that was said about one object is shown as the value of another.
#[test]
fn an_answer_about_another_object_is_not_the_answer() {
    let said = event_lines(&[
        (0.0, "605#4000100000000000"),
        (1.0, "585#4308100001020304"),
        (2.0, "585#4300100092010200"),
        (3.0, "605#2B171000E8030000"),
        (4.0, "585#6018100000000000"),
        (5.0, "585#6017100000000000"),
    ]);
    assert_eq!(said.len(), 4, "{said:?}");
    assert!(
        said[0].contains("SDO read 1008:00") && said[0].ends_with("its beginning is missing"),
        "{said:?}"
    );
    assert!(said[1].contains("1000:00") && said[1].ends_with("value 0x00020192, after 2 ms"), "{said:?}");
    assert!(
        said[2].contains("SDO write 1018:00") && said[2].ends_with("its beginning is missing"),
        "{said:?}"
    );
    assert!(said[3].contains("1017:00") && said[3].ends_with("value 1000, after 2 ms"), "{said:?}");
}

#[test]
fn an_sdo_frame_without_its_unused_bytes_is_read_and_reported() {
    // As in python-canopen's tests, from a device.
    for (frames, expected) in [
        (
            &[(0.0, "602#4000140200000000"), (1.0, "582#4F001402FE")][..],
            "canopen ? > 2 SDO read 1400:02: index 0x1400 (RPDO communication parameter), sub 0x02, transport \"expedited\", \
             value 254, after 1 ms; malformed: an SDO frame has 8 bytes",
        ),
        (
            &[(0.0, "602#2B171000A00F"), (1.0, "582#60171000")],
            "canopen ? > 2 SDO write 1017:00: index 0x1017 (producer heartbeat time), sub 0x00, transport \"expedited\", \
             value 4000, after 1 ms; malformed: an SDO frame has 8 bytes",
        ),
        (
            &[(0.0, "602#40081000"), (1.0, "582#4108100002000000"), (2.0, "602#60"), (3.0, "582#0B4142")],
            "canopen ? > 2 SDO read 1008:00: index 0x1008 (manufacturer device name), sub 0x00, transport \"segmented\", \
             value \"AB\", after 1 ms; malformed: an SDO frame has 8 bytes",
        ),
    ] {
        assert_eq!(event_lines(frames), [expected]);
    }
    // What lacks used bytes is not read.
    let said = event_lines(&[(0.0, "602#4000140200000000"), (1.0, "582#43001402FE")]);
    assert!(said[0].contains("malformed: an SDO frame has 8 bytes"), "{said:?}");
    assert!(said[1].contains("SDO read 1400:02") && said[1].contains("the trace ends here"), "{said:?}");
}

#[test]
fn a_signed_integer_of_a_few_bits_keeps_its_sign() {
    // The PDO of python-canopen's tests.
    const SHEET: &str = "[DeviceInfo]\n[1A00]\nObjectType=9\n[1A00sub0]\nDefaultValue=6\n[1A00sub1]\nDefaultValue=0x20010010\n\
        [1A00sub2]\nDefaultValue=0x20020004\n[1A00sub3]\nDefaultValue=0x20030004\n[1A00sub4]\nDefaultValue=0x20040020\n\
        [1A00sub5]\nDefaultValue=0x20050001\n[1A00sub6]\nDefaultValue=0x20060001\n[2001]\nParameterName=A\nDataType=3\n\
        [2002]\nParameterName=B\nDataType=5\n[2003]\nParameterName=C\nDataType=2\n[2004]\nParameterName=D\nDataType=4\n\
        [2005]\nParameterName=E\nDataType=1\n[2006]\nParameterName=F\nDataType=1\n";
    let event_lines = |frame| {
        let sheet = Sheet { node: Some(1), eds: Eds::parse(SHEET.as_bytes()).into() };
        testing::event_lines(CanOpen::new(vec![sheet]), &[(0.0, frame)])
    };
    assert_eq!(
        event_lines("181#FDFFEF0403020102"),
        ["canopen 1 TPDO1: A -3, B 15, C -2, D 16909060, E 0, F 1"]
    );
    // What is left is shown unless it only fills up the last byte.
    assert_eq!(
        event_lines("181#FDFF7F0403020106"),
        ["canopen 1 TPDO1: A -3, B 15, C 7, D 16909060, E 0, F 1, rest 01"]
    );
}
