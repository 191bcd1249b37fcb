//! A part of a trace by time: the same with an index and without, and counted from the trace's first record.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// Runs the command with this cache folder: exit code, output and messages.
fn cantap_in(cache: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.env("XDG_CACHE_HOME", cache).args(arguments).stdin(Stdio::null()).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// 33 MiB, which is long enough for an index: a frame each millisecond, and two lines that are none.
fn large_log() -> String {
    let mut log = String::new();
    for at in 0_u32.. {
        if log.len() > 33 << 20 {
            break;
        }
        let (s, ms, id) = (1_700_000_000 + at / 1000, at % 1000, 0x100 + at % 50);
        writeln!(log, "({s}.{ms:03}000) can0 {id:03X}#00112233{at:08X}").unwrap();
        if at == 100_000 || at == 500_000 {
            log.push_str("(lost)\n");
        }
    }
    log
}

#[test]
fn a_part_of_a_large_trace_is_the_same_with_an_index_and_without() {
    let folder = tempfile::tempdir().unwrap();
    let (path, cache) = (folder.path().join("large.log"), folder.path().join("cache"));
    fs::write(&path, large_log()).unwrap();
    let trace = path.to_str().unwrap();
    for arguments in [
        &["convert", trace, "-", "--start", "400", "--end", "402.5"][..],
        &["convert", trace, "-", "--start", "1700000499.9", "--end", "1700000500.1", "-f", "12C"],
        &["search", trace, "--id", "12C", "--start", "10m", "--end", "601"],
        &["stats", trace, "--start", "2023-11-14T22:20:00", "--end", "2023-11-14T22:20:01", "--json"],
    ] {
        let without = cantap_in(Path::new("/dev/null"), arguments);
        assert_eq!(without.0, Some(0), "{arguments:?}: {}", without.2);
        assert!(
            without.1.lines().count() > 0 && without.2.contains("100002"),
            "{arguments:?}: {}",
            without.2
        );
        // The first makes an index, which is not trusted at once; the second does.
        for _ in 0..2 {
            assert_eq!(cantap_in(&cache, arguments), without, "{arguments:?}");
        }
    }
    assert_eq!(fs::read_dir(cache.join("cantap/indexes")).unwrap().count(), 1);
}

/// Found while the index was made: with a filter, times counted from the first frame that passed it.
#[test]
fn times_count_from_the_first_record_whether_or_not_it_passes_the_filter() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.log");
    fs::write(&path, "(10.0) can0 100#\n(12.0) can0 200#\n(13.0) can0 200#\n").unwrap();
    let trace = path.to_str().unwrap();
    let nowhere = Path::new("/dev/null");
    let (code, out, err) = cantap_in(nowhere, &["convert", trace, "-", "--start", "3", "-f", "200"]);
    assert_eq!((code, out.as_str()), (Some(0), "(13.000000) can0 200#\n"), "{err}");
}

#[test]
fn a_range_is_for_a_trace_and_not_for_a_device() {
    let nowhere = Path::new("/dev/null");
    for command in ["stats", "search"] {
        let (code, _, err) = cantap_in(nowhere, &[command, "-d", "virtual", "--start", "1"]);
        assert_eq!(code, Some(2), "{command}: {err}");
    }
}

/// Found as a newcomer: an empty trace was written, or no frames were counted, without a word.
#[test]
fn a_range_in_which_there_is_nothing_is_told_from_a_trace_without_traffic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.log");
    fs::write(&path, "(10.0) can0 100#\n(12.5) can0 200#\n").unwrap();
    let trace = path.to_str().unwrap();
    let nowhere = Path::new("/dev/null");
    for command in [&["convert", trace, "-"][..], &["stats", trace], &["search", trace, "--id", "100"]] {
        let (_, _, err) = cantap_in(nowhere, &[command, &["--start", "1m"]].concat());
        let expected =
            "no record is between --start and --end; the trace's last one is 2.500 s after its first";
        assert!(err.contains(expected), "{command:?}: {err}");
        let (_, _, err) = cantap_in(nowhere, &[command, &["--start", "2"]].concat());
        assert_eq!(err, "", "{command:?}");
        let (code, _, err) = cantap_in(nowhere, &[command, &["--start", "10", "--end", "5"]].concat());
        assert!(code == Some(2) && err.contains("the end is not after the start"), "{command:?}: {err}");
    }
}

/// Found as a newcomer: the identifier 7E8 was a number that is true for every frame.
#[test]
fn an_identifier_in_place_of_a_condition_is_explained() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.log");
    fs::write(&path, "(10.0) can0 100#\n").unwrap();
    let (code, out, err) = cantap_in(Path::new("/dev/null"), &["search", path.to_str().unwrap(), "7E8"]);
    assert!(code == Some(2) && out.is_empty() && err.contains("id == 0x7E8"), "{out}{err}");
}
