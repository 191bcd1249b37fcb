//! The ready nodes of `cantap run`, each with another program that knows its protocol, on a board shared by `cantap serve` and connected through
//! python-can's socketcand; and what `cantap conversations` says of it.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; if it or a package is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use crate::served::Served;
use cantap_testing::peers;

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
        let node = served.run_node(node, &["-o", "heard.log"]);
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
fn udsoncan_and_can_isotp_read_the_vehicle() {
    let Some(python) = peers::python_with("can, isotp, udsoncan") else { return };
    let rig = Rig::new("node:obd?speed=72");
    let found = rig.ask(&python, "obd", &[]);
    let expected = json!({
        "vin": "1CANTAP00VEHICLE7",
        "uds_codes": [["012800", 0x2F], ["030100", 0x2F], ["045500", 0x07]],
        "refused": [0x11, 0x11],
        "answers": [
            ["0100", "4100BE3FA013"], ["0120", "41208002A001"],
            // 2980 1/min, 72 km/h, 88 degC.
            ["010C", "410C2E90"], ["010D", "410D48"], ["0105", "410580"],
            ["03", "430201280301"], ["07", "47010455"], ["0A", "4A0201280301"], ["020200", "4202000128"],
            ["0902", "4902013143414E544150303056454849434C4537"], ["0904", "49040143414E5441504F4244323032362D3031"],
            // Permanent codes are not cleared by a tester.
            ["04", "44"], ["03", "4300"], ["07", "4700"], ["0A", "4A0201280301"],
        ],
    });
    assert_eq!(found, expected);
    let events = rig.conversations("obd");
    assert!(!events.is_empty());
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}

#[test]
fn can_j1939_hears_the_engine() {
    let Some(python) = peers::python_with("can, j1939") else { return };
    let rig = Rig::new("node:engine");
    let found = rig.ask(&python, "engine", &[]);
    let component = "CANTAP*ENGINE-6*2026-0042*UNIT-1*";
    let expected = json!({
        // 1500 1/min in 1/8, 80 km/h in 1/256, 85 degC + 40.
        "eec1": "F0A5A3E02E00FFFF", "ccvs": "FF0050FFFFFFFFFF", "temperatures": "7D46002EFFFFFFFF",
        "component_to_one": component, "component_to_all": component,
        "dm1": "14FF6E00000364000101BE000207",
        "trouble": [[110, 0, 3], [100, 1, 1], [190, 2, 7]],
        "refused": "01FFFFFFF94CFE00", "cleared": "00FFFFFFF9D3FE00", "dm1_after": "00FF00000000FFFF",
    });
    assert_eq!(found, expected);
    let events = rig.conversations("j1939");
    assert!(!events.is_empty());
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}

#[test]
fn python_canopen_moves_the_drive() {
    let Some(python) = peers::python_with("can, canopen") else { return };
    let rig = Rig::new("node:drive");
    let sheet = Command::new(CANTAP).args(["run", "--print", "node:drive.eds"]).output().unwrap();
    std::fs::write(rig.served.folder.path().join("drive.eds"), &sheet.stdout).unwrap();
    let found = rig.ask(&python, "drive", &["drive.eds"]);
    let expected = json!({
        "beat": "PRE-OPERATIONAL", "name": "cantap drive with a CiA 402 state machine", "booted": true,
        "states": ["SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"],
        "mode": "PROFILED VELOCITY", "velocity": 1500, "forward": true, "homed": true, "position": 5000,
        "fault": ["FAULT", 0x2310, true], "after": ["SWITCH ON DISABLED", 0], "refused": "06010002",
    });
    assert_eq!(found, expected);
    let events = rig.conversations("canopen");
    // The write to the status word, which it refuses.
    let troubled: Vec<_> =
        troubled(&events).iter().map(|event| (&event["title"], &event["fields"]["abort"])).collect();
    assert_eq!(troubled, [(&json!("SDO write 6041:00"), &json!(0x0601_0002))]);
}

#[test]
fn python_canopen_gives_the_drive_its_number() {
    let Some(python) = peers::python_with("can, canopen") else { return };
    let rig = Rig::new("node:drive?node=255");
    let sheet = Command::new(CANTAP).args(["run", "--print", "node:drive.eds"]).output().unwrap();
    std::fs::write(rig.served.folder.path().join("drive.eds"), &sheet.stdout).unwrap();
    let mut found = rig.ask(&python, "number", &["drive.eds"]);
    assert_eq!(found["identity"].take()[3], json!(402_255));
    let expected = json!({
        "found": true, "identity": null, "inquired": 255, "first": true, "serial": 402_255, "selected": true, "second": true,
        "same": 402_255,
    });
    assert_eq!(found, expected);
    assert_eq!(troubled(&rig.conversations("canopen")), Vec::<&Value>::new());
}

#[test]
fn canboats_definitions_decode_the_boat() {
    let Some(python) = peers::python_with("can, nmea2000") else { return };
    let rig = Rig::new("node:boat");
    let mut found = rig.ask(&python, "boat", &[]);
    // The boat moves, by 3 m/s, and each message of a cycle has its number.
    for pgn in ["129025", "129029"] {
        for (part, begin) in [("latitude", 54.32), ("longitude", 10.14)] {
            let at = found[pgn][part].take().as_f64().unwrap();
            assert!(at > begin && at < begin + 0.1, "{part} {at}");
        }
    }
    for pgn in ["129026", "129029", "128267", "130306", "130310"] {
        assert!(found[pgn]["sid"].take().as_u64().is_some_and(|sid| sid < 253), "{pgn}");
    }
    assert!(found["129029"]["time"].take().is_string());
    // A manufacturer of 2046 is not in canboat's list.
    let expected = json!({
        "60928": {
            "uniqueNumber": 4711, "manufacturerCode": null, "deviceInstanceLower": 0, "deviceInstanceUpper": 0,
            "deviceFunction": "Atmospheric", "spare": 0, "deviceClass": "External Environment", "systemInstance": 0,
            "industryGroup": "Marine Industry", "arbitraryAddressCapable": "Yes",
        },
        "126996": {
            "nmea2000Version": 2.1, "productCode": 42, "modelId": "cantap boat", "softwareVersionCode": "1.0",
            "modelVersion": "1", "modelSerialCode": "0000004711", "certificationLevel": "Level B", "loadEquivalency": 1,
        },
        "127488": {
            "instance": "Single Engine or Dual Engine Port", "speed": 1800.0, "boostPressure": null, "tiltTrim": null,
            "reserved_48": 65535,
        },
        "127489": {
            "instance": "Single Engine or Dual Engine Port", "oilPressure": 350_000, "oilTemperature": 363.1,
            "temperature": 358.150_000_000_000_03, "alternatorPotential": 14.1, "fuelRate": 4.2, "totalEngineHours": 720_000,
            "coolantPressure": null, "fuelPressure": null, "reserved_152": 255, "discreteStatus1": "", "discreteStatus2": "",
            "engineLoad": 60, "engineTorque": 55,
        },
        "128267": {"sid": null, "depth": 8.5, "offset": 0.5, "range": null},
        "129025": {"latitude": null, "longitude": null},
        "129026": {
            "sid": null, "cogReference": "True", "reserved_10": 63, "cog": 7853.0 / 10_000.0, "sog": 3.0, "reserved_48": 65535,
        },
        "129029": {
            "sid": null, "date": "2026-11-29", "time": null, "latitude": null, "longitude": null, "altitude": 2.0,
            "gnssType": "GPS", "method": "GNSS fix", "integrity": "No integrity checking", "reserved_258": 63,
            "numberOfSvs": 9, "hdop": 0.9, "pdop": 1.5, "geoidalSeparation": 42.0, "referenceStations": 0,
            "referenceStationType": null, "referenceStationId": null, "ageOfDgnssCorrections": null,
        },
        "130306": {
            "sid": null, "windSpeed": 6.0, "windAngle": 0.523_500_000_000_000_1, "reference": "Apparent",
            "reserved_43": 2_097_151,
        },
        "130310": {
            "sid": null, "waterTemperature": 288.150_000_000_000_03, "outsideAmbientAirTemperature": 293.150_000_000_000_03,
            "atmosphericPressure": 1_013_200, "reserved_56": 255,
        },
    });
    assert_eq!(found, expected);
    let events = rig.conversations("nmea2000");
    assert!(!events.is_empty());
    assert_eq!(troubled(&events), [&Value::Null; 0]);
}
