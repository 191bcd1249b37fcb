//! Files written by commands replace older ones only once they are complete.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// An empty directory for each test, with a trace that has a broken line in the middle, and one without.
fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join("outputs").join(test);
    // An earlier run may have left files that would be counted.
    let _ = fs::remove_dir_all(&directory);
    fs::create_dir_all(&directory).unwrap();
    let line =
        |at: u32| format!("(1410714882.{:06}) can0 {:03X}#{:08X}\n", at * 500, 0x100 + at % 7, at * at);
    let lines: Vec<_> = (0..1_000).map(line).collect();
    fs::write(directory.join("whole.log"), lines.concat()).unwrap();
    fs::write(
        directory.join("broken.log"),
        format!("{}rubbish\n{}", lines[..500].concat(), lines[500..].concat()),
    )
    .unwrap();
    fs::write(directory.join("car.dbc"), "BO_ 256 M: 4 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n").unwrap();
    directory
}

fn cantap(directory: &Path, line: &str) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cantap"));
    command.args(line.split_whitespace()).current_dir(directory);
    let Output { status, stdout, stderr } = command.output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn names(directory: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(directory)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

/// Commands that write a file from what they read.
const COMMANDS: [(&str, &str); 4] = [
    ("search IN --id 101 -o", "out.log"),
    ("align IN whole.log -o", "out.blf"),
    ("plot IN --db car.dbc --signal S -o", "out.svg"),
    ("plot IN --bus-load -b 1M -o", "out.png"),
];

#[test]
fn a_run_that_fails_leaves_the_older_file_and_nothing_else() {
    for (at, (command, output)) in COMMANDS.into_iter().enumerate() {
        let directory = directory(&format!("fails{at}"));
        let mut before = names(&directory);
        fs::write(directory.join(output), "older\n").unwrap();
        before.push(output.to_owned());
        before.sort();
        let line = format!("{} {output}", command.replace("IN", "broken.log"));
        let (code, _, err) = cantap(&directory, &format!("{line} --strict"));
        assert_eq!(code, Some(1), "{line}: {err}");
        assert_eq!(fs::read_to_string(directory.join(output)).unwrap(), "older\n", "{line}");
        assert_eq!(names(&directory), before, "{line}");
        // Without --strict it is left out, and the file is complete.
        let (code, _, err) = cantap(&directory, &line);
        assert_eq!(code, Some(0), "{line}: {err}");
        assert_ne!(fs::read(directory.join(output)).unwrap(), b"older\n", "{line}");
        assert_eq!(names(&directory), before, "{line}");
    }
}

/// A trace without an end, like a pipe: the command is in the middle of its work when Ctrl-C comes.
#[cfg(unix)]
#[test]
fn a_run_that_is_interrupted_leaves_the_older_file_and_nothing_else() {
    use std::io::Write;
    use std::time::{Duration, Instant};

    for (command, output) in [("search pipe.log --id 101 -o", "out.log"), ("convert pipe.log", "out.blf")] {
        let directory = directory(&format!("interrupted_{}", command.split(' ').next().unwrap()));
        assert!(Command::new("mkfifo").arg(directory.join("pipe.log")).status().unwrap().success());
        fs::write(directory.join(output), "older\n").unwrap();
        let before = names(&directory);
        let mut child = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(command.split(' '))
            .arg(output)
            .current_dir(&directory)
            .spawn()
            .unwrap();
        // Opening for writing only would wait for a reader, even if there will never be one.
        let mut pipe =
            fs::OpenOptions::new().read(true).write(true).open(directory.join("pipe.log")).unwrap();
        pipe.write_all(&fs::read(directory.join("whole.log")).unwrap()).unwrap();
        let started = Instant::now();
        while names(&directory) == before {
            assert!(started.elapsed() < Duration::from_secs(20), "{command}: no file beside");
            assert_eq!(child.try_wait().unwrap(), None, "{command}");
            std::thread::sleep(Duration::from_millis(10));
        }
        assert_eq!(fs::read_to_string(directory.join(output)).unwrap(), "older\n", "{command}");
        assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), Some(130), "{command}");
        assert_eq!(fs::read_to_string(directory.join(output)).unwrap(), "older\n", "{command}");
        assert_eq!(names(&directory), before, "{command}");
    }
}

/// What could not be read, and what is not part of a CAN trace, in every object about what was read.
#[test]
fn what_is_missing_is_in_the_json_of_every_command_that_reads_a_trace() {
    let directory = directory("missing");
    let head = "date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\ninternal events logged\n";
    let frames: Vec<_> = (0..60).map(|at| format!("0.{at:02} 1 100 Rx d 4 11 {at:02X} 33 44\n")).collect();
    let more = "0.7 L1 WakeupReq\n0.7 L1 WakeupReq\n0.8 1 12G Rx d 0\n";
    fs::write(directory.join("mixed.asc"), format!("{head}{}{more}", frames.concat())).unwrap();
    for (line, times) in [
        ("stats mixed.asc", 1),
        ("convert mixed.asc out.log", 1),
        ("diff mixed.asc mixed.asc", 2),
        ("align mixed.asc mixed.asc", 2),
        ("db car.dbc --coverage mixed.asc", 1),
        ("plot mixed.asc --db car.dbc -o out.svg", 1),
        ("plot mixed.asc --timing 100 -o out.svg", 1),
        ("search mixed.asc --id 100", 1),
        ("decode mixed.asc --db car.dbc", 1),
        ("replay -d virtual:load=0 -b 500k --speed 10 mixed.asc", 1),
    ] {
        let (code, out, err) = cantap(&directory, &format!("{line} --json"));
        assert_eq!(code, Some(0), "{line}: {err}");
        let last: serde_json::Value = serde_json::from_str(out.lines().last().unwrap()).unwrap();
        let object = last.get("summary").unwrap_or(&last);
        assert_eq!(object["issues"], times, "{line}: {out}");
        assert_eq!(object["left_out"]["LIN events other than frames"], 2 * times, "{line}: {out}");
        let share = &object["missing_pct"];
        let share = share.as_f64().or_else(|| share[0].as_f64()).unwrap();
        assert!((share - 300.0 / 63.0).abs() < 1e-9, "{line}: {out}");
    }
}

#[test]
fn a_replay_and_a_send_count_what_did_not_go_out_by_reason() {
    let directory = directory("unsent");
    let trace =
        "(1.000000) can0 123#11\n(1.001000) can1 123#11\n(1.002000) can2 123#11\n(1.003000) can0 123##011\n";
    fs::write(directory.join("a.log"), trace).unwrap();
    let json = |line: &str, expected: i32| -> serde_json::Value {
        let (code, out, err) = cantap(&directory, &format!("{line} --json"));
        assert_eq!(code, Some(expected), "{line}: {err}");
        serde_json::from_str(&out).unwrap()
    };
    let replayed = json("replay -d virtual:load=0 -b 500k a.log", 0);
    assert_eq!(
        (&replayed["asked"], &replayed["sent"], &replayed["not_sent"]),
        (&2.into(), &2.into(), &0.into())
    );
    let kinds = serde_json::json!({
        "frames of channels that nothing is sent to": 1,
        "CAN FD frames, which the device cannot send": 1,
    });
    assert_eq!((&replayed["left_out"], &replayed["issues"]), (&kinds, &0.into()));
    let sent = json("send -d virtual:load=0,ack=no 1 123#11 -n 2 --one-shot", 1);
    assert_eq!((&sent["not_sent"], &sent["left_out"]["bus-error"]), (&2.into(), &2.into()), "{sent}");
    let sent = json("send -d virtual:load=0,ack=no 1 123#11", 1);
    assert_eq!(
        (&sent["not_sent"], &sent["left_out"]["never left the device"]),
        (&1.into(), &1.into()),
        "{sent}"
    );
    // A database with a fault, of which the rest is usable.
    fs::write(
        directory.join("odd.dbc"),
        "BO_ 256 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n SG_ T : 0|99@1+ (1,0) [0|0] \"\" A\n",
    )
    .unwrap();
    let sent = json("send -d virtual:load=0 -b 500k 1 M:S=1 --db odd.dbc", 0);
    assert_eq!((&sent["sent"], &sent["issues"]), (&1.into(), &1.into()), "{sent}");
}
