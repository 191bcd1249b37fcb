//! The clients in `docs/clients`, written from `docs/wire-protocol.md` alone: they read the test vectors and work with the virtual
//! device.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; the C compiler is `cc`. If one is missing, it is named and its client passes,
//! unless `CANTAP_REQUIRE_PEERS=1`.
#![cfg(unix)]

use cantap_testing::peers;

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use cantap_virtual::open_terminal;
use serde_json::Value;

const CLIENTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/clients");
const VECTORS: &str = include_str!("../../../../wire/vectors.json");

/// A client that is ready to run.
struct Client {
    name: &'static str,
    command: Vec<String>,
    /// The folder of a compiled one.
    _directory: Option<tempfile::TempDir>,
}

fn python() -> Option<Client> {
    let python = peers::python_with("os")?;
    let command = vec![python, "-u".to_owned(), format!("{CLIENTS}/cantap_client.py")];
    Some(Client { name: "Python", command, _directory: None })
}

fn c() -> Option<Client> {
    if !peers::has(Command::new("cc").arg("--version"), "cc") {
        return None;
    }
    let directory = tempfile::tempdir().unwrap();
    let program = directory.path().join("cantap_client").display().to_string();
    let source = format!("{CLIENTS}/cantap_client.c");
    let options = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-o"];
    let compiled = Command::new("cc").args(options).args([&program, &source]).output().unwrap();
    assert!(compiled.status.success(), "{}", String::from_utf8_lossy(&compiled.stderr));
    Some(Client { name: "C", command: vec![program], _directory: Some(directory) })
}

fn clients() -> impl Iterator<Item = Client> {
    python().into_iter().chain(c())
}

impl Client {
    fn start(&self, arguments: &[&str]) -> Child {
        let mut command = Command::new(&self.command[0]);
        command.args(&self.command[1..]).args(arguments).env("PYTHONDONTWRITEBYTECODE", "1");
        command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }

    /// Everything that it prints, and whether it succeeded.
    fn run(&self, arguments: &[&str]) -> (Vec<String>, bool) {
        let output = self.start(arguments).wait_with_output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        eprint!("{}", String::from_utf8_lossy(&output.stderr));
        (said.lines().map(str::to_owned).collect(), output.status.success())
    }

    fn decode(&self, bytes: &[u8], directory: &Path) -> Vec<String> {
        let file = directory.join("stream");
        std::fs::write(&file, bytes).unwrap();
        let (lines, good) = self.run(&["--decode", file.to_str().unwrap()]);
        assert!(good, "{}", self.name);
        lines
    }
}

fn bytes(hex: &Value) -> Vec<u8> {
    let hex = hex.as_str().unwrap();
    hex.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

/// The number after a word in the last line.
fn told(lines: &[String], word: &str) -> u64 {
    let mut words = lines.last().map_or("", String::as_str).split(' ');
    words.find(|found| *found == word).unwrap_or_else(|| panic!("no {word:?} in {:?}", lines.last()));
    words.next().unwrap().parse().unwrap()
}

#[test]
fn both_read_what_the_vectors_say() {
    let vectors: Value = serde_json::from_str(VECTORS).unwrap();
    let directory = tempfile::tempdir().unwrap();
    for client in clients() {
        for part in ["batches", "responses"] {
            let vectors = vectors[part].as_array().unwrap();
            let stream: Vec<u8> = vectors.iter().flat_map(|vector| bytes(&vector["wire"])).collect();
            let reads = vectors.iter().flat_map(|vector| vector["reads"].as_array().unwrap());
            let reads: Vec<&str> = reads.filter_map(Value::as_str).collect();
            assert_eq!(client.decode(&stream, directory.path()), reads, "{} {part}", client.name);
        }
        for vector in vectors["framing"].as_array().unwrap() {
            let damaged = client.decode(&bytes(&vector["wire"]), directory.path()) == ["damaged"];
            assert_eq!(damaged, vector["message"].is_null(), "{} {vector}", client.name);
        }
    }
}

#[test]
fn both_capture_send_and_balance_their_books() {
    for client in clients() {
        let terminal = open_terminal("load=30,bitrate=500k".parse().unwrap()).unwrap();
        let (lines, good) = client.run(&[terminal.path(), "500000", "1.5"]);
        assert!(good, "{}: {:?}", client.name, lines.last());
        // Records may come before it: they are printed as they arrive.
        let board = lines.iter().find(|line| line.starts_with("board virtual serial VIRTUAL channels 2"));
        assert!(board.is_some(), "{}: {:?}", client.name, lines.first());
        let sent = lines.iter().filter(|line| line.ends_with(" can1 sent tag 7 123 2 1122")).count();
        assert_eq!(sent, 1, "{}", client.name);
        assert!(lines.iter().any(|line| line.contains(" sof ")), "{}", client.name);
        assert!(told(&lines, "frames") > 500 && told(&lines, "lost") == 0, "{:?}", lines.last());
    }
}

/// A client that stops reading while the bus is full loses frames, and knows how many.
#[test]
fn both_count_what_a_stalled_host_loses() {
    let _turn = cantap_testing::process::turn();
    for client in clients() {
        let terminal = open_terminal("load=100,frames=std0,bitrate=1M".parse().unwrap()).unwrap();
        let mut child = client.start(&[terminal.path(), "1000000", "6"]);
        let mut output = BufReader::new(child.stdout.take().unwrap());
        let mut text = String::new();
        while !text.contains("can1 started") {
            assert!(output.read_line(&mut text).unwrap() > 0, "{}: {text}", client.name);
        }
        // Nobody reads what it prints, so it blocks: no signal is needed.
        std::thread::sleep(std::time::Duration::from_secs(4));
        output.read_to_string(&mut text).unwrap();
        let lines: Vec<String> = text.lines().map(str::to_owned).collect();
        assert!(child.wait().unwrap().success(), "{}: {:?}", client.name, lines.last());
        let lost: u64 = told(&lines, "lost");
        assert!(lost > 10_000, "{}: {:?}", client.name, lines.last());
        assert!(lines.iter().any(|line| line.contains(" can1 lost ")), "{}", client.name);
    }
}
