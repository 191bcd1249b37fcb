//! MCAP files written by `cantap decode`, read by the format's own library.
//!
//! It is in `CANTAP_PYTHON`, otherwise `python3`. If it is missing, the test says so and passes, unless `CANTAP_REQUIRE_PEERS=1`.
#![cfg(feature = "mcap")]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;

use cantap_testing::peers;
use serde_json::{Value, json};

fn run(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let command = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(line.split(' '))
        .current_dir(folder)
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (command.status.code(), text(command.stdout), text(command.stderr))
}

fn cantap(folder: &Path, line: &str) -> (String, String) {
    let (code, out, err) = run(folder, line);
    assert_eq!(code, Some(0), "{line}: {err}");
    (out, err)
}

fn as_read(python: &str, folder: &Path, file: &str) -> Value {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/mcap_peer.py");
    let output = Command::new(python).args([script, file]).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Nanoseconds of a time in seconds with a point.
fn ns(seconds: &str) -> u64 {
    let (whole, fraction) = seconds.split_once('.').unwrap();
    whole.parse::<u64>().unwrap() * 1_000_000_000 + format!("{fraction:0<9}").parse::<u64>().unwrap()
}

/// More messages than a chunk has, and each of them as the JSON lines say.
#[test]
fn the_library_reads_every_value_that_decode_prints() {
    let Some(python) = peers::python_with("mcap") else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("car.dbc"), cantap(folder, "virtual car --dbc").0).unwrap();
    cantap(folder, "capture -d virtual:car,pace=fast -n 30000 -o captured.log");
    let log = fs::read_to_string(folder.join("captured.log")).unwrap();
    let (before, after) = log.split_at(log[..log.len() / 2].rfind('\n').unwrap() + 1);
    let stamp = after.split(' ').next().unwrap();
    let events = format!("{stamp} can0 20000004#0001000000000000\n{stamp} can0 20000088#0000000000000000\n");
    fs::write(folder.join("drive.log"), format!("{before}{events}{after}")).unwrap();
    cantap(folder, "decode --db car.dbc drive.log -o drive.mcap");
    let found = as_read(&python, folder, "drive.mcap");

    let messages = found["messages"].as_array().unwrap();
    let mut by_topic: BTreeMap<&str, Vec<&Value>> = BTreeMap::new();
    for message in messages {
        by_topic.entry(message[0].as_str().unwrap()).or_default().push(message);
    }
    let (out, _) = cantap(folder, "decode --db car.dbc drive.log --json --details");
    let mut lines = 0;
    for line in out.lines().filter(|line| !line.starts_with("{\"summary\"")) {
        let value: Value = serde_json::from_str(line).unwrap();
        let topic = format!("/channel{}/{}", value["channel"], value["message"].as_str().unwrap());
        let of_topic = by_topic.get_mut(topic.as_str()).unwrap();
        let message = of_topic.remove(0);
        // As it is printed: a number in JSON would lose the nanoseconds.
        let seconds = line.split([':', ',']).nth(1).unwrap();
        assert_eq!(message[2], ns(seconds), "{line}");
        let mut wanted = json!({ "id": u32::from_str_radix(value["id"].as_str().unwrap(), 16).unwrap() });
        for (name, signal) in value["signals"].as_object().unwrap() {
            if !signal["value"].is_null() {
                wanted[name] = signal["value"].clone();
            }
            let has_table = found["schemas"][value["message"].as_str().unwrap()][1]["properties"]
                .get(format!("{name}.text"))
                .is_some();
            if has_table && let Some(text) = signal.get("text") {
                wanted[format!("{name}.text")] = text.clone();
            }
        }
        assert_eq!(message[3], wanted, "{line}");
        lines += 1;
    }
    let events = by_topic.remove("/events").unwrap();
    assert_eq!(events.len(), 2, "{events:?}");
    assert_eq!(events[0][3]["event"], "lost");
    assert_eq!(events[1][3]["event"], "bus-error");
    assert_eq!(events[1][3]["channel"], 1);
    assert!(by_topic.values().all(Vec::is_empty));
    assert_eq!(messages.len(), lines + 2);
    assert_eq!(found["in_order"], messages.len());
    assert_eq!(found["statistics"]["messages"], messages.len());
    assert!(found["statistics"]["chunks"].as_u64().unwrap() > 1, "{}", found["statistics"]);
    let topic = &found["topics"]["/channel1/ECM_Engine1"];
    assert_eq!((&topic[0], &topic[1]), (&json!("json"), &json!("ECM_Engine1")));
    let schema = &found["schemas"]["ECM_Engine1"];
    assert_eq!((&schema[0], &schema[1]["type"]), (&json!("jsonschema"), &json!("object")));
    assert!(
        schema[1]["properties"]["EngineSpeed"]["description"].as_str().unwrap().ends_with("[rpm]"),
        "{schema}"
    );
}

/// Names that are no names elsewhere, two messages of the same name, a name that a field has, floats without a value, times before 1970.
#[test]
fn what_a_database_of_a_stranger_says_stays_json() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let signal = |name: &str, at: u8| format!(" SG_ {name} : {at}|8@1+ (1,0) [0|0] \"<µ>\" A\n");
    let one = format!("BO_ 291 M: 8 A\n{}{}VAL_ 291 x 2 \"a, {{b}}\" ;\n", signal("id", 0), signal("x", 8));
    let float = "BO_ 292 M: 8 A\n SG_ f : 0|32@1- (1,0) [0|0] \"\" A\n SG_ g : 32|64@1+ (1,0) [0|0] \"\" A\nSIG_VALTYPE_ 292 f : 1;\n";
    fs::write(folder.join("a.dbc"), one).unwrap();
    fs::write(folder.join("b.dbc"), float).unwrap();
    fs::write(
        folder.join("a.log"),
        "(-1.000000) can0 123#0102\n(1.000000) can0 123#0102\n(2.000000) can0 124#0000C07F\n(0.500000) can1 124#0000803F\n",
    )
    .unwrap();
    let (_, err) = cantap(folder, "decode --db a.dbc --db b.dbc a.log -o a.mcap");
    assert!(err.contains("before 1970: 1 messages"), "{err}");
    let Some(python) = peers::python_with("mcap") else { return };
    let found = as_read(&python, folder, "a.mcap");
    let mut messages = found["messages"].as_array().unwrap().clone();
    messages.sort_by_key(|message| message[2].as_u64());
    assert_eq!(messages[0][3], json!({ "id": 0x124, "f": 1 }), "{found}");
    assert_eq!(messages[1][3], json!({ "id": 0x123, "M.id": 1, "x": 2, "x.text": "a, {b}" }), "{found}");
    assert_eq!(messages[2][3], json!({ "id": 0x124 }), "{found}");
    let topics: Vec<_> = found["topics"].as_object().unwrap().keys().cloned().collect();
    assert_eq!(topics.len(), 3, "{topics:?}");
    assert!(topics[0].starts_with("/channel1/M") && topics[2] == "/channel2/M", "{topics:?}");
}

#[test]
fn a_file_takes_its_name_when_it_is_whole_and_what_does_not_fit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.log"), "(1.000000) can0 123#00\n").unwrap();
    fs::write(folder.join("b.log"), "no trace\nat all\n").unwrap();
    fs::write(folder.join("car.dbc"), "BO_ 291 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n").unwrap();
    for option in ["--wide", "--resample 1s", "--protocols"] {
        let (code, _, err) = run(folder, &format!("decode --db car.dbc a.log -o a.mcap {option}"));
        assert_eq!(code, Some(2), "{option}: {err}");
        assert!(!folder.join("a.mcap").exists());
    }
    fs::write(folder.join("older.mcap"), "older").unwrap();
    let (code, _, err) = run(folder, "decode --db car.dbc b.log -o older.mcap");
    assert_eq!(code, Some(1), "{err}");
    assert_eq!(fs::read(folder.join("older.mcap")).unwrap(), b"older");
    cantap(folder, "decode --db car.dbc a.log -o older.mcap");
    assert!(fs::read(folder.join("older.mcap")).unwrap().starts_with(b"\x89MCAP0\r\n"));
}
