//! The pictures in the documents, made by the command from recorded buses, and the live view's `--once` as scripts
//! use it.
//!
//! After an intended change, rewrite them with `CANTAP_OVERWRITE=1 cargo test -p cantap-cli --test
//! monitor_screens` and check them.

use std::path::Path;
use std::process::{Command, Output};

/// Half a minute of `virtual:car`, recorded.
const DRIVE: &str = "docs/screens/drive.log.xz";
const BOAT: &str = "monitor host/formats/tests/data/nmea2000.log.gz -p docs/screens/boat.toml --once";

fn cantap(arguments: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(arguments.split_whitespace()).env("LC_ALL", "C.UTF-8").env_remove("NO_COLOR");
    command.current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."));
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn the_pictures_in_the_documents_are_what_the_command_draws() {
    let documents = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/screens");
    let folder = tempfile::tempdir().unwrap();
    let monitor = format!("monitor {DRIVE} -p docs/screens/car.toml --once");
    for (name, command) in [
        ("fixed", format!("{monitor} --view fixed --size 132x24 --svg")),
        ("graph", format!("{monitor} --view graph --size 100x26 --svg")),
        (
            "plot",
            format!(
                "plot {DRIVE} --db host/virtual/src/car/car.dbc -s EngineSpeed -s VehicleSpeed -s CurrentGear -s AcceleratorPedal -o"
            ),
        ),
    ] {
        let drawn = folder.path().join(format!("{name}.svg"));
        let line = format!("{command} {}", drawn.display());
        let (code, out, err) = cantap(&line);
        assert!(
            code == Some(0) && out.is_empty() && (name == "plot" || err.is_empty()),
            "{line}: {out}{err}"
        );
        let drawn = std::fs::read_to_string(drawn).unwrap();
        let document = documents.join(format!("{name}.svg"));
        if std::env::var_os("CANTAP_OVERWRITE").is_some() {
            std::fs::write(&document, &drawn).unwrap();
        }
        let shown = std::fs::read_to_string(&document).unwrap_or_default().replace("\r\n", "\n");
        assert!(drawn == shown, "{} is not what is drawn now", document.display());
    }
}

#[test]
fn one_screen_is_text_of_the_size_that_was_asked_for() {
    let (code, out, err) = cantap(&format!("{BOAT} --view signals --size 90x12"));
    assert_eq!((code, err.as_str()), (Some(0), ""));
    assert!(out.lines().count() == 12 && out.lines().all(|line| line.chars().count() <= 90), "{out}");
    assert!(out.contains("PositionRapid.Latitude") && out.contains("deg"), "{out}");
    // If it cannot show anything, it says so and fails.
    for (line, code, part) in [
        ("monitor nothing.log --once", 1, "nothing.log"),
        ("monitor -d /dev/nothing -b 500k --once", 1, "there is no device at '/dev/nothing'"),
        ("monitor --once --size 0x5", 2, "80x24"),
        ("monitor --svg a.svg", 2, "--once"),
        ("monitor --normal --mode listen --once", 2, "--mode"),
        ("monitor a.log -d virtual", 2, "--device"),
        ("monitor -d virtual -b 999999 --once", 1, "947368"),
        ("monitor -d virtual -c 3 --once", 2, "a device has channels 1 and 2, and no channel 3"),
        ("monitor -d virtual -b 3:250k --once", 2, "a device has no channel 3"),
        ("monitor -d virtual:load=101 --once", 2, "give per cent, 0 to 100"),
        ("monitor -d emu:any.elf,load=101 --once", 2, "give per cent, 0 to 100"),
    ] {
        let (got, _, err) = cantap(line);
        assert!(got == Some(code) && err.contains(part), "{line}: {got:?} {err}");
    }
}

#[test]
fn an_address_given_bare_is_the_device() {
    let (code, out, err) = cantap("monitor virtual:car --once -t 1s --view signals --size 120x50");
    assert!(
        code == Some(0) && out.contains("EngineSpeed") && err.contains("virtual car --dbc"),
        "{err}{out}"
    );
    let (code, out, err) = cantap("monitor virtual:load=30 -c 2 --once -t 800ms --view statistics");
    assert!(code == Some(0) && out.contains("Channel 2: ") && !out.contains("Channel 1: "), "{err}{out}");
    for (line, code, part) in [
        ("monitor virtual:speed=5 --once", 2, "there is no option 'speed'"),
        ("monitor /dev/ttyACM99 -b 500k --once", 1, "there is no device at '/dev/ttyACM99'"),
        ("monitor host/formats/tests/data/nmea2000.log.gz -c 1 --once", 2, "-c chooses a device's channels"),
        ("monitor virtual -d virtual --once", 2, "--device"),
    ] {
        let (got, _, err) = cantap(line);
        assert!(got == Some(code) && err.contains(part), "{line}: {got:?} {err}");
    }
}

#[test]
fn a_profile_is_read_where_it_is_and_what_it_names_must_be_there() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    std::fs::create_dir(folder.path().join("db")).unwrap();
    write(
        "db/car.toml",
        "version = 1\n[[message]]\nname = \"Engine\"\nid = 0x123\nlength = 1\n[[message.signal]]\nname = \"Speed\"\nat = \"D1\"\n",
    );
    write("drive.log", "(1.0) can0 123#11\n(2.0) can0 123#22\n(3.0) can0 123#33\n");
    let once = |profile: &str, more: &str| {
        write("car-profile.toml", profile);
        let path = |name: &str| folder.path().join(name).display().to_string();
        cantap(&format!("monitor {} -p {} --once {more}", path("drive.log"), path("car-profile.toml")))
    };
    // The test does not run in the profile's folder.
    for graph in ["Speed", "Engine.Speed", "Engine.*"] {
        let (code, out, err) =
            once(&format!("databases = [\"db/car.toml\"]\ngraph = [\"{graph}\"]\nview = \"graph\"\n"), "");
        assert!(code == Some(0) && err.is_empty() && out.contains("Speed 51"), "{graph}: {err}{out}");
    }
    let recorded = folder.path().join("again.log");
    let (code, _, err) = once("record = \"again.log\"\n", "");
    assert!(code == Some(0) && recorded.exists(), "{err}");
    for (profile, more, part) in [
        (
            "databases = [\"db/car.toml\"]\ngraph = [\"Sped\"]\n",
            "",
            "no signal of the databases matches \"Sped\"; did you mean Speed?",
        ),
        ("databases = [\"db/car.toml\"]\ngraph = [\"Body.Speed\"]\n", "", "\"Body.Speed\""),
        ("databases = [\"car.toml\"]\n", "", "car.toml"),
        ("", "--db nothing.dbc", "nothing.dbc"),
        ("speed = 5\n", "", "unknown field `speed`"),
    ] {
        let (code, out, err) = once(profile, more);
        assert!(code == Some(1) && out.is_empty() && err.contains(part), "{profile}: {code:?} {err}");
    }
}

#[test]
fn channels_are_opened_as_by_the_other_commands() {
    for (line, parts) in [
        ("-b 500k -b 2:250k", vec!["Channel 1: 500000 bit/s", "Channel 2: 250000 bit/s", "listen-only"]),
        ("-b 2:250k", vec!["Channel 2: 250000 bit/s"]),
        ("-c 1", vec!["Channel 1: 500000 bit/s"]),
        ("--segments 9,13,2,2", vec!["Channel 1: 250000 bit/s", "Channel 2: 250000 bit/s"]),
        ("-b 500k --sample-point 75 --mode normal", vec!["Channel 1: 500000 bit/s", " NORMAL: running"]),
        ("-b 500k --mode loopback", vec![" loopback: running"]),
    ] {
        let line =
            format!("monitor -d virtual:load=30 --view statistics --once --size 120x40 -t 800ms {line}");
        let (code, out, err) = cantap(&line);
        assert_eq!((code, err.as_str()), (Some(0), ""), "{line}");
        for part in parts {
            assert!(out.contains(part), "{line}: {part}\n{out}");
        }
        let both = line.contains("-b 500k") || line.contains("--segments");
        let heard = out.matches("\nChannel ").count();
        assert_eq!(
            heard,
            if line.contains("loopback") {
                0
            } else if both {
                2
            } else {
                1
            },
            "{line}\n{out}"
        );
    }
}

#[test]
fn what_the_device_leaves_out_gives_no_load() {
    let line = "monitor -d virtual:load=50,frames=std8 -c 1 -b 500k --view statistics --once --size 120x40 -t 2500ms";
    let load = |option: &str| {
        let (code, out, _) = cantap(&format!("{line} {option}"));
        assert!(code == Some(0) && out.contains("Channel 1: 500000 bit/s"), "{out}");
        (
            out.contains("Load"),
            out.lines().nth(1).unwrap().contains(" %"),
            out.contains("there are zeros in its place"),
        )
    };
    assert_eq!(load(""), (true, true, false));
    assert_eq!(load("--no-data"), (false, false, true));
    assert_eq!(load("--no-stamps"), (false, false, false));
}
