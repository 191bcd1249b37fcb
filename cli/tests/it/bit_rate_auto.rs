//! `-b auto`: the bit rate is found by listening, reported, remembered, and believed only after it was confirmed.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use crate::port::Port;

/// Runs the command with a cache folder of its own.
fn cantap_in(cache: &Path, arguments: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.env("XDG_CACHE_HOME", cache).args(arguments.split_whitespace()).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8_lossy(&stdout).into_owned(), String::from_utf8(stderr).unwrap())
}

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let output = cantap_in(folder.path(), arguments);
    // Buses inside the program are others each time: nothing of them is remembered.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "{arguments}");
    output
}

const CAPTURE: &str = "capture -d virtual:bitrate=125k";

/// What happened during the search is no part of a capture: errors at a bit rate that did not hold would be, too.
fn assert_nothing_but_frames(summary: &str) {
    let summary: serde_json::Value = serde_json::from_str(summary).unwrap();
    for channel in summary["channels"].as_array().unwrap() {
        assert_eq!((&channel["bus_errors"], &channel["lost"]), (&0.into(), &0.into()), "{summary}");
        assert!(channel["frames"].as_u64() > Some(0), "{summary}");
    }
}

#[test]
fn a_capture_finds_its_bit_rates_and_the_trace_keeps_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("found.pcapng");
    let (code, _, err) = cantap(&format!("{CAPTURE} -b auto -n 50 -o {}", path.display()));
    assert_eq!(code, Some(0), "{err}");
    for line in ["channel 1: 125000 bit/s, found by listening", "channel 2: 125000 bit/s, found by listening"]
    {
        assert!(err.contains(line), "{err}");
    }
    let trace = std::fs::read(&path).unwrap();
    let text = b"125000 bit/s, listening only";
    assert!(trace.windows(text.len()).any(|bytes| bytes == text));
    let (_, out, _) = cantap(&format!("stats --json {}", path.display()));
    let statistics: serde_json::Value = serde_json::from_str(&out).unwrap();
    for channel in statistics["channels"].as_array().unwrap() {
        assert_eq!(channel["bitrate_bps"], 125_000, "{out}");
        assert!(channel["bus_load_pct"].as_f64() > Some(0.0), "{out}");
    }
    let (_, out, _) = cantap(&format!("{CAPTURE} -b auto -n 50 --json"));
    assert_nothing_but_frames(&out);
}

#[test]
fn each_command_that_asks_for_a_bit_rate_finds_it() {
    for (line, part) in [
        ("stats -d virtual:bitrate=125k -b auto -c 1 -t 500ms", "125000 bit/s, found by listening"),
        ("search -d virtual:bitrate=125k -b auto -t 300ms --data ??", "125000 bit/s, found by listening"),
        ("send -d virtual:bitrate=125k -b auto 1 123#11", "channel 1: 125000 bit/s, found by listening"),
        ("gen -d virtual:bitrate=125k -b auto can1 -n 2", "channel 2: 125000 bit/s, found by listening"),
        ("defaults save -d virtual:bitrate=125k -b auto -c 1", "125000 bit/s, found by listening"),
        ("status -d virtual:bitrate=125k -b auto -c 1 -t 200ms", "125000 bit/s, found by listening"),
        ("obd -d virtual:car -b auto vin", "channel 1: 500000 bit/s, found by listening"),
    ] {
        let (code, _, err) = cantap(line);
        assert!(code == Some(0) && err.contains(part), "{line}: {code:?} {err}");
    }
    let (code, out, err) =
        cantap("monitor -d virtual:bitrate=125k -b 1:auto --once --view statistics -t 500ms");
    assert!(code == Some(0) && out.contains("Channel 1: 125000 bit/s"), "{out}{err}");
    assert!(!out.contains("Channel 2"), "{out}");
}

/// Often one of two channels is not connected.
#[test]
fn a_silent_channel_is_left_out_unless_it_was_named() {
    let device = "capture -d virtual:bitrate=125k,channels=1";
    let (code, out, err) = cantap(&format!("{device} -b auto -n 20 --json"));
    assert_eq!(code, Some(0), "{err}");
    assert!(
        err.contains("no traffic on channel 2 in ") && err.contains("; the channel is left out"),
        "{err}"
    );
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    let channels = summary["channels"].as_array().unwrap();
    assert!(channels.len() == 1 && channels[0]["frames"] == 20, "{summary}");
    let (code, _, err) = cantap(&format!("{device} -b auto -b 2:auto -n 20"));
    assert!(code == Some(1) && err.contains("no traffic on channel 2"), "{err}");
    assert!(!err.contains("left out"), "{err}");
    // Where nothing is found nothing is opened, and nothing sent.
    let (code, out, err) = cantap("send -d virtual:load=0 -b auto 1 123#11");
    assert!(code == Some(1) && err.contains("no traffic on channel 1") && out.is_empty(), "{out}{err}");
}

#[test]
fn a_board_is_first_listened_to_at_the_rate_that_it_had_and_that_is_believed_only_if_it_holds() {
    let cache = tempfile::tempdir().unwrap();
    let mut port = Port::new();
    let mut capture = |options: &str| {
        port.plug(options);
        let line = format!("capture -d {} -c 1 -b auto -n 50 --json", port.name());
        let (code, out, err) = cantap_in(cache.path(), &line);
        assert_eq!(code, Some(0), "{err}");
        assert_nothing_but_frames(&out);
        err
    };
    let err = capture("bitrate=125k,serial=A");
    assert!(err.contains("125000 bit/s, found by listening"), "{err}");
    let err = capture("bitrate=125k,serial=A");
    assert!(err.contains("125000 bit/s, as the last time"), "{err}");
    let err = capture("bitrate=500k,serial=A");
    assert!(err.contains("500000 bit/s, found by listening"), "{err}");
    // Another board has buses of its own.
    let err = capture("bitrate=500k,serial=B");
    assert!(err.contains("500000 bit/s, found by listening"), "{err}");
    let err = capture("bitrate=500k,serial=A");
    assert!(err.contains("500000 bit/s, as the last time"), "{err}");
}

#[test]
fn a_trace_cannot_be_listened_to() {
    let trace = "../host/formats/tests/data/nmea2000.log.gz";
    for (line, part) in [
        (format!("stats {trace} -b auto"), "a trace cannot be listened to"),
        (format!("monitor {trace} -b 2:auto --once"), "a trace cannot be listened to"),
        (format!("plot {trace} --bus-load -b auto -o x.svg"), "auto listens to a device"),
        ("capture -d virtual -b automatic".to_owned(), "or auto to find it by listening"),
    ] {
        let (code, out, err) = cantap(&line);
        assert!(code == Some(2) && err.contains(part) && out.is_empty(), "{line}: {code:?} {err}");
    }
}
