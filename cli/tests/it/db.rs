//! `cantap db`: the content of databases, and how they match a trace.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::{Command, Output};

const CAR: &str = "BO_ 256 Engine: 3 A\n SG_ Enable : 7|1@0- (1,0) [0|0] \"-\" A\n SG_ Radius : 6|6@0+ (0.1,0) [0|5] \"m\" A\n \
                   SG_ Temp : 0|12@0- (0.01,250) [229.53|270.47] \"degK\" A\nBO_ 512 Brake: 1 A\nBO_ 768 Lamp: 1 A\n \
                   SG_ Page M : 0|4@1+ (1,0) [0|0] \"\" A\n SG_ Left m1 : 4|2@1+ (1,0) [0|0] \"\" A\n SG_ Right m2 : 4|2@1+ (1,0) [0|0] \"\" A\n\
                   CM_ BO_ 256 \"What the engine does\nand how\";\nCM_ SG_ 256 Temp \"of the oil\";\n\
                   VAL_ 256 Enable 0 \"Off\" 1 \"On\" ;\n\
                   BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 10000;\nBA_DEF_DEF_ \"GenMsgCycleTime\" 0;\n\
                   BA_ \"GenMsgCycleTime\" BO_ 256 10;\nBA_ \"GenMsgCycleTime\" BO_ 768 500;\nBO_ 536870912 Far: 1 A\n";

fn cantap(test: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(format!("db-{test}"));
    std::fs::create_dir_all(&directory).unwrap();
    std::fs::write(directory.join("car.dbc"), CAR).unwrap();
    let mut trace = String::new();
    for n in 0..10 {
        let (first, second) = (n * 20_000, n * 20_000 + 5000);
        writeln!(trace, "(1.{first:06}) can0 100#400123\n(1.{second:06}) can0 7FF#00").unwrap();
    }
    std::fs::write(directory.join("trace.log"), trace).unwrap();
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).arg("db").args(arguments).current_dir(directory).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn messages_are_listed_with_cycle_and_comment() {
    let (code, out, err) = cantap("list", &["car.dbc"]);
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert_eq!(
        out,
        "car.dbc: 3 messages, 6 signals, 1 warning (--warnings lists them)\n\
         \x20 ID       Message Bytes     Cycle Signals  Comment\n\
         \x20 100      Engine      3     10 ms       3  What the engine does\n\
         \x20 200      Brake       1         –       0\n\
         \x20 300      Lamp        1    500 ms       3\n"
    );
    let (_, out, _) = cantap("list", &["car.dbc", "--warnings"]);
    assert!(out.starts_with("car.dbc: line ") && out.contains("Far: identifier 0x20000000"), "{out}");
}

#[test]
fn a_message_is_drawn_and_described() {
    let (code, out, _) = cantap("show", &["car.dbc", "--message", "Eng*"]);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "100 Engine, 3 bytes, every 10 ms\n\
         \x20 What the engine does\n\
         \x20 and how\n\
         \n\
         \x20       7   6   5   4   3   2   1   0\n\
         \x20     +---+---+---+---+---+---+---+---+\n\
         \x20   0 |<-x|<---------------------x|<--|  Enable, Radius, Temp\n\
         \x20     +---+---+---+---+---+---+---+---+\n\
         \x20   1 |-------------------------------|  Temp\n\
         \x20     +---+---+---+---+---+---+---+---+\n\
         \x20   2 |----------x|   |   |   |   |   |  Temp\n\
         \x20     +---+---+---+---+---+---+---+---+\n\
         \n\
         \x20 Enable: bit 7, 1 bit, big-endian, signed, x 1 -\n\
         \x20   0 = Off\n\
         \x20   1 = On\n\
         \x20 Radius: bit 6, 6 bits, big-endian, unsigned, x 0.1 m, 0 to 5\n\
         \x20 Temp: bit 0, 12 bits, big-endian, signed, x 0.01 + 250 degK, 229.53 to 270.47\n\
         \x20   of the oil\n"
    );
    let (_, out, _) = cantap("show", &["car.dbc", "--message", "300"]);
    assert!(
        out.contains("  Page is 1:\n") && out.contains("Left: bit 4") && out.contains(", when Page is 2"),
        "{out}"
    );
    let (code, _, err) = cantap("show", &["car.dbc", "--message", "Engin"]);
    assert_eq!(
        (code, err.as_str()),
        (Some(1), "cantap: no message of the databases matches \"Engin\"; did you mean Engine?\n")
    );
}

#[test]
fn coverage_says_what_is_missing_on_either_side() {
    let (code, out, err) = cantap("coverage", &["car.dbc", "--coverage", "trace.log"]);
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(
        out,
        "10 of 20 frames are in the databases (50.0 %)\n\
         \n\
         Not in the databases: 1 identifier\n\
         \x20 C ID          frames    mean ms     max ms\n\
         \x20 1 7FF             10     20.000     20.000\n\
         \n\
         Never came: 2 of 3 messages\n\
         \x20 200      Brake\n\
         \x20 300      Lamp, every 500 ms\n\
         \n\
         Came: 1 identifier\n\
         \x20 C ID          frames   cycle ms    mean ms     max ms  Message\n\
         \x20 1 100             10         10     20.000     20.000  Engine  (another cycle than the database says)\n"
    );
    let (_, out, _) = cantap("coverage", &["car.dbc", "--coverage", "trace.log", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((&json["covered"], &json["not_in_database"][0]["id"]), (&10.into(), &"7FF".into()));
    assert_eq!(json["messages"][0]["cycle_differs"], true);
    let (_, out, _) = cantap("coverage", &["car.dbc", "--json"]);
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(json["databases"][0]["messages"][0]["signals"][1]["factor"], 0.1);
}

/// Frames of containers, which say themselves what is in them.
#[test]
fn what_containers_contain_is_described_decoded_and_counted() {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("db-container");
    std::fs::create_dir_all(&directory).unwrap();
    let file = directory.join("container.arxml");
    std::fs::write(&file, include_str!("../../../host/signals/tests/data/container.arxml")).unwrap();
    let trace = directory.join("trace.log");
    let lines =
        "(1.000000) can0 123##107010203030801F4\n(1.020000) can0 123##1070A0B0C02FFFF010203030901F50000\n";
    std::fs::write(&trace, lines).unwrap();
    let cantap = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        let Output { status, stdout, stderr } =
            command.args(arguments).current_dir(&directory).output().unwrap();
        assert_eq!(status.code(), Some(0), "{}", String::from_utf8_lossy(&stderr));
        (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
    };
    let (shown, _) = cantap(&["db", "container.arxml", "--message", "Engine"]);
    assert!(
        shown.contains("from byte 1 on a container of PDUs, each behind a short header:\n    010203 Engine, 3 bytes, every 20 ms")
            && shown.contains("  in Brake:\n")
            && shown.contains("  Engine.Speed: bit 15, 16 bits, big-endian"),
        "{shown}"
    );
    let (decoded, err) = cantap(&["decode", "trace.log", "--db", "container.arxml"]);
    assert_eq!(
        decoded,
        "(1.000000) can0 123 Box: Counter = 7, Engine.Counter = 8, Engine.Speed = 500\n\
         (1.020000) can0 123 Box: Counter = 7, Engine.Counter = 9, Engine.Speed = 501\n"
    );
    assert!(err.contains("not decoded: contained PDUs that the databases do not have (1)"), "{err}");
    let (json, _) =
        cantap(&["decode", "trace.log", "--db", "container.arxml", "--json", "--signal", "Engine.Speed"]);
    assert!(
        json.contains("\"signals\":{\"Engine.Speed\":501}")
            && json.contains("\"not_decoded\":{\"contained PDUs"),
        "{json}"
    );
    let (coverage, _) = cantap(&["db", "container.arxml", "--coverage", "trace.log"]);
    let rows = "In containers:\n  Box 010203           2  Engine\n  Box 040506           0  Brake\n  Box 0A0B0C           1  (not in the databases)\n";
    assert!(coverage.ends_with(rows), "{coverage}");
    let (found, _) = cantap(&["search", "trace.log", "Engine.Speed > 500", "--db", "container.arxml"]);
    assert!(found.contains("1.020000") && !found.contains("1.000000"), "{found}");
}
