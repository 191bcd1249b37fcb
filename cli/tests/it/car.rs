//! `virtual:car` through the command: its database is built in, and another program reads what it sends with that
//! database.
//!
//! cantools is in `CANTAP_PYTHON`, otherwise `python3`. If it is missing, the test says so and passes, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;

use std::process::{Command, Output};

fn cantap(arguments: &[&str]) -> (String, String) {
    let Output { status, stdout, stderr } =
        Command::new(env!("CARGO_BIN_EXE_cantap")).args(arguments).output().unwrap();
    let (out, err) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert!(status.success(), "{arguments:?}: {err}");
    (out, err)
}

#[test]
fn cantools_reads_the_database_and_finds_every_frame_in_range() {
    let Some(python) = peers::python_with("cantools") else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("car.dbc"), cantap(&["virtual", "car", "--dbc"]).0).unwrap();
    // Both buses at their own rates, for a minute of the car's time.
    let device = "virtual:car,pace=fast";
    cantap(&["capture", "-d", device, "-n", "50000", "-o", &path("car.log")]);
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/car_peer.py");
    let output = Command::new(python).args([script, &path("car.dbc"), &path("car.log")]).output().unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    let words: Vec<&str> = said.split_whitespace().collect();
    let [frames, messages] = words[..] else { panic!("{said}") };
    assert!(frames.parse::<u32>().unwrap() >= 50_000, "{said}");
    // All except those of testers and of a key's buttons.
    assert!(messages.parse::<u32>().unwrap() >= 34, "{said}");
}

#[test]
fn the_live_view_shows_signals_by_itself_and_says_whose_they_are() {
    let (screen, said) = cantap(&[
        "monitor",
        "-d",
        "virtual:car",
        "--view",
        "signals",
        "--once",
        "-t",
        "1s",
        "--size",
        "120x50",
    ]);
    assert!(screen.contains("EngineSpeed") && screen.contains("rpm"), "{screen}");
    assert!(said.contains("cantap virtual car --dbc"), "{said}");
}

#[test]
fn a_device_in_the_place_of_a_trace_is_told_apart() {
    let (screen, said) = cantap(&["monitor", "virtual:car", "--once", "-t", "1s", "--size", "120x50"]);
    assert!(screen.contains("virtual:car listen-only: running") && screen.contains("500k"), "{screen}");
    assert!(said.contains("cantap virtual car --dbc"), "{said}");
}

#[test]
fn messages_are_sent_by_the_car_s_own_names() {
    let send = |frame: &str| cantap(&["send", "-d", "virtual:car", "1", frame]);
    let (sent, said) = send("SWM_Buttons:Button=Phone,ButtonPressed=1");
    assert!(sent.contains("5A0#14"), "{sent}");
    assert!(said.contains("cantap virtual car --dbc"), "{said}");
    let (sent, said) = send("7DF#02010C");
    assert!(sent.contains("7DF#02010C") && !said.contains("--dbc"), "{sent}{said}");
}
