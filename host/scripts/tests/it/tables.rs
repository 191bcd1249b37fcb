//! Tests of tables, files for them, and the frames around a failure.

use std::path::Path;

use cantap_scripts::{Outcome, Report, Script};

use super::{bench, failure, run, run_on, script};

fn outcomes(report: &Report) -> Vec<(&str, &str)> {
    let outcome = |outcome| match outcome {
        &Outcome::Passed => "passed",
        Outcome::Failed(reason) => reason.as_str(),
    };
    report.tests.iter().map(|test| (test.name.as_str(), outcome(&test.outcome))).collect()
}

#[test]
fn each_row_of_a_table_is_a_test_of_its_own() {
    let source = r#"
        let factor = 2;
        test("doubles", [#{ of: 1, twice: 2 }, #{ of: 3, twice: 7 }, #{ of: 4, twice: 8 }], |row| {
            log(`${row.of}`);
            check(row.of * factor == row.twice, `${row.of} doubled`);
        });
        test("plain", [5, "six"], |row| log(row));
        fn setup() { log("setup"); }
        fn teardown() { log("teardown"); }
        fn test_first() { log("first"); }
    "#;
    let (report, _, lines) = run(1, &[script("a", source)]);
    assert_eq!(
        outcomes(&report),
        [
            ("test_first", "passed"),
            ("doubles[1]", "passed"),
            ("doubles[2]", "line 5: not so: 3 doubled, with #{\"of\": 3, \"twice\": 7}"),
            ("doubles[3]", "passed"),
            ("plain[1]", "passed"),
            ("plain[2]", "passed"),
        ]
    );
    let texts: Vec<&str> = lines.iter().map(|line| line.split_once(": ").unwrap().1).collect();
    assert_eq!(texts[..5], ["setup", "first", "teardown", "setup", "1"]);
    assert_eq!(texts.len(), 18);
    let junit = report.junit();
    assert!(junit.contains("tests=\"6\" failures=\"1\"") && junit.contains("name=\"doubles[2]\""), "{junit}");
}

/// A run that was over too soon says nothing of them.
#[test]
fn rows_that_a_run_did_not_come_to_have_failed() {
    let source = "test(\"t\", [1, 2, 3], |row| wait(\"400ms\"));";
    let (report, _, _) = run(1, &[script("a", source), script("b", "every(\"1s\", || 0);")]);
    let began = ("t[3]", "the run was over, after 1 s, before it had ended");
    assert_eq!(outcomes(&report), [("t[1]", "passed"), ("t[2]", "passed"), began]);
    // Also one that did not come to make them.
    let (report, _, _) = run(1, &[script("a", "wait(\"5s\"); test(\"t\", [1], |row| 0);")]);
    assert!(failure(&report).contains("before the script had made its tests"), "{report:?}");
    // Whoever has none in the end goes on as a node.
    let none = "if now() > 1.0 { test(\"t\", [1], |row| 0); } every(\"100ms\", || send(\"123#\"));";
    let (report, records, _) = run(1, &[script("a", none)]);
    assert!(report.is_success() && records.len() == 9, "{report:?}");
}

#[test]
fn tables_that_test_nothing_are_refused() {
    for (source, reason) in [
        ("test(\"t\", [], |row| 0);", "has no rows"),
        ("test(\"t\", [1], |row| 0); test(\"t\", [2], |row| 0);", "a test t[1] already"),
        ("after(\"1ms\", || test(\"t\", [1], |row| 0));", "own lines"),
        ("let a = []; a.pad(9000, 0); test(\"t\", a, |row| 0);", "8192 tests"),
    ] {
        let (report, _, _) = run(1, &[script("a", source)]);
        assert!(!report.is_success() && failure(&report).contains(reason), "{source}: {report:?}");
    }
}

#[test]
fn a_failure_has_what_came_after_it_up_to_a_bound() {
    let node = script("node", "periodic(\"100#00\", \"10ms\");");
    // The last test: the run goes on for what follows.
    let tester = script("tester", "fn test_a() { wait(\"25ms\"); fail(\"no\"); }");
    let (report, records, _) = run(10, &[node, tester]);
    let test = &report.tests[0];
    assert_eq!((test.trace.len(), test.trace_after.len()), (3, 10), "{test:?}");
    assert_eq!((test.ended_ns, report.duration_ns, records.len()), (25_000_000, 125_000_000, 13));
    let lines: Vec<&str> = test.trace_lines().collect();
    assert_eq!(lines[3], "--- failed here ---");
    assert!(lines[2].starts_with("(0.020") && lines[4].starts_with("(0.030"), "{lines:?}");
    // On a full bus, twenty frames; and what a passed test is followed by is no one's.
    let tester = script("t", "fn test_a() { wait(\"25ms\"); fail(\"no\"); } fn test_b() { wait(\"1s\"); }");
    let (report, _, _) = run_on(&bench("load=100", 10), &[tester]);
    let lens: Vec<usize> = report.tests.iter().map(|test| test.trace_after.len()).collect();
    assert_eq!(lens, [20, 0]);
    // On a silent bus, nothing is waited for.
    let (report, _, _) = run(10, &[script("t", "fn test_a() { wait(\"25ms\"); fail(\"no\"); }")]);
    assert_eq!((report.tests[0].trace_after.len(), report.tests[0].trace.len()), (0, 0));
}

fn run_in(folder: &Path, scripts: &[Script]) -> (Report, Vec<String>) {
    let mut granted = bench("load=0", 1);
    granted.readable = Some(folder.to_owned());
    let (report, _, lines) = run_on(&granted, scripts);
    (report, lines)
}

#[test]
fn rows_come_from_a_file_in_a_granted_folder() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rows.csv"), "speed,frame\n80,123#50\n0xFF,123#FE\n").unwrap();
    let source = r#"
        test("speed", csv("rows.csv"), |row| check(frame(row.frame).data[0] == row.speed, "as it is sent"));
        log(read("rows.csv").len());
    "#;
    let (report, lines) = run_in(folder.path(), &[script("a", source)]);
    let failed = ("speed[2]", "line 2: not so: as it is sent, with #{\"frame\": \"123#FE\", \"speed\": 255}");
    assert_eq!(outcomes(&report), [("speed[1]", "passed"), failed]);
    assert!(lines[0].ends_with(": 34"), "{lines:?}");
    // Nobody else has been granted it.
    let (report, _, _) = run(1, &[script("a", source)]);
    assert!(failure(&report).contains("--allow-read"), "{report:?}");
}

/// What an attacker's script would try.
#[test]
fn a_granted_folder_opens_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("granted")).unwrap();
    std::fs::write(folder.path().join("secret"), "secret").unwrap();
    std::fs::write(folder.path().join("granted/table.csv"), ",".repeat((1 << 20) + 1)).unwrap();
    std::fs::write(folder.path().join("granted/many.csv"), "a\n".repeat(1 << 19)).unwrap();
    std::fs::write(folder.path().join("granted/large"), "x".repeat(1 << 24)).unwrap();
    let granted = folder.path().join("granted");
    let error = |source: &str| {
        let (report, _) = run_in(&granted, &[script("a", source)]);
        failure(&report)
    };
    for path in
        ["../secret", "/etc/passwd", "..", "", "./../secret", "x/../../secret", "a\\x00b", "~/.ssh/id_rsa"]
    {
        for function in ["read", "csv"] {
            let reason = error(&format!("log({function}(\"{path}\"));"));
            let is_refused = ["granted folder", "cannot read"].iter().any(|why| reason.contains(why));
            assert!(is_refused && !reason.contains("root:"), "{path}: {reason}");
        }
    }
    let columns: Vec<String> = (0..150_000).map(|column| format!("{column:x}")).collect();
    std::fs::write(granted.join("wide.csv"), columns.join(",")).unwrap();
    let (report, _) = run_in(&granted, &[script("a", "csv(\"wide.csv\");")]);
    assert!(report.is_success(), "{report:?}");
    std::fs::remove_file(granted.join("wide.csv")).unwrap();
    assert!(error("csv(\"table.csv\");").contains("too much for a table"));
    // Its values are counted as all others are.
    let reason = error("let all = []; for i in 0..100 { all.push(csv(\"many.csv\")); }");
    assert!(
        ["too much memory", "too large", "computed for too long"].iter().any(|why| reason.contains(why)),
        "{reason}"
    );
    let reason = error("let all = []; for i in 0..100 { all.push(steps([read(\"large\")])); }");
    assert!(["too much memory", "computed for too long"].iter().any(|why| reason.contains(why)), "{reason}");
    // No other way has opened.
    let unknown = error("write(\"a\", \"b\");");
    assert!(unknown.contains("write"), "{unknown}");
    assert_eq!(std::fs::read_dir(&granted).unwrap().count(), 3);
}
