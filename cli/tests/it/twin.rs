//! `cantap twin`: a trace becomes scripts, and these become a trace that is like it.

use std::path::Path;
use std::process::{Command, Output};

fn cantap(folder: &Path, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(arguments.split(' ')).current_dir(folder).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

/// A trace of the virtual vehicle with somebody who asks it.
fn vehicle() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let source = "fn test_all() { for round in 0..20 { request(\"7E0\", \"7E8\", [0x22, 0xF1, 0x90]); wait(\"1s\"); } }";
    std::fs::write(folder.path().join("asks.rhai"), source).unwrap();
    let output = cantap(folder.path(), "run asks.rhai --bus car -o drive.log");
    assert!(output.status.success(), "{output:?}");
    folder
}

#[test]
fn a_vehicle_becomes_scripts_that_play_it_again() {
    let folder = vehicle();
    let output = cantap(folder.path(), "twin drive.log -o car.rhai --tester asks.rhai --force --json");
    assert!(output.status.success(), "{output:?}");
    let object: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(object["apart_pct"].as_f64().unwrap() < 2.0, "{object}");
    for identifier in object["identifiers"].as_array().unwrap() {
        assert!(
            identifier["checksums_right_pct"][1].as_f64().is_none_or(|right| right >= 100.0),
            "{identifier}"
        );
        assert!(identifier["known_rest_pct"].as_f64().is_none_or(|known| known >= 100.0), "{identifier}");
    }
    let checksums = |object: &serde_json::Value| {
        object["identifiers"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|each| each["checksum"] == true && each["role"] == "sender")
            .count()
    };
    assert!(checksums(&object) >= 2 && object["exchanges"] == 1, "{object}");
    let played = cantap(folder.path(), "run car.rhai asks.rhai --for 20s -o played.log");
    assert!(played.status.success(), "{played:?}");
    // A twin of the twin has found the same.
    let again = cantap(folder.path(), "twin played.log --json");
    let again: serde_json::Value = serde_json::from_slice(&again.stdout).unwrap();
    assert_eq!(
        (checksums(&again), &again["exchanges"]),
        (checksums(&object), &object["exchanges"]),
        "{again}"
    );
}

#[test]
fn scripts_that_exist_are_kept_and_what_is_in_none_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let pair = |at| format!("({at}.000000) can0 123#00\n({at}.500000) can0 124##0112233\n");
    let lines: String = (0..20).map(pair).collect();
    std::fs::write(at("a.log"), lines).unwrap();
    std::fs::write(at("car.rhai"), "mine").unwrap();
    let output = cantap(folder.path(), "twin a.log -o car.rhai");
    assert!(!output.status.success() && text(&output.stderr).contains("--force"), "{output:?}");
    assert_eq!(std::fs::read_to_string(at("car.rhai")).unwrap(), "mine");
    let output = cantap(folder.path(), "twin a.log -o same.rhai --tester same.rhai");
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    let output = cantap(folder.path(), "twin a.log -o car.rhai --force --tester tester.rhai");
    assert!(output.status.success(), "{output:?}");
    assert!(text(&output.stdout).contains("left out: FD frames (20)"), "{output:?}");
    assert!(text(&output.stderr).contains("nobody asks") && !at("tester.rhai").exists(), "{output:?}");
    // One frame has no load of its own time.
    std::fs::write(at("one.log"), "(1.000000) can0 123#00\n").unwrap();
    let output = cantap(folder.path(), "twin one.log");
    assert!(text(&output.stdout).contains("1 and 1 frame\nchannel 1: load 0.1"), "{output:?}");
    std::fs::write(at("empty.log"), "(1.000000) can0 124##0112233\n").unwrap();
    let output = cantap(folder.path(), "twin empty.log");
    assert!(
        !output.status.success() && text(&output.stderr).contains("no frame to learn from"),
        "{output:?}"
    );
}
