//! `cantap run`: scripts on simulated buses and on the virtual device.

use std::path::Path;
use std::process::{Command, Output};

/// The scripts of docs/scripts.md, as they stand there, in a folder.
fn documented() -> tempfile::TempDir {
    let page =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scripts.md")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let scripts: Vec<&str> =
        page.split("```rhai\n").skip(1).map(|rest| rest.split("```").next().unwrap()).collect();
    for (name, script) in ["speed.rhai", "tester.rhai"].iter().zip(scripts) {
        std::fs::write(folder.path().join(name), script).unwrap();
    }
    folder
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

fn run(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cantap"))
        .arg("run")
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

#[test]
fn the_pages_example_prints_what_the_page_shows() {
    let folder = documented();
    let output = run(folder.path(), &["speed.rhai", "tester.rhai"]);
    assert!(output.status.success(), "{output:?}");
    let page =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scripts.md")).unwrap();
    let shown =
        page.split("$ cantap run speed.rhai tester.rhai\n").nth(1).unwrap().split("```").next().unwrap();
    assert_eq!(text(&output.stdout), shown);
}

#[test]
fn a_failed_test_is_exit_code_1_with_its_frames_a_trace_and_junit() {
    let folder = documented();
    let output = run(folder.path(), &["tester.rhai", "--junit", "report.xml", "-o", "run.log", "--json"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let lines: Vec<serde_json::Value> =
        text(&output.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(
        (lines.len(), &lines[0]["passed"], &lines[1]["summary"]["failed"]),
        (2, &false.into(), &1.into())
    );
    assert!(lines[0]["text"].as_str().unwrap().contains("no frame 7E8 within 50ms"), "{lines:?}");
    let junit = std::fs::read_to_string(folder.path().join("report.xml")).unwrap();
    assert!(junit.contains("name=\"test_speed\"") && junit.contains("7DF#02010D"), "{junit}");
    let trace = std::fs::read_to_string(folder.path().join("run.log")).unwrap();
    assert_eq!(trace.lines().count(), 1);
    assert!(trace.ends_with(" can0 7DF#02010D\n"), "{trace}");
}

#[test]
fn the_same_test_passes_on_a_device_and_only_its_vehicle_answers() {
    let folder = tempfile::tempdir().unwrap();
    let source = "fn test_vin() { check(request(\"7E0\", \"7E8\", [0x22, 0xF1, 0x90]).len() == 20, \"17 characters\"); }";
    std::fs::write(folder.path().join("vin.rhai"), source).unwrap();
    for place in [&["--bus", "car"][..], &["-d", "virtual:car", "-b", "500k"]] {
        let output = run(folder.path(), &[&["vin.rhai"], place].concat());
        assert!(output.status.success() && text(&output.stdout).contains("1 passed"), "{place:?} {output:?}");
    }
    let output = run(folder.path(), &["vin.rhai", "-d", "virtual:load=0", "-b", "500k"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
}

#[test]
fn what_is_no_script_is_refused_before_anything_is_sent() {
    let folder = tempfile::tempdir().unwrap();
    let bad = |content: &[u8]| {
        std::fs::write(folder.path().join("bad.rhai"), content).unwrap();
        let output = run(folder.path(), &["bad.rhai", "-d", "virtual", "-b", "500k"]);
        assert!(!output.status.success());
        text(&output.stderr)
    };
    assert!(bad(b"let = 1;").contains("bad.rhai"));
    assert!(bad(b"\xff\xfe").contains("not text in UTF-8"));
    let output = run(folder.path(), &["missing.rhai"]);
    assert!(text(&output.stderr).contains("cannot read missing.rhai"));
}

#[test]
fn escapes_in_what_a_script_writes_do_not_reach_the_terminal() {
    let folder = tempfile::tempdir().unwrap();
    let source = "log(\"a\\x1b]0;title\\x07b\"); fn test_x() { fail(\"c\\x1b[2J\"); }";
    std::fs::write(folder.path().join("x.rhai"), source).unwrap();
    let output = run(folder.path(), &["x.rhai"]);
    assert!(text(&output.stdout).contains("title") && !output.stdout.contains(&0x1B), "{output:?}");
}
