//! `virtual:canopen` with another program: python-canopen as its master on a board shared by `cantap serve`, connected through python-can's
//! socketcand, while `cantap conversations` listens. So the server's blocks, the nodes' LSS and the events for both are checked against a
//! master that is not ours.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use crate::served;
use cantap_testing::peers;

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};
use served::Served;

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

#[test]
fn python_canopen_masters_the_nodes_and_a_listener_hears_the_same() {
    let Some(python) = peers::python_with("can, canopen") else { return };
    let mut served = Served::start("virtual:canopen", Stdio::piped());
    let folder = served.folder.path().to_owned();
    let sheet = folder.join("node.eds");
    let printed = Command::new(CANTAP).args(["virtual", "--print-eds"]).output().unwrap();
    std::fs::write(&sheet, &printed.stdout).unwrap();
    let [host, port] = &served.socketcand;
    let heard = folder.join("heard.log");
    let mut listener = Command::new(CANTAP)
        .args(["capture", "-d", &served.at, "-b", "500k", "-t", "2m", "-o"])
        .arg(&heard)
        .stdin(Stdio::null())
        .spawn()
        .unwrap();
    // The server reports that it is ready.
    let mut words = BufReader::new(served.server.stderr.take().unwrap()).lines();
    assert!(words.any(|line| line.unwrap().contains("is in and may")));
    let rest = std::thread::spawn(move || words.count());
    std::thread::sleep(Duration::from_millis(500));
    let peer = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/canopen_master_peer.py");
    let output = Command::new(&python).args([peer, host, port]).arg(&sheet).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    // Ended as by Ctrl-C, so that the file is complete.
    Command::new("kill").args(["-INT", &listener.id().to_string()]).status().unwrap();
    listener.wait().unwrap();
    served.server.kill().unwrap();
    served.server.wait().unwrap();
    rest.join().unwrap();
    assert!(output.status.success(), "{text}");
    let said: Value = serde_json::from_slice(&output.stdout).unwrap();
    for (name, expected) in [
        ("name", json!("cantap virtual drive")),
        ("serial", json!(1001)),
        ("target", json!(-1234)),
        ("refused", json!(["06010002", "06010001", "06020000", "06070010"])),
        ("segments", json!(true)),
        ("blocks", json!(true)),
        ("written_again", json!(true)),
        ("read_again", json!(true)),
        ("state", json!("OPERATIONAL")),
        ("sync_pdo", json!(true)),
        ("status", json!(0x0237)),
        ("timer_pdo", json!(true)),
        ("emergency", json!([0x4210, 1])),
        ("found", json!(true)),
        ("identity", json!([0x29C, 0x4452_5631, 0x1_0000, 1002])),
        ("inquired", json!(1002)),
        ("started", json!(true)),
        ("other_serial", json!(1002)),
    ] {
        assert_eq!(said[name], expected, "{name}: {said}");
    }
    assert!(said["speed"].as_i64().is_some_and(|speed| (1..=500).contains(&speed)), "{said}");

    // What the listener received of it.
    let told = Command::new(CANTAP)
        .args(["conversations", "--json", "--quiet", "--protocol", "canopen"])
        .args(["--eds", &sheet.display().to_string()])
        .arg(&heard)
        .output()
        .unwrap();
    let told = String::from_utf8(told.stdout).unwrap();
    let events: Vec<Value> = told.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |kind: &str| events.iter().filter(|event| event["kind"] == kind).collect::<Vec<_>>();
    let blocks: Vec<_> = events.iter().filter(|event| event["fields"]["transport"] == "block").collect();
    assert_eq!(blocks.len(), 4, "{blocks:?}");
    for (block, (kind, length)) in
        blocks.iter().zip([("sdo_write", 1287), ("sdo_read", 1287), ("sdo_write", 1286), ("sdo_read", 1286)])
    {
        assert_eq!((block["kind"].as_str(), block["trouble"].as_str()), (Some(kind), None), "{block}");
        assert_eq!(
            block["data"].as_str().map(|data| data.replace(' ', "").len() / 2),
            Some(length),
            "{block}"
        );
    }
    assert!(of("lss_answer").iter().any(|event| event["title"] == "LSS inquire serial number"), "{told}");
    assert!(of("emergency").iter().any(|event| event["texts"]["code"].as_str().is_some()), "{told}");
    assert!(of("pdo").iter().any(|event| event["fields"]["Statusword"] == 0x0237), "{told}");
    assert_eq!(of("boot_up").len(), 1, "{told}");
    assert_eq!(
        events
            .iter()
            .filter(|event| event["fields"]["abort"].is_string() || event["fields"]["abort"].is_number())
            .count(),
        4,
        "{told}"
    );
}
