//! `cantap decode` as users run it.

use std::path::PathBuf;
use std::process::{Command, Output};

const DASHBOARD: &str = r#"
[[message]]
name = "Dashboard"
id = 0x618
signal = [
  { name = "Speed", at = "D2", factor = 2, offset = -40, unit = "km/h" },
  { name = "EngineSpeed", at = "D3:D4", order = "big", factor = 0.5, offset = 512, unit = "rpm, mean" },
  { name = "Ignition", at = "D1.7", values = { 0 = "off", 1 = "on" } },
]
"#;

const BODY: &str = "BO_ 1560 Body: 8 A\n SG_ Door : 7|1@1+ (1,0) [0|0] \"\" A\n SG_ F : 0|32@1- (1,0) [0|0] \"\" A\n\
                    SIG_VALTYPE_ 1560 F : 1;\n";

const TRACE: &str = "(1.000000) can0 618#004023FF\n(1.500000) can1 618#800000C07F\nbroken\n(2.000000) can0 123#00\n\
                     (3.000000) can1 618#0000C07F\n";

/// A directory of its own for each test.
fn directory(test: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(test);
    std::fs::create_dir_all(&directory).unwrap();
    for (name, content) in [("dashboard.toml", DASHBOARD), ("body.dbc", BODY), ("trace.log", TRACE)] {
        std::fs::write(directory.join(name), content).unwrap();
    }
    directory
}

fn cantap(test: &str, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).current_dir(directory(test)).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn text_names_values_units_and_texts() {
    let (code, out, err) = cantap("text", &["decode", "--db", "dashboard.toml", "trace.log"]);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "(1.000000) can0 618 Dashboard: Speed = 88 km/h, EngineSpeed = 5119.5 rpm, mean, Ignition = 0 (off)\n\
         (1.500000) can1 618 Dashboard: Speed = -40 km/h, EngineSpeed = 608 rpm, mean, Ignition = 1 (on)\n\
         (3.000000) can1 618 Dashboard: Speed = -40 km/h, EngineSpeed = 25151.5 rpm, mean, Ignition = 0 (off)\n"
    );
    assert_eq!(
        err,
        "cantap: trace.log, line 3: expected a log line such as '(1410714882.622188) can0 123#DEADBEEF', found 'broken'\n\
         cantap: 1 place in the file could not be read and was left out\n\
         cantap: decoded 3 of 4 frames, 9 values\n"
    );
}

#[test]
fn json_lines_have_exactly_the_documented_keys() {
    let arguments = ["decode", "--db", "dashboard.toml", "--db", "2:body.dbc", "trace.log", "--json"];
    let (code, out, _) = cantap("json", &arguments);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "{\"t\":1.000000,\"ch\":1,\"id\":\"618\",\"message\":\"Dashboard\",\"signals\":{\"Speed\":88,\"EngineSpeed\":5119.5,\"Ignition\":0}}\n\
         {\"t\":1.500000,\"ch\":2,\"id\":\"618\",\"message\":\"Body\",\"signals\":{\"Door\":1,\"F\":-2.000030517578125}}\n\
         {\"t\":3.000000,\"ch\":2,\"id\":\"618\",\"message\":\"Body\",\"signals\":{\"Door\":0,\"F\":null}}\n"
    );
}

#[test]
fn csv_is_one_line_per_chosen_signal() {
    let arguments =
        ["decode", "--db", "dashboard.toml", "trace.log", "--csv", "-s", "Eng*", "-f", "can0,618:7FF"];
    let (code, out, _) = cantap("csv", &arguments);
    assert_eq!(code, Some(0));
    assert_eq!(
        out,
        "time,channel,id,message,signal,value,unit,text\r\n\
         1.000000,1,618,Dashboard,EngineSpeed,5119.5,\"rpm, mean\",\r\n"
    );
}

#[test]
fn what_is_wrong_is_named_and_ends_with_1() {
    std::fs::write(directory("wrong").join("bad.dbc"), "BO_ 5 M: 8 A\n SG_ S : 0|8@1+ (1,0 [0|0] \"\" A\n")
        .unwrap();
    for (arguments, expected) in [
        (&["--db", "bad.dbc", "trace.log"][..], "cantap: bad.dbc: line 2: M.S: not of the form SG_ NAME"),
        (&["--db", "none.dbc", "trace.log"], "cantap: cannot read database none.dbc: No such file"),
        (&["--db", "trace.log", "trace.log"], "cantap: trace.log is no known kind of database"),
        (&["--db", "body.dbc", "none.log"], "cantap: cannot open none.log"),
        (&["trace.log"], "cantap: no database to decode by; give one with --db FILE"),
        (
            &["--db", "dashboard.toml", "trace.log", "-s", "Sped"],
            "cantap: --signal: no signal of the databases matches \"Sped\"; did you mean Speed?",
        ),
        (&["--db", "dashboard.toml", "trace.log", "--strict"], "cantap: trace.log, line 3: expected"),
    ] {
        let (code, _, err) = cantap("wrong", &[&["decode"], arguments].concat());
        assert_eq!(code, Some(1), "{arguments:?}: {err}");
        assert!(err.contains(expected), "{arguments:?}: {err}");
    }
}
