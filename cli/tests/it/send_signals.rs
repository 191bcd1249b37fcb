//! `cantap send` with messages and values instead of bytes, using a DBC file.

use std::path::Path;
use std::process::{Command, Output};

/// Sends on the virtual device's channel 1; returns the lines without their times.
fn send(arguments: &[&str]) -> (Option<i32>, Vec<String>, String) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../host/signals/tests/data/dbc");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(["send", "-d", "virtual:load=0", "can0"]).args(arguments).current_dir(folder);
    let Output { status, stdout, stderr } = command.output().unwrap();
    let lines = String::from_utf8(stdout).unwrap();
    let lines = lines.lines().map(|line| line.split_once(") ").unwrap().1.to_owned()).collect();
    (status.code(), lines, String::from_utf8(stderr).unwrap())
}

fn sent(arguments: &[&str]) -> Vec<String> {
    let (code, lines, err) = send(arguments);
    assert_eq!((code, err.as_str()), (Some(0), ""), "{arguments:?}");
    lines
}

#[test]
fn values_become_the_frame_that_other_tools_make() {
    let db = ["--db", "motohawk.dbc"];
    // As cantools encodes them: see its tests of this file.
    let line = "ExampleMessage:Temperature=250.55,AverageRadius=3.2,Enable=1";
    assert_eq!(sent(&[&[line], &db[..]].concat()), ["can0 1F0#C006E00000000000 T"]);
    // Spaces, a text of the value table, hexadecimal and raw bits mean the same.
    for line in [
        "ExampleMessage: Temperature = 250.55, AverageRadius = 3.2, Enable = Enabled",
        "ExampleMessage:Temperature=raw:0x37,AverageRadius=raw:32,Enable=0x1",
    ] {
        assert_eq!(sent(&[&[line], &db[..]].concat()), ["can0 1F0#C006E00000000000 T"], "{line}");
    }
    // Values not given are zero or the database's start value; frames and messages mix, in order.
    let mixed = ["123#11", "ExampleMessage:Enable=1", "ExampleMessage:Enable=0", "--db", "motohawk.dbc"];
    let expected = ["can0 123#11 T", "can0 1F0#8000000000000000 T", "can0 1F0#0000000000000000 T"];
    assert_eq!(sent(&mixed), expected);
}

#[test]
fn a_multiplexer_that_is_not_given_follows_from_the_signals() {
    let db = ["--db", "multiplex.dbc"];
    let of = |line: &str| sent(&[&[line], &db[..]].concat()).remove(0);
    assert_eq!(of("Message1:BIT_A=1"), "can0 00123456#6000000400000000 T");
    assert_eq!(of("Message1:Multiplexor=24,BIT_A=1"), "can0 00123456#6000000400000000 T");
    assert_eq!(of("Message1:BIT_L=1"), "can0 00123456#2000000100000000 T");
    // The database's extended multiplexing has both at 24.
    assert_eq!(of("Message1:BIT_A=1,BIT_L=1"), "can0 00123456#6000000500000000 T");
    let (code, lines, err) = send(&[&["Message1:Multiplexor=8,BIT_A=1"], &db[..]].concat());
    assert!(code == Some(1) && lines.is_empty(), "{err}");
    assert!(err.contains("BIT_A is only there when Multiplexor is 24, and it is 8"), "{err}");
}

#[test]
fn what_no_frame_can_say_is_refused_before_anything_is_sent() {
    for (line, part) in [
        ("ExampleMesage:Enable=1", "did you mean ExampleMessage"),
        ("ExampleMessage:Enabel=1", "did you mean Enable"),
        ("ExampleMessage:Enable=1,Enable=0", "given twice"),
        ("ExampleMessage:Enable=2", "does not fit Enable, which goes from 0 to 1"),
        ("ExampleMessage:Enable=Maybe", "is not a value for Enable"),
        ("ExampleMessage:Temperature=300", "does not fit Temperature"),
        ("ExampleMessage:AverageRadius=5.5", "raw:55"),
        ("ExampleMessage:Enable", "write it as Message:Signal=value"),
        ("ExampleMessage:Enable=", "write it as Message:Signal=value"),
        (":Enable=1", "write it as Message:Signal=value"),
    ] {
        // The good frame before it is not sent either.
        let (code, lines, err) = send(&["123#11", line, "--db", "motohawk.dbc"]);
        assert!(code == Some(1) && lines.is_empty() && err.contains(part), "{line}: {err}");
    }
    // Without a database there are no messages.
    let (code, _, err) = send(&["ExampleMessage:Enable=1"]);
    assert!(code == Some(1) && err.contains("no database has a message"), "{err}");
    let (code, _, err) = send(&["ExampleMessage:Enable=1", "--db", "nowhere.dbc"]);
    assert!(code == Some(1) && err.contains("nowhere.dbc"), "{err}");
}

/// The device repeats and modifies a frame made from values like any other.
#[test]
fn a_message_with_values_can_be_periodic_and_count() {
    let line =
        ["ExampleMessage:Enable=1", "--db", "motohawk.dbc", "--period", "5ms", "-n", "3", "--counter", "7"];
    let expected =
        ["can0 1F0#8000000000000000 T", "can0 1F0#8000000000000001 T", "can0 1F0#8000000000000002 T"];
    assert_eq!(sent(&line), expected);
}
