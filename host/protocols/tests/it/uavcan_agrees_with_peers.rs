//! Transfers of every data type of DroneCAN and Cyphal with random contents, encoded by the Python packages dronecan and pycyphal, and read by
//! us, value by value.
//!
//! The Python that has them is `CANTAP_PYTHON`, otherwise `python3`. If one is missing, that is said and the test passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use cantap_protocols::dsdl::DataTypes;
use cantap_protocols::{Event, EventKind, Options, Protocol, Reader, Value};
use cantap_testing::peers;
use cantap_trace::{Direction, TraceEvent, TraceRecord};

const TESTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests");
/// Transfers of each type.
const ROUNDS: u32 = 12;

/// What a peer's script prints, one object a line.
fn transfers(python: &str, script: &str, arguments: &[&str]) -> Vec<serde_json::Value> {
    let script = format!("{TESTS}/{script}");
    let output = Command::new(python).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// The events of the frames, a tenth of a millisecond apart.
fn events(protocol: Protocol, types: Arc<DataTypes>, transfer: &serde_json::Value) -> Vec<Event> {
    let options = Options { protocols: vec![protocol], types: Some(types), ..Options::default() };
    let (mut reader, mut events) = (Reader::new(options), Vec::new());
    let mark = if transfer["fd"] == true { "##1" } else { "#" };
    for (time_ns, frame) in (0..).step_by(100_000).zip(transfer["frames"].as_array().unwrap()) {
        let frame = format!("{}{mark}{}", frame[0].as_str().unwrap(), frame[1].as_str().unwrap());
        let event =
            TraceEvent::Frame { frame: frame.parse().unwrap(), direction: Direction::Rx, late: false };
        reader.push(&TraceRecord { time_ns, device_ns: None, channel: 1, event }, &mut events);
    }
    reader.finish(&mut events);
    events
}

/// Whether our value is theirs.
fn is_same(ours: &Value, kind: &str, theirs: &serde_json::Value) -> bool {
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat();
    match (kind, ours) {
        ("int", Value::Number(ours)) => theirs.as_i64() == Some(*ours),
        ("int", Value::Hex(ours, _)) => theirs.as_u64() == Some(*ours),
        ("float", Value::Missing) => theirs == "nan",
        ("float", Value::Real(ours)) => {
            let theirs: f64 = theirs.as_str().unwrap().parse().unwrap();
            // Ours has the fewest digits that a float of 32 bits needs.
            ours.to_bits() == theirs.to_bits() || (*ours as f32).to_bits() == (theirs as f32).to_bits()
        }
        ("bytes", Value::Bytes(ours)) => theirs.as_str() == Some(&hex(ours)),
        ("bytes", Value::Text(ours)) => theirs.as_str() == Some(&hex(ours.as_bytes())),
        ("bits", Value::Text(ours)) => {
            let set: Vec<_> = theirs.as_array().unwrap().iter().map(ToString::to_string).collect();
            set.join(", ") == **ours
        }
        _ => false,
    }
}

/// Compares one transfer, or a request with its response; returns how many values there were.
fn compare(
    event: &Event,
    transfer: &serde_json::Value,
    fields_before: usize,
    wrong: &mut Vec<String>,
) -> usize {
    let theirs = transfer["values"].as_array().unwrap();
    let title = transfer["title"].as_str().unwrap();
    // More than are shown.
    let shown = theirs.iter().take(2000);
    let ours = &event.fields[fields_before..];
    if event.trouble.is_some() || event.title != title || theirs.len() <= 2000 && ours.len() != theirs.len() {
        wrong.push(format!("{title}: {event} {transfer}"));
        return 0;
    }
    let mut compared = 0;
    for ((part, field), number) in shown.zip(ours).zip(0..) {
        let (name, kind) = (part[0].as_str().unwrap(), part[1].as_str().unwrap());
        if field.name != name || !is_same(&field.value, kind, &part[2]) {
            wrong.push(format!("{title}: value {number}: {part}, ours is {field}"));
        }
        compared += 1;
    }
    compared
}

#[test]
fn every_data_type_of_dronecan_has_its_values() {
    let Some(python) = peers::python_with("dronecan") else { return };
    let seed = fastrand::u32(..);
    eprintln!("seed {seed}");
    let transfers = transfers(&python, "dronecan_peer.py", &[&seed.to_string(), &ROUNDS.to_string()]);
    let (mut compared, mut wrong, mut types, mut long) = (0, Vec::new(), BTreeSet::new(), 0);
    for transfer in &transfers {
        let events = events(Protocol::DroneCan, DataTypes::built_in(), transfer);
        let lines: Vec<_> = events.iter().map(ToString::to_string).collect();
        assert_eq!(events.len(), 1, "{transfer}: {lines:?}");
        compared += compare(&events[0], transfer, 3, &mut wrong);
        types.insert(transfer["title"].as_str().unwrap());
        long += usize::from(transfer["frames"].as_array().unwrap().len() > 2);
        let is_service = events[0].kind == EventKind::Exchange;
        assert_eq!(is_service, events[0].response_ns.is_some(), "{lines:?}");
    }
    assert!(wrong.is_empty(), "{} of {compared}: {}", wrong.len(), wrong[..wrong.len().min(5)].join("\n"));
    eprintln!(
        "{} transfers of {} types, {long} of more than two frames, {compared} values",
        transfers.len(),
        types.len()
    );
    assert!(types.len() > 120 && compared > 10_000, "{} {compared}", types.len());
}

#[test]
fn every_data_type_of_cyphal_has_its_values() {
    let Some(python) = peers::python_with("pycyphal.dsdl, pycyphal.transport.can") else { return };
    let seed = fastrand::u32(..);
    eprintln!("seed {seed}");
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cyphal_peer");
    let _ = std::fs::remove_dir_all(&folder);
    let definitions = concat!(env!("CARGO_MANIFEST_DIR"), "/data/cyphal.dsdl");
    let arguments = [definitions, folder.to_str().unwrap(), &seed.to_string(), &ROUNDS.to_string()];
    let transfers = transfers(&python, "cyphal_peer.py", &arguments);
    let (mut compared, mut wrong, mut types, mut long, mut others) =
        (0, Vec::new(), BTreeSet::new(), 0, BTreeSet::new());
    let mut named = (None, DataTypes::built_in());
    for transfer in &transfers {
        let title = transfer["title"].as_str().unwrap();
        if named.0 != Some(title) {
            let mut own = DataTypes::with(&[]).0;
            // A message's type may be named; of a service's versions, the newest is taken.
            let _ = own.name_subject(transfer["port"].as_u64().unwrap() as u16, title);
            named = (Some(title), Arc::new(own));
        }
        let events = events(Protocol::Cyphal, named.1.clone(), transfer);
        let lines: Vec<_> = events.iter().map(ToString::to_string).collect();
        assert_eq!(events.len(), 1, "{transfer}: {lines:?}");
        let is_service = events[0].kind == EventKind::Exchange;
        if is_service && events[0].title != title {
            others.insert(title);
            continue;
        }
        compared += compare(&events[0], transfer, 3, &mut wrong);
        types.insert(title);
        long += usize::from(transfer["frames"].as_array().unwrap().len() > 2);
    }
    assert!(wrong.is_empty(), "{} of {compared}: {}", wrong.len(), wrong[..wrong.len().min(5)].join("\n"));
    eprintln!(
        "{} transfers of {} types, {long} of more than two frames, {compared} values; other versions: {others:?}",
        transfers.len(),
        types.len()
    );
    assert!(
        types.len() > 220 && others.len() < 16 && compared > 10_000,
        "{} {compared} {others:?}",
        types.len()
    );
}
