//! `cantap delay` and `cantap gateway` as users run them.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const PAGE: &str = include_str!("../../../docs/gateway.md");

/// Channel 1 sends 123 with a counter every 10 ms. A gateway takes 2 ms, and loses one.
fn both() -> String {
    let line = |at: u32| {
        let from = format!("(1.{:06}) can0 123#11{at:02X}0000\n", at * 10_000);
        let to = format!("(1.{:06}) can1 123#11{at:02X}0000\n", at * 10_000 + 2_000);
        if at == 5 { from } else { from + &to }
    };
    let lines: String = (0..50).map(line).collect();
    "(0.000000) can0 7FF#\n".to_owned() + &lines + "(1.490000) can1 321#\n(3.000000) can0 7FF#\n"
}

fn directory(test: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("gateway").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    let toml = PAGE.split("```toml\n").nth(1).unwrap().split("```").next().unwrap();
    std::fs::write(directory.join("rules.toml"), toml).unwrap();
    std::fs::write(directory.join("both.log"), both()).unwrap();
    let both = both();
    let received: Vec<_> = both.split_inclusive('\n').filter(|line| !line.contains("can1")).collect();
    std::fs::write(directory.join("car.log"), received.concat()).unwrap();
    directory
}

fn cantap(directory: &Path, line: &str) -> (Option<i32>, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(line.split(' ')).current_dir(directory).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn object(directory: &Path, line: &str) -> Value {
    let (code, out, err) = cantap(directory, &format!("{line} --json"));
    assert_eq!(code, Some(0), "{line}: {err}");
    serde_json::from_str(&out).unwrap()
}

#[test]
fn delays_missing_and_extra_frames_are_shown() {
    let directory = directory("delay");
    let (code, out, err) = cantap(&directory, "delay both.log --from 1 --to 2 -f 123 -f 321");
    assert_eq!(code, Some(0), "{err}");
    let row = |id: &str| -> Vec<&str> {
        out.lines().find(|line| line.starts_with(id)).unwrap().split_whitespace().collect()
    };
    assert_eq!(row("123"), ["123", "49", "1", "0", "2.000", "2.000", "2.000", "2.000", "2.000"], "{out}");
    assert_eq!(row("321")[..4], ["321", "0", "0", "1"]);
    assert!(out.contains("steps of 2 ms"), "{out}");
    let (code, ..) = cantap(&directory, "delay both.log --from 1 --to 2 --check -f 123 --within 5ms");
    assert_eq!(code, Some(3));
    let (code, ..) = cantap(&directory, "delay both.log --from 1 --to 2 --check -f 124");
    assert_eq!(code, Some(0));
}

#[test]
fn what_cannot_be_measured_is_an_error_that_says_why() {
    let directory = directory("errors");
    for (line, code, expected) in [
        ("delay both.log --from 1 --to 1", 2, "the same channel"),
        ("delay both.log --from 1 --to 3", 1, "channel 3 has no frames in this trace"),
        ("delay both.log --from 1 --to 2 --within 2h", 2, "at most an hour"),
        ("delay both.log --from 3 --to 2 --map rules.toml", 2, "channels 1 and 2"),
        ("gateway both.log --dry-run both.log", 1, "both.log, line 1"),
        ("gateway none.toml --dry-run both.log", 1, "none.toml"),
    ] {
        let (found, _, err) = cantap(&directory, line);
        assert_eq!(found, Some(code), "{line}: {err}");
        assert!(err.contains(expected), "{line}: {err}");
    }
}

#[test]
fn a_device_can_be_measured_live() {
    let directory = directory("live");
    let found = object(&directory, "delay -d virtual:load=5 -b 500k -t 500ms --from 1 --to 2");
    assert!(
        found["total"]["extra"].as_u64().unwrap() + found["total"]["missing"].as_u64().unwrap() > 0,
        "{found}"
    );
}

/// The page's rules on the page's example.
#[test]
fn what_a_dry_run_writes_is_found_again_with_its_rules() {
    let directory = directory("dry_run");
    let counts = object(&directory, "gateway rules.toml --dry-run car.log --all -o checked.log");
    let rule = |number: usize, key: &str| counts["rules"][number][key].as_u64().unwrap();
    let counted = (rule(0, "matched"), rule(0, "sent"), rule(0, "changed"), rule(1, "matched"));
    assert_eq!(counted, (50, 50, 50, 0), "{counts}");
    let sent = std::fs::read_to_string(directory.join("checked.log")).unwrap();
    assert!(sent.contains(" 456#") && sent.contains(" 123#"), "{sent}");
    let found = object(&directory, "delay checked.log --from 1 --to 2 --map rules.toml");
    let total = &found["total"];
    assert_eq!(
        (total["matched"].as_u64(), total["missing"].as_u64(), total["extra"].as_u64()),
        (Some(50), Some(0), Some(0))
    );
    assert_eq!(found["not_expected"], 2);
    // The gateway of the trace changes nothing.
    let found = object(&directory, "delay both.log --from 1 --to 2 --map rules.toml");
    assert_eq!((&found["total"]["missing"], &found["total"]["extra"]), (&50.into(), &50.into()));
}

/// Each command of the page runs as it stands.
#[test]
fn the_pages_commands_run() {
    let directory = directory("page");
    let blocks = PAGE.split("```sh\n").skip(1).map(|block| block.split("```").next().unwrap());
    let lines: Vec<_> = blocks.flat_map(str::lines).collect();
    assert_eq!(lines.len(), 5, "{lines:?}");
    for line in lines {
        let (code, out, err) = cantap(&directory, line.strip_prefix("cantap ").unwrap());
        let expected = if line.contains("--check") { 3 } else { 0 };
        assert_eq!(code, Some(expected), "{line}\n{out}\n{err}");
    }
}
