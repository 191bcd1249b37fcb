//! `cantap extcap` as Wireshark calls it: manually with its pipes, and by tshark if it is installed (required with
//! `CANTAP_REQUIRE_PEERS=1`).
#![cfg(unix)]

use crate::firmware;
use crate::port;
use cantap_testing::peers;

use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use cantap::{Direction, TraceEvent, TraceRecord};
use cantap_formats::{ReadOptions, open_reader};
use port::Port;
use rustix::process::{Pid, Signal, kill_process};

const CANTAP: &str = env!("CARGO_BIN_EXE_cantap");
const PATIENCE: Duration = Duration::from_mins(1);

fn cantap<'a>(arguments: impl IntoIterator<Item = &'a str>) -> Command {
    let mut command = Command::new(CANTAP);
    command.env("XDG_CACHE_HOME", "/dev/null");
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn said(output: &Output) -> (Option<i32>, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout), text(&output.stderr))
}

fn run(line: &str) -> (Option<i32>, String, String) {
    said(&cantap(line.split_whitespace()).output().unwrap())
}

/// Waits until a condition holds.
fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "{what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn end(child: Child, signal: Signal) -> (Option<i32>, String, String) {
    kill_process(Pid::from_child(&child), signal).unwrap();
    said(&child.wait_with_output().unwrap())
}

/// The records of a whole file.
fn records(path: &Path) -> Vec<TraceRecord> {
    open_reader(path, &ReadOptions::default()).unwrap().collect::<Result<_, _>>().unwrap()
}

fn is_loss(record: &TraceRecord) -> bool {
    matches!(record.event, TraceEvent::Lost { .. })
}

/// Times of a channel's frames in nanoseconds.
fn times(records: &[TraceRecord], channel: u8) -> Vec<i64> {
    let of = records.iter().filter(|record| record.channel == channel && record.frame().is_some());
    of.map(|record| record.time_ns).collect()
}

#[test]
fn wireshark_learns_of_interfaces_link_type_options_and_toolbar() {
    let (code, out, err) = run("--extcap-interfaces --extcap-version=4.0");
    assert_eq!(code, Some(0), "{err}");
    for line in [
        "interface {value=cantap-virtual}{display=cantap, a CAN analyser without a board}",
        "interface {value=cantap-address}{display=cantap, a shared or remote CAN analyser}",
        "control {number=5}{type=button}{role=logger}{display=Log}",
        "value {control=2}{value=normal}{display=take part}",
    ] {
        assert!(out.lines().any(|have| have.starts_with(line)), "{line}: {out}");
    }
    let (code, out, err) = run("--extcap-interface cantap-virtual --extcap-dlts");
    assert_eq!(
        (code, &*out, &*err),
        (Some(0), "dlt {number=227}{name=CAN_SOCKETCAN}{display=SocketCAN}\n", "")
    );
    let (_, of_address, _) = run("--extcap-config --extcap-interface cantap-address");
    let (_, of_virtual, _) = run("--extcap-config --extcap-interface=cantap-virtual");
    assert!(of_address.contains("call=--device") && !of_virtual.contains("call=--device"), "{of_address}");
    assert!(
        of_virtual.contains("{call=--mode}") && of_virtual.contains("{value=listen-only}"),
        "{of_virtual}"
    );
    assert_eq!(run("--extcap-interface cantap-virtual --extcap-cleanup-postkill").0, Some(0));
    assert_eq!(
        run("extcap --extcap-interface cantap-virtual --extcap-capture-filter can0,123:7FF").0,
        Some(0)
    );
}

#[test]
fn what_cannot_be_done_says_what_can() {
    for (line, code, says) in [
        ("extcap", 2, "cantap extcap install"),
        ("--extcap-interface cantap-3A --extcap-config", 1, "'cantap-3A' is not connected"),
        ("--extcap-interface cantap-virtual", 2, "--capture --fifo PIPE"),
        ("--extcap-interface cantap-virtual --extcap-capture-filter tcp", 2, "'tcp' is not a filter"),
        ("--capture --extcap-interface cantap-virtual", 2, "--fifo"),
        ("--capture --extcap-interface cantap-virtual --fifo x --bitrate1 fast", 2, "auto"),
        ("--capture --extcap-interface cantap-virtual --fifo /nowhere/x", 1, "Wireshark makes this pipe"),
    ] {
        let (found, _, err) = run(line);
        assert!(found == Some(code) && err.contains(says), "{line}: {found:?} {err}");
    }
}

/// A folder with pipes, as Wireshark makes them.
struct Pipes(tempfile::TempDir);

impl Pipes {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let names = ["capture", "in", "out"].map(|name| folder.path().join(name));
        assert!(Command::new("mkfifo").args(names).status().unwrap().success());
        Self(folder)
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    fn capture(&self, rest: &str) -> Child {
        let line =
            format!("--capture --extcap-interface cantap-address --fifo {} {rest}", self.path("capture"));
        cantap(line.split_whitespace()).spawn().unwrap()
    }

    /// What comes through a pipe, as it arrives.
    fn read(&self, name: &str) -> Receiver<Vec<u8>> {
        let (sender, received) = channel();
        let path = self.path(name);
        std::thread::spawn(move || {
            let mut pipe = File::open(path).unwrap();
            let mut bytes = vec![0; 64 * 1024];
            while let Ok(count @ 1..) = pipe.read(&mut bytes) {
                if sender.send(bytes[..count].to_vec()).is_err() {
                    return;
                }
            }
        });
        received
    }
}

/// Appends what has arrived to a file that others read.
fn keep(received: &Receiver<Vec<u8>>, bytes: &mut Vec<u8>) {
    bytes.extend(received.try_iter().flatten());
}

#[test]
fn a_quiet_bus_shows_its_interfaces_at_once_and_a_closed_pipe_ends_the_capture() {
    let pipes = Pipes::new();
    let child = pipes.capture("--device virtual:load=0 --bitrate1 250k --bitrate2 125k");
    let mut pipe = File::open(pipes.path("capture")).unwrap();
    let mut head = [0; 300];
    pipe.read_exact(&mut head).unwrap();
    let text = String::from_utf8_lossy(&head);
    for part in [
        "channel 1 of virtual:load=0, 250000 bit/s, listening only",
        "channel 2 of virtual:load=0, 125000 bit/s",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    drop(pipe);
    let (code, out, err) = said(&child.wait_with_output().unwrap());
    assert_eq!((code, &*out, &*err), (Some(0), "", ""));
}

#[test]
fn the_polite_end_leaves_a_whole_file_and_a_silent_board() {
    let mut port = Port::new();
    port.plug("load=30,bitrate=250k");
    let pipes = Pipes::new();
    let received = pipes.read("capture");
    let child = pipes.capture(&format!("--device {} --bitrate2 off --mode normal", port.name()));
    let mut bytes = Vec::new();
    until("some packets", || {
        keep(&received, &mut bytes);
        bytes.len() > 30_000
    });
    let (code, out, err) = end(child, Signal::TERM);
    assert_eq!((code, &*out, &*err), (Some(0), "", ""));
    bytes.extend(received.iter().flatten());
    let file = pipes.0.path().join("all.pcapng");
    std::fs::write(&file, &bytes).unwrap();
    // Nothing is saved on the device: the bit rate was found by listening.
    let described = format!("channel 1 of {}, 250000 bit/s, taking part", port.name());
    assert!(String::from_utf8_lossy(&bytes[..400]).contains(&described));
    let all = records(&file);
    assert!(
        times(&all, 1).len() > 300 && times(&all, 2).is_empty() && !all.iter().any(is_loss),
        "{}",
        all.len()
    );
    let (code, out, err) = run(&format!("status -d {} --json", port.name()));
    assert_eq!(code, Some(0), "{err}");
    let status: serde_json::Value = serde_json::from_str(&out).unwrap();
    for channel in status["channels"].as_array().unwrap() {
        assert_eq!(channel["open"], false, "{status}");
    }
}

/// A tshark left waiting for a pipe would wait for ever.
#[test]
fn what_goes_wrong_closes_the_pipe_and_is_said() {
    for (device, says) in [
        ("unix:/nowhere/cantap.sock", "start one with `cantap serve`"),
        ("/dev/nowhere", "cantap list"),
        ("virtual:bitrate=250k --bitrate1 off --bitrate2 off", "both channels are off"),
    ] {
        let pipes = Pipes::new();
        let received = pipes.read("capture");
        let child = pipes.capture(&format!("--device {device}"));
        assert_eq!(received.iter().count(), 0, "{device}");
        let (code, _, err) = said(&child.wait_with_output().unwrap());
        assert!(
            code == Some(1) && err.contains(says) && err.lines().count() == 1,
            "{device}: {code:?} {err}"
        );
    }
}

/// A message of the toolbar, to Wireshark or from it.
fn message(control: u8, command: u8, payload: &str) -> Vec<u8> {
    let length = (payload.len() as u32 + 2).to_be_bytes();
    [&b"T"[..], &length[1..], &[control, command], payload.as_bytes()].concat()
}

#[test]
fn the_toolbar_shows_the_load_and_changes_bit_rate_and_mode_of_a_running_capture() {
    let pipes = Pipes::new();
    let (received, shown) = (pipes.read("capture"), pipes.read("out"));
    let child = pipes.capture(&format!(
        "--device virtual:load=40 --bitrate1 500k --bitrate2 95238 --extcap-control-in {} --extcap-control-out {}",
        pipes.path("in"),
        pipes.path("out")
    ));
    let mut toolbar = OpenOptions::new().write(true).open(pipes.path("in")).unwrap();
    // Nobody has requested in this capture what was there before.
    toolbar.write_all(&message(2, 1, "normal")).unwrap();
    toolbar.write_all(&message(255, 0, "")).unwrap();
    let (mut bytes, mut seen) = (Vec::new(), Vec::new());
    let has = |seen: &[u8], message: &[u8]| seen.windows(message.len()).any(|part| part == message);
    let mut wait = |what: &[u8], bytes: &mut Vec<u8>| {
        until(&String::from_utf8_lossy(what), || {
            keep(&received, bytes);
            keep(&shown, &mut seen);
            has(&seen, what)
        });
        assert!(!has(&seen, b"acknowledge"));
        String::from_utf8_lossy(&seen).into_owned()
    };
    // A rate that is not in the list is added.
    wait(&message(1, 2, "95238\x0095238 bit/s"), &mut bytes);
    wait(&message(1, 1, "95238"), &mut bytes);
    wait(&message(0, 1, "500k"), &mut bytes);
    wait(&message(2, 1, "listen-only"), &mut bytes);
    wait(&message(4, 1, "1: 0  2: 0"), &mut bytes);
    let text = wait(&[&message(3, 1, "1: 00 %  2: 00 %")[..6], b"1: "].concat(), &mut bytes);
    assert!(!text.contains("taking part"), "{text}");
    toolbar.write_all(&message(1, 1, "250k")).unwrap();
    wait(b"channel 2: from here on 250000 bit/s, listening only", &mut bytes);
    toolbar.write_all(&message(2, 1, "normal")).unwrap();
    wait(b"channel 1: from here on 500000 bit/s, taking part", &mut bytes);
    wait(b"channel 2: from here on 250000 bit/s, taking part", &mut bytes);
    wait(&message(2, 1, "normal"), &mut bytes);
    let before = bytes.len();
    until("packets after the change", || {
        keep(&received, &mut bytes);
        bytes.len() > before + 30_000
    });
    let (code, out, err) = end(child, Signal::TERM);
    assert_eq!((code, &*out, &*err), (Some(0), "", ""));
    bytes.extend(received.iter().flatten());
    // The trace also says so, on the first packet to which it applies.
    for remark in ["from here on 250000 bit/s, listening only", "from here on 500000 bit/s, taking part"] {
        assert!(has(&bytes, remark.as_bytes()), "{remark}");
    }
}

/// tshark with its own home, in which `cantap extcap install` put the command; `None` after reporting that it is missing.
struct Tshark(tempfile::TempDir);

impl Tshark {
    fn install() -> Option<Self> {
        let tshark = Self(tempfile::tempdir().unwrap());
        if !peers::has(tshark.command("tshark").arg("--version"), "tshark") {
            return None;
        }
        let (code, out, err) = said(&tshark.command(CANTAP).args(["extcap", "install"]).output().unwrap());
        assert_eq!(code, Some(0), "{err}");
        assert!(Path::new(out.trim()).starts_with(tshark.0.path()), "{out}");
        assert!(err.contains("tshark shows the interfaces"), "{err}");
        Some(tshark)
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(program);
        command.env("HOME", self.0.path()).env_remove("XDG_CONFIG_HOME").env_remove("WIRESHARK_EXTCAP_DIR");
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    fn file(&self) -> PathBuf {
        self.0.path().join("live.pcapng")
    }

    /// A capture at an address.
    fn capture(&self, device: &str, rest: &[&str]) -> Child {
        let device = format!("extcap.cantap_address.device:{device}");
        let mut command = self.command("tshark");
        command
            .args(["-i", "cantap-address", "-o", &device, "-w"])
            .arg(self.file())
            .args(rest)
            .spawn()
            .unwrap()
    }

    fn grows_to(&self, bytes: u64) {
        until("tshark writes packets", || self.file().metadata().is_ok_and(|file| file.len() > bytes));
    }

    /// tshark's output for the packets that pass a filter.
    fn fields(&self, filter: &str, fields: &[&str]) -> Vec<String> {
        let mut command = self.command("tshark");
        command.arg("-r").arg(self.file()).args(["-Y", filter, "-T", "fields", "-E", "separator=|"]);
        command.args(fields.iter().flat_map(|field| ["-e", field]));
        let (code, out, err) = said(&command.output().unwrap());
        assert_eq!(code, Some(0), "{err}");
        out.lines().map(str::to_owned).collect()
    }

    /// Checks that nothing of ours is still running.
    fn leaves_nothing_behind(&self) {
        let folder = self.0.path().to_str().unwrap().as_bytes().to_vec();
        until("the capture has ended", || {
            let processes = std::fs::read_dir("/proc").unwrap().filter_map(Result::ok);
            let lines = processes.filter_map(|process| std::fs::read(process.path().join("cmdline")).ok());
            let mut of_ours = lines.filter(|line| line.windows(folder.len()).any(|part| part == folder));
            of_ours.next().is_none()
        });
    }
}

const AT_1M: [&str; 4] =
    ["-o", "extcap.cantap_address.bitrate1:1M", "-o", "extcap.cantap_address.bitrate2:1M"];

/// Frames without data follow each other every 48 µs: if one were missing, the next would be late.
#[test]
fn tshark_captures_two_saturated_channels_and_nothing_is_dropped_in_between() {
    let _turn = cantap_testing::process::turn();
    let Some(tshark) = Tshark::install() else { return };
    let child = tshark.capture("virtual:load=100,frames=std0", &[&AT_1M[..], &["-a", "duration:2"]].concat());
    let (code, _, err) = said(&child.wait_with_output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    assert!(!err.contains("Error") && !err.contains("dropped"), "{err}");
    tshark.leaves_nothing_behind();
    let all = records(&tshark.file());
    assert!(err.contains(&format!("{} packets captured", all.len())), "{} {err}", all.len());
    for channel in [1, 2] {
        let times = times(&all, channel);
        let span_ns = times[times.len() - 1] - times[0];
        assert!(times.len() > 30_000, "{}", times.len());
        // The device's clock is compared with this computer's on the way, and the result is worse on a busy
        // computer.
        let frames = span_ns as f64 / 48_000.0;
        let off = frames / (times.len() - 1) as f64 - 1.0;
        assert!(off.abs() < 0.001, "channel {channel}: {frames} of {}", times.len());
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] < 90_000), "channel {channel}");
    }
    assert!(!all.iter().any(is_loss));
}

/// dumpcap discards what it has no room for when it captures from several interfaces, which depends on what else the computer does. It
/// counts that, and nothing else may be missing. On a busy computer it has been seen to abort at its start, with several interfaces only: then once more.
#[test]
fn tshark_captures_two_devices_at_once_and_only_what_it_counts_is_missing() {
    let _turn = cantap_testing::process::turn();
    let Some(tshark) = Tshark::install() else { return };
    let second: Vec<&str> =
        ["-i", "cantap-virtual", "-o", "extcap.cantap_virtual.bitrate1:1M", "-a", "duration:3"].to_vec();
    let capture = || {
        let child = tshark.capture("virtual:load=100,frames=std0", &[&AT_1M[..], &second].concat());
        let (code, _, err) = said(&child.wait_with_output().unwrap());
        tshark.leaves_nothing_behind();
        (code, err)
    };
    let (mut code, mut err) = capture();
    if err.contains("Child dumpcap process died: Abort") {
        (code, err) = capture();
    }
    assert_eq!(code, Some(0), "{err}");
    let numbers = |what: &str| {
        let lines = err.lines().filter(|line| line.contains(what));
        lines.filter_map(|line| line.split(' ').next()?.parse::<usize>().ok()).sum::<usize>()
    };
    let (captured, dropped) = (numbers("packets captured"), numbers("dropped"));
    let all = records(&tshark.file());
    assert_eq!(all.len(), captured, "{err}");
    assert!(captured > 10_000, "{err}");
    // Frames without data follow each other every 48 µs on the first device: what is missing leaves a gap.
    let gaps = [1, 2].map(|channel| {
        let times = times(&all, channel);
        assert!(times.len() > 5_000, "channel {channel}: {} of {err}", times.len());
        times.windows(2).map(|pair| (pair[1] - pair[0] + 24_000) / 48_000 - 1).sum::<i64>()
    });
    assert!(gaps.iter().sum::<i64>() <= dropped as i64, "{gaps:?} of {err}");
    assert!(!all.iter().any(is_loss));
}

#[test]
fn tshark_shows_what_a_shared_board_sends_and_where_frames_are_missing() {
    let Some(tshark) = Tshark::install() else { return };
    let socket = tshark.0.path().join("board.sock").display().to_string();
    let line = format!("serve -d virtual:load=10 -b 500k --allow send --unix {socket}");
    let mut server = cantap(line.split_whitespace()).spawn().unwrap();
    until("the server listens", || Path::new(&socket).exists());
    let child = tshark.capture(&format!("unix:{socket}"), &[]);
    tshark.grows_to(20_000);
    // For its sender, the server has the channel take part in the bus and then listen again: two gaps of unknown length.
    let (code, _, err) = run(&format!("send -d unix:{socket} 1 7aa#1122 7ab#33"));
    assert_eq!(code, Some(0), "{err}");
    let now = tshark.file().metadata().unwrap().len();
    tshark.grows_to(now + 40_000);
    let (code, _, err) = end(child, Signal::INT);
    assert_eq!(code, Some(0), "{err}");
    kill_process(Pid::from_child(&server), Signal::INT).unwrap();
    server.wait().unwrap();
    tshark.leaves_nothing_behind();
    let sent = tshark
        .fields("frame.packet_flags", &["frame.interface_name", "can.id", "frame.packet_flags_direction"]);
    assert_eq!(sent, ["can0|1962|0x00000002", "can0|1963|0x00000002"]);
    let lost = tshark.fields("frame.drop_count", &["frame.interface_name", "can.flags.err", "frame.comment"]);
    assert!(!lost.is_empty());
    for line in &lost {
        let words: Vec<_> = line.split('|').collect();
        assert!(words[0] == "can0" && ["1", "True"].contains(&words[1]), "{line}");
        assert_eq!(words[2], "an unknown number of frames was lost here between device and computer");
    }
    // And what it wrote is what we read.
    let all = records(&tshark.file());
    let sent =
        |record: &&TraceRecord| matches!(record.event, TraceEvent::Frame { direction: Direction::Tx, .. });
    assert_eq!(
        (all.iter().filter(sent).count(), all.iter().filter(|record| is_loss(record)).count()),
        (2, lost.len())
    );
}

#[test]
fn a_tshark_that_is_killed_and_one_that_filters_leave_nothing_behind() {
    let Some(tshark) = Tshark::install() else { return };
    let child = tshark.capture("virtual:load=50", &["-f", "can1,0:0"]);
    tshark.grows_to(5_000);
    end(child, Signal::KILL);
    tshark.leaves_nothing_behind();
    let reader = open_reader(tshark.file(), &ReadOptions::default()).unwrap();
    assert!(reader.filter_map(Result::ok).all(|record| record.channel == 2));
    let (code, _, err) =
        said(&tshark.command(CANTAP).args(["extcap", "install", "--remove"]).output().unwrap());
    assert_eq!(code, Some(0), "{err}");
    let (_, out, _) = said(&tshark.command("tshark").arg("-D").output().unwrap());
    assert!(!out.contains("cantap"), "{out}");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn tshark_captures_two_saturated_channels_of_the_emulated_board() {
    let _turn = cantap_testing::process::turn();
    let Some(tshark) = Tshark::install() else { return };
    let device = format!("emu:{},load=100", firmware::elf().display());
    let child = tshark.capture(&device, &AT_1M);
    tshark.grows_to(400_000);
    let (code, _, err) = end(child, Signal::INT);
    assert_eq!(code, Some(0), "{err}");
    tshark.leaves_nothing_behind();
    let all = records(&tshark.file());
    assert!(times(&all, 1).len() > 1000 && times(&all, 2).len() > 1000);
    assert!(!all.iter().any(is_loss), "{err}");
    assert!(err.contains(&format!("{} packets captured", all.len())), "{} {err}", all.len());
}
