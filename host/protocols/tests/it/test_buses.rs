//! A vehicle, a machine and a boat, made frame by frame, and what is said on each: the transcripts are `buses/*.txt`, the buses
//! `buses/*.log`, which every command can read.
//!
//! After an intended change, rewrite them with `CANTAP_OVERWRITE=1` and check the difference.

use std::fmt::Write as _;
use std::path::Path;

use cantap_protocols::{Announcement, Options, Overview, ReadItem, Reader};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

/// Frames with their times in microseconds.
#[derive(Default)]
struct Bus {
    now_us: u64,
    frames: Vec<(u64, String)>,
}

impl Bus {
    fn frame(&mut self, id: &str, data: &[u8]) {
        self.now_us += 500;
        let hex = data.iter().fold(String::new(), |mut hex, byte| {
            write!(hex, "{byte:02X}").unwrap();
            hex
        });
        self.frames.push((self.now_us, format!("{id}#{hex}")));
    }

    fn wait_ms(&mut self, ms: u64) {
        self.now_us += ms * 1000;
    }

    /// An ISO 15765-2 message, with the other side's flow control if it needs that.
    fn iso_tp(&mut self, from: &str, to: &str, data: &[u8]) {
        let padded = |bytes: &[u8]| {
            let mut bytes = bytes.to_vec();
            bytes.resize(8, 0xAA);
            bytes
        };
        if data.len() < 8 {
            return self.frame(from, &padded(&[&[data.len() as u8], data].concat()));
        }
        self.frame(from, &[&[0x10 | (data.len() >> 8) as u8, data.len() as u8], &data[..6]].concat());
        self.frame(to, &padded(&[0x30, 0, 0]));
        for (number, chunk) in (1_u8..).zip(data[6..].chunks(7)) {
            self.frame(from, &padded(&[&[0x20 | number & 15], chunk].concat()));
        }
    }

    /// A request to the engine's server and its response.
    fn ask(&mut self, request: &[u8], response: &[u8]) {
        self.iso_tp("7E0", "7E8", request);
        self.wait_ms(2);
        self.iso_tp("7E8", "7E0", response);
        self.wait_ms(10);
    }

    /// An expedited SDO transfer with node 5.
    fn sdo(&mut self, command: u8, object: [u8; 3], data: [u8; 4], answer: u8, answered: [u8; 4]) {
        self.frame("605", &[&[command], &object[..], &data].concat());
        self.frame("585", &[&[answer], &object[..], &answered].concat());
        self.wait_ms(5);
    }

    /// A fast packet.
    fn fast(&mut self, id: &str, counter: u8, data: &[u8]) {
        let all: Vec<u8> = [&[data.len() as u8], data].concat();
        let (first, rest) = all.split_at(7.min(all.len()));
        for (number, chunk) in (0_u8..).zip(std::iter::once(first).chain(rest.chunks(7))) {
            let mut bytes = [&[counter << 5 | number], chunk].concat();
            bytes.resize(8, 0xFF);
            self.frame(id, &bytes);
        }
    }
}

/// A workshop at a car: session, identity, codes, a refusal, a server that asks for more time, one that is silent;
/// OBD-II.
fn vehicle() -> Bus {
    let mut bus = Bus::default();
    bus.ask(&[0x10, 0x03], &[0x50, 0x03, 0x00, 0x32, 0x01, 0xF4]);
    bus.ask(&[0x22, 0xF1, 0x90], b"\x62\xF1\x90WVWZZZ1KZAW000001");
    bus.frame("123", &[1, 2, 3, 4, 5, 6, 7, 8]);
    bus.ask(&[0x19, 0x02, 0xFF], &[0x59, 0x02, 0xFF, 0x01, 0x33, 0x00, 0x2F, 0xC1, 0x00, 0x87, 0x2F]);
    bus.ask(&[0x27, 0x03], &[0x7F, 0x27, 0x33]);
    bus.iso_tp("7E0", "7E8", &[0x31, 0x01, 0x02, 0x03]);
    bus.wait_ms(20);
    bus.iso_tp("7E8", "7E0", &[0x7F, 0x31, 0x78]);
    bus.wait_ms(1200);
    bus.iso_tp("7E8", "7E0", &[0x71, 0x01, 0x02, 0x03, 0x00]);
    bus.ask(&[0x2E, 0x01, 0x00, 0x42], &[0x6E, 0x01, 0x00]);
    bus.iso_tp("7DF", "7E8", &[0x01, 0x0C]);
    bus.wait_ms(1);
    bus.iso_tp("7E8", "7E0", &[0x41, 0x0C, 0x1A, 0xF8]);
    bus.ask(&[0x03], &[0x43, 0x01, 0x01, 0x33]);
    bus.frame("7E0", &[0x10, 0x0A, 0x2E, 0x01, 0x01, 1, 2, 3]);
    bus.frame("7E8", &[0x30, 0, 0, 0xAA, 0xAA, 0xAA, 0xAA, 0xAA]);
    bus.frame("7E0", &[0x22, 4, 5, 6, 7, 0xAA, 0xAA, 0xAA]);
    bus.iso_tp("7E1", "7E9", &[0x3E, 0x00]);
    bus.wait_ms(3000);
    bus.frame("123", &[1, 2, 3, 4, 5, 6, 7, 8]);
    bus
}

/// A machine with two CANopen nodes: boot-up, a mapping being written, transfers of each kind, an emergency, a node that falls silent.
fn machine() -> Bus {
    let mut bus = Bus::default();
    bus.frame("705", &[0]);
    bus.frame("706", &[0]);
    // Its heartbeat, and TPDO1 with two objects.
    bus.sdo(0x2B, [0x17, 0x10, 0], [100, 0, 0, 0], 0x60, [0; 4]);
    bus.sdo(0x2F, [0x00, 0x1A, 0], [0; 4], 0x60, [0; 4]);
    bus.sdo(0x23, [0x00, 0x1A, 1], [0x10, 0, 0x41, 0x60], 0x60, [0; 4]);
    bus.sdo(0x23, [0x00, 0x1A, 2], [0x20, 0, 0x64, 0x60], 0x60, [0; 4]);
    bus.sdo(0x2F, [0x00, 0x1A, 0], [2, 0, 0, 0], 0x60, [0; 4]);
    bus.sdo(0x40, [0x18, 0x10, 1], [0; 4], 0x43, [0x78, 0x56, 0x34, 0x12]);
    bus.sdo(0x40, [0x00, 0x20, 0], [0; 4], 0x80, [0, 0, 2, 6]);
    // The device's name, in segments.
    bus.sdo(0x40, [0x08, 0x10, 0], [0; 4], 0x41, [10, 0, 0, 0]);
    for (request, answer, text) in [(0x60, 0x00, b"drive 1"), (0x70, 0x19, b"000\0\0\0\0")] {
        bus.frame("605", &[request, 0, 0, 0, 0, 0, 0, 0]);
        bus.frame("585", &[&[answer], &text[..]].concat());
    }
    bus.frame("000", &[1, 0]);
    for round in 0..4 {
        bus.frame("705", &[5]);
        bus.frame("706", &[5]);
        bus.frame("185", &[0x37, 0x02, round, 1, 0, 0]);
        bus.wait_ms(98);
    }
    bus.frame("085", &[0x10, 0x23, 0x03, 1, 2, 3, 4, 5]);
    for _ in 0..6 {
        bus.frame("706", &[5]);
        bus.wait_ms(98);
    }
    bus.frame("705", &[0]);
    bus
}

/// A boat: its devices claim addresses and send position, engine and wind.
fn boat() -> Bus {
    let mut bus = Bus::default();
    bus.frame("18EEFF05", &[0x01, 0x00, 0x20, 0xE0, 0x00, 0x91, 0x78, 0xC0]);
    bus.frame("18EAFF00", &[0x14, 0xF0, 0x01]);
    bus.wait_ms(5);
    for round in 0..3_u8 {
        bus.frame("09F80105", &[0x36, 0x72, 0x9A, 0x16, 0x02, 0x1A, 0xB8, 0x0D + round]);
        bus.frame("09F20001", &[0x00, 0x40, 0x1F + round, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
        bus.frame("09FD0223", &[round, 0x2C, 0x01, 0x10, 0x27, 0xFA, 0xFF, 0xFF]);
        bus.wait_ms(100);
    }
    let mut engine = [0xFF; 26];
    engine[..13]
        .copy_from_slice(&[0, 0xA0, 0x0F, 0xFF, 0xFF, 0x8D, 0x7E, 0xC8, 0x05, 0xFF, 0xFF, 0x10, 0x0E]);
    bus.fast("09F20101", 2, &engine);
    // One that misses its second frame.
    let whole = bus.frames.len();
    bus.fast("09F20101", 3, &engine);
    bus.frames.remove(whole + 1);
    bus.wait_ms(1000);
    bus.frame("09F80105", &[0x36, 0x72, 0x9A, 0x16, 0x02, 0x1A, 0xB8, 0x0D]);
    bus
}

fn check(name: &str, bus: &Bus) {
    let mut log = String::new();
    for (us, frame) in &bus.frames {
        writeln!(log, "({}.{:06}) can0 {frame}", us / 1_000_000, us % 1_000_000).unwrap();
    }
    let records: Vec<_> = bus
        .frames
        .iter()
        .map(|(us, frame)| {
            let event =
                TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
            TraceRecord { time_ns: *us as i64 * 1000, device_ns: None, channel: 1, event }
        })
        .collect();
    let (mut text, mut overview) = (String::new(), Overview::default());
    let mut reader = Reader::new(Options::default());
    let Ok(()) = reader.take(&records, false, |read| {
        match read {
            ReadItem::Record(_) => {}
            ReadItem::Event(event) => {
                overview.take(&event);
                writeln!(text, "{:>9.4} {event}", event.time_ns as f64 / 1e9).unwrap();
            }
            ReadItem::Announcement(Announcement::Found { protocols, relatives }) => {
                assert_eq!(relatives, []);
                for evidence in protocols {
                    writeln!(text, "# speaks {}", evidence.protocol).unwrap();
                }
            }
            ReadItem::Announcement(begun) => panic!("{begun:?}"),
        }
        Ok::<_, std::convert::Infallible>(())
    });
    for ((_, protocol, node), known) in overview.nodes() {
        let state = known.state.as_deref().map_or(String::new(), |state| format!(", {state}"));
        writeln!(text, "# {protocol} {node}: {} events, {} faults{state}", known.events, known.faults)
            .unwrap();
    }
    for (suffix, is) in [("log", &log), ("txt", &text)] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/buses/{name}.{suffix}"));
        if std::env::var_os("CANTAP_OVERWRITE").is_some() {
            std::fs::write(&path, is).unwrap();
        }
        let expected = std::fs::read_to_string(&path).unwrap_or_default().replace("\r\n", "\n");
        assert!(*is == expected, "{} differs; it is now:\n{is}", path.display());
    }
}

#[test]
fn a_vehicle_is_understood() {
    check("vehicle", &vehicle());
}

#[test]
fn a_machine_is_understood() {
    check("machine", &machine());
}

#[test]
fn a_boat_is_understood() {
    check("boat", &boat());
}
