//! Frames that are not sent: `send`, `gen` and `replay` end, give the true reason, and count each frame once.

use std::fmt::Write;
use std::path::PathBuf;
use std::process::{Command, Output};

const NOBODY: &str = "nobody acknowledged";
const FULL: &str = "the bus is full (";
const DEAD_BUS: &str = "virtual:ack=no,load=0 -b 500k";
const FULL_BUS: &str = "virtual:load=100,frames=std0 -b 500k";

/// Exit code, lines printed, standard error.
fn cantap(arguments: &str) -> (Option<i32>, Vec<String>, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments.split_whitespace()).output();
    let Output { status, stdout, stderr } = output.unwrap();
    let lines = String::from_utf8(stdout).unwrap().lines().map(str::to_owned).collect();
    (status.code(), lines, String::from_utf8(stderr).unwrap())
}

fn log(name: &str, times_us: impl Iterator<Item = u64>, frame: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    let mut text = String::new();
    for us in times_us {
        writeln!(text, "({}.{:06}) can0 {frame}", us / 1_000_000, us % 1_000_000).unwrap();
    }
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn periodic_frames_on_a_bus_that_takes_none_end_with_the_reason_and_the_count_that_was_asked_for() {
    let _turn = cantap_testing::process::turn();
    let disturbed = "virtual:load=0,disturb=5 -b 500k";
    let broken = "virtual:load=0,disturb=40 -b 500k";
    for (bus, options, sent, part) in [
        (DEAD_BUS, "", 0, "nobody acknowledged 20 of 20 frames"),
        (DEAD_BUS, "--one-shot", 0, "nobody acknowledged 20 of 20 frames"),
        (disturbed, "--one-shot", 15, "5 of 20 frames were not sent: errors destroyed them"),
        (broken, "--recovery manual", 0, "20 of 20 frames were not sent: the controller went bus-off"),
        (FULL_BUS, "", 0, "20 of 20 frames were not sent: the bus is full"),
    ] {
        let line = format!("send -d {bus} can0 7FF#11 --period 10ms --count 20 {options}");
        let (code, lines, err) = cantap(&line);
        assert_eq!((code, lines.len()), (Some(1), sent), "{line}: {err}");
        assert!(err.contains(part) && err.lines().count() == 1, "{line}: {err}");
    }
    // If its time ends it, it has the same reason.
    let (code, _, err) = cantap(&format!("send -d {DEAD_BUS} can0 7FF#11 --period 10ms --time 500ms"));
    assert!(code == Some(1) && err.contains(NOBODY), "{err}");
}

#[test]
fn an_overtaken_period_is_no_second_failure_of_the_frame() {
    let line = "send -d virtual:load=0 -b 500k can0 123#1122334455667788 --period 100us --count 100";
    let (code, lines, err) = cantap(line);
    assert_eq!((code, lines.len()), (Some(1), 100), "{err}");
    assert!(
        err.contains("all 100 frames were sent, but") && err.contains("choose a longer --period"),
        "{err}"
    );
}

#[test]
fn on_a_full_bus_everything_that_sends_ends_and_names_the_load() {
    let _turn = cantap_testing::process::turn();
    let one = log("full.log", std::iter::once(1_000_000), "7FF#01");
    for (line, count) in [
        (format!("send -d {FULL_BUS} can0 7FF#1122334455667788 -n 10"), "10 of 10"),
        (format!("gen -d {FULL_BUS} can0 -I 7FF -g 0 -n 500"), "500 of 500"),
        (format!("gen -d {FULL_BUS} can0 -I 7FF -g 10"), "frames were not sent"),
        (format!("replay -d {FULL_BUS} {}", one.display()), "1 of 1"),
        (format!("replay -d {FULL_BUS} {} -t", one.display()), "1 of 1"),
    ] {
        let (code, _, err) = cantap(&line);
        assert_eq!(code, Some(1), "{line}: {err}");
        assert!(err.contains(count) && err.contains("use a lower identifier"), "{line}: {err}");
        let (_, load) = err.split_once(FULL).unwrap_or_else(|| panic!("{line}: {err}"));
        let load: f64 = load.split_once(" %) of frames with lower identifiers").unwrap().0.parse().unwrap();
        assert!((95.0..=100.0).contains(&load), "{line}: {err}");
    }
    // Without stamps the load is unknown, and none is invented.
    let (_, _, err) = cantap(&format!("send -d {FULL_BUS} can0 7FF#11 --no-stamps"));
    assert!(err.contains("the bus is full of frames with lower identifiers"), "{err}");
    // A lower identifier does get through.
    let (code, lines, err) = cantap("send -d virtual:load=100,frames=std8 -b 500k can0 000#11");
    assert_eq!((code, lines.len()), (Some(0), 1), "{err}");
}

/// More than fit in the device's queue, so that some were never handed over.
#[test]
fn totals_name_every_frame_that_was_asked_for() {
    let (code, _, err) = cantap(&format!("send -d {DEAD_BUS} can0 123#11 124#22 -n 300"));
    assert!(code == Some(1) && err.contains("nobody acknowledged 600 of 600"), "{err}");
    let (code, _, err) = cantap(&format!("gen -d {DEAD_BUS} can0 -g 0 -n 500"));
    assert!(code == Some(1) && err.contains("nobody acknowledged 500 of 500"), "{err}");
    let many = log("many.log", (0..600).map(|n| n * 100), "123#01");
    for (options, count) in [("", 600), ("-l 3", 1800), ("-l i", 257), ("-l 3 -n 1000", 1000), ("-t", 600)] {
        let line = format!("replay -d {DEAD_BUS} {} --json {options}", many.display());
        let (code, lines, err) = cantap(&line);
        assert!(
            code == Some(1) && err.contains(&format!("{NOBODY} {count} of {count} frames")),
            "{line}: {err}"
        );
        let object: serde_json::Value = serde_json::from_str(&lines.concat()).unwrap();
        assert_eq!((&object["sent"], &object["not_sent"]), (&0.into(), &count.into()), "{line}");
        let reason = object["reason"].as_str().unwrap();
        assert_eq!(err, format!("cantap: {reason}\n"));
    }
    let (code, lines, _) = cantap(&format!("replay -d virtual:load=0 -b 500k {} --json", many.display()));
    let object: serde_json::Value = serde_json::from_str(&lines.concat()).unwrap();
    assert_eq!(
        (code, &object["not_sent"], &object["reason"]),
        (Some(0), &0.into(), &serde_json::Value::Null)
    );
}

#[test]
fn frames_that_wait_for_their_time_do_not_stand_still() {
    let pause = log("pause.log", [0, 2_500_000].into_iter(), "123#01");
    let (code, lines, err) = cantap(&format!("replay -d virtual:load=0 -b 500k {} -v", pause.display()));
    assert_eq!((code, lines.len()), (Some(0), 2), "{err}");
    let line = "send -d virtual:load=0 -b 500k can0 123#11 --period 1500ms --count 2";
    let (code, lines, err) = cantap(line);
    assert_eq!((code, lines.len()), (Some(0), 2), "{err}");
}
