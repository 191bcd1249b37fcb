//! `cantap serve` on a UNIX socket and on TCP, and commands that use it.
#![cfg(unix)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use crate::adapters::{fd_rows, frames_of, pipe};
use crate::served::server::{Server, agree, cantap, capture, log, nothing_lost, run, said, socket};

#[test]
fn programs_share_a_device_each_with_all_of_its_frames() {
    let _turn = cantap_testing::process::turn();
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let mut server = Server::start(&format!("-d virtual:load=80 -b 500k --unix {path} --tcp 0"), 2);
    assert_eq!(server.at[0], format!("unix:{path}"));
    assert!(server.at[1].starts_with("tcp://127.0.0.1:"), "{:?}", server.at);
    assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    let files: Vec<PathBuf> = (0..3).map(|number| folder.path().join(format!("{number}.log"))).collect();
    // Without a bit rate it uses the server's.
    let captures: Vec<Child> = [(&server.at[0], "-b 500k"), (&server.at[0], ""), (&server.at[1], "")]
        .iter()
        .zip(&files)
        .map(|((at, rate), file)| capture(at, file, &format!("{rate} -t 1s")).spawn().unwrap())
        .collect();
    for capture in captures {
        nothing_lost(&capture.wait_with_output().unwrap());
    }
    agree(&log(&files[0]), &log(&files[1]));
    agree(&log(&files[0]), &log(&files[2]));
    // Every command accepts the address.
    let (code, out, err) = run(&format!("info -d {} --json", server.at[0]));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("VIRTUAL"), "{out}");
    let (code, out, err) = run(&format!("stats -d {} -t 500ms", server.at[1]));
    assert_eq!(code, Some(0), "{out}{err}");
    // What is not allowed is refused, with the remedy.
    let (code, _, err) = run(&format!("send -d {} 1 123#11", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("the right to send") && err.contains("--allow send"), "{err}");
    let (code, _, err) =
        run(&format!("capture -d {} -b 125k -n 1 -o /dev/null --format candump", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("another bit rate"), "{err}");
    assert!(server.interrupt().success());
    assert!(!Path::new(&path).exists());
    let (code, _, err) =
        run(&format!("capture -d {} -b 500k -n 1 -o /dev/null --format candump", server.at[0]));
    assert_eq!(code, Some(1));
    assert!(err.contains("there is no server; start one with `cantap serve`"), "{err}");
}

/// From another maker's adapter.
#[test]
fn fd_frames_reach_the_clients_of_a_server_with_its_filters() {
    let folder = tempfile::tempdir().unwrap();
    let (path, rows) = (socket(folder.path()), fd_rows());
    // The clients have as much time to come as they need.
    let (device, _done) = pipe("fd-serve", rows.clone());
    let server = Server::start(&format!("-d {device} -b 500k --unix {path}"), 1);
    let file = folder.path().join("fd.log");
    let output = capture(&server.at[0], &file, "-c 1 -n 13 -f 123:7FF,124:7FF,125:7FF,18DAF110:1FFFFFFF")
        .output()
        .unwrap();
    let (code, _, err) = said(&output);
    assert_eq!(code, Some(0), "{err}");
    let written = std::fs::read_to_string(&file).unwrap();
    let mut wanted = frames_of(&rows);
    wanted.retain(|frame| *frame != "7FF#11");
    assert_eq!(frames_of(&written), wanted, "{err}");
}

#[test]
fn who_may_send_sends_and_others_see_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=0 -b 500k --unix {path} --allow send"), 1);
    let at = &server.at[0];
    let file = folder.path().join("heard.log");
    let listener = capture(at, &file, "-t 3s").spawn().unwrap();
    std::thread::sleep(Duration::from_millis(800));
    let (code, out, err) = run(&format!("send -d {at} -b 500k 1 123#112233"));
    assert_eq!(code, Some(0), "{out}{err}");
    let (code, out, err) = run(&format!("gen -d {at} -b 500k -n 50 -g 2 can1"));
    assert_eq!(code, Some(0), "{out}{err}");
    let (code, out, err) = said(&listener.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    for (stage, lost) in summary["lost"].as_object().unwrap() {
        // Each channel left its bus once, to join it as a node that sends.
        assert!(
            if stage == "off_bus" { *lost == 2 } else { stage == "off_bus_us" || *lost == 0 },
            "{summary}"
        );
    }
    let heard = log(&file);
    assert_eq!(
        heard.iter().filter(|(_, frame)| frame.starts_with("can0 123#112233")).count(),
        1,
        "{heard:?}"
    );
    assert_eq!(heard.iter().filter(|(_, frame)| frame.starts_with("can1 ")).count(), 50);
}
/// Garbage, half-open peers and floods harm nobody, and receive nothing.
#[test]
fn strangers_on_the_port_hear_nothing_and_take_nobodys_place() {
    let mut server = Server::start("-d virtual:load=30 -b 500k --tcp 0", 1);
    let at = server.at[0].clone();
    let place = at.strip_prefix("tcp://").unwrap();
    let mut browser = TcpStream::connect(place).unwrap();
    browser.write_all(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n").unwrap();
    let flood: Vec<TcpStream> = (0..60).map(|_| TcpStream::connect(place).unwrap()).collect();
    browser.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let mut heard = Vec::new();
    // It is dropped without a byte: a peer that does not greet gets no answer.
    let closed = browser.read_to_end(&mut heard);
    assert!(closed.is_ok() && heard.is_empty(), "{closed:?} {heard:?}");
    drop(flood);
    for _ in 0..50 {
        drop(TcpStream::connect(place).unwrap());
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    nothing_lost(&capture(&at, file.path(), "--format candump --force -t 500ms").output().unwrap());
    assert!(server.interrupt().success());
}

#[test]
fn what_cannot_be_served_is_said_at_once() {
    for (arguments, code, part) in [
        ("serve -d virtual -b 500k --tcp 0.0.0.0", 2, "everybody on every network"),
        ("serve -d virtual -b 500k --tcp 192.0.2.1", 2, "everybody on the network"),
        ("serve -d virtual -b 500k --tcp here", 2, "write it as 127.0.0.1:29537"),
        ("serve -d virtual -b 3:500k", 2, "no channel 3"),
        ("serve -d virtual -b 500k --unix /nowhere/at/all", 1, "no socket can be made at '/nowhere/at/all'"),
        ("serve -d /dev/nothing -b 500k", 1, "there is no device at '/dev/nothing'"),
        ("serve -d virtual -d virtual --stdio", 2, "--stdio serves one device"),
        ("capture -d tcp://127.0.0.1:9 -b 500k", 1, "there is no server"),
        ("capture -d ssh://-oProxyCommand=x -b 500k", 2, "is not the name of a computer"),
    ] {
        let (exit, out, err) = run(arguments);
        assert_eq!(exit, Some(code), "{arguments}: {out}{err}");
        assert!(err.contains(part), "{arguments}: {err}");
    }
}

/// A path may name anything.
#[test]
fn what_is_no_abandoned_socket_stays() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes.txt");
    std::fs::write(&notes, "mine").unwrap();
    let (code, _, err) = run(&format!("serve -d virtual -b 500k --unix {}", notes.display()));
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("there is a file, which is left as it is; give another path with --unix"), "{err}");
    assert_eq!(std::fs::read_to_string(&notes).unwrap(), "mine");
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual -b 500k --unix {path}"), 1);
    let (code, _, err) = run(&format!("serve -d virtual -b 500k --unix {path}"));
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("another server is at"), "{err}");
    drop(server);
}

/// Other clients that come, send and go cost one gap, which the capture's own summary counts.
#[test]
fn a_change_of_mode_is_in_the_capture_s_summary_and_in_the_statistics() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let server = Server::start(&format!("-d virtual:load=30 -b 500k --unix {path} --allow send"), 1);
    let file = folder.path().join("all.log");
    let capture = capture(&server.at[0], &file, "-t 4s").spawn().unwrap();
    let started = Instant::now();
    while std::fs::metadata(&file).map_or(0, |file| file.len()) < 1000 {
        assert!(started.elapsed() < Duration::from_secs(20), "nothing is captured");
        std::thread::sleep(Duration::from_millis(20));
    }
    for _ in 0..3 {
        let (code, _, err) = run(&format!("send -d unix:{path} 1 7A1#11"));
        assert_eq!(code, Some(0), "{err}");
    }
    let (code, out, err) = said(&capture.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let summary: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(summary["lost"]["off_bus"], 1, "{summary}");
    assert!(summary["lost"]["off_bus_us"].as_u64() > Some(0), "{summary}");
    assert_eq!(summary["channels"][0]["lost_at_least"], true, "{summary}");
    assert_eq!(summary["channels"][1]["lost_at_least"], false, "{summary}");
    let (code, out, err) = run(&format!("stats {} -b 500k", file.display()));
    assert_eq!(code, Some(0), "{err}");
    assert!(out.lines().next().unwrap().contains(", an unknown number lost, "), "{out}");
}

/// The server's end is what clients are told, and commands say what was done until then. Programs with other protocols, which the end does not
/// concern, keep it from nobody.
#[test]
fn what_was_sent_until_the_server_ended_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let doors = "--socketcand 127.0.0.1:0 --lines 127.0.0.1:0 --gvret 127.0.0.1:0";
    let mut server =
        Server::start(&format!("-d virtual:load=0 -b 500k --unix {path} --allow send {doors}"), 4);
    let place = |way: &str| TcpStream::connect(way.rsplit(['/', ' ']).next().unwrap()).unwrap();
    let mut others: Vec<TcpStream> = server.at[1..].iter().map(|way| place(way)).collect();
    others[0].write_all(b"< open can0 >< rawmode >").unwrap();
    others[1].write_all(&[0xE7, 0xE7, 0xF1, 9]).unwrap();
    for other in &mut others[..2] {
        assert!(other.read(&mut [0; 16]).unwrap() > 0);
    }
    let sends = cantap(&format!("gen -d unix:{path} can0 -g 5 --json")).spawn().unwrap();
    let mut ears = capture(&server.at[0], &folder.path().join("x.log"), "-n 20").spawn().unwrap();
    assert!(ears.wait().unwrap().success());
    server.interrupt();
    let (code, out, err) = said(&sends.wait_with_output().unwrap());
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("its server has ended"), "{err}");
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert!(object["sent"].as_u64() >= Some(19), "{object}");
    assert!(object["reason"].as_str().unwrap().contains("its server has ended"), "{object}");
}

/// As systemd starts it: the socket is there before the server, and after it. Nobody else could listen at these addresses meanwhile.
#[test]
fn a_server_takes_the_listening_socket_that_it_is_started_with() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let listener = UnixListener::bind(&path).unwrap();
    for number in 0..2 {
        let mut command = cantap(&format!("serve -d virtual:load=30 -b 500k --unix {path}"));
        let input = OwnedFd::from(listener.try_clone().unwrap());
        let mut server = Server::of(command.stdin(input).stderr(Stdio::inherit()), 1);
        let file = folder.path().join(format!("{number}.log"));
        nothing_lost(&capture(&server.at[0], &file, "-t 500ms").output().unwrap());
        assert!(server.interrupt().success());
        assert!(Path::new(&path).exists());
    }
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let doors = format!("--unix {path}-2 --gvret {at}");
    let mut command = cantap(&format!("serve -d virtual:load=30 -b 500k {doors}"));
    let server = Server::of(command.stdin(OwnedFd::from(listener)).stderr(Stdio::inherit()), 2);
    assert_eq!(server.at[1], format!("gvret:tcp://{at}"));
    let (code, out, err) = run(&format!("capture -d gvret:tcp://{at} -b 500k -c 1 -n 20 -o {path}.log"));
    assert_eq!(code, Some(0), "{out}{err}");
}

/// A beacon at 127.0.0.1 stays on this computer.
#[test]
fn a_server_that_announces_itself_is_listed_and_can_be_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = socket(folder.path());
    let board = "virtual:load=20,serial=BENCH-7";
    let server = Server::start(&format!("-d {board} -b 500k --unix {path} --socketcand 127.0.0.1:0"), 2);
    let place = server.at[1].strip_prefix("can://").unwrap();
    let (code, out, err) = run("list --network --json");
    assert_eq!(code, Some(0), "{err}");
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    let servers = object["servers"].as_array().unwrap();
    let device = format!("socketcand://{place}/can0");
    let found = servers.iter().find(|server| server["devices"][0] == *device).expect(&out);
    assert!(found["name"].as_str().unwrap().starts_with("cantap BENCH-7"), "{found}");
    assert_eq!(found["from"], "127.0.0.1");
    let (code, out, err) = run(&format!("capture -d {device} -b 500k -n 5 -o {path}.log"));
    assert_eq!(code, Some(0), "{out}{err}");
    // Without it, nothing of the network is listed.
    let (code, out, _) = run("list --json");
    assert_eq!(
        (code, serde_json::from_str::<serde_json::Value>(&out).unwrap().get("servers")),
        (Some(0), None)
    );
}
