//! Nodes of other programs talk on a simulated bus and our events match what they said: can-isotp, udsoncan, python-canopen,
//! can-j1939. Canboat's own decoder, from the package nmea2000, reads the same recorded boat as we do; python-canopen reads the same
//! sheets; canmatrix and can-j1939 name the same parameter groups.
//!
//! The Python that has them is `CANTAP_PYTHON`, otherwise `python3`. If a peer is missing, it is named and its test passes,
//! unless `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;

use std::fmt::Write as _;
use std::io::{Read, Write as _};
use std::process::Command;

use cantap_protocols::canopen::eds::{self, Eds};
use cantap_protocols::j1939::{Header, fast_frames};
use cantap_protocols::{
    Announcement, Event, EventKind, Evidence, Options, Party, Protocol, ReadItem, Reader, Value,
};
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/protocol_peer.py");
const BOAT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../formats/tests/data/nmea2000.log.gz");

/// The output of the script, or `None` after reporting that a module is missing.
fn peer(module: &str, arguments: &[&str]) -> Option<String> {
    let python = peers::python_with(&format!("can, {module}"))?;
    let output = Command::new(python).arg(SCRIPT).args(arguments).output().unwrap();
    assert!(output.status.success(), "{module}: {}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}

fn record(time_ns: i64, frame: &str) -> TraceRecord {
    let event = TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
    TraceRecord { time_ns, device_ns: None, channel: 1, event }
}

/// The frames printed by a talk, and what was said.
fn talk(module: &str, what: &str) -> Option<(Vec<TraceRecord>, Vec<serde_json::Value>)> {
    let text = peer(module, &[what])?;
    let (mut records, mut said) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let (first, rest) = line.split_once(' ').unwrap();
        if first == "=" {
            said.push(serde_json::from_str(rest).unwrap());
        } else {
            records.push(record((first.parse::<f64>().unwrap() * 1e6) as i64, rest));
        }
    }
    assert!(!records.is_empty() && !said.is_empty(), "{what}: {text}");
    Some((records, said))
}

fn events(records: &[TraceRecord], protocols: &[Protocol]) -> Vec<Event> {
    let options = Options { protocols: protocols.to_vec(), ..Options::default() };
    let mut reader = Reader::new(options);
    let mut events = Vec::new();
    for record in records {
        reader.push(record, &mut events);
    }
    reader.finish(&mut events);
    events
}

fn found(records: &[TraceRecord]) -> Vec<Protocol> {
    let mut found = Vec::new();
    let Ok(()) = Reader::new(Options::default()).take(records, false, |read| {
        if let ReadItem::Announcement(Announcement::Found { protocols, .. }) = read {
            found.extend(protocols.into_iter().map(|Evidence { protocol, .. }| protocol));
        }
        Ok::<_, std::convert::Infallible>(())
    });
    found
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat()
}

/// Whether a field has the peer's value.
fn agrees(event: &Event, name: &str, value: &serde_json::Value) -> bool {
    match name {
        "kind" => return value == event.kind.name(),
        "source" => return event.from.node().is_some_and(|node| *value == node),
        "data" => {
            return hex(&event.data) == *value;
        }
        _ => {}
    }
    if let Some(of) = name.strip_suffix("_text") {
        // They are spelt differently: InvalidKey, invalidKey.
        let plain = |text: &str| text.to_lowercase().replace([' ', '-'], "");
        let text = event.field(of).and_then(|field| field.text.as_deref()).unwrap_or_default();
        return value.as_str().is_some_and(|value| plain(value).contains(&plain(text)) && !text.is_empty());
    }
    let Some(field) = event.field(name) else { return false };
    match &field.value {
        Value::Text(text) => value.as_str() == Some(text),
        Value::Bytes(bytes) => value.as_str() == Some(&hex(bytes)),
        number => number.as_number() == value.as_f64(),
    }
}

/// Checks that everything said is an event, in this order.
fn all_are_there(events: &[Event], said: &[serde_json::Value]) {
    let text: Vec<_> = events.iter().map(ToString::to_string).collect();
    let mut rest = events.iter();
    for expected in said {
        let members = expected.as_object().unwrap();
        let there = rest.any(|event| members.iter().all(|(name, value)| agrees(event, name, value)));
        assert!(there, "{expected} is not there, or not in its place:\n{}", text.join("\n"));
    }
    let troubled: Vec<_> =
        events.iter().filter(|event| event.trouble.is_some() && event.kind != EventKind::SdoRead).collect();
    assert!(troubled.is_empty(), "{troubled:?}");
}

#[test]
fn can_isotps_transfers_are_put_together_in_every_addressing() {
    let Some((records, said)) = talk("isotp", "isotp") else { return };
    let events = events(&records, &[Protocol::IsoTp]);
    let whole: Vec<_> = events
        .iter()
        .map(|event| {
            assert_eq!(event.trouble, None, "{event}");
            hex(&event.data)
        })
        .collect();
    assert_eq!(whole, said);
}

#[test]
fn udsoncans_services_are_named_as_it_names_them() {
    let Some((records, said)) = talk("udsoncan, isotp", "uds") else { return };
    assert_eq!(found(&records), [Protocol::Uds]);
    let events = events(&records, &[]);
    assert_eq!(events.len(), said.len());
    all_are_there(&events, &said);
}

#[test]
fn python_canopens_nodes_are_understood() {
    let Some((records, said)) = talk("canopen", "canopen") else { return };
    assert_eq!(found(&records), [Protocol::CanOpen]);
    let events = events(&records, &[Protocol::CanOpen]);
    all_are_there(&events, &said);
}

#[test]
fn can_j1939s_messages_are_put_together() {
    let Some((records, said)) = talk("j1939", "j1939") else { return };
    assert_eq!(found(&records), [Protocol::J1939]);
    // Address claims come from both at the same time, in either order.
    let events = events(&records, &[Protocol::J1939]);
    for one in said {
        all_are_there(&events, &[one]);
    }
}

/// Compares the recorded boat, each field of each message.
#[test]
fn canboat_reads_the_boat_as_we_do() {
    let Some(text) = peer("nmea2000", &["nmea2000", BOAT]) else { return };
    let mut log = String::new();
    flate2::read::GzDecoder::new(std::fs::File::open(BOAT).unwrap()).read_to_string(&mut log).unwrap();
    let records: Vec<_> = log
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| {
            let parts: Vec<_> = line.split(' ').collect();
            let seconds: f64 = parts[0].trim_matches(['(', ')']).parse().unwrap();
            record((seconds * 1e9) as i64, parts[2])
        })
        .collect();
    assert_eq!(found(&records), [Protocol::Nmea2000]);
    let all = events(&records, &[Protocol::Nmea2000]);
    let mut whole: Vec<_> = all.iter().filter(|event| event.trouble.is_none()).collect();
    let mut theirs: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    // Each sender's groups in order.
    let pgn_of = |event: &Event| event.field("pgn").and_then(|field| field.value.as_number()).unwrap() as u64;
    whole.sort_by_key(|event| (pgn_of(event), event.from.node().map_or(254, u64::from)));
    theirs.sort_by_key(|their| (their["pgn"].as_u64(), their["source"].as_u64()));
    assert_eq!(whole.len(), theirs.len(), "messages");
    let (mut fields, mut late) = (0, 0);
    for (our, their) in whole.iter().zip(&theirs) {
        let wrong = differences(our, their, &mut fields);
        // Where the altitude changes, theirs is that of the previous message; the bytes in the log show that ours is
        // right.
        let is_late = wrong.iter().all(|wrong| wrong.starts_with("129029 Altitude"));
        assert!(is_late, "{}", wrong.join("\n"));
        late += wrong.len();
    }
    assert!(fields > 18_000 && late <= 4, "{fields} {late}");
}

/// The fields of a message that canboat decodes differently.
fn differences(our: &Event, their: &serde_json::Value, fields: &mut usize) -> Vec<String> {
    let mut wrong = Vec::new();
    let pgn = their["pgn"].as_u64().unwrap();
    let same_pgn = our.field("pgn").and_then(|field| field.value.as_number()) == their["pgn"].as_f64();
    if !same_pgn || !(agrees(our, "source", &their["source"]) || our.from == Party::Unknown) {
        wrong.push(format!("{our}: {pgn} of {}", their["source"]));
        return wrong;
    }
    // Address claims and requests belong to J1939, and have its names.
    if matches!(pgn, 60_928 | 59_904 | 59_392) {
        return wrong;
    }
    // For unknown groups, theirs gives the range they are in.
    let title = their["title"].as_str().unwrap();
    if our.title != title && !title.starts_with("0x") {
        wrong.push(format!("{}: {title}", our.title));
    }
    for field in their["fields"].as_array().unwrap() {
        let (name, value) = (field[0].as_str().unwrap(), &field[1]);
        *fields += 1;
        let ours = our.field(name);
        let same = match (ours, value) {
            // A message may end before its last fields.
            (None, value) => value.is_null(),
            (Some(ours), serde_json::Value::Null) => {
                ours.value == Value::Missing
                    || ours.text.is_none() && field[2].as_f64() == ours.value.as_number()
            }
            (Some(ours), serde_json::Value::Number(number)) => {
                let number = number.as_f64().unwrap();
                ours.value
                    .as_number()
                    .is_some_and(|ours| (ours - number).abs() <= 1e-6 * number.abs().max(1e-3))
            }
            (Some(ours), serde_json::Value::String(text)) => match &ours.value {
                Value::Text(ours) => ours == text,
                Value::Bytes(bytes) => hex(bytes).eq_ignore_ascii_case(text),
                // Of a set of bits in which none is set, there is no name; of a time of day, no fraction.
                number => match ours.text.as_deref() {
                    Some(ours) => {
                        let is_whole = field[2].as_f64() == number.as_number();
                        text.contains(ours) || is_whole && ours.starts_with(text.as_str())
                    }
                    None => text.is_empty(),
                },
            },
            _ => true,
        };
        if !same {
            wrong.push(format!("{pgn} {name}: {value} ({}) is not {ours:?}", field[2]));
        }
    }
    wrong
}

/// A number of a sheet for node 16 (as in `strange.eds`); hexadecimal ones of signed types are the bits.
fn number_of(text: &str, data_type: Option<u16>) -> Option<f64> {
    let Some(number) = eds::number(text, 16) else { return text.parse().ok() };
    let bits = match data_type {
        Some(2) => 8,
        Some(3) => 16,
        Some(4) => 32,
        Some(0x15) => 64,
        _ => return Some(number as f64),
    };
    Some(((number << (128 - bits)) >> (128 - bits)) as f64)
}

/// Compares python-canopen's own sheets, and one of ours with what is seldom seen: names, types, access, values, limits.
#[test]
fn sheets_have_every_entry_that_python_canopen_has() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data");
    let sheets = ["sample", "datatypes", "e35", "strange"].map(|name| format!("{folder}/{name}.eds"));
    let arguments: Vec<_> = std::iter::once("eds").chain(sheets.iter().map(String::as_str)).collect();
    let Some(text) = peer("canopen", &arguments) else { return };
    let (mut eds, mut entries, mut wrong) = (Eds::default(), 0, Vec::new());
    for line in text.lines() {
        if let Some(path) = line.strip_prefix("file ") {
            eds = Eds::parse(&std::fs::read(path).unwrap());
            continue;
        }
        let their: serde_json::Value = serde_json::from_str(line).unwrap();
        let (index, sub) = (their["index"].as_u64().unwrap() as u16, their["sub"].as_u64().unwrap() as u8);
        let entry = eds.entry_of(index, sub).unwrap_or_else(|| panic!("no {index:04X}:{sub}"));
        entries += 1;
        // Compact arrays have no section for their number of entries; theirs is writable.
        let is_made_up =
            sub == 0 && their["name"] == "Number of entries" && entry.name != "Number of entries";
        if is_made_up {
            continue;
        }
        let name = their["name"].as_str().unwrap();
        let number = |text: &str| number_of(text, entry.data_type);
        for (what, is_same) in [
            ("name", entry.name == name || name.ends_with(&entry.name) || entry.name.starts_with(name)),
            // A type of the maker's own is a domain to them.
            (
                "type",
                entry.data_type.map(u64::from) == their["type"].as_u64()
                    || their["type"] == 15 && entry.data_type >= Some(0x40),
            ),
            ("access", their["access"] == entry.access),
            ("mapping", their["mappable"] == entry.mappable),
            (
                "value",
                their["value"].is_null()
                    || number_as(&their["value"], entry.data_type) == number(&entry.value),
            ),
            ("low limit", their["low"].is_null() || their["low"].as_f64() == number(&entry.low_limit)),
            ("high limit", their["high"].is_null() || their["high"].as_f64() == number(&entry.high_limit)),
        ] {
            if !is_same {
                wrong.push(format!("{what} of {line}: {entry:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(entries > 130, "{entries}");
    let strange = Eds::parse(&std::fs::read(&sheets[3]).unwrap());
    assert_eq!(strange.issues, [""; 0]);
    // They are made when they are asked for, there; the names are the sheet's.
    let names: Vec<_> = strange.objects[&0x1003].entries.values().map(|entry| entry.name.as_str()).collect();
    assert_eq!(names[1..], ["The first", "The second", "The third"]);
    assert_eq!(strange.objects[&0x2006].entries.len(), 17);
}

/// Their value: they keep the bits of a negative number as they are written.
fn number_as(their: &serde_json::Value, data_type: Option<u16>) -> Option<f64> {
    number_of(&their.to_string(), data_type)
}

/// Our name of a parameter group, from the title of one of its messages.
fn group_name(pgn: u32) -> Option<String> {
    let receiver = if pgn & 0xFF00 < 0xF000 { 0xFF } else { 0 };
    let frame = format!("{:08X}#FFFFFFFFFFFFFFFF", 6 << 26 | (pgn | receiver) << 8 | 5);
    let events = events(&[record(0, &frame)], &[Protocol::J1939]);
    let [event] = &events[..] else { panic!("{pgn:05X}: {events:?}") };
    (!event.title.starts_with("PGN ")).then(|| event.title.to_string())
}

/// An acronym of SAE J1939-71, or the number of a diagnostic message.
#[test]
fn parameter_groups_have_the_names_that_canmatrix_and_can_j1939_give_them() {
    // canmatrix' edition is older: these groups were given another acronym, most when they got a sister.
    const RENAMED: [(&str, &str); 4] = [("CCVS", "CCVS1"), ("DD", "DD1"), ("LFE", "LFE1"), ("TI1", "AT1T1I")];
    let Some(text) = peer("canmatrix, j1939", &["groups"]) else { return };
    let (mut acronyms, mut messages, mut wrong) = (0, 0, Vec::new());
    for line in text.lines() {
        let (pgn, theirs) = line.split_once(' ').unwrap();
        let pgn = pgn.parse().unwrap();
        let theirs = RENAMED.iter().find(|(old, _)| *old == theirs).map_or(theirs, |(_, new)| new);
        let is_message = theirs.starts_with("DM");
        let Some(ours) = group_name(pgn) else {
            // canmatrix has many groups that we show by number, but no diagnostic message is without its name.
            if is_message {
                wrong.push(format!("{pgn:05X}: {theirs} has no name"));
            }
            continue;
        };
        *(if is_message { &mut messages } else { &mut acronyms }) += 1;
        if ours.split(' ').next().map(|first| first.replace('/', "_")).as_deref() != Some(theirs) {
            wrong.push(format!("{pgn:05X}: {ours}, theirs is {theirs}"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    // All of ours: DM1 to DM57 without DM9, which can-j1939 does not have; the others without those of the protocol itself.
    assert_eq!((acronyms, messages), (52, 56));
}

/// Values by name become frames, single or fast packets, and canboat's decoder reads the values from them.
#[test]
fn canboat_reads_what_we_send_by_name() {
    const SENT: [(&str, &[(&str, &str)]); 12] = [
        ("Position, Rapid Update", &[("Latitude", "54.3212345 deg"), ("Longitude", "-10.1")]),
        ("COG & SOG, Rapid Update", &[("COG Reference", "True"), ("COG", "1.5708 rad"), ("SOG", "3.21")]),
        ("Wind Data", &[("Wind Speed", "6 m/s"), ("Wind Angle", "0.5235"), ("Reference", "Apparent")]),
        ("Water Depth", &[("Depth", "8.51"), ("Offset", "-0.5")]),
        ("Vessel Heading", &[("Heading", "3.1"), ("Variation", "-0.05"), ("Reference", "Magnetic")]),
        ("Rudder", &[("Instance", "0"), ("Direction Order", "0"), ("Position", "-0.1")]),
        (
            "Engine Parameters, Rapid Update",
            &[("Instance", "0"), ("Speed", "1800.25 rpm"), ("Tilt/Trim", "-3")],
        ),
        (
            "Engine Parameters, Dynamic",
            &[
                ("Instance", "1"),
                ("Oil pressure", "350000"),
                ("Temperature", "358.15 K"),
                ("Alternator Potential", "14.1"),
                ("Total Engine hours", "720000"),
                ("Discrete Status 1", "Over Temperature, Low Oil Pressure"),
                ("Engine Load", "60"),
            ],
        ),
        ("Fluid Level", &[("Instance", "2"), ("Type", "Fuel"), ("Level", "75.5 %"), ("Capacity", "120")]),
        (
            "GNSS Position Data",
            &[
                ("SID", "7"),
                ("Date", "2026-11-30"),
                ("Time", "12:34:56.5"),
                ("Latitude", "54.32123456789"),
                ("Longitude", "10.1"),
                ("Altitude", "2.5"),
                ("GNSS type", "GPS"),
                ("Method", "GNSS fix"),
                ("Integrity", "No integrity checking"),
                ("Number of SVs", "9"),
                ("HDOP", "0.9"),
            ],
        ),
        (
            "Product Information",
            &[
                ("NMEA 2000 Version", "2.1"),
                ("Product Code", "42"),
                ("Model ID", "cantap boat"),
                ("Software Version Code", "1.0"),
                ("Model Version", "1"),
                ("Model Serial Code", "4711"),
                ("Certification Level", "Level B"),
                ("Load Equivalency", "1"),
            ],
        ),
        ("System Time", &[("Source", "GPS"), ("Date", "2026-11-30"), ("Time", "01:02:03")]),
    ];
    let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("sent.log.gz");
    let (mut records, mut log) = (Vec::new(), String::new());
    for (counter, (group, values)) in (0_u8..).zip(SENT) {
        let made = cantap_protocols::nmea2000::encode(group, values).unwrap();
        let priority = made.priority.unwrap_or(6);
        let header = Header { priority, pgn: made.pgn, source: 35, destination: 255 };
        let frames = if cantap_protocols::nmea2000::is_fast(made.pgn) {
            fast_frames(header, counter, &made.data)
        } else {
            vec![cantap_can::Frame::data_frame(header.id(), &made.data).unwrap()]
        };
        for frame in frames {
            let time_ns = 1_000_000 * records.len() as i64;
            writeln!(log, "({:.6}) can0 {frame}", time_ns as f64 / 1e9).unwrap();
            records.push(record(time_ns, &frame.to_string()));
        }
    }
    let mut file =
        flate2::write::GzEncoder::new(std::fs::File::create(&path).unwrap(), flate2::Compression::fast());
    file.write_all(log.as_bytes()).unwrap();
    file.finish().unwrap();
    let Some(text) = peer("nmea2000", &["nmea2000", path.to_str().unwrap()]) else { return };
    let theirs: Vec<serde_json::Value> =
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let ours = events(&records, &[Protocol::Nmea2000]);
    assert_eq!((ours.len(), theirs.len()), (SENT.len(), SENT.len()));
    let mut fields = 0;
    for ((our, their), (group, values)) in ours.iter().zip(&theirs).zip(SENT) {
        assert_eq!((&*our.title, their["title"].as_str()), (group, Some(group)));
        let wrong = differences(our, their, &mut fields);
        assert!(wrong.is_empty(), "{}", wrong.join("\n"));
        // Whatever was given is a value for both.
        for (name, text) in values {
            let field = our.field(name).unwrap_or_else(|| panic!("{group}: {name}"));
            assert!(field.value != Value::Missing, "{group}: {name} {text}: {field}");
        }
    }
    assert!(fields > 70, "{fields}");
}
