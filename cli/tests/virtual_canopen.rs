//! `virtual:canopen` with another program: python-canopen as its master on a board shared by `cantap serve`, connected through python-can's
//! socketcand, while `cantap conversations` listens. So the server's blocks, the nodes' LSS and the events for both are checked against a
//! master that is not ours.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

fn has_peer(python: &str) -> bool {
    let there = Command::new(python).args(["-c", "import can, canopen"]).output();
    let there = there.is_ok_and(|output| output.status.success());
    if !there {
        let required = std::env::var_os("CANTAP_REQUIRE_PEERS").is_some_and(|value| value == "1");
        assert!(!required, "canopen is required and does not run");
        eprintln!("SKIPPED: canopen is not installed, so it was not the nodes' master");
    }
    there
}

#[test]
fn python_canopen_masters_the_nodes_and_a_listener_hears_the_same() {
    let python = std::env::var("CANTAP_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !has_peer(&python) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("cantap.sock").display().to_string();
    let sheet = folder.path().join("node.eds");
    let printed = Command::new(CANTAP).args(["virtual", "--print-eds"]).output().unwrap();
    std::fs::write(&sheet, &printed.stdout).unwrap();
    let mut server = Command::new(CANTAP)
        .args(["serve", "-d", "virtual:canopen", "-b", "500k", "--unix", &socket])
        .args(["--socketcand", "127.0.0.1:0", "--allow", "send"])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(server.stdout.take().unwrap()).lines();
    let at = lines.next().unwrap().unwrap();
    let way = lines.next().unwrap().unwrap();
    let (host, port) = way.strip_prefix("can://").unwrap().split_once(':').unwrap();
    let heard = folder.path().join("heard.log");
    let mut listener = Command::new(CANTAP)
        .args(["capture", "-d", &at, "-b", "500k", "-t", "2m", "-o"])
        .arg(&heard)
        .stdin(Stdio::null())
        .spawn()
        .unwrap();
    // The server reports that it is ready.
    let mut words = BufReader::new(server.stderr.take().unwrap()).lines();
    assert!(words.any(|line| line.unwrap().contains("is in and may")));
    let rest = std::thread::spawn(move || words.count());
    std::thread::sleep(Duration::from_millis(500));
    let peer = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/canopen_master_peer.py");
    let output = Command::new(&python).args([peer, host, port]).arg(&sheet).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    // Ended as by Ctrl-C, so that the file is complete.
    Command::new("kill").args(["-INT", &listener.id().to_string()]).status().unwrap();
    listener.wait().unwrap();
    server.kill().unwrap();
    server.wait().unwrap();
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
