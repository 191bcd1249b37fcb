//! The commands that need no bus, and those that capture, as users run them.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

fn command(arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(arguments.split_whitespace()).stdin(Stdio::null());
    command
}

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = command(arguments).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn json(text: &str) -> serde_json::Value {
    assert_eq!(text.lines().count(), 1, "one object was expected: {text}");
    serde_json::from_str(text).unwrap()
}

fn keys(value: &serde_json::Value) -> Vec<&str> {
    let mut keys: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
    keys.sort_unstable();
    keys
}

/// Checks that every line is complete: time, interface, frame.
fn whole_lines(path: &Path) -> usize {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.ends_with('\n'), "the last line is cut");
    for line in text.lines() {
        let parts: Vec<&str> = line.split(' ').collect();
        assert!(parts[0].starts_with('(') && parts[0].ends_with(')') && parts[2].contains('#'), "{line}");
    }
    text.lines().count()
}

/// A virtual device behind a pseudo-terminal, in a separate process, until it is dropped.
#[cfg(unix)]
struct Virtual {
    process: Child,
    port: String,
}

#[cfg(unix)]
impl Virtual {
    fn start(options: &str) -> Self {
        let mut process = command(&format!("virtual {options}"))
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut port = String::new();
        BufReader::new(process.stdout.take().unwrap()).read_line(&mut port).unwrap();
        Self { process, port: port.trim_end().to_owned() }
    }
}

#[cfg(unix)]
impl Drop for Virtual {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Waits until a file has grown beyond this many bytes.
fn wait_for_bytes(path: &Path, bytes: u64) {
    let deadline = Instant::now() + Duration::from_secs(20);
    while std::fs::metadata(path).map_or(0, |metadata| metadata.len()) < bytes {
        assert!(Instant::now() < deadline, "nothing was captured");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn bits_prints_length_stuff_bits_crc_and_duration() {
    let (code, out, _) = cantap("bits 000#55 -b 500k");
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "frame       000#55\nlength      58 bits, intermission included\nframe bits  55\nstuff bits  3\n\
         CRC         0x722\nduration    116 us at 500000 bit/s\n"
    );
    let (code, out, _) = cantap("bits 001#88098A0088008101 --json");
    assert_eq!((code, json(&out)["bits"].as_u64()), (Some(0), Some(119)));
    assert_eq!(cantap("bits 12#").0, Some(0));
    let (code, _, err) = cantap("bits 800#");
    assert!(code == Some(2) && err.contains("00000800"), "{err}");
}

#[test]
fn info_tells_what_the_device_is() {
    let (code, out, err) = cantap("info -d virtual --json");
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let object = json(&out);
    assert_eq!(object["board"], "virtual");
    assert_eq!(object["queue_bytes"], 98_304);
    let (code, out, _) = cantap("info -d virtual");
    assert!(code == Some(0) && out.starts_with("board           virtual\n"), "{out}");
}

#[test]
fn list_prints_one_object() {
    let (code, out, _) = cantap("list --json");
    assert_eq!(code, Some(0));
    assert!(json(&out)["devices"].is_array());
}

#[test]
fn completions_are_made_for_each_shell() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let (code, out, _) = cantap(&format!("completions {shell}"));
        assert!(code == Some(0) && out.contains("cantap"), "{shell}: {out}");
    }
    assert_eq!(cantap("completions tcsh").0, Some(2));
}

#[test]
fn capture_prints_so_many_candump_lines_and_a_summary_on_stderr() {
    let (code, out, err) = cantap("capture -d virtual:load=30,frames=std8 -b 500k -c 2 -n 20");
    assert_eq!((code, out.lines().count()), (Some(0), 20));
    assert!(out.lines().all(|line| line.contains(" can1 ") && line.starts_with("(1")), "{out}");
    assert!(err.contains("channel 2: 20 frames") && !err.contains("channel 1"), "{err}");
}

#[test]
fn capture_with_json_prints_one_object_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.log");
    let arguments = format!("capture -d virtual:load=60 -b 250k -t 700ms --json -o {}", file.display());
    let (code, out, _) = cantap(&arguments);
    assert_eq!(code, Some(0));
    let object = json(&out);
    assert_eq!(keys(&object), ["channels", "clock_drift_ppm", "lost", "seconds"]);
    assert!(object["seconds"].as_f64() >= Some(0.7), "{out}");
    let frames: u64 =
        object["channels"].as_array().unwrap().iter().map(|c| c["frames"].as_u64().unwrap()).sum();
    assert_eq!(whole_lines(&file) as u64, frames);
    let load = object["channels"][0]["bus_load_pct"].as_f64().unwrap();
    assert!((55.0..65.0).contains(&load), "{load}");
}

/// A captured channel, and its figures from `stats` for the recorded file.
fn captured_and_counted(options: &str, channel: usize) -> (serde_json::Value, serde_json::Value, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.log");
    let (code, out, err) = cantap(&format!("capture {options} --json -o {}", file.display()));
    // A capture with nothing but errors is a failure.
    assert_eq!(code, Some(i32::from(json(&out)["channels"][channel]["frames"] == 0)), "{err}");
    let (code, counted, _) = cantap(&format!("stats {} --json", file.display()));
    assert_eq!(code, Some(0));
    (json(&out)["channels"][channel].clone(), json(&counted)["channels"][channel].clone(), err)
}

#[test]
fn a_bus_with_nothing_but_errors_is_told_from_a_silent_one() {
    let _turn = cantap_testing::process::turn();
    let (captured, counted, err) =
        captured_and_counted("-d virtual:errors=100,load=100 -c 2 -b 1M -t 400ms", 0);
    assert_eq!(captured["frames"], 0);
    assert!(captured["bus_errors"].as_u64() > Some(100), "{captured}");
    assert!(counted["errors"]["suppressed"].as_u64() > Some(0), "{counted}");
    assert_eq!(captured["bus_errors"], counted["errors"]["total"]);
    assert!(
        err.contains("channel 2: only errors and no frame, which usually means a wrong bit rate"),
        "{err}"
    );
    assert!(err.contains("`cantap autobaud -d virtual:"), "{err}");
    // The other node has a different rate.
    let (code, _, err) = cantap("capture -d virtual:load=50,bitrate=250k -c 1 -b 500k -t 300ms");
    assert_eq!(code, Some(1));
    let line = err.lines().find(|line| line.starts_with("channel 1: 0 frames, ")).unwrap();
    assert!(line.ends_with(" bus errors") && !line.ends_with(" 0 bus errors"), "{err}");
    assert!(err.contains("`cantap autobaud -d virtual:"), "{err}");
    // A bus with both, and one with neither, need no advice.
    let (captured, counted, err) =
        captured_and_counted("-d virtual:errors=30,load=60 -c 1 -b 500k -t 400ms", 0);
    assert!(
        captured["frames"].as_u64() > Some(10) && captured["bus_errors"].as_u64() > Some(10),
        "{captured}"
    );
    assert_eq!(captured["bus_errors"], counted["errors"]["total"]);
    assert!(!err.contains("autobaud"), "{err}");
    let (_, _, err) = cantap("capture -d virtual:load=0 -c 1 -b 500k -t 100ms");
    assert!(err.contains(" 0 lost, 0 bus errors") && !err.contains("autobaud"), "{err}");
    // Errors describe the state of the bus, whatever is captured of it.
    let (_, out, err) =
        cantap("capture -d virtual:errors=100,load=100 -c 1 -b 1M -t 300ms -f can0,123:7FF --json");
    assert!(json(&out)["channels"][0]["bus_errors"].as_u64() > Some(100), "{out}");
    assert!(!err.contains("autobaud"), "{err}");
}

#[test]
fn data_that_was_left_out_is_told_and_gives_no_load() {
    let line = "capture -d virtual:load=50,frames=std8 -c 1 -b 500k -n 30 --no-data";
    let (code, out, err) = cantap(line);
    assert_eq!((code, out.lines().count()), (Some(0), 30));
    let notice = "cantap: standard output does not carry the data that the device left out, and has zeros in its place (30)";
    assert!(err.lines().any(|line| line == notice), "{err}");
    assert!(
        err.contains("channel 1: 30 frames, ") && err.contains("bus load – (frames come without data)"),
        "{err}"
    );
    let (_, out, err) = cantap(&format!("{line} --json"));
    assert_eq!(err, "");
    let channel = &json(&out)["channels"][0];
    assert!(channel["bus_load_pct"].is_null() && channel["frames_per_s"].is_f64(), "{out}");
    // Frames without data do not lack them.
    let (_, _, err) = cantap("capture -d virtual:load=50,frames=std0 -c 1 -b 500k -n 30 --no-data");
    assert!(err.contains("bus load ") && !err.contains("zeros"), "{err}");
}

#[test]
fn times_that_were_left_out_give_neither_rate_nor_load() {
    let line = "capture -d virtual:load=50 -c 1 -b 500k -t 300ms --no-stamps";
    let (code, _, err) = cantap(line);
    assert_eq!(code, Some(0));
    assert!(err.contains("does not carry the mark of times that are only upper bounds"), "{err}");
    assert!(!err.contains("frames/s") && err.contains("bus load – (frames come without times)"), "{err}");
    let (_, out, _) = cantap(&format!("{line} --json"));
    let channel = &json(&out)["channels"][0];
    assert!(channel["bus_load_pct"].is_null() && channel["frames_per_s"].is_null(), "{out}");
    assert!(channel["frames"].as_u64() > Some(100), "{out}");
}

#[test]
fn a_timing_out_of_range_is_told_in_words() {
    for (option, part) in [
        ("--segments 9,6,1,2", "the jump width is out of range"),
        ("--segments 9,17,2,2", "segment 1 (PROP+PS1) is out of range"),
        ("--btr 0x03000000", "the jump width is out of range"),
    ] {
        let (code, _, err) = cantap(&format!("capture -d virtual {option}"));
        assert!(code == Some(2) && err.contains(part) && !err.contains('{'), "{err}");
    }
}

#[test]
fn what_cannot_work_is_one_line_with_the_next_step() {
    let _turn = cantap_testing::process::turn();
    for (arguments, wanted, message) in [
        ("info -d /dev/there-is-none", 1, "there is no device at '/dev/there-is-none'; `cantap list` shows"),
        ("info -d emu:there-is-none.elf", 1, "cannot read there-is-none.elf"),
        ("capture -d virtual -b 999999", 1, "the nearest it reaches: 947368 and 1000000 bit/s"),
        (
            "capture -d virtual -b 2M",
            1,
            "a bit rate of 2000000 bit/s is impossible; choose one from 5000 to 1000000",
        ),
        (
            "capture -d virtual -b 500k -o /nowhere/x.log",
            1,
            "cannot write to '/nowhere/x.log'; choose a folder",
        ),
        (
            "info -d virtual:speed=9",
            2,
            "there is no option 'speed'; there are car, canopen, ecu, load, frames",
        ),
        ("info -d virtual:load=101", 2, "'101' does not fit the option 'load': give per cent, 0 to 100"),
        ("info -d virtual:log=/nowhere.log", 2, "'/nowhere.log' does not fit the option 'log'"),
        ("info -d emu:any.elf,load=101", 2, "'101' does not fit the option 'load': give per cent, 0 to 100"),
        ("capture -d virtual -b 500k -b 3:250k", 2, "a device has no channel 3"),
        ("capture -d virtual -b 3:250k", 2, "a device has no channel 3"),
        ("capture -d virtual --sjw 2", 2, "needs a bit rate; add -b RATE"),
    ] {
        let (code, out, err) = cantap(arguments);
        assert_eq!((code, out.as_str(), err.lines().count()), (Some(wanted), "", 1), "{arguments}: {err}");
        assert!(err.starts_with("cantap: ") && err.contains(message), "{arguments}: {err}");
    }
    assert_eq!(cantap("capture -d virtual").0, Some(2));
    assert_eq!(cantap("demo --load 101").0, Some(2));
    assert_eq!(cantap("demo --load 0").0, Some(2));
    assert_eq!(cantap("capture -d virtual -b 1M -n 0").0, Some(2));
    assert_eq!(cantap("capture -d virtual -b 1M -t 0").0, Some(2));
}

#[cfg(unix)]
#[test]
fn a_capture_that_outgrows_its_place_says_how_many_frames_the_file_has() {
    let _turn = cantap_testing::process::turn();
    let folder = tempfile::tempdir().unwrap();
    // Files are limited to 64 KiB here.
    let script =
        "trap '' XFSZ; ulimit -f 128; exec \"$0\" capture -d virtual:load=100 -b 1M -t 20 -o cut.log --json";
    let output = Command::new("sh")
        .args(["-c", script, env!("CARGO_BIN_EXE_cantap")])
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let text = std::fs::read_to_string(folder.path().join("cut.log")).unwrap();
    assert!(text.ends_with('\n') && text.len() <= 128 * 512, "{}", text.len());
    assert_eq!(summary["frames_in_file"], text.lines().count());
    let captured = &summary["channels"];
    let captured = captured[0]["frames"].as_u64().unwrap() + captured[1]["frames"].as_u64().unwrap();
    assert!(captured > text.lines().count() as u64, "{summary}");
}

#[cfg(target_os = "linux")]
#[test]
fn messages_that_nobody_can_take_change_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut capture = command("capture -d virtual:load=50 -b 1M -n 10 -o some.log");
    let status = capture.current_dir(folder.path()).stderr(full).status().unwrap();
    assert_eq!(status.code(), Some(0));
    assert_eq!(std::fs::read_to_string(folder.path().join("some.log")).unwrap().lines().count(), 10);
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_ends_the_capture_with_a_clear_line() {
    let _turn = cantap_testing::process::turn();
    let (code, _, err) = cantap("capture -d virtual:load=100 -b 1M -t 10 -o /dev/full");
    assert_eq!(code, Some(1));
    let last = err.lines().last().unwrap();
    assert!(last.starts_with("cantap: writing to '/dev/full' failed") && last.contains("make room"), "{err}");
}

#[cfg(unix)]
#[test]
fn a_port_that_vanishes_leaves_a_whole_file_and_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.log");
    let device = Virtual::start("load=50,frames=std8");
    let arguments = format!("capture -d {} -b 500k -o {}", device.port, file.display());
    let capture = command(&arguments).stderr(Stdio::piped()).spawn().unwrap();
    wait_for_bytes(&file, 10_000);
    drop(device);
    // It waits for the device to come back until it is stopped.
    let pid = capture.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let output = capture.wait_with_output().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(err.lines().last().unwrap().contains("vanished"), "{err}");
    assert!(whole_lines(&file) > 100);
}

#[cfg(unix)]
#[test]
fn a_port_in_use_is_refused_and_ctrl_c_ends_a_capture_cleanly() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.log");
    let device = Virtual::start("load=50,frames=std8");
    let arguments = format!("capture -d {} -b 500k -o {}", device.port, file.display());
    let capture = command(&arguments).stderr(Stdio::piped()).spawn().unwrap();
    wait_for_bytes(&file, 1000);
    let (code, _, err) = cantap(&format!("info -d {}", device.port));
    assert_eq!((code, err.lines().count()), (Some(1), 1));
    assert!(err.contains("is in use by another program; close it there"), "{err}");
    let pid = capture.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().unwrap().success());
    let output = capture.wait_with_output().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{err}");
    let lines = whole_lines(&file);
    assert!(err.contains("lost: controller 0, queue 0, link 0, host 0"), "{err}");
    let total: usize = err
        .lines()
        .filter_map(|line| {
            line.strip_prefix("channel ")?.split_once(": ")?.1.split_once(" frames")?.0.parse::<usize>().ok()
        })
        .sum();
    assert_eq!(total, lines);
    // The port is free again.
    assert_eq!(cantap(&format!("info -d {}", device.port)).0, Some(0));
}

#[test]
fn the_demo_loses_nothing_and_says_so_in_the_promised_object() {
    let _turn = cantap_testing::process::turn();
    let (code, out, err) = cantap("demo --time 1 --json");
    let object = json(&out);
    assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
    assert_eq!(
        keys(&object),
        [
            "channels",
            "in_order",
            "lost",
            "ok",
            "queue_bytes",
            "queue_high_water_bytes",
            "seconds",
            "wire_bytes_per_frame"
        ]
    );
    assert_eq!(
        keys(&object["lost"]),
        ["controller", "gateway", "host", "link", "off_bus", "off_bus_us", "queue", "unknown"]
    );
    for channel in object["channels"].as_array().unwrap() {
        assert_eq!(keys(channel), ["bus_load_pct", "channel", "delivered", "frames_per_s", "lost", "sent"]);
        assert_eq!((&channel["delivered"], channel["lost"].as_u64()), (&channel["sent"], Some(0)));
        assert!(channel["frames_per_s"].as_f64().unwrap() >= 20_800.0, "{out}");
        assert!(channel["bus_load_pct"].as_f64().unwrap() > 99.9, "{out}");
    }
    assert_eq!((object["ok"].as_bool(), object["in_order"].as_bool()), (Some(true), Some(true)));
    assert!(object["wire_bytes_per_frame"].as_f64().unwrap() <= 5.5, "{out}");
}

#[test]
fn a_demo_that_stalls_too_long_counts_every_frame_it_loses() {
    let _turn = cantap_testing::process::turn();
    let (code, out, _) = cantap("demo --time 1 --stall 1500ms --kind ext8 --json");
    let object = json(&out);
    assert_eq!((code, object["ok"].as_bool()), (Some(0), Some(true)), "{out}");
    for channel in object["channels"].as_array().unwrap() {
        let count = |key: &str| channel[key].as_u64().unwrap();
        assert!(count("lost") > 1000, "{out}");
        assert_eq!(count("sent"), count("delivered") + count("lost"));
    }
    assert!(object["lost"]["queue"].as_u64().unwrap() > 0);
}
