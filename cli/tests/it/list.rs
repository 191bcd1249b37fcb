//! `cantap list` beside makers' libraries, which are those that stand in for them in the adapters' tests, where the system's loader finds them.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::{Value, json};

use crate::schema::Schema;

/// A folder with both libraries; `None` where there is no compiler for C, which is said.
fn libraries(test: &str) -> Option<PathBuf> {
    if Command::new("cc").arg("--version").output().is_err() {
        println!("not tested: there is no cc");
        return None;
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("list").join(test);
    std::fs::create_dir_all(&folder).unwrap();
    for name in ["pcanbasic", "canlib"] {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/adapters/tests/stand_in");
        let compiled = Command::new("cc")
            .args(["-shared", "-fPIC", "-O1", "-pthread", "-o"])
            .args([folder.join(format!("lib{name}.so")), source.join(name).with_extension("c")])
            .output()
            .unwrap();
        assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    }
    Some(folder)
}

/// Standard output and standard error of `list`, with libraries that behave in this way.
fn list(folder: &Path, way: &str, more: &[&str]) -> (String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.arg("list").args(more).env("LD_LIBRARY_PATH", folder).env("STANDIN", way);
    let output = command.stdin(Stdio::null()).output().unwrap();
    let (out, err) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(output.status.success(), "{way}: {out}{err}");
    (out, err)
}

fn object(folder: &Path, way: &str) -> Value {
    let object: Value = serde_json::from_str(&list(folder, way, &["--json"]).0).unwrap();
    let schema = Schema::new(include_str!("../../../docs/json.schema.json"));
    assert_eq!(schema.faults("list", &object), [""; 0], "{object}");
    object
}

const LEAF: &str = "kvaser:0\tKvaser Leaf Light v2 (channel 0)\t12345\n";
const VIRTUAL: &str = "kvaser:1\tKvaser Virtual CAN Driver (channel 0)\t-\n";

#[test]
fn channels_of_makers_libraries_are_listed_once_each_and_cleaned() {
    let Some(folder) = libraries("listed") else { return };
    let (out, err) = list(&folder, "", &[]);
    let peak = "pcan:PCAN_USBBUS1\tPCAN-USB FD (device ID 2Ah)\t-\n\
                pcan:PCAN_USBBUS2\tPCAN-USB Pro FD\u{FFFD}[2J (device ID 7h)\t-\tanother program has it\n";
    assert!(out.ends_with(&format!("{peak}{LEAF}{VIRTUAL}")), "{out}");
    assert!(err.contains("left out: 1 channel, of kinds"), "{err}");
    let object = object(&folder, "");
    let adapters = object["adapters"].as_array().unwrap();
    assert_eq!(
        [&adapters[0], &adapters[1], &adapters[2], &adapters[3]].map(|one| (
            one["device"].as_str().unwrap(),
            one["can_fd"].clone(),
            one["in_use"].clone(),
            one["is_virtual"].clone()
        )),
        [
            ("pcan:PCAN_USBBUS1", json!(false), json!(false), json!(false)),
            ("pcan:PCAN_USBBUS2", json!(true), json!(true), json!(false)),
            ("kvaser:0", json!(true), json!(null), json!(false)),
            ("kvaser:1", json!(true), json!(null), json!(true)),
        ]
    );
    assert_eq!((&object["without_address"], &object["unusable"]), (&json!(1), &json!([])));
}

/// The other maker's channels are there all the same.
#[test]
fn a_library_that_hangs_dies_or_refuses_is_named() {
    let Some(folder) = libraries("bad") else { return };
    for (way, reason) in [("hangs", "did not answer within"), ("dies", "it ended the program that asked it")]
    {
        let (out, err) = list(&folder, way, &[]);
        assert!(out.ends_with(&format!("{LEAF}{VIRTUAL}")) && !out.contains("pcan:"), "{way}: {out}");
        assert!(
            err.contains("PCAN-Basic's channels are not known: ") && err.contains(reason),
            "{way}: {err}"
        );
    }
    let object = object(&folder, "refuses");
    assert_eq!(object["adapters"][0]["device"], "pcan:PCAN_USBBUS1");
    assert_eq!(object["unusable"], json!([{ "library": "CANlib", "reason": "CANlib says: Hardware error" }]));
    // A file that is no library is not the same as none.
    std::fs::write(folder.join("libcanlib.so"), "no library").unwrap();
    assert!(
        list(&folder, "", &[]).1.contains("CANlib's channels are not known: libcanlib.so cannot be loaded")
    );
    std::fs::remove_file(folder.join("libcanlib.so")).unwrap();
    assert!(!list(&folder, "", &[]).1.contains("CANlib"));
}

#[test]
fn what_a_library_invents_is_bounded_and_an_old_one_is_asked_channel_by_channel() {
    let Some(folder) = libraries("odd") else { return };
    let lies = object(&folder, "lies");
    let adapters = lies["adapters"].as_array().unwrap();
    // The two of PEAK's that are there and the two of Kvaser's that it knows something of; the handle of all the others has no name.
    assert_eq!(adapters.len(), 4, "{lies}");
    assert_eq!(lies["without_address"], 256 - 3);
    let (out, _) = list(&folder, "is old", &[]);
    assert!(out.contains("pcan:PCAN_USBBUS1\tPCAN-USB FD (device ID 0h)\t-\n"), "{out}");
}
