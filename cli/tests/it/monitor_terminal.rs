//! The live view in terminals of every kind, and how it leaves them.
#![cfg(unix)]

use crate::terminal;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use cantap_formats::{ReadOptions, open_reader};
use terminal::Terminal;

const BUSY: &str = "monitor -d virtual:load=50 -b 500k";

#[test]
fn without_a_terminal_it_says_what_to_use_instead() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(BUSY.split_whitespace()).stdin(Stdio::null()).env("TERM", "xterm");
    let output = command.output().unwrap();
    assert_eq!((output.status.code(), output.stdout.as_slice()), (Some(1), &b""[..]));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("needs a terminal; use --once"), "{said}");
    // A terminal that cannot move its cursor is not usable either.
    for kind in ["dumb", ""] {
        let mut view = Terminal::start_with(BUSY, (120, 24), &[("TERM", Some(kind))]);
        assert_eq!(view.end(), 1);
        let said = view.text();
        assert!(said.contains("TERM says it cannot; use --once") && !said.contains("Trace"), "{said}");
    }
}

/// `candump can0 | cantap monitor -`, as one would into other programs: keys come from the terminal, frames from candump, in either of its forms.
#[test]
fn what_another_program_writes_is_watched_and_the_keys_still_work() {
    for line in ["  can0  123   [2]  11 22", "(1410714882.622188) can0 123#1122"] {
        let program = format!("while echo '{line}'; do sleep 0.05; done");
        let mut view = Terminal::start_behind(&program, "monitor - -b 500k", (120, 24));
        view.wait_for("11 22");
        view.keys("5");
        view.wait_for("5▸");
        view.keys("q");
        assert_eq!(view.end(), 0);
        view.check_given_back();
    }
}

#[test]
fn any_size_is_drawn_or_said_to_be_too_small_and_a_change_shows_at_once() {
    let mut view = Terminal::start(BUSY, (20, 5));
    view.wait_for("too small: 20×5,");
    view.resize((1, 1));
    view.resize((80, 24));
    view.wait_for("Period ms");
    view.resize((160, 50));
    view.wait_until("the wide heading", |screen| screen.contains("ASCII"));
    for columns_rows in [(40, 8), (39, 8), (300, 100), (2, 60), (500, 2), (79, 23)] {
        view.resize(columns_rows);
        std::thread::sleep(Duration::from_millis(60));
    }
    view.wait_for("Period ms");
    view.keys("q");
    assert_eq!(view.end(), 0);
    view.check_given_back();
}

#[test]
fn a_key_pressed_while_the_size_changes_is_obeyed() {
    let mut view = Terminal::start(BUSY, (300, 100));
    view.wait_for("2▸Fixed");
    for round in 0..40_u64 {
        let columns = if round % 2 == 0 { 290 } else { 300 };
        let (key, page) = if round % 2 == 0 { ("1", "1▸Trace") } else { ("2", "2▸Fixed") };
        // The first change makes it draw; it finds the second one and the key together when it is done.
        view.resize((columns, 100));
        std::thread::sleep(Duration::from_millis(round / 2));
        view.resize((columns - 1, 100));
        view.keys(key);
        view.wait_for(page);
    }
    view.keys("q");
    assert_eq!(view.end(), 0);
}

#[test]
fn without_utf8_and_without_colours_the_drawing_is_plain() {
    let environment = [("LC_ALL", Some("C")), ("LANG", Some("C")), ("NO_COLOR", Some("1"))];
    let mut view = Terminal::start_with(BUSY, (100, 30), &environment);
    for key in "1234567h".chars() {
        view.keys(&key.to_string());
        let text = view.wait_until("a page", |screen| match key {
            'h' => screen.contains("any key closes"),
            digit => screen.contains(&format!("{digit}>")),
        });
        assert!(text.is_ascii(), "{text}");
    }
    let colours = view.screen(|screen| {
        let cells = (0..30).flat_map(|row| (0..100).filter_map(move |column| screen.cell(row, column)));
        cells.filter(|cell| [cell.fgcolor(), cell.bgcolor()] != [vt100::Color::Default; 2]).count()
    });
    assert_eq!(colours, 0);
    view.keys("q");
}

#[test]
fn a_signal_ends_it_with_the_terminal_given_back_and_the_recording_whole() {
    for name in ["TERM", "HUP", "INT"] {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("trace.blf");
        let mut view = Terminal::start(&format!("{BUSY} -o {}", file.display()), (120, 24));
        wait_until_recorded(&view);
        view.signal(name);
        assert_eq!(view.end(), 0, "{name}");
        view.check_given_back();
        assert!(view.text().contains("records are in"), "{name}: {}", view.text());
        check_complete(&file);
    }
}

#[test]
fn a_window_that_is_closed_ends_it_with_the_recording_whole() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.blf");
    let mut view = Terminal::start(&format!("{BUSY} -o {}", file.display()), (120, 24));
    wait_until_recorded(&view);
    view.close();
    // It ends on its own, or with an error that nobody can read.
    view.end();
    check_complete(&file);
}

/// Until the second line says that there are thousands of bytes in the file.
fn wait_until_recorded(view: &Terminal) {
    let is_recorded = |text: &str| {
        text.split("REC ").nth(1).is_some_and(|size| size.split_whitespace().nth(1) == Some("kB"))
    };
    view.wait_until("kilobytes are recorded", is_recorded);
}

/// Every record can be read, and nothing was lost.
fn check_complete(file: &Path) {
    let records = open_reader(file, &ReadOptions::default()).unwrap();
    let records: Vec<_> = records.map(Result::unwrap).collect();
    assert!(records.len() > 100, "{}", records.len());
    assert!(records.iter().all(|record| record.frame().is_some()));
}

#[test]
fn the_shell_can_have_the_terminal_for_a_while() {
    for by_key in [true, false] {
        let mut view = Terminal::start(BUSY, (120, 24));
        view.wait_for("running");
        if by_key {
            view.keys("\x1a");
        } else {
            view.signal("TSTP");
        }
        view.wait_until("the terminal back", |screen| !screen.contains("Trace"));
        view.check_given_back();
        view.signal("CONT");
        view.wait_for("running");
        assert!(!view.is_as_a_shell_wants_it());
        view.keys("q");
        assert_eq!(view.end(), 0);
        view.check_given_back();
    }
}

/// A slow display must not thin out the recording.
#[test]
fn a_terminal_that_takes_nothing_does_not_hold_up_the_recording() {
    let _turn = cantap_testing::process::turn();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.log");
    let line = format!("monitor -d virtual:load=100,frames=std0 -b 1M --view trace -o {}", file.display());
    let mut view = Terminal::start(&line, (160, 50));
    view.wait_for("REC");
    view.stall(true);
    // Until the terminal's own buffer is full, and a little longer.
    std::thread::sleep(Duration::from_millis(800));
    let size = || std::fs::metadata(&file).unwrap().len();
    let before = size();
    std::thread::sleep(Duration::from_millis(1500));
    assert!(size() > before + 500_000, "{before} {}", size());
    view.stall(false);
    view.wait_until("nothing lost", |screen| screen.contains("running") && !screen.contains("lost"));
    view.keys("q");
    assert_eq!(view.end(), 0);
    check_complete(&file);
}

#[test]
fn what_is_wrong_with_profile_and_database_is_said_and_the_view_opens_without_it() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let profile = write("car.toml", "device = \"virtual\"\n\nspeed = 5\n");
    let database = write("car.dbc", "VERSION \"\"\nBO_ 291 Engine: 8 ECU\n SG_ Speed : 0|99 nonsense\n");
    let mut view = Terminal::start(&format!("monitor -p {profile} --db {database}"), (300, 24));
    let text =
        view.wait_until("both reasons", |screen| screen.contains("car.toml") && screen.contains("car.dbc"));
    assert!(text.contains("line 3: unknown field `speed`"), "{text}");
    assert!(text.contains("car.dbc: line 3: Engine.Speed: "), "{text}");
    view.wait_for("virtual listen-only: running");
    // The first key only ends the message.
    view.keys("xq");
    assert_eq!(view.end(), 0);
    // A part of a profile that is wrong does not affect the others.
    let profile = write(
        "bus.toml",
        "device = \"virtual:load=30\"\nbitrates = [\"2:250k\", \"fast\"]\nfilters = [\"nonsense,,\"]\nview = \"statistics\"\n\
         send = [\"123#1\"]\n",
    );
    let mut view = Terminal::start(&format!("monitor -p {profile}"), (300, 24));
    let text = view.wait_for("bit rate fast: ");
    assert!(text.contains("filter nonsense,,: ") && text.contains("to send, 123#1: "), "{text}");
    view.wait_for("Channel 2: 250000 bit/s");
    view.keys("xq");
    assert_eq!(view.end(), 0);
}
