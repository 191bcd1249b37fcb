//! `cantap delay` and `cantap gateway` as users run them.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::in_folder::cantap;

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

/// Rules that pass on the lower half of the 11-bit identifiers and drop the others. None matches 29-bit ones.
const HALVES: &str = "[[rule]]\nname = \"low\"\nfrom = 1\nfilter = \"000-3FF\"\n\n[[rule]]\nfrom = 1\nfilter = \"400-7FF\"\ndrop = true\n\n\
                      [[rule]]\nname = \"back\"\nfrom = 2\nfilter = \"000-7FF\"\n";

fn on_a_device(test: &str) -> PathBuf {
    let directory = directory(test);
    std::fs::write(directory.join("halves.toml"), HALVES).unwrap();
    directory
}

/// Every frame of a direction and of a rule is accounted for. Returns the counts of the direction from channel 1.
fn accounted(counts: &Value) -> impl Fn(&str) -> u64 {
    let count = |of: &Value, key: &str| of[key].as_u64().unwrap();
    let all = |of: &Value| ["sent", "dropped", "replaced", "lost", "failed"].map(|key| count(of, key));
    for of in counts["rules"].as_array().unwrap() {
        assert_eq!(count(of, "matched"), all(of).iter().sum::<u64>(), "{counts}");
    }
    for of in counts["directions"].as_array().unwrap() {
        assert_eq!(count(of, "received"), count(of, "matched") + count(of, "unmatched"), "{counts}");
        assert_eq!(count(of, "matched"), all(of).iter().sum::<u64>(), "{counts}");
        assert_eq!(count(of, "waiting"), 0, "{counts}");
    }
    let first = counts["directions"][0].clone();
    move |key| count(&first, key)
}

#[test]
fn a_device_passes_frames_on_and_accounts_for_each() {
    let directory = on_a_device("device");
    let counts =
        object(&directory, "gateway halves.toml -d virtual:load=20,frames=mix,channels=1 -b 500k -t 2s");
    let from_1 = accounted(&counts);
    assert!(["sent", "dropped", "unmatched"].iter().all(|key| from_1(key) > 0), "{counts}");
    assert_eq!((from_1("lost"), from_1("failed")), (0, 0), "{counts}");
    assert_eq!((&counts["state"], &counts["directions"][1]["received"]), (&"off".into(), &0.into()));
    assert_eq!((&counts["rules"][0]["rule"], &counts["rules"][0]["line"]), (&"low".into(), &1.into()));
}

#[test]
fn what_the_other_bus_cannot_take_is_counted_as_lost() {
    let directory = on_a_device("slower");
    let line = "gateway halves.toml -d virtual:load=90,frames=std8,channels=1 -b 1M -b 2:125k -t 2s";
    let counts = object(&directory, line);
    let from_1 = accounted(&counts);
    assert!(from_1("lost") > 0 && from_1("sent") > 0, "{counts}");
    let (code, out, err) = cantap(&directory, line);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("LOST"), "{out}");
    assert!(
        err.contains("acknowledges and sends on channel 1 (") && err.contains("and channel 2 ("),
        "{err}"
    );
}

#[test]
fn two_channels_on_one_bus_end_it_and_the_exit_code_says_so() {
    let directory = on_a_device("loop");
    let line = "gateway halves.toml -d virtual:load=50,frames=std8,wire=joined -b 500k -t 60s";
    let (code, out, err) = cantap(&directory, line);
    assert_eq!(code, Some(1), "{out}{err}");
    assert!(err.contains("both channels are on one bus"), "{err}");
    assert!(out.contains("received"), "{out}");
}

/// A device keeps its gateway until it is erased. Without one that runs, there is nothing to show or to stop.
#[test]
fn a_gateway_is_stored_and_erased() {
    let directory = on_a_device("stored");
    let settings = directory.join("settings.bin");
    let _ = std::fs::remove_file(&settings);
    let device = "-d virtual:load=0,settings=settings.bin";
    let (code, out, err) =
        cantap(&directory, &format!("gateway halves.toml {device} -b 500k -b 2:250k --save"));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("--forget"), "{out}");
    let saved = object(&directory, &format!("defaults show {device}"));
    let channel = |number: usize, key: &str| saved["channels"][number]["saved"][key].clone();
    assert_eq!((channel(0, "bitrate_bps"), channel(1, "bitrate_bps")), (500_000.into(), 250_000.into()));
    assert_eq!(channel(1, "mode"), "normal");
    let (code, _, err) = cantap(&directory, &format!("gateway --forget {device}"));
    assert_eq!(code, Some(0), "{err}");
    let saved = object(&directory, &format!("defaults show {device}"));
    assert!(saved["channels"][0]["saved"].is_null(), "{saved}");
}

/// A device starts with what is stored on it, before any host finds it.
#[test]
fn a_stored_gateway_is_shown_and_stopped_and_its_channels_are_its_own() {
    let directory = on_a_device("runs_alone");
    let _ = std::fs::remove_file(directory.join("settings.bin"));
    let device = "-d virtual:load=20,frames=mix,channels=1,settings=settings.bin";
    let (code, _, err) = cantap(&directory, &format!("gateway halves.toml {device} -b 500k --save"));
    assert_eq!(code, Some(0), "{err}");
    // One object a second.
    let (code, out, err) = cantap(&directory, &format!("gateway --show {device} -t 1s --json"));
    assert_eq!(code, Some(0), "{err}");
    let shown: Value = serde_json::from_str(out.lines().last().unwrap()).unwrap();
    assert_eq!((&shown["state"], &shown["standalone"]), (&"running".into(), &true.into()), "{shown}");
    assert!(shown["directions"][0]["sent"].as_u64().unwrap() > 0, "{shown}");
    let (code, _, err) = cantap(&directory, &format!("capture {device} -b 500k -t 1s"));
    assert_eq!(code, Some(1), "{err}");
    let (code, _, err) = cantap(&directory, &format!("gateway halves.toml {device} -b 500k"));
    assert!(code == Some(1) && err.contains("--stop ends it"), "{err}");
    let (code, out, err) = cantap(&directory, &format!("gateway --stop {device}"));
    assert!(code == Some(0) && out.contains("still stored"), "{out}{err}");
    let (code, _, err) = cantap(&directory, &format!("gateway --forget {device}"));
    assert_eq!(code, Some(0), "{err}");
    let (code, _, err) = cantap(&directory, &format!("gateway --stop {device}"));
    assert!(code == Some(1) && err.contains("runs no gateway on its own"), "{err}");
}

/// Both buses of a stored gateway were one, and nobody watched.
#[test]
fn a_stored_gateway_that_has_found_a_loop_says_so_to_the_next_host() {
    let directory = on_a_device("looped_alone");
    let _ = std::fs::remove_file(directory.join("settings.bin"));
    let device = "-d virtual:load=50,frames=std8,wire=joined,settings=settings.bin";
    let (code, _, err) = cantap(&directory, &format!("gateway halves.toml {device} -b 500k --save"));
    assert_eq!(code, Some(0), "{err}");
    let (code, _, err) = cantap(&directory, &format!("gateway --show {device} -t 60s"));
    assert!(code == Some(1) && err.contains("both channels are on one bus"), "{err}");
}

#[test]
fn files_that_are_no_rules_are_refused_with_the_place() {
    let directory = on_a_device("hostile");
    let rule = |fields: &str| format!("[[rule]]\nfrom = 1\n{fields}\n");
    for (content, expected) in [
        (rule("").repeat(40_000), "256 KiB"),
        (rule("").repeat(10_000), "take 20000 places"),
        (format!("[[rule]]\nfrom = {}1", "[".repeat(100_000)), "line 2"),
        (rule("filter = \"1\0\""), "line 3"),
        (rule("name = \"a\"\nname = \"b\""), "line 4"),
        (rule("period = \"0\""), "line 3"),
        (rule("delay = \"101s\""), "at most 100s"),
        (rule("checksum = \"8:xor\""), "bytes 0 to 7"),
        (rule("set.dlc = 16"), "a DLC is 0 to 15"),
        (rule("set.id = \"800\""), "line 3"),
        (rule("filter = \"800\""), "line 3"),
    ] {
        std::fs::write(directory.join("bad.toml"), content).unwrap();
        let (code, _, err) = cantap(&directory, "gateway bad.toml --dry-run both.log");
        assert!(code == Some(1) && err.contains(expected), "{expected}: {err}");
    }
    std::fs::write(directory.join("bad.toml"), [0xFF, 0xFE, 0]).unwrap();
    let (code, _, err) = cantap(&directory, "gateway bad.toml --dry-run both.log");
    assert!(code == Some(1) && err.contains("bad.toml"), "{err}");
}

#[test]
fn options_that_do_not_go_together_are_refused() {
    let directory = on_a_device("options");
    for (line, code, expected) in [
        ("gateway", 2, "RULES"),
        ("gateway --show -d virtual:load=0", 1, "runs no gateway on its own"),
        ("gateway --stop -d virtual:load=0", 1, "--forget erases"),
        ("gateway --show -d virtual:load=0 -b 500k", 2, "leave them out"),
        ("gateway --save -d virtual:load=0", 2, "RULES"),
        ("gateway halves.toml --dry-run both.log -d virtual", 2, "cannot be used with"),
        ("gateway halves.toml --dry-run both.log -b 500k", 2, "cannot be used with"),
        ("gateway halves.toml -d virtual:load=0 -b 500k -f 123", 2, "--dry-run"),
        ("gateway halves.toml -d candump:both.log -b 500k", 1, "cannot be a gateway"),
        ("gateway halves.toml -d virtual:load=0 -b 500k --db both.log", 2, "--db is for a trace"),
        ("gateway halves.toml -d virtual:load=0 -b 500k --j1939", 2, "--j1939 is for a trace"),
        ("gateway halves.toml -d virtual:load=0 -b 500k --from candump", 2, "--from is for a trace"),
        (
            "gateway halves.toml -d virtual:load=0 -b 500k --columns id=1,data=2",
            2,
            "--columns is for a trace",
        ),
        ("gateway --show -d virtual:load=0 --strict", 2, "--strict is for a trace"),
        ("gateway --stop -d virtual:load=0 --zone +02:00", 2, "--zone is for a trace"),
    ] {
        let (found, _, err) = cantap(&directory, line);
        assert_eq!(found, Some(code), "{line}: {err}");
        assert!(err.contains(expected), "{line}: {err}");
    }
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
