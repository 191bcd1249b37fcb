//! python-can's slcan interface, unmodified, on the virtual device's pseudo-terminal.
#![cfg(unix)]

use cantap_testing::peers;

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

/// Receives, sends, and compares with what the device reports about itself.
const PROGRAM: &str = r#"
import sys, can
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=500000)
assert bus.get_version(2) == (10, 1), bus.get_version(2)
frames = [bus.recv(5) for _ in range(200)]
assert all(frame is not None for frame in frames)
assert all(frame.dlc == 8 and len(frame.data) == 8 and not frame.is_extended_id for frame in frames)
bus.send(can.Message(arbitration_id=0x123, data=[1, 2, 3], is_extended_id=False))
bus.send(can.Message(arbitration_id=0x1ABBCCDD, is_remote_frame=True, dlc=4, is_extended_id=True))
bus.shutdown()
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=250000, listen_only=True)
assert bus.recv(5) is not None
bus.shutdown()
print("done")
"#;

/// python-can's command for a rate must give that rate: python-can reads no answer that could tell otherwise.
const RATE: &str = r#"
import sys, can
bus = can.Bus(interface="slcan", channel=sys.argv[1], bitrate=int(sys.argv[2]), listen_only=True, sleep_after_open=0.2)
print("heard" if bus.recv(5) is not None else "nothing")
bus.shutdown()
"#;

/// Those of its rates that are missing or different in Lawicel's manual.
#[test]
fn python_cans_own_bit_rates_are_what_it_means_by_them() {
    for (asked, bus) in [("750000", "750k"), ("83300", "83.333k"), ("500000", "500k")] {
        let Some(output) = on_virtual_device(&format!("load=20,frames=std8,bitrate={bus}"), &[RATE, asked])
        else {
            return;
        };
        assert_eq!(output, "heard\n", "{asked}");
    }
}

#[test]
fn python_can_talks_to_the_virtual_device() {
    if let Some(output) = on_virtual_device("load=5,frames=std8", &[PROGRAM]) {
        assert_eq!(output, "done\n");
    }
}

/// The output of a program that gets the virtual device's port and these arguments; `None` without python-can.
fn on_virtual_device(options: &str, program: &[&str]) -> Option<String> {
    let python = peers::python_with("can, serial")?;
    let mut device = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["virtual", options])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut path = String::new();
    BufReader::new(device.stdout.take().unwrap()).read_line(&mut path).unwrap();
    let output = Command::new(&python).args(["-c", program[0], path.trim()]).args(&program[1..]).output();
    device.kill().unwrap();
    device.wait().unwrap();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Some(String::from_utf8(output.stdout).unwrap())
}
