//! Several boards in one command: four channels, one trace, one clock.

use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

fn cantap(arguments: &[&str]) -> (Option<i32>, String, String) {
    let command = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).stdin(Stdio::null()).output();
    let Output { status, stdout, stderr } = command.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn line(arguments: &str) -> (Option<i32>, String, String) {
    cantap(&arguments.split_whitespace().collect::<Vec<_>>())
}

const TWO: &str = "-d virtual:load=20,ppm=40,seed=1 -d virtual:load=10,ppm=-40,seed=2";

#[test]
fn two_boards_are_four_channels_of_one_trace_on_one_clock() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("both.log");
    let (code, out, err) =
        line(&format!("capture {TWO} -b 500k -b 3:250k -t 6s --json -o {}", file.display()));
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    let text = std::fs::read_to_string(&file).unwrap();
    for (index, channel) in summary["channels"].as_array().unwrap().iter().enumerate() {
        assert_eq!(channel["channel"], index as u64 + 1);
        let in_file = text.lines().filter(|line| line.contains(&format!(" can{index} "))).count();
        assert!(in_file > 100 && channel["frames"] == in_file as u64 && channel["lost"] == 0, "{channel}");
        // By each channel's own bit rate.
        let load = channel["bus_load_pct"].as_f64().unwrap();
        let expected = if index < 2 { 20.0 } else { 10.0 };
        assert!((load - expected).abs() < 2.0, "{channel}");
    }
    let devices = summary["devices"].as_array().unwrap();
    let channels: Vec<_> = devices.iter().map(|device| device["channels"].to_string()).collect();
    assert_eq!(channels, ["[1,2]", "[3,4]"]);
    // `host/tests/it/several_devices.rs` tests how well: a busy computer's virtual devices may not be on one clock yet.
    let told = &devices[1];
    assert_eq!(told["by_usb_frames"] == true, told["no_usb_frames_because"].is_null(), "{out}");
    assert_eq!(told["by_usb_frames"] == true, told["uncertainty_us"].is_null(), "{out}");
}

#[test]
fn channels_filters_and_limits_count_over_all_boards() {
    let (code, out, err) = line(&format!("capture {TWO} -b 500k -c 2,3 -n 50"));
    assert_eq!((code, out.lines().count()), (Some(0), 50), "{err}");
    assert!(out.contains(" can1 ") && out.contains(" can2 "), "{out}");
    assert!(!out.contains(" can0 ") && !out.contains(" can3 "), "{out}");
    assert!(err.contains("channels 3 of 'virtual") || err.contains("channel 3: "), "{err}");
    let (code, out, err) = line(&format!("capture {TWO} -b 500k -f can3,0:0 -n 20"));
    assert_eq!((code, out.lines().count()), (Some(0), 20), "{err}");
    assert!(out.lines().all(|line| line.contains(" can3 ")), "{out}");
}

#[test]
fn statistics_and_the_live_view_take_several_boards() {
    let (code, out, err) = line(&format!("stats {TWO} -b 500k -t 1s --json"));
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["channels"].as_array().unwrap().len(), 4, "{out}");
    let (code, out, err) =
        line(&format!("monitor {TWO} -b 500k --view statistics --once -t 2s --size 100x50"));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Channel 4: 500000 bit/s") && out.contains("Bus 3 "), "{out}");
    assert_eq!(out.matches("Device virtual VIRTUAL").count(), 2, "{out}");
}

#[test]
fn channels_that_no_board_has_are_refused() {
    for (options, message) in [
        ("-d virtual -c 3 -b 500k", "a device has channels 1 and 2, and no channel 3"),
        ("-d virtual -d virtual -c 5 -b 500k", "2 devices have channels 1 to 4, and no channel 5"),
        ("-d virtual -d virtual -b 500k -b 5:250k", "2 devices have no channel 5"),
        ("-d virtual -d virtual -b 3:500k", "give the bus's bit rate with -b"),
        ("-d /dev/x -d /dev/x -b 500k", "-d /dev/x is given twice"),
    ] {
        let (code, out, err) = line(&format!("capture {options}"));
        assert_eq!((code, out.as_str()), (Some(2), ""), "{options}: {err}");
        assert!(err.contains(message), "{options}: {err}");
    }
}

/// A board that is gone for good must not keep a script waiting.
#[cfg(unix)]
#[test]
fn a_capture_of_so_many_frames_gives_up_on_a_device_that_stays_away() {
    use std::io::{BufRead, BufReader};
    let mut device = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["virtual", "load=20"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut port = String::new();
    BufReader::new(device.stdout.take().unwrap()).read_line(&mut port).unwrap();
    let port = port.trim_end().to_owned();
    let capture = std::thread::spawn(move || {
        cantap(&["capture", "-d", &port, "-b", "500k", "-n", "100000000", "--give-up-after", "2s", "--json"])
    });
    std::thread::sleep(Duration::from_secs(1));
    let _ = device.kill();
    let _ = device.wait();
    let killed = Instant::now();
    let (code, out, err) = capture.join().unwrap();
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("giving up"), "{err}");
    assert!(killed.elapsed() < Duration::from_secs(20), "it took {:?}", killed.elapsed());
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(summary["channels"][0]["frames"].as_u64() > Some(0) && summary["gaps"]["count"] == 1, "{out}");
}

#[test]
fn a_capture_that_hears_only_errors_says_so_at_once_and_fails() {
    let (code, out, err) = line("capture -d virtual:bitrate=500k,load=50 -b 250k -t 2s --json");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(summary["channels"][0]["bus_errors"].as_u64() > Some(0), "{out}");
    assert_eq!((code, &summary["channels"][0]["frames"]), (Some(1), &0.into()), "{err}");
    let told: Vec<&str> = err.lines().filter(|line| line.contains("only errors and no frame")).collect();
    // For each channel while it ran, and at the end as the reason.
    assert!(told.len() == 3 && told[0].contains("cantap autobaud -d virtual"), "{err}");
    // With one good channel, the capture succeeds.
    let (code, _, err) = line("capture -d virtual:bitrate=500k,load=50 -b 500k -b 2:250k -t 2s --json");
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(err.matches("channel 2: only errors").count(), 1, "{err}");
}

/// The time is too short for the earlier warning: the end reports it anyway.
#[test]
fn whatever_listens_and_hears_only_errors_fails_and_says_why() {
    for command in [
        "stats",
        "stats --json",
        "decode --db ../host/virtual/src/car/car.dbc",
        "search --id 123",
        "conversations",
        "capture",
    ] {
        let (code, _, err) = line(&format!("{command} -d virtual:bitrate=500k,load=50 -b 250k -t 400ms"));
        assert_eq!(code, Some(1), "{command}: {err}");
        let told = err.matches("channel 1: only errors and no frame").count();
        assert!(told == 1 && err.contains("cantap autobaud -d virtual"), "{command}: {err}");
    }
    // One good channel is enough, and silence is not an error.
    for bus in ["virtual:bitrate=500k,load=50 -b 500k -b 2:250k", "virtual:load=0 -b 500k"] {
        let (code, _, err) = line(&format!("stats -d {bus} -t 400ms"));
        assert!(code == Some(0) && !err.contains("channel 1: only errors"), "{bus}: {err}");
    }
}

/// The window in which listening ends is milliseconds long, but contains errors from a tenth of a second
/// before it.
#[test]
fn live_statistics_have_a_line_for_each_whole_window() {
    for (options, steady) in
        [("virtual:load=50 -b 500k", true), ("virtual:bitrate=500k,load=50 -b 250k", false)]
    {
        let (_, _, err) = line(&format!("stats -d {options} --window 500ms -t 1100ms"));
        let loads: Vec<f64> = err
            .lines()
            .filter(|line| line.contains(" frames/s "))
            .map(|line| line.split(" % |").next().unwrap().rsplit(' ').next().unwrap().parse().unwrap())
            .collect();
        assert_eq!(loads.len(), 4, "{err}");
        let is_likely = |load: &f64| if steady { (45.0..55.0).contains(load) } else { *load < 90.0 };
        assert!(loads.iter().all(is_likely), "{err}");
        // Shorter than a window: there is nothing else.
        let (_, _, err) = line(&format!("stats -d {options} --window 5s -t 400ms"));
        assert_eq!(err.lines().filter(|line| line.contains(" frames/s ")).count(), 2, "{err}");
    }
}
