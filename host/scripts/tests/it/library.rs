//! The ready nodes on simulated buses, asked by scripts; foreign programs ask them in the command's tests.

use cantap_scripts::library::{self, ReadyNode};
use cantap_scripts::{Report, Script};
use cantap_trace::TraceRecord;

use super::{failure, run, script};

/// A ready node, and a script that tests it.
fn ask(seconds: u64, node: &str, tester: &str) -> (Report, Vec<TraceRecord>, Vec<String>) {
    run(seconds, &[library::script(node).unwrap(), script("tester", tester)])
}

fn passes(seconds: u64, node: &str, tester: &str) -> Vec<TraceRecord> {
    let (report, records, lines) = ask(seconds, node, tester);
    assert!(report.is_success() && !report.tests.is_empty(), "{report:#?} {lines:?}");
    records
}

/// Only its first lines run: no node needs another to begin.
#[test]
fn every_ready_node_runs_alone_without_an_error_the_same_each_time() {
    for node in ReadyNode::all() {
        assert!(node.title().len() > 20, "{}", node.name);
        let alone = [library::script(node.name).unwrap()];
        let first = run(5, &alone);
        assert!(first.0.is_success(), "{}: {:?}", node.name, first.0);
        assert_eq!(first, run(5, &alone), "{}", node.name);
        // Nobody asks a vehicle's ECU: it is silent.
        assert_eq!(first.1.is_empty(), node.name == "obd", "{}", node.name);
    }
}

#[test]
fn settings_are_the_nodes_and_a_wrong_one_says_which_there_are() {
    let set = passes(
        1,
        "obd?vin=WVWZZZ1KZAW000001&speed=0x40&codes=",
        r#"fn test_it() {
            check(request("7E0", "7E8", [0x22, 0xF1, 0x90]) == bytes([0x62, 0xF1, 0x90, "WVWZZZ1KZAW000001"]), "VIN");
            check(request("7E0", "7E8", [0x01, 0x0D]) == bytes([0x41, 0x0D, 0x40]), "speed");
            check(request("7E0", "7E8", [0x03]) == bytes([0x43, 0]), "no codes");
        }"#,
    );
    assert!(!set.is_empty());
    let wrong = |settings: &str| failure(&run(1, &[library::script(settings).unwrap()]).0);
    assert_eq!(
        wrong("obd?velocity=3"),
        "it has no setting velocity; it has codes, pending, request, response, speed, vin"
    );
    assert!(
        wrong("obd?speed=fast").contains("the setting speed is a whole number, as in speed=50, and not fast")
    );
    assert!(wrong("obd?codes=P0128,X1").contains("X1 is no trouble code, such as P0128"));
    assert!(wrong("obd?vin=TOO-SHORT").contains("the vin TOO-SHORT has 9 characters; give it the 17"));
    assert!(wrong("engine?codes=1/2").contains("write SPN/FMI/occurrences"));
    assert!(wrong("valves?mac=64").contains("a MAC ID is 0 to 63"));
    let unknown = library::script("boot").unwrap_err().to_string();
    assert_eq!(unknown, "there is no ready node \"boot\"; there are boat, drive, engine, obd, valves");
    let unwritten = library::script("obd?speed").unwrap_err().to_string();
    assert!(unwritten.contains("node:obd?name=value&other=value"), "{unwritten}");
}

#[test]
fn the_vehicle_answers_all_at_once_only_what_it_has() {
    passes(
        10,
        "obd",
        r#"fn test_functional() {
            send("7DF#020100");
            // PIDs 01, 03 to 07, 0B to 11, 13, 1C, 1F, and more beyond.
            check(expect("7E8", "1s").data == bytes("064100BE3FA013CC"), "which there are");
            send("7DF#0201FE");
            check(wait_for("7E8", "100ms") == (), "no refusal to all");
            send("7E0#0201FE");
            check(expect("7E8", "1s").data.extract(0, 4) == bytes("037F0112"), "a refusal to one");
        }
        fn test_clear() {
            check(request("7E0", "7E8", [0x03]) == bytes("430201280301"), "two codes");
            request("7E0", "7E8", [0x04]);
            check(request("7E0", "7E8", [0x03]) == bytes("4300"), "none");
            check(request("7E0", "7E8", [0x0A]) == bytes("4A0201280301"), "permanent ones stay");
        }"#,
    );
}

#[test]
fn two_engines_with_one_address_settle_it_by_their_names() {
    let engine = |identity: u32| {
        let mut script = library::script(&format!("engine?identity={identity}")).unwrap();
        script.name = format!("engine {identity}");
        script
    };
    let (report, records, lines) = run(2, &[engine(5), engine(4)]);
    assert!(report.is_success(), "{report:?}");
    let sent = |prefix: &str| {
        records.iter().filter(|record| record.frame().unwrap().to_string().starts_with(prefix)).count()
    };
    // The loser says that it has no address, and nothing else; EEC1 comes from the winner alone, every 20 ms.
    assert_eq!(sent("18EEFFFE#"), 1, "{lines:?}");
    assert!((95..=100).contains(&sent("0CF00400#")), "{}", sent("0CF00400#"));
    assert!(lines.len() == 1 && lines[0].contains("engine 5: node 0: the address 0 is taken"), "{lines:?}");
}

#[test]
fn the_engine_sends_its_codes_in_many_frames_and_one_in_one() {
    let records = passes(
        5,
        "engine?codes=520192/31/126",
        r#"fn test_dm1() {
            // SPN 520192 = 7F000 hex: 00 F0, and its three highest bits before the FMI (J1939-73, 5.7.1).
            check(expect("pgn:65226", "3s").data == bytes("04FF00F0FF7EFFFF"), "one code, eight bytes");
        }"#,
    );
    assert!(records.iter().all(|record| !record.frame().unwrap().to_string().starts_with("1CECFF00#20")));
    passes(
        5,
        "engine",
        r#"fn test_dm1() {
            let announced = expect("1CECFF00", "3s");
            check(announced.data == bytes("200E0002FFCAFE00"), "14 bytes in 2 frames");
            let first = expect("1CEBFF00", "1s");
            check(first.data == bytes("0114FF6E00000364"), "red and amber, SPN 110 FMI 0, 3 times");
            check(expect("1CEBFF00", "1s").data == bytes("02000101BE000207"), "SPN 100 FMI 1, SPN 190 FMI 2");
        }"#,
    );
}

/// J1939-21, 5.4.4: to all, and the fifth byte says for whom. J1939-73 has no acknowledgement of what was asked of all.
#[test]
fn the_engine_acknowledges_dm11_to_whoever_asked_for_it_alone() {
    passes(
        5,
        "engine",
        r#"fn test_dm11() {
            wait("300ms");
            send("18EAFFF9#D3FE00");
            check(wait_for("18E8FF00", "500ms") == (), "nothing for all");
            send("18EA00F9#D3FE00");
            check(expect("18E8FF00", "1s").data == bytes("00FFFFFFF9D3FE00"), "positive, for F9");
            send("18EA00F9#4CFE00");
            check(expect("18E8FF00", "1s").data == bytes("01FFFFFFF94CFE00"), "negative, for F9");
        }"#,
    );
}

/// By hand from the layouts of explicit messages; the same frames are in the decoder's tests.
#[test]
fn the_valve_block_joins_is_allocated_polled_and_times_out() {
    let records = passes(
        20,
        "valves",
        r#"
        fn ask(text, expected) {
            send(text);
            let answer = expect("42B", "1s");
            check(answer.data == bytes(expected), text + " is answered with " + answer);
        }
        fn test_all() {
            // Silent before it is online; somebody who asks for its MAC ID afterwards is told.
            send("42E#004B03010300");
            check(wait_for("42B", "1900ms") == (), "offline");
            wait("200ms");
            send("42F#00010078563412");
            check(expect("42F", "100ms").data == bytes("80FEFFCA243501"), "in use");
            send("42C#000E010101");
            check(wait_for("42B", "50ms") == (), "not allocated");
            ask("42E#004B03010300", "00CB00");
            ask("42E#014B03010101", "01940C01");
            ask("42C#400E010106", "408ECA243501");
            send("42C#000E010107");
            check(expect("42B", "1s").data == bytes("80008E1263616E74"), "8E, 18 characters, cant");
            send("42C#80C000");
            check(expect("42B", "1s").data == bytes("804161702076616C"), "ap val");
            send("42C#80C100");
            check(expect("42B", "1s").data == bytes("8042766520626C6F"), "ve blo");
            send("42C#80C200");
            check(expect("42B", "1s").data == bytes("8083636B"), "ck");
            send("42C#80C300");
            ask("42C#000E010108", "009414FF");
            ask("42C#000E090101", "009416FF");
            ask("42C#0005050100", "009408FF");
            // Not polled before its expected packet rate is set.
            send("42D#AA55");
            check(wait_for("3C5", "50ms") == (), "not established");
            ask("42C#0010050209C800", "0090C800");
            ask("42C#000E050201", "008E03");
            send("42D#AA55");
            check(expect("3C5", "10ms").data == bytes("000000"), "on their way");
            wait("40ms");
            send("42D#AA55");
            check(expect("3C5", "10ms").data == bytes("AA5501"), "moved");
            ask("42C#000E046503", "008EAA55");
            // 200 ms four times.
            wait("900ms");
            ask("42C#000E050201", "008E04");
            ask("42C#000E046503", "008E0000");
            ask("42E#004C030103", "00CC");
            send("42C#000E010101");
            check(wait_for("42B", "50ms") == (), "released");
        }"#,
    );
    let sent: Vec<String> = records.iter().map(|record| record.frame().unwrap().to_string()).collect();
    assert_eq!(sent.iter().filter(|frame| *frame == "42F#00FEFFCA243501").count(), 2);
    let (report, _, lines) = ask(
        5,
        "valves",
        r#"fn test_taken() { wait("500ms"); send("42F#80010078563412"); wait("3s"); send("42F#00010078563412"); check(wait_for("42F", "50ms") == (), "offline"); }"#,
    );
    assert!(
        report.is_success() && lines[0].ends_with("MAC ID 5 is in use; this node stays offline"),
        "{lines:?}"
    );
}

#[test]
fn the_drive_follows_its_controlword_and_falls_into_a_fault() {
    passes(
        20,
        "drive",
        r#"
        fn ask(text) {
            send(text);
            expect("585", "1s").data
        }
        fn status(controlword) {
            send(frame(0x205, bytes([le(controlword, 2), 3])));
            wait("10ms");
            from_le(ask("605#4041600000000000"), 4, 2)
        }
        fn test_states() {
            // Not operational: a PDO is for nobody.
            check((status(0x06) & 0x3FF) == 0x250, "switch on disabled");
            send("000#0105");
            wait("5ms");
            check((status(0x06) & 0x3FF) == 0x231, "ready to switch on");
            check((status(0x07) & 0x3FF) == 0x233, "switched on");
            check((status(0x0F) & 0x6F) == 0x27, "operation enabled");
            check((status(0x02) & 0x6F) == 0x07, "quick stop active");
            check((status(0x0F) & 0x6F) == 0x27, "and back");
            check((status(0x00) & 0x3FF) == 0x250, "voltage disabled");
            check((status(0x0F) & 0x3FF) == 0x250, "from there only by shutdown");
            check(ask("605#2B00200010230000") == bytes("6000200000000000"), "a fault is made");
            let status = status(0x06);
            check((status & 0x4F) == 0x08, "fault");
            check((status(0x80) & 0x4F) == 0x40, "reset");
        }
        fn test_emergency_and_stop() {
            send("605#2B00200010230000");
            check(expect("085", "1s").data == bytes("1023010000000000"), "emergency");
            wait("5ms");
            send("000#0205");
            send("605#4041600000000000");
            check(wait_for("585", "100ms") == (), "a stopped node has no SDO");
            send("000#8105");
            check(expect("705", "1s").data == bytes("00"), "boot-up");
            check(expect("705", "2s").data == bytes("7F"), "pre-operational");
        }"#,
    );
}

/// CiA 305: a first number applies at once, another one from the next reset.
#[test]
fn the_drive_takes_its_number_from_an_lss_master() {
    let source = library::script("drive?node=255&heartbeat=0").unwrap();
    let tester = script(
        "tester",
        r#"
        fn lss(text) {
            send("7E5#" + text);
            let answer = wait_for("7E4", "20ms");
            if answer == () { "none" } else { from_le(answer.data, 0, 1) + " " + from_le(answer.data, 1, 1) }
        }
        fn test_number() {
            wait("10ms");
            send("000#0100");
            send("67F#4008100000000000");
            check(wait_for("580-77F", "50ms") == (), "without a number it is silent");
            check(lss("4C00000000000000") == "80 0", "it says that it has none");
            check(lss("110C000000000000") == "none", "not while it waits");
            check(lss("0401000000000000") == "none", "all are configured");
            check(lss("1100000000000000") == "17 1", "0 is no number");
            check(lss("110C000000000000") == "17 0", "12 is one");
            send("7E5#0400000000000000");
            check(expect("70C", "50ms").data == bytes("00"), "it boots");
            send("60C#4018100400000000");
            check(from_le(expect("58C", "50ms").data, 4, 4) == 402255, "the serial number stays");
            check(lss("4C00000000000000") == "none", "it has a number");
            check(lss("0401000000000000") == "none", "configured again");
            check(lss("110D000000000000") == "17 0", "13");
            check(lss("5E00000000000000") == "94 12", "still 12");
            send("7E5#0400000000000000");
            check(wait_for("70D", "50ms") == (), "not before a reset");
            send("000#820C");
            check(expect("70D", "50ms").data == bytes("00"), "13 from now on");
        }"#,
    );
    let (report, _, _) = run(5, &[source, tester]);
    assert!(report.is_success(), "{report:?}");
}

/// Position by its speed and course: 3 m/s north-east for an hour.
#[test]
fn the_boat_sails_where_it_heads() {
    let source = library::script("boat?latitude=0.0&longitude=0.0&course=90.0&speed=5.0").unwrap();
    let (report, records, _) = run(100, &[source]);
    assert!(report.is_success());
    let mut positions =
        records.iter().filter(|record| record.frame().unwrap().to_string().starts_with("09F80123#"));
    let last = positions.next_back().unwrap().frame().unwrap();
    let number = |from: usize| i32::from_le_bytes(last.data()[from..from + 4].try_into().unwrap());
    let meters = f64::from(number(4)) * 1e-7 * 111_120.0;
    assert!(number(0).abs() < 2 && (meters - 500.0).abs() < 5.0, "{} {meters}", number(0));
}

/// A script of one's own may serve, too.
#[test]
fn a_handler_that_waits_answers_later_and_one_that_returns_no_bytes_is_an_error() {
    let (report, _, _) = run(
        5,
        &[
            script("server", r#"on_request("7E0", "7E8", |data| { wait("30ms"); [0x7E, 0] });"#),
            script(
                "tester",
                r#"fn test_it() { request("7E0", "7E8", [0x3E, 0]); check(now() > 0.03, "later"); }"#,
            ),
        ],
    );
    assert!(report.is_success(), "{report:?}");
    let server: Script = script("server", r#"on_request("7E0", "7E8", |data| #{ a: 1 });"#);
    let (report, _, _) = run(5, &[server, script("tester", r#"send("7E0#023E00"); wait("100ms");"#)]);
    assert!(failure(&report).contains("is no bytes"), "{report:?}");
}
