//! What frames say together, in commands other than `cantap conversations`.

use std::path::PathBuf;
use std::process::{Command, Output};

use serde_json::Value;

/// A workshop and a plant: an identifier is read, another is refused, and a node's heartbeat stops.
const WORKSHOP: &str = "\
(1.000000) can0 7E0#0322F190AAAAAAAA
(1.002500) can0 7E8#101462F190575657
(1.003000) can0 7E0#300000AAAAAAAAAA
(1.004000) can0 7E8#215A5A5A314B5A41
(1.005000) can0 7E8#2257303030303031
(2.000000) can0 7E0#0322F18CAAAAAAAA
(2.001500) can0 7E8#037F2231AAAAAAAA
(3.000000) can0 7E0#021001AAAAAAAAAA
(3.004000) can0 7E8#0650010032012CAA
(3.500000) can1 705#00
(3.600000) can1 605#4000100000000000
(3.601000) can1 585#4300100091010F00
(3.700000) can1 705#05
(3.800000) can1 705#05
(5.000000) can1 080#
";

fn cantap(test: &str, logs: &[(&str, &str)], line: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("protocols").join(test);
    std::fs::create_dir_all(&directory).unwrap();
    for (name, text) in logs {
        std::fs::write(directory.join(name), text).unwrap();
    }
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let Output { status, stdout, stderr } = command.args(line).current_dir(directory).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn a_search_finds_the_frame_that_completes_what_was_said() {
    let search = |arguments: &[&str]| {
        let line: Vec<_> = ["search", "bus.log"].iter().chain(arguments).copied().collect();
        cantap("search", &[("bus.log", WORKSHOP)], &line)
    };
    let (code, out, err) = search(&["uds.sid == 0x22 and uds.nrc"]);
    assert_eq!((code, &*err), (Some(0), ""));
    assert_eq!(
        out,
        "(2.001500) can0 7E8#037F2231AAAAAAAA  uds 7E0 > 7E8 ReadDataByIdentifier: sid 0x22, did 0xF18C (ECU serial number), \
         nrc 0x31 (requestOutOfRange), after 1.5 ms\n"
    );
    assert_eq!(
        search(&["uds.nrc == requestoutofrange or canopen.kind == heartbeat_missing", "--count"]).1,
        "2\n"
    );
    let (code, out, err) = search(&["uds.nrcc"]);
    assert_eq!((code, &*out), (Some(1), ""));
    assert!(err.contains("nothing had uds.nrcc; `cantap conversations` shows"), "{err}");
    let (code, _, err) = search(&["usd.nrc"]);
    assert!(code == Some(2) && err.contains("usd.nrc"), "{code:?} {err}");
    let (_, out, _) = search(&["uds.did == 0xF190", "--json"]);
    let found: Value = serde_json::from_str(out.lines().next().unwrap()).unwrap();
    assert!(found["said"][0].as_str().unwrap().contains("WVWZZZ1KZAW000001"), "{found}");
}

#[test]
fn statistics_tell_response_times_and_nodes() {
    let logs = [("bus.log", WORKSHOP)];
    let (code, out, err) = cantap("stats", &logs, &["stats", "bus.log", "--protocols", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let known: Value = serde_json::from_str(&out).unwrap();
    let known = &known["protocols"];
    let read =
        known["services"].as_array().unwrap().iter().find(|one| one["service"] == "ReadDataByIdentifier");
    let read = read.unwrap();
    assert_eq!((&read["count"], &read["faults"]), (&2.into(), &1.into()));
    assert_eq!((&read["response_min_ms"], &read["response_max_ms"]), (&1.5.into(), &2.5.into()));
    let nodes = known["nodes"].as_array().unwrap();
    let plant = nodes.iter().find(|node| node["protocol"] == "canopen").unwrap();
    assert_eq!((&plant["node"], &plant["state"]), (&"5".into(), &"heartbeat missing".into()));
    assert_eq!((&plant["missed"], &plant["period_ms"]), (&1.into(), &100.0.into()));
    let car = nodes.iter().find(|node| node["node"] == "7E8").unwrap();
    assert_eq!(car["identity"], "WVWZZZ1KZAW000001");
    let (_, out, _) = cantap("stats", &logs, &["stats", "bus.log", "--protocols"]);
    assert!(
        out.contains("DiagnosticSessionControl")
            && out.contains("heartbeat missing (1 time missed, period 100 ms)"),
        "{out}"
    );
}

#[test]
fn a_difference_names_nodes_and_objects() {
    let other = WORKSHOP
        .replace("215A5A5A", "215B5A5A")
        .replace("705#", "706#")
        .replace("7E0#0322F18C", "7E0#0322F18A");
    let logs = [("a.log", WORKSHOP), ("b.log", &*other)];
    let (code, out, err) = cantap("diff", &logs, &["diff", "a.log", "b.log", "--protocols", "--check"]);
    assert_eq!(code, Some(3), "{err}");
    assert!(out.contains("channel 2, canopen node 6: only in b.log\n"), "{out}");
    assert!(
        out.contains("channel 1, uds node 7E8, did 0xF190: \"WVWZZZ1KZAW000001\" -> \"WVW[ZZ1KZAW000001\"\n"),
        "{out}"
    );
    assert!(out.contains("channel 1, uds node 7E8, did 0xF18C: only in a.log\n"), "{out}");
    let (code, out, _) = cantap("diff", &logs, &["diff", "a.log", "a.log", "--protocols", "--check"]);
    assert_eq!(code, Some(0), "{out}");
}

#[test]
fn decoding_has_what_was_said_between_the_signals() {
    let database = "version = 1\n[[message]]\nname = \"Session\"\nid = 0x7E0\nlength = 8\n[[message.signal]]\nname = \"Pci\"\nat = \"D1\"\n";
    let logs = [("bus.log", WORKSHOP), ("car.toml", database)];
    let decode = |arguments: &[&str]| {
        let line: Vec<_> =
            ["decode", "bus.log", "--protocols", "-q"].iter().chain(arguments).copied().collect();
        cantap("decode", &logs, &line)
    };
    let (code, out, err) = decode(&["--db", "car.toml"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("decoded 4 of 14 frames") || err.contains("decoded 4 of 15 frames"), "{err}");
    let lines: Vec<_> = out.lines().collect();
    assert!(
        lines[0].ends_with("7E0 Session: Pci = 3") && lines[2].contains("uds 7E0 > 7E8 ReadData"),
        "{out}"
    );
    let (_, out, _) = decode(&["--csv"]);
    assert!(out.contains("2.001500,1,7E0,ReadDataByIdentifier,uds.nrc,49,,requestOutOfRange\r\n"), "{out}");
    assert!(out.contains("1.005000,1,7E0,ReadDataByIdentifier,uds.value,,,WVWZZZ1KZAW000001\r\n"), "{out}");
    let (_, out, _) = decode(&["--json"]);
    let first: Value = serde_json::from_str(out.lines().next().unwrap()).unwrap();
    assert_eq!((&first["signals"]["uds.sid"], &first["to"]), (&34.into(), &"7E8".into()));
    assert_eq!(decode(&["-o", "x.parquet"]).0, Some(2));
}

#[test]
fn a_table_has_the_numbers_of_what_was_said() {
    let database = "version = 1\n[[message]]\nname = \"Session\"\nid = 0x7E0\nlength = 8\n[[message.signal]]\nname = \"Pci\"\nat = \"D1\"\n";
    let logs = [("bus.log", WORKSHOP), ("car.toml", database)];
    let decode = |arguments: &[&str]| {
        let line = ["decode", "bus.log", "--protocols", "-q", "--db", "car.toml", "--csv"];
        let line: Vec<_> = line.iter().chain(arguments).copied().collect();
        cantap("table", &logs, &line)
    };
    let (code, out, err) = decode(&["--wide"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("values of protocols are texts or bytes"), "{err}");
    let lines: Vec<Vec<&str>> = out.lines().map(|line| line.split(',').collect()).collect();
    let at = |name: &str| lines[0].iter().position(|column| column.starts_with(name)).unwrap();
    let (pci, nrc) = (at("1:Session.Pci"), at("1:uds.nrc"));
    let refused = lines.iter().find(|line| line[0] == "2.001500").unwrap();
    assert_eq!((refused[nrc], refused[pci]), ("49", ""), "{out}");
    let asked = lines.iter().find(|line| line[0] == "2.000000").unwrap();
    assert_eq!((asked[nrc], asked[pci]), ("", "3"), "{out}");
    assert!(lines.iter().all(|line| line.len() == lines[0].len()), "{out}");
    // At regular intervals, each with its last value.
    let (code, out, err) = decode(&["--resample", "500ms"]);
    assert_eq!(code, Some(0), "{err}");
    let times: Vec<f64> =
        out.lines().skip(1).map(|line| line.split(',').next().unwrap().parse().unwrap()).collect();
    assert!(times.len() > 3 && times.is_sorted(), "{out}");
}

#[test]
fn relatives_that_are_not_read_are_named() {
    let ring = ["0", "1", "2", "3"]
        .map(|round| {
            format!("(1.{round}) can0 403#0702000000000000\n(1.{round}5) can0 407#0302000000000000\n")
        })
        .concat();
    let (code, out, err) = cantap("relatives", &[("bus.log", &*ring)], &["conversations", "bus.log"]);
    assert_eq!((code, &*out), (Some(0), ""));
    assert!(
        err.starts_with("cantap: channel 1 has OSEK network management with the identifiers 400 to 4FF"),
        "{err}"
    );
}
