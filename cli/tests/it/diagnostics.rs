//! `cantap obd` and `cantap uds` as users run them, on the virtual car.

use std::process::{Command, Output};

#[cfg(unix)]
use crate::terminal::Terminal;

fn cantap(line: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { status, stdout, stderr } = command.args(line).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn well(line: &str) -> String {
    let (code, out, err) = cantap(&line.split(' ').collect::<Vec<_>>());
    assert_eq!(code, Some(0), "{line}: {out}{err}");
    out
}

fn badly(line: &str) -> (Option<i32>, String) {
    let (code, out, err) = cantap(&line.split(' ').collect::<Vec<_>>());
    (code, out + &err)
}

#[test]
fn a_car_tells_who_it_is_what_it_has_and_how_it_is() {
    let out = well("obd -d virtual:car");
    let row = |start: &str, ecu: &str| {
        let mut lines = out.lines().filter(|line| line.starts_with(start) && line.contains(ecu));
        lines.next().unwrap_or_else(|| panic!("no row {start} of {ecu}: {out}"))
    };
    assert!(out.lines().next().unwrap().starts_with("PID    name "), "{out}");
    assert!(row("0C     engine_speed ", "7E8").ends_with(" rpm"), "{out}");
    assert!(row("05     coolant_temperature ", "7E8").ends_with(" °C"), "{out}");
    assert!(row("09 02  vin ", "7E8").ends_with("  WCTCANTA4P0000001"), "{out}");
    assert!(row("       stored trouble codes ", "7E8").ends_with("  P0128"), "{out}");
    assert!(row("       stored trouble codes ", "7E9").ends_with("  none"), "{out}");
    row("0D     vehicle_speed ", "7E9");
    let out = well("obd supported -d virtual:car");
    assert!(out.lines().any(|line| line.starts_with("0C  engine_speed") && line.ends_with("7E8")), "{out}");
    assert!(
        out.lines().any(|line| line.starts_with("0D  vehicle_speed") && line.ends_with("7E8, 7E9")),
        "{out}"
    );
    let out = well("obd -d virtual:car live 0C 0D --period 100ms -n 3");
    // The speed comes from two.
    assert_eq!(out.lines().count(), 9, "{out}");
    assert_eq!(
        out.lines().filter(|line| line.contains("engine_speed") && line.contains("rpm")).count(),
        3,
        "{out}"
    );
    let out = well("obd -d virtual:car watch 0C 0D --period 100ms -n 3");
    // Without a terminal, lines as of live: each with both speeds of two ECUs.
    assert_eq!(
        out.lines().filter(|line| line.contains("(vehicle_speed), vehicle_speed ")).count(),
        6,
        "{out}"
    );
    assert!(!out.contains('\u{1b}') && !out.contains("PID"), "{out}");
    let (code, said) = badly("obd -d virtual:car live FE -n 1");
    assert!(code == Some(1) && said.contains("cantap obd supported"), "{said}");
}

#[test]
fn trouble_codes_have_the_texts_of_the_user_s_table() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("codes.csv");
    let at = path.display();
    std::fs::write(&path, "code,text\nP0128,\"Coolant below the thermostat's temperature\"\n").unwrap();
    let out = well(&format!("obd -d virtual:car codes --dtc {at}"));
    assert!(out.contains("P0128     Coolant below the thermostat's temperature"), "{out}");
    // An ECU without codes has none that the table might not have.
    assert!(!out.contains("(not in the table)"), "{out}");
    let out = well(&format!("obd -d virtual:car --dtc {at}"));
    assert!(out.contains("P0128     Coolant below the thermostat's temperature"), "{out}");
    std::fs::write(&path, "P0001,Another\n").unwrap();
    assert!(well(&format!("obd -d virtual:car codes --dtc {at}")).contains("P0128     (not in the table)"));
    std::fs::write(&path, "P0001,Another\nP00\n").unwrap();
    let (code, said) = badly(&format!("obd -d virtual:car codes --dtc {at}"));
    assert!(code == Some(1) && said.contains("codes.csv") && said.contains("line 2"), "{said}");
}

#[test]
fn codes_are_erased_only_when_that_is_meant() {
    let (code, said) = badly("obd -d virtual:car clear");
    assert!(code == Some(2) && said.contains("--yes"), "{said}");
    let out = well("obd -d virtual:car clear --yes");
    assert!(out.contains("clear trouble codes"), "{out}");
    let (code, said) = badly("uds -d virtual:car dtc --clear");
    assert!(code == Some(2) && said.contains("--yes"), "{said}");
    assert!(well("uds -d virtual:car dtc --clear --yes").contains("ClearDiagnosticInformation"));
    assert!(well("uds -d virtual:car dtc").contains("P0128-00"));
}

#[test]
fn an_ecu_is_asked_and_refuses_by_name() {
    let out = well("uds -d virtual:car read F190 F187");
    assert_eq!(out.lines().count(), 2, "{out}");
    assert!(out.contains("did 0xF190 (VIN), value \"") && out.contains("CANTAP-ECM-01"), "{out}");
    let out = well("uds -d virtual:car --session extended read F186");
    assert!(out.contains("DiagnosticSessionControl") && out.lines().count() == 2, "{out}");
    assert!(well("uds -d virtual:car --pair 7E1:7E9 read F187").contains("CANTAP-TCM-01"));
    assert!(well("uds -d virtual:car tester-present").contains("TesterPresent"));
    assert!(well("uds -d virtual:car reset hard").contains("ECUReset"));
    assert!(well("uds -d virtual:car raw 22 F1 90").contains("VIN"));
    let out = well("uds -d virtual:car tester-present --period 100ms -n 3");
    assert_eq!(out.lines().filter(|line| line.contains("TesterPresent")).count(), 3, "{out}");
    let (code, said) = badly("uds -d virtual:car read 1234");
    assert!(code == Some(1) && said.contains("requestOutOfRange (31)"), "{said}");
    let (code, said) = badly("uds -d virtual:car routine start FF00");
    assert!(code == Some(1) && said.contains("serviceNotSupported (11)"), "{said}");
    let (code, said) = badly("uds -d virtual:car session extended --block-size 2 --functional");
    assert!(code == Some(0) && said.contains("7DF > 7E9"), "{said}");
}

#[test]
fn a_scan_of_the_car_finds_its_two_ecus_and_says_what_it_sends() {
    let (code, out, err) = cantap(&["uds", "-d", "virtual:car", "scan", "--p2", "200ms"]);
    assert_eq!(code, Some(0), "{err}");
    let pairs: Vec<_> = out.lines().filter_map(|line| line.split_whitespace().nth(1)).collect();
    assert_eq!(pairs, ["7E0:7E8", "7E1:7E9"], "{out}");
    assert!(
        err.contains("265 addresses") && err.contains("(3E 00)") && err.contains("7DF, 18DB33F1"),
        "{err}"
    );
    let (code, said) = badly("uds -d virtual:load=0 -b 500k scan --functional --p2 100ms");
    assert!(code == Some(1) && said.contains("nobody answered"), "{said}");
}

/// Its engine sends its trouble codes every second, whether requested or not.
#[test]
fn a_node_of_j1939_is_heard_for_a_bounded_time() {
    let started = std::time::Instant::now();
    assert!(well("j1939 -d virtual:car dm1").contains("SPN 110 FMI 17"));
    assert!(started.elapsed() < std::time::Duration::from_mins(1), "{:?}", started.elapsed());
}

/// The first flow control may come from the device itself.
#[test]
fn the_device_answers_first_frames_by_itself_where_that_is_asked_for() {
    let out = well("uds -d virtual:car read F190 F190 --flow-control device");
    assert_eq!(out.lines().filter(|line| line.contains("(VIN)")).count(), 2, "{out}");
    // A small block: the computer sends the rest of the flow control.
    let out = well("uds -d virtual:car read F190 --flow-control device --block-size 1");
    assert!(out.contains("(VIN)"), "{out}");
}

#[test]
fn silence_is_explained() {
    let (code, said) = badly("uds -d virtual:load=0 -b 500k read F190 --p2 200ms");
    assert_eq!(code, Some(1));
    for part in ["7E0: no answer within 200 ms", "acknowledged", "no other frame was heard", "--pair"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let (code, said) = badly("uds -d virtual:load=0,ack=no -b 500k read F190");
    assert!(code == Some(1) && said.contains("nobody acknowledged 1 of 1 frame"), "{said}");
    let (code, said) = badly("obd -d virtual:load=30 -b 500k");
    assert!(
        code == Some(1) && said.contains("no ECU answers") && said.contains("frames of others"),
        "{said}"
    );
}

/// The longest request with a short length, the first with a long one, identifiers at their limits, times beyond any clock.
#[test]
fn values_at_the_limits_are_taken() {
    for (length, words) in [(4095, "after 6 of 4095 bytes"), (4096, "after 2 of 4096 bytes")] {
        let line = format!("uds -d virtual:load=0 -b 500k --frame-timeout 100ms raw {}", "22".repeat(length));
        let (code, said) = badly(&line);
        assert!(
            code == Some(1) && said.contains("no flow control came within 100 ms") && said.contains(words),
            "{said}"
        );
    }
    for (pair, patience) in [("7FF:7FE", "100ms"), ("1FFFFFFF:1FFFFFFE", "100ms"), ("000:7FF", "50ms")] {
        let line = format!(
            "uds -d virtual:load=0 -b 500k --pair {pair} --p2 999999999h --patience {patience} read FFFF"
        );
        let (code, said) = badly(&line);
        assert!(
            code == Some(1) && said.contains(&format!("no answer within {}", &patience.replace("ms", " ms"))),
            "{said}"
        );
    }
    for line in [
        "canopen -d virtual:canopen -b 500k --timeout 999999999h --patience 999999999h read 5 1000",
        "canopen -d virtual:canopen -b 500k sync --period 10ms -n 2 --cob-id 1FFFFFFF",
        "canopen -d virtual:canopen -b 500k heartbeat 127 --period 47us -n 2",
        "canopen -d virtual:canopen -b 500k write 5 2000 0 @/dev/null",
        "j1939 -d virtual:load=0 -b 250k claim --address 253 --name FFFFFFFFFFFFFFFF",
    ] {
        let (code, said) = badly(line);
        assert_eq!(code, Some(0), "{line}: {said}");
    }
}

#[test]
fn wrong_words_are_exit_code_2() {
    for line in [
        "uds -d virtual:car read XYZ",
        "uds -d virtual:car raw 22F19",
        "uds -d virtual:car --pair 7E0 read F190",
        "uds -d virtual:car --separation 1500us read F190",
        "uds -d virtual:car --security 2 --key-command true read F190",
        "uds -d virtual:car tester-present --period 9ms",
        "uds -d virtual:car --pair 800:801 read F190",
        "uds -d virtual:car --pair 20000000:7E8 read F190",
        "uds -d virtual:car --pair 7E0:7E0 read F190",
        "uds -d virtual:car --p2 0ms read F190",
        "uds -d virtual:car --max-waits 4294967296 read F190",
        "uds -d virtual:car read 10000",
        "canopen -d virtual:canopen read 5 1000 --sdo 605:605",
        "canopen -d virtual:canopen read 5 1000 --sdo 605/1:585/2",
        "canopen -d virtual:canopen read 128 1000",
        "canopen -d virtual:canopen read 5 10000",
        "canopen -d virtual:canopen read 5 1000 100",
        "canopen -d virtual:canopen scan 0-5",
        "canopen -d virtual:canopen sync --period 10ms --cob-id 800",
        "canopen -d virtual:canopen sync --period 10ms --cob-id 20000000",
        "canopen -d virtual:canopen lss --identity 1:2:3",
        "j1939 -d virtual:load=0 request 262144",
        "j1939 -d virtual:load=0 request 65260 --to 254",
        "j1939 -d virtual:load=0 claim --address 254",
        "j1939 -d virtual:load=0 claim --name 10000000000000000",
        "j1939 -d virtual:load=0 send 0xFEEC 0",
        "j1939 -d virtual:load=0 --timeout 0s request 65260",
        "obd -d virtual:car live GG",
    ] {
        assert_eq!(badly(line).0, Some(2), "{line}");
    }
}

/// On a terminal the table stays where it is, above it what was there before.
#[cfg(unix)]
#[test]
fn a_watched_table_is_drawn_over_the_one_before() {
    let mut view = Terminal::start("obd -d virtual:car watch 0C 0D --period 50ms", (80, 24));
    view.wait_for("0C   engine_speed");
    let times = |text: &str, what: &str| text.matches(what).count();
    // More than two rounds: the speed of a car that moves off.
    let text = view.wait_until("a range", |screen| {
        let speed = screen.lines().find(|line| line.starts_with("0C   engine_speed"));
        let cells = speed.map(|line| line.split_whitespace().collect::<Vec<_>>()).unwrap_or_default();
        cells.len() == 7 && cells[5] != cells[6]
    });
    assert_eq!((times(&text, "PID  name"), times(&text, "0D   vehicle_speed")), (1, 2), "{text}");
    // One that is too low shows as much as it can, and says how much that is not.
    view.resize((40, 4));
    let text = view.wait_for("2 more: ");
    assert!(text.lines().all(|line| line.chars().count() <= 40), "{text}");
    // The value is there, and the name is shorter.
    let engine = text.lines().find(|line| line.starts_with("0C   engine")).unwrap_or_default();
    assert!(engine.contains(" rpm"), "{text}");
    view.keys("q");
    assert_eq!(view.end(), 0);
}

/// Found as a newcomer: after Ctrl-Z, a pause and `fg`, the device had "not answered within 2 s".
#[cfg(unix)]
#[test]
fn a_table_of_values_that_was_stopped_for_a_while_goes_on() {
    let mut view = Terminal::start("obd -d virtual:car watch 0C 0D --period 50ms", (80, 24));
    view.wait_for("engine_speed");
    view.signal("STOP");
    // Longer than a device may take to answer.
    std::thread::sleep(std::time::Duration::from_secs(3));
    view.signal("CONT");
    let before = view.text();
    view.wait_until("other values", |screen| screen != before && screen.contains("engine_speed"));
    view.keys("q");
    assert_eq!(view.end(), 0, "{}", view.text());
}
