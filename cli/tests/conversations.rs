//! `cantap conversations` as users run it.

use std::path::PathBuf;
use std::process::{Command, Output};

fn cantap(test: &str, log: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(test);
    std::fs::create_dir_all(&directory).unwrap();
    std::fs::write(directory.join("bus.log"), log).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { status, stdout, stderr } =
        command.args(["conversations", "bus.log"]).args(arguments).current_dir(directory).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A workshop: a VIN is read while the car talks, a service is refused, one transfer breaks, nobody answers the last request.
const WORKSHOP: &str = "\
(1.000000) can0 7E0#0322F190AAAAAAAA
(1.000500) can0 123#1008112233445566
(1.002500) can0 7E8#101462F190575657
(1.003000) can0 7E0#300000AAAAAAAAAA
(1.004000) can0 7E8#215A5A5A314B5A41
(1.005000) can0 7E8#2257303030303031
(2.000000) can0 7E0#022703AAAAAAAAAA
(2.001500) can0 7E8#037F2733AAAAAAAA
(3.000000) can0 7DF#02010CAAAAAAAAAA
(3.001000) can0 7E8#04410C1AF8AAAAAA
(3.002000) can0 7E8#101462F190575657
(3.003000) can0 7E0#300000AAAAAAAAAA
(3.004000) can0 7E8#2257303030303031
(4.000000) can0 7E0#023E00AAAAAAAAAA
";

#[test]
fn frames_are_shown_as_what_they_say() {
    let (code, out, err) = cantap("conversations_text", WORKSHOP, &[]);
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(
        out,
        "(1.005000) can0 uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF190 (VIN), value \"WVWZZZ1KZAW000001\", \
         after 2.5 ms\n\
         (2.001500) can0 uds 7E0 > 7E8 SecurityAccess: sid 0x27, sub_function 0x03 (request seed), \
         nrc 0x33 (securityAccessDenied), after 1.5 ms\n\
         (3.001000) can0 obd 7DF > 7E8 current data: sid 0x01, pid 0x0C (engine_speed), engine_speed 1726 rpm, asked \"all\", \
         after 1 ms\n\
         (3.004000) can0 isotp 7E8 > 7E0 broken transfer: length 20 bytes, received 6 bytes, block_size 0, separation_us 0, \
         data 62 F1 90 57 56 57; frame 2 came instead of 1\n\
         (4.000000) can0 uds 7E0 > 7E8 TesterPresent: sid 0x3E, sub_function 0x00 (zero), response \"none\"; the trace ends here\n"
    );
    assert_eq!(
        err,
        "cantap: channel 1 speaks uds, obd\ncantap: 14 frames: 1 isotp (1 with a fault), 3 uds (2 with a fault), 1 obd\n"
    );
}

#[test]
fn one_protocol_or_only_faults_can_be_asked_for() {
    let lines = |arguments: &[&str]| cantap("conversations_choice", WORKSHOP, arguments).1.lines().count();
    assert_eq!(lines(&["--protocol", "obd"]), 1);
    assert_eq!(lines(&["--protocol", "uds,obd"]), 4);
    assert_eq!(lines(&["--faults"]), 3);
    // Each message by itself, and the broken one.
    assert_eq!(lines(&["--protocol", "isotp"]), 8);
    let (code, _, err) = cantap("conversations_choice", WORKSHOP, &["--protocol", "odb"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("there is no protocol 'odb'; there are isotp, uds"), "{err}");
    let (code, _, err) = cantap("conversations_choice", WORKSHOP, &["--pair", "7E0"]);
    assert!(code == Some(2) && err.contains("as 7E0:7E8"), "{err}");
}

#[test]
fn programs_get_an_object_for_each_line() {
    let (code, out, err) = cantap("conversations_json", WORKSHOP, &["--json", "--quiet"]);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    let objects: Vec<serde_json::Value> =
        out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let first = &objects[0];
    assert_eq!(first["time_s"], 1.005);
    assert_eq!(first["start_s"], 1.0);
    assert_eq!(
        (&first["channel"], &first["protocol"], &first["kind"]),
        (&1.into(), &"uds".into(), &"exchange".into())
    );
    assert_eq!((&first["from"], &first["to"]), (&"7E0".into(), &"7E8".into()));
    assert_eq!(
        (&first["fields"]["sid"], &first["fields"]["did"], &first["texts"]["did"]),
        (&0x22.into(), &0xF190.into(), &"VIN".into())
    );
    assert_eq!((&first["response_ms"], &first["frames"]), (&2.5.into(), &5.into()));
    assert_eq!(first["data"], "62F1905756575A5A5A314B5A4157303030303031");
    assert_eq!(
        (&objects[1]["kind"], &objects[1]["texts"]["nrc"]),
        (&"refusal".into(), &"securityAccessDenied".into())
    );
    assert_eq!(objects[2]["units"]["engine_speed"], "rpm");
    assert_eq!((&objects[3]["trouble"], &objects[3]["kind"]), (&"sequence".into(), &"broken".into()));
    assert_eq!(objects[4]["kind"], "no_response");
}

#[test]
fn a_loss_in_the_middle_is_said() {
    let log = "(1.0) can0 7E0#0322F190\n(1.002) can0 7E8#101462F190575657\n(1.003) can0 7E0#300000\n\
               (1.0035) can0 20000004#0001000000000000\n\
               (1.004) can0 7E8#215A5A5A314B5A41\n(1.005) can0 7E8#2257303030303031\n";
    let (code, out, err) = cantap("conversations_loss", log, &["--protocol", "uds"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.ends_with("after 2 ms; frames were lost meanwhile\n"), "{out}{err}");
    assert!(err.contains("are missing in the trace"), "{err}");
}

#[test]
fn a_bus_that_speaks_nothing_known_says_what_to_do() {
    let (code, out, err) = cantap("conversations_none", "(1.0) can0 123#11\n(2.0) can0 123#12\n", &[]);
    assert_eq!((code, out.as_str()), (Some(0), ""));
    assert!(err.contains("name one with --protocol"), "{err}");
}
