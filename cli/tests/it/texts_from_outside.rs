//! Texts that come from outside reach the terminal cleaned, whatever command shows them; and no print goes round the one place that cleans.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command as Program, Stdio};

use cantap::wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal, unseal};
use cantap::wire::message::{Defaults, Failures, write_response};
use cantap::wire::{BitTiming, Command, Hello, PROTOCOL_VERSION, Refusal, Reply, Request};

/// An escape sequence, C0, DEL, C1, and a change of the writing direction, in 20 bytes.
const HARMFUL: &str = "\x1b]0;P\x07\x7f\u{9b}31m\u{202e}x";

/// A server whose texts are not plain.
fn hostile_server() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = format!("tcp://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            std::thread::spawn(move || serve(stream));
        }
    });
    at
}

fn serve(mut stream: TcpStream) {
    let mut partial = Vec::new();
    let mut bytes = [0; 4096];
    let mut ticks = 0;
    while let Ok(len @ 1..) = stream.read(&mut bytes) {
        for byte in &bytes[..len] {
            if *byte != 0 {
                partial.push(*byte);
                continue;
            }
            let encoded = std::mem::take(&mut partial);
            let mut out = vec![0; MAX_ENCODED];
            let Ok(message) = unseal(&encoded, &mut out) else { continue };
            let Ok((Request { id, command }, _)) = postcard::take_from_bytes(message) else { continue };
            ticks += 1000;
            if stream.write_all(&answer(id, &command, ticks)).is_err() {
                return;
            }
        }
    }
}

fn answer(id: u16, command: &Command, ticks: u64) -> Vec<u8> {
    let result = match command {
        Command::Hello { .. } => Ok(Reply::Hello(Hello {
            protocol: PROTOCOL_VERSION,
            firmware: [0, 1, 0],
            board: HARMFUL.try_into().unwrap(),
            serial: HARMFUL.try_into().unwrap(),
            channels: 2,
            tick_hz: 12_000_000,
            can_clock_hz: 36_000_000,
            queue_bytes: 65_536,
            tx_queue: 64,
            periodic_slots: 16,
            trigger_slots: 16,
            filter_banks: 28,
            capabilities: 0x3F,
        })),
        Command::Time => Ok(Reply::Time(ticks)),
        Command::Failures => Ok(Reply::Failures(Failures { count: 3, last: HARMFUL.try_into().unwrap() })),
        Command::Defaults { .. } => {
            let timing = BitTiming::choose(36_000_000, 500_000, None).unwrap();
            let config = cantap::wire::message::ChannelConfig::listen_only(timing);
            Ok(Reply::Defaults(Defaults { config, filters: heapless::Vec::new() }))
        }
        _ => Err(Refusal::Unsupported),
    };
    let mut message = vec![0; MAX_MESSAGE + CRC_LEN];
    let mut out = vec![0; MAX_ENCODED];
    let len = write_response(id, &result, &mut message[..MAX_MESSAGE]).unwrap();
    let len = seal(&mut message, len, &mut out).unwrap();
    [&[0], &out[..len]].concat()
}

/// A server that refuses with a text that is not plain.
fn refusing_server() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = format!("tcp://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for mut stream in listener.incoming().map_while(Result::ok) {
            let _ = stream.write_all(format!("cantap: {HARMFUL}\r\nmore").as_bytes());
            let _ = stream.shutdown(std::net::Shutdown::Write);
            // Closed with something unread, the connection would be reset, and the text perhaps lost.
            std::thread::spawn(move || std::io::copy(&mut stream, &mut std::io::sink()));
        }
    });
    at
}

fn said(arguments: &str) -> String {
    let mut command = Program::new(env!("CARGO_BIN_EXE_cantap"));
    let output = command.args(arguments.split_whitespace()).stdin(Stdio::null()).output().unwrap();
    String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap()
}

#[test]
fn a_server_s_texts_move_no_cursor() {
    let (hostile, refusing) = (hostile_server(), refusing_server());
    let commands = [
        ("info", "board           ?]0;P???31m?x"),
        ("info --json", "?]0;P???31m?x"),
        ("status", ""),
        ("doctor -t 100ms", ""),
        ("selftest", ""),
        ("defaults", ""),
        ("capture -t 100ms -o /dev/null", ""),
        ("update firmware.bin", ""),
    ];
    for (command, shows) in commands {
        for at in [&hostile, &refusing] {
            let said = said(&format!("{command} -d {at}"));
            let harmful =
                said.chars().find(|shown| *shown != '\n' && cantap_trace::clean::is_harmful(*shown));
            assert_eq!(harmful, None, "{command}: {said:?}");
            assert!(!said.is_empty(), "{command}");
            if at == &hostile {
                assert!(said.contains(shows), "{command}: {said:?}");
            }
        }
    }
    let said = said(&format!("info -d {refusing}"));
    assert!(said.contains("its server refuses: "), "{said:?}");
}

/// Files of a folder, and of those in it.
fn sources(folder: &Path, all: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, all);
        } else if path.extension().is_some_and(|suffix| suffix == "rs") {
            all.push(path);
        }
    }
}

/// Standard error is written by one file, which cleans; no second function decides what is harmful; escapes are written where the terminal
/// is drawn.
#[test]
fn no_print_goes_round_the_place_that_cleans() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut files = Vec::new();
    for folder in ["cli/src", "host"] {
        sources(&root.join(folder), &mut files);
    }
    let rules: [(&str, &[&str]); 4] = [
        // The live view draws on standard output, and update asks a question there without foreign text.
        (
            "io::stderr()",
            &[
                "cli/src/stderr.rs",
                "cli/src/progress.rs",
                "cli/src/commands/autobaud.rs",
                "cli/src/commands/update.rs",
            ],
        ),
        ("std::eprint", &[]),
        (
            "\\x1b[",
            &[
                "cli/src/stderr.rs",
                "tui/src/",
                "host/trace/src/clean.rs",
                "cli/src/commands/stats/live.rs",
                "cli/src/commands/obd.rs",
                "host/analysis/src/plot/text.rs",
            ],
        ),
        // A folder's name, where more is harmful than on a terminal.
        ("is_control()", &["host/trace/src/clean.rs", "host/columns/src/parquet/dataset.rs"]),
    ];
    let mut found = Vec::new();
    for path in &files {
        let name = path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
        if name.contains("/tests/") || name.ends_with("tests.rs") || name.contains("/examples/") {
            continue;
        }
        let text = std::fs::read_to_string(path).unwrap();
        let text = text.split("#[cfg(test)]\nmod tests").next().unwrap();
        for (number, line) in
            text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"))
        {
            for (what, allowed) in rules {
                let is_allowed = allowed.iter().any(|allowed| name.starts_with(allowed));
                // Whether a terminal is there is asked anywhere.
                if line.contains(what) && !is_allowed && !line.contains("is_terminal") {
                    found.push(format!("{name}:{}: {}", number + 1, line.trim()));
                }
            }
        }
    }
    assert!(files.len() > 300, "{}", files.len());
    assert!(
        found.is_empty(),
        "these go round cantap_trace::clean or cli/src/stderr.rs:\n{}",
        found.join("\n")
    );
}
