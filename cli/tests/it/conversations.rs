//! `cantap conversations` as users run it.

use std::path::PathBuf;
use std::process::{Command, Output};

fn cantap(test: &str, log: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("conversations").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    std::fs::write(directory.join("bus.log"), log).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { status, stdout, stderr } =
        command.args(["conversations", "bus.log"]).args(arguments).current_dir(directory).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A workshop: a VIN is read while the car talks, a service is refused, one transfer breaks, and the last request is not
/// answered.
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

/// A sprayer at a terminal and a task controller: it was bytes, with PGNs for names.
#[test]
fn what_agricultural_machines_say_has_names_and_values() {
    let lines = (1..=9).map(|second| {
        format!(
            "({second}.000000) can0 0CF00400#017DA06813FFF0FF\n({second}.100000) can0 0CFE4800#B80B40420F00FFD5\n\
             ({second}.200000) can0 14E72680#A8D204FF3930000{second}\n({second}.210000) can0 14E68026#A8D204003930000{second}\n\
             ({second}.300000) can0 0CCBF780#33004800B004000{second}\n"
        )
    });
    let log = lines.collect::<Vec<_>>().concat();
    let (code, out, err) = cantap("tractor", &log, &[]);
    assert!(code == Some(0) && err.contains("channel 1 speaks j1939\n"), "{err}");
    for line in [
        "0 > all wheel-based speed and distance: pgn 65096, priority 3, wheel_based_machine_speed 3 m/s,",
        "128 > 38 ECU to VT: change numeric value: pgn 59136, priority 5, function 0xA8 (change numeric value), object 1234, value 16789561",
        "38 > 128 VT to ECU: change numeric value: pgn 58880, priority 5, function 0xA8 (change numeric value), object 1234, errors 0x00 (none),",
        "128 > 247 process data: value: pgn 51968, priority 3, command 3 (value), element 3, ddi 72 (Actual Volume Content), \
         actual_volume_content 16778416 ml",
    ] {
        assert!(out.contains(line), "{line} in {out}");
    }
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("conversations").join("tractor");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let view = ["monitor", "bus.log", "--once", "--view", "nodes", "--size", "160x50"];
    let shown =
        String::from_utf8(command.args(view).current_dir(&directory).output().unwrap().stdout).unwrap();
    assert!(shown.contains("ECU to VT: change numeric value"), "{shown}");
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let plot = [
        "plot",
        "bus.log",
        "-s",
        "j1939.actual_volume_content",
        "-s",
        "j1939.wheel_based_*",
        "--json",
        "-o",
        "a.svg",
    ];
    let drawn =
        String::from_utf8(command.args(plot).current_dir(&directory).output().unwrap().stdout).unwrap();
    assert!(
        drawn.contains(r#"["j1939.actual_volume_content","j1939.wheel_based_direction","j1939.wheel_based_machine_distance","j1939.wheel_based_machine_speed"]"#),
        "{drawn}"
    );
}

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

/// A tester that is plugged in, and a machine that is switched on, long after the first frames: both are read, and this is said.
#[test]
fn what_begins_later_is_not_left_out() {
    let car = (0..1000).map(|at| {
        format!("({}.{:03}000) can0 {:03X}#1122334455667788\n", at / 100, at % 100 * 10, 0x100 + at % 5)
    });
    let tester = "(10.500000) can0 7E0#0322F18C\n(10.501000) can0 7E8#0462F18C41\n".to_owned();
    let machine = (0..40).map(|at| format!("(11.{at:02}0000) can1 705#05\n(11.{at:02}5000) can1 185#0102\n"));
    let log: String = car.chain([tester]).chain(machine).collect();
    let (code, out, err) = cantap("conversations_later", &log, &[]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("(10.501000) can0 uds 7E0 > 7E8 ReadDataByIdentifier"), "{out}");
    assert!(err.contains("cantap: channel 1 speaks uds from 10.500000 on\n"), "{err}");
    let pdos = out.lines().filter(|line| line.contains("can1 canopen") && line.contains("PDO")).count();
    assert_eq!(pdos, 40, "{out}");
    assert!(err.contains("cantap: channel 2 speaks canopen from 11.000000 on\n"), "{err}");
    // On a channel that has had other frames, what came before the first sign may have been more of it.
    let beside = log.replace("can1", "can0");
    let (_, out, err) = cantap("conversations_later_beside", &beside, &[]);
    assert!(out.contains("can0 canopen 5 operational") && out.contains("can0 uds"), "{out}");
    let said = "cantap: channel 1 speaks canopen from 11.000000 on; --protocol canopen reads what came before by it, too\n";
    assert!(err.contains(said), "{err}");
    let (_, out, err) = cantap("conversations_later", &log, &["--quiet"]);
    assert!(out.contains("can1 canopen") && !err.contains("speaks"), "{err}");
}

#[test]
fn one_protocol_or_only_faults_can_be_asked_for() {
    let lines = |arguments: &[&str]| cantap("conversations_choice", WORKSHOP, arguments).1.lines().count();
    // The broken one may have been one of theirs.
    assert_eq!(lines(&["--protocol", "obd"]), 2);
    assert_eq!(lines(&["--protocol", "uds,obd"]), 5);
    assert_eq!(lines(&["--protocol", "j1939"]), 0);
    assert_eq!(lines(&["--faults"]), 3);
    // Each message on its own, and the broken one.
    assert_eq!(lines(&["--protocol", "isotp"]), 8);
    let (code, _, err) = cantap("conversations_choice", WORKSHOP, &["--protocol", "odb"]);
    assert_eq!(code, Some(2));
    assert!(err.contains("there is no protocol 'odb'; there are isotp, uds"), "{err}");
    let (code, _, err) = cantap("conversations_choice", WORKSHOP, &["--pair", "7E0"]);
    assert!(code == Some(2) && err.contains("as 7E0:7E8"), "{err}");
}

#[test]
fn programs_get_an_object_for_each_line() {
    let (code, out, err) = cantap("conversations_json", WORKSHOP, &["--json"]);
    assert_eq!(code, Some(0), "{err}");
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
    let summary = &objects[5]["summary"];
    assert_eq!((&summary["frames"], &summary["faults"]["uds"]), (&14.into(), &2.into()));
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

/// A vehicle on channel 1, a machine on channel 2, a boat on channel 3, a plant on channel 4: each is decoded by its own
/// protocol.
#[test]
fn each_channel_is_read_by_what_it_speaks() {
    let log = "\
(1.0) can0 0CF00400#FFFFFF6813FFFFFF
(1.1) can0 18FEF100#0000000000000000
(1.2) can0 18FECAFF#04FFBE0A0302FFFF
(1.0) can1 705#00
(1.1) can1 605#4018100100000000
(1.2) can1 585#4318100178563412
(1.3) can1 185#0102
(1.0) can2 09F80102#36729A16021AB80D
(1.1) can2 09F80102#36729A16021AB80D
(1.0) can3 42F#00010078563412
(2.0) can3 42F#00010078563412
(3.0) can3 42C#000E010107
(3.1) can3 42B#008E05
";
    let (code, out, err) = cantap("conversations_all", log, &[]);
    assert_eq!(code, Some(0), "{err}");
    for (channel, protocol) in [(1, "j1939"), (2, "canopen"), (3, "nmea2000"), (4, "devicenet")] {
        assert!(err.contains(&format!("channel {channel} speaks {protocol}\n")), "{err}");
        let of_channel: Vec<_> =
            out.lines().filter(|line| line.contains(&format!(" can{} ", channel - 1))).collect();
        assert!(of_channel.len() >= 2, "{out}");
        assert!(of_channel.iter().all(|line| line.contains(protocol)), "{out}");
    }
    assert!(out.contains("Latitude 37.9220534 deg"), "{out}");
    assert!(out.contains("SPN 2750 FMI 3"), "{out}");
}

#[test]
fn a_sheet_names_what_pdos_carry_and_one_that_is_none_is_refused() {
    let directory =
        PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("conversations").join("conversations_sheet");
    std::fs::create_dir_all(&directory).unwrap();
    let sheet = "[DeviceInfo]\n[1A00]\nObjectType=9\n[1A00sub0]\nDefaultValue=1\n[1A00sub1]\nDefaultValue=0x60410010\n\
                 [6041]\nParameterName=Statusword\nDataType=6\nrubbish\n";
    std::fs::write(directory.join("drive.eds"), sheet).unwrap();
    let log = "(1.0) can0 705#00\n(1.1) can0 185#3702\n(1.2) can0 186#3702\n";
    let (code, out, err) = cantap("conversations_sheet", log, &["--eds", "5:drive.eds"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(
        out.contains(
            "TPDO1: Statusword 0x0237 (operation enabled), status_flags \"voltage enabled, remote\"\n"
        ) && out.contains("TPDO1: data 37 02\n"),
        "{out}"
    );
    assert!(err.contains("drive.eds: line 11: neither a section nor a key: rubbish"), "{err}");
    let (code, _, err) = cantap("conversations_sheet", log, &["--eds", "bus.log"]);
    assert!(code == Some(1) && err.contains("is not an EDS, DCF, XDD or XDC"), "{err}");
    let (code, _, err) = cantap("conversations_sheet", log, &["--eds", "200:drive.eds"]);
    assert!(code == Some(2) && err.contains("nodes from 1 to 127"), "{err}");
}

/// Identifiers that no standard has, from the first request on: the same exchanges in text, as JSON and as columns.
#[test]
fn a_makers_pairs_are_read_alike_in_every_form() {
    let bmw = ["12", "18", "40"].iter().zip(1..).flat_map(|(ecu, second)| {
        [
            format!("({second}.000000) can0 6F1#{ecu}0322F190\n"),
            format!("({second}.005000) can0 6{ecu}#F1101462F1905742\n"),
            format!("({second}.010000) can0 6F1#{ecu}300000\n"),
            format!("({second}.015000) can0 6{ecu}#F121415A5A5A3132\n"),
            format!("({second}.020000) can0 6{ecu}#F122333435363738\n"),
            format!("({second}.025000) can0 6{ecu}#F12339303132FFFF\n"),
            format!("({second}.100000) can0 6F1#{ecu}021003\n"),
            format!("({second}.105000) can0 6{ecu}#F1065003003201F4\n"),
        ]
    });
    let bmw: String = bmw.collect();
    let (_, text, err) = cantap("makers_pairs", &bmw, &[]);
    assert_eq!(text.lines().count(), 6, "{text}");
    assert!(text.lines().all(|line| line.contains(" uds 6F1/") && line.ends_with("after 5 ms")), "{text}");
    assert!(err.starts_with("cantap: channel 1 speaks uds\n"), "{err}");
    let (_, json, _) = cantap("makers_pairs", &bmw, &["--json", "--quiet"]);
    let kinds: Vec<_> = json.lines().map(|line| line.contains("\"kind\":\"exchange\"")).collect();
    assert_eq!(kinds, [true; 6], "{json}");
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("conversations/makers_pairs");
    let wide = ["decode", "bus.log", "--protocols", "--wide", "--csv", "--quiet"];
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(wide).current_dir(directory).output().unwrap();
    let table = String::from_utf8(output.stdout).unwrap();
    assert!(table.lines().next().is_some_and(|head| head.contains("uds.p2_ms")), "{table}");
    assert_eq!(table.lines().count(), 7, "{table}");

    // A server that never answers is one only if somebody says so.
    let silent = "(1.0) can0 715#0322F19000000000\n(2.0) can0 715#0322F19000000000\n";
    let (_, text, _) = cantap("makers_silent", silent, &[]);
    assert_eq!(text, "");
    let (_, text, _) = cantap("makers_silent", silent, &["--pair", "VAG"]);
    assert_eq!(text.matches("uds 715 > 77F ReadDataByIdentifier").count(), 2, "{text}");
    let (code, _, err) = cantap("makers_silent", silent, &["--pair", "VGA"]);
    assert_eq!(code, Some(2));
    assert!(
        err.contains("'VGA' is not a pair; write two identifiers") && err.contains("vag, toyota"),
        "{err}"
    );
}

/// DroneCAN and Cyphal on two channels, found and told apart; a user's own data types, and one named for a subject.
#[test]
fn dronecan_and_cyphal_are_read_with_their_types_and_a_users_own() {
    let lines = (1..5).flat_map(|second| {
        [
            format!("({second}.000000) can0 1001550A#0{second}0000008C0000C{second}\n"),
            format!("({second}.100000) can0 1051FF0A#2AC{second}\n"),
            format!("({second}.000000) can1 107D552A#0{second}00000001020BE{second}\n"),
            format!("({second}.100000) can1 1065562A#00004841E{second}\n"),
        ]
    });
    let log: String = lines.collect();
    let (code, out, err) = cantap("drones", &log, &[]);
    assert_eq!(code, Some(0), "{err}");
    assert!(
        err.contains("channel 1 speaks dronecan\n") && err.contains("channel 2 speaks cyphal\n"),
        "{err}"
    );
    let line = "(2.000000) can0 dronecan 10 > all uavcan.protocol.NodeStatus: data_type 341, priority 16, transfer 2, uptime_sec 2 s, \
                health 2 (error), mode 1 (initialization), sub_mode 4, vendor_specific_status_code 0\n";
    assert!(out.contains(line), "{out}");
    assert!(out.contains("data type 20991: data_type 20991, priority 16, transfer 1, data 2A\n"), "{out}");
    assert!(
        out.contains("uavcan.node.Heartbeat.1.0: subject 7509") && out.contains("mode.value 2 (maintenance)"),
        "{out}"
    );
    assert!(out.contains("subject 1366: subject 1366, priority 4, transfer 1, data 00 00 48 41\n"), "{out}");
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("conversations").join("drones");
    std::fs::create_dir_all(directory.join("types/own/deeper")).unwrap();
    std::fs::write(directory.join("types/own/20991.Gear.uavcan"), "uint8 gear_pct  # of all\n").unwrap();
    std::fs::write(directory.join("types/own/deeper/Wrong.uavcan"), "uint99 a\n").unwrap();
    let named = ["--dsdl", "types", "--subject", "1366=uavcan.si.unit.voltage.Scalar.1.0"];
    let (code, out, err) = cantap("drones", &log, &named);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("cantap: own.deeper.Wrong: line 1: there is no type own.deeper.uint99\n"), "{err}");
    assert!(out.contains("own.Gear: data_type 20991, priority 16, transfer 1, gear_pct 42 %\n"), "{out}");
    assert!(
        out.contains(
            "uavcan.si.unit.voltage.Scalar.1.0: subject 1366, priority 4, transfer 1, volt 12.5 V\n"
        ),
        "{out}"
    );
    // The live view takes the same, and shows them.
    let view = ["monitor", "bus.log", "--once", "--view", "nodes", "--size", "160x50"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let shown = command.args(view).args(named).current_dir(&directory).output().unwrap();
    let shown = String::from_utf8(shown.stdout).unwrap();
    assert!(shown.contains("gear_pct 42 %") && shown.contains("volt 12.5 V"), "{shown}");
    for (arguments, code, what) in [
        (["--subject", "1366=own.Nothing.1.0"], 1, "is called 'own.Nothing.1.0'"),
        (["--subject", "9000=uavcan.si.unit.voltage.Scalar.1.0"], 2, "subjects from 0 to 8191"),
        (["--dsdl", "nowhere"], 1, "cannot read data types in nowhere"),
        (["--dsdl", "types/own/deeper/none"], 1, "cannot read data types"),
    ] {
        let (exit, _, err) = cantap("drones", &log, &arguments);
        assert!(exit == Some(code) && err.contains(what), "{arguments:?}: {err}");
    }
}
