//! `cantap stats`, `cantap plot` and `cantap monitor` as a user meets them.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn cantap() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.env("LC_ALL", "C.UTF-8").env("NO_COLOR", "1").stdin(std::process::Stdio::null());
    command
}

fn boat() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/formats/tests/data/nmea2000.log.gz")
}

/// Ten frames of 58 bits, back to back at 1 Mbit/s, as the earlier analyser's test sent them.
fn golden_burst(folder: &Path) -> PathBuf {
    let mut log = String::new();
    for n in 0..10 {
        writeln!(log, "(100.{:06}) can0 000#55", n * 58).unwrap();
    }
    let path = folder.join("burst.log");
    std::fs::write(&path, log).unwrap();
    path
}

/// Runs a command and returns its standard output and standard error; it must exit with this code.
fn run(command: &mut Command, code: i32) -> (String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert_eq!(status.code(), Some(code), "{stderr}");
    (stdout, stderr)
}

fn stdout(command: &mut Command) -> String {
    run(command, 0).0
}

fn failure(command: &mut Command) -> String {
    let (stdout, stderr) = run(command, 1);
    assert_eq!(stdout, "");
    stderr
}

#[test]
fn the_golden_burst_has_the_load_it_was_sent_with() {
    let folder = tempfile::tempdir().unwrap();
    let log = golden_burst(folder.path());
    let text = stdout(cantap().arg("stats").arg(&log).args(["-b", "1M", "--json"]));
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let channel = &json["channels"][0];
    assert_eq!((&json["frames"], &channel["bits"]), (&10.into(), &580.into()));
    assert!((channel["bus_load_pct"].as_f64().unwrap() - 100.0).abs() < 1e-6, "{channel}");
    assert!((channel["ids"][0]["period_mean_ms"].as_f64().unwrap() - 0.058).abs() < 1e-9);
}

#[test]
fn a_boats_bus_is_summed_up() {
    let text = stdout(cantap().arg("stats").arg(boat()).args(["-b", "250k", "--per-id"]));
    let lines: Vec<_> = text.lines().collect();
    assert_eq!(lines[0], "10495 frames in 215.199309 s on 1 channel, 0 lost, 0 errors");
    assert_eq!(lines[3], "  frames    10495 (0 standard, 10495 extended, 0 remote, 0 sent), 48.8 frames/s");
    assert!(
        text.contains("  09F80102      2040     23.010    105.542   2568.176     95.356  18.97%  8\n"),
        "{text}"
    );
}

#[test]
fn windows_are_listed_and_add_up() {
    let text = stdout(cantap().arg("stats").arg(boat()).args([
        "-b",
        "250k",
        "--windows",
        "--window",
        "10s",
        "--json",
    ]));
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let windows = json["windows"].as_array().unwrap();
    assert_eq!(windows.len(), 22);
    assert_eq!(windows.iter().map(|window| window["frames"].as_u64().unwrap()).sum::<u64>(), 10_495);
}

#[test]
fn a_trace_that_is_shorter_than_a_window_says_why_it_has_none() {
    let log = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("short-for-windows.log");
    std::fs::write(&log, "(1.000000) can0 123#11\n(1.010000) can0 124#22\n(1.020000) can0 125#33\n").unwrap();
    let text = stdout(cantap().arg("stats").arg(&log).args(["-b", "500k"]));
    assert!(
        text.contains("windows   1 s: the trace is too short for one; choose shorter ones with --window"),
        "{text}"
    );
    let text = stdout(cantap().arg("stats").arg(&log).args(["-b", "500k", "--window", "5ms"]));
    assert!(text.contains("windows   0.005 s: least 0.000 %"), "{text}");
}

#[test]
fn what_cannot_be_measured_is_refused_with_the_reason() {
    let (_, reason) = run(cantap().arg("stats").arg(boat()).args(["-b", "10k", "--window", "1ms"]), 2);
    assert_eq!(
        reason,
        "cantap: a window must be longer than the longest frame, at 10000 bit/s 16000 µs; give a longer one\n"
    );
    run(cantap().arg("stats").arg(boat()).args(["-b", "fast"]), 2);
    run(cantap().arg("stats"), 2);
}

/// It was an empty picture, and success.
#[test]
fn a_load_that_needs_the_data_phases_bit_rate_is_asked_for_instead_of_an_empty_picture() {
    let folder = tempfile::tempdir().unwrap();
    let (log, load) = (folder.path().join("fd.log"), folder.path().join("load.svg"));
    let lines: Vec<_> =
        (0..30).map(|n| format!("(100.{n:02}0000) can0 123##100112233445566778899AABB\n")).collect();
    std::fs::write(&log, lines.concat()).unwrap();
    let mut plot = cantap();
    plot.arg("plot").arg(&log).args(["--bus-load", "-b", "500k", "-o"]).arg(&load);
    let reason = failure(&mut plot);
    assert!(reason.contains("--data-bitrate 2M") && !load.exists(), "{reason}");
    run(plot.args(["--data-bitrate", "2M"]), 0);
    assert!(load.exists());
    let reason = failure(cantap().arg("plot").arg(&log).args(["--bus-load", "-b", "500k", "--start", "1h"]));
    assert!(reason.contains("nothing to draw in fd.log between --start and --end"), "{reason}");
}

/// Of a file cut in its middle it said that less than 0.1 % was missing.
#[test]
fn nobody_knows_how_much_of_a_cut_compressed_file_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let whole = std::fs::read(boat()).unwrap();
    let cut = folder.path().join("cut.log.gz");
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let (out, reason) = run(cantap().arg("stats").arg(&cut).arg("--json"), 0);
    assert!(reason.contains("nobody knows how much is missing"), "{reason}");
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(object["missing_pct"].is_null() && object["issues"] == 2, "{}", object["missing_pct"]);
}

#[test]
fn pictures_are_written_in_the_format_of_their_suffix() {
    let folder = tempfile::tempdir().unwrap();
    for (suffix, start) in [("svg", &b"<svg "[..]), ("png", b"\x89PNG\r\n"), ("html", b"<!DOCTYPE html>")] {
        let path = folder.path().join(format!("load.{suffix}"));
        run(cantap().arg("plot").arg(boat()).args(["--bus-load", "-b", "250k", "-o"]).arg(&path), 0);
        assert!(std::fs::read(&path).unwrap().starts_with(start), "{suffix}");
    }
    let (_, reason) = run(cantap().arg("plot").arg(boat()).args(["--bus-load", "-o", "load.gif"]), 2);
    assert!(reason.contains("use .svg, .png or .html"), "{reason}");
    let (_, reason) = run(cantap().arg("plot").arg(boat()), 2);
    assert!(reason.contains("--db FILE"), "{reason}");
    let reason = failure(cantap().arg("plot").arg(boat()).args(["--timing", "7FF"]));
    assert!(reason.contains("no two frames of 7FF"), "{reason}");
}

/// `decode --protocols` and conditions had them, a picture needed a database.
#[test]
fn values_of_protocols_are_drawn_by_the_names_that_conditions_have() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("boat.svg");
    let curves = |command: &mut std::process::Command| -> Vec<String> {
        let (out, _) = run(command.args(["--json", "-o"]).arg(&path), 0);
        let object: serde_json::Value = serde_json::from_str(&out).unwrap();
        let names = object["curves"].as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned());
        let mut names: Vec<_> = names.collect();
        // They are in the order of their panes.
        names.sort();
        names
    };
    let drawn =
        curves(cantap().arg("plot").arg(boat()).args(["-s", "nmea2000.depth", "-s", "nmea2000.temperature"]));
    assert_eq!(drawn, ["nmea2000.depth", "nmea2000.temperature"]);
    // Each ship has its own.
    let ships = curves(cantap().arg("plot").arg(boat()).args(["-s", "nmea2000.cog"]));
    assert!(ships.iter().any(|name| name.ends_with("user_id 237808200)")) && ships.len() > 10, "{ships:?}");
    // Two engines and two gearboxes are not one curve; what is not available has none.
    let log = folder.path().join("engines.log");
    let lines = (0..20).map(|n| {
        format!(
            "(1.{n:02}0000) can0 0CF00400#017DA068{n:02X}FFF0FF\n(1.{n:02}1000) can0 0CF00401#017DA068{:02X}FFF0FF\n\
             (1.{n:02}2000) can0 7DF#02010C\n(1.{n:02}3000) can0 7E8#04410C1A{n:02X}\n",
            n + 1
        )
    });
    std::fs::write(&log, lines.collect::<String>()).unwrap();
    let drawn =
        curves(cantap().arg("plot").arg(&log).args(["-s", "j1939.engine_*", "-s", "obd.engine_speed"]));
    assert_eq!(
        drawn,
        [
            "j1939.engine_speed (0 > all)",
            "j1939.engine_speed (1 > all)",
            "j1939.engine_starter_mode (0 > all)",
            "j1939.engine_starter_mode (1 > all)",
            "j1939.engine_torque_mode (0 > all)",
            "j1939.engine_torque_mode (1 > all)",
            "obd.engine_speed"
        ]
    );
    let reason = failure(cantap().arg("plot").arg(&log).args(["-s", "obd.speed", "-o"]).arg(&path));
    assert!(
        reason.contains("nothing had a number obd.speed") && reason.contains("`cantap conversations`"),
        "{reason}"
    );
}

#[test]
fn without_a_file_the_picture_is_in_the_terminal() {
    let text = stdout(cantap().arg("plot").arg(boat()).args(["--timing", "09F80202", "--width", "60"]));
    assert!(text.starts_with("nmea2000.log.gz: periods of 09F80202\n"), "{text}");
    assert!(text.contains('█') && text.lines().all(|line| line.chars().count() <= 90), "{text}");
}

#[test]
fn one_screen_can_be_printed_without_a_terminal() {
    let text = stdout(cantap().arg("monitor").arg(boat()).args(["-b", "250k", "--once", "--view", "fixed"]));
    assert_eq!(text.lines().count(), 24);
    assert!(text.contains("\n1  09F80102      2040 "), "{text}");
    let reason = failure(cantap().arg("monitor").arg(boat()));
    assert!(reason.contains("the live view needs a terminal; use --once"), "{reason}");
}

#[test]
fn one_screen_is_printed_and_a_device_that_is_not_there_is_told() {
    let text =
        stdout(cantap().args(["monitor", "-d", "virtual", "--once", "-t", "600ms", "--view", "trace"]));
    assert!(text.contains(" virtual listen-only: running"), "{text}");
    let reason = failure(cantap().args(["monitor", "-d", "/dev/nowhere", "--once"]));
    // Also without a bit rate: the board may have one saved.
    assert!(reason.contains("there is no device at '/dev/nowhere'"), "{reason}");
}

#[test]
fn a_picture_with_a_broken_profile_is_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    let profile = folder.path().join("car.toml");
    std::fs::write(&profile, "bitrates = [\"250k\"]\nspeed = 3\n").unwrap();
    let mut command = cantap();
    command.arg("monitor").arg(boat()).arg("-p").arg(&profile).arg("--once");
    let said = failure(&mut command);
    assert!(said.contains("car.toml, line 2: unknown field `speed`"), "{said}");
}

#[test]
fn the_live_view_of_the_virtual_device_loses_nothing() {
    let text = stdout(cantap().args([
        "monitor",
        "-d",
        "virtual:load=100,frames=std0",
        "-b",
        "1M",
        "--once",
        "--view",
        "statistics",
    ]));
    assert!(text.contains("Channel 1: 1000000 bit/s") && text.contains("Channel 2: 1000000 bit/s"), "{text}");
    assert_eq!(text.matches("Lost               0 ").count(), 2, "{text}");
}

/// A channel with only errors begins where the trace does, not in 1970, and nothing begins at minus zero.
#[test]
fn windows_count_from_the_traces_start() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("errors.log");
    std::fs::write(
        &log,
        "(1800000000.000000) can0 20000008#0000040000000000\n(1800000000.500000) can1 123#1122\n\
         (1800000003.000000) can0 20000008#0000040000000000\n(1800000003.100000) can1 123#1122\n",
    )
    .unwrap();
    let text = stdout(cantap().arg("stats").arg(&log).args(["-b", "500k", "--windows"]));
    assert!(!text.contains("-0.000"), "{text}");
    assert!(!text.contains("180000000"), "{text}");
    let part = [
        "plot",
        "--bus-load",
        "-b",
        "500k",
        "--start",
        "0.2",
        "--end",
        "3.05",
        "--y",
        "0:50",
        "--width",
        "100",
    ];
    let text = stdout(cantap().args(part).arg(&log));
    assert!(text.contains("2027-01-15 08:00:00.500000 UTC"), "{text}");
    run(cantap().args(["plot", "--bus-load", "--y", "50:0"]).arg(&log), 2);
}
