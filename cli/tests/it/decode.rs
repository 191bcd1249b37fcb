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

/// A separate directory for each test.
fn directory(test: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("decode").join(test);
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
         cantap: 1 place could not be read; 20.0 % of the file left out\n\
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
        "{\"time_s\":1.000000,\"channel\":1,\"id\":\"618\",\"message\":\"Dashboard\",\"signals\":{\"Speed\":88,\"EngineSpeed\":5119.5,\"Ignition\":0}}\n\
         {\"time_s\":1.500000,\"channel\":2,\"id\":\"618\",\"message\":\"Body\",\"signals\":{\"Door\":1,\"F\":-2.0000305}}\n\
         {\"time_s\":3.000000,\"channel\":2,\"id\":\"618\",\"message\":\"Body\",\"signals\":{\"Door\":0,\"F\":null}}\n\
         {\"summary\":{\"decoded\":3,\"frames\":4,\"issues\":1,\"left_out\":{},\"lost\":0,\"lost_at_least\":false,\"missing_pct\":20.0,\"values\":7}}\n"
    );
}

/// 0.1 on the bus is 0.10000000149011612 as a double; what is no such float keeps every digit.
#[test]
fn a_float_of_32_bits_has_the_digits_that_read_back_as_the_same_float() {
    let directory = directory("floats");
    let database = "BO_ 1 M: 8 A\n SG_ F : 0|32@1- (1,0) [0|0] \"\" A\n SG_ Scaled : 32|32@1- (0.5,0) [0|0] \"\" A\n\
                    SIG_VALTYPE_ 1 F : 1;\nSIG_VALTYPE_ 1 Scaled : 1;\n";
    std::fs::write(directory.join("floats.dbc"), database).unwrap();
    std::fs::write(directory.join("floats.log"), "(1.000000) can0 001#CDCCCC3DCDCCCC3D\n").unwrap();
    let decode = |form: &[&str]| {
        let (code, out, err) =
            cantap("floats", &[&["decode", "--db", "floats.dbc", "floats.log"], form].concat());
        assert_eq!(code, Some(0), "{err}");
        out
    };
    assert!(
        decode(&["--json"]).contains("\"F\":0.1,\"Scaled\":0.05000000074505806}"),
        "{}",
        decode(&["--json"])
    );
    assert!(decode(&["--csv"]).contains(",F,0.1,"), "{}", decode(&["--csv"]));
    assert!(
        decode(&["--csv", "--wide"]).contains(",0.1,0.05000000074505806"),
        "{}",
        decode(&["--csv", "--wide"])
    );
    assert!(decode(&[]).contains("F = 0.1, Scaled = 0.05"), "{}", decode(&[]));
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
        (&["--db", "trace.log", "trace.log"], "cantap: trace.log is not a known kind of database"),
        (&["--db", "body.dbc", "none.log"], "cantap: cannot open none.log"),
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

const TRUCK: &str = "BO_ 2364539904 EEC1: 8 A\n SG_ Speed : 24|16@1+ (0.125,0) [0|8031.875] \"rpm\" A\n \
                     SG_ Gear : 0|4@1+ (1,0) [0|0] \"\" A\nVAL_ 2364539904 Gear 3 \"Drive\" ;\n\
                     BA_DEF_ BO_ \"VFrameFormat\" ENUM \"StandardCAN\",\"ExtendedCAN\",\"J1939PG\";\n\
                     BA_ \"VFrameFormat\" BO_ 2364539904 2;\n";

const TRUCK_TRACE: &str = "(1.000000) can0 0CF00400#03FFFF4038\n(1.100000) can0 0CF00400#03FFFFFFFF\n\
                           (1.200000) can0 0CF00400#03FFFF0038\n(61.200000) can0 0CF00400#03FFFF0138\n";

fn truck(test: &str) {
    let directory = directory(test);
    std::fs::write(directory.join("truck.dbc"), TRUCK).unwrap();
    std::fs::write(directory.join("truck.log"), TRUCK_TRACE).unwrap();
}

/// 0xFFFF would be 8191.875 rpm; J1939 says that there is no value.
#[test]
fn what_is_not_available_is_told_as_such() {
    truck("available");
    let decode = |more: &[&str]| {
        let (code, out, err) =
            cantap("available", &[&["decode", "--db", "truck.dbc", "truck.log"], more].concat());
        assert_eq!(code, Some(0), "{err}");
        out.lines().take(2).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(
        decode(&[]),
        [
            "(1.000000) can0 0CF00400 EEC1: Speed = 1800 rpm, Gear = 3 (Drive)",
            "(1.100000) can0 0CF00400 EEC1: Speed = not available, Gear = 3 (Drive)"
        ]
    );
    assert!(decode(&["--json"])[1].ends_with("\"signals\":{\"Speed\":null,\"Gear\":3}}"));
    assert_eq!(
        decode(&["--json", "--details"])[1].split_once("\"signals\":").unwrap().1,
        "{\"Speed\":{\"value\":null,\"unit\":\"rpm\",\"text\":\"not available\",\"raw\":65535},\
         \"Gear\":{\"value\":3,\"text\":\"Drive\",\"raw\":3}}}"
    );
    assert!(
        cantap("available", &["decode", "--db", "truck.dbc", "truck.log", "--csv"])
            .1
            .contains("1.100000,1,0CF00400,EEC1,Speed,,rpm,not available\r\n")
    );
}

#[test]
fn a_wide_table_has_a_column_per_signal() {
    truck("wide");
    std::fs::write(
        directory("wide").join("both.log"),
        format!("{TRUCK_TRACE}(62.000000) can0 618#004023FF\n"),
    )
    .unwrap();
    let arguments = ["decode", "--db", "truck.dbc", "--db", "dashboard.toml", "both.log", "--csv", "--wide"];
    let (code, out, err) = cantap("wide", &arguments);
    assert_eq!(code, Some(0), "{err}");
    assert_eq!(
        out,
        "time,EEC1.Speed [rpm],EEC1.Gear,Dashboard.Speed [km/h],\"Dashboard.EngineSpeed [rpm, mean]\",Dashboard.Ignition\r\n\
         1.000000,1800,3,,,\r\n1.100000,,3,,,\r\n1.200000,1792,3,,,\r\n61.200000,1792.125,3,,,\r\n62.000000,,,88,5119.5,0\r\n"
    );
}

#[test]
fn a_resampled_table_holds_values_but_not_over_a_silence() {
    truck("resampled");
    let arguments =
        ["decode", "--db", "truck.dbc", "truck.log", "--csv", "--resample", "500ms", "--signal", "Speed"];
    let (code, out, err) = cantap("resampled", &arguments);
    assert_eq!(code, Some(0), "{err}");
    // The signal comes every 100 ms: a second later its value is unknown.
    assert_eq!(out, "time,EEC1.Speed [rpm]\r\n1.500000,1792\r\n2.000000,1792\r\n61.500000,1792.125\r\n");
}

#[test]
fn warnings_can_be_left_out_and_a_database_that_replaces_another_is_told() {
    let twice = "BO_ 1560 Other: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\nBO_ 4000 Far: 1 A\n";
    std::fs::write(directory("quiet").join("other.dbc"), twice).unwrap();
    let arguments = ["decode", "--db", "body.dbc", "--db", "other.dbc", "trace.log"];
    let (code, _, err) = cantap("quiet", &arguments);
    assert_eq!(code, Some(0));
    assert!(
        err.contains("cantap: other.dbc: line 3: Far: identifier 0xFA0 is not marked as extended"),
        "{err}"
    );
    assert!(
        err.contains("cantap: other.dbc replaces 1 message of body.dbc with the same identifier, Body\n"),
        "{err}"
    );
    let (code, _, err) = cantap("quiet", &[&arguments[..], &["--quiet"]].concat());
    assert_eq!(code, Some(0));
    assert!(!err.contains("other.dbc"), "{err}");
    let (code, ..) = cantap("quiet", &[&arguments[..], &["--quiet", "--strict"]].concat());
    assert_eq!(code, Some(1));
}
