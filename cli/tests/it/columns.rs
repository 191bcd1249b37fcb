//! Parquet files written by the command, read by other programs.
//!
//! pyarrow, DuckDB, Polars and pandas are in `CANTAP_PYTHON`, otherwise `python3`. If they are missing, the test says so and passes,
//! unless `CANTAP_REQUIRE_PEERS=1`.
#![cfg(feature = "parquet")]

use cantap_testing::peers;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::{Value, json};

fn run(folder: &Path, line: &str) -> (Option<i32>, String, String) {
    let command = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(line.split(' '))
        .current_dir(folder)
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (command.status.code(), text(command.stdout), text(command.stderr))
}

fn cantap(folder: &Path, line: &str) -> String {
    let (code, out, err) = run(folder, line);
    assert_eq!(code, Some(0), "{line}: {err}");
    out
}

/// Twenty thousand frames from the virtual car, with its database, including a loss and a bus error.
fn drive(folder: &Path) {
    fs::write(folder.join("car.dbc"), cantap(folder, "virtual car --dbc")).unwrap();
    cantap(folder, "capture -d virtual:car,pace=fast -n 20000 -o captured.log");
    let log = fs::read_to_string(folder.join("captured.log")).unwrap();
    let (before, after) = log.split_at(log[..log.len() / 2].rfind('\n').unwrap() + 1);
    let stamp = after.split(' ').next().unwrap();
    let events = format!("{stamp} can0 20000004#0001000000000000\n{stamp} can0 20000088#0000000000000000\n");
    fs::write(folder.join("drive.log"), format!("{before}{events}{after}")).unwrap();
}

#[test]
fn engines_read_what_the_trace_has() {
    let Some(python) = peers::python_with("duckdb, pandas, polars, pyarrow") else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    drive(folder);
    for line in [
        "convert drive.log frames.parquet",
        "decode --db car.dbc drive.log -o signals.parquet",
        "convert drive.log fleet --partition vehicle=7,day,channel",
        "decode --db car.dbc drive.log -o messages --per-message",
        "decode --db car.dbc drive.log -o wide.parquet --resample 100ms",
    ] {
        cantap(folder, line);
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/columns_peer.py");
    let files =
        ["frames.parquet", "signals.parquet", "fleet", "messages/ECM_Engine1.parquet", "wide.parquet"];
    let output = Command::new(python).arg(script).args(files).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();

    let stats: Value = serde_json::from_str(&cantap(folder, "stats drive.log --json")).unwrap();
    let channels = stats["channels"].as_array().unwrap();
    let frames: u64 = channels.iter().map(|channel| channel["frames"].as_u64().unwrap()).sum();
    let events = found["frames"].as_array().unwrap();
    assert!(events.contains(&json!(["frame", frames])) && events.contains(&json!(["lost", 1])), "{events:?}");
    assert!(events.contains(&json!(["bus-error", 1])), "{events:?}");
    assert_eq!(found["zone"], "timestamp[ns, tz=UTC]");

    // Each signal's number of values and their sum, from the JSON lines.
    let mut sums: BTreeMap<String, (u64, f64)> = BTreeMap::new();
    for line in cantap(folder, "decode --db car.dbc drive.log --json").lines() {
        let line: Value = serde_json::from_str(line).unwrap();
        let Some(signals) = line["signals"].as_object() else { continue };
        for (name, value) in signals {
            let sum = sums.entry(format!("{}.{name}", line["message"].as_str().unwrap())).or_default();
            if let Some(value) = value.as_f64() {
                *sum = (sum.0 + 1, sum.1 + value);
            }
        }
    }
    let signals = found["signals"].as_array().unwrap();
    assert_eq!(signals.len(), sums.len());
    for signal in signals {
        let (count, sum) = sums[signal[0].as_str().unwrap()];
        assert_eq!(signal[1], count, "{signal}");
        let found = signal[2].as_f64().unwrap();
        assert!((found - sum).abs() <= 1e-3 + sum.abs() * 1e-9, "{signal} {sum}");
    }

    let rows: u64 = found["dataset"].as_array().unwrap().iter().map(|place| place[3].as_u64().unwrap()).sum();
    assert_eq!(rows, frames + 2);
    let engine = sums.iter().filter(|(name, _)| name.starts_with("ECM_Engine1.")).count();
    assert!(found["message"]["rows"].as_u64().unwrap() > 100, "{found}");
    assert!(found["message"]["columns"].as_array().unwrap().len() >= 3 + engine, "{found}");
    assert_eq!(found["message"]["units"]["EngineSpeed"], "rpm", "{found}");
    assert_eq!(found["wide"]["columns"], sums.len() + 1, "{found}");
    assert!(found["wide"]["rows"].as_u64().unwrap() > 10, "{found}");
    assert!(folder.join("messages/events.parquet").exists());
}

#[test]
fn a_name_or_a_wish_that_does_not_fit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.log"), "(1.000000) can0 123#00\n").unwrap();
    fs::write(folder.join("car.dbc"), "BO_ 291 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n").unwrap();
    for (line, says) in [
        ("convert a.log out.parquet --partition day", "give a folder's"),
        ("convert a.log out --partition days", "write day, channel, or NAME=VALUE"),
        ("decode --db car.dbc a.log --wide", "a name that ends in .csv or .parquet"),
        ("decode --db car.dbc a.log --per-message", "--output"),
        ("decode --db car.dbc a.log -o x.parquet --per-message", "give a folder's"),
    ] {
        let (code, _, err) = run(folder, line);
        assert_eq!(code, Some(2), "{line}: {err}");
        assert!(err.contains(says), "{line}: {err}");
    }
    // If the input cannot be read, an older file stays unchanged.
    fs::write(folder.join("older.parquet"), "older").unwrap();
    fs::write(folder.join("b.log"), "no trace\nat all\n").unwrap();
    for line in ["convert b.log older.parquet", "decode --db car.dbc b.log -o older.parquet"] {
        let (code, _, err) = run(folder, line);
        assert_eq!(code, Some(1), "{line}: {err}");
        assert_eq!(fs::read(folder.join("older.parquet")).unwrap(), b"older", "{line}");
    }
    let names: Vec<_> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names.len(), 4, "{names:?}");
}

/// The form follows the file's name.
#[test]
fn decoded_signals_go_to_a_file_of_their_form() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.log"), "(1.000000) can0 123#2A\n").unwrap();
    fs::write(folder.join("car.dbc"), "BO_ 291 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n").unwrap();
    for (name, option) in [("a.csv", "--csv"), ("a.json", "--json"), ("a.txt", "-q")] {
        let said = cantap(folder, &format!("decode --db car.dbc a.log {option}"));
        assert_eq!(cantap(folder, &format!("decode --db car.dbc a.log -o {name}")), "");
        assert_eq!(fs::read_to_string(folder.join(name)).unwrap(), said, "{name}");
    }
    // Lines of text would be mistaken for something else under such a name.
    for name in ["a.mf4", "a.xlsx", "a.blf", "a.foo"] {
        let arguments = format!("decode --db car.dbc a.log -o {name}");
        let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
        let output = command.args(arguments.split_whitespace()).current_dir(folder).output().unwrap();
        let err = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{name}: {err}");
        assert!(err.contains("does not say which form") && err.contains(".csv"), "{name}: {err}");
        assert!(!folder.join(name).exists(), "{name}");
    }
}

/// Everything that a trace has comes back from its table, and every command reads it.
#[test]
fn a_parquet_file_is_a_trace_again() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    drive(folder);
    cantap(folder, "convert drive.log drive.parquet");
    cantap(folder, "convert drive.parquet again.log");
    cantap(folder, "convert drive.log directly.log");
    assert!(fs::read(folder.join("again.log")).unwrap() == fs::read(folder.join("directly.log")).unwrap());
    cantap(folder, "convert --to parquet drive.log other.bin");
    for command in ["stats IN --json", "decode --db car.dbc IN --csv"] {
        let of = |name: &str| cantap(folder, &command.replace("IN", name)).replace(name, "IN");
        let without_format = |text: String| text.replace("\"parquet\"", "\"candump\"");
        assert!(without_format(of("drive.parquet")) == of("drive.log"), "{command}");
        assert!(without_format(of("other.bin")) == of("drive.log"), "{command}");
    }
    for (line, says) in [
        ("convert drive.log - --to parquet", "give a file's name"),
        ("convert drive.log out.parquet --rotate 1M", "--partition day"),
    ] {
        let (code, _, err) = run(folder, line);
        assert_eq!(code, Some(2), "{line}: {err}");
        assert!(err.contains(says), "{line}: {err}");
    }
    cantap(folder, "decode --db car.dbc drive.log -o signals.parquet");
    let (code, _, err) = run(folder, "convert signals.parquet frames.log");
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("decoded values, whose frames are not in the table"), "{err}");
    cantap(folder, "decode --db car.dbc drive.log -o wide.parquet --resample 100ms");
    let (code, _, err) = run(folder, "convert wide.parquet frames.log");
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("say what they are with --columns"), "{err}");
}

/// As pandas and pyarrow write frames: with their compressions, and columns of any names and types.
#[test]
fn tables_that_engines_wrote_are_traces() {
    let Some(python) = peers::python_with("pandas, pyarrow") else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let script = "
import pandas, sys
frames = pandas.DataFrame({
    'Timestamp': pandas.to_datetime([1700000000000000001, 1700000001000000002, 1700000001500000000], utc=True),
    'CAN ID': [0x123, 0x18DAF110, 0x7FF], 'Bus': [0, 0, 1],
    'Data': [bytes([1, 2]), b'', bytes(range(8))], 'Label': ['a', 'b', None]})
for codec in ['snappy', 'gzip', 'lz4', 'zstd', 'none']:
    frames.to_parquet(f'{codec}.parquet', compression=codec)
frames.to_parquet('brotli.parquet', compression='brotli')
frames['Data'] = [[1, 2], [], list(range(8))]
frames.to_parquet('lists.parquet')
pandas.DataFrame({'when': [1000.5], 'who': ['18DAF110'], 'd': ['0x0102']}).to_parquet('unknown.parquet')
";
    let output = Command::new(python).args(["-c", script]).current_dir(folder).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let wanted = "(1700000000.000000) can0 123#0102\n(1700000001.000000) can0 18DAF110#\n(1700000001.500000) can1 7FF#0001020304050607\n";
    for name in ["snappy", "gzip", "lz4", "zstd", "none", "lists"] {
        assert_eq!(cantap(folder, &format!("convert {name}.parquet -")), wanted, "{name}");
    }
    let (code, _, err) = run(folder, "convert brotli.parquet a.log");
    assert!(code == Some(1) && err.to_lowercase().contains("brotli"), "{err}");
    let (code, _, err) = run(folder, "convert unknown.parquet a.log");
    assert!(code == Some(1) && err.contains("when, who, d"), "{err}");
    let found = cantap(folder, "convert unknown.parquet - --columns time=when:ms,id=who,data=d");
    assert_eq!(found, "(1.000500) can0 18DAF110#0102\n");
}
