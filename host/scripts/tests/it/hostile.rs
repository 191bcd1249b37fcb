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
