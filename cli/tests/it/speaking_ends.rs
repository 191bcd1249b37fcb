//! How the commands that speak end where the device, its server or the bus fails, and by Ctrl-C: by themselves, soon, with the reason, and without
//! sending anything afterwards.
#![cfg(unix)]

use crate::port;
use crate::served;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use cantap_testing::process::wait_until;
use port::Port;
use served::Served;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");
/// Nobody answers, so each of them is in the middle of something for as long as its options say.
const WAITING: [&str; 13] = [
    "uds --p2 50s read F190",
    "uds --p2 50s --session extended --security 1 --key-command true tester-present",
    "uds --p2 50s routine start FF00",
    "obd live 0C",
    "obd watch 0C",
    "canopen --timeout 50s read 5 1000",
    "canopen --timeout 50s write 6 2000 0 11223344556677889900 --type hex --block",
    "canopen --timeout 50s scan 20-30",
    "canopen scan --listen 50s",
    "canopen --timeout 50s lss --node 5",
    "canopen --timeout 50s drive 5 enable --yes",
    "j1939 request 65260",
    "j1939 send 0xD000 BIG",
];
/// These go on until they are told to end.
const REPEATING: [&str; 5] = [
    "uds tester-present --period 30ms",
    "canopen sync --period 30ms",
    "canopen heartbeat 7 --period 30ms",
    "canopen monitor",
    "j1939 send 130306 Reference=2 --period 30ms",
];
/// Longer than any of them takes once it is disturbed, on a busy machine. Most of them would wait for longer.
const SOON: Duration = Duration::from_secs(20);

fn start(device: &str, line: &str) -> Child {
    let line = line.replace("BIG", &"01".repeat(1785));
    let mut command = Command::new(CANTAP);
    command.args(line.split(' ')).args(["-d", device]);
    if !line.starts_with("autobaud") {
        command.args(["-b", "500k"]);
    }
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

/// Everywhere.
const SIGINT: u32 = 2;

/// Whether it has set up what Ctrl-C does; until then that kills it.
fn catches_ctrl_c(child: &Child) -> bool {
    // Elsewhere nobody can ask.
    let Ok(status) = std::fs::read_to_string(format!("/proc/{}/status", child.id())) else { return true };
    let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
    u64::from_str_radix(caught.trim(), 16).unwrap() & 1 << (SIGINT - 1) != 0
}

/// Whether it has opened this port.
fn has_opened(child: &Child, port: &str) -> bool {
    // Elsewhere nobody can ask.
    let Ok(files) = std::fs::read_dir(format!("/proc/{}/fd", child.id())) else { return true };
    let port = std::fs::canonicalize(port).unwrap();
    files.flatten().any(|file| std::fs::read_link(file.path()).is_ok_and(|open| open == port))
}

/// Its exit code, and what it said on standard error.
fn end(mut child: Child, line: &str) -> (Option<i32>, String) {
    let until = Instant::now() + SOON;
    while child.try_wait().unwrap().is_none() {
        if Instant::now() > until {
            child.kill().unwrap();
            panic!("{line}: it does not end");
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    (status.code(), String::from_utf8(stderr).unwrap())
}

/// The frames in a log, without what candump has about errors and sessions.
fn frames_of(log: &str) -> Vec<&str> {
    let frames = log.lines().filter_map(|line| line.split(' ').nth(2));
    frames.filter(|frame| !frame.starts_with("20000")).collect()
}

/// Long enough for each to have begun.
fn begin() {
    std::thread::sleep(Duration::from_millis(400));
}

#[test]
fn a_device_that_is_unplugged_ends_each_with_the_reason() {
    let lines = WAITING.into_iter().filter(|line| !line.starts_with("obd")).chain(REPEATING);
    let mut running: Vec<_> = lines
        .map(|line| {
            let mut port = Port::new();
            port.plug("load=0");
            (line, start(port.name(), line), port)
        })
        .collect();
    for (line, child, port) in &running {
        wait_until(&format!("{line}: it has not opened its port"), || has_opened(child, port.name()));
    }
    begin();
    for (.., port) in &mut running {
        port.unplug();
    }
    for (line, child, _) in running {
        let (code, said) = end(child, line);
        assert!(
            code == Some(1) && said.contains("vanished") && said.contains("plug it in again"),
            "{line}: {said}"
        );
    }
}

#[test]
fn a_server_that_is_killed_ends_each_with_the_reason() {
    let lines: Vec<_> =
        WAITING.into_iter().filter(|line| !line.starts_with("obd")).chain(REPEATING).collect();
    // A server takes eight clients.
    for lines in lines.chunks(7) {
        let mut served = Served::start("virtual:load=0", Stdio::null());
        let running: Vec<_> = lines.iter().map(|line| (line, start(&served.at, line))).collect();
        begin();
        served.server.kill().unwrap();
        for (line, child) in running {
            let (code, said) = end(child, line);
            assert!(code == Some(1) && said.contains("its server has ended"), "{line}: {said}");
        }
    }
}

/// The controller comes back by itself, and would then send what was waiting.
#[test]
fn a_channel_that_goes_bus_off_ends_each_with_the_reason() {
    let sends = |line: &&str| !line.contains("--listen") && !line.contains("monitor");
    let lines = WAITING.into_iter().chain(REPEATING).filter(sends);
    let running: Vec<_> = lines.map(|line| (line, start("virtual:load=0,disturb=40", line))).collect();
    for (line, child) in running {
        let (code, said) = end(child, line);
        assert!(code == Some(1) && said.contains("channel 1 went bus-off"), "{line}: {said}");
        assert!(said.contains("check bit rate, wiring and termination"), "{line}: {said}");
    }
}

#[test]
fn ctrl_c_ends_each_at_once() {
    let lines =
        || WAITING.into_iter().filter(|line| !line.starts_with("obd") && !line.starts_with("j1939 request"));
    let mut running: Vec<_> = lines().map(|line| (line, start("virtual:load=0", line), 130)).collect();
    for line in ["uds scan", "autobaud -t 50s", "run node:engine"] {
        running.push((line, start("virtual:load=0", line), 130));
    }
    running.extend(REPEATING.map(|line| (line, start("virtual:load=0", line), 0)));
    let mut live = start("virtual:car", "obd live 0C");
    // Without an answer by then it would have failed.
    let mut answers = BufReader::new(live.stdout.take().unwrap());
    answers.read_line(&mut String::new()).unwrap();
    running.push(("obd live 0C", live, 0));
    begin();
    for (_, child, _) in &running {
        wait_until("it takes Ctrl-C itself", || catches_ctrl_c(child));
        signal(child, "-INT");
    }
    for (line, child, expected) in running {
        let (code, said) = end(child, line);
        assert_eq!(code, Some(expected), "{line}: {said}");
        let reasons = ["ended by Ctrl-C", "stopped before a bit rate", "ended before the scripts"];
        assert!(code == Some(0) || reasons.iter().any(|reason| said.contains(reason)), "{line}: {said}");
    }
}

/// Neither after Ctrl-C nor after a death without any last word.
#[test]
fn nothing_is_sent_after_the_end() {
    let served = Served::start("virtual:load=0", Stdio::null());
    let log = served.folder.path().join("heard.log");
    let listener = start(&served.at, &format!("capture -t 2m -o {}", log.display()));
    begin();
    for name in ["-INT", "-KILL"] {
        let running = REPEATING.map(|line| (line, start(&served.at, line)));
        begin();
        for (_, child) in &running {
            signal(child, name);
        }
        for (line, child) in running {
            end(child, line);
        }
        std::thread::sleep(Duration::from_millis(300));
        let (code, said) = end(start(&served.at, "send 1 7FF#"), "send");
        assert_eq!(code, Some(0), "{said}");
        std::thread::sleep(Duration::from_millis(300));
    }
    signal(&listener, "-INT");
    end(listener, "capture");
    let log = std::fs::read_to_string(&log).unwrap();
    let frames = frames_of(&log);
    let of = |id: &str| frames.iter().filter(|frame| frame.starts_with(id)).count();
    assert!(of("7E0#") >= 4 && of("080#") >= 4 && of("707#") >= 4 && of("09FD02F9#") >= 2, "{log}");
    assert_eq!(frames.last(), Some(&"7FF#"), "{log}");
    // After the first mark comes the second round, which begins with the session of a new client.
    assert_eq!(of("7FF#"), 2, "{log}");
}

/// A node in configuration mode would take the next orders for itself.
#[test]
fn ctrl_c_leaves_no_node_in_configuration_mode() {
    let served = Served::start("virtual:load=0", Stdio::null());
    let log = served.folder.path().join("heard.log");
    let listener = start(&served.at, &format!("capture -t 2m -o {}", log.display()));
    begin();
    let lss = start(&served.at, "canopen --timeout 50s lss --identity 1:2:3:4 --node 5");
    begin();
    signal(&lss, "-INT");
    let (code, said) = end(lss, "lss");
    assert!(code == Some(130) && said.contains("ended by Ctrl-C"), "{said}");
    signal(&listener, "-INT");
    end(listener, "capture");
    let log = std::fs::read_to_string(&log).unwrap();
    let frames = frames_of(&log);
    assert_eq!(frames.first(), Some(&"7E5#0400000000000000"), "{log}");
    assert_eq!(frames.last(), Some(&"7E5#0400000000000000"), "{log}");
    assert_eq!(frames.len(), 6, "{log}");
}

/// Where nothing leaves, and where nobody is.
#[test]
fn what_was_not_done_is_no_success() {
    for (line, device, words) in [
        ("canopen sync --period 10ms -t 500ms", "virtual:load=0,ack=no", "0 frames were sent"),
        ("canopen sync --period 10ms -t 500ms", "virtual:load=0,ack=no", "nobody acknowledged"),
        ("canopen heartbeat 5 --period 10ms -t 500ms", "virtual:load=0,ack=no", "nobody acknowledged"),
        (
            "canopen scan 1-9",
            "virtual:load=0",
            "no node answered or sent a heartbeat; what was sent was acknowledged",
        ),
        ("canopen scan --listen 300ms", "virtual:load=0", "no node sent a heartbeat; nothing was sent"),
        ("canopen lss", "virtual:load=0", "no node without a number answers"),
        ("j1939 request 65260", "virtual:load=0", "no answer within 1250 ms"),
        ("j1939 dm1", "virtual:load=0", "no answer within 1250 ms"),
        ("obd codes", "virtual:load=0", "no ECU answers"),
        ("uds --functional read F190", "virtual:load=0", "no answer within"),
        // At a wrong bit rate there are only errors.
        ("canopen monitor -t 500ms", "virtual:load=50,bitrate=125k", "only errors and no frame"),
        ("canopen scan --listen 500ms", "virtual:load=50,bitrate=125k", "only errors and no frame"),
    ] {
        let (code, said) = end(start(device, line), line);
        assert!(code == Some(1) && said.contains(words), "{line}: {code:?} {said}");
    }
    let (code, said) = end(start("virtual:load=0", "canopen monitor -t 300ms"), "monitor");
    assert!(code == Some(0) && said.contains("no frame was heard"), "{said}");
}
