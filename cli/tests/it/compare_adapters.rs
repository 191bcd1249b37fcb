//! `cantap compare-adapters` as users run it.

use std::process::{Command, Output, Stdio};

use serde_json::Value;

use crate::adapters::pipe;
use crate::served::Served;

/// Exit code, standard output, standard error.
fn compare(devices: [&str; 2], options: &str) -> (Option<i32>, String, String) {
    let [first, second] = devices;
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(["compare-adapters", "-d", first, "-d", second, "-b", "500k"]);
    command.args(options.split_whitespace()).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// Compares what two programs write into pipes.
fn compare_pipes(test: &str, logs: [String; 2], options: &str) -> (Option<i32>, String, String) {
    let mut number = 0;
    let [(first, _first), (second, _second)] = logs.map(|log| {
        number += 1;
        pipe(&format!("compare-{test}-{number}"), log)
    });
    compare([&first, &second], &format!("-t 3s {options}"))
}

fn object(of: &(Option<i32>, String, String)) -> Value {
    serde_json::from_str(&of.1).unwrap_or_else(|_| panic!("{of:?}"))
}

/// A log of frames that never repeat.
fn log(order: impl IntoIterator<Item = u32>) -> String {
    let line = |(place, at): (usize, u32)| {
        let us = 100_000 + place * 700;
        format!("(1410714882.{us:06}) can0 {:03X}#{:08X}\n", 0x100 + at % 3, at * at)
    };
    order.into_iter().enumerate().map(line).collect()
}

/// A figure of each of the two.
fn of_each(result: &Value, key: &str) -> [u64; 2] {
    [0, 1].map(|adapter| result["adapters"][adapter][key].as_u64().unwrap())
}

/// Each with its own way to the bus of a virtual device: what one has, the other has.
#[test]
fn two_ways_to_one_bus_miss_nothing_of_each_other() {
    let served = Served::start("virtual:load=10", Stdio::null());
    let [host, port] = &served.socketcand;
    let other = format!("socketcand://{host}:{port}/can0");
    let found = compare([&served.at, &other], "-c 1,3 -t 3s --json");
    let result = object(&found);
    assert_eq!(
        (found.0, of_each(&result, "missed"), of_each(&result, "surplus")),
        (Some(0), [0; 2], [0; 2]),
        "{found:?}"
    );
    assert!(result["frames_in_both"].as_u64().unwrap() > 100, "{found:?}");
    let [first, second] = [0, 1].map(|adapter| &result["adapters"][adapter]);
    assert_eq!(second["kind"], "socketcand");
    // A board's losses are all counted, and the other's are not.
    assert_eq!((&first["lost"]["unknown"], &first["not_known"]), (&0.into(), &Value::Null));
    assert_eq!(second["lost"]["unknown"], 1);
    assert!(second["not_known"].as_str().unwrap().contains("not reported"), "{found:?}");
}

#[test]
fn what_one_missed_and_what_came_in_another_order_is_found() {
    let order = || {
        (0..300).filter(|at| at % 10 != 5).map(|at| match at {
            200 => 201,
            201 => 200,
            at => at,
        })
    };
    let found = compare_pipes("lossy", [log(0..300), log(order())], "-c 1,3 --json");
    let result = object(&found);
    assert_eq!(
        (found.0, of_each(&result, "missed"), &result["out_of_order"]),
        (Some(3), [0, 30], &1.into()),
        "{found:?}"
    );
    let (_, out, _) = compare_pipes("text", [log(0..300), log(order())], "-c 1,3");
    assert!(out.contains("compare-text-2': 270 frames") && out.contains("30 missed that 'candump:"), "{out}");
    assert!(!out.contains(" 0 lost") && out.contains("an unknown number"), "{out}");
}

#[test]
fn a_frame_that_came_twice_is_no_loss_of_the_other() {
    let twice = (0..300).flat_map(|at| std::iter::repeat_n(at, if at % 50 == 20 { 2 } else { 1 }));
    let found = compare_pipes("twice", [log(0..300), log(twice)], "-c 1,3 --json");
    let result = object(&found);
    assert_eq!(
        (found.0, of_each(&result, "missed"), of_each(&result, "surplus")),
        (Some(3), [0, 0], [0, 6]),
        "{found:?}"
    );
}

/// Both are opened one after the other, and one may end: that is no loss of the other.
#[test]
fn what_one_has_after_the_other_has_ended_is_not_compared() {
    let (first, _first) = pipe("compare-ends-1", log(0..300));
    let (second, ends) = pipe("compare-ends-2", log(50..250));
    drop(ends);
    let found = compare([&first, &second], "-c 1,3 -t 20s --json");
    let result = object(&found);
    assert_eq!(
        (found.0, of_each(&result, "missed"), of_each(&result, "not_compared")),
        (Some(0), [0, 0], [100, 0]),
        "{found:?}"
    );
    assert!(
        found.2.contains("its input has ended") && found.2.contains("before that is compared"),
        "{found:?}"
    );
}

#[test]
fn what_cannot_be_compared_is_refused_with_the_reason() {
    let same = "(1.000000) can0 123#11\n".repeat(300);
    for (test, other) in [("other", log(1000..1300)), ("same", same)] {
        let (code, out, err) = compare_pipes(test, [log(0..300), other], "-c 1,3 --json");
        assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
        assert!(
            err.contains("cannot be compared") && err.contains("no part of one is found in the other"),
            "{err}"
        );
    }
    let (code, out, err) = compare_pipes("silent", [log(0..300), String::new()], "-c 1,3 --json");
    assert_eq!((code, out.as_str()), (Some(1), ""), "{err}");
    assert!(err.contains("compare-silent-2' received no frame") && err.contains("(-b)"), "{err}");
    let one = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["compare-adapters", "-d", "virtual", "-b", "500k"])
        .output()
        .unwrap();
    assert_eq!(one.status.code(), Some(2));
    let (code, _, err) = compare(["virtual", "virtual"], "-c 1,2");
    assert_eq!(code, Some(2), "{err}");
    assert!(err.contains("second device's are 3 and 4"), "{err}");
}
