use std::sync::Arc;

use cantap_signals::{Decoder, Source, dbc};
use cantap_trace::TraceEvent;

use super::*;
use crate::testing::{self, at, hex, lost};

fn event_lines(frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(J1939::default(), frames)
}

/// Active trouble codes: two of them, ten bytes by broadcast.
const DM1: [(f64, &str); 3] = [
    (0.0, "1CECFF00#200A0002FFCAFE00"),
    (50.0, "1CEBFF00#0104FFBE0A038221"),
    (100.0, "1CEBFF00#021F037FFFFFFFFF"),
];

#[test]
fn a_broadcast_of_trouble_codes_is_one_message() {
    assert_eq!(
        event_lines(&DM1),
        [
            "j1939 0 > all DM1 active trouble codes: pgn 65226, priority 7, transport \"BAM\", length 10 bytes, \
          malfunction_lamp \"off\", red_stop_lamp \"off\", amber_warning_lamp \"on\", protect_lamp \"off\", trouble_codes 2, \
          codes \"SPN 2750 FMI 3 (voltage above normal or shorted high) 2 times in an old conversion: SPN 389200 by version 1, 22000 by version 2, \
          SPN 7969 FMI 3 (voltage above normal or shorted high)\", spn 2750, fmi 3, occurrences 2, spn 7969, fmi 3, occurrences not available"
        ]
    );
}

#[test]
fn missing_frames_are_said() {
    let broken = event_lines(&[DM1[0], DM1[2]]);
    assert_eq!(broken.len(), 1);
    assert!(broken[0].ends_with("received 0 bytes; frame 2 came instead of 1"), "{broken:?}");
    let late = event_lines(&[DM1[0], DM1[1], (2000.0, "18FEF100#0000000000000000")]);
    assert!(late[0].ends_with("received 7 bytes; nothing came for 750 ms"), "{late:?}");
    let headless = event_lines(&DM1[1..]);
    assert_eq!(headless.len(), 1, "{headless:?}");
    assert!(headless[0].ends_with("its beginning is missing"), "{headless:?}");
    let unfinished = event_lines(&DM1[..2]);
    assert!(unfinished[0].ends_with("the trace ends here"), "{unfinished:?}");
    let records = [at(0.0, DM1[0].1), lost(10.0), at(50.0, DM1[1].1), at(100.0, DM1[2].1)];
    assert!(testing::events(J1939::default(), &records)[0].frames_lost);
}

#[test]
fn connections_are_followed_with_their_times() {
    let frames = [
        (0.0, "18EC2100#1017000 4FFEBFE00"),
        (5.0, "18EC0021#110201FFFFEBFE00"),
        (10.0, "18EB2100#0141424344454647"),
        (11.0, "18EB2100#0248494A4B4C4D4E"),
        // The second one is requested again.
        (12.0, "18EC0021#110302FFFFEBFE00"),
        (13.0, "18EB2100#0248494A4B4C4D4E"),
        (14.0, "18EB2100#034F505152535455"),
        (15.0, "18EB2100#0456572AFFFFFFFF"),
        (16.0, "18EC0021#13170004FFEBFE00"),
    ];
    let frames = frames.map(|(ms, frame)| (ms, frame.replace(' ', "")));
    let frames: Vec<_> = frames.iter().map(|(ms, frame)| (*ms, frame.as_str())).collect();
    let expected = "j1939 0 > 33 CI component identification: pgn 65259, priority 6, transport \"RTS/CTS\", length 23 bytes, \
                    rts_to_cts_ms 5 ms, text \"ABCDEFGHIJKLMNOPQRSTUVW\"";
    assert_eq!(event_lines(&frames), [expected]);
    // Without the repetition, the missing frame is reported at the acknowledgement.
    let without: Vec<_> = [&frames[..3], &frames[7..]].concat();
    assert!(event_lines(&without)[0].ends_with("frame 4 came instead of 2"), "{:?}", event_lines(&without));
    let aborted = event_lines(&[frames[0], (1.0, "18EC0021#FF01FFFFFFEBFE00")]);
    assert!(aborted[0].ends_with("aborted: the receiver has as many connections as it can"), "{aborted:?}");
}

#[test]
fn long_messages_come_by_the_extended_protocol() {
    let size = 2000_usize;
    let data: Vec<u8> = (0..size).map(|at| at as u8).collect();
    let mut frames = vec!["18C82100#14D0070000EBFE00".to_owned(), "18C80021#15FF010000EBFE00".to_owned()];
    for (at, chunk) in data.chunks(7).enumerate() {
        if at % 200 == 0 {
            let count = (size.div_ceil(7) - at).min(200);
            let offset = hex(&(at as u32).to_le_bytes()[..3]);
            frames.push(format!("18C82100#16{count:02X}{offset}EBFE00"));
        }
        let mut bytes = chunk.to_vec();
        bytes.resize(7, 0xFF);
        frames.push(format!("18C72100#{:02X}{}", at % 200 + 1, hex(&bytes)));
    }
    let records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
    let events = testing::events(J1939::default(), &records);
    assert_eq!(events.len(), 1, "{:?}", events.iter().map(ToString::to_string).collect::<Vec<_>>());
    assert_eq!((&events[0].data[..], events[0].trouble), (&data[..], None));
}

#[test]
fn requests_are_answered_or_not() {
    let said = event_lines(&[
        (0.0, "18EA00F9#EBFE00"),
        (3.0, "18E8FF00#01FFFFFFF9EBFE00"),
        (10.0, "18EA03F9#E5FE00"),
        (13.0, "18FEE503#0102030405060708"),
        (20.0, "18EA03F9#E6FE00"),
        (2000.0, "18FEF100#"),
    ]);
    assert_eq!(
        said[1],
        "j1939 0 > all acknowledgement: pgn 59392, priority 6, control 1 (no), group_function 255, \
         requested 65259 (CI component identification), of 249, after 3 ms"
    );
    assert!(
        said[3].ends_with("engine_hours 3365299.25 h, engine_revolutions 134678021000 r, after 3 ms"),
        "{said:?}"
    );
    assert_eq!(
        said[5],
        "j1939 249 > 3 request: pgn 59904, requested 65254 (TD time and date), response \"none\"; nothing came for 1250 ms"
    );
}

/// On a boat with two nodes of one address, times until the response were negative.
#[test]
fn what_was_on_its_way_when_it_was_asked_for_is_no_response() {
    let again = DM1.map(|(ms, frame)| (ms + 200.0, frame));
    let request = [(60.0, "18EA00F9#CAFE00")];
    let said = event_lines(&[&DM1[..2], &request, &DM1[2..], &again].concat());
    assert_eq!(said.len(), 3, "{said:?}");
    assert!(!said[1].contains(", after"), "{said:?}");
    assert!(said[2].ends_with(", after 140 ms"), "{said:?}");
}

#[test]
fn addresses_are_claimed_and_lost() {
    let said = event_lines(&[
        (0.0, "18EEFF00#0100A0FF00000080"),
        (1.0, "18EEFF00#0000A0FF00000080"),
        (2.0, "18EEFFFE#0100A0FF00000080"),
    ]);
    assert_eq!(
        said[0],
        "j1939 0 > all address claimed: pgn 60928, priority 6, name 0x80000000FFA00001, identity 1, manufacturer 2045, \
         ecu_instance 0, function_instance 0, function 0 (engine), vehicle_system 0, vehicle_system_instance 0, \
         industry_group 0 (global), arbitrary_address_capable 1 (takes any address)"
    );
    assert!(said[1].ends_with("address_lost_by 0x80000000FFA00001"), "{said:?}");
    assert!(said[2].starts_with("j1939 ? > all cannot claim an address"), "{said:?}");
}

#[test]
fn a_database_gives_signals_of_one_and_of_many_frames() {
    let text = "BO_ 2566844926 DM1: 10 X\n SG_ Fifth : 32|8@1+ (2,0) [0|0] \"x\" X\nBO_ 2364540158 EEC1: 8 X\n \
                SG_ EngSpeed : 24|16@1+ (0.125,0) [0|8031.875] \"rpm\" X\nBA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\"reserved\",\"J1939PG\";\nBA_ \"VFrameFormat\" BO_ 2364540158 3;\n\
                BO_ 2566843134 Long: 10 X\n SG_ Ninth : 64|8@1+ (1,0) [0|0] \"\" X\nBA_ \"VFrameFormat\" BO_ 2566843134 3;\n";
    let database = dbc::parse("x.dbc", text.as_bytes()).unwrap();
    let mut decoder = Decoder::new(vec![Source { channel: None, database }]);
    decoder.assume_j1939();
    let assembler = J1939::new(Some(Arc::new(decoder)));
    let frames = [(0.0, "0CF00400#FFFFFF6813FFFFFF")];
    assert_eq!(
        testing::event_lines(assembler, &frames),
        ["j1939 0 > all EEC1: pgn 61444, priority 3, EngSpeed 621 rpm"]
    );
}

/// Frames from many senders, some dropped, repeated or swapped: what is complete is what was sent.
#[test]
fn messages_at_random_are_whole_and_right_or_said_to_be_broken() {
    let mut random = fastrand::Rng::with_seed(1939);
    for round in 0..300 {
        let mut lines: Vec<(u8, String)> = Vec::new();
        let mut sent = Vec::new();
        let mut queues: Vec<Vec<String>> = Vec::new();
        for source in 0..4_u8 {
            let mut queue = Vec::new();
            for _ in 0..4 {
                let data: Vec<u8> = (0..random.usize(9..120)).map(|_| random.u8(..)).collect();
                let frames = data.len().div_ceil(7);
                queue.push(format!("1CECFF{source:02X}#20{:02X}00{frames:02X}FF10FF00", data.len()));
                for (at, chunk) in data.chunks(7).enumerate() {
                    let mut bytes = chunk.to_vec();
                    bytes.resize(7, 0xFF);
                    queue.push(format!("1CEBFF{source:02X}#{:02X}{}", at + 1, hex(&bytes)));
                }
                sent.push((source, data));
            }
            queue.reverse();
            queues.push(queue);
        }
        while queues.iter().any(|queue| !queue.is_empty()) {
            let source = random.usize(0..queues.len());
            if let Some(frame) = queues[source].pop() {
                lines.push((source as u8, frame));
            }
        }
        let disturbed = round % 3 > 0;
        if disturbed {
            testing::disturb(&mut lines, &mut random);
        }
        let records: Vec<_> = lines.iter().enumerate().map(|(ms, (_, frame))| at(ms as f64, frame)).collect();
        let events = testing::events(J1939::default(), &records);
        let whole: Vec<_> = events.iter().filter(|event| event.kind == EventKind::Message).collect();
        for event in &whole {
            let source = event.from.node().unwrap();
            assert!(sent.contains(&(source, event.data.to_vec())), "round {round}: never sent: {event}");
        }
        let broken = events.iter().filter(|event| event.trouble.is_some()).count();
        assert!(
            if disturbed { whole.len() + broken >= 15 } else { whole.len() == 16 && broken == 0 },
            "round {round}"
        );
    }
}

/// Memory stays bounded, and nothing panics.
#[test]
fn any_frames_are_taken() {
    let mut random = fastrand::Rng::with_seed(71);
    let mut assembler = J1939::default();
    let mut events = Vec::new();
    for number in 0..200_000_u32 {
        let group = random.choice([0xEC, 0xEB, 0xC8, 0xC7, 0xEA, 0xE8, 0xEE, 0xFE]).unwrap();
        let id = 0x1800_0000 | group << 16 | random.u32(..) & 0xFFFF;
        let mut bytes: Vec<u8> = (0..random.usize(0..=8)).map(|_| random.u8(..)).collect();
        if let Some(first) = bytes.first_mut() {
            *first = random.choice([16, 17, 19, 20, 21, 22, 23, 32, 255, 1, 2]).unwrap();
        }
        assembler.take(&at(f64::from(number) / 10.0, &format!("{id:08X}#{}", hex(&bytes))), &mut events);
        assert!(assembler.requests.len() <= MOST_REQUESTS);
        for event in events.drain(..) {
            let _ = event.to_string();
        }
    }
    let gap = cantap_trace::TraceRecord { time_ns: 0, device_ns: None, channel: 1, event: TraceEvent::GAP };
    assembler.take(&gap, &mut events);
    assembler.finish(&mut events);
}

/// The receiver requests what it missed again, although it was received here.
#[test]
fn frames_that_come_again_behind_the_last_one_are_no_fault() {
    let frames = [
        (0.0, "18EC2100#100E0002FFEBFE00"),
        (1.0, "18EC0021#110201FFFFEBFE00"),
        (2.0, "18EB2100#0141424344454647"),
        (3.0, "18EB2100#0248494A4B4C4D4E"),
        (4.0, "18EC0021#110101FFFFEBFE00"),
        (5.0, "18EB2100#0141424344454647"),
        (6.0, "18EC0021#130E0002FFEBFE00"),
    ];
    let all = event_lines(&frames);
    assert_eq!(all.len(), 1, "{all:?}");
    assert!(all[0].contains("text \"ABCDEFGHIJKLMN\""), "{all:?}");
    // What comes long afterwards belongs to nothing.
    let late = event_lines(&[frames[0], frames[1], frames[2], frames[3], (9000.0, frames[5].1)]);
    assert!(late[1].ends_with("its beginning is missing"), "{late:?}");
}

/// Two nodes send to each other at the same time; one of them aborts.
#[test]
fn an_abort_ends_the_message_that_it_names() {
    let all = event_lines(&[
        (0.0, "18EC2100#100E0002FFEBFE00"),
        (1.0, "18EC0021#100E0002FFDAFE00"),
        (2.0, "18EC0021#FF09FFFFFFDAFE00"),
        (3.0, "18EC0021#110201FFFFEBFE00"),
        (4.0, "18EB2100#0141424344454647"),
        (5.0, "18EB2100#0248494A4B4C4D4E"),
    ]);
    assert_eq!(all.len(), 2, "{all:?}");
    assert!(
        all[0].contains("pgn 65242") && all[0].ends_with("aborted: too long for the receiver"),
        "{all:?}"
    );
    assert!(all[1].contains("pgn 65259") && all[1].contains("text \"ABCDEFGHIJKLMN\""), "{all:?}");
}

/// A receiver that missed one frame inside a window asks for that one alone, and then goes on behind the window.
#[test]
fn one_frame_of_a_window_may_be_sent_again() {
    let frames = [
        (0.0, "1CEC375E#103100070500E700"),
        (3.0, "1CEC5E37#110501FFFF00E700"),
        (6.0, "1CEB375E#0101020304050607"),
        (8.0, "1CEB375E#0208090A0B0C0D0E"),
        (10.0, "1CEB375E#030F101112131415"),
        (12.0, "1CEB375E#041617181920212F"),
        (14.0, "1CEB375E#0522232425262728"),
        (16.0, "1CEC5E37#110102FFFF00E700"),
        (19.0, "1CEB375E#0208090A0B0C0D0E"),
        (21.0, "1CEC5E37#110206FFFF00E700"),
        (23.0, "1CEB375E#062930313233343F"),
        (25.0, "1CEB375E#073536373839404F"),
        (27.0, "1CEC5E37#13310007FF00E700"),
    ];
    let whole = event_lines(&frames);
    assert_eq!(whole.len(), 1, "{whole:?}");
    assert!(whole[0].contains("length 49 bytes") && whole[0].contains("0E 0F 10 11"), "{whole:?}");
    // The frame that the receiver missed may be one that was not captured the first time either.
    let mut missed = frames.to_vec();
    missed.remove(3);
    let again = event_lines(&missed);
    assert_eq!(again[0].replace("1 frames", ""), whole[0].replace("1 frames", ""));
    // It did not come again: the message ends with the receiver's acknowledgement, as far as it came.
    missed.retain(|(_, frame)| !frame.starts_with("1CEB375E#02"));
    let broken = event_lines(&missed);
    assert_eq!(broken.len(), 1, "{broken:?}");
    assert!(
        broken[0].contains("received 7 bytes") && broken[0].contains("frame 3 came instead of 2"),
        "{broken:?}"
    );
}

/// Three connections at a time with windows of every size, frames that are requested again in the middle, and some of them lost by
/// the capture, too.
#[test]
fn connections_with_frames_sent_again_are_whole() {
    let mut random = fastrand::Rng::with_seed(77_001);
    for round in 0..400 {
        let (mut frames, mut sent) = (Vec::new(), Vec::new());
        for pair in 0..3_u8 {
            let (from, to) = (pair + 1, pair + 101);
            let data: Vec<u8> = (0..random.usize(9..300)).map(|_| random.u8(..)).collect();
            let count = data.len().div_ceil(7);
            let window = random.choice([1, 2, 5, 16, 255]).unwrap().min(count);
            let mut now = f64::from(pair) * 0.7;
            let mut frame = |group: u32, from: u8, to: u8, bytes: &[u8]| {
                now += 3.0;
                frames.push((now, format!("1C{group:02X}{to:02X}{from:02X}#{}", hex(bytes))));
            };
            let size = (data.len() as u16).to_le_bytes();
            let packet = |number: usize| {
                let mut bytes = vec![number as u8];
                bytes.extend(&data[(number - 1) * 7..(number * 7).min(data.len())]);
                bytes.resize(8, 0xFF);
                bytes
            };
            frame(0xEC, from, to, &[16, size[0], size[1], count as u8, 255, 0, 0xEF, 0]);
            let mut first = 1;
            while first <= count {
                let last = (first + window - 1).min(count);
                let cleared = (last - first + 1) as u8;
                frame(0xEC, to, from, &[17, cleared, first as u8, 255, 255, 0, 0xEF, 0]);
                // What the receiver misses; half of it is missing in the capture as well, and none of it may be the last of all.
                let missed =
                    Some(random.usize(first..=last)).filter(|missed| random.bool() && *missed < count);
                for number in first..=last {
                    if missed != Some(number) || random.bool() {
                        frame(0xEB, from, to, &packet(number));
                    }
                }
                if let Some(missed) = missed {
                    frame(0xEC, to, from, &[17, 1, missed as u8, 255, 255, 0, 0xEF, 0]);
                    frame(0xEB, from, to, &packet(missed));
                }
                first = last + 1;
            }
            frame(0xEC, to, from, &[19, size[0], size[1], count as u8, 255, 0, 0xEF, 0]);
            sent.push((from, data));
        }
        frames.sort_by(|a, b| a.0.total_cmp(&b.0));
        let records: Vec<_> = frames.iter().map(|(ms, frame)| at(*ms, frame)).collect();
        let events = testing::events(J1939::default(), &records);
        assert_eq!(events.len(), 3, "round {round}: {events:?}");
        for event in &events {
            let source = event.from.node().unwrap();
            assert!(sent.contains(&(source, event.data.to_vec())), "round {round}: never sent: {event}");
        }
    }
}

/// GB/T 27930: the group of a charger's recognition is TC1 elsewhere.
#[test]
fn a_chargers_messages_have_their_own_names() {
    let title = |frame: &str| event_lines(&[(0.0, frame)]).remove(0);
    let recognition = title("1801F456#0000000000FFFFFF");
    assert!(recognition.contains("CRM charger recognition"), "{recognition}");
    assert!(title("181056F4#DC05A00F0100FFFF").contains("BCL charging demand"));
    assert!(title("18010300#0000000000FFFFFF").contains("TC1 transmission control"));
}

/// A readiness message from its frame to its fields.
#[test]
fn readiness_is_read_from_the_bus() {
    let line = event_lines(&[(0.0, "18FECE00#0200141701000100")]).remove(0);
    assert!(
        line.contains("DM5 diagnostic readiness") && line.contains("obd_compliance 20 (HD OBD)"),
        "{line}"
    );
}

/// Where RV-C's groups show, they are read with J1939's: alone, and not elsewhere.
#[test]
fn a_caravans_groups_are_read_once_they_show() {
    let home = [
        "19FFFD46#01780B01847E3577",
        "19FEDA96#017CC8FCFFFF04FF",
        "19FFE096#0101FFFF64C8FFFF",
        "19FFB79C#0005FFFFFFFFFFFF",
    ];
    let lines = |home: &[&str]| {
        let records: Vec<_> = home
            .iter()
            .cycle()
            .take(16)
            .enumerate()
            .map(|(at, frame)| testing::at(at as f64, frame))
            .collect();
        let (mut reader, mut events) = (crate::Reader::new(crate::Options::default()), Vec::new());
        for record in &records {
            reader.push(record, &mut events);
        }
        reader.finish(&mut events);
        events.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let all = lines(&home);
    assert_eq!(all.len(), 16);
    assert_eq!(
        all[0],
        "j1939 70 > all DC_SOURCE_STATUS_1: pgn 131069, priority 6, instance 1 (main house battery bank), \
         device_priority 120 (battery soc device), dc_voltage 13.35 V, dc_current -5.5 A"
    );
    assert_eq!(lines(&home[..3]), Vec::<String>::new());
}
