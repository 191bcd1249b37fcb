//! What users of other programs type: the answer says what it is called here.

use std::path::Path;
use std::process::{Command, Stdio};

fn cantap(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(arguments).current_dir(folder).stdin(Stdio::null()).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

/// A folder with a trace and a database.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.log"), "(1.0) can0 123#11\n(2.0) can0 456#22\n(3.0) can0 123#33\n")
        .unwrap();
    std::fs::write(folder.path().join("b.log"), "(1.0) can0 123#11\n").unwrap();
    std::fs::write(
        folder.path().join("car.dbc"),
        "BO_ 291 Engine: 8 X\n SG_ Speed : 0|8@1+ (1,0) [0|0] \"\" X\n",
    )
    .unwrap();
    folder
}

#[test]
fn other_programs_names_and_files_in_place_of_a_command_get_advice() {
    let folder = folder();
    for (line, advice) in [
        ("candump can0", "cantap capture prints or records"),
        ("record -d virtual", "cantap capture prints or records"),
        ("cansend can0 123#11", "cantap send sends frames"),
        ("canplayer -I a.log", "cantap replay plays a trace"),
        ("cansniffer can0", "cantap monitor shows"),
        ("canbusload can0", "cantap stats measures"),
        ("log2asc -I a.log", "cantap convert IN OUT"),
        ("databases car.dbc", "cantap db shows"),
        ("version", "cantap --version"),
        ("a.log", "cantap monitor a.log shows a trace, and cantap stats a.log measures it"),
        ("car.dbc", "cantap db car.dbc shows"),
        ("decode a.log car.dbc", "a database is given with --db, as in: --db car.dbc"),
        ("decode car.dbc a.log", "a database is given with --db, as in: --db car.dbc"),
        ("plot a.log car.dbc Speed", "--db car.dbc"),
        (
            "stats a.log b.log",
            "one trace at a time, as in: for trace in *.log; do cantap stats \"$trace\"; done",
        ),
        ("capture virtual:car", "a device is given with -d, as in: -d virtual:car"),
        ("obd virtual:car vin", "a device is given with -d, as in: -d virtual:car"),
        ("monitor -c virtual:car", "a device is given with -d, as in: -d virtual:car"),
        ("gen virtual:car", "a device is given with -d, as in: -d virtual:car"),
        ("obd -d virtual:car dtc", "cantap obd codes"),
        ("uds -d virtual:car rdbi F190", "cantap uds read F190"),
        ("compare a.log b.log", "cantap diff shows"),
        ("cut a.log", "--start 10s --end 20s"),
        ("plot a.log Speed", "as in: --signal Speed"),
        ("convert -I a.log -O b.asc", "cantap convert IN OUT"),
        ("convert a.log b.log b.asc", "one trace at a time"),
        ("capture -d virtual:car -l", "-o FILE.log records one"),
        ("capture -d virtual:car -t a", "-t says for how long"),
        ("capture -d virtual:car --baud 500000", "-b 500k"),
        ("capture -d virtual:car --duration 3", "-t 10s"),
        ("monitor -i socketcan", "-d can0"),
        ("search a.log -Y can.id==1", "cantap search TRACE 'id == 0x123'"),
    ] {
        let arguments: Vec<_> = line.split(' ').collect();
        let (code, out, err) = cantap(folder.path(), &arguments);
        assert!(code == Some(2) && out.is_empty() && err.contains(advice), "{line}: {err}");
        assert!(!err.contains("similar"), "{line}: {err}");
    }
    // An option that there is not is no file's name.
    let (_, _, err) = cantap(folder.path(), &["stats", "a.log", "-Z"]);
    assert!(!err.contains("as a value"), "{err}");
    // A device in the place of a trace, and an interface in that of a channel.
    let (code, _, err) = cantap(folder.path(), &["stats", "virtual:car"]);
    assert!(code == Some(1) && err.contains("; a device is given with -d, as in: -d virtual:car"), "{err}");
    let (_, _, err) = cantap(folder.path(), &["send", "vcan7", "123#11"]);
    assert!(!err.contains("no board is connected") || err.contains("cantap send -d vcan7 1"), "{err}");
    // What is only spelled wrongly still gets the nearest, and what is right needs none.
    let (code, _, err) = cantap(folder.path(), &["stat", "a.log"]);
    assert!(code == Some(2) && err.contains("'stats'"), "{err}");
    assert_eq!(cantap(folder.path(), &["decode", "a.log", "--db", "car.dbc"]).0, Some(0));
}

#[test]
fn several_identifiers_are_separated_as_in_filters() {
    let folder = folder();
    let (code, out, err) = cantap(folder.path(), &["search", "a.log", "--id", "123,456", "--count"]);
    assert_eq!((code, out.trim(), err.as_str()), (Some(0), "3", ""));
    let (code, _, err) = cantap(folder.path(), &["search", "a.log", "--id", "123,x!"]);
    assert!(code == Some(2) && err.contains("x!"), "{err}");
}

#[test]
fn topics_of_help_have_a_singular() {
    let folder = folder();
    for (one, all) in [("filter", "filters"), ("condition", "conditions"), ("time", "times")] {
        let [one, all] = [one, all].map(|word| cantap(folder.path(), &["help", word]));
        assert!(one.0 == Some(0) && one == all, "{}", one.2);
    }
}

/// A trace that comes through a pipe without `-` in its place.
#[cfg(unix)]
#[test]
fn a_pipe_without_a_name_for_it_is_pointed_out() {
    use std::io::Write as _;
    let folder = folder();
    for arguments in [&["stats"][..], &["decode", "--db", "car.dbc"]] {
        let mut child = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(arguments)
            .current_dir(folder.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let _ = child.stdin.take().unwrap().write_all(b"(1.0) can0 123#11\n");
        let err = String::from_utf8(child.wait_with_output().unwrap().stderr).unwrap();
        // With a board on this computer it is listened to, and nothing is pointed out.
        assert!(
            !err.contains("no board is connected") || err.contains("is read with - for its name"),
            "{err}"
        );
    }
}
