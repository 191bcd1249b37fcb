//! `cantap selftest` on good devices, and on a faulty one; `gen --saturate`.

use crate::firmware;

use std::process::{Command, Output, Stdio};

use serde_json::Value;

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(arguments.split_whitespace()).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn outcomes(object: &Value) -> Vec<(&str, &str)> {
    let steps = object["steps"].as_array().unwrap();
    steps.iter().map(|step| (step["name"].as_str().unwrap(), step["outcome"].as_str().unwrap())).collect()
}

#[test]
fn a_good_device_passes_alone_and_the_report_has_lines_and_object() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("board.txt");
    let line = format!("selftest -d virtual:load=0 --load-time 300ms --report {}", file.display());
    let (code, out, err) = cantap(&line);
    assert_eq!((code, err.as_str()), (Some(0), ""), "{out}");
    assert!(
        out.contains("\npass  channel 2 by itself, 1000000 bit/s: 2 to 2: 100 sent, 100 heard, 0 lost,"),
        "{out}"
    );
    assert!(
        out.contains("\nskip  channel 1 to channel 2: they are not said to be wired to each other"),
        "{out}"
    );
    assert!(out.contains(" passed, 0 failed, "), "{out}");
    let report = std::fs::read_to_string(&file).unwrap();
    assert!(report.starts_with(&out), "{report}");
    let object: Value = serde_json::from_str(&report[report.find('{').unwrap()..]).unwrap();
    assert_eq!((&object["board"], &object["passed"]), (&Value::from("virtual"), &Value::from(true)));
    let saturated =
        outcomes(&object).iter().position(|(name, _)| name.starts_with("both channels saturated")).unwrap();
    for flow in object["steps"][saturated]["measured"]["flows"].as_array().unwrap() {
        assert!(flow["sent"].as_u64() > Some(500) && flow["sent"] == flow["heard"], "{flow}");
        assert!(flow["bus_load_pct"].as_f64() > Some(80.0), "{flow}");
    }
}

#[test]
fn two_channels_on_one_wire_pass_the_loop() {
    let (code, out, _) =
        cantap("selftest -d virtual:load=0,wire=joined,ack=no --loop --load-time 300ms --json");
    let object: Value = serde_json::from_str(&out).unwrap();
    assert_eq!(code, Some(0), "{:#}", object["steps"]);
    let outcomes = outcomes(&object);
    for name in [
        "channel 1 to channel 2 and back, 1000000 bit/s",
        "channel 1 to channel 2 and back, 125000 bit/s",
        "channel 1 without an acknowledgement",
        "channel 2 without an acknowledgement",
        "both channels saturate one bus",
        "saved settings untouched",
    ] {
        assert!(outcomes.contains(&(name, "pass")), "{name}: {outcomes:?}");
    }
}

#[test]
fn a_loop_that_is_not_there_fails_and_says_what_to_look_at() {
    let (code, out, _) = cantap("selftest -d virtual:load=0,ack=no --loop --load-time 300ms");
    assert_eq!(code, Some(3), "{out}");
    let line =
        out.lines().find(|line| line.starts_with("FAIL  channel 1 to channel 2 and back, 500000")).unwrap();
    assert!(line.contains("nothing arrived: are the channels wired to each other"), "{line}");
    // Unrelated steps are still tested.
    assert!(out.lines().any(|line| line.starts_with("pass  saved settings untouched")), "{out}");
}

#[test]
fn its_own_example_passes() {
    let (_, help, _) = cantap("selftest --help");
    let example = help.lines().find(|line| line.contains("cantap selftest -d virtual")).unwrap();
    let line = example.trim().strip_prefix("cantap ").unwrap();
    let (code, out, _) = cantap(&format!("{line} --load-time 300ms"));
    assert_eq!(code, Some(0), "{line}: {out}");
}

#[test]
fn a_node_that_should_not_be_there_is_named() {
    let (code, out, _) = cantap("selftest -d virtual:load=0,wire=joined --loop --load-time 100ms");
    assert_eq!(code, Some(3), "{out}");
    let step = "FAIL  channel 1 without an acknowledgement: ";
    let line = out.lines().find_map(|line| line.strip_prefix(step)).unwrap_or_else(|| panic!("{out}"));
    assert!(line.starts_with("somebody acknowledged: with --loop nothing but the two channels"), "{line}");
}

/// A report that goes to a file is whole, even if nobody reads the lines any more.
#[test]
fn a_reader_that_has_read_enough_ends_the_lines_and_not_the_report() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("board.txt");
    for (options, is_whole) in [("", false), (&*format!("--report {}", file.display()), true)] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        command.args("selftest -d virtual:load=0 --load-time 100ms".split_whitespace());
        let Output { status, stderr, .. } =
            command.args(options.split_whitespace()).stdout(writer).output().unwrap();
        assert_eq!((status.code(), String::from_utf8(stderr).unwrap().as_str()), (Some(0), ""), "{options}");
        assert_eq!(file.exists(), is_whole);
    }
    let report = std::fs::read_to_string(&file).unwrap();
    assert!(report.contains(" passed, 0 failed, "), "{report}");
}

#[cfg(unix)]
#[test]
fn ctrl_c_ends_it_within_the_step_and_fails_nothing() {
    use rustix::process::{Pid, Signal, kill_process};
    use std::io::{BufRead, BufReader};

    let run = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        // The load would outlast this test.
        command.args("selftest -d virtual:load=0 --load-time 60m".split_whitespace()).stdin(Stdio::null());
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
        let mut before: Vec<String> = Vec::new();
        while !before.last().is_some_and(|line| line.contains("  channel 2 transmit queue: ")) {
            before.push(lines.next().unwrap());
        }
        kill_process(Pid::from_child(&child), Signal::INT).unwrap();
        let rest: Vec<String> = lines.collect();
        let says_so = rest.last().unwrap().ends_with("; Ctrl-C ended it, and not all steps were tried");
        assert!(says_so && !rest.iter().any(|line| line.starts_with("FAIL")), "{before:#?} {rest:#?}");
        let code = child.wait().unwrap().code();
        // A busy computer may have failed a step before, or have sent the signal between two steps.
        let is_busy = before.iter().any(|line| line.starts_with("FAIL"));
        assert_eq!(code, Some(if is_busy { 1 } else { 130 }), "{before:#?} {rest:#?}");
        rest.first().map(String::as_str)
            == Some("skip  both channels saturated, each by itself: Ctrl-C ended it")
    };
    assert!((0..10).any(|_| run()));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn the_emulated_board_passes() {
    let elf = firmware::elf();
    let line = format!(
        "selftest -d emu:{},load=0,wire=joined,ack=no --loop --load-time 500ms --json",
        elf.display()
    );
    let (code, out, err) = cantap(&line);
    let object: Value = serde_json::from_str(&out).unwrap_or_else(|_| panic!("{err}"));
    assert_eq!(code, Some(0), "{:#}", object["steps"]);
}

#[test]
fn a_generator_fills_both_buses_and_says_how_full_they_were() {
    let _turn = cantap_testing::process::turn();
    // A busy computer leaves the buses idle for a while, and then the line says so: one run without that shows that both can be full.
    let is_full = || {
        let (code, _, err) = cantap("gen -d virtual:load=0 both -b 1M --saturate -n 20000");
        assert!(code == Some(0) && err.contains("20000 frames sent"), "{err}");
        let load_of = |channel: u8| -> f64 {
            let line = err.lines().find(|line| line.starts_with(&format!("cantap: channel {channel}: ")));
            line.unwrap().split_once("bus load ").unwrap().1.trim_end_matches(" %").parse().unwrap()
        };
        [1, 2].iter().all(|channel| load_of(*channel) > 80.0)
    };
    assert!((0..10).any(|_| is_full()));
}
