//! A vehicle asked by OBD-II in the live view: only when the user has agreed to take part in the bus, and no longer than the page is shown. In a real
//! terminal.
#![cfg(unix)]

use crate::port::Port;
use crate::terminal::Terminal;

const SIZE: (u16, u16) = (100, 40);

/// The words on the screen, since a sentence may go on in the next line.
fn words(screen: &str) -> String {
    screen.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Waits for a sentence.
fn wait_for_words(view: &Terminal, wanted: &str) -> String {
    words(&view.wait_until(wanted, |screen| words(screen).contains(wanted)))
}

/// How many frames a channel has sent, from the statistics.
fn sent(screen: &str, channel: u8) -> Option<u64> {
    let line = screen.lines().find(|line| line.starts_with(&format!("Bus {channel} ")))?;
    line.split_once("sent ")?.1.split(',').next()?.trim().parse().ok()
}

/// How many frames have come on channel 1, from the statistics.
fn heard(screen: &str) -> Option<u64> {
    let line = screen.lines().find(|line| line.starts_with("Frames "))?;
    line.split_whitespace().nth(1)?.parse().ok()
}

#[test]
fn a_vehicle_is_asked_after_a_clear_yes_and_no_longer_than_its_page_is_shown() {
    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("a.log");
    let mut view = Terminal::start(&format!("monitor virtual:car -o {}", recording.display()), SIZE);
    view.wait_for("running");
    // The screen names the key.
    view.wait_for("0 OBD");
    view.keys("0");
    view.wait_for("y or n");
    view.keys("n");
    view.wait_for("it stays listen-only");
    view.keys("t");
    let text = view.wait_for("Listen-only: nothing is sent, so nothing is asked.");
    assert!(!text.contains("NORMAL"), "{text}");
    view.keys("5");
    let text = view.wait_until("the device's figures", |screen| sent(screen, 1).is_some());
    assert_eq!((sent(&text, 1), sent(&text, 2)), (Some(0), Some(0)), "{text}");
    view.keys("0y");
    let is_answered = |screen: &str| {
        let values = screen.lines().filter(|line| line.contains("  7E8  ")).count();
        screen.contains("NORMAL") && screen.contains("engine_speed") && values > 10
    };
    let text = view.wait_until("values", is_answered);
    assert!(text.contains("Asking 7E8, 7E9 on channel 1, ") && text.contains("Space stops."), "{text}");
    assert!(text.contains("  7E9  "), "{text}");
    // Stopped and begun again by the page's own key.
    view.keys(" ");
    view.wait_for("nothing is asked. Space asks.");
    view.keys(" ");
    view.wait_for("Asking 7E8, 7E9 on channel 1, ");
    // Left: nothing more is sent.
    view.keys("5");
    view.wait_until("the device's figures", |screen| sent(screen, 1).is_some_and(|sent| sent > 10));
    let after = |frames: u64| {
        let text =
            view.wait_until("more frames", |screen| heard(screen).is_some_and(|heard| heard >= frames));
        (heard(&text).unwrap(), sent(&text, 1).unwrap())
    };
    let (frames, _) = after(0);
    let (frames, before) = after(frames + 1000);
    let (_, now) = after(frames + 3000);
    assert_eq!(now, before);
    view.keys("0");
    view.wait_for("Asking 7E8, 7E9 on channel 1, ");
    view.keys("q");
    assert_eq!(view.end(), 0);
    // What was asked was recorded like everything else.
    assert!(std::fs::read_to_string(&recording).unwrap().contains(" 7DF#02010C"));
}

#[test]
fn a_bus_on_which_nobody_acknowledges_is_given_up_and_nothing_is_left_to_be_sent() {
    let mut view = Terminal::start("monitor -d virtual:load=0,ack=no -b 500k --normal --view obd", SIZE);
    let text = wait_for_words(&view, "Space asks again.");
    assert!(text.contains("nothing that was asked got onto the bus of channel 2"), "{text}");
    // What is said of the errors may lie over the page, and goes first.
    view.keys("55");
    let is_idle = |screen: &str| {
        let buses = screen.lines().filter(|line| line.starts_with("Bus "));
        buses.filter(|line| line.contains("waiting 0")).count() == 2
    };
    view.wait_until("nothing that waits", is_idle);
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_bus_without_ecus_is_told_from_one_with_a_vehicle() {
    let mut view = Terminal::start("monitor -d virtual:load=0 -b 500k --normal --view obd", SIZE);
    let text = wait_for_words(&view, "Space asks again.");
    assert!(text.contains("no ECU answers, neither to 7DF nor to 18DB33F1"), "{text}");
    view.keys(" ");
    view.wait_for("who is there");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn a_vehicle_that_vanishes_is_not_asked_when_it_is_back_until_the_user_wants_it() {
    let mut port = Port::new();
    port.plug("car,serial=ONE");
    let mut view =
        Terminal::start(&format!("monitor -d {} -b 500k -b 2:125k --normal --view obd", port.name()), SIZE);
    view.wait_for("engine_speed");
    port.unplug();
    view.wait_for("GONE, trying again");
    wait_for_words(&view, "Nothing is asked any more: the device");
    port.plug("car,serial=ONE");
    view.wait_for("is back after");
    view.keys("5");
    let text = view.wait_until("the device's figures", |screen| sent(screen, 1).is_some());
    assert_eq!(sent(&text, 1), Some(0), "{text}");
    view.keys("0");
    view.wait_for("Asking 7E8, 7E9 on channel 1, ");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn one_screen_of_a_vehicle_is_printed_if_the_command_line_takes_part_in_the_bus() {
    let once = |options: &str| {
        let line = format!("monitor virtual:car --view obd --once --size 100x30 {options}");
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_cantap"));
        let output = command.args(line.split_whitespace()).env("LC_ALL", "C.UTF-8").output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    let text = once("");
    assert!(text.contains("Listen-only: nothing is sent, so nothing is asked."), "{text}");
    let text = once("--normal -t 4s");
    assert!(text.contains("engine_speed") && text.contains("7E8"), "{text}");
}
