//! Wireshark's dissectors and we decode the same frames, compared field by field: iso15765, uds, obd-ii, canopen, devicenet,
//! j1939, isobus.
//!
//! Without `tshark` the tests say so and pass, unless `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;

use std::collections::HashMap;
use std::io::Read;
use std::process::Command;

use cantap_protocols::iso_tp::{FlowStatus, Pci, parse};
use cantap_protocols::j1939::Header;
use cantap_protocols::{Event, EventKind, Options, Protocol, Reader};
use cantap_trace::{Direction, TraceEvent, TraceFrame, TraceRecord};

const BOAT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../formats/tests/data/nmea2000.log.gz");

/// A frame's fields by name, as far as it has them.
type Row = HashMap<String, String>;

/// Whether there is a tshark; reports its absence.
fn is_there() -> bool {
    peers::has(Command::new("tshark").arg("--version"), "tshark")
}

/// tshark's output for each frame, one per millisecond; `None` after reporting that it is missing.
fn tshark(test: &str, frames: &[TraceFrame], decode_as: &[&str], fields: &[&str]) -> Option<Vec<Row>> {
    if !is_there() {
        return None;
    }
    // pcap with SocketCAN's link type, 227.
    let mut pcap = Vec::new();
    for word in [0xA1B2_C3D4_u32, 0x0004_0002, 0, 0, 65_535, 227] {
        pcap.extend(word.to_le_bytes());
    }
    for (at, frame) in frames.iter().enumerate() {
        let data = frame.data();
        let length = 8 + data.len() as u32;
        for word in [at as u32 / 1000, at as u32 % 1000 * 1000, length, length] {
            pcap.extend(word.to_le_bytes());
        }
        let extended = if frame.id().is_extended() { 1 << 31 } else { 0 };
        let remote = if frame.is_remote() { 1 << 30 } else { 0 };
        pcap.extend((frame.id().raw() | extended | remote).to_be_bytes());
        pcap.extend([data.len() as u8, 0, 0, 0]);
        pcap.extend(data);
    }
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("tshark_{test}.pcap"));
    std::fs::write(&path, pcap).unwrap();
    let mut command = Command::new("tshark");
    command.arg("-r").arg(&path).args(["-T", "fields", "-E", "separator=|", "-E", "occurrence=l"]);
    command.args(decode_as.iter().flat_map(|rule| ["-d", rule]));
    command.args(fields.iter().flat_map(|field| ["-e", field]));
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let rows: Vec<Row> = String::from_utf8(output.stdout)
        .unwrap()
        .lines()
        .map(|line| {
            let values = fields.iter().zip(line.split('|'));
            values
                .filter(|(_, value)| !value.is_empty())
                .map(|(name, value)| ((*name).to_owned(), value.to_owned()))
                .collect()
        })
        .collect();
    assert_eq!(rows.len(), frames.len());
    Some(rows)
}

fn number(row: &Row, name: &str) -> Option<f64> {
    let text = row.get(name)?;
    match text.as_str() {
        "True" => return Some(1.0),
        "False" => return Some(0.0),
        _ => {}
    }
    let hex = text.strip_prefix("0x").and_then(|digits| u64::from_str_radix(digits, 16).ok());
    hex.map(|value| value as f64).or_else(|| text.parse().ok())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat()
}

fn frame(id: &str, data: &[u8]) -> TraceFrame {
    format!("{id}#{}", hex(data)).parse().unwrap()
}

/// The events that each frame completes.
fn events(frames: &[TraceFrame], protocol: Protocol) -> Vec<Vec<Event>> {
    let options = Options { protocols: vec![protocol], ..Options::default() };
    let mut reader = Reader::new(options);
    let take = |(at, frame): (usize, &TraceFrame)| {
        let event = TraceEvent::Frame { frame: *frame, direction: Direction::Rx, late: false };
        let mut events = Vec::new();
        reader.push(
            &TraceRecord { time_ns: at as i64 * 1_000_000, device_ns: None, channel: 1, event },
            &mut events,
        );
        events
    };
    frames.iter().enumerate().map(take).collect()
}

fn ours(event: &Event, name: &str) -> Option<f64> {
    event.field(name)?.value.as_number()
}

/// Random messages of 1 to 400 bytes between two pairs, alternating.
fn transfers(random: &mut fastrand::Rng) -> Vec<TraceFrame> {
    let mut frames = Vec::new();
    for round in 0..60 {
        let (from, to) = if round % 3 == 0 { ("7E0", "7E8") } else { ("7E9", "7E1") };
        let length = if round % 2 == 0 { random.usize(1..8) } else { random.usize(8..400) };
        // Not a UDS or OBD service, so that no other dissector takes over.
        let data: Vec<u8> = (0..length).map(|_| random.u8(..)).collect();
        if length < 8 {
            frames.push(frame(from, &[&[length as u8], &data[..]].concat()));
            continue;
        }
        let head = [0x10 | (length >> 8) as u8, length as u8];
        frames.push(frame(from, &[&head, &data[..6]].concat()));
        frames.push(frame(to, &[0x30, random.u8(0..3), random.u8(0..20)]));
        for (number, chunk) in (1_u8..).zip(data[6..].chunks(7)) {
            frames.push(frame(from, &[&[0x20 | number & 15], chunk].concat()));
        }
    }
    frames
}

#[test]
fn iso15765_frames_and_messages() {
    let frames = transfers(&mut fastrand::Rng::with_seed(1));
    let names = [
        "iso15765.message_type",
        "iso15765.data_length",
        "iso15765.sequence_number",
        "iso15765.flow_status",
        "iso15765.flow_control.bs",
        "iso15765.flow_control.stmin",
        "iso15765.reassembled.length",
        "data.data",
    ];
    let rule = ["can.subdissector,iso15765"];
    let Some(rows) = tshark("iso15765", &frames, &rule, &names) else { return };
    let (mut messages, mut long) = (0, 0);
    for ((frame, row), events) in frames.iter().zip(&rows).zip(events(&frames, Protocol::IsoTp)) {
        let is = |name: &str, value: u32| {
            assert_eq!(number(row, name), Some(f64::from(value)), "{frame} {name} {row:?}");
        };
        match parse(frame.data(), 0).unwrap().unwrap() {
            Pci::Single(data) => {
                is("iso15765.message_type", 0);
                is("iso15765.data_length", data.len() as u32);
            }
            Pci::First { .. } => is("iso15765.message_type", 1),
            Pci::Consecutive { number, .. } => {
                is("iso15765.message_type", 2);
                is("iso15765.sequence_number", number.into());
            }
            Pci::Flow { status, block_size, separation_us } => {
                assert_eq!(status, FlowStatus::Go);
                is("iso15765.flow_status", 0);
                is("iso15765.flow_control.bs", block_size.into());
                is("iso15765.flow_control.stmin", separation_us / 1000);
            }
        }
        for event in &events {
            assert_eq!(event.trouble, None, "{event}");
            messages += 1;
            assert_eq!(row["data.data"], hex(&event.data), "{event}");
            if event.data.len() > 7 {
                long += 1;
                is("iso15765.reassembled.length", event.data.len() as u32);
            }
        }
    }
    assert_eq!((messages, long), (60, 30));
}

#[test]
fn uds_services() {
    let mut random = fastrand::Rng::with_seed(2);
    let mut frames = Vec::new();
    let mut talk = |request: &[u8], response: &[u8]| {
        for (id, data) in [("7E0", request), ("7E8", response)] {
            frames.push(frame(id, &[&[data.len() as u8], data].concat()));
        }
    };
    for _ in 0..20 {
        let [a, b, c] = [random.u8(..), random.u8(..), random.u8(..)];
        talk(&[0x22, a, b], &[0x62, a, b, c, 1]);
        talk(&[0x2E, a, b, c], &[0x6E, a, b]);
        talk(&[0x22, a, b], &[0x7F, 0x22, [0x13, 0x31, 0x33][usize::from(c % 3)]]);
        talk(&[0x31, 1 + c % 3, a, b], &[0x71, 1 + c % 3, a, b]);
        talk(&[0x10, 1 + c % 3], &[0x50, 1 + c % 3, 0, 0x32, 1, 0xF4]);
        talk(&[0x11, 1 + c % 3], &[0x51, 1 + c % 3]);
        talk(&[0x27, 1 + 2 * (c % 3)], &[0x67, 1 + 2 * (c % 3), a, b]);
        talk(&[0x3E, 0], &[0x7E, 0]);
        talk(&[0x85, 1 + c % 2], &[0xC5, 1 + c % 2]);
    }
    let names = [
        "uds.sid",
        "uds.err.sid",
        "uds.err.code",
        "uds.rdbi.data_identifier",
        "uds.wdbi.data_identifier",
        "uds.rc.identifier",
        "uds.rc.type",
        "uds.dsc.type",
        "uds.er.type",
        "uds.sa.type",
        "uds.cdtcs.type",
    ];
    let rules = ["can.subdissector,iso15765", "iso15765.subdissector,uds"];
    let Some(rows) = tshark("uds", &frames, &rules, &names) else { return };
    let mut compared = 0;
    for (row, events) in rows.iter().zip(events(&frames, Protocol::Uds)) {
        for event in &events {
            let refused = event.kind == EventKind::Refusal;
            let theirs = |names: &[&str]| names.iter().find_map(|name| number(row, name));
            let sid = if refused { "uds.err.sid" } else { "uds.sid" };
            let pairs = [
                ("sid", theirs(&[sid])),
                ("nrc", theirs(&["uds.err.code"])),
                ("did", theirs(&["uds.rdbi.data_identifier", "uds.wdbi.data_identifier"])),
                ("routine", theirs(&["uds.rc.identifier"])),
                (
                    "sub_function",
                    theirs(&["uds.rc.type", "uds.dsc.type", "uds.er.type", "uds.sa.type", "uds.cdtcs.type"]),
                ),
            ];
            for (name, theirs) in pairs.into_iter().filter(|(_, theirs)| theirs.is_some()) {
                assert_eq!(ours(event, name), theirs, "{event}: {name} {row:?}");
                compared += 1;
            }
        }
    }
    assert!(compared > 350, "{compared}");
}

/// Ours, and Wireshark's field for the same parameter.
const PARAMETERS: [(u8, &str, &str); 20] = [
    (0x04, "calculated_load", "engine_load"),
    (0x05, "coolant_temperature", "engine_coolant_temp"),
    (0x0A, "fuel_pressure", "fuel_pressure"),
    (0x0B, "intake_manifold_pressure", "intake_manifold_absolute_pressure"),
    (0x0C, "engine_speed", "engine_rpm"),
    (0x0D, "vehicle_speed", "vehicle_speed"),
    (0x0E, "timing_advance", "timing_advance"),
    (0x0F, "intake_air_temperature", "intake_air_temp"),
    (0x10, "air_flow", "maf_air_flow_rate"),
    (0x11, "throttle_position", "throttle_position"),
    (0x1F, "run_time", "engine_uptime"),
    (0x21, "distance_with_mil_on", "distance_traveled_with_mil"),
    (0x2C, "commanded_egr", "commanded_egr"),
    (0x2F, "fuel_level", "fuel_tank_level_input"),
    (0x31, "distance_since_cleared", "distance_traveled_since_code_clear"),
    (0x33, "barometric_pressure", "absolute_barometric_pressure"),
    (0x42, "control_module_voltage", "control_module_voltage"),
    (0x46, "ambient_air_temperature", "ambient_air_temp"),
    (0x5C, "oil_temperature", "engine_oil_temp"),
    (0x5E, "fuel_rate", "engine_fuel_rate"),
];

#[test]
fn obd_parameters() {
    let mut random = fastrand::Rng::with_seed(3);
    let mut frames = Vec::new();
    for _ in 0..10 {
        for (pid, ..) in PARAMETERS {
            frames.push(frame("7DF", &[2, 1, pid]));
            let word = matches!(pid, 0x0C | 0x10 | 0x1F | 0x21 | 0x31 | 0x42 | 0x5E);
            let data = [if word { 4 } else { 3 }, 0x41, pid, random.u8(..), random.u8(..)];
            frames.push(frame("7E8", &data[..if word { 5 } else { 4 }]));
        }
    }
    let names: Vec<_> = PARAMETERS.map(|(.., theirs)| format!("obd-ii.mode01_{theirs}")).into();
    let names: Vec<_> = names.iter().map(String::as_str).collect();
    let rules = ["can.subdissector,iso15765", "iso15765.subdissector,obd-ii"];
    let Some(rows) = tshark("obd", &frames, &rules, &names) else { return };
    let mut wrong = Vec::new();
    let mut compared = 0;
    for ((frame, row), events) in frames.iter().zip(&rows).zip(events(&frames, Protocol::Obd)) {
        for event in &events {
            let pid = frame.data()[2];
            let (_, name, theirs) = PARAMETERS.iter().find(|(known, ..)| *known == pid).unwrap();
            let theirs = number(row, &format!("obd-ii.mode01_{theirs}"));
            let value = ours(event, name);
            compared += 1;
            match (value, theirs) {
                (Some(a), Some(b)) if (a - b).abs() <= 0.01 * b.abs().max(1.0) => {}
                _ => wrong.push(format!("{event}: {theirs:?}")),
            }
        }
    }
    assert!(wrong.is_empty() && compared == 200, "{compared}\n{}", wrong.join("\n"));
}

/// What a value of a parameter stands for, in our words.
fn meaning(pid: u8, name: &str, value: u8) -> Option<String> {
    let response = frame("7E8", &[3, 0x41, pid, value]);
    let [_, event] = &events(&[frame("7DF", &[2, 1, pid]), response], Protocol::Obd)[..] else { return None };
    let text = event.first()?.field(name)?.text.as_deref()?;
    // What follows is an explanation that Wireshark does not have.
    Some(text.split(':').next().unwrap_or(text).to_owned())
}

/// Texts without what is only spelt differently.
fn plain(text: &str) -> String {
    let text =
        text.to_lowercase().replace("as defined by the", "").replace("gasoline", "petrol").replace("and", "");
    text.chars().filter(char::is_ascii_alphanumeric).collect()
}

#[test]
fn obd_standards_and_fuels_stand_for_the_same() {
    if !is_there() {
        return;
    }
    let output = Command::new("tshark").args(["-G", "values"]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let (mut compared, mut wrong) = ([0, 0], Vec::new());
    for line in text.lines() {
        let parts: Vec<_> = line.split('\t').collect();
        let [_, field, value, theirs] = parts[..] else { continue };
        let (pid, name, count) = match field {
            "obd-ii.mode01_obd_standards" => (0x1C, "obd_standard", 0),
            "obd-ii.mode01_fuel_type" => (0x51, "fuel_type", 1),
            _ => continue,
        };
        // Assigned since, except for 22.
        if theirs == "Reserved" {
            continue;
        }
        compared[count] += 1;
        let ours = meaning(pid, name, value.parse().unwrap());
        // Theirs stands for Euro VI, and is a misprint.
        let theirs = if theirs == "HD EOBD-IV" { "HD EOBD-VI" } else { theirs };
        if ours.as_deref().map(plain) != Some(plain(theirs)) {
            wrong.push(format!("{field} {value}: {ours:?}, theirs is {theirs}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert_eq!(compared, [28, 24]);
}

#[test]
fn canopen_objects() {
    let mut random = fastrand::Rng::with_seed(4);
    let mut frames = Vec::new();
    for _ in 0..60 {
        let node = random.u8(1..128);
        let bytes: [u8; 8] = random.u64(..).to_le_bytes();
        let id = |base: u16| format!("{:03X}", base + u16::from(node));
        frames.push(frame("000", &[[1, 2, 128, 129, 130][random.usize(0..5)], node]));
        frames.push(frame(&id(0x700), &[[0, 4, 5, 127][random.usize(0..4)]]));
        frames.push(frame(&id(0x80), &bytes));
        frames.push(frame(&id(0x600), &[&[0x40], &bytes[1..4], &[0; 4]].concat()));
        frames.push(frame(&id(0x580), &[&[0x43 | random.u8(0..4) << 2], &bytes[1..4], &bytes[4..]].concat()));
        frames.push(frame(&id(0x600), &[&[0x40], &bytes[1..4], &[0; 4]].concat()));
        frames.push(frame(&id(0x580), &[&[0x80], &bytes[1..4], &[0, 0, 2, 6]].concat()));
        frames.push(frame("100", &[bytes[0], bytes[1], bytes[2], 1, bytes[4], bytes[5]]));
    }
    let names = [
        "canopen.node_id",
        "canopen.nmt_ctrl.cd",
        "canopen.nmt_ctrl.node_id",
        "canopen.nmt_guard.state",
        "canopen.em.err_code",
        "canopen.em.err_reg",
        "canopen.sdo.main_idx",
        "canopen.sdo.sub_idx",
        "canopen.sdo.abort_code",
        "canopen.sdo.data.bytes",
        "canopen.time_stamp_ms",
        "canopen.time_stamp_days",
    ];
    let Some(rows) = tshark("canopen", &frames, &["can.subdissector,canopen"], &names) else { return };
    let mut compared = HashMap::<&str, u32>::new();
    for ((frame, row), events) in frames.iter().zip(&rows).zip(events(&frames, Protocol::CanOpen)) {
        for event in &events {
            let mut is = |name: &'static str, ours: Option<f64>| {
                let theirs = number(row, name);
                assert!(theirs.is_some() && ours == theirs, "{event}: {name} {ours:?} {row:?} {frame}");
                *compared.entry(name).or_default() += 1;
            };
            let node = event.node().map(f64::from);
            match event.kind {
                EventKind::Nmt => {
                    is("canopen.nmt_ctrl.cd", ours(event, "command"));
                    is("canopen.nmt_ctrl.node_id", node);
                }
                EventKind::BootUp | EventKind::State => {
                    is("canopen.node_id", node);
                    is("canopen.nmt_guard.state", Some(f64::from(frame.data()[0])));
                }
                EventKind::Emergency => {
                    is("canopen.node_id", node);
                    is("canopen.em.err_code", ours(event, "code"));
                    is("canopen.em.err_reg", ours(event, "register"));
                }
                EventKind::SdoRead => {
                    is("canopen.node_id", node);
                    is("canopen.sdo.main_idx", ours(event, "index"));
                    is("canopen.sdo.sub_idx", ours(event, "sub"));
                    if event.field("abort").is_some() {
                        is("canopen.sdo.abort_code", ours(event, "abort"));
                    } else {
                        let theirs = row["canopen.sdo.data.bytes"].replace(':', "");
                        assert!(theirs.starts_with(&hex(&event.data)), "{event}: {theirs}");
                    }
                }
                EventKind::Time => {
                    is("canopen.time_stamp_ms", ours(event, "time_of_day_s").map(|s| (s * 1000.0).round()));
                    is("canopen.time_stamp_days", ours(event, "days_since_1984"));
                }
                EventKind::HeartbeatMissing => {}
                other => panic!("{other}: {event}"),
            }
        }
    }
    assert_eq!(compared.len(), 11, "{compared:?}");
    assert!(compared.values().all(|count| *count > 20), "{compared:?}");
}

#[test]
fn devicenet_messages() {
    let mut random = fastrand::Rng::with_seed(5);
    let mut frames = Vec::new();
    for _ in 0..50 {
        let mac = random.u16(0..64);
        let bytes = random.u64(..).to_le_bytes();
        frames.push(frame(&format!("{:03X}", 0x407 + mac * 8), &[&[bytes[0] & 1], &bytes[1..7]].concat()));
        frames.push(frame(&format!("{:03X}", 0x3C0 + mac), &bytes[..4]));
        frames.push(frame(&format!("{:03X}", 0x405 + mac * 8), &bytes[..2]));
    }
    let names = [
        "devicenet.src_mac_id",
        "devicenet.dup_mac_id.physical_port_number",
        "devicenet.dup_mac_id.vendor",
        "devicenet.dup_mac_id.serial_number",
        "devicenet.grp_msg1.id",
        "devicenet.grp_msg2.id",
    ];
    let Some(rows) = tshark("devicenet", &frames, &["can.subdissector,devicenet"], &names) else { return };
    let (mut checks, mut inputs) = (0, 0);
    for ((frame, row), events) in frames.iter().zip(&rows).zip(events(&frames, Protocol::DeviceNet)) {
        for event in &events {
            let node = event.node().map(f64::from);
            assert_eq!(number(row, "devicenet.src_mac_id"), node, "{event} {frame} {row:?}");
            match event.kind {
                EventKind::DuplicateCheck | EventKind::Duplicate => {
                    for (name, theirs) in [
                        ("physical_port", "physical_port_number"),
                        ("vendor", "vendor"),
                        ("serial_number", "serial_number"),
                    ] {
                        let theirs = number(row, &format!("devicenet.dup_mac_id.{theirs}"));
                        assert_eq!(ours(event, name), theirs, "{event}: {name} {row:?}");
                    }
                    checks += 1;
                }
                EventKind::Io => {
                    let is_input = frame.id().raw() < 0x400;
                    let message = if is_input { "devicenet.grp_msg1.id" } else { "devicenet.grp_msg2.id" };
                    let expected = if is_input { 15.0 } else { 5.0 };
                    assert_eq!(number(row, message), Some(expected), "{event}");
                    inputs += 1;
                }
                other => panic!("{other}: {event}"),
            }
        }
    }
    assert!(checks == 50 && inputs > 40, "{checks} {inputs}");
}

/// The recorded boat, and random identifiers.
#[test]
fn j1939_headers() {
    let mut log = String::new();
    flate2::read::GzDecoder::new(std::fs::File::open(BOAT).unwrap()).read_to_string(&mut log).unwrap();
    let lines = log.lines().filter(|line| !line.starts_with('#'));
    let mut frames: Vec<TraceFrame> =
        lines.map(|line| line.split(' ').nth(2).unwrap().parse().unwrap()).collect();
    assert!(frames.len() > 10_000);
    let mut random = fastrand::Rng::with_seed(6);
    frames.extend((0..2000).map(|_| frame(&format!("{:08X}", random.u32(..1 << 29)), &[0; 8])));
    let names = ["j1939.priority", "j1939.pgn", "j1939.src_addr", "j1939.dst_addr"];
    let Some(rows) = tshark("j1939", &frames, &["can.subdissector,j1939"], &names) else { return };
    for (frame, row) in frames.iter().zip(&rows) {
        let header = Header::of(frame.id()).unwrap();
        let all = [u32::from(header.priority), header.pgn, header.source.into(), header.destination.into()];
        for (name, ours) in names.iter().zip(all) {
            // For groups sent to all, it has no receiver.
            let theirs = number(row, name).or((*name == "j1939.dst_addr").then_some(255.0));
            assert_eq!(theirs, Some(f64::from(ours)), "{frame} {name} {row:?}");
        }
    }
}

#[test]
fn isobus_transport() {
    let mut random = fastrand::Rng::with_seed(7);
    let mut frames = Vec::new();
    for _ in 0..30 {
        let size = random.usize(9..200);
        let data: Vec<u8> = (0..size).map(|_| random.u8(..)).collect();
        let pgn = [0xCA, 0xFE, 0];
        let [low, high] = (size as u16).to_le_bytes();
        let count = size.div_ceil(7) as u8;
        let to_all = random.bool();
        let to = if to_all { "FF" } else { "21" };
        let control = |bytes: &[u8]| [bytes, &pgn].concat();
        frames.push(frame(
            &format!("18EC{to}05"),
            &control(&[if to_all { 32 } else { 16 }, low, high, count, 0xFF]),
        ));
        if !to_all {
            frames.push(frame("18EC0521", &control(&[17, count, 1, 0xFF, 0xFF])));
        }
        for (number, chunk) in (1_u8..).zip(data.chunks(7)) {
            let mut bytes = chunk.to_vec();
            bytes.resize(7, 0xFF);
            frames.push(frame(&format!("18EB{to}05"), &[&[number], &bytes[..]].concat()));
        }
        if !to_all {
            frames.push(frame("18EC0521", &control(&[19, low, high, count, 0xFF])));
        }
    }
    let transport = "isobus.transport_protocol";
    let names = [
        format!("{transport}.broadcast_announce_message.total_message_size"),
        format!("{transport}.broadcast_announce_message.pgn"),
        format!("{transport}.request_to_send.total_size"),
        format!("{transport}.request_to_send.pgn"),
        "isobus.src_addr".to_owned(),
    ];
    let names: Vec<_> = names.iter().map(String::as_str).collect();
    let Some(rows) = tshark("isobus", &frames, &["can.subdissector,isobus"], &names) else { return };
    // Its own length of a reassembled message includes padding, so compare the announced one.
    let (mut announced, mut whole) = (None, 0);
    for (row, events) in rows.iter().zip(events(&frames, Protocol::J1939)) {
        let either = |a: usize, b: usize| number(row, names[a]).or_else(|| number(row, names[b]));
        announced = either(0, 2).zip(either(1, 3)).or(announced);
        for event in &events {
            assert_eq!(event.trouble, None, "{event}");
            let (size, pgn) = announced.unwrap();
            assert_eq!((ours(event, "length"), ours(event, "pgn")), (Some(size), Some(pgn)), "{event}");
            assert_eq!(number(row, "isobus.src_addr"), event.node().map(f64::from));
            whole += 1;
        }
    }
    assert_eq!(whole, 30);
}
