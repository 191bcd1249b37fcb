//! `cantap align` as users run it.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

fn folder(test: &str) -> PathBuf {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("align").join(test);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

fn cantap(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).current_dir(folder).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// A candump log of a bus whose frames carry a counter, as recorded with a clock that is `ahead_s` ahead and gains
/// `ppm`. A log has no more than the clock's microseconds.
fn log(interface: &str, frames: std::ops::Range<u64>, ahead_s: f64, ppm: f64, salt: u64) -> String {
    frames.fold(String::new(), |mut log, frame| {
        // 1 ms apart, and up to 0.3 ms later.
        let true_us = frame * 1_000 + frame * frame % 311;
        let shown_us = true_us as f64 * (1.0 + ppm * 1e-6) + ahead_s * 1e6;
        let (seconds, us) = ((shown_us / 1e6) as u64, shown_us as u64 % 1_000_000);
        writeln!(log, "({seconds}.{us:06}) {interface} {:03X}#{:016X}", 0x100 + frame % 7, frame ^ salt)
            .unwrap();
        log
    })
}

#[test]
fn two_recorders_of_a_bus_become_one_trace() {
    let folder = folder("two");
    std::fs::write(folder.join("a.log"), log("can0", 0..20_000, 1000.0, 0.0, 0)).unwrap();
    std::fs::write(folder.join("b.log"), log("can0", 5_000..25_000, 1003.25, 40.0, 0)).unwrap();
    let (code, out, err) =
        cantap(&folder, &["align", "a.log", "b.log", "-o", "both.log", "--json", "--check", "5us"]);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let found: Value = serde_json::from_str(&out).unwrap();
    let found = &found["traces"][0];
    assert_eq!(found["channels"], serde_json::json!([{ "first": 1, "own": 1, "written": 2 }]));
    assert_eq!(found["frames_in_both"], 15_000);
    assert_eq!((&found["only_in_first"], &found["only_in_this"]), (&0.into(), &0.into()));
    assert!((found["drift_ppm"].as_f64().unwrap() - 40.0).abs() < 0.2, "{found}");
    assert!((found["offset_s"].as_f64().unwrap() - 3.25).abs() < 0.001, "{found}");
    let both = std::fs::read_to_string(folder.join("both.log")).unwrap();
    assert_eq!(both.lines().count(), 40_000);
    assert_eq!(both.lines().filter(|line| line.contains(" can1 ")).count(), 20_000);
    let times: Vec<_> = both.lines().map(|line| line.split(')').next().unwrap().to_owned()).collect();
    assert!(times.is_sorted());
}

#[test]
fn what_was_found_is_told_in_words_without_an_output() {
    let folder = folder("words");
    std::fs::write(folder.join("a.log"), log("can0", 0..6_000, 1000.0, 0.0, 0)).unwrap();
    std::fs::write(folder.join("b.log"), log("can1", 0..6_000, 900.0, 0.0, 0)).unwrap();
    let (code, out, _) = cantap(&folder, &["align", "a.log", "b.log"]);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "channel 2 of b.log (now 3) is on the bus of channel 1 of a.log\n\
         its clock was -100.000000 s from the first one's and gains +0.000 ppm on it\n\
         6000 frames in both; of the common time, 0 only in a.log, 0 only in b.log\n\
         stamps of the same frame apart: 0.0 us half of them, 0.0 us 99 %, 0.0 us at most\n"
    );
}

#[test]
fn traces_without_a_common_bus_are_refused_and_nothing_is_written() {
    let folder = folder("strangers");
    std::fs::write(folder.join("a.log"), log("can0", 0..3_000, 0.0, 0.0, 0)).unwrap();
    std::fs::write(folder.join("b.log"), log("can0", 0..3_000, 0.0, 0.0, 0xFFFF_0000)).unwrap();
    let (code, out, err) = cantap(&folder, &["align", "a.log", "b.log", "-o", "none.log"]);
    assert_eq!((code, out.as_str()), (Some(1), ""));
    assert!(err.starts_with("cantap: a.log and b.log cannot be aligned: no part"), "{err}");
    assert!(!folder.join("none.log").exists());
}

/// Loggers of two buses: nothing shows how their clocks differ but what the user knows.
#[test]
fn a_known_difference_of_the_clocks_joins_traces_of_different_buses() {
    let folder = folder("shift");
    std::fs::write(folder.join("a.log"), "(10.000000) can0 100#01\n(12.000000) can1 100#02\n").unwrap();
    std::fs::write(folder.join("b.log"), "(14.200000) can0 200#03\n(15.300000) can0 200#04\n").unwrap();
    std::fs::write(folder.join("c.log"), "(0.500000) can0 300#05\n").unwrap();
    let both = ["align", "a.log", "b.log", "c.log", "--shift=-3.2s", "--shift", "10s", "-o", "all.log"];
    let (code, out, err) = cantap(&folder, &both);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(
        out,
        "-3.200000 s added to the times of b.log; its channel 1 is now 3\n\
         +10.000000 s added to the times of c.log; its channel 1 is now 4\n"
    );
    assert_eq!(
        std::fs::read_to_string(folder.join("all.log")).unwrap(),
        "(10.000000) can0 100#01\n(10.500000) can3 300#05\n(11.000000) can2 200#03\n(12.000000) can1 100#02\n\
         (12.100000) can2 200#04\n"
    );
    let (code, _, err) = cantap(&folder, &["align", "a.log", "b.log", "--shift", "1s", "--shift", "2s"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("2 times for 1 traces"), "{err}");
}

#[test]
fn stamps_too_far_apart_end_with_3() {
    let folder = folder("check");
    let log_a = log("can0", 0..6_000, 0.0, 0.0, 0);
    // Every seventh stamp of the second is 60 us late.
    let late = |(at, line): (usize, &str)| -> String {
        let (time, rest) = line.split_once(')').unwrap();
        let us: u64 = time[1..].replace('.', "").parse().unwrap();
        let us = us + if at % 7 == 0 { 60 } else { 0 };
        format!("({}.{:06}){rest}\n", us / 1_000_000, us % 1_000_000)
    };
    std::fs::write(folder.join("b.log"), log_a.lines().enumerate().map(late).collect::<String>()).unwrap();
    std::fs::write(folder.join("a.log"), log_a).unwrap();
    for (check, code) in [("100us", 0), ("20us", 3)] {
        assert_eq!(cantap(&folder, &["align", "a.log", "b.log", "--check", check]).0, Some(code), "{check}");
    }
}
