//! `cantap uds`, `canopen` and `j1939` with nodes of other programs: can-isotp, python-canopen and can-j1939 on a board shared by `cantap
//! serve`, connected through python-can's socketcand.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use crate::schema;
use crate::served;
use cantap_testing::peers;

use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, Output, Stdio};

use schema::Schema;
use serde_json::Value;
use served::Served;

/// A bus on which nobody but the peer says anything.
const NO_NODE: &str = "virtual:load=0";
const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

/// A shared board and a node on its bus.
struct Rig {
    served: Served,
    peer: Child,
    /// What the peer prints from now on.
    said: BufReader<ChildStdout>,
}

impl Rig {
    /// A device, and what `node_peer.py` calls `kind` on its bus; `None` without the Python `packages` for it.
    fn new(device: &str, packages: &str, kind: &str) -> Option<Self> {
        let python = peers::python_with(&format!("can, {packages}"))?;
        let served = Served::start(device, Stdio::inherit());
        let [host, port] = &served.socketcand;
        let mut peer = Command::new(python)
            .args([concat!(env!("CARGO_MANIFEST_DIR"), "/tests/node_peer.py"), kind, host, port])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut said = BufReader::new(peer.stdout.take().unwrap());
        let mut ready = String::new();
        let _ = said.read_line(&mut ready);
        let rig = Self { served, peer, said };
        assert_eq!(ready.trim_end(), "ready");
        Some(rig)
    }

    fn run(&self, line: &str) -> (Option<i32>, String, String) {
        let mut words = line.split(' ');
        let mut command = Command::new(CANTAP);
        command.arg(words.next().unwrap()).args(["-d", &self.served.at, "-b", "500k"]).args(words);
        let Output { status, stdout, stderr } =
            command.current_dir(self.served.folder.path()).output().unwrap();
        (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
    }

    /// What must succeed: the peer is an interpreter on a computer that may be busy, so it has longer than a node on a bus.
    fn well(&self, line: &str) -> String {
        let (command, rest) = line.split_once(' ').unwrap();
        let patience = match (command, rest.split(' ').next()) {
            ("uds", _) if !rest.contains("scan") && !rest.contains("--p2") => " --p2 30s --frame-timeout 30s",
            // Both wait this long wherever nobody has to answer.
            ("obd", _) => " --p2 1s",
            ("canopen", Some("lss")) => " --timeout 400ms",
            ("canopen", Some("read" | "write")) => " --timeout 30s",
            ("canopen", Some("drive")) => " --timeout 30s --confirm 30s",
            _ => "",
        };
        let (code, out, err) = self.run(&format!("{line}{patience}"));
        assert_eq!(code, Some(0), "{line}: {out}{err}");
        out
    }

    /// Each line's object, checked against its type.
    fn json(&self, line: &str, name: &str) -> Vec<Value> {
        let schema = Schema::new(include_str!("../../../docs/json.schema.json"));
        let out = self.well(&format!("{line} --json"));
        let objects: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert!(!objects.is_empty(), "{line}");
        for object in &objects {
            assert_eq!(schema.faults(name, object), [""; 0], "{object}");
        }
        objects
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.peer.kill();
        let _ = self.peer.wait();
    }
}

/// Servers of all kinds: prompt, late, refusing, flooding, with an address, with 29 bits; and an identifier that another node uses.
#[test]
fn a_scan_finds_every_ecu_and_disturbs_nobody() {
    let Some(rig) = Rig::new(NO_NODE, "can", "servers") else { return };
    let found = &rig.json("uds scan bmw", "uds_scan")[0];
    let servers = found["servers"].as_array().unwrap();
    let pairs: Vec<_> = servers
        .iter()
        .map(|server| {
            format!("{}:{}", server["request"].as_str().unwrap_or("?"), server["answer"].as_str().unwrap())
        })
        .collect();
    let wanted = ["6F1/12:612/F1", "7E0:7E8", "7E1:7E9", "7E2:7EA", "7E3:7EB", "18DA10F1:18DAF110"];
    assert_eq!(pairs, wanted, "{found}");
    let with = |answer: &str| servers.iter().find(|server| server["answer"] == answer).unwrap();
    assert_eq!(with("7E8")["functional"], true);
    assert_eq!(with("7EA")["nrc"], 0x11);
    assert!(with("7EB")["answers"].as_u64().unwrap() > 10, "{found}");
    assert!(with("7E9")["after_ms"].as_f64().unwrap() > 100.0, "{found}");
    assert_eq!(found["not_asked"], serde_json::json!(["7E5"]));
    let (code, _, err) = rig.run("uds scan --session extended");
    assert!(code == Some(2) && err.contains("opens no session"), "{err}");
    let (code, _, err) = rig.run("uds scan opel-or-so");
    assert!(code == Some(2) && err.contains("vag, toyota"), "{err}");
}

#[test]
fn an_ecu_on_can_isotp_is_asked_unlocked_and_given_long_requests() {
    let Some(rig) = Rig::new(NO_NODE, "isotp", "uds") else { return };
    let read = rig.json("uds read F190 F18C", "conversations");
    assert_eq!(read[0]["fields"]["value"], "WVWZZZ1KZAW000001");
    assert_eq!(
        (&read[1]["fields"]["value"], &read[1]["fields"]["pending"]),
        (&"SERIAL-42".into(), &2.into())
    );
    let out = rig.well("uds read F190 --block-size 1 --separation 5ms --padding none");
    assert!(out.contains("WVWZZZ1KZAW000001"), "{out}");
    assert!(rig.well("uds dtc --mask 09").contains("P0123-11"));
    // The seed, in hexadecimal, is inverted: 11223344 becomes EEDDCCBB.
    let key = "tr${IFS}0123456789ABCDEF${IFS}FEDCBA9876543210";
    let out =
        rig.well(&format!("uds --session extended --security 1 --key-command {key} routine start FF00"));
    assert_eq!(out.lines().count(), 4, "{out}");
    let out = rig.well(&format!("uds --security 1 --key-command echo${{IFS}}{{seed}}|{key} tester-present"));
    assert!(out.contains("TesterPresent"), "{out}");
    let (code, _, err) = rig.run("uds --security 1 --key-command echo${IFS}00 tester-present");
    assert!(code == Some(1) && err.contains("invalidKey (35)") && err.contains("--key-command"), "{err}");
    let (code, _, err) = rig.run("uds --security 1 --key-command false tester-present");
    assert!(code == Some(1) && err.contains("no key was sent"), "{err}");
    // A key that does not come must not keep the command for ever.
    let asked = std::time::Instant::now();
    let (code, _, err) =
        rig.run("uds --security 1 --key-command exec${IFS}sleep${IFS}100 --patience 1500ms tester-present");
    assert!(code == Some(1) && err.contains("did not end within 1.5 s") && err.contains("no key"), "{err}");
    assert!(asked.elapsed() < std::time::Duration::from_secs(30));
    // 200 bytes, in blocks of three with a minimum separation.
    let request = "36".repeat(200);
    let said = rig.json(&format!("uds raw {request}"), "conversations");
    assert_eq!(said[0]["data"], "763600C8", "{}", said[0]);
    let (code, _, err) = rig.run("uds read 0001 --p2 300ms");
    assert!(
        code == Some(1) && err.contains("no answer within 300 ms") && err.contains("acknowledged"),
        "{err}"
    );
}

/// The ECU's session ends after three seconds without a request, and the key takes four.
#[test]
fn requests_of_a_file_are_one_session_that_lasts_while_a_key_is_computed() {
    let Some(rig) = Rig::new(NO_NODE, "isotp", "memory") else { return };
    let folder = rig.served.folder.path();
    let image =
        ":10200000000102030405060708090A0B0C0D0E0F58\n:042010001011121386\n:01208000AAB5\n:00000001FF\n";
    std::fs::write(folder.join("image.hex"), image).unwrap();
    let steps = "# All of it in one session.\nsession extended\nsecurity 1\ndownload image.hex --yes\nwait 800ms\n\
                 upload 2000 14 -o back.bin\nupload 2080 1 -o one.bin\n";
    std::fs::write(folder.join("steps.txt"), steps).unwrap();
    let fast = "tr${IFS}0123456789ABCDEF${IFS}FEDCBA9876543210";
    let key = format!("sleep${{IFS}}4;{fast}");
    let all = rig.json(&format!("uds --key-command {key} --keep-alive 500ms run steps.txt"), "conversations");
    let titles: Vec<_> = all.iter().map(|event| event["title"].as_str().unwrap()).collect();
    let count = |title: &str| titles.iter().filter(|one| **one == title).count();
    let counts = ["RequestDownload", "RequestUpload", "RequestTransferExit"].map(count);
    assert_eq!(counts, [2, 2, 4], "{titles:?}");
    let kept = |from: &str, to: &str| {
        let place = |title: &str| titles.iter().position(|one| *one == title).unwrap();
        titles[place(from)..place(to)].iter().filter(|title| **title == "TesterPresent").count()
    };
    // While the key was computed, and during the wait.
    assert!(kept("SecurityAccess", "RequestDownload") >= 2, "{titles:?}");
    assert!(kept("RequestDownload", "RequestUpload") >= 1, "{titles:?}");
    assert_eq!(std::fs::read(folder.join("back.bin")).unwrap(), (0..20).collect::<Vec<u8>>());
    assert_eq!(std::fs::read(folder.join("one.bin")).unwrap(), [0xAA]);
    // Without anything said meanwhile, the session is over, and that is shown.
    let (code, _, err) = rig.run(&format!("uds --key-command {key} --keep-alive 60s run steps.txt"));
    assert!(code == Some(2) && err.contains("steps.txt:6") && err.contains("already exists"), "{err}");
    std::fs::write(folder.join("short.txt"), "session extended\nsecurity 1\n").unwrap();
    let (code, _, err) = rig.run(&format!("uds --key-command {key} --keep-alive 60s run short.txt"));
    assert!(code == Some(1) && err.contains("short.txt:2") && err.contains("(7F)"), "{err}");
    // Memory that is not there: what was written before stays as it is, and no file is left behind.
    let unlocked = format!("uds --session extended --security 1 --key-command {fast}");
    let (code, _, err) = rig.run(&format!("{unlocked} upload 3000 10 -o none.bin"));
    assert!(code == Some(1) && err.contains("requestOutOfRange (31)"), "{err}");
    assert!(!folder.join("none.bin").exists());
    let (code, _, err) = rig.run(&format!("{unlocked} download image.hex"));
    assert!(code == Some(2) && err.contains("--yes"), "{err}");
}

#[test]
fn a_node_on_python_canopen_is_found_read_written_and_commanded() {
    let Some(rig) = Rig::new(NO_NODE, "canopen", "canopen") else { return };
    let scan = &rig.json("canopen scan", "canopen_scan")[0];
    assert_eq!(scan["nodes"].as_array().unwrap().len(), 1, "{scan}");
    let node = &scan["nodes"][0];
    assert_eq!((&node["node"], &node["device_type"]), (&5.into(), &0x0002_0192.into()), "{node}");
    assert_eq!((&node["vendor_id"], &node["serial_number"]), (&0x29C.into(), &1234.into()), "{node}");
    assert_eq!(node["name"], "A node with a long name");
    let out = rig.well("canopen scan 1-10");
    assert!(out.starts_with("node 5, ") && out.contains("vendor 0000029C"), "{out}");
    // Expedited, segmented both ways, and a block that the node turns into segments.
    let read = rig.json("canopen read 5 1018 4", "conversations");
    assert_eq!(read[0]["kind"], "sdo_read");
    rig.json("canopen write 5 2001 0 123456 --type u32", "conversations");
    assert!(rig.well("canopen read 5 2001").contains("0x0001E240"));
    rig.well("canopen write 5 2000 0 written_in_more_than_one_frame --type text");
    assert!(rig.well("canopen read 5 2000 --block").contains("written_in_more_than_one_frame"));
    rig.well("canopen read 5 2000 -o object.bin");
    assert_eq!(
        std::fs::read(rig.served.folder.path().join("object.bin")).unwrap(),
        b"written_in_more_than_one_frame"
    );
    let (code, _, err) = rig.run("canopen read 5 2000 -o object.bin");
    assert!(code == Some(1) && err.contains("nothing there is overwritten"), "{err}");
    assert_eq!(rig.run("canopen read 5 3000 -o nothing.bin").0, Some(1));
    assert!(!rig.served.folder.path().join("nothing.bin").exists());
    // A sheet provides types and names.
    let sheet = "[DeviceInfo]\nProductName=Node\n[2001]\nParameterName=Counter\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\n";
    std::fs::write(rig.served.folder.path().join("node.eds"), sheet).unwrap();
    rig.well("canopen write 5 2001 0 123456 --eds 5:node.eds");
    let out = rig.well("canopen read 5 2001 --eds 5:node.eds");
    assert!(out.contains("Counter") && out.contains("value 123456"), "{out}");
    assert!(rig.well("canopen read 5 2001 --sdo 605:585").contains("0x0001E240"));
    let (code, _, err) = rig.run("canopen read 5 3000");
    assert!(code == Some(1) && err.contains("object does not exist (06020000)"), "{err}");
    let (code, _, err) = rig.run("canopen write 5 2000 0 @object.bin --block");
    assert!(code == Some(1) && err.contains("omit --block"), "{err}");
    let (code, _, err) = rig.run("canopen read 6 1000 --timeout 200ms");
    assert!(
        code == Some(1) && err.contains("no answer within 200 ms") && err.contains("cantap canopen scan"),
        "{err}"
    );
    let (code, _, err) = rig.run("canopen write 5 2002 0 1");
    assert!(code == Some(2) && err.contains("--type"), "{err}");
    // Its state from its heartbeat.
    rig.well("canopen write 5 1017 0 100");
    let out = rig.well("canopen nmt 5 start");
    assert!(out.contains("start") && out.contains("operational"), "{out}");
    let monitored = rig.json("canopen monitor -t 500ms", "conversations");
    assert!(monitored.iter().any(|event| event["from"] == "5"), "{monitored:?}");
    let out = rig.well("canopen scan --listen 500ms");
    assert!(out.contains("node 5, operational"), "{out}");
    // A node without a number gets one, and then no longer answers.
    let given = &rig.json("canopen lss --node 12 --node-bitrate 250k --store", "canopen_lss")[0];
    assert_eq!((&given["vendor_id"], &given["serial_number"]), (&0x29C.into(), &0x4D2.into()), "{given}");
    let (code, _, err) = rig.run("canopen lss");
    assert!(code == Some(1) && err.contains("no node without a number"), "{err}");
}

/// Its server of objects, its transitions and its statuswords are python-canopen's.
#[test]
fn a_drive_on_python_canopen_is_enabled_moved_and_disabled() {
    let Some(rig) = Rig::new(NO_NODE, "canopen", "drive") else { return };
    let states = |objects: &[Value]| -> Vec<String> {
        let states = objects.iter().flat_map(|object| object["states"].as_array().unwrap());
        states.map(|state| state.as_str().unwrap().to_owned()).collect()
    };
    let up = ["switch on disabled", "ready to switch on", "switched on", "operation enabled"];
    assert_eq!(states(&rig.json("canopen drive 5 enable --yes", "canopen_drive")), up);
    let down = ["operation enabled", "switched on", "ready to switch on", "switch on disabled"];
    assert_eq!(states(&rig.json("canopen drive 5 disable", "canopen_drive")), down);
    for (line, position) in [("1234", 1234), ("-34 --relative", 1200)] {
        let objects = rig.json(&format!("canopen drive 5 position {line} --yes"), "canopen_drive");
        let expected: Vec<_> = up.into_iter().chain(["quick stop active", "switch on disabled"]).collect();
        assert_eq!(states(&objects), expected);
        let last = objects.last().unwrap();
        assert_eq!(
            (&last["position"], &last["mode"], &last["mode_name"]),
            (&position.into(), &1.into(), &"profile position".into())
        );
    }
    let objects = rig.json("canopen drive 5 velocity -700 -t 300ms --yes", "canopen_drive");
    assert_eq!(objects.last().unwrap()["velocity"], 0);
    let (code, _, err) = rig.run("canopen drive 5 velocity -700 -t 300ms --yes --timeout 30s --confirm 30s");
    assert!(
        code == Some(0) && err.contains("at velocity -700; it was stopped, and is switch on disabled"),
        "{err}"
    );
}

#[test]
fn a_node_on_can_j1939_is_seen_asked_and_told() {
    let Some(rig) = Rig::new(NO_NODE, "j1939", "j1939") else { return };
    let claims = rig.json("j1939 claim", "conversations");
    let from = |address: &str| claims.iter().find(|claim| claim["from"] == address);
    assert_eq!(from("129").unwrap()["fields"]["manufacturer"], 666, "{claims:?}");
    assert_eq!(from("249").unwrap()["fields"]["function"], 29, "{claims:?}");
    let data = |line: &str| rig.json(line, "conversations")[0]["data"].as_str().unwrap().to_owned();
    assert_eq!(data("j1939 request 0xFEF6 --to 129"), "0102030405060708");
    // To all in many frames, and to us by RTS/CTS.
    assert!(rig.well("j1939 request 65260 --to 129").contains("WVWZZZ1KZAW000001"));
    assert_eq!(data("j1939 request 0xEF00 --to 129").len(), 200);
    assert!(rig.well("j1939 dm1 --to 129").contains("SPN 100 FMI 3"));
    let all = rig.json("j1939 dm1", "conversations");
    let of =
        |address: &str| all.iter().find(|event| event["from"] == address).unwrap()["data"].as_str().unwrap();
    assert_eq!(of("129"), "04FF64000305FFFF");
    // Several codes, by BAM.
    assert_eq!(of("130"), "10FF640004026E000402BE000402");
    assert!(rig.well("j1939 dm1 --to 130").contains("SPN 110 FMI 4"));
    // A long message to it: what it reports about that is received by another program.
    let message = "01".repeat(150);
    let sent = rig.json(&format!("j1939 send 0xD000 {message} --to 129"), "conversations");
    assert_eq!(sent[0]["data"].as_str().unwrap().len(), 300);
    let (code, _, err) = rig.run("j1939 request 0xFEE5 --to 129");
    assert!(
        code == Some(1) && err.contains("no answer within 1250 ms") && err.contains("j1939 claim"),
        "{err}"
    );
    // The second one's NAME is higher than any: it has to leave its address to us.
    let (code, out, err) = rig.run("j1939 claim --address 130");
    assert!(code == Some(0) && !err.contains("is taken"), "{out}{err}");
    // Its NAME is lower than ours, so it keeps the address.
    let (code, out, err) = rig.run("j1939 claim --address 129");
    assert!(code == Some(0) && err.contains("the address 129 is taken"), "{out}{err}");
    let (code, _, err) = rig.run("j1939 claim --address 129 --name 7FFFFFFFFFFFFFFF");
    assert!(code == Some(1) && err.contains("there is none left to take"), "{err}");
}

/// Who answered, and with what, in the order of the senders.
fn answers(events: &[Value]) -> Vec<(String, String)> {
    let text = |event: &Value, key: &str| event[key].as_str().unwrap_or_default().to_owned();
    let mut answers: Vec<_> = events.iter().map(|event| (text(event, "to"), text(event, "data"))).collect();
    answers.sort();
    answers
}

/// Four ECUs that are asked at once: one has a long answer, one says first that its answer is pending, one refuses, one answers at once. Two of the
/// long ones come at the same time.
#[test]
fn several_ecus_are_asked_at_once_with_identifiers_of_both_lengths() {
    let Some(rig) = Rig::new(NO_NODE, "isotp", "ecus") else { return };
    let hex = |text: &str| text.bytes().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat();
    let vin = |number: u8| format!("62F190{}", hex(&format!("WVWZZZ1KZAW00000{number}")));
    for (line, ids) in [
        ("uds --functional", ["7E8", "7E9", "7EA", "7EB"]),
        ("uds --functional --pair 18DA10F1:18DAF110", ["18DAF110", "18DAF111", "18DAF112", "18DAF113"]),
    ] {
        let (code, out, err) = rig.run(&format!("{line} --p2 500ms --json read F190"));
        // One of them refuses, and the others' answers are there all the same.
        assert_eq!(code, Some(1), "{out}{err}");
        assert!(err.contains(&format!("{} refused ReadDataByIdentifier", ids[2])), "{err}");
        let events: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let expected = [vin(1), vin(2), "7F2231".to_owned(), "62F1904634".to_owned()];
        let expected: Vec<_> = ids.map(str::to_owned).into_iter().zip(expected).collect();
        assert_eq!(answers(&events), expected, "{out}");
        let pending = events.iter().find(|event| event["to"] == ids[1]).unwrap();
        assert_eq!(pending["fields"]["pending"], 2, "{pending}");
        // One of them by itself, with a request in many frames, for which it has flow control of its own.
        let pair = if ids[0] == "7E8" { "7E1:7E9" } else { "18DA11F1:18DAF111" };
        let said = rig.json(&format!("uds --pair {pair} raw {}", "36".repeat(100)), "conversations");
        assert_eq!(said[0]["data"], "76360064", "{}", said[0]);
    }
}

/// The same four as a scan tool finds them, first with 7DF, and where that is nobody's, with 18DB33F1.
#[test]
fn a_vehicle_of_several_ecus_is_asked_with_identifiers_of_both_lengths() {
    for (kind, ids) in [("obd", ["7E8", "7E9"]), ("obd_29", ["18DAF110", "18DAF111"])] {
        let Some(rig) = Rig::new(NO_NODE, "isotp", kind) else { return };
        let out = rig.well("obd supported");
        let has = |pid: &str, who: &str| out.lines().any(|line| line.starts_with(pid) && line.ends_with(who));
        assert!(has("0C", ids[0]) && has("0D", &ids.join(", ")), "{out}");
        let live = rig.json("obd live 0C 0D -n 1", "conversations");
        assert_eq!(
            answers(&live),
            [(ids[0], "410C1AF8"), (ids[0], "410D32"), (ids[1], "410D31")]
                .map(|(id, data)| (id.to_owned(), data.to_owned()))
        );
        // Four codes are more than one frame has.
        let out = rig.well("obd codes");
        assert!(out.contains("P0133") && out.contains("P0301, P0302, P0303, C0155"), "{out}");
        let out = rig.well("obd vin");
        assert!(out.contains("WVWZZZ1KZAW000001") && out.contains("WVWZZZ1KZAW000002"), "{out}");
    }
}

/// SAE J1979-2: none of OBD-II's own services is answered.
#[test]
fn a_vehicle_with_obd_over_uds_is_asked_that_way() {
    let Some(rig) = Rig::new(NO_NODE, "isotp", "obd_on_uds") else { return };
    let out = rig.well("obd supported");
    assert!(out.lines().any(|line| line.starts_with("0C  engine_speed") && line.ends_with("7E8")), "{out}");
    assert!(out.lines().any(|line| line.starts_with("0D") && line.ends_with("7E8, 7E9")), "{out}");
    let live = rig.json("obd live 0C 0D -n 1", "conversations");
    let mut data: Vec<_> = live.iter().map(|event| event["data"].as_str().unwrap()).collect();
    data.sort_unstable();
    assert_eq!(data, ["62F40C1AF8", "62F40D31", "62F40D32"]);
    assert_eq!(live[0]["fields"]["engine_speed"], 1726.0, "{}", live[0]);
    let out = rig.well("obd codes");
    assert!(out.contains("P0133-00 (confirmed)"), "{out}");
    assert!(rig.well("obd vin").contains("WVWZZZ1KZAW000001"));
    assert!(rig.well("obd clear --yes").contains("ClearDiagnosticInformation"));
}

/// The other way round: a tester of theirs, on our car.
#[test]
fn udsoncan_over_can_isotp_reads_what_we_read() {
    let Some(mut rig) = Rig::new("virtual:car", "isotp, udsoncan", "tester") else { return };
    let mut line = String::new();
    rig.said.read_line(&mut line).unwrap();
    let said: Value = serde_json::from_str(&line).unwrap();
    let ours = rig.json("uds --session extended read F190 F187 F18C", "conversations");
    for (at, did) in [(1, "F190"), (2, "F187"), (3, "F18C")] {
        assert_eq!(ours[at]["fields"]["value"], said[did], "{said}");
    }
    assert_eq!(said["codes"], serde_json::json!([[0x01_2800, 0x2A]]), "{said}");
    assert_eq!((&said["refused"], &said["after"]), (&0x11.into(), &0.into()), "{said}");
    assert_eq!(rig.json("uds dtc", "conversations")[0]["fields"]["trouble_codes"], 0);
}
