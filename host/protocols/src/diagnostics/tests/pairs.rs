//! Which identifiers belong together.

use super::*;

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
