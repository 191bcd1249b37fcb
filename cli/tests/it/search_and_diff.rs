//! `cantap search` and `cantap diff` as users run them.

use std::path::PathBuf;
use std::process::{Command, Output};

const DATABASE: &str = "BO_ 1 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"km/h\" A\nBO_ 2 Box: 8 A\n \
                        SG_ Gear : 0|8@1+ (1,0) [0|0] \"\" A\nVAL_ 2 Gear 3 \"Drive\" 0 \"Park\" ;\n";

/// One frame per 10 ms.
const FRAMES: [&str; 10] = [
    "001#20",
    "002#00",
    "001#60",
    "123#112233",
    "002#03",
    "001#61",
    "123#AA1122",
    "001#30",
    "123#1144",
    "001#70",
];

fn cantap(test: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("search_and_diff").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    let log = |frames: &[&str], step: usize| -> String {
        let lines = frames.iter().enumerate();
        let lines: Vec<_> =
            lines.map(|(at, frame)| format!("({}.000000) can0 {frame}\n", at * step)).collect();
        lines.concat()
    };
    for (name, content) in [
        ("car.dbc", DATABASE.to_owned()),
        ("a.log", log(&FRAMES, 1)),
        ("b.log", log(&["001#20", "001#60", "001#61", "002#00", "002#03", "124#"], 2)),
    ] {
        std::fs::write(directory.join(name), content).unwrap();
    }
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).current_dir(directory).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn frames_are_found_by_identifier_data_and_condition() {
    for (arguments, expected) in [
        (&["--id", "123"][..], &[3, 6, 8][..]),
        (&["--id", "123", "--data", "11 ?? 3?"], &[3]),
        (&["--data", "* 11 22"], &[3, 6]),
        (&["--id", "00?"], &[0, 1, 2, 4, 5, 7, 9]),
        (&["--db", "car.dbc", "Speed > 80 and Gear == 3"], &[4, 5, 9]),
        (&["--db", "car.dbc", "Speed > 80 and Gear == Drive"], &[4, 5, 9]),
        (&["--db", "car.dbc", "-e", "Engine.Speed > 0x60", "-m", "1"], &[5]),
        (&["id == 0x123 and byte[0] == 0xAA"], &[6]),
        (&["--id", "123", "byte[1] > 0x30"], &[8]),
    ] {
        let (code, out, err) = cantap("search", &[&["search", "a.log", "--json"], arguments].concat());
        let (lines, summary) = out.trim_end().rsplit_once('\n').unwrap();
        assert!(summary.starts_with(&format!("{{\"summary\":{{\"found\":{}", expected.len())), "{summary}");
        let found: Vec<_> = lines
            .lines()
            .map(|line| {
                serde_json::from_str::<serde_json::Value>(line).unwrap()["time_s"].as_f64().unwrap() as usize
            })
            .collect();
        assert_eq!((code, &found[..], err.as_str()), (Some(0), expected, ""), "{arguments:?}");
    }
}

#[test]
fn context_is_shown_as_grep_does() {
    let (_, out, _) =
        cantap("context", &["search", "a.log", "--id", "123", "-B", "1", "--after-context", "0"]);
    assert_eq!(
        out,
        "(2.000000) can0 001#60\n(3.000000) can0 123#112233\n--\n(5.000000) can0 001#61\n(6.000000) can0 123#AA1122\n\
         (7.000000) can0 001#30\n(8.000000) can0 123#1144\n"
    );
    let (_, out, _) = cantap("context", &["search", "a.log", "--db", "car.dbc", "Gear == Drive", "-A", "1"]);
    assert_eq!(
        out,
        "(4.000000) can0 002#03  Box: Gear = 3 (Drive)\n(5.000000) can0 001#61  Engine: Speed = 97 km/h\n"
    );
    let (_, out, _) = cantap("context", &["search", "a.log", "--id", "123", "-C", "9", "--count"]);
    assert_eq!(out, "3\n");
    let (_, out, _) =
        cantap("context", &["search", "a.log", "--id", "123", "-m", "1", "-A", "1", "-o", "found.log"]);
    assert_eq!(out, "");
    let (_, out, _) = cantap("context", &["search", "found.log", "-e", "len >= 0"]);
    assert_eq!(out, "(3.000000) can0 123#112233\n(4.000000) can0 002#03\n");
}

#[test]
fn what_is_no_frame_is_told_in_words() {
    let table = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("events.csv");
    let events = ["bus-error bit-recessive", "state passive", "transmit-failed arbitration-lost tag=1"];
    let rows = events.map(|event| format!("1.0,1,,event,,,,{event}\n"));
    let head = "time,channel,direction,type,id,dlc,data,event";
    std::fs::write(&table, format!("{head}\n{}1.0,1,Rx,data,123,1,11,\n", rows.concat())).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { stdout, .. } =
        command.arg("search").arg(&table).args(["id == 0x123", "-B", "9"]).output().unwrap();
    let found = String::from_utf8(stdout).unwrap();
    let words: Vec<&str> = found.lines().map(|line| line.split_once("can0 ").unwrap().1).collect();
    assert_eq!(
        words,
        ["bus error: bit-recessive", "controller: passive", "not sent: arbitration-lost", "123#11"]
    );
}

#[test]
fn finding_nothing_ends_with_1_and_a_bad_condition_with_2_and_is_marked() {
    assert_eq!(
        cantap("nothing", &["search", "a.log", "--id", "7FF"]),
        (Some(1), String::new(), String::new())
    );
    let (code, _, err) = cantap("nothing", &["search", "a.log", "--db", "car.dbc", "Speed > and Gear"]);
    assert_eq!(code, Some(2));
    assert_eq!(
        err,
        "cantap: condition: expected a number, a signal, a part of the frame or \"(\", found \"and\"\n  \
         Speed > and Gear\n          ^\n"
    );
    let (code, _, err) = cantap("nothing", &["search", "a.log", "Speed > 3"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("load one with --db"), "{err}");
    assert_eq!(cantap("nothing", &["search", "a.log"]).0, Some(2));
    assert_eq!(cantap("nothing", &["search", "a.log", "--id", "123456789"]).0, Some(2));
}

#[test]
fn differences_are_listed() {
    let (code, out, _) = cantap("diff", &["diff", "a.log", "b.log"]);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "channel 1, 123: only in a.log (3 frames)\n\
         channel 1, 124: only in b.log (1 frame)\n\
         channel 1, 001: period 2250.000 ms -> 2000.000 ms\n\
         channel 1, 001: byte 0 0x1x000x -> 0x10000x\n\
         channel 1, 002: period 3000.000 ms -> 2000.000 ms\n\
         1 only in the first, 1 only in the second, 2 changed, 0 the same\n"
    );
    let (code, out, _) =
        cantap("diff", &["diff", "a.log", "b.log", "--json", "--check", "--tolerance", "60"]);
    assert_eq!(code, Some(3));
    let found: serde_json::Value = serde_json::from_str(&out).unwrap();
    let key = |id: &str| serde_json::json!({ "channel": 1, "id": id, "remote": false, "fd": false });
    let with = |mut value: serde_json::Value, more: serde_json::Value| {
        value.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        value
    };
    let bytes = serde_json::json!([{ "byte": 0, "a": "0x1x000x", "b": "0x10000x" }]);
    let changed = serde_json::json!({ "period_ms": null, "dlc": null, "fd_flags": null, "bytes": bytes });
    assert_eq!(
        found,
        serde_json::json!({
            "only_a": [with(key("123"), serde_json::json!({ "count": 3 }))],
            "only_b": [with(key("124"), serde_json::json!({ "count": 1 }))],
            "changed": [with(key("001"), changed)],
            "same": 1,
            "issues": 0,
            "left_out": {},
            "missing_pct": [0.0, 0.0],
            "equal": false,
        })
    );
    assert_eq!(cantap("diff", &["diff", "a.log", "a.log", "--check"]).0, Some(0));
}

#[test]
fn a_channel_of_a_trace_is_chosen_as_in_convert() {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("search_and_diff/channels");
    std::fs::create_dir_all(&folder).unwrap();
    let line = |at: usize| format!("({at}.000000) can{} 001#{at:02X}\n", at % 2);
    std::fs::write(folder.join("both.log"), (0..10).map(line).collect::<String>()).unwrap();
    let run = |line: &str| cantap("channels", &line.split(' ').collect::<Vec<_>>());
    assert_eq!(run("convert both.log second.log -c 2").0, Some(0));
    for line in [
        "search {} --id 001",
        "decode {} --db car.dbc",
        "stats {} --json",
        "conversations {}",
        "stats {} --per-id",
    ] {
        let second = run(&line.replace("{}", "second.log"));
        assert_eq!(run(&format!("{} -c 2", line.replace("{}", "both.log"))), second, "{line}");
        assert_ne!(run(&line.replace("{}", "both.log")), second, "{line}");
    }
    assert_eq!(run("search both.log --id 001 -c 9"), (Some(1), String::new(), String::new()));
    assert_eq!(run("delay both.log --from 1 --to 2 -c 1,2"), run("delay both.log --from 1 --to 2"));
}
