//! What a device keeps across a power cycle, as users set and use it. The virtual device's settings are in a file, so
//! each command here meets the device after a power cycle.

use std::path::PathBuf;
use std::process::{Command, Output};

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments.split_whitespace()).output();
    let Output { status, stdout, stderr } = output.unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

/// A settings file for this test only, which does not exist yet.
fn settings(name: &str) -> PathBuf {
    let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_file(&path);
    path
}

fn done(arguments: &str, out: &str) {
    assert_eq!(cantap(arguments), (Some(0), out.to_owned(), String::new()), "{arguments}");
}

/// On a bus on which nobody else acknowledges, every completely received frame was acknowledged by this device. A capture
/// without -b has to find out what is saved, and must not do so by joining the bus as saved.
#[test]
fn a_capture_only_listens_though_normal_mode_is_saved() {
    let file = settings("normal.settings");
    let device = format!("virtual:ack=no,load=60,frames=std8,bitrate=500k,settings={}", file.display());
    done(&format!("defaults save -d {device} -b 500k --mode normal"), "saved on the device\n");
    let (code, out, err) = cantap(&format!("capture -d {device} -t 400ms"));
    // A capture with nothing but errors is a failure.
    assert_eq!(code, Some(1), "{err}");
    let frames = |out: &str| out.lines().filter(|line| !line.contains(" 2000") && line.contains('#')).count();
    assert_eq!(frames(&out), 0, "{out}");
    // The bus was active all the time, and it does get frames across once somebody acknowledges them.
    assert!(err.contains("channel 1: 0 frames"), "{err}");
    assert!(out.lines().count() > 10, "{out}");
    let (code, out, err) = cantap(&format!("capture -d {device} --mode normal -n 20 -t 5s"));
    assert_eq!((code, frames(&out)), (Some(0), 20), "{err}");
}

#[test]
fn saved_settings_survive_a_power_cycle_and_are_used_where_no_bit_rate_is_given() {
    let file = settings("kept.settings");
    let device = format!("virtual:frames=std8,bitrate=250k,settings={}", file.display());
    done(&format!("defaults show -d {device}"), "channel 1  nothing saved\nchannel 2  nothing saved\n");
    done(&format!("defaults save -d {device} -c 1 -b 250k -f 000:C0000400"), "saved on the device\n");
    // The other channel, from another session: the first one stays unchanged.
    done(
        &format!("defaults save -d {device} -c 2 -b 125k --one-shot --recovery manual"),
        "saved on the device\n",
    );
    done(
        &format!("defaults show -d {device}"),
        "channel 1  250000 bit/s, sample point 87.5 %, listen-only, receives 000:400 data\n\
         channel 2  125000 bit/s, sample point 87.5 %, listen-only, one-shot, recovery manual, receives everything\n",
    );
    let (code, out, err) = cantap(&format!("capture -d {device} -c 1 -n 50 -t 5s"));
    assert_eq!(code, Some(0), "{err}");
    assert!(err.contains("channel 1: only what its 1 saved filters accept"), "{err}");
    let ids: Vec<u32> = out
        .lines()
        .map(|line| u32::from_str_radix(line.split([' ', '#']).nth(2).unwrap(), 16).unwrap())
        .collect();
    assert!(ids.len() == 50 && ids.iter().all(|id| id & 0x400 == 0), "{out}");
    // Options on the command line take precedence.
    let (code, out, err) = cantap(&format!("capture -d {device} -c 1 -f 400:C0000400 -n 5 -t 5s"));
    assert!(code == Some(0) && out.lines().count() == 5, "{err}");
    // Changing the mode leaves rate and filters unchanged.
    done(&format!("defaults save -d {device} -c 1 --mode normal"), "saved on the device\n");
    let (_, out, _) = cantap(&format!("defaults show -d {device} --json"));
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    let saved = &object["channels"][0]["saved"];
    assert_eq!(
        (&saved["mode"], &saved["bitrate_bps"], &saved["filters"]),
        (&"normal".into(), &250_000.into(), &serde_json::json!(["000:400 data"]))
    );
    done(&format!("defaults clear -d {device}"), "erased from the device\n");
    done(&format!("defaults show -d {device}"), "channel 1  nothing saved\nchannel 2  nothing saved\n");
}

#[test]
fn what_cannot_be_saved_is_refused_and_what_was_saved_stays() {
    let file = settings("refused.settings");
    let device = format!("virtual:settings={}", file.display());
    done(&format!("defaults save -d {device} -b 500k"), "saved on the device\n");
    let before = std::fs::read(&file).unwrap();
    for (line, part) in [
        ("-b 250k -f 123~7FF", "cannot be saved"),
        ("-b 999999", "947368"),
        ("--segments 1,1,1,1", "cantap timing"),
    ] {
        let (code, out, err) = cantap(&format!("defaults save -d {device} {line}"));
        assert_eq!((code, out.as_str()), (Some(1), ""), "{line}: {err}");
        assert!(err.contains(part), "{line}: {err}");
        assert_eq!(std::fs::read(&file).unwrap(), before, "{line}");
    }
}
