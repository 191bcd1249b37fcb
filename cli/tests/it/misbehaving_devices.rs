//! Commands and a device that misbehaves at the other end of a real terminal: they report it, continue, and end
//! properly.
#![cfg(unix)]

use crate::fake_device;
use crate::port;

use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap::{TraceEvent, TraceRecord};
use cantap_formats::{ReadOptions, open_reader};
use fake_device::{FakeDevice, Fault, Log};
use port::Port;
use portable_pty::{PtySize, native_pty_system};

/// Longer than anything here takes, however busy the machine.
const PATIENCE: Duration = Duration::from_mins(1);
/// Number of frames on a channel before a device misbehaves.
const BEFORE: u32 = 100;

/// What a program writes into a terminal; nothing once it has closed it.
struct Input {
    pieces: Receiver<Vec<u8>>,
    rest: Vec<u8>,
}

impl Read for Input {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.rest.is_empty() {
            match self.pieces.recv_timeout(Duration::from_millis(20)) {
                Ok(piece) => self.rest = piece,
                Err(RecvTimeoutError::Timeout) => return Err(ErrorKind::TimedOut.into()),
                Err(RecvTimeoutError::Disconnected) => return Ok(0),
            }
        }
        let len = self.rest.len().min(out.len());
        out[..len].copy_from_slice(&self.rest[..len]);
        self.rest.drain(..len);
        Ok(len)
    }
}

/// A device behind a terminal, with a fault in each session, and without any after the last. Returns the terminal's
/// name.
fn device(faults: &[Fault]) -> (String, Arc<Mutex<Log>>) {
    let pair = native_pty_system().openpty(PtySize::default()).unwrap();
    let name = pair.master.tty_name().unwrap().to_str().unwrap().to_owned();
    drop(pair.slave);
    let mut terminal = pair.master.try_clone_reader().unwrap();
    let writer = pair.master.take_writer().unwrap();
    let (pieces, received) = channel();
    std::thread::spawn(move || {
        let mut is_open = false;
        let mut bytes = [0; 4096];
        loop {
            let piece = match terminal.read(&mut bytes) {
                Ok(len) if len > 0 => bytes[..len].to_vec(),
                _ if std::mem::take(&mut is_open) => Vec::new(),
                _ => {
                    std::thread::sleep(Duration::from_millis(2));
                    continue;
                }
            };
            is_open = !piece.is_empty();
            if pieces.send(piece).is_err() {
                return;
            }
        }
    });
    let log = Arc::default();
    let mut fake = FakeDevice::over(Input { pieces: received, rest: Vec::new() }, writer).log_to(&log);
    let faults = faults.to_vec();
    std::thread::spawn(move || {
        let _terminal = pair.master;
        for fault in faults.into_iter().chain(std::iter::repeat(Fault::None)) {
            fake.run(fault, BEFORE);
        }
    });
    (name, log)
}

/// A running command, whose messages are read as they arrive.
struct Running {
    child: Child,
    lines: Receiver<String>,
    said: Vec<String>,
}

impl Running {
    fn start(arguments: &str) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_cantap"))
            .args(arguments.split_whitespace())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let messages = BufReader::new(child.stderr.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            for line in messages.lines().map_while(Result::ok) {
                let _ = sender.send(line);
            }
        });
        Self { child, lines, said: Vec::new() }
    }

    fn wait_for(&mut self, words: &str) -> String {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let Ok(line) = self.lines.recv_timeout(left) else {
                panic!("never said: {words}: {:#?}", self.said)
            };
            self.said.push(line.clone());
            if line.contains(words) {
                return line;
            }
        }
    }

    /// Like `timeout`: the child, then its process group.
    fn signal_twice(&self) {
        let pid = self.child.id();
        let script = format!("kill -TERM {pid}; kill -TERM {pid}");
        assert!(Command::new("sh").args(["-c", &script]).status().unwrap().success());
    }

    /// The exit code, its output, and its messages since then.
    fn end(mut self) -> (Option<i32>, String, Vec<String>) {
        let mut out = self.child.stdout.take().unwrap();
        let printing = std::thread::spawn(move || {
            let mut text = String::new();
            out.read_to_string(&mut text).unwrap();
            text
        });
        let deadline = Instant::now() + PATIENCE;
        let status = loop {
            if let Some(status) = self.child.try_wait().unwrap() {
                break status;
            }
            assert!(Instant::now() < deadline, "it does not end: {:#?}", self.said);
            std::thread::sleep(Duration::from_millis(20));
        };
        self.said.extend(self.lines.iter());
        (status.code(), printing.join().unwrap(), std::mem::take(&mut self.said))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn records(path: &Path) -> Vec<TraceRecord> {
    open_reader(path, &ReadOptions::default()).unwrap().map(Result::unwrap).collect()
}

fn frames_of(records: &[TraceRecord]) -> usize {
    records.iter().filter(|record| record.frame().is_some()).count()
}

fn gaps_of(records: &[TraceRecord]) -> Vec<u8> {
    let gaps = records.iter().filter(|record| record.event == TraceEvent::GAP);
    gaps.map(|record| record.channel).collect()
}

/// Waits until a file does not grow beyond this many frames.
fn wait_for_frames(path: &Path, count: usize) {
    let deadline = Instant::now() + PATIENCE;
    while !path.exists() || frames_of(&records(path)) < count {
        assert!(Instant::now() < deadline, "{count} frames never came");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Number of frames on all channels, as in the summary.
fn frames_told(said: &[String]) -> usize {
    let frames = |line: &String| {
        line.strip_prefix("channel ")?.split_once(": ")?.1.split_once(" frames")?.0.parse::<usize>().ok()
    };
    said.iter().filter_map(frames).sum()
}

#[test]
fn a_capture_goes_on_when_a_device_that_fell_silent_answers_again() {
    for (fault, words) in [
        (Fault::Deaf, "has answered nothing for"),
        (Fault::SessionLost, "this computer slept, or the device was restarted"),
        (Fault::Suspended, "this computer put the device to sleep"),
    ] {
        let (port, log) = device(&[fault]);
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("trace.asc");
        let mut capture =
            Running::start(&format!("capture -d {port} -b 500k --mode normal -o {}", file.display()));
        let gone = capture.wait_for(words);
        assert!(gone.contains("it continues when the device is back; Ctrl-C ends it"), "{gone}");
        capture.wait_for("the device is back after ");
        wait_for_frames(&file, 3 * BEFORE as usize);
        capture.signal_twice();
        let (code, _, said) = capture.end();
        assert_eq!(code, Some(0), "{said:#?}");
        assert!(said.iter().any(|line| line.starts_with("gaps: 1, ")), "{said:#?}");
        let records = records(&file);
        assert_eq!((frames_of(&records), gaps_of(&records)), (frames_told(&said), vec![1, 2]));
        // As requested, both times.
        let opened = log.lock().unwrap().opened.clone();
        assert_eq!((opened.len(), &opened[..2]), (4, &opened[2..]));
    }
}

#[test]
fn a_capture_goes_on_when_the_cable_is_plugged_in_again() {
    let mut port = Port::new();
    port.plug("load=20,frames=std8,serial=ONE");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("trace.blf");
    let arguments = format!("capture -d {} -b 500k -o {} --json", port.name(), file.display());
    let mut capture = Running::start(&arguments);
    std::thread::sleep(Duration::from_millis(500));
    port.unplug();
    capture.wait_for("vanished");
    port.plug("load=20,frames=std8,serial=ONE");
    capture.wait_for("the device is back after ");
    port.unplug();
    capture.wait_for("vanished");
    port.plug("load=20,frames=std8,serial=TWO");
    capture.wait_for("another board is there now, virtual TWO");
    std::thread::sleep(Duration::from_millis(500));
    capture.signal_twice();
    let (code, out, said) = capture.end();
    assert_eq!(code, Some(0), "{said:#?}");
    let object: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(object["gaps"]["count"], 2);
    let records = records(&file);
    assert_eq!(gaps_of(&records), [1, 2, 1, 2]);
    let frames: u64 =
        object["channels"].as_array().unwrap().iter().map(|c| c["frames"].as_u64().unwrap()).sum();
    assert_eq!(frames_of(&records) as u64, frames);
    // The load covers only the time in which the device was there.
    let load = object["channels"][0]["bus_load_pct"].as_f64().unwrap();
    assert!((load - 20.0).abs() < 2.0, "{out}");
}

#[test]
fn statistics_and_searches_go_on_too() {
    for command in ["stats -d PORT -b 500k", "search -d PORT -b 500k --id 123"] {
        let (port, _) = device(&[Fault::SessionLost]);
        let mut running = Running::start(&command.replace("PORT", &port));
        running.wait_for("the session with the device");
        running.wait_for("the device is back after ");
        std::thread::sleep(Duration::from_millis(500));
        running.signal_twice();
        let (code, out, said) = running.end();
        assert_eq!(code, Some(0), "{command}: {said:#?}");
        assert!(!out.is_empty(), "{command}");
    }
}

#[test]
fn what_is_sent_ends_with_the_reason_and_does_not_begin_again() {
    let (port, log) = device(&[Fault::Suspended]);
    let mut sending = Running::start(&format!("send -d {port} -b 500k can0 123#00 --period 10ms"));
    sending.wait_for("this computer put the device to sleep");
    let (code, _, said) = sending.end();
    assert_eq!(code, Some(1), "{said:#?}");
    let log = log.lock().unwrap();
    assert_eq!((log.opened.len(), log.sent), (1, 1));
}

/// What speaks does not wait for a device that comes back: what it asked is long forgotten then.
#[test]
fn commands_that_speak_end_with_the_reason() {
    for (fault, words) in [
        (Fault::Suspended, "this computer put the device to sleep"),
        (Fault::SessionLost, "session"),
        (Fault::Deaf, "has answered nothing for"),
    ] {
        let lines = [
            "canopen monitor",
            "canopen scan --listen 50s",
            "canopen sync --period 10ms",
            "j1939 request 65260",
        ];
        let running: Vec<_> = lines
            .map(|line| {
                let (port, log) = device(&[fault]);
                (line, Running::start(&format!("{line} -d {port} -b 500k")), log)
            })
            .into_iter()
            .collect();
        for (line, running, log) in running {
            let (code, _, said) = running.end();
            let said = said.join("\n");
            // A fake device never confirms a frame, which may be noticed first.
            assert_eq!(code, Some(1), "{fault:?}, {line}: {said}");
            let is_stuck = line.starts_with("j1939") && said.contains("were not sent");
            assert!(said.contains(words) || is_stuck, "{fault:?}, {line}: {said}");
            assert_eq!(log.lock().unwrap().opened.len(), 1, "{fault:?}, {line}");
        }
    }
}

#[test]
fn a_capture_ends_whole_whatever_the_device_keeps_back() {
    let folder = tempfile::tempdir().unwrap();
    for (fault, expected) in [(Fault::NeverStops, 0), (Fault::Deaf, 1), (Fault::Mute, 1)] {
        let (port, _) = device(&[fault]);
        let file = folder.path().join(format!("{fault:?}.log"));
        let capture = Running::start(&format!("capture -d {port} -b 500k -o {}", file.display()));
        wait_for_frames(&file, 2 * BEFORE as usize - 80);
        std::thread::sleep(Duration::from_millis(300));
        capture.signal_twice();
        let (code, _, said) = capture.end();
        assert_eq!(code, Some(expected), "{fault:?}: {said:#?}");
        assert_eq!(frames_of(&records(&file)), frames_told(&said), "{fault:?}: {said:#?}");
        let told = said.iter().any(|line| line.contains("frames may be missing at its end"));
        assert_eq!(told, expected == 1, "{fault:?}: {said:#?}");
    }
}
