//! Unreadable input is not a success, whatever the command, and nothing is silently left out.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// An empty directory for each test.
fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("nothing_read").join(test);
    let _ = fs::remove_dir_all(&directory);
    fs::create_dir_all(&directory).unwrap();
    directory
}

fn cantap(directory: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(arguments).current_dir(directory).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

const DATABASE: &str = "VERSION \"\"\nBO_ 291 A: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" X\n";

#[test]
fn every_command_fails_where_nothing_could_be_read_and_says_what_the_file_looks_like() {
    let directory = directory("commands");
    fs::write(directory.join("diary.log"), "dear diary\n".repeat(30)).unwrap();
    fs::write(directory.join("other.log"), "(1.000000) can0 123#11\n").unwrap();
    fs::write(directory.join("car.dbc"), DATABASE).unwrap();
    for arguments in [
        &["convert", "diary.log", "new.asc"][..],
        &["stats", "diary.log"],
        &["stats", "diary.log", "--json"],
        &["diff", "diary.log", "diary.log", "--check"],
        &["diff", "other.log", "diary.log"],
        &["search", "diary.log", "--id", "123"],
        &["decode", "--db", "car.dbc", "diary.log"],
        &["plot", "--db", "car.dbc", "--signal", "S", "diary.log", "-o", "plot.svg"],
    ] {
        let (code, out, err) = cantap(&directory, arguments);
        assert_eq!(code, Some(1), "{arguments:?}: {out}{err}");
        let says = "nothing in diary.log could be read as candump; it looks like text that begins with 'dear diary'; \
                    if it is a trace, name its format with --from";
        assert!(err.contains(says), "{arguments:?}: {err}");
        assert!(err.contains("expected a log line such as"), "{err}");
        assert!(!out.contains("equal") && !out.contains("frames"), "{arguments:?}: {out}");
    }
    // A few of its lines are examples enough.
    let (_, _, err) = cantap(&directory, &["convert", "diary.log", "new.asc"]);
    assert_eq!(err.lines().count(), 4, "{err}");
    let (code, _, err) = cantap(&directory, &["align", "other.log", "diary.log", "-o", "aligned.log"]);
    assert!(code == Some(1) && err.contains("diary.log: no frame could be read"), "{code:?} {err}");
    let mut made: Vec<_> =
        fs::read_dir(&directory).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    made.sort();
    assert_eq!(made, ["car.dbc", "diary.log", "other.log"]);
}

#[test]
fn an_older_output_stays_as_it_is_where_nothing_can_be_read() {
    let directory = directory("older");
    fs::write(directory.join("broken.csv"), "a,b\n1,2\n").unwrap();
    fs::write(directory.join("out.log"), "older\n").unwrap();
    let (code, _, err) = cantap(&directory, &["convert", "broken.csv", "out.log"]);
    assert_eq!(code, Some(1), "{err}");
    assert_eq!(fs::read_to_string(directory.join("out.log")).unwrap(), "older\n");
    // A trace without any frame is still a trace, and replaces the older one.
    fs::write(directory.join("empty.log"), "").unwrap();
    let (code, _, err) = cantap(&directory, &["convert", "empty.log", "out.log"]);
    assert_eq!((code, err.as_str()), (Some(0), "cantap: note: the file is empty (1)\n"));
    assert_eq!(fs::read_to_string(directory.join("out.log")).unwrap(), "");
    assert_eq!(fs::read_dir(&directory).unwrap().count(), 3, "nothing temporary is left");
}

/// As with every command that writes a file, a failed run leaves the older one. What comes from a pipe exists nowhere else, and is
/// kept.
#[test]
fn a_strict_end_leaves_the_older_output_and_keeps_what_came_from_a_pipe() {
    let directory = directory("strict");
    let log = "(1.000000) can0 123#11\nrubbish\n(2.000000) can0 123#11\n";
    fs::write(directory.join("in.log"), log).unwrap();
    for output in ["out.log", "out.blf", "new.asc.gz", "new.parquet"] {
        let is_older = output.starts_with("out");
        if is_older {
            fs::write(directory.join(output), "older\n").unwrap();
        }
        let (code, _, err) = cantap(&directory, &["convert", "in.log", output, "--strict"]);
        assert_eq!(code, Some(1), "{output}: {err}");
        let left = fs::read_to_string(directory.join(output)).ok();
        assert_eq!(left.as_deref(), is_older.then_some("older\n"), "{output}");
    }
    let (code, _, err) = cantap(&directory, &["convert", "in.log", "out.log", "--strict"]);
    assert!(code == Some(1) && err.contains("line 2") && err.contains("out.log was not written"), "{err}");
    assert_eq!(fs::read_dir(&directory).unwrap().count(), 3, "nothing temporary is left");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(["convert", "-", "piped.log", "--strict"]).current_dir(&directory);
    let input = fs::File::open(directory.join("in.log")).unwrap();
    assert_eq!(command.stdin(input).output().unwrap().status.code(), Some(1));
    assert_eq!(fs::read_to_string(directory.join("piped.log")).unwrap(), "(1.000000) can0 123#11\n");
}

/// Only formats without a header can have files of zero bytes; that a file is empty is reported.
#[test]
fn an_empty_file_is_an_empty_trace_only_where_the_format_has_no_head() {
    let directory = directory("empty");
    for name in ["a.log", "a.log.gz"] {
        fs::write(directory.join(name), "").unwrap();
        for command in ["stats", "convert"] {
            let out = if command == "convert" { &["out.log"][..] } else { &[] };
            let (code, _, err) = cantap(&directory, &[&[command, name], out].concat());
            assert_eq!((code, err.as_str()), (Some(0), "cantap: note: the file is empty (1)\n"), "{name}");
        }
    }
    for suffix in ["asc", "blf", "trc", "csv", "pcapng", "pcap", "mf4", "dif", "asc.zst", "db"] {
        let name = format!("a.{suffix}");
        fs::write(directory.join(&name), "").unwrap();
        let (code, _, err) = cantap(&directory, &["stats", &name]);
        assert_eq!(code, Some(1), "{name}: {err}");
        assert!(err.contains(&format!("nothing in {name} could be read")), "{err}");
        assert!(err.contains("it looks like an empty file"), "{err}");
    }
    // What we write for an empty trace has its header.
    for suffix in ["log", "asc", "blf", "trc", "csv", "pcapng", "mf4", "dif", "asc.zst", "blf.gz"] {
        let name = format!("written.{suffix}");
        assert_eq!(cantap(&directory, &["convert", "a.log", &name]).0, Some(0), "{name}");
        let (code, out, err) = cantap(&directory, &["stats", &name]);
        assert_eq!(code, Some(0), "{name}: {err}");
        assert!(out.contains("0 frames"), "{name}: {out}");
    }
}

/// The live view shows what it can; used in a script, it reports that there was nothing.
#[test]
fn one_screen_of_a_file_that_could_not_be_read_is_no_success() {
    let directory = directory("once");
    fs::write(directory.join("diary.log"), "dear diary\n").unwrap();
    let (code, out, err) = cantap(&directory, &["monitor", "--once", "diary.log"]);
    assert_eq!(code, Some(1), "{err}");
    assert!(out.contains("1 unreadable"), "{out}");
    assert!(err.contains("nothing of the trace could be read: diary.log, line 1: expected"), "{err}");
}

#[test]
fn content_decides_where_it_is_clear_and_from_overrides() {
    let directory = directory("content");
    let log = "(1410714882.000000) can0 123#1122\n(1410714883.000000) can1 1F334455#AA T\n";
    fs::write(directory.join("a.log"), log).unwrap();
    for (format, wrong) in
        [("asc", "as.log"), ("blf", "is.asc"), ("pcapng", "is.log"), ("candump", "is.trc"), ("trc", "is.csv")]
    {
        let (code, _, err) = cantap(&directory, &["convert", "a.log", wrong, "--format", format]);
        assert_eq!(code, Some(0), "{err}");
        let (code, out, err) = cantap(&directory, &["convert", wrong, "-"]);
        assert_eq!((code, out.as_str()), (Some(0), log), "{wrong}: {err}");
        assert!(err.contains(&format!("{wrong} is read as {format}, which its content is")), "{err}");
        assert!(err.contains("--from overrides"), "{err}");
        let (code, out, err) = cantap(&directory, &["convert", wrong, "-", "--from", "dif"]);
        assert_eq!((code, out.as_str()), (Some(1), ""), "{wrong}: {err}");
    }
    // The logs of other programs, too, except with their usual names.
    let printed = "Timestamp: 1410714882.000000    ID:      123    S Rx                DL:  2    11 22     Channel: can0\n";
    let shown = " (1410714882.000000)  can0  123   [2]  11 22\n";
    for (name, text, format) in [
        ("printed.txt", printed, None),
        ("printed.asc", printed, Some("printer")),
        ("shown.log", shown, None),
        ("shown.blf", shown, Some("candump-screen")),
    ] {
        fs::write(directory.join(name), text).unwrap();
        let (code, out, err) = cantap(&directory, &["convert", name, "-"]);
        assert_eq!((code, out.as_str()), (Some(0), "(1410714882.000000) can0 123#1122\n"), "{name}: {err}");
        let note = format.map(|format| format!("{name} is read as {format}, which its content is"));
        assert!(note.map_or(err.is_empty(), |note| err.contains(&note)), "{name}: {err}");
    }
    fs::copy(directory.join("a.log"), directory.join("name.xyz")).unwrap();
    fs::write(directory.join("rubbish.xyz"), "rubbish\n").unwrap();
    let (code, _, err) = cantap(&directory, &["stats", "rubbish.xyz"]);
    assert!(code == Some(1) && err.contains("name it with one of --from "), "{err}");
}

/// Well-formed captures and measurements without any CAN traffic.
#[test]
fn a_file_without_traffic_of_can_is_no_success_and_says_what_is_in_it() {
    let directory = directory("without_can");
    let word = |value: u32| value.to_le_bytes();
    let head = [0xA1B2_C3D4, 0x0004_0002, 0, 0, 65535, 1].map(word).concat();
    let packet = [[1_700_000_000, 0, 60, 60].map(word).concat(), vec![0; 60]].concat();
    fs::write(directory.join("ethernet.pcap"), [head, packet.clone(), packet].concat()).unwrap();
    for command in [&["stats", "ethernet.pcap"][..], &["convert", "ethernet.pcap", "out.log"]] {
        let (code, _, err) = cantap(&directory, command);
        assert_eq!(code, Some(1), "{err}");
        let says = "it looks like pcap without traffic of CAN: packets that are not SocketCAN (2)";
        assert!(err.contains(says), "{err}");
    }
    assert!(!directory.join("out.log").exists());
}

#[test]
fn what_is_left_out_is_told_by_kind_with_its_share_and_is_in_the_json() {
    let directory = directory("left_out");
    let head = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\ninternal events logged\n";
    let frames = "0.1 1 123 Rx d 1 11\n".repeat(6);
    let lin = "0.2 L1 WakeupReq\n".repeat(3);
    let broken = "0.3 1 12G Rx d 0\n";
    fs::write(directory.join("mixed.asc"), format!("{head}{frames}{lin}{broken}")).unwrap();
    let words = "1 place could not be read; no part of a CAN trace: LIN events other than frames (3); 40.0 % of the file left out";
    let (code, out, err) = cantap(&directory, &["stats", "mixed.asc"]);
    assert_eq!(code, Some(0));
    assert!(out.contains(&format!("not in these figures: {words}")), "{out}");
    assert!(err.contains(words), "{err}");
    for arguments in [
        &["stats", "mixed.asc", "--json"][..],
        &["convert", "mixed.asc", "out.log", "--json"],
        &["diff", "mixed.asc", "mixed.asc", "--json"],
    ] {
        let (_, out, _) = cantap(&directory, arguments);
        let object: serde_json::Value = serde_json::from_str(&out).unwrap();
        let times = if arguments[0] == "diff" { 2 } else { 1 };
        assert_eq!(object["issues"], times, "{out}");
        assert_eq!(object["left_out"]["LIN events other than frames"], 3 * times, "{out}");
        let share = &object["missing_pct"];
        let share = share.as_f64().or_else(|| share[0].as_f64()).unwrap();
        assert!((share - 40.0).abs() < 1e-9, "{out}");
    }
}

#[test]
fn fd_frames_have_their_load_only_with_the_data_bit_rate() {
    let directory = directory("fd");
    // 17 bits of arbitration, with no stuff bit in it, and 12 after the data phase; 500 kbit/s, one frame per
    // millisecond.
    let frame = format!("2AA##1{}", "AA".repeat(64));
    let line = |at: u32| format!("(1.{:06}) can0 {frame}\n", at * 1000);
    fs::write(directory.join("fd.log"), (0..10).map(line).collect::<String>()).unwrap();
    let load = |arguments: &[&str]| {
        let (code, out, err) = cantap(&directory, &[&["stats", "fd.log", "--json"], arguments].concat());
        assert_eq!(code, Some(0), "{err}");
        let object: serde_json::Value = serde_json::from_str(&out).unwrap();
        (object["channels"][0]["bus_load_pct"].as_f64(), object["channels"][0]["fd"].as_u64())
    };
    assert_eq!(load(&["-b", "500k"]), (None, Some(10)));
    let (_, out, _) = cantap(&directory, &["stats", "fd.log", "-b", "500k"]);
    assert!(
        out.contains("10 frames (10 with a switched bit rate") && out.contains("--data-bitrate"),
        "{out}"
    );
    let (_, out, _) = cantap(&directory, &["bits", &frame, "-b", "500k", "--data-bitrate", "2M", "--json"]);
    let bits: serde_json::Value = serde_json::from_str(&out).unwrap();
    // 5 + 512 + 4 + 21 + 7 + 1, plus the stuff bits that the length code 1111 causes with its neighbours.
    let (nominal, data) = (bits["nominal_bits"].as_u64().unwrap(), bits["data_phase_bits"].as_u64().unwrap());
    assert_eq!((nominal, data), (29, 550 + bits["stuff_bits"].as_u64().unwrap()));
    let expected = (nominal as f64 / 500e3 + data as f64 / 2e6) / 1e-3 * 100.0;
    let (found, _) = load(&["-b", "500k", "--data-bitrate", "2M"]);
    assert!((found.unwrap() - expected).abs() < 1e-6, "{found:?} {expected}");
    let (found, _) = load(&["-b", "500k", "--data-bitrate", "1:4M", "--data-bitrate", "2M"]);
    assert!(found.unwrap() < expected, "{found:?}");
}

/// They were counted by kind, and nobody saw them.
#[test]
fn frames_of_lin_are_kept_shown_and_found() {
    let directory = directory("lin");
    let head = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\ninternal events logged\n";
    let lines = "0.1 1 123 Rx d 1 11\n0.2 Li 3c Rx 2 01 ff  checksum = fe\n0.3 L2 0a TransmErr\n0.4 1 123 Rx d 1 12\n";
    fs::write(directory.join("mixed.asc"), format!("{head}{lines}")).unwrap();
    let run = |line: &str| {
        let (code, out, err) = cantap(&directory, &line.split(' ').collect::<Vec<_>>());
        assert_eq!(code, Some(0), "{line}: {out}{err}");
        (out, err)
    };
    let (out, _) = run("stats mixed.asc");
    assert!(out.starts_with("2 frames in"), "{out}");
    assert!(out.contains("beside them 2 LIN frames, which are in no other figure"), "{out}");
    let found = ["lin0 LIN frame 3C: 01 FF, checksum FE", "lin1 LIN frame 0A: no response"];
    for file in ["mixed.blf", "mixed.mf4", "mixed.parquet", "mixed.csv", "mixed.asc"] {
        if file != "mixed.asc" {
            let kind = if file.ends_with("csv") { " --to csv-full" } else { "" };
            let (_, err) = run(&format!("convert mixed.asc {file}{kind}"));
            assert!(!err.contains("LIN"), "{file}: {err}");
        }
        let (out, _) = run(&format!("search {file} lin"));
        assert!(out.lines().count() == 2 && found.iter().all(|line| out.contains(line)), "{file}: {out}");
    }
    let (_, err) = run("convert mixed.asc mixed.log");
    assert!(err.contains("LIN frames, which this format has no form for (2)"), "{err}");
    let (out, _) = run("convert mixed.asc can.asc --filter can0");
    assert!(!fs::read_to_string(directory.join("can.asc")).unwrap().contains("Li "), "{out}");
}
