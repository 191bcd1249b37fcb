//! The USB/IP server, with this file in place of the kernel: what `cargo xtask ci --only kernel` shows with a real one, but in a
//! second.
#![cfg(unix)]

use crate::common;

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use cantap_testing::usbip;
use serde_json::Value;

/// Far longer than anything takes.
const PATIENCE: Duration = Duration::from_mins(1);

/// The server, and its ports.
struct Server {
    process: Child,
    folder: tempfile::TempDir,
    usbip: u16,
    control: u16,
}

impl Server {
    fn start() -> Self {
        let elf = common::elf();
        let folder = tempfile::tempdir().unwrap();
        let mut process = Command::new(env!("CARGO_BIN_EXE_cantap-sim"));
        let mut process = process.arg("usbip").arg(elf).arg(folder.path()).spawn().unwrap();
        let ports = wait_for(|| {
            assert!(process.try_wait().unwrap().is_none(), "the server ended before it began");
            let text = std::fs::read_to_string(folder.path().join("ports")).ok()?;
            let ports: Option<Vec<u16>> =
                text.lines().map(|line| line.split_once('=')?.1.parse().ok()).collect();
            ports.filter(|ports| ports.len() == 3)
        });
        Self { process, folder, usbip: ports[0], control: ports[2] }
    }

    /// Sends a line and returns the answer.
    fn say(&self, line: &str) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.control)).unwrap();
        writeln!(stream, "{line}").unwrap();
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer).unwrap();
        answer
    }

    fn figure(&self, name: &str) -> Value {
        serde_json::from_str::<Value>(&self.say("status")).unwrap()[name].clone()
    }

    /// Like `usbip attach`: asks for the device by its bus ID.
    fn import(&self, name: &str) -> usbip::Kernel {
        usbip::Kernel::import(self.usbip, name).unwrap()
    }

    /// Attached, enumerated and configured, as Linux does it.
    fn attach(&self) -> Kernel {
        let mut kernel = self.import("1-1");
        let reply = kernel.bytes(320);
        assert_eq!(reply[..8], [1, 0x11, 0, 3, 0, 0, 0, 0]);
        assert_eq!(reply[8 + 300..8 + 304], [0x12, 0x09, 0, 1], "vendor and product");
        let configuration = kernel.enumerate();
        let (input, output) = (usbip::bulk(&configuration, 0x80), usbip::bulk(&configuration, 0));
        Kernel { bus: kernel, input, output }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.say("quit");
            assert!(self.process.wait().unwrap().success());
        }
        let _ = self.process.kill();
    }
}

/// A connection that has the device.
struct Kernel {
    bus: usbip::Kernel,
    /// The serial port's endpoints.
    input: u32,
    output: u32,
}

impl Kernel {
    /// The next message: its number, its status, and the data that came.
    fn end(&mut self) -> (u32, i32, Vec<u8>) {
        let ended = self.bus.next(PATIENCE).unwrap().expect("it ends");
        (ended.seq, ended.status, ended.data)
    }

    fn control(&mut self, setup: [u8; 8], data: &[u8]) -> (i32, Vec<u8>) {
        self.bus.control(setup, data, PATIENCE).unwrap()
    }

    fn set_lines(&mut self, dtr: bool) {
        assert_eq!(self.control([0x21, 0x22, dtr.into(), 0, 0, 0, 0, 0], &[]).0, 0);
    }

    /// Writes to the serial port.
    fn write(&mut self, bytes: &[u8]) {
        let seq = self.bus.submit(self.output, false, bytes.len() as u32, [0; 8], bytes).unwrap();
        assert_eq!(self.end(), (seq, 0, vec![]));
    }

    /// Begins to read from it.
    fn begin_read(&mut self) -> u32 {
        self.bus.submit(self.input, true, 128, [0; 8], &[]).unwrap()
    }

    /// Reads until the bytes end like this.
    fn read_until(&mut self, end: &str) -> String {
        let mut text = Vec::new();
        while !text.ends_with(end.as_bytes()) {
            let seq = self.begin_read();
            let (ended, status, data) = self.end();
            assert_eq!((ended, status), (seq, 0));
            text.extend(data);
        }
        String::from_utf8(text).unwrap()
    }

    /// Sends slcan lines and reads their answers.
    fn converse(&mut self, conversation: &[(&str, &str)]) {
        for (line, answer) in conversation {
            self.write(format!("{line}\r").as_bytes());
            assert_eq!(self.read_until(answer), *answer, "the answer to {line}");
        }
    }
}

fn wait_for<T>(mut what: impl FnMut() -> Option<T>) -> T {
    let until = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = what() {
            return found;
        }
        assert!(Instant::now() < until, "waited for a minute");
        std::thread::sleep(Duration::from_millis(10));
    }
}

const ECONNRESET: i32 = -104;
const EPIPE: i32 = -32;

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_kernel_enumerates_it_and_talks_through_its_port() {
    let server = Server::start();
    let mut kernel = server.attach();
    kernel.set_lines(true);
    kernel.converse(&[("S8", "\r"), ("O", "\r"), ("F", "F00\r")]);
    server.say("send 1 123#DEADBEEF");
    assert_eq!(kernel.read_until("\r"), "t1234DEADBEEF\r");
    kernel.converse(&[("t4561AA", "z\r")]);
    assert_eq!((server.figure("taken")[0].clone(), server.figure("sent")[0].clone()), (1.into(), 1.into()));
    server.say("dump books");
    assert_eq!(std::fs::read_to_string(server.folder.path().join("books.sent1")).unwrap(), "456#AA\n");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_read_is_taken_back_and_what_it_would_have_brought_comes_with_the_next() {
    let server = Server::start();
    let mut kernel = server.attach();
    kernel.set_lines(true);
    let victim = kernel.begin_read();
    let seq = kernel.bus.take_back(victim).unwrap();
    assert_eq!(kernel.end(), (seq, ECONNRESET, vec![]));
    kernel.converse(&[("V", "V1001\r")]);
}

/// Linux's virtual controller may send the withdrawal of a transfer before the transfer itself. If the answer were that it has ended,
/// and the transfer were then carried out, the kernel would give up the device.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_transfer_that_is_taken_back_before_it_comes_is_not_carried_out() {
    let server = Server::start();
    let mut kernel = server.attach();
    let victim = kernel.bus.next_seq() + 1;
    let seq = kernel.bus.take_back(victim).unwrap();
    assert_eq!(kernel.end(), (seq, ECONNRESET, vec![]));
    assert_eq!(kernel.bus.submit(0, true, 1, [0x80, 8, 0, 0, 0, 0, 1, 0], &[]).unwrap(), victim);
    assert_eq!(kernel.control([0x80, 8, 0, 0, 0, 0, 1, 0], &[]), (0, vec![1]));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_request_that_the_device_refuses_ends_with_a_stall() {
    let server = Server::start();
    let mut kernel = server.attach();
    assert_eq!(kernel.control([0xC0, 1, 0, 0, 0, 0, 8, 0], &[]), (EPIPE, vec![]));
    assert_eq!(kernel.control([0x80, 8, 0, 0, 0, 0, 1, 0], &[]), (0, vec![1]));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn one_kernel_has_the_device_and_another_may_when_it_is_gone() {
    let server = Server::start();
    let kernel = server.attach();
    assert_eq!(server.import("1-1").bytes(8)[4..], [0, 0, 0, 1], "somebody has it");
    drop(kernel);
    // The end of a connection is noticed a moment later.
    wait_for(|| (server.import("1-1").bytes(8)[4..] == [0; 4]).then_some(()));
    assert_eq!(server.import("7-7").bytes(8)[4..], [0, 0, 0, 1], "there is no such device");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn a_pulled_cable_ends_the_connection_without_answers() {
    let server = Server::start();
    let mut kernel = server.attach();
    kernel.set_lines(true);
    kernel.begin_read();
    server.say("unplug");
    let rest = kernel.bus.rest();
    assert!(rest.is_empty(), "{rest:?}");
    server.attach();
}

/// A slow client does not lose frames while it sets the pace, since time stands still; in real time the device's queue fills.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn time_stands_still_while_the_kernel_owes_reads() {
    let server = Server::start();
    let mut kernel = server.attach();
    server.say("traffic 50 std0");
    kernel.set_lines(true);
    kernel.converse(&[("S8", "\r"), ("L", "\r")]);
    kernel.read_until("\r");
    let before = server.figure("emulated_s");
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!(server.figure("emulated_s"), before);
    server.say("pace real");
    wait_for(|| (server.figure("emulated_s") != before).then_some(()));
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn lines_that_make_no_sense_are_refused() {
    let server = Server::start();
    for line in
        ["", "plug", "traffic", "traffic 10 wild", "send 3 123#", "send 1 123", "halt xx", "play 1 10 mix"]
    {
        assert!(server.say(line).starts_with("error: "), "{line}");
    }
    assert!(server.say("status").starts_with('{'));
}
