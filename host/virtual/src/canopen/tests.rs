use std::collections::VecDeque;
use std::fmt::Write as _;

use cantap_protocols::canopen::CanOpen;
use cantap_protocols::{Assembler, Event, EventKind};
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use cantap_wire::Id;

use super::*;

const MS_NS: u64 = 1_000_000;
/// Duration of a frame, whatever its length.
const FRAME_NS: u64 = 200_000;

/// The nodes, a master, and a listener that is not part of this crate.
struct Bus {
    nodes: CanOpenBus,
    now_ns: u64,
    heard: VecDeque<String>,
    records: Vec<TraceRecord>,
}

impl Bus {
    fn new() -> Self {
        Self { nodes: CanOpenBus::in_use(), now_ns: 0, heard: VecDeque::new(), records: Vec::new() }
    }

    fn note(&mut self, frame: &Frame) {
        let event = TraceEvent::Frame { frame: (*frame).into(), direction: Direction::Rx, late: false };
        self.records.push(TraceRecord { time_ns: self.now_ns as i64, device_ns: None, channel: 1, event });
    }

    /// Lets time pass.
    fn pass(&mut self, ms: u64) {
        let until_ns = self.now_ns + ms * MS_NS;
        while let Some(due_ns) = self.nodes.due(self.now_ns).filter(|due_ns| *due_ns <= until_ns) {
            self.now_ns = self.now_ns.max(due_ns);
            let Some(frame) = self.nodes.bid(self.now_ns) else { continue };
            self.nodes.take(self.now_ns);
            self.now_ns += FRAME_NS;
            self.nodes.delivered();
            self.note(&frame);
            self.heard.push_back(text(&frame));
        }
        self.now_ns = self.now_ns.max(until_ns);
    }

    fn send(&mut self, text: &str) {
        let (id, data) = text.split_once('#').unwrap();
        let bytes: Vec<u8> = (0..data.len() / 2)
            .map(|at| u8::from_str_radix(&data[2 * at..2 * at + 2], 16).unwrap())
            .collect();
        let mut all = [0; 8];
        all[..bytes.len()].copy_from_slice(&bytes);
        let id = Id::standard_truncated(u32::from_str_radix(id, 16).unwrap());
        let frame = Frame::from_bus(id, false, bytes.len() as u8, all);
        self.now_ns += FRAME_NS;
        self.nodes.hear(&frame, self.now_ns);
        self.note(&frame);
    }

    /// Sends a frame and returns the answers.
    fn ask(&mut self, frame: &str) -> Vec<String> {
        self.heard.clear();
        self.send(frame);
        self.pass(20);
        self.heard.drain(..).collect()
    }

    fn events(&self) -> Vec<Event> {
        let (mut decoder, mut events) = (CanOpen::default(), Vec::new());
        for record in &self.records {
            decoder.take(record, &mut events);
        }
        decoder.finish(&mut events);
        events
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02X}").unwrap();
        text
    })
}

fn text(frame: &Frame) -> String {
    format!("{:03X}#{}", frame.id().raw(), hex(frame.data()))
}

#[test]
fn the_sheet_is_understood_whole() {
    let sheet = Eds::parse(SHEET.as_bytes());
    assert_eq!(sheet.issues, [""; 0]);
}

#[test]
fn a_node_boots_beats_and_follows_its_master() {
    let mut bus = Bus::new();
    bus.pass(1200);
    assert_eq!(bus.heard.drain(..).collect::<Vec<_>>(), ["705#7F", "705#7F"]);
    bus.send("000#0100");
    bus.pass(1000);
    assert!(bus.heard.contains(&"705#05".to_owned()), "{:?}", bus.heard);
    // TPDO 2 by its timer, TPDO 1 by SYNC.
    assert!(bus.heard.iter().filter(|frame| frame.starts_with("285#")).count() >= 4, "{:?}", bus.heard);
    assert!(bus.ask("080#").iter().any(|frame| frame == "185#500200000000"));
    // Switched on, with a target: it turns.
    bus.send("205#0F00E8030000");
    bus.pass(2000);
    let turned = bus.ask("080#");
    assert!(
        turned.iter().any(|frame| frame.starts_with("185#3702") && frame != "185#370200000000"),
        "{turned:?}"
    );
    // Too short.
    assert!(bus.ask("205#0F00").iter().any(|frame| frame == "085#1082010000000000"));
    assert!(bus.events().iter().any(|event| event.kind == EventKind::Emergency));
    bus.send("000#8105");
    bus.pass(200);
    assert!(bus.heard.contains(&"705#00".to_owned()));
}

#[test]
fn objects_are_read_and_written_in_every_way() {
    let mut bus = Bus::new();
    bus.pass(200);
    assert_eq!(bus.ask("605#4000100000000000"), ["585#4300100092010200"]);
    assert_eq!(bus.ask("605#2B171000F4010000"), ["585#6017100000000000"]);
    for (frame, answer) in [
        ("605#4000300000000000", "585#8000300000000206"),
        ("605#4018100900000000", "585#8018100911000906"),
        ("605#2F00100001000000", "585#8000100002000106"),
        ("605#2F17100001000000", "585#8017100010000706"),
        ("605#4005200000000000", "585#8005200001000106"),
        ("605#2F001A0001000000", "585#60001A0000000000"),
        ("605#23001A0210004060", "585#80001A0222000008"),
        ("605#FF00000000000000", "585#80001A0201000405"),
    ] {
        assert_eq!(bus.ask(frame), [answer], "{frame}");
    }
    // Segments.
    assert_eq!(bus.ask("605#4008100000000000"), ["585#4108100014000000"]);
    assert_eq!(bus.ask("605#6000000000000000"), ["585#0063616E74617020"]);
    // The wrong toggle bit.
    assert_eq!(bus.ask("605#6000000000000000"), ["585#8008100000000305"]);
    // A silent client.
    bus.ask("605#4008100000000000");
    bus.pass(4000);
    assert!(bus.heard.contains(&"585#8008100000000405".to_owned()), "{:?}", bus.heard);
}

#[test]
fn blocks_go_both_ways_with_what_is_lost_sent_again() {
    let mut bus = Bus::new();
    bus.pass(200);
    // The third segment is lost.
    bus.ask("605#2F04200003000000");
    assert_eq!(bus.ask("605#C60020001E000000"), ["585#A400200010000000"]);
    let bytes: Vec<u8> = (1..=30).collect();
    let segment = |number: u8, from: usize, last: bool| {
        let part = &bytes[from..bytes.len().min(from + 7)];
        let hex = hex(part);
        format!("605#{:02X}{hex:0<14}", number | u8::from(last) << 7)
    };
    let answers: Vec<String> = (0..5_u8)
        .flat_map(|place| bus.ask(&segment(place + 1, usize::from(place) * 7, place == 4)))
        .collect();
    assert_eq!(answers, ["585#A202100000000000"]);
    let again: Vec<String> = (0..3_u8)
        .flat_map(|place| bus.ask(&segment(place + 1, 14 + usize::from(place) * 7, place == 2)))
        .collect();
    assert_eq!(again, ["585#A203100000000000"]);
    let [low, high] = cantap_protocols::canopen::codec::sdo::crc_of(&bytes).to_le_bytes();
    assert_eq!(bus.ask(&format!("605#D5{low:02X}{high:02X}0000000000")), ["585#A100000000000000"]);
    // Back, in blocks of four, the second segment lost.
    bus.ask("605#2F04200002000000");
    assert_eq!(bus.ask("605#A400200004000000"), ["585#C60020001E000000"]);
    assert_eq!(bus.ask("605#A300000000000000").len(), 3);
    let rest = bus.ask("605#A201040000000000");
    assert_eq!((rest.len(), rest[3].as_str()), (4, "585#841D1E0000000000"));
    assert_eq!(bus.ask("605#A204040000000000"), [format!("585#D5{low:02X}{high:02X}0000000000")]);
    bus.ask("605#A100000000000000");
    // The listener has both, complete.
    let events = bus.events();
    let blocks: Vec<_> = events.iter().filter(|event| event.data[..] == bytes[..]).collect();
    assert_eq!(
        blocks.iter().map(|event| event.kind).collect::<Vec<_>>(),
        [EventKind::SdoWrite, EventKind::SdoRead]
    );
    assert!(blocks.iter().all(|event| event.trouble.is_none()), "{blocks:?}");
    // A wrong CRC is refused.
    bus.ask("605#C600200007000000");
    bus.ask("605#8101020304050607");
    assert_eq!(bus.ask("605#C100000000000000"), ["585#8000200004000405"]);
}

#[test]
fn a_node_without_a_number_is_given_one() {
    let mut bus = Bus::new();
    bus.pass(200);
    assert_eq!(bus.ask("7E5#4C00000000000000"), ["7E4#5000000000000000"]);
    for frame in ["7E5#409C020000000000", "7E5#4131565244000000", "7E5#4200000100000000"] {
        assert_eq!(bus.ask(frame), [""; 0]);
    }
    assert_eq!(bus.ask("7E5#43EA030000000000"), ["7E4#4400000000000000"]);
    assert_eq!(bus.ask("7E5#5E00000000000000"), ["7E4#5EFF000000000000"]);
    assert_eq!(bus.ask("7E5#1180000000000000"), ["7E4#1101000000000000"]);
    assert_eq!(bus.ask("7E5#1109000000000000"), ["7E4#1100000000000000"]);
    bus.send("7E5#0400000000000000");
    bus.pass(200);
    assert!(bus.heard.contains(&"709#00".to_owned()), "{:?}", bus.heard);
    assert_eq!(bus.ask("609#4018100400000000"), ["589#43181004EA030000"]);
}

/// Whatever they receive, nodes answer and keep running.
#[test]
fn nodes_bear_any_frames() {
    let seed = fastrand::u64(..);
    eprintln!("seed {seed}");
    let mut random = fastrand::Rng::with_seed(seed);
    let mut bus = Bus::new();
    bus.pass(200);
    for _ in 0..50_000 {
        let ids = [0x000, 0x080, 0x205, 0x605, 0x605, 0x605, 0x7E5, 0x705];
        let mut data: Vec<u8> = (0..8).map(|_| random.u8(..)).collect();
        if random.bool() {
            data[0] = [0x40, 0x60, 0x70, 0xA4, 0xA3, 0xA2, 0xC6, 0xC2, 0x21, 0x01, 0x81, 0x51, 0x11, 0x04]
                [random.usize(0..14)];
            (data[1], data[2], data[3]) =
                (random.u8(0..24), [0x10, 0x20, 0x1A][random.usize(0..3)], random.u8(0..4));
        }
        data.truncate(if random.bool() { 8 } else { random.usize(0..9) });
        let hex = hex(&data);
        bus.send(&format!("{:03X}#{hex}", ids[random.usize(0..ids.len())]));
        if random.u8(0..8) == 0 {
            bus.pass(1);
            bus.records.clear();
            bus.heard.clear();
        }
    }
    bus.pass(5000);
    bus.send("000#8100");
    bus.pass(300);
    assert!(
        bus.heard.iter().any(|frame| frame.starts_with('7') && frame.ends_with("#00")),
        "{:?}",
        bus.heard
    );
}
