//! slcan (Lawicel) on the firmware's ELF: every letter with both of its answers, reported overruns, and unmodified
//! python-can.

use crate::common;
#[cfg(unix)]
use cantap_testing::peers;

use cantap_emu::bus::{BitTime, Disturbance, Node};
use cantap_emu::soc::CAN_IRQS;
use cantap_emu::traffic::{Kind, Script, Traffic};
use cantap_emu::usb_host::Timing;
use cantap_sim::board::CLOCK;
use cantap_sim::rig::{MS, Rig};
use cantap_wire::Frame;

const BITRATE_BPS: u32 = 500_000;

/// A board with its port open, and a node that acknowledges on channel 1's bus.
fn plugged_in() -> Rig {
    let mut rig = Rig::new(common::firmware(), common::setup(), Timing::hasty(CLOCK));
    rig.plug_in().unwrap();
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(BITRATE_BPS, CLOCK)));
    rig
}

/// The device's answer to a line.
fn say(rig: &mut Rig, line: &str) -> String {
    rig.with_host(|host, _| host.send(line.as_bytes()));
    String::from_utf8(rig.run_unbooked(5 * MS).unwrap()).unwrap()
}

fn converse(rig: &mut Rig, lines: &[(&str, &str)]) {
    for (line, answer) in lines {
        assert_eq!(say(rig, line), *answer, "the answer to {line:?}");
    }
}

/// Puts frames on the bus, a millisecond apart.
fn on_the_bus(rig: &mut Rig, frames: &[&str]) {
    let from = rig.now() + MS / 2;
    let frames = frames.iter().zip(0..).map(|(text, n)| (from + n * MS, text.parse::<Frame>().unwrap()));
    let sender = Node::new(BitTime::of_rate(BITRATE_BPS, CLOCK)).with_source(Script::new(frames.collect()));
    rig.machine.board().wires[0].add(sender);
}

fn text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes).unwrap()
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_letter_is_answered_on_a_closed_channel() {
    let mut rig = plugged_in();
    let serial = say(&mut rig, "\rN\r");
    assert!(serial.len() == "\rN1234\r".len() && serial.starts_with("\rN"), "{serial:?}");
    for digit in 0..=9 {
        converse(&mut rig, &[(&format!("S{digit}\r"), "\r")]);
    }
    converse(
        &mut rig,
        &[
            // Nothing is saved yet, and a rate is set: commands that need an open channel are refused.
            ("V\r", "V1001\r"),
            ("F\r", "\x07"),
            ("P\r", "\x07"),
            ("A\r", "\x07"),
            ("t1230\r", "\x07"),
            ("T000001230\r", "\x07"),
            ("r1230\r", "\x07"),
            ("R000001230\r", "\x07"),
            ("Z0\r", "\r"),
            ("Z1\r", "\r"),
            ("Z2\r", "\r"),
            ("Z3\r", "\x07"),
            ("X0\r", "\r"),
            ("X1\r", "\r"),
            ("X2\r", "\x07"),
            ("W0\r", "\r"),
            ("W1\r", "\r"),
            ("W2\r", "\x07"),
            ("M00000000\r", "\r"),
            ("mFFFFFFFF\r", "\r"),
            ("M0000000\r", "\x07"),
            ("mFFFFFFFG\r", "\x07"),
            ("S:\r", "\x07"),
            ("S\r", "\x07"),
            ("s001C\r", "\r"),
            ("sFFFFF\r", "\x07"),
            ("Q3\r", "\x07"),
            ("E\r", "\x07"),
            ("C\r", "\r"),
            ("\r", "\r"),
        ],
    );
    // SJA1000 timing and registers by name.
    let registers = say(&mut rig, "I\r");
    assert!(registers.starts_with('I') && registers.ends_with('\r') && registers.len() > 8, "{registers:?}");
    assert_eq!(say(&mut rig, "Y\r"), "\x07", "there was no error yet");
}

#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn every_letter_is_answered_on_an_open_channel_and_what_would_change_it_is_refused() {
    let mut rig = plugged_in();
    converse(&mut rig, &[("\r\rC\r", "\r\r\r"), ("S6\r", "\r"), ("Z0\r", "\r"), ("O\r", "\r")]);
    converse(
        &mut rig,
        &[
            ("O\r", "\x07"),
            ("L\r", "\x07"),
            ("S6\r", "\x07"),
            ("s001C\r", "\x07"),
            ("Z1\r", "\x07"),
            ("X0\r", "\x07"),
            ("W0\r", "\x07"),
            ("M00000000\r", "\x07"),
            ("mFFFFFFFF\r", "\x07"),
            ("Q1\r", "\x07"),
            ("P\r", "\x07"),
            ("A\r", "\x07"),
            ("V\r", "V1001\r"),
            ("F\r", "F00\r"),
            ("t1232DEAD\r", "z\r"),
            ("t7FF81122334455667788\r", "z\r"),
            ("T1ABBCCDD3112233\r", "Z\r"),
            ("r1234\r", "z\r"),
            ("R1FFFFFFF0\r", "Z\r"),
            ("t8000\r", "\x07"),
            ("t1239\r", "\x07"),
            ("t12321\r", "\x07"),
            ("T200000000\r", "\x07"),
            ("t123\r", "\x07"),
            ("x\r", "\x07"),
        ],
    );
    on_the_bus(&mut rig, &["7FF#0102", "1ABBCCDD#R3", "001#"]);
    assert_eq!(text(rig.run_unbooked(8 * MS).unwrap()), "t7FF20102\rR1ABBCCDD3\rt0010\r");
    converse(&mut rig, &[("C\r", "\r"), ("C\r", "\r"), ("L\r", "\r"), ("t1230\r", "\x07"), ("C\r", "\r")]);
    // Milliseconds have four digits, microseconds eight.
    for (mode, digits) in [("Z1\r", 4), ("Z2\r", 8)] {
        converse(&mut rig, &[(mode, "\r"), ("L\r", "\r")]);
        on_the_bus(&mut rig, &["123#AB"]);
        let line = text(rig.run_unbooked(8 * MS).unwrap());
        assert!(line.starts_with("t1231AB") && line.len() == 8 + digits, "{mode:?}: {line:?}");
        converse(&mut rig, &[("C\r", "\r")]);
    }
    // Polled: a frame only on request.
    converse(&mut rig, &[("Z0\r", "\r"), ("X0\r", "\r"), ("O\r", "\r")]);
    on_the_bus(&mut rig, &["101#", "102#", "103#"]);
    assert_eq!(text(rig.run_unbooked(8 * MS).unwrap()), "");
    converse(&mut rig, &[("P\r", "t1010\r"), ("A\r", "t1020\rt1030\rA\r"), ("P\r", "\r"), ("A\r", "A\r")]);
    converse(&mut rig, &[("t1230\r", "\r"), ("C\r", "\r"), ("X1\r", "\r")]);
    // The acceptance filter of an SJA1000: standard frame 123 alone.
    converse(&mut rig, &[("W1\r", "\r"), ("M24600000\r", "\r"), ("m001FFFFF\r", "\r"), ("L\r", "\r")]);
    on_the_bus(&mut rig, &["122#", "123#", "124#"]);
    assert_eq!(text(rig.run_unbooked(8 * MS).unwrap()), "t1230\r");
    // Flash takes its time.
    converse(&mut rig, &[("C\r", "\r")]);
    for line in ["Q1\r", "Q0\r"] {
        let said = say(&mut rig, line) + &text(rig.run_unbooked(3_000 * MS).unwrap());
        assert_eq!(said, "\r", "the answer to {line:?}");
    }
}

/// Through the flash: once `K1` is saved, programs that never send it get reports.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn reports_that_were_saved_are_there_without_being_asked_for() {
    let mut rig = plugged_in();
    for (lines, reports) in [("C\rK1\rQ1\r", true), ("K0\rQ1\r", false), ("K1\rQ1\rQ0\r", false)] {
        let said = say(&mut rig, lines) + &text(rig.run_unbooked(300 * MS).unwrap());
        assert!(!said.contains('\x07'), "{lines:?}: {said:?}");
        // A program that comes later.
        rig.with_host(|host, _| host.close_port());
        rig.run_unbooked(20 * MS).unwrap();
        rig.wait_for_port().unwrap();
        converse(&mut rig, &[("C\rS6\rO\r", "\r\r\r")]);
        rig.machine.board().wires[0].disturb(0, Disturbance::Crc);
        on_the_bus(&mut rig, &["123#00"]);
        let said = text(rig.run_unbooked(20 * MS).unwrap());
        assert_eq!(said.contains("e3"), reports, "{lines:?}: {said:?}");
        converse(&mut rig, &[("C\r", "\r")]);
    }
}

/// What can-utils' `slcand -o -c -f -s6` writes before it asks the kernel for the line discipline.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn slcands_opening_opens_the_channel() {
    let mut rig = plugged_in();
    converse(&mut rig, &[("C\rS6\rF\rO\r", "\r\r\x07\r")]);
    on_the_bus(&mut rig, &["123#"]);
    assert_eq!(text(rig.run_unbooked(4 * MS).unwrap()), "t1230\r");
}

/// Frames that the controller's FIFO dropped because its interrupt was handled too late.
#[test]
#[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
fn an_overrun_sets_the_data_overrun_flag_once() {
    const DATA_OVERRUN: u8 = 1 << 3;
    let mut rig = plugged_in();
    converse(&mut rig, &[("\rS6\r", "\r\r"), ("L\r", "\r"), ("F\r", "F00\r")]);
    let (from, until) = (rig.now(), rig.now() + 4 * MS);
    let traffic = Traffic::new(Kind::Std0, 1, 100.0, from, until);
    rig.machine.board().wires[0].add(Node::new(BitTime::of_rate(BITRATE_BPS, CLOCK)).with_source(traffic));
    rig.machine.hold_lines(1 << CAN_IRQS[0][1]);
    rig.run_unbooked(MS).unwrap();
    rig.machine.hold_lines(0);
    rig.run_unbooked(10 * MS).unwrap();
    let flags = say(&mut rig, "F\r");
    let bits = flags.strip_prefix('F').and_then(|rest| u8::from_str_radix(rest.trim_end(), 16).ok());
    assert!(bits.is_some_and(|bits| bits & DATA_OVERRUN != 0), "{flags:?}");
    assert_eq!(say(&mut rig, "F\r"), "F00\r");
}

#[cfg(unix)]
mod python_can {
    use super::*;

    use std::process::Command;
    use std::sync::PoisonError;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::{io, thread};

    use cantap_emu::bus::Member;
    use cantap_sim::link::{Client, Manner, Served};
    use cantap_sim::pty::Pty;
    use cantap_sim::run::{Load, Options};

    /// Receives, sends, and compares what the device says about itself.
    const PROGRAM: &str = r#"
import sys, can
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=500000)
assert bus.get_version(2) == (10, 1), bus.get_version(2)
assert bus.get_serial_number(2), "no serial number"
frames = [bus.recv(10) for _ in range(100)]
assert all(frame is not None for frame in frames)
assert all(frame.dlc == 8 and len(frame.data) == 8 and not frame.is_extended_id for frame in frames)
bus.send(can.Message(arbitration_id=0x123, data=[1, 2, 3], is_extended_id=False))
bus.send(can.Message(arbitration_id=0x1ABBCCDD, is_remote_frame=True, dlc=4, is_extended_id=True))
for n in range(50):
    bus.send(can.Message(arbitration_id=0x18000000 + n, data=[n] * 8, is_extended_id=True))
frames = [bus.recv(10) for _ in range(100)]
assert all(frame is not None for frame in frames)
bus.shutdown()
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=250000, listen_only=True)
assert bus.recv(10) is not None
bus.shutdown()
print("done")
"#;

    /// A terminal, until the flag says that it is enough.
    struct UntilDone<'a>(&'a Pty, &'a AtomicBool);

    impl Client for UntilDone<'_> {
        fn receive(&self) -> io::Result<Vec<u8>> {
            if self.1.load(Ordering::Relaxed) { Err(io::ErrorKind::BrokenPipe.into()) } else { self.0.read() }
        }

        fn deliver(&self, bytes: &[u8]) -> io::Result<usize> {
            self.0.write(bytes)
        }

        fn is_open(&self) -> bool {
            self.0.has_client()
        }
    }

    #[test]
    #[ignore = "runs the firmware: CANTAP_FIRMWARE_ELF and --include-ignored"]
    fn python_can_sends_and_receives_through_the_elf() {
        let (image, Some(python)) = (common::firmware(), peers::python_with("can, serial")) else { return };
        let load = Load::Frames { kind: Kind::Std8, percent: 5.0 };
        let options = Options { load, bound: common::bound(), ..Options::default() };
        let manner = Manner { witness: true, ..Manner::default() };
        let mut served = Served::start(image, options, manner).unwrap();
        let witness = served.witness();
        let (pty, done) = (Pty::open().unwrap(), AtomicBool::new(false));
        let output = thread::scope(|scope| {
            scope.spawn(|| {
                let end = served.until(None, &UntilDone(&pty, &done));
                assert!(done.load(Ordering::Relaxed), "{end:?}");
            });
            let output = Command::new(&python).args(["-c", PROGRAM, pty.name()]).output();
            done.store(true, Ordering::Relaxed);
            output.unwrap()
        });
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(String::from_utf8_lossy(&output.stdout), "done\n", "{errors}");
        let seen = witness.lock().unwrap_or_else(PoisonError::into_inner);
        let ours = seen.frames[0].iter().filter(|crossed| crossed.sender == Member::Controller(0));
        let sent: Vec<Frame> = ours.map(|crossed| crossed.frame).collect();
        let fifty = (0..50u32).map(|n| format!("{:08X}#{}", 0x1800_0000 + n, format!("{n:02X}").repeat(8)));
        let expected = ["123#010203".to_owned(), "1ABBCCDD#R4".to_owned()].into_iter().chain(fifty);
        assert_eq!(sent, expected.map(|text| text.parse().unwrap()).collect::<Vec<Frame>>());
    }
}
