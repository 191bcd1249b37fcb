//! `cantap doctor`: each fault that can be simulated is found, named, and followed by what to do; a port that is no board is explained.
#![cfg(target_os = "linux")]

use std::io::Read;
use std::process::{Command, Output, Stdio};

use portable_pty::{CommandBuilder, PtySize, native_pty_system};
use serde_json::Value;

use crate::port::Port;

fn cantap(line: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(line.split_whitespace()).stdin(Stdio::null()).output().unwrap();
    let Output { status, stdout, stderr } = output;
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// The checks of a run with `--json`, after its exit code was compared.
fn checks(line: &str, code: i32) -> Vec<Value> {
    let (ended, out, err) = cantap(&format!("doctor {line} --json"));
    assert_eq!(ended, Some(code), "{line}: {out}{err}");
    let object: Value = serde_json::from_str(&out).unwrap();
    let checks = object["checks"].as_array().unwrap().clone();
    let problems: Vec<&Value> = checks.iter().filter(|check| check["outcome"] == "problem").collect();
    assert_eq!(object["problems"], problems.len(), "{object}");
    // Whoever has a problem learns what to do.
    assert!(problems.iter().all(|check| check["next"].is_string()), "{object}");
    checks
}

/// The check of a channel's bus.
fn bus(checks: &[Value], channel: u8) -> &Value {
    let is = |check: &&Value| check["check"] == "bus" && check["channel"] == channel;
    checks.iter().find(is).unwrap_or_else(|| panic!("no bus {channel} in {checks:?}"))
}

fn of<'c>(checks: &'c [Value], name: &str) -> &'c Value {
    checks.iter().find(|check| check["check"] == name).unwrap_or_else(|| panic!("no {name} in {checks:?}"))
}

#[test]
fn a_good_device_has_no_problem() {
    let checks = checks("-d virtual:load=30 -t 300ms", 0);
    assert_eq!(of(&checks, "device")["outcome"], "ok");
    for channel in [1, 2] {
        let bus = bus(&checks, channel);
        assert!(bus["outcome"] == "ok" && bus["bus"]["hint"].is_null(), "{bus}");
        assert!(bus["bus"]["frames"].as_u64() > Some(0) && bus["bus"]["bus_errors"] == 0, "{bus}");
    }
    let (code, out, _) = cantap("doctor -d virtual:load=30,bitrate=125k -c 1 -b auto -t 300ms");
    assert_eq!(code, Some(0), "{out}");
    assert!(out.contains("ok       bus 1") && out.contains(" frames at 125000 bit/s, load "), "{out}");
}

#[test]
fn each_simulated_fault_of_a_bus_is_named_with_the_next_step() {
    for (line, hint, found, next) in [
        (
            "virtual:bitrate=125k -b 500k",
            "wrong-bit-rate",
            "the bus runs at 125000 bit/s, not at 500000",
            "-b 1:125000",
        ),
        ("virtual:ack=no", "lone-sender", "nobody acknowledges", "--mode normal"),
        ("virtual:load=0", "silent", "neither frames nor errors", "cantap help wiring"),
        ("virtual:load=0 -b auto", "silent", "neither frames nor errors", "cantap help wiring"),
        (
            "virtual:load=50,errors=20 -b 500k",
            "disturbed",
            "more than one error for a hundred frames",
            "60 ohms",
        ),
    ] {
        let checks = checks(&format!("-d {line} -c 1 -t 300ms"), 3);
        let bus = bus(&checks, 1);
        assert_eq!(bus["bus"]["hint"], hint, "{line}: {bus}");
        assert!(bus["found"].as_str().unwrap().contains(found), "{line}: {bus}");
        assert!(bus["next"].as_str().unwrap().contains(next), "{line}: {bus}");
    }
}

/// Often only one of two channels is connected.
#[test]
fn a_silent_channel_beside_one_with_traffic_is_worth_a_note_only() {
    let checks = checks("-d virtual:channels=1 -b 500k -t 300ms", 0);
    assert_eq!(bus(&checks, 1)["outcome"], "ok");
    assert!(bus(&checks, 2)["outcome"] == "note" && bus(&checks, 2)["bus"]["hint"] == "silent");
}

#[test]
fn a_board_at_a_port_is_examined_from_the_port_on() {
    let mut port = Port::new();
    port.plug("load=30,serial=A1");
    let checks = checks(&format!("-d {} -b 500k -t 300ms", port.name()), 0);
    let names: Vec<&str> = checks.iter().map(|check| check["check"].as_str().unwrap()).collect();
    assert_eq!(names, ["port", "in-use", "rights", "device", "bus", "bus"]);
    assert!(of(&checks, "device")["found"].as_str().unwrap().contains("serial number A1"));
}

#[test]
fn a_port_that_is_no_board_is_explained() {
    let pair = native_pty_system().openpty(PtySize::default()).unwrap();
    let name = pair.master.tty_name().unwrap().to_str().unwrap().to_owned();
    drop(pair.slave);
    let mut reader = pair.master.try_clone_reader().unwrap();
    // It takes what is sent, and says nothing.
    std::thread::spawn(move || while reader.read(&mut [0; 256]).is_ok() {});
    let checks = checks(&format!("-d {name}"), 3);
    assert_eq!(
        (&of(&checks, "port")["outcome"], &of(&checks, "in-use")["outcome"]),
        (&"ok".into(), &"ok".into())
    );
    let device = of(&checks, "device");
    assert!(device["found"].as_str().unwrap().contains("does not answer as a cantap device"), "{device}");
    assert!(device["next"].as_str().unwrap().contains(&format!("-d slcan:{name}")), "{device}");
    drop(pair.master);
}

#[test]
fn whoever_has_the_port_open_is_named_and_not_disturbed() {
    let pair = native_pty_system().openpty(PtySize::default()).unwrap();
    let name = pair.master.tty_name().unwrap().to_str().unwrap().to_owned();
    let mut command = CommandBuilder::new("sleep");
    command.arg("600");
    let mut holder = pair.slave.spawn_command(command).unwrap();
    drop(pair.slave);
    let checks = checks(&format!("-d {name}"), 3);
    let pid = holder.process_id().unwrap();
    holder.kill().unwrap();
    holder.wait().unwrap();
    let found = of(&checks, "in-use")["found"].as_str().unwrap();
    assert!(found.contains(&format!("sleep, process {pid}")), "{found}");
    assert_eq!(of(&checks, "device")["outcome"], "skipped");
    drop(pair.master);
}

/// Whoever gives a program its name, or a port, may want to write on our terminal.
#[test]
fn names_from_outside_move_no_cursor() {
    let folder = tempfile::tempdir().unwrap();
    let evil = folder.path().join("\u{1b}[31mevil");
    std::fs::copy("/bin/sleep", &evil).unwrap();
    let pair = native_pty_system().openpty(PtySize::default()).unwrap();
    let name = pair.master.tty_name().unwrap().to_str().unwrap().to_owned();
    let mut command = CommandBuilder::new(&evil);
    command.arg("600");
    let mut holder = pair.slave.spawn_command(command).unwrap();
    drop(pair.slave);
    let (code, out, err) = cantap(&format!("doctor -d {name}"));
    holder.kill().unwrap();
    holder.wait().unwrap();
    assert!(code == Some(3) && out.contains("[31mevil, process "), "{out}{err}");
    let (_, absent, said) = cantap("doctor -d /dev/\u{1b}[31mx");
    assert!(absent.contains("there is no "), "{absent}{said}");
    assert!(![out, err, absent, said].concat().contains('\u{1b}'));
    drop(pair.master);
}

#[test]
fn a_port_that_is_not_there_or_is_a_file_is_a_problem_with_a_next_step() {
    let checks = checks("-d /dev/ttyNoSuchPort", 3);
    assert!(of(&checks, "port")["found"].as_str().unwrap().starts_with("there is no "), "{checks:?}");
    let file = tempfile::NamedTempFile::new().unwrap();
    let checks = self::checks(&format!("-d {}", file.path().display()), 3);
    assert!(of(&checks, "port")["found"].as_str().unwrap().contains("and no port"), "{checks:?}");
    let (code, _, err) = cantap("doctor -d virtual -c 3");
    assert_eq!(code, Some(2), "{err}");
}

/// The same hints where people are when something is the matter.
#[test]
fn a_capture_s_summary_and_the_live_view_have_the_same_hints() {
    for (options, hint, part) in [
        ("virtual:load=50,errors=20", "disturbed", "channel 1: more than one error for a hundred frames"),
        ("virtual:load=0", "silent", "channel 1: neither frames nor errors"),
    ] {
        let (code, out, err) = cantap(&format!("capture -d {options} -c 1 -b 500k -t 500ms --json"));
        assert_eq!(code, Some(0), "{err}");
        let summary: Value = serde_json::from_str(&out).unwrap();
        assert_eq!(summary["channels"][0]["hint"], hint, "{summary}");
        assert_eq!(err.matches(part).count(), 1, "{err}");
        let view =
            format!("monitor -d {options} -c 1 -b 500k --once --view statistics -t 500ms --size 100x30");
        let (_, out, err) = cantap(&view);
        let [label, text] = ["Hint", part.split_once(": ").unwrap().1];
        let line = out.lines().find(|line| line.trim_start().starts_with(label));
        assert!(line.is_some_and(|line| line.contains(text)), "{out}{err}");
        assert!(out.contains("Next "), "{out}");
    }
    let (_, out, err) = cantap("capture -d virtual:bitrate=125k -c 1 -b 500k -t 1500ms --json");
    let summary: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["channels"][0]["hint"], "wrong-bit-rate", "{summary}");
    assert!(err.contains("only errors and no frame"), "{err}");
    let (_, out, _) = cantap("capture -d virtual:load=50 -c 1 -b 500k -t 300ms --json");
    let summary: Value = serde_json::from_str(&out).unwrap();
    assert!(summary["channels"][0]["hint"].is_null(), "{summary}");
}
