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
    for (name, script) in
        ["speed.rhai", "tester.rhai", "table.rhai", "dash.rhai", "missing.rhai"].iter().zip(scripts)
    {
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
fn the_pages_examples_print_what_the_page_shows() {
    let folder = documented();
    std::fs::create_dir(folder.path().join("limits")).unwrap();
    std::fs::write(folder.path().join("limits/sensors.csv"), "name,low,high\noil,110,90\n").unwrap();
    let page =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scripts.md")).unwrap();
    for (line, code) in [
        ("speed.rhai tester.rhai", 0),
        ("table.rhai --allow-read limits", 1),
        ("node:engine dash.rhai missing.rhai", 0),
    ] {
        let output = run(folder.path(), &line.split(' ').collect::<Vec<_>>());
        assert_eq!(output.status.code(), Some(code), "{output:?}");
        let shown = page.split(&format!("$ cantap run {line}\n")).nth(1).unwrap();
        assert_eq!(text(&output.stdout), shown.split("```").next().unwrap());
    }
}

/// What the bus's options let go wrong is what the functions do, and what cannot is refused before the run.
#[test]
fn the_bus_goes_wrong_at_its_times() {
    let folder = documented();
    let waits = "fn test_it() { wait(\"2s\"); expect(\"3A0\", \"500ms\", |f| f.data[0] == 1); }";
    std::fs::write(folder.path().join("waits.rhai"), waits).unwrap();
    let nodes = ["node:engine", "dash.rhai", "waits.rhai"];
    let with = |bus: &str| run(folder.path(), &[&nodes[..], &["--bus", bus]].concat());
    assert!(with("power_off=engine@2s").status.success());
    assert_eq!(with("load=5").status.code(), Some(1));
    for (bus, reason) in [
        ("power_off=motor@2s", "there is no node motor; there are engine, dash, waits"),
        ("power_off=waits@2s", "has tests"),
        ("power_off=2s", "write it as power_off=engine@1s+500ms"),
        ("explode=2s", "error_burst, bus_off, power_off, stall, lose"),
    ] {
        let output = with(bus);
        assert!(!output.status.success() && text(&output.stderr).contains(reason), "{bus}: {output:?}");
        assert!(output.stdout.is_empty(), "{output:?}");
    }
    let output = run(folder.path(), &["table.rhai", "--allow-read", "nowhere"]);
    assert!(text(&output.stderr).contains("--allow-read nowhere: there is no such folder"), "{output:?}");
}

#[test]
fn explain_prints_what_the_page_shows_and_runs_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let source = "periodic(\"100#00\", \"10ms\");\non_frame(\"7DF\", |f| send(\"7E8#00\"));\n";
    std::fs::write(folder.path().join("node.rhai"), source).unwrap();
    let output = run(folder.path(), &["--explain", "node.rhai", "-d", "virtual"]);
    assert!(output.status.success(), "{output:?}");
    let page =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/scripts.md")).unwrap();
    let shown = page
        .split("$ cantap run --explain node.rhai -d virtual\n")
        .nth(1)
        .and_then(|rest| rest.split("```").next())
        .unwrap();
    assert_eq!(text(&output.stdout), shown);
    let simulated = run(folder.path(), &["--explain", "node.rhai", "node:engine"]);
    let lines = text(&simulated.stdout);
    assert!(lines.contains("node.rhai:1: periodic: simulation: exactly, in simulated time\n"), "{lines}");
    let is_called =
        |line: &str| line.starts_with("node:engine:") && line.contains("; called by every of line ");
    assert!(lines.lines().any(is_called), "{lines}");
    std::fs::write(folder.path().join("bad.rhai"), "send(").unwrap();
    assert!(!run(folder.path(), &["--explain", "bad.rhai"]).status.success());
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

#[cfg(unix)]
#[test]
fn keys_typed_at_a_terminal_reach_a_script_and_the_terminal_is_given_back() {
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("keys.rhai");
    std::fs::write(&script, "on_key(|key| log(\"typed \" + key)); log(\"begun\");").unwrap();
    let line = format!("run {} -d virtual:load=0 -b 500k", script.display());
    let mut terminal = crate::terminal::Terminal::start(&line, (120, 24));
    terminal.wait_for("begun");
    terminal.keys("x");
    terminal.wait_for("typed x");
    assert!(!terminal.is_as_a_shell_wants_it());
    terminal.keys("\x03");
    assert_eq!(terminal.end(), 130);
    assert!(terminal.is_as_a_shell_wants_it());
}

#[test]
fn without_a_terminal_no_keys_come_and_it_says_so() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("keys.rhai"), "on_key(|key| log(\"typed \" + key));").unwrap();
    let output = run(folder.path(), &["keys.rhai", "-d", "virtual:load=0", "-b", "500k", "--for", "50ms"]);
    assert!(output.status.success(), "{output:?}");
    assert!(
        text(&output.stderr).contains("keys.rhai: standard input is no terminal; run it in one"),
        "{output:?}"
    );
    let output = run(folder.path(), &["keys.rhai", "--for", "3s"]);
    assert!(text(&output.stderr).contains("as in --keys 1s:a,2s:b"), "{output:?}");
    let output = run(folder.path(), &["keys.rhai", "--for", "3s", "--keys", "1s:a,2s:\u{e4}"]);
    let typed = text(&output.stdout);
    assert!(
        typed.contains("1.000000 keys.rhai: typed a\n")
            && typed.contains("2.000000 keys.rhai: typed \u{e4}\n"),
        "{typed}"
    );
    for (bad, reason) in
        [("1s", "1s is no key; write 1s:a"), ("1s:ab", "\"ab\" is not one key"), ("x:a", "x")]
    {
        let output = run(folder.path(), &["keys.rhai", "--keys", bad]);
        assert_eq!(output.status.code(), Some(2));
        assert!(text(&output.stderr).contains(reason), "{output:?}");
    }
}

#[test]
fn ready_nodes_are_listed_printed_and_run_as_printed() {
    let folder = tempfile::tempdir().unwrap();
    let listed = text(&run(folder.path(), &["--nodes"]).stdout);
    let names: Vec<&str> = listed.lines().map(|line| line.split(' ').next().unwrap()).collect();
    assert_eq!(names, ["node:boat", "node:drive", "node:engine", "node:obd", "node:valves"]);
    let printed = run(folder.path(), &["--print", "node:engine"]);
    std::fs::write(folder.path().join("mine.rhai"), &printed.stdout).unwrap();
    for (node, log) in [("mine.rhai", "mine.log"), ("node:engine", "ready.log")] {
        let output = run(folder.path(), &[node, "--for", "2s", "-o", log]);
        assert!(output.status.success(), "{output:?}");
    }
    let log = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    assert_eq!(log("mine.log"), log("ready.log"));
    assert!(log("ready.log").len() > 5000);
    assert!(text(&run(folder.path(), &["--print", "node:drive.eds"]).stdout).contains("[6040]"));
    for (arguments, reason) in [
        (&["node:car"][..], "there is no ready node \"car\"; there are boat"),
        (&["--print", "car"], "there is no ready node"),
        (&["--print", "node:obd.eds"], "there is no sheet of a ready node \"obd\"; there are drive"),
        (&["node:obd?x"], "write settings as in node:obd?name=value"),
    ] {
        let output = run(folder.path(), arguments);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(text(&output.stderr).contains(reason), "{output:?}");
    }
    let output = run(folder.path(), &["node:obd?colour=red", "--for", "1s"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(text(&output.stdout).contains("it has no setting colour; it has codes"), "{output:?}");
}

#[test]
fn a_place_where_no_results_can_be_written_is_refused_before_the_run() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.rhai"), "log(\"begun\"); fn test_a() {}").unwrap();
    for place in [".", "nowhere/report.xml"] {
        let output = run(folder.path(), &["a.rhai", "--junit", place]);
        assert!(!output.status.success() && output.stdout.is_empty(), "{output:?}");
        assert!(text(&output.stderr).contains(&format!("cannot write {place}: ")), "{output:?}");
    }
    // A device, as if the disk were full: the results are at least shown.
    #[cfg(target_os = "linux")]
    {
        let output = run(folder.path(), &["a.rhai", "--junit", "/dev/full"]);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        assert!(text(&output.stdout).contains("1 passed"), "{output:?}");
    }
}

#[test]
fn a_test_that_the_run_did_not_wait_for_is_no_success() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.rhai"), "fn test_a() { wait(\"2s\"); }").unwrap();
    let output = run(folder.path(), &["a.rhai", "--for", "1s"]);
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(text(&output.stdout).contains("the run was over, after 1 s, before it had ended"), "{output:?}");
}
