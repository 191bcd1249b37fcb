//! The ready nodes of `cantap run`, each with another program that knows its protocol, on a board shared by `cantap serve` and connected through
//! python-can's socketcand; and what `cantap conversations` says of it.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use crate::served::Served;
use cantap_testing::peers;

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use serde_json::{Value, json};

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");

/// A node that runs on a shared board.
struct Rig {
    served: Served,
    node: Child,
}

impl Rig {
    fn new(node: &str) -> Self {
        let served = Served::start("virtual:load=0", Stdio::inherit());
        // Scripts begin one after the other: when this one says so, the node has begun.
        std::fs::write(served.folder.path().join("ready.rhai"), "log(\"ready\");").unwrap();
        let mut node = Command::new(CANTAP)
            .args(["run", node, "ready.rhai", "-d", &served.at, "-b", "500k", "-o", "heard.log"])
            .current_dir(served.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(node.stdout.take().unwrap()).lines();
        assert!(lines.any(|line| line.unwrap().ends_with("ready.rhai: ready")));
        std::thread::spawn(move || lines.count());
        Self { served, node }
    }

    /// What `ready_node_peer.py` has found.
    fn ask(&self, python: &str, kind: &str, more: &[&str]) -> Value {
        let [host, port] = &self.served.socketcand;
        let peer = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ready_node_peer.py");
        let output = Command::new(python)
            .args([peer, kind, host, port])
            .args(more)
            .current_dir(self.served.folder.path())
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{errors}");
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {errors}"))
    }

    /// Ends the node as by Ctrl-C, and returns what happened on its bus.
    fn conversations(mut self, protocol: &str) -> Vec<Value> {
        Command::new("kill").args(["-INT", &self.node.id().to_string()]).status().unwrap();
        self.node.wait().unwrap();
        let output = Command::new(CANTAP)
            .args(["conversations", "--json", "--quiet", "--protocol", protocol, "heard.log"])
            .current_dir(self.served.folder.path())
            .output()
            .unwrap();
        assert!(output.status.success(), "{output:?}");
        let told = String::from_utf8(output.stdout).unwrap();
        told.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        let _ = self.node.kill();
        let _ = self.node.wait();
    }
}

fn troubled(events: &[Value]) -> Vec<&Value> {
    events.iter().filter(|event| event["trouble"].is_string()).collect()
}

#[test]
#[ignore = "its expectations have not been compared with a run yet"]
fn udsoncan_and_can_isotp_read_the_vehicle() {
    let Some(python) = peers::python_with("can, isotp, udsoncan") else { return };
    let rig = Rig::new("node:obd?speed=72");
    let found = rig.ask(&python, "obd", &[]);
    assert_eq!(found, json!({}));
    let events = rig.conversations("obd");
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}

#[test]
#[ignore = "its expectations have not been compared with a run yet"]
fn can_j1939_hears_the_engine() {
    let Some(python) = peers::python_with("can, j1939") else { return };
    let rig = Rig::new("node:engine");
    let found = rig.ask(&python, "engine", &[]);
    assert_eq!(found, json!({}));
    let events = rig.conversations("j1939");
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}

#[test]
#[ignore = "its expectations have not been compared with a run yet"]
fn python_canopen_moves_the_drive() {
    let Some(python) = peers::python_with("can, canopen") else { return };
    let rig = Rig::new("node:drive");
    let sheet = Command::new(CANTAP).args(["run", "--print", "node:drive.eds"]).output().unwrap();
    std::fs::write(rig.served.folder.path().join("drive.eds"), &sheet.stdout).unwrap();
    let found = rig.ask(&python, "drive", &["drive.eds"]);
    assert_eq!(found, json!({}));
    let events = rig.conversations("canopen");
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}

#[test]
#[ignore = "its expectations have not been compared with a run yet"]
fn canboats_definitions_decode_the_boat() {
    let Some(python) = peers::python_with("can, nmea2000") else { return };
    let rig = Rig::new("node:boat");
    let found = rig.ask(&python, "boat", &[]);
    assert_eq!(found, json!({}));
    let events = rig.conversations("nmea2000");
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}
