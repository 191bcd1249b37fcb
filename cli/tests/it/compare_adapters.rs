//! `cantap compare-adapters` as users run it.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::Value;

use crate::served::Served;

fn folder(test: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compare_adapters").join(test);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// Exit code, standard output, standard error.
fn compare(folder: &Path, devices: [&str; 2], options: &str) -> (Option<i32>, String, String) {
    let [first, second] = devices;
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(["compare-adapters", "-d", first, "-d", second, "-b", "500k"]);
    command.args(options.split_whitespace()).current_dir(folder).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A log of frames that never repeat.
fn log(order: impl IntoIterator<Item = u32>) -> String {
    let line =
        |at: u32| format!("(1410714882.{:06}) can0 {:03X}#{:08X}\n", at * 700, 0x100 + at % 3, at * at);
    order.into_iter().map(line).collect()
}

/// Each with its own way to the bus of a virtual device: what one has, the other has.
#[test]
fn two_ways_to_one_bus_miss_nothing_of_each_other() {
    let served = Served::start("virtual:load=10", Stdio::null());
    let [host, port] = &served.socketcand;
    let other = format!("socketcand://{host}:{port}/can0");
    let (code, out, err) = compare(&folder("ways"), [&served.at, &other], "-c 1,3 -t 3s --json");
    let result: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{out}{err}"));
    let [first, second] = [0, 1].map(|adapter| &result["adapters"][adapter]);
    assert_eq!((code, &first["missed"], &second["missed"]), (Some(0), &0.into(), &0.into()), "{out}{err}");
    assert!(result["frames_in_both"].as_u64().unwrap() > 100, "{out}");
    assert_eq!(second["kind"], "socketcand");
    // A board's losses are all counted, and the other's are not.
    assert_eq!((&first["lost"]["unknown"], &first["not_known"]), (&0.into(), &Value::Null));
    assert_eq!(second["lost"]["unknown"], 1);
    assert!(second["not_known"].as_str().unwrap().contains("not reported"), "{out}");
}

#[test]
fn what_one_missed_and_what_came_in_another_order_is_found() {
    let folder = folder("lossy");
    std::fs::write(folder.join("all.log"), log(0..300)).unwrap();
    let order = (0..300).filter(|at| *at != 150).map(|at| match at {
        200 => 201,
        201 => 200,
        at => at,
    });
    std::fs::write(folder.join("lossy.log"), log(order)).unwrap();
    let (code, out, err) = compare(&folder, ["candump:all.log", "candump:lossy.log"], "-c 1,3 -t 5s --json");
    let result: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{out}{err}"));
    let missed = [0, 1].map(|adapter| result["adapters"][adapter]["missed"].as_u64().unwrap());
    assert_eq!((code, missed, &result["out_of_order"]), (Some(3), [0, 1], &1.into()), "{out}{err}");
    let (_, out, _) = compare(&folder, ["candump:all.log", "candump:lossy.log"], "-c 1,3 -t 5s");
    assert!(
        out.contains("'candump:lossy.log': 299 frames")
            && out.contains("1 missed that 'candump:all.log' has"),
        "{out}"
    );
    assert!(!out.contains(" 0 lost") && out.contains("an unknown number"), "{out}");
}

#[test]
fn what_cannot_be_compared_is_refused_with_the_reason() {
    let folder = folder("refused");
    std::fs::write(folder.join("all.log"), log(0..300)).unwrap();
    std::fs::write(folder.join("other.log"), log(1000..1300)).unwrap();
    std::fs::write(folder.join("same.log"), "(1.000000) can0 123#11\n".repeat(300)).unwrap();
    for other in ["other.log", "same.log"] {
        let devices = ["candump:all.log", &format!("candump:{other}")];
        let (code, out, err) = compare(&folder, devices, "-c 1,3 -t 5s --json");
        assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
        assert!(
            err.contains("cannot be compared") && err.contains("no part of one is found in the other"),
            "{err}"
        );
    }
    let output = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["compare-adapters", "-d", "virtual", "-b", "500k"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
}
