//! `--follow` and `-` in every command that reads a trace: what has arrived is shown immediately, and Ctrl-C ends with the
//! summary.

#![cfg(unix)]

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};

const DATABASE: &str = "BO_ 291 Engine: 8 A\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"km/h\" A\n";

fn spawn(folder: &Path, arguments: &[&str]) -> Child {
    std::fs::write(folder.join("car.dbc"), DATABASE).unwrap();
    Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(arguments)
        .current_dir(folder)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn line(number: usize) -> String {
    format!("(170000000{number}.000000) can0 123#0{number}\n")
}

/// Ends a program as Ctrl-C does, and returns its output beyond what was already read.
fn interrupt(child: Child) -> (Option<i32>, String, String) {
    let status = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(status.unwrap().success());
    let output = child.wait_with_output().unwrap();
    (
        output.status.code(),
        String::from_utf8(output.stdout).unwrap(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

#[test]
fn what_is_appended_to_a_followed_file_is_shown_at_once() {
    for arguments in [
        &["decode", "--db", "car.dbc", "--follow", "a.log"][..],
        &["search", "--follow", "a.log", "--id", "123"],
        &["convert", "--follow", "a.log", "-"],
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.log");
        std::fs::write(&path, line(1)).unwrap();
        let mut child = spawn(folder.path(), arguments);
        let mut out = BufReader::new(child.stdout.take().unwrap());
        let mut file = OpenOptions::new().append(true).open(&path).unwrap();
        let mut shown = String::new();
        for number in 1..=3 {
            // A partial line is waited for.
            shown.clear();
            out.read_line(&mut shown).unwrap();
            assert!(
                shown.starts_with(&format!("(170000000{number}.000000) can0 123")),
                "{arguments:?}: {shown}"
            );
            append_in_two(&mut file, &line(number + 1));
        }
        let (code, _, err) = interrupt(child);
        assert_eq!(code, Some(0), "{arguments:?}: {err}");
    }
}

fn append_in_two(file: &mut File, line: &str) {
    let (first, rest) = line.split_at(20);
    file.write_all(first.as_bytes()).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(60));
    file.write_all(rest.as_bytes()).unwrap();
}

#[test]
fn statistics_of_a_followed_file_come_with_ctrl_c() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.log"), [line(1), line(2)].concat()).unwrap();
    let child = spawn(folder.path(), &["stats", "--follow", "a.log", "-b", "500k", "--json"]);
    // Long enough for it to have begun; before that, Ctrl-C would end it without a word.
    std::thread::sleep(std::time::Duration::from_secs(2));
    let (code, out, err) = interrupt(child);
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["frames"], 2);
}

#[test]
fn standard_input_is_read_as_it_comes() {
    for arguments in
        [&["decode", "--db", "car.dbc", "-"][..], &["search", "-", "--id", "123"], &["convert", "-", "-"]]
    {
        let folder = tempfile::tempdir().unwrap();
        let mut child = spawn(folder.path(), arguments);
        let mut to = child.stdin.take().unwrap();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        for number in 1..=3 {
            to.write_all(line(number).as_bytes()).unwrap();
            let mut shown = String::new();
            out.read_line(&mut shown).unwrap();
            assert!(
                shown.starts_with(&format!("(170000000{number}.000000) can0 123")),
                "{arguments:?}: {shown}"
            );
        }
        drop(to);
        assert!(child.wait().unwrap().success(), "{arguments:?}");
    }
}
