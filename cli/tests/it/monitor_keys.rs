//! Keys in the live view do what they say, and nothing else. In a real terminal.
#![cfg(unix)]

use crate::terminal;

use terminal::Terminal;

const CAR: &str = "monitor virtual:car";
const BUSY: &str = "monitor -d virtual:load=50 -b 500k";
const UP: &str = "\x1b[A";

fn view(line: &str, size: (u16, u16)) -> Terminal {
    let view = Terminal::start(line, size);
    view.wait_for("running");
    view
}

/// On a slow line, Escape and a key typed after it arrive as one: it must not end a recording.
#[test]
fn a_key_with_alt_does_nothing_and_ctrl_c_still_leaves() {
    let folder = tempfile::tempdir().unwrap();
    let mut view = view(&format!("{BUSY} -o {}", folder.path().join("a.log").display()), (100, 24));
    view.wait_for("REC");
    for keys in ["\x1bc", "\x1bq", "\x1bz", "\x1bd", "\x1bu"] {
        view.keys(keys);
    }
    view.keys("5");
    view.wait_for("5▸Statistics");
    // What was typed before it stays.
    view.keys("f");
    view.wait_for("show only, in candump's syntax");
    view.keys("12\x1bc3");
    view.wait_for("> 123");
    let text = view.text();
    assert!(text.contains("REC"), "{text}");
    view.keys("\x03");
    assert_eq!(view.end(), 0);
}

#[test]
fn an_impossible_bit_rate_is_refused_while_the_device_goes_on() {
    let mut view = view(BUSY, (100, 24));
    view.keys("b");
    view.wait_for("1:500000 2:500000");
    // What was suggested is replaced by typing.
    view.keys("999999");
    view.wait_for("> 999999");
    view.keys("\r");
    let text = view.wait_for("947368");
    assert!(text.contains("running") && text.contains("> 999999"), "{text}");
    // Another line takes its place, and the device was there all the time.
    view.keys("\x15250k\r");
    view.wait_for("250k");
    view.keys("5");
    let text = view.wait_for("reconnects");
    assert!(text.contains("0 reconnects"), "{text}");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn taking_part_is_asked_for_and_answered_with_one_key() {
    let mut view = view(BUSY, (100, 24));
    for refusal in ["n", "\r", "\x1b"] {
        view.keys("m");
        view.wait_for("y or n");
        // Neither yes nor no.
        view.keys("x");
        view.wait_for("y or n");
        view.keys(refusal);
        view.wait_for("it stays listen-only");
        view.keys("t");
    }
    view.keys("m");
    view.wait_for("y or n");
    view.keys("y");
    view.wait_for("NORMAL");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn the_key_that_continues_after_a_message_does_nothing_else() {
    let mut view = view(BUSY, (60, 20));
    view.keys("O/no/such/file/anywhere/in/this/world/at/all.log\r");
    view.wait_for("there is no file");
    view.keys("\x1b");
    view.wait_until("the prompt to go", |screen| !screen.contains("there is no file"));
    // A search that is not found has a long message here.
    view.keys("1/ZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZZ\r");
    view.wait_for("any key continues");
    view.keys("q");
    view.wait_until("the message to go", |screen| !screen.contains("any key continues"));
    view.keys("h");
    view.wait_for("any key closes");
    view.keys("q");
    view.wait_until("the help to go", |screen| !screen.contains("any key closes"));
    assert!(view.text().contains("1▸Trace"));
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn an_armed_recording_says_so_and_leaves_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("never.log");
    let mut view = view(CAR, (100, 24));
    view.keys(&format!("r{} if id == 0x7FE\r", path.display()));
    view.wait_for("ARMED");
    view.keys("7");
    let text = view.wait_for("It has not come true yet");
    assert!(text.contains("Armed: ") && !text.contains("REC "), "{text}");
    assert!(!path.exists());
    view.keys("q");
    assert_eq!(view.end(), 0);
    let text = view.text();
    assert!(text.contains("nothing was recorded: id == 0x7FE never came true"), "{text}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn forty_columns_show_the_data_and_no_number_is_cut_without_a_sign() {
    let mut view = view("monitor -d virtual:load=20,frames=std8 -b 500k", (40, 12));
    view.wait_for("Data");
    let has_data = |screen: &str| {
        screen.lines().any(|line| line.split_whitespace().filter(|word| word.len() == 2).count() >= 8)
    };
    view.wait_until("eight bytes of data", has_data);
    view.keys("1");
    view.wait_for("1▸Trace");
    view.wait_until("eight bytes of data", has_data);
    view.keys(UP);
    // The statistics have longer lines.
    view.keys("5");
    let text = view.wait_for("Channel 1: 500000");
    let full = text.lines().filter(|line| line.chars().count() == 40);
    assert!(full.clone().filter(|line| line.ends_with('…')).count() > 1, "{text}");
    assert!(full.clone().all(|line| !line.ends_with(|end: char| end.is_ascii_digit())), "{text}");
    view.keys("q");
    assert_eq!(view.end(), 0);
}
