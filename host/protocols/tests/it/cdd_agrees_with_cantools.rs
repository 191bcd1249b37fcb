//! Vector's descriptions of ECUs (CDD), value by value, as cantools reads its own examples.

use std::path::Path;
use std::process::Command;

use cantap_protocols::odx::{Ecu, Internal, Odx, Physical};
use cantap_testing::peers;

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/cdd_peer.py");

/// The number of a value, without its text.
fn number(value: &Physical) -> f64 {
    match value {
        Physical::Int(value) | Physical::Meaning(Internal::Int(value), _) => *value as f64,
        Physical::Real(value) => *value,
        other => panic!("{other:?}"),
    }
}

/// The response to the request of an instance, with this data behind what the response repeats.
fn read(ecu: &Ecu, line: &serde_json::Value) -> Vec<(String, Physical, String)> {
    let name = line["name"].as_str().unwrap();
    let wanted = format!("{name}_Read");
    let requests = ecu.requests();
    let request =
        requests.iter().find(|request| request.name == wanted).unwrap_or_else(|| panic!("{wanted}"));
    let text = line["data"].as_str().unwrap();
    let data = (0..text.len()).step_by(2).map(|at| u8::from_str_radix(&text[at..at + 2], 16).unwrap());
    let mut response = request.bytes.clone();
    response[0] += 0x40;
    response.extend(data);
    let described = ecu.describe(Some(&request.bytes), Some(&response)).unwrap();
    assert_eq!(described.service, wanted);
    let reading = described.response.unwrap();
    assert!(reading.stop.is_none() && reading.undescribed.is_empty(), "{line}: {reading:?}");
    let values = reading.values.into_iter().filter(|decoded| !decoded.is_constant);
    values.map(|decoded| (decoded.path, decoded.value, decoded.unit.to_string())).collect()
}

#[test]
fn values_are_those_that_cantools_reads() {
    let Some(python) = peers::python_with("cantools") else { return };
    let cache = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cdd");
    std::fs::create_dir_all(&cache).unwrap();
    let output = Command::new(python).arg(SCRIPT).arg(&cache).args(["7", "20"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (mut ecu, mut files, mut values) = (None, 0, 0);
    for line in String::from_utf8(output.stdout).unwrap().lines() {
        if let Some(path) = line.strip_prefix("file ") {
            let odx = Odx::read(path, &std::fs::read(path).unwrap()).unwrap();
            let layer = odx.layers().next().unwrap().1.to_owned();
            ecu = Some(odx.ecu(&layer).unwrap());
            files += 1;
            continue;
        }
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        let ours = read(ecu.as_ref().unwrap(), &line);
        assert_eq!(ours.len(), line["values"].as_object().unwrap().len(), "{line}");
        for (name, value, unit) in ours {
            let theirs = line["values"][&name].as_f64().unwrap_or_else(|| panic!("{name}: {line}"));
            assert!((number(&value) - theirs).abs() <= 1e-9 * theirs.abs(), "{name} {value:?}: {line}");
            assert_eq!(line["units"][&name], unit.as_str(), "{name}: {line}");
            if let Physical::Meaning(_, text) = &value {
                let shown = line["shown"][&name].as_str().unwrap();
                // It has no ranges of values with a text.
                assert!(shown == text || shown.parse::<f64>().is_ok(), "{name} {text}: {line}");
            }
            values += 1;
        }
    }
    assert!(files >= 2 && values > 1000, "{files} files, {values} values");
}
