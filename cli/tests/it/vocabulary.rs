//! Names that are the same everywhere: channels, JSON keys, mistakes and their exit codes.

use std::process::{Command, Output, Stdio};

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(arguments.split_whitespace()).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn json(arguments: &str) -> serde_json::Value {
    let (code, out, err) = cantap(&format!("{arguments} --json"));
    assert_eq!(code, Some(0), "{arguments}: {err}");
    assert_eq!(out.lines().count(), 1, "{arguments}: {out}");
    serde_json::from_str(&out).unwrap()
}

/// Each key with every value that it has anywhere in an object.
fn each(value: &serde_json::Value, see: &mut impl FnMut(&str, &serde_json::Value)) {
    match value {
        serde_json::Value::Object(members) => {
            for (key, value) in members {
                see(key, value);
                each(value, see);
            }
        }
        serde_json::Value::Array(values) => values.iter().for_each(|value| each(value, see)),
        _ => {}
    }
}

const TRACE: &str = "../host/formats/tests/data/nmea2000.log.gz";

/// As in `docs/json.md`.
#[test]
fn json_speaks_one_language_in_every_command() {
    for arguments in [
        "info -d virtual".to_owned(),
        "status -d virtual".to_owned(),
        "list".to_owned(),
        "bits 123#11".to_owned(),
        "timing -b 500k".to_owned(),
        "autobaud -d virtual".to_owned(),
        "defaults show -d virtual".to_owned(),
        "capture -d virtual -b 500k -t 200ms".to_owned(),
        "send -d virtual 1 123#11".to_owned(),
        format!("stats {TRACE} -b 250k --windows"),
        format!("diff {TRACE} {TRACE}"),
    ] {
        each(&json(&arguments), &mut |key, value| {
            let abbreviated = ["ch", "t", "bitrate"].contains(&key);
            let spelt_out = key.ends_with("_percent") || key.ends_with("_seconds");
            assert!(!abbreviated && !spelt_out, "{arguments}: {key}");
            let is_figure = |value: &serde_json::Value| value.is_number() || value.is_null();
            // `diff` has one for each trace.
            let is_number =
                is_figure(value) || value.as_array().is_some_and(|each| each.iter().all(is_figure));
            match key {
                "channel" => {
                    assert!(value.as_u64().is_some_and(|channel| channel >= 1), "{arguments}: {value}");
                }
                "seconds" | "bitrate_bps" => assert!(is_number, "{arguments}: {key} {value}"),
                _ if ["_s", "_us", "_ms", "_pct", "_ppm", "_hz", "_bps"]
                    .iter()
                    .any(|unit| key.ends_with(unit)) =>
                {
                    assert!(is_number, "{arguments}: {key} {value}");
                }
                _ => {}
            }
        });
    }
}

#[test]
fn send_tells_scripts_what_became_of_the_frames() {
    let sent = json("send -d virtual 2 123#11 124#22 -n 3");
    assert_eq!((&sent["channel"], &sent["asked"], &sent["sent"]), (&2.into(), &6.into(), &6.into()));
    assert!(sent["reason"].is_null() && sent["seconds"].is_f64(), "{sent}");
    let (code, out, _) = cantap("send -d virtual:ack=no 1 123#11 --json");
    let failed: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((code, &failed["not_sent"]), (Some(1), &1.into()), "{failed}");
    assert!(failed["reason"].as_str().unwrap().contains("nobody acknowledged"), "{failed}");
}

/// Channel 1 is 1 in words, and `can0` where a trace wants an interface; both are accepted.
#[test]
fn a_channel_has_one_number_in_every_command() {
    for (arguments, part) in [
        ("stats -d virtual -b 500k -c can1 -t 1200ms", "channel 2 "),
        ("capture -d virtual -b 500k -c can1 -n 5 -o /dev/null --format candump", "channel 2: 5 frames"),
        ("autobaud -d virtual -c can1", "bit/s"),
        ("monitor -d virtual -b 500k -c can1 --once --view statistics -t 1s", "Channel 2: 500000 bit/s"),
    ] {
        let (code, out, err) = cantap(arguments);
        assert!(code == Some(0) && (out + &err).contains(part), "{arguments}: {err}");
    }
    let (_, out, _) = cantap("send -d virtual 2 123#11");
    assert!(out.contains(" can1 123#11 T"), "{out}");
    let (_, out, _) = cantap("send -d virtual can1 123#11");
    assert!(out.contains(" can1 123#11 T"), "{out}");
}

#[test]
fn the_same_mistake_has_the_same_words_and_exit_code_everywhere() {
    let folder = tempfile::tempdir().unwrap();
    let there = folder.path().join("there.log");
    std::fs::write(&there, "kept").unwrap();
    let there = there.display();
    for (arguments, part) in [
        ("capture -d virtual -b 500".to_owned(), "write 500k for 500 kbit/s"),
        ("monitor -d virtual -b 500 --once".to_owned(), "write 500k for 500 kbit/s"),
        ("stats -d virtual -b 500".to_owned(), "write 500k for 500 kbit/s"),
        (
            "capture -d virtual -b 500k -o x.foo".to_owned(),
            "the name 'x.foo' does not show the format; name it with",
        ),
        (format!("convert {TRACE} x.foo"), "the name 'x.foo' does not show the format"),
        (
            format!("search {TRACE} --id 123 -o x.foo"),
            "cannot write x.foo: the name 'x.foo' does not show the format",
        ),
        (
            format!("align {TRACE} {TRACE} -o x.foo"),
            "cannot write x.foo: the name 'x.foo' does not show the format",
        ),
        ("demo -t 100ms -o x.foo".to_owned(), "the name 'x.foo' does not show the format"),
        (
            "monitor -d virtual -b 500k --once -o x.foo".to_owned(),
            "the name 'x.foo' does not show the format",
        ),
        (format!("plot {TRACE} --bus-load -o x.foo"), "'x.foo' names no picture format; use .svg"),
        (format!("decode {TRACE}"), "no database to decode by; give one with --db FILE"),
        (format!("plot {TRACE}"), "no database to find signals in; give one with --db FILE"),
        (format!("search {TRACE}"), "nothing to look for; give --id, --data or a condition"),
        (
            "search -d virtual -c 3 --id 1".to_owned(),
            "cantap: a device has channels 1 and 2, and no channel 3",
        ),
        // This option is for output.
        (format!("stats {TRACE} --format asc"), "unexpected argument '--format'"),
        ("send -d virtual 123#11".to_owned(), "as in: cantap send 1 123#11"),
        ("capture -d virtual -b 500k -f 12x".to_owned(), "neither an ID, such as 123"),
        ("capture -d virtual -b 500k -c 3".to_owned(), "a device has channels 1 and 2, and no channel 3"),
        ("stats -d virtual -b 500k -c 3".to_owned(), "a device has channels 1 and 2, and no channel 3"),
        ("status -d virtual -t 1s -c 3".to_owned(), "a device has channels 1 and 2, and no channel 3"),
    ] {
        let (code, _, err) = cantap(&arguments);
        assert_eq!(code, Some(2), "{arguments}: {err}");
        assert!(err.contains(part), "{arguments}: {err}");
    }
    // An existing file is not lost by a slip.
    let (code, _, err) = cantap(&format!("capture -d virtual -b 500k -n 5 -o {there}"));
    assert!(code == Some(1) && err.contains("already exists"), "{err}");
    assert_eq!(std::fs::read_to_string(folder.path().join("there.log")).unwrap(), "kept");
    let (code, _, err) = cantap(&format!("monitor -d virtual -b 500k --once -o {there}"));
    assert!(code == Some(1) && err.contains("already exists"), "{err}");
    assert_eq!(std::fs::read_to_string(folder.path().join("there.log")).unwrap(), "kept");
    for command in ["capture -d virtual -b 500k -n 5", "monitor -d virtual -b 500k --once -t 100ms"] {
        let (code, _, err) = cantap(&format!("{command} -o {there} --force"));
        assert_eq!(code, Some(0), "{err}");
        assert_ne!(std::fs::read_to_string(folder.path().join("there.log")).unwrap(), "kept");
        std::fs::write(folder.path().join("there.log"), "kept").unwrap();
    }
    let found = folder.path().join("found");
    let (code, _, err) =
        cantap(&format!("search {TRACE} --id 9F80102 -m 1 -o {} --format asc", found.display()));
    assert!(code == Some(0) && std::fs::read_to_string(&found).unwrap().starts_with("date "), "{err}");
    // What users of candump type.
    let (code, out, err) = cantap("capture -d virtual:frames=std8 -b 500k -f 123 -t 300ms");
    assert!(code == Some(0) && out.lines().all(|line| line.contains(" 123#")), "{err}{out}");
    let (code, out, err) = cantap(&format!("search {TRACE} --id 9F80102 --count"));
    assert!(code == Some(0) && out.trim() != "0", "{err}{out}");
}

/// What is asked for and cannot be had is refused, and not ignored: nothing is opened.
#[test]
fn options_that_mean_nothing_there_are_refused() {
    let alone = "cannot be used with";
    for (line, part) in [
        ("search {trace} --id 1 -t 1s", alone),
        ("decode {trace} --protocols -b 500k", alone),
        ("conversations {trace} -t 1s", alone),
        ("delay {trace} --from 1 --to 2 -b 500k", alone),
        ("delay {trace} --from 1 --to 2 -c 1", "-c leaves out channel 2"),
        ("search --id 1 --follow -t 1s", alone),
        ("stats -d virtual:car --follow", alone),
        ("stats -d virtual:car --strict", alone),
        ("stats -d virtual:car --zone UTC", alone),
        ("conversations -d virtual:car --zone UTC", alone),
        ("stats --zone UTC", "<FILE>"),
        ("search {trace} --id 1 --count --format asc", alone),
        ("stats {trace} --pair 7E0:7E8", "--protocols"),
        ("diff {trace} {trace} --pair 7E0:7E8", "--protocols"),
        ("decode {trace} --protocols --text-cells", "add --csv"),
        ("db no.dbc --strict", "--coverage"),
        ("db no.dbc --message A -f 1", alone),
        ("plot {trace} --db no.dbc -s A -b 500k", alone),
        ("plot {trace} --db no.dbc -w 1s", "--bus-load"),
        ("plot {trace} --timing 123 --curves 3", alone),
        ("monitor {trace} --once --normal", "--normal is for a device"),
        ("monitor {trace} --once --mode normal", "--mode is for a device"),
        ("monitor {trace} --once -t 1s", "-t is for a device"),
        ("monitor {trace} --once --btr 1", "--btr is for a device"),
        ("monitor virtual:car -t 1s", "--once"),
        ("obd -d virtual:car live --dtc no.csv", "cantap obd codes does"),
        ("send -d virtual 1 123#00 --brs", "123##1DEADBEEF"),
        ("run node:engine --one-shot --for 1ms", "--one-shot is for a device"),
        ("capture -d virtual -b 1M -o no.log --decimal-mark .", "--format csv-analyser or --format dif"),
        ("capture -d virtual -b 1M --json --format asc", "with -o"),
        ("capture -d virtual -b 1M -o no.parquet", "cantap convert"),
        ("capture -d virtual -b 1M --format rlog", "only read"),
        ("convert {trace} no.log --dif rows", "--format dif"),
        ("convert {trace} no.csv --format csv-analyser --separator ,", "choose different ones"),
        ("align {trace} {trace} --format asc", "with -o"),
        ("stats {trace} --window 1us", "a window must be longer"),
        ("stats {trace} --window 99999999999999d", "a year"),
        ("capture virtual:car", "-d virtual:car"),
        ("obd codes virtual:car", "-d virtual:car"),
        ("send virtual:car 1 123#00", "-d virtual:car"),
    ] {
        let (code, out, err) = cantap(&line.replace("{trace}", TRACE));
        assert!(code == Some(2) && err.contains(part) && out.is_empty(), "{line}: {code:?} {out}{err}");
    }
    assert!(!std::path::Path::new("no.log").exists() && !std::path::Path::new("no.parquet").exists());
}
