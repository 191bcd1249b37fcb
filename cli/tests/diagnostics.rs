//! `cantap obd` and `cantap uds` as users run them, on the virtual car.

use std::process::{Command, Output};

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
    for part in ["7DF > 7E8", "vin \"", "P0128", "engine_speed", "coolant_temperature", "7DF > 7E9"] {
        assert!(out.contains(part), "{part}: {out}");
    }
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
    let (code, said) = badly("obd -d virtual:car live FE -n 1");
    assert!(code == Some(1) && said.contains("cantap obd supported"), "{said}");
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

/// Its engine sends its trouble codes every second, whether requested or not.
#[test]
fn a_node_of_j1939_is_heard_for_a_bounded_time() {
    let started = std::time::Instant::now();
    assert!(well("j1939 -d virtual:car dm1").contains("SPN 110 FMI 17"));
    assert!(started.elapsed() < std::time::Duration::from_secs(10), "{:?}", started.elapsed());
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
    assert!(code == Some(1) && said.contains("nobody acknowledged 1 of 1 frames"), "{said}");
    let (code, said) = badly("obd -d virtual:load=30 -b 500k");
    assert!(
        code == Some(1) && said.contains("no ECU answers") && said.contains("frames of others"),
        "{said}"
    );
}

#[test]
fn wrong_words_are_exit_code_2() {
    for line in [
        "uds -d virtual:car read XYZ",
        "uds -d virtual:car raw 22F19",
        "uds -d virtual:car --pair 7E0 read F190",
        "uds -d virtual:car --separation 1500us read F190",
        "uds -d virtual:car --security 2 --key-command true read F190",
        "obd -d virtual:car live GG",
    ] {
        assert_eq!(badly(line).0, Some(2), "{line}");
    }
}
