//! The `cantap-sim` command: what it prints, how it ends, and the device it serves to others.

use crate::common;

use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use cantap_sim::address::Address;
use cantap_sim::capture::{Session, SessionEvent};
use cantap_sim::rig::timing;
use cantap_wire::message::ChannelConfig;
use cantap_wire::{Channel, Record, Reply};
use serde_json::Value;

fn cantap_sim(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cantap-sim")).args(arguments).output().unwrap()
}

fn run(elf: &Path, arguments: &[&str]) -> Output {
    cantap_sim(&[&["run", elf.to_str().unwrap()], arguments].concat())
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_run_prints_one_object_with_the_demos_keys_and_its_own() {
    let elf = common::elf();
    let output = run(&elf, &["--seconds", "0.05", "--frames", "mix", "--json"]);
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let mut keys: Vec<&str> = report.as_object().unwrap().keys().map(String::as_str).collect();
    keys.sort_unstable();
    let expected = [
        "channels",
        "cpu_load_pct",
        "host_s_per_emulated_s",
        "in_order",
        "isr_cycles_per_frame",
        "lost",
        "masked_ns_max",
        "ok",
        "queue_bytes",
        "queue_high_water_bytes",
        "seconds",
        "stamp_latency_ns",
        "timing",
        "wire_bytes_per_frame",
    ];
    assert_eq!(keys, expected);
    assert_eq!(report["ok"], true);
    for channel in report["channels"].as_array().unwrap() {
        assert!(
            channel["sent"].as_u64().unwrap() > 400 && channel["sent"] == channel["delivered"],
            "{channel}"
        );
    }
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_log_is_replayed_at_its_own_times_to_the_last_frame() {
    let elf = common::elf();
    let directory = tempfile::tempdir().unwrap();
    let log = directory.path().join("two.log");
    let lines = "(10.000000) vcan0 123#1122\n(10.010000) vcan1 1F334455#R\n(10.020000) vcan0 7FF#\n";
    std::fs::write(&log, lines).unwrap();
    let output = run(&elf, &["--replay", log.to_str().unwrap(), "--json"]);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["channels"][0]["delivered"], 2);
    assert_eq!(report["channels"][1]["delivered"], 1);
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn bad_input_is_told_in_one_line_that_names_it() {
    let elf = common::elf();
    let host_program = env!("CARGO_BIN_EXE_cantap-sim");
    for (arguments, what) in [
        (vec!["run", "no-such-file.elf"], "no-such-file.elf"),
        (vec!["run", concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")], "not an ELF"),
        (vec!["run", host_program], "another chip"),
        (vec!["run", elf.to_str().unwrap(), "--replay", "no.log"], "no.log"),
        (vec!["run", elf.to_str().unwrap(), "--bitrate", "999999"], "999999"),
        (vec!["run", elf.to_str().unwrap(), "--trace", "/no/such/place.json"], "/no/such/place.json"),
    ] {
        let output = cantap_sim(&arguments);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert!(message.starts_with("cantap-sim: ") && message.contains(what), "{message}");
        assert_eq!(message.lines().count(), 1, "{message}");
    }
    for wrong in [["--frames", "fd"], ["--seconds", "0"], ["--load", "101"], ["--channels", "3"]] {
        assert_eq!(run(&elf, &wrong).status.code(), Some(2), "{wrong:?}");
    }
}

/// The device as a byte stream in this process, as the host library uses it.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_served_device_talks_to_whoever_reads_and_writes() {
    use std::io::{ErrorKind, Read, Write};

    let elf = common::elf();
    let address: Address = format!("{},load=10,seed=3", elf.display()).parse().unwrap();
    let mut port = address.open().unwrap();
    let mut session = Session::new();
    let mut frames = 0;
    let mut exchange = |bytes: &[u8], until: &mut dyn FnMut(&mut Session, u64) -> bool| {
        port.writer.write_all(bytes).unwrap();
        let deadline = Instant::now() + Duration::from_mins(1);
        while !until(&mut session, frames) {
            assert!(Instant::now() < deadline, "nothing more came");
            let mut piece = [0; 4096];
            match port.reader.read(&mut piece) {
                Ok(0) => panic!("the emulation ended"),
                Ok(len) => session.take(&piece[..len], |heard| {
                    frames += u64::from(matches!(heard, SessionEvent::Record(_, Record::Received(_))));
                }),
                Err(error) => assert_eq!(error.kind(), ErrorKind::TimedOut),
            }
        }
    };
    let mut requests = Session::new();
    let (id, hello) = requests.hello();
    exchange(&hello, &mut |session, _| {
        session.response(id).is_some_and(|response| matches!(response.result, Ok(Reply::Hello(_))))
    });
    // Half the default bit rate: the buses use the rate at which the channel is opened.
    let config = Some(ChannelConfig::listen_only(timing(500_000).unwrap()));
    let (id, open) = requests.request(cantap_wire::Command::Open { channel: Channel::Can1, config });
    exchange(&open, &mut |session, _| session.response(id).is_some_and(|response| response.result.is_ok()));
    exchange(&[], &mut |_, frames| frames >= 50);
    assert_eq!(session.corruptions(), []);
}

/// A client that is killed closes the port like any other: the channel leaves the bus, and the next client finds it closed.
#[cfg(unix)]
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_pty_whose_client_is_gone_leaves_the_bus() {
    use std::fs::File;
    use std::io::{BufRead, BufReader, Read, Write};
    use std::process::Stdio;

    let elf = common::elf();
    let mut server = Command::new(env!("CARGO_BIN_EXE_cantap-sim"))
        .args(["run", elf.to_str().unwrap(), "--pty", "--load", "5"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut name = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut name).unwrap();
    let open = || File::options().read(true).write(true).open(name.trim()).unwrap();
    // An slcan channel that receives and is never closed.
    let mut first = open();
    first.write_all(b"\rS6\rO\r").unwrap();
    let mut heard = Vec::new();
    while !heard.windows(2).any(|pair: &[u8]| pair == b"\rt" || pair == b"\rT") {
        let mut piece = [0; 64];
        let len = first.read(&mut piece).unwrap();
        heard.extend(&piece[..len]);
    }
    drop(first);
    // `S` is refused (BEL) on an open channel. What the first client left unread may come before the answers; `V`'s is the last. A port that
    // is opened again before the board saw it closed was never closed for it: then it is closed once more.
    let refuses = || {
        std::thread::sleep(Duration::from_millis(50));
        let mut client = open();
        client.write_all(b"S5\rV\r").unwrap();
        let mut answers = Vec::new();
        while !answers.windows(2).any(|pair: &[u8]| pair == b"V1") {
            let mut piece = [0; 64];
            let len = client.read(&mut piece).unwrap();
            answers.extend(&piece[..len]);
        }
        answers.contains(&0x07)
    };
    let tries = (0..200).take_while(|_| refuses()).count();
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(tries < 200, "the channel is still open");
}

/// Served on a pseudo-terminal, it is a serial port like any other.
#[cfg(unix)]
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_pty_is_announced_by_its_name_and_answers() {
    use std::fs::File;
    use std::io::{BufRead, BufReader, Read, Write};
    use std::process::Stdio;

    let elf = common::elf();
    let mut server = Command::new(env!("CARGO_BIN_EXE_cantap-sim"))
        .args(["run", elf.to_str().unwrap(), "--pty", "--seconds", "2", "--load", "0"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut name = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut name).unwrap();
    let mut port = File::options().read(true).write(true).open(name.trim()).unwrap();
    let mut session = Session::new();
    let (id, hello) = session.hello();
    port.write_all(&hello).unwrap();
    let mut piece = [0; 512];
    let response = loop {
        let len = port.read(&mut piece).unwrap();
        session.take(&piece[..len], |_| {});
        if let Some(response) = session.response(id) {
            break response;
        }
    };
    assert!(matches!(response.result, Ok(Reply::Hello(_))), "{response:?}");
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

/// Asked politely, by Ctrl-C or by the system, it ends as a device that is no longer needed, with or without a client.
#[cfg(unix)]
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_pty_ends_when_it_is_asked_to() {
    use std::fs::File;
    use std::io::{BufRead, BufReader};
    use std::process::Stdio;

    let elf = common::elf();
    for (signal, has_client) in [("-INT", false), ("-TERM", false), ("-TERM", true)] {
        let mut server = Command::new(env!("CARGO_BIN_EXE_cantap-sim"))
            .args(["run", elf.to_str().unwrap(), "--pty", "--load", "5"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut name = String::new();
        BufReader::new(server.stdout.take().unwrap()).read_line(&mut name).unwrap();
        let client = has_client.then(|| File::options().read(true).write(true).open(name.trim()).unwrap());
        let asked = Command::new("kill").args([signal, &server.id().to_string()]).status().unwrap();
        assert!(asked.success());
        assert_eq!(server.wait().unwrap().code(), Some(0), "{signal}");
        drop(client);
    }
}
