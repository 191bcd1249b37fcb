//! What scripts do on simulated buses.

use cantap_scripts::{Outcome, Script, ScriptError};
use cantap_trace::FrameBits;

use super::{bench, failure, run, run_on, script};

#[test]
fn a_request_of_one_script_is_answered_by_another_after_exactly_the_frames_bits() {
    let server = script(
        "server",
        r#"on_frame("7DF", |request| if request.data[2] == 0x0D { send("7E8#03410D50"); });"#,
    );
    let tester = script(
        "tester",
        r#"
        fn test_speed() {
            wait("10ms");
            send("7DF#02010D");
            let answer = expect("7E8", "50ms");
            check(answer.data == blob(4, 0) == false, "it has data");
            check(answer.data[3] == 0x50, "the speed is 80 km/h");
            log(answer.time);
        }
        "#,
    );
    let (report, records, lines) = run(10, &[server, tester]);
    assert!(report.is_success(), "{report:?}");
    assert_eq!(report.tests.len(), 1);
    assert_eq!(
        records.iter().map(|record| record.frame().unwrap().to_string()).collect::<Vec<_>>(),
        ["7DF#02010D", "7E8#03410D50"]
    );
    let request: cantap_trace::Frame = "7DF#02010D".parse().unwrap();
    let response: cantap_trace::Frame = "7E8#03410D50".parse().unwrap();
    // Both without the three bits after the last one, but those of the request are between them.
    let bits = u64::from(FrameBits::of(&request).total() + FrameBits::of(&response).total() - 3);
    assert_eq!(records[1].time_ns as u64, 10_000_000 + bits * 2000);
    assert_eq!(lines.len(), 1);
    assert_eq!((report.frames_sent, report.frames_received, report.frames_not_sent), (2, 2, 0));
}

#[test]
fn the_same_scripts_and_seed_give_the_same_run_to_the_bit_and_another_seed_does_not() {
    let scripts: Vec<Script> = (0..5)
        .map(|number| {
            let source = format!(
                "every(\"{}ms\", || send(frame(0x10{number}, [random(0, 255)])));\n\
                 on_frame(\"10{}\", |f| if f.data[0] < 16 {{ send(frame(0x20{number}, [f.data[0], random(0, 255)])); }});",
                number + 7,
                (number + 1) % 5
            );
            script(&format!("node {number}"), &source)
        })
        .collect();
    let first = run(20, &scripts);
    let again = run(20, &scripts);
    assert!(first.1.len() > 9_000, "{}", first.1.len());
    assert_eq!(first, again);
    let mut other = bench("load=0", 20);
    other.seed = 2;
    assert_ne!(run_on(&other, &scripts).1, first.1);
}

#[test]
fn repetitions_and_timers_keep_their_times_until_they_are_stopped() {
    let source = r#"
        let p = periodic("100#00", "10ms");
        let t = every("25ms", || send("200#"));
        after("95ms", || { stop(p); stop(t); });
        after("55ms", || change(p, frame("100#01")));
    "#;
    let (report, records, _) = run(1, &[script("a", source)]);
    assert!(report.is_success(), "{report:?}");
    let of = |text: &str| records.iter().filter(|record| record.frame().unwrap().to_string() == text).count();
    assert_eq!((of("100#00"), of("100#01"), of("200#")), (6, 4, 3));
    // Nothing of it can happen after that.
    assert_eq!(report.duration_ns, 95_000_000);
}

#[test]
fn signals_are_read_and_written_by_name() {
    let engine = script("engine", r#"every("10ms", || send("Engine", #{ Speed: 1000.25, Gear: "Drive" }));"#);
    let reader = script(
        "reader",
        r#"
        fn test_values() {
            check(value("Engine.Speed") == (), "nothing was on the bus yet");
            let frame = expect("Engine", "20ms", |f| signals(f).Speed > 1000.0);
            check(value("Engine.Speed") == 1000.25, "speed");
            check(signals(frame).Gear == 1.0, "gear");
            let seen = 0;
            on_message("Engine", |m| log(`${m.Speed} ${m.frame}`));
            wait("15ms");
        }
        "#,
    );
    let (report, _, lines) = run(1, &[engine, reader]);
    assert!(report.is_success(), "{report:?}");
    assert_eq!(lines.len(), 1, "{lines:?}");
    assert!(lines[0].ends_with("reader: 1000.25 100#A10F010000000000"), "{lines:?}");
}

#[test]
fn setup_and_teardown_run_around_each_test_and_a_failure_has_its_trace() {
    let source = r#"
        fn setup() { log("setup"); }
        fn teardown() { log("teardown"); }
        fn test_b() { send("123#42"); wait("1ms"); fail("as planned"); }
        fn test_a() { log("a"); }
    "#;
    let (report, _, lines) = run(1, &[script("s", source)]);
    let texts: Vec<&str> = lines.iter().map(|line| line.split_once(": ").unwrap().1).collect();
    assert_eq!(texts, ["setup", "teardown", "setup", "a", "teardown"]);
    assert_eq!(report.tests.iter().map(|test| test.name.as_str()).collect::<Vec<_>>(), ["test_b", "test_a"]);
    assert_eq!(failure(&report), "line 4: as planned");
    let trace = &report.tests[0].trace;
    assert!(trace.len() == 1 && trace[0].ends_with(") can0 123#42"), "{trace:?}");
    assert_eq!(report.tests[1].outcome, Outcome::Passed);
}

#[test]
fn a_diagnostic_request_reaches_a_server_of_the_virtual_vehicle() {
    let source = r#"
        fn test_vin() {
            wait("100ms");
            let answer = request("7E0", "7E8", [0x22, 0xF1, 0x90]);
            check(answer.len() == 20, "17 characters");
        }
        fn test_refused() { request("7E0", "7E8", [0x22, 0x12, 0x34]); }
        fn test_nobody() { request("7E5", "7ED", [0x3E, 0x00]); }
    "#;
    let (report, _, _) = run_on(&bench("car", 60), &[script("tester", source)]);
    let outcomes: Vec<&Outcome> = report.tests.iter().map(|test| &test.outcome).collect();
    assert_eq!(*outcomes[0], Outcome::Passed);
    assert!(
        matches!(outcomes[1], Outcome::Failed(reason) if reason.contains("negative response 31")),
        "{report:?}"
    );
    assert!(matches!(outcomes[2], Outcome::Failed(reason) if reason.contains("answer")), "{report:?}");
}

#[test]
fn errors_on_the_bus_reach_scripts() {
    let source = "on_error(|channel, kind| log(`${channel} ${kind}`));";
    let (_, _, lines) = run_on(&bench("load=10,errors=50", 1), &[script("a", source)]);
    assert!(lines.len() > 100 && lines.iter().any(|line| line.ends_with("1 stuff")), "{:?}", lines.first());
}

#[test]
fn a_script_that_is_none_is_refused_with_its_name_and_line() {
    let error =
        bench("load=0", 1).run(&[script("x.rhai", "let a = ;")], &mut |_| {}, &mut |_| {}, &mut || true);
    assert!(error.unwrap_err().to_string().starts_with("x.rhai: "));
    assert_eq!(bench("load=0", 1).run(&[], &mut |_| {}, &mut |_| {}, &mut || true), Err(ScriptError::None));
}

#[test]
fn keys_are_typed_at_their_times_and_a_script_for_which_none_come_is_named() {
    let source = r#"
        on_key('a', || send("100#01"));
        let all = on_key(|key| log("typed " + key));
        on_key("b", || stop(all));
    "#;
    let mut typed = bench("load=0", 5);
    typed.keys = vec![(3_000_000_000, 'a'), (1_000_000_000, 'a'), (2_000_000_000, 'b')];
    let (report, records, lines) = run_on(&typed, &[script("keys", source)]);
    assert!(report.is_success() && report.without_keys.is_empty(), "{report:?}");
    let seconds: Vec<i64> = records.iter().map(|record| record.time_ns / 1_000_000_000).collect();
    assert_eq!(seconds, [1, 3]);
    assert_eq!(lines, ["1000000000 keys: typed a", "2000000000 keys: typed b"]);
    let (report, _, lines) = run(5, &[script("keys", source)]);
    assert_eq!((&report.without_keys[..], lines.len()), (&["keys".to_owned()][..], 1));
    let (report, ..) = run(5, &[script("keys", "on_key(\"ab\", || 0);")]);
    assert!(failure(&report).contains("\"ab\" is not one key"), "{report:?}");
}

#[test]
fn steps_are_played_with_their_waits_and_jumps() {
    let source = r#"
        play([
            #{ send: "100#", wait: "5ms" },
            #{ name: "ramp", channel: 2, send: frame("200#01"), wait: "10ms" },
            #{ name: "inner", run: || log("inner") },
            #{ jump: "inner", times: 1 },
            #{ jump: "ramp", times: 2 },
            #{ send: "101#" },
        ]);
        log("done");
    "#;
    let (report, records, lines) = run(1, &[script("a", source)]);
    assert!(report.is_success(), "{report:?}");
    let frames: Vec<(i64, String)> = records
        .iter()
        .map(|record| (record.time_ns / 1_000_000, record.frame().unwrap().to_string()))
        .collect();
    let frames: Vec<(i64, &str)> = frames.iter().map(|(at, frame)| (*at, frame.as_str())).collect();
    assert_eq!(frames, [(0, "100#"), (5, "200#01"), (15, "200#01"), (25, "200#01"), (35, "101#")]);
    assert_eq!(lines.iter().filter(|line| line.ends_with("inner")).count(), 6);
    assert_eq!(report.duration_ns / 1_000_000, 35);
    for (steps, reason) in [
        ("#{ name: \"a\" }, #{ jump: \"a\" }", "no time passed"),
        ("#{ name: \"a\", wait: \"0s\", jump: \"a\" }", "no time passed"),
        ("#{ name: \"a\", send: \"1#\", jump: \"a\" }", "no time passed"),
        ("#{ jump: \"b\" }", "no step \"b\""),
        ("#{ name: 1 }, #{ name: 1 }", "two steps have the name 1"),
        ("#{ sent: \"1#\" }", "a step has no sent"),
        ("#{ times: 3 }", "times is for a jump"),
        ("5", "a step is a map"),
    ] {
        let (report, _, _) = run(1, &[script("a", &format!("play([{steps}]);"))]);
        assert!(failure(&report).contains(reason), "{steps}: {report:?}");
    }
    // With a wait it goes on for as long as the run does.
    let (report, records, _) =
        run(1, &[script("a", "play([#{ name: \"a\", send: \"1#\", wait: \"10ms\", jump: \"a\" }]);")]);
    assert!(report.is_success() && records.len() == 100, "{} {report:?}", records.len());
}

/// A run that was over too soon says nothing of a test: that is no success.
#[test]
fn a_test_that_has_not_ended_with_the_run_has_failed() {
    let source =
        "fn test_a() { wait(\"100ms\"); } fn test_b() { send(\"123#42\"); wait(\"10s\"); } fn test_c() { }";
    let (report, _, _) = run(2, &[script("a", source), script("b", "every(\"1s\", || 0);")]);
    assert!(!report.is_success());
    let reasons: Vec<_> = report
        .tests
        .iter()
        .map(|test| match &test.outcome {
            Outcome::Passed => (test.name.as_str(), "passed"),
            Outcome::Failed(reason) => (test.name.as_str(), reason.as_str()),
        })
        .collect();
    assert_eq!(
        reasons,
        [
            ("test_a", "passed"),
            ("test_b", "the run was over, after 2 s, before it had ended"),
            ("test_c", "the run was over, after 2 s, before it had begun"),
        ]
    );
    assert_eq!((report.tests[1].began_ns, report.tests[1].ended_ns), (100_000_000, 2_000_000_000));
    assert_eq!(report.tests[1].trace.len(), 1);
}
