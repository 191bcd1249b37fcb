//! `cantap capture --trigger` and `cantap decode` on a device, as users run them.

use std::path::PathBuf;
use std::process::{Command, Output};

const DATABASE: &str = "BO_ 1 Engine: 8 A\n SG_ Speed : 0|8@1+ (2,-40) [0|0] \"km/h\" A\n";

/// Runs it on a virtual device that replays 60 frames, one every 10 ms, numbered in their first byte.
fn cantap(test: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("trigger").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    let lines: Vec<_> = (0..60).map(|at| format!("(0.{:06}) can0 001#{at:02X}\n", at * 10_000)).collect();
    std::fs::write(directory.join("bus.log"), lines.concat()).unwrap();
    std::fs::write(directory.join("car.dbc"), DATABASE).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(arguments)
        .args(["-d", "virtual:log=bus.log", "-c", "1", "-b", "500k"])
        .current_dir(directory)
        .output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// The frames without their times.
fn frames(log: &str) -> Vec<&str> {
    log.lines().filter_map(|line| line.split(' ').nth(2)).collect()
}

#[test]
fn only_what_is_around_the_event_is_kept() {
    let trigger =
        ["--db", "car.dbc", "--trigger", "Speed > 0 and Speed < 10", "--pre", "25ms", "--post", "15ms"];
    let (code, out, err) = cantap("around", &[&["capture", "-n", "60"][..], &trigger].concat());
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(frames(&out), ["001#13", "001#14", "001#15", "001#16"]);
    assert!(err.contains("trigger: 1 event, 4 records kept\n"), "{err}");
}

#[test]
fn once_ends_after_the_first_event() {
    let trigger = [
        "--trigger",
        "byte[0] == 3",
        "--pre",
        "0",
        "--post",
        "5ms",
        "--events",
        "1",
        "--json",
        "--force",
        "-o",
        "once.log",
    ];
    let (code, out, err) = cantap("once", &[&["capture"][..], &trigger].concat());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["trigger"], serde_json::json!({ "events": 1, "kept": 1, "forgotten": 0 }));
}

#[test]
fn a_condition_that_cannot_be_understood_ends_before_anything_is_written() {
    let (code, _, err) =
        cantap("wrong", &["capture", "--trigger", "Sped > 1", "--db", "car.dbc", "-o", "wrong.log"]);
    assert_eq!(code, Some(2));
    assert!(
        err.starts_with("cantap: --trigger: there is no signal or message \"Sped\"; did you mean Speed?\n"),
        "{err}"
    );
}

#[test]
fn a_device_is_decoded_live() {
    let (code, out, err) = cantap("live", &["decode", "--db", "car.dbc", "-t", "300ms"]);
    assert_eq!(code, Some(0), "{err}");
    let values: Vec<_> = out.lines().filter_map(|line| line.split_once(") ")).map(|(_, line)| line).collect();
    assert_eq!(values[..2], ["can0 001 Engine: Speed = -40 km/h", "can0 001 Engine: Speed = -38 km/h"]);
}

#[test]
fn a_device_is_searched_live_with_context() {
    let search = ["search", "--db", "car.dbc", "-e", "Speed == -36", "-C", "1", "-m", "1"];
    let (code, out, err) = cantap("search", &search);
    assert_eq!(code, Some(0), "{err}");
    let found: Vec<_> = out.lines().map(|line| line.split(' ').nth(2).unwrap_or_default()).collect();
    assert_eq!(found, ["001#01", "001#02", "001#03"], "{out}");
    let (code, out, err) = cantap("search", &["search", "--id", "7FF", "-t", "100ms"]);
    assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
}
