//! `cantap j1939 send` with the groups of NMEA 2000: values by name, fast packets, again and again, and what is refused before anything is sent.
#![cfg(unix)]

use crate::served::Served;

use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::Value;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

fn cantap(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = Command::new(CANTAP).args(arguments).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

const WIND: [&str; 4] = ["Wind Data", "wind_speed=6 m/s", "Wind Angle=0.5", "reference=apparent"];
const MODEL: [&str; 5] = [
    "126996",
    "Model ID=cantap boat",
    "Product Code=42",
    "Load Equivalency=1",
    "Certification Level=Level B",
];

#[test]
fn values_by_name_leave_as_single_frames_and_fast_packets_and_are_heard_as_such() {
    let served = Served::start("virtual:load=0", Stdio::null());
    let folder = served.folder.path();
    let mut listener = served.record("heard.log");
    let send = |more: &[&str]| {
        let start = ["j1939", "-d", &served.at, "-b", "500k", "--address", "35", "send"];
        let (code, out, err) = cantap(folder, &[&start, more].concat());
        assert_eq!(code, Some(0), "{more:?}: {out}{err}");
        (out, err)
    };
    let (out, _) = send(&WIND);
    assert!(
        out.contains("nmea2000 35 > all Wind Data: pgn 130306, priority 2, ")
            && out.contains("Wind Speed 6 m/s"),
        "{out}"
    );
    let (out, err) = send(&[&MODEL[..], &["--period", "50ms", "-n", "3"]].concat());
    assert_eq!(out.matches("Product Information: pgn 126996").count(), 3, "{out}");
    assert!(out.contains("Model ID \"cantap boat\"") && err.contains("3 messages were sent"), "{out}{err}");
    // Bytes of a group that the database does not have, by either way.
    send(&["0x1FF42", "0102030405060708090A", "--transport", "fast-packet"]);
    send(&["0xFF42", "0102030405060708090A"]);
    Command::new("kill").args(["-INT", &listener.id().to_string()]).status().unwrap();
    listener.wait().unwrap();
    let log = std::fs::read_to_string(folder.join("heard.log")).unwrap();
    let frames = |id: &str| log.lines().filter(|line| line.contains(&format!(" {id}#"))).count();
    // Twenty frames for 134 bytes, each with its own counter; the claim before each command.
    assert_eq!((frames("09FD0223"), frames("19F01423"), frames("19FF4223")), (1, 60, 2), "{log}");
    assert_eq!((frames("18EEFF23"), frames("1CECFF23"), frames("1CEBFF23")), (4, 1, 2), "{log}");
    let (_, out, _) =
        cantap(folder, &["conversations", "--json", "--quiet", "--protocol", "nmea2000", "heard.log"]);
    let events: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let models = events.iter().filter(|event| event["fields"]["Model ID"] == "cantap boat").count();
    assert_eq!(models, 3, "{out}");
    assert!(events.iter().all(|event| event["trouble"].is_null()), "{out}");
}

#[test]
fn a_preview_prints_the_frames_and_what_is_wrong_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let send = |more: &[&str]| cantap(folder.path(), &[&["j1939", "--address", "35", "send"], more].concat());
    let (code, out, err) = send(&[&WIND[..], &["--preview"]].concat());
    assert_eq!((code, out.as_str()), (Some(0), "09FD0223#FF58028813FAFFFF\n"), "{err}");
    let (_, out, _) = send(&[&MODEL[..], &["--preview"]].concat());
    assert_eq!(out.lines().next(), Some("19F01423#0086FFFF2A006361"), "{out}");
    assert_eq!(out.lines().count(), 20, "{out}");
    for (line, expected) in [
        (&["Wind Data", "Wind Speed=700 m/s"][..], "Wind Speed cannot be '700 m/s': it is from 0 to"),
        (&["Wind Data", "Depth=1"], "Wind Data has no field 'Depth'; it has SID, Wind Speed"),
        (&["Wind", "Speed=1"], "no group 'Wind'; there are"),
        (&["GNSS Position Data", "Latitude=1"], "Integrity"),
        (&["65260", "0102", "Speed=1"], "write all bytes in one argument"),
        (&["Wind Data", "0102"], "is no group's number"),
        (&["0xEF05", "01"], "--to gives"),
        (&["130306", "Reference=2", "--to", "5"], "goes to all; omit --to"),
        (
            &["0xEF00", &"01".repeat(224), "--transport", "fast-packet"],
            "at most 223 bytes, and this one has 224",
        ),
        (&["0xEF00", "010203040506070809", "--preview"], "depends on its receiver"),
        (&["130306", "Reference=2", "--period", "1ms"], "a period is at least 10 ms"),
        (&["130306", "Reference=2", "-n", "3"], "--period"),
    ] {
        let (code, out, err) = send(line);
        assert!(code == Some(2) && out.is_empty() && err.contains(expected), "{line:?}: {code:?} {err}");
    }
}
