//! Scripts that go wrong, on purpose or not: each ends with a reason, and the others go on.

use super::{bench, failure, run, script};

fn error(source: &str) -> String {
    let (report, _, _) = run(1, &[script("a", source)]);
    assert!(!report.is_success());
    failure(&report)
}

#[test]
fn what_takes_long_in_few_operations_is_ended() {
    // Each of these looks at all that is in the array again.
    assert!(error("let a = 1; for i in 0..1_000_000 { a = [a]; }").contains("computed for too long"));
    let wide = error("let a = []; for i in 0..900_000 { a.push([1, 2, 3, 4, 5, 6, 7, 8]); }");
    assert!(wide.contains("computed for too long") || wide.contains("too large"), "{wide}");
}

#[test]
fn an_endless_loop_is_ended_also_if_it_tries_to_catch_that() {
    assert!(error("loop { }").contains("computed for too long"));
    assert!(error("loop { try { loop { } } catch { } }").contains("computed for too long"));
    assert!(error("every(\"1ms\", || { loop { } });").contains("computed for too long"));
    assert!(error("fn again() { after(\"0s\", || again()); }\nagain();").contains("computed for too long"));
    // In a test, too: it fails, and nothing of the script runs on.
    assert!(error("fn test_a() { loop { } }\nfn test_b() { }").contains("computed for too long"));
}

#[test]
fn memory_and_calls_are_limited() {
    assert!(error("let a = [0]; loop { a += a; }").contains("Size of array"));
    assert!(error("let a = \"x\"; loop { a += a; }").contains("Length of string"));
    assert!(error("let a = blob(1, 0); loop { a += a; }").contains("Size of"));
    assert!(error("fn f(n) { f(n + 1) }\nf(0);").contains("Stack overflow"));
    assert!(error("loop { send(\"123#\"); }").contains("frames wait to be sent"));
}

#[test]
fn a_script_reaches_no_file_and_no_other_script() {
    let refused = |source: &str| {
        let result = bench("load=0", 1).run(&[script("a", source)], &mut |_| {}, &mut |_| {}, &mut || true);
        result.unwrap_err().to_string()
    };
    assert!(refused("import \"/etc/passwd\" as p;").contains("import"));
    assert!(refused("eval(\"1\");").contains("eval"));
    assert!(error("let t = timestamp();").contains("timestamp"));
}

#[test]
fn names_that_do_not_exist_are_errors_with_what_there_is() {
    assert!(error("send(\"Engin\", #{ Speed: 1 });").contains("Engine"));
    assert!(error("send(\"Engine\", #{ Sped: 1 });").contains("Speed"));
    assert!(error("value(\"Engine.Sped\");").contains("no signal Sped"));
    assert!(error("on_frame(\"XYZ\", |f| ());").contains("not an identifier"));
    assert!(error("send(3, \"123#\");").contains("no channel 3"));
    assert!(error("wait(\"5 parsecs\");").contains("number and a unit"));
    assert!(error("frame(0x20000000, []);").contains("29 bits"));
    assert!(error("frame(1, [1, 2, 3, 4, 5, 6, 7, 8, 9]);").contains("9 bytes"));
    assert!(error("frame(1, [256]);").contains("256 is no byte"));
    assert!(error("nonsense();").contains("nonsense"));
}

#[test]
fn one_that_ends_with_an_error_does_not_end_the_others_and_sends_nothing_more() {
    let bad = script("bad", "periodic(\"100#\", \"10ms\"); wait(\"35ms\"); fail(\"gone\");");
    let good = script("good", "periodic(\"200#\", \"10ms\");");
    let (report, records, _) = run(1, &[bad, good]);
    assert_eq!(report.errors, [("bad".to_owned(), "line 1: gone".to_owned())]);
    let of = |id: &str| {
        records.iter().filter(|record| record.frame().unwrap().to_string().starts_with(id)).count()
    };
    assert_eq!((of("100"), of("200")), (4, 100));
}

/// What a script hands over is kept by the computer until it waits, and its functions for as long as it runs.
#[test]
fn what_is_kept_for_a_script_is_limited() {
    let long = "let s = \"x\"; s.pad(100000, \"y\"); ";
    assert!(error(&format!("{long} loop {{ log(s); }}")).contains("logged too much"));
    assert!(error(&format!("{long} loop {{ print(s); }}")).contains("logged too much"));
    assert!(
        error(&format!("{long} loop {{ try {{ loop {{ debug(s); }} }} catch {{ }} }}"))
            .contains("logged too much")
    );
    for adds in [
        "after(\"1h\", || {})",
        "every(\"1h\", || {})",
        "every(\"1h\", \"1s\", || {})",
        "on_frame(|f| {})",
        "on_frame(\"123\", |f| {})",
        "on_message(\"Engine\", |m| {})",
        "on_error(|c, k| {})",
        "on_state(|c, s| {})",
    ] {
        assert!(error(&format!("loop {{ {adds}; }}")).contains("functions are waiting already"), "{adds}");
    }
    assert!(error("loop { on_request(\"7E0\", \"7E8\", |d| d); }").contains("servers are waiting already"));
    assert!(error("loop { periodic(\"123#\", \"1s\"); }").contains("frames are repeated already"));
    // What is ended has room for others.
    let (report, _, _) = run(
        1,
        &[script("a", "for i in 0..9000 { stop(after(\"1h\", || {})); if i % 100 == 0 { wait(\"1us\"); } }")],
    );
    assert!(report.is_success(), "{report:?}");
}

/// Each of these keeps many values, none of which is too large by itself.
#[test]
fn what_a_script_keeps_as_a_whole_is_limited() {
    let text = "let s = \"x\"; s.pad(1000000, \"y\"); ";
    for keeps in [
        "let all = []; for i in 0..100000 { all.push(steps([s + i])); }",
        "let all = []; fn f(text) {} for i in 0..100000 { all.push(Fn(\"f\").curry(s + i)); }",
        "for i in 0..8000 { let t = s + i; after(\"1h\", || t.len()); }",
        // Also a little in each turn.
        "let all = []; for i in 0..100000 { all.push(steps([s + i])); wait(\"1ms\"); }",
    ] {
        assert!(error(&format!("{text}{keeps}")).contains("too much memory"), "{keeps}");
    }
    // What it no longer has, and what it has logged, does not count.
    let (report, _, _) = run(
        600,
        &[script("a", &format!("{text} for i in 0..200 {{ log(steps([s + i]).next()); wait(\"1ms\"); }}"))],
    );
    assert!(report.is_success(), "{:?}", report.errors);
}

/// Freed one within the other, these would overflow a thread's usual stack, and end the whole program.
#[test]
fn a_chain_of_values_as_long_as_the_memory_allows_ends_only_its_script() {
    let waits = "if i % 10000 == 0 { wait(\"1us\"); }";
    for chain in [
        format!("let last = (); for i in 0..2000000 {{ last = steps([last]); {waits} }}"),
        format!("let f = || 1; for i in 0..2000000 {{ let g = f; f = || g; {waits} }}"),
    ] {
        assert!(error(&chain).contains("too much memory"), "{chain}");
    }
}

/// What it sends and then fails, without a wait, happens at one moment: nothing of it is sent after its error.
#[test]
fn nothing_of_a_script_is_sent_after_its_error() {
    let ends = |source: &str| {
        let (report, records, _) = run(1, &[script("a", source)]);
        assert_eq!(report.errors.len(), 1, "{report:?}");
        (records.len(), report.frames_sent, report.frames_not_sent)
    };
    assert_eq!(ends("for i in 0..100 { send(\"123#\"); } fail(\"no\");"), (0, 0, 100));
    assert_eq!(ends("send(\"123#\"); loop {}"), (0, 0, 1));
    // 47 bits of 2 us each: the first frame is sent, the second is on the bus.
    let (sent, _, dropped) = ends("for i in 0..100 { send(\"123#\"); } wait(\"150us\"); fail(\"no\");");
    assert_eq!((sent, dropped), (2, 98));
}

/// As in a device: a frame that waits for the bus is not due again.
#[test]
fn a_repeated_frame_that_the_bus_does_not_take_does_not_pile_up() {
    let fast = script("fast", "periodic(\"200#0102030405060708\", \"1ns\");");
    let (report, records, _) = run(1, &[fast]);
    // A frame of eight bytes has 111 to 135 bits.
    assert!((3700..=4600).contains(&records.len()), "{}", records.len());
    assert!(report.frames_not_sent <= 1, "{report:?}");
    // Behind another that the bus is full of, it waits, and once.
    let high =
        script("high", "periodic(\"100#0102030405060708\", \"1us\"); after(\"500ms\", || fail(\"over\"));");
    let low = script("low", "periodic(\"200#0102030405060708\", \"10ms\");");
    let (_, records, _) = run(1, &[high, low]);
    let low = records.iter().filter(|record| record.frame().unwrap().to_string().starts_with("200"));
    assert!((50..=52).contains(&low.count()));
}

#[test]
fn a_function_that_waits_while_it_is_called_again_and_again_says_so() {
    let reason = error("on_frame(|f| wait(\"10s\")); every(\"1ms\", || wait(\"1s\"));");
    assert!(reason.contains("while a function waits"), "{reason}");
}
