//! The properties checked by the fuzz targets, with random bytes: nothing panics, every event can be written, and memory stays flat
//! under a flood of messages that are never finished.

use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::odx::Odx;
use cantap_protocols::{Event, Options, Overview, Protocol, Reader};
use cantap_trace::{Direction, FdFrame, Frame, Id, TraceEvent, TraceRecord};

fn record(time_ns: i64, id: Id, data: &[u8]) -> TraceRecord {
    let frame = Frame::data_frame(id, data).map(Into::into);
    let frame = frame.or_else(|| FdFrame::new(id, false, false, data).map(Into::into));
    let event = match frame {
        Some(frame) => TraceEvent::Frame { frame, direction: Direction::Rx, late: false },
        None => TraceEvent::GAP,
    };
    TraceRecord { time_ns, device_ns: None, channel: 1, event }
}

/// Identifiers that protocols use, few of each, so that frames collide.
fn known_id(random: &mut fastrand::Rng) -> Id {
    let node = random.u32(0..4);
    match random.u8(0..10) {
        8 => Id::extended_truncated([0x1001_5500, 0x1E01_8A80, 0x1E01_0180][random.usize(0..3)] | node),
        9 => Id::extended_truncated([0x107D_5500, 0x136B_9500, 0x126B_8080][random.usize(0..3)] | node),
        0 => Id::standard_truncated(0x7E0 | node | random.u32(0..2) << 3),
        1 => Id::standard_truncated(random.u32(0..16) << 7 | node),
        2 => Id::standard_truncated(0x400 | node << 3 | random.u32(0..8)),
        3 => Id::extended_truncated(
            0x18EC_0000 | random.u32(0..2) << 16 ^ 0x1_0000 | node << 8 | random.u32(0..4),
        ),
        4 => Id::extended_truncated(0x0DF8_0000 | random.u32(..0x1_0000) & 0xFF00 | node),
        5 => Id::extended_truncated(0x18DA_0000 | node << 8 | random.u32(0..4)),
        6 => Id::standard_truncated(random.u32(..)),
        _ => Id::extended_truncated(random.u32(..)),
    }
}

#[test]
fn any_frames_are_taken_by_every_protocol_and_each_event_can_be_written() {
    let seed = fastrand::u64(..);
    eprintln!("seed {seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    for protocols in std::iter::once(Protocol::ALL.to_vec()).chain(Protocol::ALL.map(|one| vec![one])) {
        let sheet: Vec<u8> = (0..random.usize(0..300)).map(|_| random.u8(..)).collect();
        let sheets = vec![Sheet { node: None, eds: Eds::parse(&sheet).into() }];
        let options = Options { protocols: protocols.clone(), sheets, ..Options::default() };
        let (mut reader, mut finder) = (Reader::new(options), Reader::new(Options::default()));
        let (mut overview, mut events) = (Overview::default(), Vec::<Event>::new());
        let mut found = Vec::new();
        let mut time_ns = 0_i64;
        for _ in 0..20_000 {
            time_ns += random.i64(0..3_000_000);
            let mut data: Vec<u8> = (0..random.usize(0..9)).map(|_| random.u8(..)).collect();
            // Frames that begin, continue and end transfers.
            if let Some(first) = data.first_mut().filter(|_| random.bool()) {
                *first = [0x10, 0x20, 0x21, 0x22, 0x30, 0x03, 0x40, 0x43, 0x60, 0x80][random.usize(0..10)];
            }
            if let Some(last) = data.last_mut().filter(|_| random.bool()) {
                *last =
                    [0x80, 0x20, 0x40, 0x60, 0xA0, 0xC0, 0xE0, 0x00][random.usize(0..8)] | random.u8(0..2);
            }
            let mut record = record(time_ns, known_id(&mut random), &data);
            if random.u8(..) == 0 {
                record.event = TraceEvent::GAP;
            }
            finder.push(&record, &mut found);
            reader.push(&record, &mut events);
            for event in events.drain(..) {
                let broke = event.protocol == Protocol::IsoTp && event.trouble.is_some();
                assert!(protocols.contains(&event.protocol) || broke, "{event}");
                assert!(event.start_ns <= event.time_ns && event.channel == 1, "{event:?}");
                overview.take(&event);
                let _ = event.to_string();
            }
        }
        let _ = (reader.under_way(), finder.under_way());
        reader.finish(&mut events);
        finder.finish(&mut found);
        for event in &found {
            let _ = event.to_string();
        }
        for event in &events {
            overview.take(event);
        }
        assert!(overview.nodes().count() > 0 || protocols.len() == 1, "{protocols:?}");
    }
}

#[test]
fn any_text_is_taken_as_a_sheet() {
    let mut random = fastrand::Rng::with_seed(1);
    let good = include_bytes!("../data/sample.eds");
    for _ in 0..300 {
        let mut bytes = good.to_vec();
        for _ in 0..random.usize(1..30) {
            let place = random.usize(..bytes.len());
            match random.u8(0..3) {
                0 => bytes[place] = random.u8(..),
                1 => drop(bytes.drain(place..(place + random.usize(0..50)).min(bytes.len()))),
                _ => bytes.insert(place, b"=[]x0F\n$"[random.usize(0..8)]),
            }
        }
        let eds = Eds::parse(&bytes);
        for (index, object) in &eds.objects {
            object.entries.keys().for_each(|sub| assert!(eds.entry_of(*index, *sub).is_some()));
        }
    }
}

/// This process's memory in use, in bytes.
#[cfg(target_os = "linux")]
fn resident() -> usize {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap();
    text.split(' ').nth(1).unwrap().parse::<usize>().unwrap() * 4096
}

/// Begins a message of a protocol, numbered by a count: as many senders as the protocol has, none of which completes it.
#[cfg(target_os = "linux")]
type Beginning = fn(u32) -> (Id, Vec<u8>);

#[cfg(target_os = "linux")]
const BEGINNINGS: [(&str, &[Protocol], Beginning); 14] = [
    ("ISO-TP, 11 bits", &[Protocol::IsoTp], |at| {
        (Id::standard_truncated(at), vec![0x1F, 0xFF, 0x62, 1, 2, 3, 4, 5])
    }),
    ("UDS, 29 bits", &[Protocol::Uds], |at| {
        (Id::extended_truncated(0x18DA_0000 | at & 0xFFFF), vec![0x1F, 0xFF, 0x62, 1, 2, 3, 4, 5])
    }),
    // Requests that nobody answers, by a service that only KWP2000 has.
    ("KWP2000", &[Protocol::Kwp2000], |at| {
        (Id::extended_truncated(0x18DA_0000 | at & 0xFFFF), vec![0x02, 0x1A, at as u8, 0, 0, 0, 0, 0])
    }),
    // To all, and from each to one other: two at a time for each of 254 senders.
    ("J1939 TP", &[Protocol::J1939], |at| {
        let (sender, to) = (at / 2 % 254, if at.is_multiple_of(2) { 0xFF } else { at / 508 % 254 });
        let control = if to == 0xFF { 0x20 } else { 0x10 };
        let id = Id::extended_truncated(0x18EC_0000 | to << 8 | sender);
        (id, vec![control, 0xF9, 6, 255, 255, 0xCA, 0xFE, 0])
    }),
    // Of 16 MiB each, with frames that go on.
    ("J1939 ETP", &[Protocol::J1939], |at| {
        let sender = at / 4 % 254;
        let group = if at.is_multiple_of(4) { 0x18C8_0000 } else { 0x18C7_0000 };
        let id = Id::extended_truncated(group | (sender ^ 1) << 8 | sender);
        let bytes =
            if at.is_multiple_of(4) { vec![20, 0, 0, 0, 1, 0, 0xEF, 0] } else { vec![(at % 4) as u8; 8] };
        (id, bytes)
    }),
    ("fast packets", &[Protocol::Nmea2000], |at| {
        (Id::extended_truncated(0x0DF8_0500 | at & 0xFF), vec![(at >> 8 << 5) as u8, 223, 1, 2, 3, 4, 5, 6])
    }),
    ("SDO segments", &[Protocol::CanOpen], |at| {
        let node = at / 64 % 127 + 1;
        // A write that never ends, restarted after 63 segments.
        let bytes = if at.is_multiple_of(64) { vec![0x20, 0, 0x20, 1, 0, 0, 0, 0] } else { vec![0; 8] };
        (Id::standard_truncated(0x600 + node), bytes)
    }),
    // Each write gives a node another SDO channel, on which a transfer begins.
    ("SDO channels", &[Protocol::CanOpen], |at| {
        let (node, index, place) = (at / 10 % 127 + 1, 0x1201 + (at / 1270 % 126) as u16, at % 10);
        let [low, high] = index.to_le_bytes();
        let request = 0x680 + at / 10 % 0x80;
        let [id_low, id_high] = (request as u16).to_le_bytes();
        match place {
            0 => (Id::standard_truncated(0x600 + node), vec![0x23, low, high, 1, id_low, id_high, 0, 0]),
            1 => (Id::standard_truncated(0x580 + node), vec![0x60, low, high, 1, 0, 0, 0, 0]),
            2 => (Id::standard_truncated(0x600 + node), vec![0x23, low, high, 2, id_low, 5, 0, 0]),
            3 => (Id::standard_truncated(0x580 + node), vec![0x60, low, high, 2, 0, 0, 0, 0]),
            4 => (Id::standard_truncated(request), vec![0x20, 0, 0x20, 1, 0, 0, 0, 0]),
            _ => (Id::standard_truncated(request), vec![0; 8]),
        }
    }),
    // Blocks that are never whole, of ever more masters.
    ("XCP blocks", &[Protocol::Xcp], |at| {
        let (master, place) = (0x100 + at / 8 % 0x300 * 2, at % 8);
        match place {
            0 => (Id::standard_truncated(master), vec![0xFF, 0]),
            1 => (Id::standard_truncated(master + 1), vec![0xFF, 5, 0xC0, 8, 8, 0, 1, 1]),
            2 => (Id::standard_truncated(master), vec![0xF5, 255]),
            _ => (Id::standard_truncated(master + 1), vec![0xFF, 1, 2, 3, 4, 5, 6, 7]),
        }
    }),
    // Lists that grow, and now and then a command that is not answered.
    ("XCP lists", &[Protocol::Xcp], |at| {
        let number = (at / 6) as u16;
        let [low, high] = number.to_le_bytes();
        match at % 6 {
            _ if at == 0 => (Id::standard_truncated(0x7F0), vec![0xFF, 0]),
            _ if at == 1 => (Id::standard_truncated(0x7F1), vec![0xFF, 5, 0xC0, 8, 8, 0, 1, 1]),
            0 => (Id::standard_truncated(0x7F0), vec![0xE2, 0, low, high, number as u8, number as u8]),
            2 => (Id::standard_truncated(0x7F0), vec![0xE1, 0xFF, 4, 0, 0, 0, 0, 0x20]),
            4 => (Id::standard_truncated(0x7F0), vec![0xD4, 0, low, high, 251]),
            5 if at % 60 == 59 => (Id::standard_truncated(0x100), Vec::new()),
            _ => (Id::standard_truncated(0x7F1), vec![0xFF]),
        }
    }),
    // Of ever more sessions, whose slaves answer the first two only.
    ("CCP commands", &[Protocol::Ccp], |at| {
        let (master, place) = (0x100 + at / 64 % 0x300 * 2, (at % 64) as u8);
        match place {
            0 => (Id::standard_truncated(master), vec![0x01, 0, 0x39, 0, 0, 0, 0, 0]),
            1 | 3 => (Id::standard_truncated(master + 1), vec![0xFF, 0, place / 2, 2, 1, 0, 0, 0]),
            2 => (Id::standard_truncated(master), vec![0x1B, 1, 2, 1, 0, 0, 0, 0]),
            _ => (Id::standard_truncated(master), vec![0x1B, place - 2, 2, 1, 0, 0, 0, 0]),
        }
    }),
    // The first fragment and those in the middle, without a last one.
    ("DeviceNet fragments", &[Protocol::DeviceNet], |at| {
        let (node, count) = (at / 64 % 64, (at % 64) as u8);
        let second = if count == 0 { 0 } else { 0x40 | count };
        (Id::standard_truncated(0x404 | node << 3), vec![0x80 | 1, second, 0x10, 1, 2, 3, 4, 5])
    }),
    ("DroneCAN transfers", &[Protocol::DroneCan], |at| {
        (Id::extended_truncated(0x1000_0001 | at << 8 & 0xFF_FF00), vec![1, 2, 3, 4, 5, 6, 7, 0x80])
    }),
    // Requests that nobody answers, of every service and client.
    ("Cyphal requests", &[Protocol::Cyphal], |at| {
        let (service, client) = (at % 512, at / 512 % 128);
        (Id::extended_truncated(0x1300_0080 | service << 14 | client), vec![(at % 32) as u8 | 0xE0])
    }),
];

#[cfg(target_os = "linux")]
#[test]
fn memory_is_flat_under_a_flood_of_messages_that_are_never_finished() {
    let test = "anything_is_taken::memory_is_flat_under_a_flood_of_messages_that_are_never_finished";
    cantap_testing::process::alone(test, flood_every_reader);
}

#[cfg(target_os = "linux")]
fn flood_every_reader() {
    let everything = Protocol::ALL;
    for (name, protocols, begin) in BEGINNINGS {
        // By its own reader, and with every other one beside it.
        for protocols in [protocols, &everything[..]] {
            let options = Options { protocols: protocols.to_vec(), ..Options::default() };
            let mut reader = Reader::new(options);
            let mut events = Vec::new();
            let mut said = 0_u64;
            let mut flood = |frames: std::ops::Range<u32>| {
                for at in frames {
                    let (id, data) = begin(at);
                    reader.push(&record(i64::from(at) * 50_000, id, &data), &mut events);
                    said += events.iter().filter(|event| event.trouble.is_some()).count() as u64;
                    events.clear();
                }
                reader.under_way().len()
            };
            flood(0..70_000);
            let before = resident();
            let under_way = flood(70_000..200_000);
            let grown = resident().saturating_sub(before);
            assert!(grown < 2 << 20, "{name}: {grown} bytes more");
            assert!(under_way <= 1024, "{name}: {under_way}");
            assert!(said > 500, "{name}: what was given up is said: {said}");
        }
    }
}

/// A description in which bytes were changed, left out or doubled is read or refused, and whatever is read of it takes any message.
#[test]
fn any_description_is_taken_with_any_message() {
    let seed = fastrand::u64(..);
    eprintln!("seed {seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    let kinds = include_bytes!("../data/kinds.odx-d");
    let mut read = 0;
    for round in 0..60 {
        let mut bytes = kinds.to_vec();
        for _ in 0..if round == 0 { 0 } else { random.usize(1..40) } {
            let (from, length) = (random.usize(0..bytes.len()), random.usize(0..30));
            let part = from..(from + length).min(bytes.len());
            match random.u8(0..4) {
                // Digits for digits keep the document one.
                0 => {
                    for byte in bytes[part].iter_mut().filter(|byte| byte.is_ascii_digit()) {
                        *byte = random.u8(b'0'..=b'9');
                    }
                }
                1 => {
                    // A value for another one of the document.
                    let (values, to): (Vec<&[u8]>, _) =
                        (kinds.split(|byte| *byte == b'"').collect(), random.usize(0..bytes.len()));
                    let value = values[random.usize(0..values.len())].to_vec();
                    if let Some(at) =
                        bytes[to..].iter().position(|byte| *byte == b'"').filter(|_| value.len() < 40)
                    {
                        let end = bytes[to + at + 1..].iter().position(|byte| *byte == b'"').unwrap_or(0);
                        bytes.splice(to + at + 1..to + at + 1 + end, value);
                    }
                }
                2 if random.u8(0..8) == 0 => drop(bytes.drain(part)),
                3 if random.u8(0..8) == 0 => bytes[from] = random.u8(..),
                _ => {}
            }
        }
        let Ok(odx) = Odx::read("any.odx-d", &bytes) else { continue };
        read += 1;
        let layers: Vec<_> = odx.layers().map(|(_, name)| name.to_owned()).collect();
        for ecu in layers.iter().filter_map(|name| odx.ecu(name).ok()) {
            for request in ecu.requests() {
                let mut asked = request.bytes;
                asked.extend((0..random.usize(0..4)).map(|_| random.u8(..)));
                let Some(first) = asked.first().copied() else { continue };
                let mut answer: Vec<u8> = (0..random.usize(0..40)).map(|_| random.u8(..)).collect();
                answer.splice(0..0, [first | 0x40].into_iter().chain(asked[1..].iter().copied().take(2)));
                let _ = (ecu.describe(Some(&asked), Some(&answer)), ecu.describe(None, Some(&answer)));
            }
        }
    }
    assert!(read > 0);
}
