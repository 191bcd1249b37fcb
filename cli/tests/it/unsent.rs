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

fn object(arguments: &str) -> (Option<i32>, serde_json::Value) {
    let (code, lines, err) = cantap(arguments);
    let line = lines.last().unwrap_or_else(|| panic!("{arguments}: {err}"));
    (code, serde_json::from_str(line).unwrap())
}

/// A reply that never gets onto the bus was asked for all the same.
#[test]
fn replies_are_counted_with_the_frames_that_asked_for_them() {
    let _turn = cantap_testing::process::turn();
    // There are frames to reply to, and no room for a reply behind them.
    let (code, sent) = object(&format!("send -d {FULL_BUS} can0 7FF#11 --on-rx 000:000 -t 500ms --json"));
    assert_eq!((code, sent["sent"].as_u64()), (Some(1), Some(0)), "{sent}");
    let matches = sent["replies"][0]["matches"].as_u64().unwrap();
    assert!(matches > 100 && sent["asked"].as_u64() >= Some(matches), "{sent}");
    assert!(sent["reason"].as_str().unwrap().contains("the bus is full"), "{sent}");
    // With room, each is answered, or counted as one that is not.
    let line = "send -d virtual:load=20,frames=std0,seed=5 -b 500k can0 000#11 --on-rx 100:700 -t 1s --json";
    let (code, sent) = object(line);
    let reply = &sent["replies"][0];
    let count = |name: &str| reply[name].as_u64().unwrap();
    assert!(count("matches") > 0 && count("sent") > 0, "{sent}");
    assert_eq!(count("asked"), count("sent") + count("left_out") + count("withdrawn"), "{sent}");
    assert!(count("asked") >= count("matches"), "{sent}");
    assert_eq!(code, Some(i32::from(count("left_out") > 0)), "{sent}");
    assert_eq!((reply["frame"].as_str(), reply["on"].as_str()), (Some("000#11"), Some("100:700")));
    // Nothing asked for any.
    let (code, sent) = object("send -d virtual:load=0 -b 500k can0 000#11 --on-rx 7FF -t 200ms --json");
    assert_eq!((code, sent["asked"].as_u64(), &sent["replies"][0]["matches"]), (Some(0), Some(0), &0.into()));
    // What the command line says wrongly has the code of that.
    let (code, _, err) = cantap("send -d virtual -b 500k can0 000#11 --on-rx 100~700");
    assert!(code == Some(2) && err.contains("cannot start a reply"), "{err}");
}

/// Ends with the test.
#[cfg(unix)]
struct Server(std::process::Child);

#[cfg(unix)]
impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Nothing leaves that is not counted: by a witness on the same bus.
#[cfg(unix)]
#[test]
fn what_was_sent_is_what_left_however_it_ended() {
    let _turn = cantap_testing::process::turn();
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("cantap.sock").display().to_string();
    let mut server = Command::new(env!("CARGO_BIN_EXE_cantap"));
    server.args(["serve", "-d", "virtual:wire=joined,load=50,frames=std0,seed=5", "-b", "500k"]);
    server.args(["--allow", "send", "--unix", &socket]).stdin(std::process::Stdio::null());
    server.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::null());
    let mut server = Server(server.spawn().unwrap());
    let mut first = String::new();
    let stdout = server.0.stdout.take().unwrap();
    std::io::BufRead::read_line(&mut std::io::BufReader::new(stdout), &mut first).unwrap();
    let at = first.trim().to_owned();
    let end = |child: std::process::Child| {
        let process = child.id().to_string();
        assert!(Command::new("kill").args(["-s", "INT", &process]).status().unwrap().success());
        String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap()
    };
    let spawn = |line: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        command
            .args(line.split_whitespace())
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::null());
        command.spawn().unwrap()
    };
    for (number, (what, ended_by)) in [
        ("send 1 7F0#11 --on-rx 000:400", "-t 700ms"),
        ("send 1 7F1#11 --period 1ms", "-t 700ms"),
        ("send 1 7F2#11 -n 1000000", "a signal"),
        ("gen 1 -I 7F3 -L 1 -g 0", "a signal"),
    ]
    .into_iter()
    .enumerate()
    {
        let log = folder.path().join(format!("{number}.log"));
        let witness = spawn(&format!("capture -d {at} -c 1 -b 500k --mode normal -o {}", log.display()));
        // It listens once there is something in its file.
        let deadline = std::time::Instant::now() + std::time::Duration::from_mins(1);
        while std::fs::metadata(&log).map_or(0, |file| file.len()) == 0 {
            assert!(std::time::Instant::now() < deadline, "the witness hears nothing");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        let signal = ended_by == "a signal";
        let (command, rest) = what.split_once(' ').unwrap();
        let option = if signal { "" } else { ended_by };
        let sender = spawn(&format!("{command} -d {at} -b 500k --mode normal {rest} {option} --json"));
        let out = if signal {
            std::thread::sleep(std::time::Duration::from_millis(700));
            end(sender)
        } else {
            String::from_utf8(sender.wait_with_output().unwrap().stdout).unwrap()
        };
        // What left before is in the file before what comes now.
        let mark = spawn(&format!("send -d {at} -b 500k --mode normal 1 7FE#0{number} --json"));
        mark.wait_with_output().unwrap();
        end(witness);
        let sent: serde_json::Value = serde_json::from_str(out.lines().last().unwrap()).unwrap();
        let id = format!(" 7F{number}#");
        let text = std::fs::read_to_string(&log).unwrap();
        let left = text.lines().filter(|line| line.starts_with('(') && line.contains(&id)).count() as u64;
        let lost = text.contains(" lost ");
        assert!(!lost, "the witness missed frames, and proves nothing");
        assert_eq!(sent["sent"].as_u64(), Some(left), "{what}: {sent}");
        assert!(left > 0, "{what}");
    }
}
