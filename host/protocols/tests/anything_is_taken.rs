//! The properties checked by the fuzz targets, with random bytes: nothing panics, every event can be written, and memory stays flat
//! under a flood of messages that are never finished.

use cantap_protocols::canopen::Sheet;
use cantap_protocols::canopen::eds::Eds;
use cantap_protocols::{Conversations, Event, Options, Overview, Protocol, Survey};
use cantap_trace::{Direction, FdFrame, Frame, Id, TraceEvent, TraceRecord};

fn record(time_ns: i64, id: Id, data: &[u8]) -> TraceRecord {
    let frame = Frame::data_frame(id, data).map(Into::into);
    let frame = frame.or_else(|| FdFrame::new(id, false, false, data).map(Into::into));
    let event = match frame {
        Some(frame) => TraceEvent::Frame { frame, direction: Direction::Rx, late: false },
        None => TraceEvent::GAP,
    };
    TraceRecord { time_ns, channel: 1, event }
}

fn every_protocol() -> Options {
    Options { protocols: Protocol::ALL.to_vec(), ..Options::default() }
}

/// Identifiers that protocols use, few of each, so that frames collide.
fn known_id(random: &mut fastrand::Rng) -> Id {
    let node = random.u32(0..4);
    match random.u8(0..8) {
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
        let (mut conversations, mut survey) = (Conversations::new(&options), Survey::new());
        let (mut overview, mut events) = (Overview::default(), Vec::<Event>::new());
        let mut time_ns = 0_i64;
        for _ in 0..20_000 {
            time_ns += random.i64(0..3_000_000);
            let mut data: Vec<u8> = (0..random.usize(0..9)).map(|_| random.u8(..)).collect();
            // Frames that begin, continue and end transfers.
            if let Some(first) = data.first_mut().filter(|_| random.bool()) {
                *first = [0x10, 0x20, 0x21, 0x22, 0x30, 0x03, 0x40, 0x43, 0x60, 0x80][random.usize(0..10)];
            }
            let mut record = record(time_ns, known_id(&mut random), &data);
            if random.u8(..) == 0 {
                record.event = TraceEvent::GAP;
            }
            survey.take(&record);
            conversations.take(&record, &mut events);
            for event in events.drain(..) {
                let broke = event.protocol == Protocol::IsoTp && event.trouble.is_some();
                assert!(protocols.contains(&event.protocol) || broke, "{event}");
                assert!(event.start_ns <= event.time_ns && event.channel == 1, "{event:?}");
                overview.take(&event);
                let _ = event.to_string();
            }
        }
        let _ = (conversations.under_way(), survey.found());
        conversations.finish(&mut events);
        for event in &events {
            overview.take(event);
        }
        assert!(overview.nodes().count() > 0 || protocols.len() == 1, "{protocols:?}");
    }
}

#[test]
fn any_text_is_taken_as_a_sheet() {
    let mut random = fastrand::Rng::with_seed(1);
    let good = include_bytes!("data/sample.eds");
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

/// First frames of four protocols from ever new senders, none of which continues.
#[cfg(target_os = "linux")]
#[test]
fn memory_is_flat_under_a_flood_of_messages_that_are_never_finished() {
    let mut conversations = Conversations::new(&every_protocol());
    let mut events = Vec::new();
    let mut begun = 0_u64;
    let mut flood = |frames: std::ops::Range<u32>| {
        for at in frames {
            let time_ns = i64::from(at) * 50_000;
            let (id, data) = match at % 4 {
                0 => (
                    Id::extended_truncated(0x18DA_0000 | at >> 2 & 0xFFFF),
                    [0x1F, 0xFF, 0x62, 1, 2, 3, 4, 5],
                ),
                1 => (
                    Id::extended_truncated(0x18EC_0000 | at >> 2 & 0xFFFF),
                    [16, 0xF9, 6, 255, 255, 0xCA, 0xFE, 0],
                ),
                2 => (
                    Id::extended_truncated(0x0DF8_0500 | at >> 2 & 0xFF),
                    [(at >> 10 << 5) as u8, 223, 1, 2, 3, 4, 5, 6],
                ),
                _ => (Id::standard_truncated(at >> 2 & 0x7FF), [0x1F, 0xFF, 0x62, 1, 2, 3, 4, 5]),
            };
            conversations.take(&record(time_ns, id, &data), &mut events);
            begun += events.iter().filter(|event| event.trouble.is_some()).count() as u64;
            events.clear();
        }
        conversations.under_way().len()
    };
    flood(0..100_000);
    let before = resident();
    let under_way = flood(100_000..400_000);
    let grown = resident().saturating_sub(before);
    assert!(grown < 4 << 20, "{grown} bytes more");
    assert!(under_way <= 1024, "{under_way}");
    assert!(begun > 100_000, "what was given up is said: {begun}");
}
