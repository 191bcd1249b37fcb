//! `cantap capture --rotate`, ended by a request and by SIGKILL: every file of the series is valid on its
//! own.

#![cfg(unix)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use cantap_formats::{Fault, ReadIssue, ReadOptions, open_reader};

const BUS: [&str; 6] = ["capture", "-d", "virtual:load=60,frames=std8", "-b", "500k", "-o"];

fn cantap() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The files in a folder by name.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// The number of records in a file; nothing may be wrong with it.
fn records(path: &Path) -> usize {
    let reader = open_reader(path, &ReadOptions::default()).unwrap();
    reader.collect::<Result<Vec<_>, _>>().unwrap().len()
}

/// Like [`records`], for a file that was being written: the system may have been stopped between two of its pages. Then the
/// cut is reported, and nothing else is wrong.
fn records_of_the_last(path: &Path) -> usize {
    if path.metadata().unwrap().len() == 0 {
        // Created, and killed before anything was written.
        return 0;
    }
    let items: Vec<_> = open_reader(path, &ReadOptions::default()).unwrap().collect();
    let issues: Vec<_> = items.iter().filter_map(|item| item.as_ref().err()).collect();
    assert!(matches!(issues[..], [] | [ReadIssue { fault: Fault::Truncated(_), .. }]), "{issues:?}");
    items.len() - issues.len()
}

#[test]
fn files_of_a_second_each_are_kept_up_to_a_number_and_all_frames_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.log");
    let limits = ["-t", "3500ms", "--rotate", "1s", "--keep", "2", "--json"];
    let output = cantap().args(BUS).arg(&file).args(limits).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let names: Vec<_> = files(folder.path())
        .iter()
        .map(|path| path.file_name().unwrap().to_str().unwrap().to_owned())
        .collect();
    assert!(names.len() == 2 && names.iter().all(|name| name.starts_with("drive-00000")), "{names:?}");
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let frames = |channel: usize| summary["channels"][channel]["frames"].as_u64().unwrap() as usize;
    let kept: usize = files(folder.path()).iter().map(|path| records(path)).sum();
    assert!(kept > 1000 && kept < frames(0) + frames(1), "{kept} of {summary}");
}

#[test]
fn a_capture_that_is_killed_leaves_files_that_are_each_whole() {
    for name in ["a.log", "a.blf", "a.pcapng", "a.asc", "a.trc", "a.dif", "a.csv.gz", "a.log.zst"] {
        let folder = tempfile::tempdir().unwrap();
        let mut capture =
            cantap().args(BUS).arg(folder.path().join(name)).args(["--rotate", "40k"]).spawn().unwrap();
        let deadline = Instant::now() + Duration::from_secs(30);
        while files(folder.path()).len() < 3 {
            assert!(Instant::now() < deadline, "{name}: nothing was captured");
            std::thread::sleep(Duration::from_millis(5));
        }
        // This sends SIGKILL.
        capture.kill().unwrap();
        capture.wait().unwrap();
        let paths = files(folder.path());
        for (at, path) in paths.iter().enumerate() {
            let size = path.metadata().unwrap().len();
            assert!(size <= 40_000, "{}: {size} bytes", path.display());
            let is_last = at + 1 == paths.len();
            // The last one may have been created just before.
            let records = if is_last { records_of_the_last(path) } else { records(path) };
            assert!(is_last || records > 50, "{}", path.display());
            assert!(size == 0 || records > 0, "{}", path.display());
        }
    }
}
