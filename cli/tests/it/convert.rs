//! `cantap convert` as users run it.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

const TRACE: &str = "(1410714882.000000) can0 123#1122\n\
                     (1410714883.000000) can1 1F334455#AA T\n\
                     (1410714884.000000) can0 124#R2\n\
                     (1410714885.000000) can0 20000088#0000040000000000\n\
                     (1410714886.500000) can1 400#\n";

/// An empty directory for each test, except for the trace.
fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("convert").join(test);
    // An earlier run may have left files that would be counted.
    let _ = fs::remove_dir_all(&directory);
    fs::create_dir_all(&directory).unwrap();
    fs::write(directory.join("trace.log"), TRACE).unwrap();
    directory
}

fn cantap(directory: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    texts(Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).current_dir(directory).output().unwrap())
}

fn texts(output: Output) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = output;
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// The lines of the trace with these numbers.
fn lines(numbers: &[usize]) -> String {
    numbers.iter().map(|number| TRACE.split_inclusive('\n').nth(*number).unwrap()).collect()
}

/// Wherever a trace goes, its bit rates go along, and the load is known without `-b`.
#[test]
fn bit_rates_go_along_from_format_to_format() {
    let directory = directory("bit_rates");
    fs::write(directory.join("known.log"), format!("# cantap: bit-rates 1=500000 2=125000\n{TRACE}"))
        .unwrap();
    let mut before = "known.log".to_owned();
    for name in ["a.asc", "b.blf", "c.trc", "d.mf4", "e.pcapng", "f.asc"] {
        let (code, _, err) = cantap(&directory, &["convert", &before, name, "-c", "both"]);
        assert_eq!(code, Some(0), "{name}: {err}");
        let (code, out, err) = cantap(&directory, &["stats", name]);
        assert_eq!(code, Some(0), "{name}: {err}");
        assert!(out.contains("Channel 1 at 500000 bit/s, as the trace says"), "{name}: {out}");
        assert!(out.contains("Channel 2 at 125000 bit/s, as the trace says"), "{name}: {out}");
        let (_, out, _) = cantap(&directory, &["stats", name, "-b", "250k"]);
        assert!(out.contains("Channel 1 at 250000 bit/s\n"), "what is given comes first: {out}");
        let (_, out, _) = cantap(&directory, &["stats", name, "--json"]);
        let statistics: serde_json::Value = serde_json::from_str(&out).unwrap();
        assert_eq!(statistics["channels"][1]["bitrate_from_trace"], true, "{name}: {out}");
        name.clone_into(&mut before);
    }
    let (_, out, _) = cantap(&directory, &["convert", &before, "-"]);
    assert_eq!(out, TRACE);
}

#[test]
fn channels_are_chosen_as_in_every_command() {
    let directory = directory("channels");
    for all in [&["-c", "both"][..], &["-c", "all"], &["-c", "1,2"], &["-c", "1", "-c", "can1"], &[]] {
        let (code, out, err) = cantap(&directory, &[&["convert", "trace.log", "-"], all].concat());
        assert_eq!((code, out.as_str()), (Some(0), TRACE), "{all:?}: {err}");
    }
    let (_, out, _) = cantap(&directory, &["convert", "trace.log", "-", "-c", "2"]);
    assert_eq!(out, lines(&[1, 4]));
    for wrong in ["0", "256", "x", ""] {
        let (code, _, err) = cantap(&directory, &["convert", "trace.log", "-", "-c", wrong]);
        assert_eq!(code, Some(2), "{wrong}: {err}");
    }
}

/// A script's variable that is not set must not mean everything.
#[test]
fn an_empty_filter_is_refused_however_it_is_written() {
    let directory = directory("empty_filter");
    for empty in ["", ",", " ", ",,"] {
        let (code, out, err) = cantap(&directory, &["convert", "trace.log", "-", "-f", empty]);
        assert_eq!((code, out.as_str()), (Some(2), ""), "'{empty}'");
        assert!(err.contains("a filter is empty; write any for all frames"), "'{empty}': {err}");
    }
    let (_, out, _) = cantap(&directory, &["convert", "trace.log", "-", "-f", "any"]);
    assert_eq!(out, TRACE);
}

#[test]
fn a_trace_comes_back_from_every_format_that_carries_everything_plain_and_compressed() {
    let directory = directory("there_and_back");
    for format in ["asc", "blf", "pcapng", "trc", "log", "mf4"] {
        for compression in ["", ".gz", ".zst", ".xz", ".lz4"] {
            // This would report that it is marked as unfinished.
            if format == "mf4" && !compression.is_empty() {
                continue;
            }
            let name = format!("there.{format}{compression}");
            let (code, out, err) = cantap(&directory, &["convert", "trace.log", &name]);
            assert_eq!((code, out.as_str(), err.as_str()), (Some(0), "", ""), "{name}");
            let (code, out, err) = cantap(&directory, &["convert", &name, "-"]);
            assert_eq!((code, out.as_str(), err.as_str()), (Some(0), TRACE, ""), "{name}");
        }
    }
}

/// A BUSMASTER log has the same suffix as candump's, and an ASC file has the clock of the computer that wrote
/// it.
#[test]
fn logs_of_other_programs_are_known_by_their_beginning_and_their_dates_have_the_zone_that_is_named() {
    let directory = directory("zones");
    let log = "***BUSMASTER Ver 2.4.0***\n***START DATE AND TIME 14:9:2014 19:14:42:0***\n***HEX***\n***SYSTEM MODE***\n\
               19:14:42:0000 Rx 1 0x123 s 2 11 22\n";
    fs::write(directory.join("bus.log"), log).unwrap();
    for (zone, line) in [
        ("UTC", "(1410722082.000000) can0 123#1122\n"),
        ("Europe/Berlin", "(1410714882.000000) can0 123#1122\n"),
        ("+03:00", "(1410711282.000000) can0 123#1122\n"),
    ] {
        let (code, out, err) = cantap(&directory, &["convert", "bus.log", "-", "--zone", zone]);
        assert_eq!((code, out.as_str(), err.as_str()), (Some(0), line, ""), "{zone}");
    }
    cantap(&directory, &["convert", "trace.log", "local.asc", "--zone", "Europe/Berlin"]);
    let asc = fs::read_to_string(directory.join("local.asc")).unwrap();
    assert!(asc.starts_with("date Sun Sep 14 19:14:42.000 2014\n"), "{asc}");
    let (_, out, _) = cantap(&directory, &["convert", "local.asc", "-", "--zone", "Europe/Berlin"]);
    assert_eq!(out, TRACE);
    let (code, _, err) = cantap(&directory, &["stats", "bus.log", "--zone", "Berlin"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("write a name such as Europe/Berlin, an offset such as +02:00, or UTC"), "{err}");
    let (code, _, err) = cantap(&directory, &["convert", "bus.log", "out.txt", "--to", "busmaster"]);
    assert_eq!(code, Some(1));
    assert!(err.contains("only read") && !directory.join("out.txt").exists(), "{err}");
}

#[test]
fn a_compressed_file_is_compressed_and_its_format_is_known_without_a_name() {
    let directory = directory("unnamed");
    cantap(&directory, &["convert", "trace.log", "a.blf.gz"]);
    let bytes = fs::read(directory.join("a.blf.gz")).unwrap();
    assert_eq!(bytes[..2], [0x1F, 0x8B]);
    fs::rename(directory.join("a.blf.gz"), directory.join("unnamed")).unwrap();
    let (code, out, _) = cantap(&directory, &["convert", "unnamed", "-"]);
    assert_eq!((code, out.as_str()), (Some(0), TRACE));
}

#[test]
fn what_a_format_does_not_carry_is_counted() {
    let directory = directory("left_out");
    let (code, _, err) = cantap(&directory, &["convert", "trace.log", "a.csv"]);
    assert_eq!(code, Some(0));
    assert_eq!(
        err,
        "cantap: a.csv does not carry channels other than 1, which python-can's CSV has no column for (2)\n\
         cantap: a.csv does not carry the direction of sent frames, which python-can's CSV has no column for (1)\n"
    );
    let (_, out, err) = cantap(&directory, &["convert", "trace.log", "b.csv", "--json"]);
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((summary["records"].as_u64(), summary["issues"].as_u64()), (Some(5), Some(0)));
    assert_eq!(summary["left_out"].as_object().unwrap().len(), 2, "{err}");
}

#[test]
fn filters_channels_and_times_pick_records() {
    let directory = directory("picked");
    let cases: [(&[&str], &[usize]); 7] = [
        (&["123:7FF"], &[0]),
        (&["--filter", "can0,123:7FF", "--filter", "can1,400:7FF"], &[0, 4]),
        (&["--channel", "2"], &[1, 4]),
        (&["--start", "1", "--end", "2s"], &[1]),
        (&["--start", "2014-09-14T17:14:45"], &[3, 4]),
        (&["--end", "1410714883.5"], &[0, 1]),
        (&["--channel", "1", "--start", "2"], &[2, 3]),
    ];
    for (arguments, expected) in cases {
        let (code, out, err) = cantap(&directory, &[&["convert", "trace.log", "-"], arguments].concat());
        assert_eq!((code, out, err.as_str()), (Some(0), lines(expected), ""), "{arguments:?}");
    }
    let (code, out, err) = cantap(&directory, &["convert", "trace.log", "-", "--start", "100"]);
    assert!(
        (code, out.as_str()) == (Some(0), "") && err.contains("no record is between --start and --end"),
        "{err}"
    );
}

#[test]
fn details_of_error_frames_that_are_not_kept_are_counted() {
    let directory = directory("details");
    let log = "(1.000000) can0 20000088#0000040B00000000\n(2.000000) can0 123#11\n(3.000000) can0 20000088#0000040000000000\n\
               (4.000000) can0 20000002#0900000000000000\n(5.000000) can0 123#22\n";
    std::fs::write(directory.join("details.log"), log).unwrap();
    for name in ["again.log", "again.csv", "again.pcapng"] {
        let (code, _, err) = cantap(&directory, &["convert", "details.log", name]);
        assert_eq!(code, Some(0));
        assert!(
            err.contains("error frames say more than their kind") && err.contains("(2)"),
            "{name}: {err}"
        );
        // Everything that was written is reported.
        let (_, _, err) = cantap(&directory, &["convert", name, "twice.log"]);
        assert!(!err.contains("error frames say more"), "{name}: {err}");
    }
}

#[test]
fn a_broken_line_is_told_and_left_out_and_strict_stops_there() {
    let directory = directory("broken");
    fs::write(directory.join("broken.log"), lines(&[0, 1]) + "nonsense\n" + &lines(&[2, 3, 4])).unwrap();
    let (code, out, err) = cantap(&directory, &["convert", "broken.log", "-"]);
    assert_eq!((code, out.as_str()), (Some(0), TRACE));
    assert!(err.starts_with("cantap: broken.log, line 3: expected a log line such as '"), "{err}");
    assert!(err.contains("found 'nonsense'"), "{err}");
    let (code, out, err) = cantap(&directory, &["convert", "broken.log", "-", "--strict"]);
    assert_eq!((code, out), (Some(1), lines(&[0, 1])));
    assert!(err.contains("line 3"), "{err}");
}

#[test]
fn rotation_makes_files_that_each_stand_alone_and_keeps_the_last() {
    let directory = directory("rotated");
    let arguments = ["convert", "trace.log", "part.asc.gz", "--rotate", "2s", "--keep", "2"];
    assert_eq!(cantap(&directory, &arguments).0, Some(0));
    let mut names: Vec<_> = fs::read_dir(&directory)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.starts_with("part"))
        .collect();
    names.sort();
    assert_eq!(names, ["part-000002.asc.gz", "part-000003.asc.gz"]);
    for (name, expected) in names.iter().zip([&[2, 3][..], &[4]]) {
        let (code, out, err) = cantap(&directory, &["convert", name, "-"]);
        assert_eq!((code, out, err.as_str()), (Some(0), lines(expected), ""), "{name}");
    }
}

#[test]
fn standard_input_and_output_are_logs_unless_told() {
    let directory = directory("piped");
    let mut child = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["convert", "-", "-", "--format", "csv-full"])
        .current_dir(&directory)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(TRACE.as_bytes()).unwrap();
    let (code, out, err) = texts(child.wait_with_output().unwrap());
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(
        out.lines().take(3).collect::<Vec<_>>(),
        [
            "time,channel,direction,type,id,dlc,data,event,device_ns",
            "1410714882.000000,1,Rx,data,123,2,1122,,",
            "1410714883.000000,2,Tx,data,1F334455,1,AA,,",
        ]
    );
}

#[test]
fn the_input_is_never_overwritten_and_unknown_names_are_refused() {
    let directory = directory("refused");
    let (code, _, err) = cantap(&directory, &["convert", "trace.log", "./trace.log"]);
    assert!(code == Some(1) && err.contains("both input and output"), "{code:?} {err}");
    assert_eq!(fs::read_to_string(directory.join("trace.log")).unwrap(), TRACE);
    let (code, _, err) = cantap(&directory, &["convert", "trace.log", "a.xyz"]);
    assert!(code == Some(2) && err.contains("--format"), "{code:?} {err}");
    assert!(!err.contains("busmaster"), "it can only be read: {err}");
    assert!(!directory.join("a.xyz").exists());
    let (code, _, err) = cantap(&directory, &["convert", "absent.log", "a.asc"]);
    assert!(code == Some(1) && err.contains("absent.log"), "{code:?} {err}");
    assert!(!directory.join("a.asc").exists(), "an output without an input");
    let (code, ..) = cantap(&directory, &["convert", "trace.log", "a.asc", "--rotate", "0M"]);
    assert_eq!(code, Some(2));
}
