//! Which of the protocols a server speaks: UDS, KWP2000, OBD.

use super::*;

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
