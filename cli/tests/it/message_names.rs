//! Names of messages in filters, identifiers and conditions, in each command that reads databases.

use std::path::Path;
use std::process::{Command, Output, Stdio};

const LOG: &str =
    "(1.0) can0 123#0A00\n(1.1) can0 124#0B\n(1.2) can1 123#FF\n(1.3) can0 200#00\n(1.4) can0 123#0C00\n";
const DATABASE: &str = "BO_ 291 EngineData: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"km/h\" A\nBO_ 292 Body2: 8 A\n SG_ Door : 0|8@1+ (1,0) [0|0] \"\" A\nBO_ 512 EEC1: 8 A\n SG_ Gear : 0|8@1+ (1,0) [0|0] \"\" A\n";

fn cantap(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(arguments).current_dir(folder).stdin(Stdio::null()).output().unwrap();
    let Output { status, stdout, stderr } = output;
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.log"), LOG).unwrap();
    // What differs is hidden by the filter.
    std::fs::write(folder.path().join("b.log"), LOG.replace("124#0B", "124#0C")).unwrap();
    std::fs::write(folder.path().join("x.dbc"), DATABASE).unwrap();
    folder
}

#[test]
fn a_message_s_name_stands_for_its_identifier_in_every_command() {
    let folder = folder();
    for (line, lines) in [
        (vec!["search", "a.log", "--db", "x.dbc", "-f", "EngineData", "len > 0"], 3),
        (vec!["search", "a.log", "--db", "x.dbc", "-i", "EngineData"], 3),
        (vec!["search", "a.log", "--db", "x.dbc", "-i", "msg:EEC1"], 1),
        (vec!["search", "a.log", "--db", "x.dbc", "-f", "can0,EngineData", "len > 0"], 2),
        (vec!["search", "a.log", "--db", "x.dbc", "EngineData and byte[0] > 10"], 2),
        (vec!["search", "a.log", "--db", "x.dbc", "Body2 or EEC1"], 2),
        (vec!["decode", "a.log", "--db", "x.dbc", "-f", "any,Body2,EngineData"], 4),
        (vec!["decode", "a.log", "--db", "x.dbc", "-f", "Body2"], 1),
        (vec!["decode", "a.log", "--db", "x.dbc", "-f", "can1,EngineData"], 1),
        (vec!["convert", "a.log", "-", "--to", "candump", "--db", "x.dbc", "EngineData", "-f", "Body2"], 4),
        (vec!["diff", "a.log", "b.log", "--db", "x.dbc", "-f", "EngineData"], 1),
        (vec!["search", "a.log", "--db", "x.dbc", "msg:EngineData and byte[0] > 10"], 2),
    ] {
        let (code, out, err) = cantap(folder.path(), &line);
        assert_eq!((code, out.lines().count()), (Some(0), lines), "{line:?}: {out}{err}");
        assert!(line[0] != "diff" || out.ends_with("0 changed, 2 the same\n"), "{out}");
    }
    let plot = ["plot", "a.log", "--db", "x.dbc", "-f", "EngineData", "-o", "x.svg", "--json"];
    let (code, out, err) = cantap(folder.path(), &plot);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Speed") && !out.contains("Door"), "{out}");
    for (line, frames) in [
        (vec!["stats", "a.log", "--db", "x.dbc", "-f", "EngineData", "--json"], 3),
        (vec!["db", "x.dbc", "--coverage", "a.log", "-f", "Body2", "--json"], 1),
    ] {
        let (code, out, err) = cantap(folder.path(), &line);
        let object: serde_json::Value =
            serde_json::from_str(&out).unwrap_or_else(|_| panic!("{code:?} {err}"));
        let channels = object["channels"].as_array();
        let sum = channels.map(|all| all.iter().filter_map(|channel| channel["frames"].as_u64()).sum());
        assert_eq!(sum.or_else(|| object["frames"].as_u64()), Some(frames), "{object}");
    }
    let replay = [
        "replay",
        "-d",
        "virtual",
        "-b",
        "500k",
        "a.log",
        "--db",
        "x.dbc",
        "-f",
        "can0,EngineData",
        "--json",
    ];
    let (code, out, err) = cantap(folder.path(), &replay);
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["sent"], 2, "{summary}");
    let send =
        ["send", "-d", "virtual:car", "1", "7FF#00", "--on-rx", "TCM_Transmission1", "-t", "300ms", "--json"];
    let (code, out, err) = cantap(folder.path(), &send);
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(summary["replies"][0]["matches"].as_u64() > Some(0), "{summary}");
    let view = ["monitor", "a.log", "--db", "x.dbc", "-f", "EngineData", "--once", "--size", "100x20"];
    let (code, out, err) = cantap(folder.path(), &view);
    assert!(code == Some(0) && out.contains("EngineData") && !out.contains("Body2"), "{out}{err}");
    let capture = ["capture", "-d", "virtual:car", "-t", "500ms", "-f", "TCM_Transmission1", "--json"];
    let (code, out, err) = cantap(folder.path(), &capture);
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{code:?} {err}"));
    let frames = summary["channels"][0]["frames"].as_u64().unwrap();
    assert!(frames > 0 && frames < 60, "{summary}");
}

#[test]
fn what_is_no_name_or_could_be_two_things_is_an_error_of_the_command_line() {
    let folder = folder();
    for (line, part) in [
        (vec!["search", "a.log", "--db", "x.dbc", "-i", "EngineDate"], "did you mean EngineData?"),
        (vec!["search", "a.log", "--db", "x.dbc", "-i", "EEC1"], "msg:EEC1 or 0xEEC1"),
        (vec!["decode", "a.log", "--db", "x.dbc", "-f", "can0,EEC1"], "msg:EEC1 or 0xEEC1"),
        (
            vec!["decode", "a.log", "--db", "x.dbc", "-f", "Bdoy2"],
            "did you mean Body2? If it is an interface, write can2",
        ),
        (
            vec!["convert", "a.log", "out.log", "--db", "x.dbc", "-f", "Enginedata"],
            "did you mean EngineData?",
        ),
        (
            vec!["send", "-d", "virtual", "-b", "500k", "1", "7FF#00", "--on-rx", "EngineData"],
            "load one with --db",
        ),
        (
            vec!["plot", "a.log", "--db", "x.dbc", "--bus-load", "-f", "EngineDate"],
            "did you mean EngineData?",
        ),
        (vec!["stats", "a.log", "-f", "EngineData"], "load one with --db"),
        (vec!["search", "a.log", "-f", "EngineData", "len > 0"], "load one with --db"),
        (vec!["search", "a.log", "EngineData"], "neither signals nor messages"),
        (vec!["capture", "-d", "virtual", "-b", "500k", "-f", "EngineData"], "load one with --db"),
    ] {
        let (code, out, err) = cantap(folder.path(), &line);
        assert!(code == Some(2) && err.contains(part) && out.is_empty(), "{line:?}: {code:?} {out}{err}");
    }
}
