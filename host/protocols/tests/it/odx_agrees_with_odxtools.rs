//! Requests and responses of ODX files, value by value, as the Python package odxtools reads them.
//!
//! The Python that has it is `CANTAP_PYTHON`, otherwise `python3`. If it is missing, that is said and the test passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use std::collections::BTreeMap;
use std::process::Command;

use cantap_protocols::odx::{Ecu, Internal, Odx, Physical, Reading};
use cantap_testing::peers;

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/odx_peer.py");
const DATA: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data");
/// Messages of each service.
const ROUNDS: u32 = 40;

fn bytes(line: &serde_json::Value, key: &str) -> Vec<u8> {
    let text = line[key].as_str().unwrap();
    (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat()
}

/// A reading as the script writes one.
fn shown(reading: &Reading) -> serde_json::Value {
    let values = reading.values.iter().map(|decoded| {
        let (kind, value) = match &decoded.value {
            // odxtools knows a code by its number, and every other value by its text.
            Physical::Meaning(Internal::Int(code), _) if decoded.hex_digits == Some(6) => {
                ("int", serde_json::json!(*code as i64))
            }
            Physical::Int(value) => ("int", serde_json::json!(*value as i64)),
            Physical::Real(value) => ("real", format!("{:016x}", value.to_bits()).into()),
            Physical::Text(text) | Physical::Meaning(_, text) => ("text", text.as_str().into()),
            Physical::Bytes(bytes) => ("bytes", hex(bytes).into()),
        };
        serde_json::json!([decoded.path, kind, value])
    });
    values.collect()
}

/// Whether a reading says that it is one, with every value.
fn is_whole(reading: &Reading) -> bool {
    reading.stop.is_none() && reading.values.iter().all(|decoded| decoded.note.is_none())
}

/// odxtools has no reading of a message with a trouble code that the file does not have; ours has its number.
fn has_unknown_code(reading: &Reading) -> bool {
    let is_code = |value: &Physical| matches!(value, Physical::Int(_));
    reading.values.iter().any(|decoded| decoded.hex_digits == Some(6) && is_code(&decoded.value))
}

#[derive(Default)]
struct Counts {
    same: u32,
    neither: u32,
}

impl Counts {
    fn compare(&mut self, ours: Option<&Reading>, theirs: &[&serde_json::Value], line: &serde_json::Value) {
        let theirs: Vec<_> = theirs.iter().filter(|reading| !reading.is_null()).collect();
        match ours.filter(|ours| is_whole(ours)) {
            Some(ours) if theirs.is_empty() => {
                assert!(has_unknown_code(ours), "{ours:?} but not theirs: {line}");
            }
            Some(ours) => {
                let shown = shown(ours);
                assert!(theirs.iter().any(|reading| ***reading == shown), "{shown} is not theirs: {line}");
                self.same += 1;
            }
            None => {
                assert!(theirs.is_empty(), "{ours:?} is not theirs: {line}");
                self.neither += 1;
            }
        }
    }
}

fn compare(file: &str, uncompared: &[&str]) -> Option<()> {
    let python = peers::python_with("odxtools")?;
    let path = format!("{DATA}/{file}");
    let odx = Odx::read(file, &std::fs::read(&path).unwrap()).unwrap();
    let output = Command::new(python).args([SCRIPT, &path, "7", &ROUNDS.to_string()]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut ecus: BTreeMap<String, Ecu> = BTreeMap::new();
    let mut counts = Counts::default();
    let mut services = BTreeMap::new();
    for line in String::from_utf8(output.stdout).unwrap().lines() {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        let (layer, service) = (line["layer"].as_str().unwrap(), line["service"].as_str().unwrap());
        let ecu = ecus.entry(layer.to_owned()).or_insert_with(|| odx.ecu(layer).unwrap());
        if uncompared.contains(&service) {
            continue;
        }
        let request = bytes(&line, "request");
        let before = counts.same;
        if line["kind"].is_null() {
            let described = ecu.describe(Some(&request), None);
            if let Some(described) = &described {
                assert_eq!(described.service, service, "{line}");
            }
            let ours = described.as_ref().and_then(|described| described.request.as_ref());
            counts.compare(ours, &[&line["of_request"]], &line);
        } else {
            let described = ecu.describe(Some(&request), Some(&bytes(&line, "data"))).unwrap();
            let theirs: Vec<_> = line["of_responses"].as_array().unwrap().iter().collect();
            counts.compare(described.response.as_ref(), &theirs, &line);
        }
        *services.entry((layer.to_owned(), service.to_owned(), line["kind"].to_string())).or_insert(0) +=
            counts.same - before;
    }
    let silent: Vec<_> = services.iter().filter(|(_, same)| **same == 0).map(|(key, _)| key).collect();
    assert!(silent.is_empty(), "of these no message was compared: {silent:?}");
    println!("{file}: {} readings are the same, {} messages are none for both", counts.same, counts.neither);
    Some(())
}

#[test]
fn somersault_has_the_values_of_odxtools() {
    // Its request has no constant, so no message can be told to be one.
    compare("somersault.pdx", &["schroedinger"]);
}

#[test]
fn each_kind_of_parameter_has_the_values_of_odxtools() {
    compare("kinds.odx-d", &[]);
}
