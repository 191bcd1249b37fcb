//! The output of every command with `--json` matches `docs/json.schema.json` and `docs/json.md`.

use crate::schema;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use schema::Schema;
use serde_json::{Value, json};

const PAGE: &str = include_str!("../../../docs/json.md");

fn schema() -> Schema {
    Schema::new(include_str!("../../../docs/json.schema.json"))
}

/// A directory for each test, with traces and databases that cover everything.
pub fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("json_schema").join(test);
    fs::create_dir_all(&directory).unwrap();
    let line =
        |at: u32| format!("(1410714882.{:06}) can0 {:03X}#{:08X}\n", at * 700, 0x100 + at % 3, at * at);
    let lines: Vec<_> = (0..300).map(line).collect();
    let others = "(1410714883.000000) can1 18FEF100#FFFFFFFFFFFFFFFF\n(1410714883.100000) can0 20000088#0000040000000000\n\
                  (1410714883.200000) can0 124#R2\n(1410714883.300000) can0 100##111223344\nrubbish\n";
    fs::write(directory.join("a.log"), lines.concat() + others).unwrap();
    fs::write(directory.join("b.log"), lines.concat() + "(1410714883.000000) can0 100#1122\n").unwrap();
    let head = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\ninternal events logged\n";
    fs::write(directory.join("a.asc"), format!("{head}0.1 1 100 Rx d 2 11 22\n0.2 L1 3e Rx 1 00\n")).unwrap();
    let database = "BO_ 256 M: 4 A\n SG_ S : 0|8@1+ (0.5,0) [0|0] \"km/h\" A\n SG_ T : 8|2@1+ (1,0) [0|0] \"\" A\n\
                    BO_ 800 Never: 8 A\n SG_ X M : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ Y m1 : 8|8@1- (1,-40) [-40|80] \"\" A\n\
                    CM_ SG_ 256 S \"Speed\";\nVAL_ 256 T 1 \"on\" 0 \"off\" ;\n\
                    BA_DEF_ BO_ \"GenMsgCycleTime\" INT 0 1000;\nBA_ \"GenMsgCycleTime\" BO_ 256 100;\n";
    let talk = "(1.000000) can0 7E0#0322F190AAAAAAAA\n(1.002500) can0 7E8#101462F190575657\n(1.003000) can0 7E0#300000AAAAAAAAAA\n\
                (1.004000) can0 7E8#215A5A5A314B5A41\n(1.005000) can0 7E8#2257303030303031\n(2.000000) can0 7DF#02010CAAAAAAAAAA\n\
                (2.001000) can0 7E8#04410C1AF8AAAAAA\n(3.000000) can0 7E0#021003AAAAAAAAAA\n";
    fs::write(directory.join("talk.log"), talk).unwrap();
    let other = talk.replace("215A5A5A", "215B5A5A").replace("7DF", "7E1");
    fs::write(directory.join("other.log"), other + "(4.000000) can0 7E9#04410C1AF8AAAAAA\n").unwrap();
    fs::write(
        directory.join("test.rhai"),
        "log(1); fn test_a() { send(\"123#\"); wait(\"5ms\"); } fn test_b() { fail(\"no\"); }",
    )
    .unwrap();
    let both = "(1.000000) can0 123#11\n(1.000300) can1 123#11\n(1.100000) can0 123#22\n(1.200000) can1 124#22\n(2.000000) can0 7FF#\n";
    fs::write(directory.join("both.log"), both).unwrap();
    fs::write(directory.join("rules.toml"), "[[rule]]\nfrom = 1\nfilter = \"123\"\nset.data = \"?1\"\n")
        .unwrap();
    fs::write(directory.join("car.dbc"), database).unwrap();
    let odx = include_bytes!("../../../host/protocols/tests/data/kinds.odx-d");
    fs::write(directory.join("kinds.odx-d"), odx).unwrap();
    fs::write(directory.join("odd.dbc"), database.replace("8|8@1-", "8|99@1-")).unwrap();
    directory
}

fn cantap(directory: &Path, line: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    // A condition contains blanks.
    let words = line.split(' ').map(|word| word.replace('%', " "));
    command.args(words).current_dir(directory).stdin(Stdio::null());
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A command line without `--json`; its exit code; the type of its object, or of each of its lines but the last, and of the last.
pub const LINES: &[(&str, i32, &[&str])] = &[
    ("list", 0, &["list"]),
    ("list --network", 0, &["list"]),
    ("info -d virtual", 0, &["info"]),
    ("doctor -d virtual -t 200ms", 0, &["doctor"]),
    ("doctor -d virtual:bitrate=125k -b 500k -t 200ms", 3, &["doctor"]),
    ("status -d virtual --registers", 0, &["status"]),
    ("status -d virtual:errors=20,load=50 -b 500k -t 300ms --registers", 0, &["status"]),
    ("capture -d virtual -b 500k -t 300ms", 0, &["capture"]),
    ("capture -d virtual -b 500k -t 300ms --no-data --no-stamps", 0, &["capture"]),
    ("capture -d virtual -d virtual -b 500k -t 300ms", 0, &["capture"]),
    (
        "capture -d virtual -b 500k -t 400ms --trigger error%or%dlc%==%8 --pre 10ms --post 10ms",
        0,
        &["capture"],
    ),
    ("capture -d virtual -b 500k -t 2s -o /dev/full --format candump", 1, &["capture"]),
    ("send -d virtual:load=0 1 123#11 -n 3", 0, &["send"]),
    ("send -d virtual:load=0,ack=no 1 123#11", 1, &["send"]),
    ("send -d virtual:load=0 1 123#11 --period 2ms -n 30", 0, &["send"]),
    ("gen -d virtual:load=0 both -g 1 -n 10", 0, &["gen"]),
    ("gen -d virtual:load=0,ack=no 1 -g 1 -n 3", 1, &["gen"]),
    ("replay -d virtual:load=0 -b 500k b.log", 0, &["replay"]),
    ("replay -d virtual:load=0,ack=no -b 500k a.log", 1, &["replay"]),
    ("run test.rhai", 1, &["run", "run_end"]),
    ("run test.rhai -d virtual:load=0 -b 500k", 1, &["run", "run_end"]),
    ("run test.rhai --explain -d virtual", 0, &["run_explain"]),
    ("twin a.log", 0, &["twin"]),
    ("twin talk.log -b 500k", 0, &["twin"]),
    ("autobaud -d virtual:bitrate=125k", 0, &["autobaud"]),
    ("defaults show -d virtual", 0, &["defaults_show"]),
    ("stats a.log", 0, &["stats"]),
    ("stats a.log -b 500k --data-bitrate 2M --windows", 0, &["stats"]),
    ("stats -d virtual:errors=20 -b 500k -t 1200ms", 0, &["stats"]),
    ("timing -b 500k", 0, &["timing"]),
    ("bits 123#11", 0, &["bits"]),
    ("bits 123##11122", 0, &["bits"]),
    ("bits 123##01122", 0, &["bits"]),
    ("convert a.log out.csv", 0, &["convert"]),
    ("convert a.asc out.log", 0, &["convert"]),
    ("delay both.log --from 1 --to 2", 0, &["delay"]),
    ("delay both.log --from 1 --to 2 --map rules.toml --check", 3, &["delay"]),
    ("gateway rules.toml --dry-run both.log", 0, &["gateway"]),
    ("gateway rules.toml -d virtual:load=5 -b 500k -t 1s", 0, &["gateway_on_a_device"]),
    ("align b.log b.log", 0, &["align"]),
    ("align b.log b.log --shift 1s", 0, &["align"]),
    ("compare-adapters -d candump:b.log -d candump:b.log -b 500k -t 2s", 0, &["compare-adapters"]),
    ("decode a.log --db car.dbc", 0, &["decode", "decode_end"]),
    ("decode a.log --db car.dbc --details", 0, &["decode", "decode_end"]),
    ("search a.log --db car.dbc --id 100 -C 2", 0, &["search", "search_end"]),
    ("search a.log error%or%rtr", 0, &["search", "search_end"]),
    ("conversations talk.log", 0, &["conversations", "conversations_end"]),
    ("obd supported -d virtual:car", 0, &["conversations", "conversations"]),
    ("obd live -d virtual:car 0C -n 1", 0, &["conversations"]),
    ("obd watch -d virtual:car 0C -n 1", 0, &["conversations"]),
    ("obd codes -d virtual:car", 0, &["conversations", "conversations"]),
    ("obd vin -d virtual:car", 0, &["conversations", "conversations"]),
    ("obd clear -d virtual:car --yes", 0, &["conversations", "conversations"]),
    ("uds scan -d virtual:car --p2 200ms", 0, &["uds_scan"]),
    ("uds read -d virtual:car F190", 0, &["conversations"]),
    ("conversations talk.log --odx kinds.odx-d:Kinds", 0, &["conversations", "conversations_end"]),
    ("uds session -d virtual:car extended", 0, &["conversations"]),
    ("uds routine -d virtual:car start FF00", 1, &["conversations"]),
    ("uds tester-present -d virtual:car", 0, &["conversations"]),
    ("uds reset -d virtual:car soft", 0, &["conversations"]),
    ("uds dtc -d virtual:car", 0, &["conversations"]),
    ("uds raw -d virtual:car 22F190", 0, &["conversations"]),
    ("xcp info -d virtual:ecu -b 500k --pair 7F0:7F1", 0, &["conversations", "conversations"]),
    ("xcp read -d virtual:ecu -b 500k --pair 7F0:7F1 20000000:2", 0, &["xcp_read"]),
    ("xcp write -d virtual:ecu -b 500k --pair 7F0:7F1 30000000 A00F --yes", 0, &["xcp_write"]),
    ("xcp poll -d virtual:ecu -b 500k --pair 7F0:7F1 20000000:2 -n 2", 0, &["xcp_row", "xcp_row"]),
    ("xcp daq -d virtual:ecu -b 500k --pair 7F0:7F1 20000000:2 -n 2", 0, &["xcp_row", "xcp_row"]),
    ("canopen scan -d virtual:load=0 -b 500k 1-5", 1, &["canopen_scan"]),
    ("canopen nmt -d virtual:load=0 -b 500k 5 start", 0, &["conversations"]),
    ("canopen drive -d virtual:canopen -b 500k 5 status", 0, &["canopen_drive"]),
    ("canopen sync -d virtual:load=0 -b 500k --period 10ms -n 3", 0, &["conversations"]),
    ("canopen heartbeat -d virtual:load=0 -b 500k 5 --period 10ms -n 3", 0, &["conversations"]),
    ("j1939 claim -d virtual:load=0 -b 250k", 0, &["conversations"]),
    ("j1939 send -d virtual:load=0 -b 250k 0xFEEC 0102", 0, &["conversations"]),
    ("j1939 send 130306 Reference=Apparent --preview", 0, &["j1939_frame"]),
    ("stats talk.log --protocols", 0, &["stats"]),
    ("decode talk.log --protocols", 0, &["decode", "decode_end"]),
    ("decode talk.log --protocols --details", 0, &["decode", "decode_end"]),
    ("search talk.log uds.did%==%0xF190", 0, &["search", "search_end"]),
    ("diff talk.log other.log --protocols", 0, &["diff"]),
    ("diff a.log b.log", 0, &["diff"]),
    ("diff b.log a.log --ignore-channels", 0, &["diff"]),
    ("plot a.log --db car.dbc -o out.svg", 0, &["plot"]),
    ("plot b.log --timing 100 -o out.svg", 0, &["plot"]),
    ("db car.dbc", 0, &["db"]),
    ("db kinds.odx-d", 0, &["db_of_ODX"]),
    ("db odd.dbc --warnings", 0, &["db_--warnings"]),
    ("db car.dbc --message Never", 0, &["db_--message"]),
    ("db car.dbc --coverage a.log", 0, &["db_--coverage"]),
    ("demo -t 300ms", 0, &["demo"]),
];

/// Commands that print something only if there are nodes: `tests/nodes.rs` checks their output. What `uds run` does in it is done by the
/// three after it as well, and `uds wait` has something to show only in it.
const WITH_NODES: [&str; 11] = [
    "canopen read",
    "canopen write",
    "canopen monitor",
    "canopen lss",
    "j1939 request",
    "j1939 dm1",
    "uds run",
    "uds security",
    "uds download",
    "uds upload",
    "uds wait",
];

fn hold(schema: &Schema, line: &str, code: Option<i32>, types: &[&str]) {
    let directory = directory(&line.replace(['/', ' ', ':', '#'], "."));
    let (ended, out, err) = cantap(&directory, &format!("{line} --json"));
    assert!(code.is_none() || ended == code, "{line}: {ended:?} {err}");
    let lines: Vec<Value> = out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let (last, others) =
        lines.split_last().unwrap_or_else(|| panic!("{line}: nothing on standard output: {err}"));
    let mut checked = vec![(types[types.len() - 1], last)];
    if types.len() == 1 {
        assert!(others.is_empty(), "{line}: {out}");
    } else {
        assert!(!others.is_empty(), "{line}: {out}");
        checked.extend(others.iter().map(|value| (types[0], value)));
    }
    for (name, value) in checked {
        assert_eq!(schema.faults(name, value), [""; 0], "{line}: {value}");
    }
}

#[test]
fn every_command_prints_what_the_schema_says() {
    let schema = schema();
    for &(line, code, types) in LINES {
        // Elsewhere there is no device that is always full.
        if cfg!(target_os = "linux") || !line.contains("/dev/full") {
            hold(&schema, line, Some(code), types);
        }
    }
}

#[test]
fn a_board_that_has_something_saved_and_one_that_is_tested_print_what_the_schema_says() {
    let schema = schema();
    let settings = directory("saved").join("settings.bin");
    let _ = fs::remove_file(&settings);
    let device = format!("virtual:settings={}", settings.display());
    let (code, _, err) =
        cantap(&directory("saved"), &format!("defaults save -d {device} -b 500k -f 100:700"));
    assert_eq!(code, Some(0), "{err}");
    let (_, out, _) = cantap(&directory("saved"), &format!("defaults show -d {device} --json"));
    let saved: Value = serde_json::from_str(&out).unwrap();
    assert!(saved["channels"][0]["saved"].is_object(), "{out}");
    assert_eq!(schema.faults("defaults_show", &saved), [""; 0]);
    // On a busy computer a step may fail, but the object is the same.
    hold(
        &schema,
        "selftest -d virtual:load=0,wire=joined,ack=no --loop --load-time 100ms",
        None,
        &["selftest"],
    );
}

/// Commands whose own help lists `--json` are those above.
#[test]
fn no_command_with_json_is_left_out() {
    let directory = directory("all");
    let help = |line: &str| cantap(&directory, &format!("{line} --help")).1;
    let commands = |help: &str| -> Vec<String> {
        // The command's own are in groups, those of a command are not.
        let is_before = |line: &&str| !(line.starts_with("Commands:") || line.starts_with("Look at"));
        let listed = help.lines().skip_while(is_before);
        let listed = listed.take_while(|line| !(line.starts_with("Topics") || line.starts_with("Options:")));
        let listed = listed.filter(|line| line.starts_with("  "));
        let names =
            listed.filter(|line| !line.starts_with("   ")).filter_map(|line| line.split_whitespace().next());
        names.filter(|name| *name != "help").map(str::to_owned).collect()
    };
    let mut with = Vec::new();
    let mut without = Vec::new();
    for command in commands(&cantap(&directory, "--help").1) {
        let own = help(&command);
        let below = commands(&own).into_iter().map(|below| format!("{command} {below}"));
        for line in below.chain([command.clone()]) {
            if help(&line).lines().any(|line| line.trim_start().starts_with("--json")) {
                with.push(line);
            } else {
                without.push(line);
            }
        }
    }
    assert!(with.len() > 15 && without.iter().any(|line| line == "monitor"), "{with:?} {without:?}");
    // `disturb` needs a board that was built for it: `tests/it/disturb.rs` checks its output; `interface` needs one of Linux's: `sim/kernel` does.
    let apart = ["selftest", "disturb", "interface"];
    let elsewhere = |line: &&String| apart.contains(&line.as_str()) || WITH_NODES.contains(&line.as_str());
    for line in with.iter().filter(|line| !elsewhere(line)) {
        let is_held = LINES.iter().any(|(held, ..)| *held == line || held.starts_with(&format!("{line} ")));
        assert!(is_held, "{line} has --json, and no line of this test");
    }
}

#[test]
fn an_unknown_key_a_missing_one_and_a_wrong_type_are_faults() {
    let schema = schema();
    let good = json!({ "devices": [{ "device": "COM3", "serial_number": null, "product": "cantap" }] });
    assert_eq!(schema.faults("list", &good), [""; 0]);
    for (path, value) in
        [("/devices/0/new", json!(1)), ("/devices/0/product", json!(1)), ("/new", json!(null))]
    {
        let mut bad = good.clone();
        let (parent, key) = path.rsplit_once('/').unwrap();
        bad.pointer_mut(parent).unwrap()[key] = value;
        assert_eq!(schema.faults("list", &bad).len(), 1, "{path}");
    }
    assert_eq!(schema.faults("list", &json!({})).len(), 1);
    assert_eq!(schema.faults("list", &json!({ "devices": {} })).len(), 1);
}

/// Every type has its table in the page, with the same keys, and every object of the schema defines all of its
/// keys.
#[test]
fn the_page_has_each_key_of_the_schema_and_no_other() {
    let schema = schema();
    let mut tables: Vec<Vec<&str>> = Vec::new();
    for line in PAGE.lines().skip_while(|line| *line != "## The commands") {
        if line == "|---|---|" {
            tables.push(Vec::new());
        } else if let (Some(key), Some(table)) =
            (line.strip_prefix("| `").and_then(|rest| rest.split('`').next()), tables.last_mut())
        {
            table.push(key);
        }
    }
    let mut types: Vec<Vec<&str>> = Vec::new();
    for (name, object) in schema.types() {
        assert_eq!(object["additionalProperties"], false, "{name}");
        types.push(object["properties"].as_object().unwrap().keys().map(String::as_str).collect());
    }
    for table in types.iter_mut().chain(&mut tables) {
        table.sort_unstable();
    }
    types.sort_unstable();
    tables.sort_unstable();
    assert_eq!(types, tables);
}
