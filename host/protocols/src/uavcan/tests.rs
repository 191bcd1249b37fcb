use super::*;
use crate::testing::{self, at, disturb, events, hex, lost};
use crate::{Overview, Reader};

fn assembler(generation: Generation) -> Uavcan {
    Uavcan::new(generation, DataTypes::built_in())
}

fn lines(generation: Generation, frames: &[(f64, &str)]) -> Vec<String> {
    testing::event_lines(assembler(generation), frames)
}

/// The frames of a transfer; `crc` begins with the signature in DroneCAN.
fn frames(generation: Generation, id: u32, transfer: u8, payload: &[u8], signature: u64) -> Vec<String> {
    let mut bytes = payload.to_vec();
    if payload.len() > 7 {
        match generation {
            Generation::DroneCan => {
                bytes.splice(0..0, message::crc_of(signature, payload).to_le_bytes());
            }
            Generation::Cyphal => bytes.extend(crate::crc::crc16(0xFFFF, payload).to_be_bytes()),
        }
    }
    let count = bytes.len().div_ceil(7).max(1);
    let first = header::first_toggle(generation);
    let frame = |number: usize| {
        let part = bytes.chunks(7).nth(number).unwrap_or_default();
        let toggle = first ^ (number % 2 == 1);
        let bits = [(number == 0, 0x80), (number + 1 == count, 0x40), (toggle, 0x20)];
        let tail =
            bits.into_iter().filter(|(set, _)| *set).fold(transfer & 0x1F, |tail, (_, bit)| tail | bit);
        format!("{id:08X}#{}{tail:02X}", hex(part))
    };
    (0..count).map(frame).collect()
}

const STATUS: u32 = 0x1001_550A;
const BEAT: u32 = 0x107D_552A;

fn signature(name: &str) -> u64 {
    DataTypes::built_in().of(Generation::DroneCan).named(name).unwrap().signature
}

#[test]
fn a_nodes_report_is_read_in_either_language() {
    assert_eq!(
        lines(
            Generation::DroneCan,
            &[(0.0, "1001550A#0C000000000000C3"), (1000.0, "1001550A#0D0000004B0500C4")]
        ),
        [
            "dronecan 10 > all uavcan.protocol.NodeStatus: data_type 341, priority 16, transfer 3, uptime_sec 12 s, health 0 (ok), \
             mode 0 (operational), sub_mode 0, vendor_specific_status_code 0",
            "dronecan 10 > all uavcan.protocol.NodeStatus: data_type 341, priority 16, transfer 4, uptime_sec 13 s, health 1 (warning), \
             mode 1 (initialization), sub_mode 3, vendor_specific_status_code 5",
        ]
    );
    assert_eq!(
        lines(Generation::Cyphal, &[(0.0, "107D552A#0C00000002030BE3")]),
        [
            "cyphal 42 > all uavcan.node.Heartbeat.1.0: subject 7509, priority 4, transfer 3, uptime 12 s, health.value 2 (caution), \
             mode.value 3 (software_update), vendor_specific_status_code 11",
        ]
    );
}

/// A report that is missing for three seconds, then comes back after the node has started anew.
#[test]
fn a_node_that_falls_silent_is_missed() {
    let said = lines(
        Generation::DroneCan,
        &[
            (0.0, "1001550A#0C000000000000C3"),
            (1000.0, "1001550A#0D000000000000C4"),
            (3900.0, "123#00"),
            (4200.0, "123#00"),
            (9000.0, "1001550A#01000000000000C0"),
        ],
    );
    assert_eq!(said.len(), 5, "{said:?}");
    assert_eq!(said[2], "dronecan 10 node status missing; nothing came for 3000 ms");
    assert!(said[3].contains("restarted \"its time since start went back\""), "{said:?}");
    assert_eq!(said[4], "dronecan 10 node status is back: operational, health ok");
    // A gap is no silence.
    let records =
        [at(0.0, "1001550A#0C000000000000C3"), lost(2900.0), at(5800.0, "123#00"), at(6000.0, "123#00")];
    let said = events(assembler(Generation::DroneCan), &records);
    assert_eq!(said.iter().map(|event| event.kind).collect::<Vec<_>>().len(), 2, "{said:?}");
    assert_eq!(said[1].time_ns, 5_900_000_000);
}

/// A parameter is written: the request in two frames, the response in three.
#[test]
fn a_request_has_its_response() {
    let set = signature("uavcan.protocol.param.GetSet");
    // Index 0, a value of type integer (tag 1), then the name up to the end.
    let mut asked = vec![0, 1];
    asked.splice(0..2, [0, 0b0000_0001]);
    asked.extend(5_i64.to_le_bytes());
    asked.extend(b"esc.index");
    let answered = [&[1][..], &7_i64.to_le_bytes(), &[0, 0, 0], b"esc.index"].concat();
    let mut all: Vec<_> = frames(Generation::DroneCan, 0x1E0B_8AFF, 5, &asked, set);
    all.extend(frames(Generation::DroneCan, 0x1E0B_7F8A, 5, &answered, set));
    let records: Vec<_> = (0..).zip(&all).map(|(ms, frame)| at(f64::from(ms), frame)).collect();
    let said = events(assembler(Generation::DroneCan), &records);
    assert_eq!(said.len(), 1, "{said:?}");
    let line = said[0].to_string();
    assert_eq!(
        line,
        "dronecan 127 > 10 uavcan.protocol.param.GetSet: service 11, priority 30, transfer 5, request.index 0, \
         request.value.integer_value 5, request.name \"esc.index\", value.integer_value 7, name \"esc.index\", after 1 ms"
    );
    let mut overview = Overview::default();
    overview.take(&said[0]);
    let objects: Vec<_> = overview
        .objects()
        .map(|((_, _, node, name), object)| (node, name.to_owned(), object.value.clone()))
        .collect();
    assert_eq!(objects, [("10".to_owned(), "esc.index".to_owned(), Some("7".to_owned()))]);
    // Nobody answers, and the next has the same number; then the trace ends.
    let records: Vec<_> = [0.0, 100.0, 2000.0]
        .iter()
        .flat_map(|from| (0..).zip(&all[..3]).map(move |(ms, frame)| at(from + f64::from(ms), frame)))
        .collect();
    let said: Vec<_> =
        events(assembler(Generation::DroneCan), &records).iter().map(ToString::to_string).collect();
    assert_eq!(said.len(), 3, "{said:?}");
    assert!(said[0].ends_with("response \"none\"; the next one began before it was complete"), "{said:?}");
    assert!(said[1].ends_with("nothing came for 1000 ms"), "{said:?}");
    assert!(said[2].ends_with("the trace ends here"), "{said:?}");
}

#[test]
fn an_unknown_type_is_bytes_and_says_what_was_not_checked() {
    let long = frames(Generation::DroneCan, 0x1040_0005, 1, &[1, 2, 3, 4, 5, 6, 7, 8], 12);
    let long: Vec<_> = long.iter().map(|frame| (0.0, frame.as_str())).collect();
    assert_eq!(
        lines(Generation::DroneCan, &long),
        ["dronecan 5 > all data type 16384: data_type 16384, priority 16, transfer 1, \
             crc \"not checked, since the data type is not known\", data 01 02 03 04 05 06 07 08"]
    );
    assert_eq!(
        lines(Generation::Cyphal, &[(0.0, "1060D205#010203E1")]),
        ["cyphal 5 > all subject 210: subject 210, priority 4, transfer 1, data 01 02 03"]
    );
}

/// What a node's registers say about its subject is believed from then on.
#[test]
fn registers_name_the_types_of_subjects() {
    let access = |id: u32, transfer: u8, payload: &[u8]| frames(Generation::Cyphal, id, transfer, payload, 0);
    let named = |name: &str, value: &[u8]| [&[name.len() as u8], name.as_bytes(), value].concat();
    // The time, flags, and the value: a text, or one number of 16 bits.
    let response = |value: &[u8]| [&[0; 7][..], &[2], value].concat();
    let kind = "reg.udral.physics.acoustics.Note.0.1";
    let text = [&[1, kind.len() as u8, 0][..], kind.as_bytes()].concat();
    // Service 384 from 123 to 42, and back.
    let (request, back) = (0x1360_157B, 0x1260_3DAA);
    let note = frames(Generation::Cyphal, 0x1060_D22A, 0, &[0, 0, 0, 64, 0, 0, 128, 63, 0, 0, 0, 63], 0);
    let mut all = note.clone();
    all.extend(access(request, 1, &named("uavcan.pub.beep.id", &[0])));
    all.extend(access(back, 1, &response(&[10, 1, 210, 0])));
    all.extend(access(request, 2, &named("uavcan.pub.beep.type", &[0])));
    all.extend(access(back, 2, &response(&text)));
    all.extend(frames(Generation::Cyphal, 0x1060_D22A, 1, &[0, 0, 0, 64, 0, 0, 128, 63, 0, 0, 0, 63], 0));
    let records: Vec<_> = (0..).zip(&all).map(|(ms, frame)| at(f64::from(ms), frame)).collect();
    let said: Vec<_> =
        events(assembler(Generation::Cyphal), &records).iter().map(ToString::to_string).collect();
    assert_eq!(said.len(), 4, "{said:?}");
    assert!(said[0].contains("subject 210: subject 210") && said[0].contains("data 00 00 00 40"), "{said:?}");
    assert!(said[1].contains("value.natural16.value[0] 210"), "{said:?}");
    assert!(
        said[3].contains(kind)
            && said[3].contains("frequency.hertz 2 Hz, duration.second 1 s, acoustic_power.watt 0.5 W"),
        "{said:?}"
    );
}

/// Transfers of several nodes at once, with some frames dropped, repeated or swapped.
#[test]
fn transfers_at_random_are_whole_and_right_or_said_to_be_broken() {
    let mut random = fastrand::Rng::with_seed(25);
    let data = signature("uavcan.tunnel.Broadcast");
    for round in 0..300 {
        let generation = if round % 2 == 0 { Generation::DroneCan } else { Generation::Cyphal };
        let (mut queues, mut sent) = (Vec::new(), Vec::new());
        for node in 1..5_u32 {
            let mut queue = Vec::new();
            for transfer in 0..5_u8 {
                let payload: Vec<u8> = (0..random.usize(8..60)).map(|_| random.u8(..)).collect();
                let id = match generation {
                    Generation::DroneCan => 0x1407_DA00 | node,
                    Generation::Cyphal => 0x1060_D200 | node,
                };
                queue.extend(frames(generation, id, transfer, &payload, data));
                sent.push((node as u8, payload));
            }
            queue.reverse();
            queues.push(queue);
        }
        let mut mixed = Vec::new();
        while queues.iter().any(|queue| !queue.is_empty()) {
            let node = random.usize(0..queues.len());
            mixed.extend(queues[node].pop());
        }
        let is_disturbed = round % 3 > 0;
        if is_disturbed {
            disturb(&mut mixed, &mut random);
        }
        let records: Vec<_> = mixed.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
        let said = events(assembler(generation), &records);
        let whole: Vec<_> = said.iter().filter(|event| event.kind == EventKind::Message).collect();
        for event in &whole {
            let node = event.from.node().unwrap();
            assert!(sent.contains(&(node, event.data.to_vec())), "round {round}: never sent: {event}");
        }
        assert!(
            if is_disturbed { whole.len() >= 10 } else { said.len() == 20 && whole.len() == 20 },
            "round {round}: {} of {}",
            whole.len(),
            said.len()
        );
    }
}

#[test]
fn what_is_missing_is_said() {
    let data = signature("uavcan.tunnel.Broadcast");
    let all = frames(Generation::DroneCan, 0x1407_DA05, 3, &(0..20).collect::<Vec<_>>(), data);
    assert_eq!(all.len(), 4);
    let of = |numbers: &[usize]| {
        let frames: Vec<_> = numbers.iter().map(|number| (0.0, all[*number].as_str())).collect();
        lines(Generation::DroneCan, &frames)
    };
    for (numbers, ends) in [
        (&[0, 1, 2][..], vec!["received 21 bytes; the trace ends here"]),
        (&[0, 2, 3], vec!["frame 2 came instead of 1"]),
        (&[1, 2, 3], vec!["received 7 bytes; its beginning is missing"]),
        (&[0, 3], vec!["its CRC does not fit its content"]),
        (&[0, 0, 1, 1, 2, 3, 3], vec!["buffer 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F 10 11 12 13"]),
        (&[0, 1, 0, 1, 2, 3], vec!["the next one began before it was complete", "11 12 13"]),
    ] {
        let said = of(numbers);
        assert_eq!(said.len(), ends.len(), "{numbers:?}: {said:?}");
        assert!(said.iter().zip(ends).all(|(line, end)| line.ends_with(end)), "{numbers:?}: {said:?}");
    }
    // Much later, and with a loss.
    let said = lines(Generation::DroneCan, &[(0.0, &all[0]), (5000.0, "123#00")]);
    assert!(said[0].ends_with("received 7 bytes; nothing came for 2000 ms"), "{said:?}");
    let mut records: Vec<_> = all.iter().map(|frame| at(0.0, frame)).collect();
    records.insert(2, lost(0.0));
    let said = events(assembler(Generation::DroneCan), &records);
    assert!(said.len() == 1 && said[0].frames_lost, "{said:?}");
}

/// A short one has what there is; one element too many ends it.
#[test]
fn what_a_type_does_not_allow_is_said() {
    let said = lines(Generation::DroneCan, &[(0.0, "1001550A#0C000000C3"), (1.0, "18000105#00C1")]);
    assert!(
        said[0].contains("uptime_sec 12 s")
            && said[0].ends_with("malformed: it is shorter than its data type"),
        "{said:?}"
    );
    // GetSet's answer: more than 92 letters.
    let set = signature("uavcan.protocol.param.GetSet");
    let long = [&[0, 0, 0, 0][..], &[65; 100]].concat();
    let all = frames(Generation::DroneCan, 0x1E0B_7F8A, 5, &long, set);
    let all: Vec<_> = all.iter().map(|frame| (0.0, frame.as_str())).collect();
    let said = lines(Generation::DroneCan, &all);
    assert!(said[0].contains("more elements than its array can have"), "{said:?}");
}

/// Frames that others have published: a file that PX4's bootloader was read (PX4-Autopilot, issue 2568), and a motor controller of Zubax (the
/// documentation of pycyphal's candump media).
#[test]
fn recorded_frames_are_read() {
    let px4 = [
        "1E3081FD#230D007B0100009B",
        "1E3081FD#2F66732F6D69633B",
        "1E3081FD#726F73642F66771B",
        "1E3081FD#2F632F623334323B",
        "1E3081FD#316331342E62691B",
        "1E3081FD#6E2E76616C69647B",
    ];
    let said = lines(Generation::DroneCan, &px4.map(|frame| (0.0, frame)));
    assert_eq!(said.len(), 1, "{said:?}");
    assert!(
        said[0].starts_with(
            "dronecan 125 > 1 uavcan.protocol.file.Read: service 48, priority 30, transfer 27, request.offset 97024, \
             request.path.path \"/fs/microsd/fw/c/b3421c14.bin.valid\""
        ),
        "{said:?}"
    );
    let zubax = [
        "0C60647D#020000FB",
        "10606E7D#00000000000000BB",
        "10606E7D#000000000000001B",
        "10606E7D#000000000000003B",
        "10606E7D#0000C6565B",
        "1060787D#00000000000000BB",
        "1060787D#0000C07F147CB71B",
        "1060787D#412BCC7B",
        "10608C7D#73000000000000FB",
        "1060967D#00000000000000BB",
        "1060967D#00313E5B",
        "1460827D#7754A643E06A96BB",
        "1460827D#430000000000001B",
        "1460827D#EE3C7B",
        "1460A07D#335DB35CD85CFB",
        "107D557D#5F000000000000FB",
    ];
    let mut types = DataTypes::with(&[]).0;
    types.name_subject(120, "reg.udral.physics.electricity.PowerTs.0.1").unwrap();
    let records: Vec<_> = (0..).zip(zubax).map(|(ms, frame)| at(f64::from(ms), frame)).collect();
    let said = events(Uavcan::new(Generation::Cyphal, types.into()), &records);
    let said: Vec<_> = said.iter().map(ToString::to_string).collect();
    assert!(said.len() == 8 && said.iter().all(|line| line.starts_with("cyphal 125 > all ")), "{said:?}");
    assert!(
        said[2].contains(
            "timestamp.microsecond 0 (unknown), value.current.ampere not available, value.voltage.volt 22.935585 V"
        ),
        "{said:?}"
    );
    assert!(said[7].contains("uavcan.node.Heartbeat.1.0") && said[7].contains("uptime 95 s"), "{said:?}");
    assert_eq!(found(&zubax.map(str::to_owned)), [Protocol::Cyphal]);
    assert_eq!(found(&px4.map(str::to_owned)), [Protocol::DroneCan]);
}

fn found(frames: &[String]) -> Vec<Protocol> {
    let records: Vec<_> = frames.iter().enumerate().map(|(ms, frame)| at(ms as f64, frame)).collect();
    let mut found = Vec::new();
    let Ok(()) = Reader::new(crate::Options::default()).take(&records, false, |item| {
        if let crate::ReadItem::Announcement(crate::Announcement::Found { protocols, relatives }) = item {
            assert_eq!(relatives, []);
            found.extend(protocols.iter().map(|evidence| evidence.protocol));
        }
        Ok::<_, std::convert::Infallible>(())
    });
    found
}

/// By reports of nodes, by transfers of many frames, or by numbers of transfers that begin anew; and nothing else is claimed.
#[test]
fn each_is_found_by_what_only_it_has() {
    let status = |generation, id: u32, count: u8| {
        (0..count)
            .flat_map(move |number| frames(generation, id, number, &[number, 0, 0, 0, 0, 0, 0], 0))
            .collect::<Vec<_>>()
    };
    assert_eq!(found(&status(Generation::DroneCan, STATUS, 4)), [Protocol::DroneCan]);
    assert_eq!(found(&status(Generation::Cyphal, BEAT, 4)), [Protocol::Cyphal]);
    let data = signature("uavcan.tunnel.Broadcast");
    let long = frames(Generation::DroneCan, 0x1407_DA05, 3, &[7; 30], data);
    assert_eq!(found(&long), [Protocol::DroneCan]);
    let long = frames(Generation::Cyphal, 0x1060_D205, 3, &[7; 30], 0);
    assert_eq!(found(&long), [Protocol::Cyphal]);
    let unknown = |generation, id: u32| {
        (0..80_u8).flat_map(move |number| frames(generation, id, number, &[1, 2], 0)).collect::<Vec<_>>()
    };
    assert_eq!(found(&unknown(Generation::DroneCan, 0x1407_0005)), [Protocol::DroneCan]);
    assert_eq!(found(&unknown(Generation::Cyphal, 0x1060_D205)), [Protocol::Cyphal]);
    // Both on one bus, as while it is converted.
    let both = [status(Generation::DroneCan, STATUS, 5), status(Generation::Cyphal, BEAT, 5)].concat();
    assert_eq!(found(&both), [Protocol::DroneCan, Protocol::Cyphal]);
    // A byte that counts, of all values or of 16, and one that stays.
    let counting = |mask: u8, bits: u8| {
        let frames =
            (0..3000_u32).map(move |number| format!("18F00405#0102030405{:02X}", number as u8 & mask | bits));
        frames.collect::<Vec<_>>()
    };
    for (mask, bits) in [(0xFF, 0), (0x0F, 0), (0x0F, 0xC0), (0x0F, 0xE0), (0, 0xFF), (0, 0xC0), (0x03, 0xE0)]
    {
        let found = found(&counting(mask, bits));
        assert!(
            !found.contains(&Protocol::DroneCan) && !found.contains(&Protocol::Cyphal),
            "{mask:X} {bits:X}"
        );
    }
}
