//! python-can's slcan interface, unchanged, on the virtual device's pseudo terminal.
#![cfg(unix)]

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};

/// Receives, sends, and compares what the device says of itself.
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

#[test]
fn python_can_talks_to_the_virtual_device() {
    let python = std::env::var("CANTAP_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let imports = Command::new(&python).args(["-c", "import can, serial"]).output();
    if !imports.is_ok_and(|output| output.status.success()) {
        assert!(
            std::env::var_os("CANTAP_REQUIRE_PEERS").is_none(),
            "{python} has no python-can with pyserial"
        );
        eprintln!("SKIPPED: {python} has no python-can with pyserial; name one that has in CANTAP_PYTHON");
        return;
    }
    let mut device = Command::new(env!("CARGO_BIN_EXE_cantap"))
        .args(["virtual", "load=5,frames=std8"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut path = String::new();
    BufReader::new(device.stdout.take().unwrap()).read_line(&mut path).unwrap();
    let output = Command::new(&python).args(["-c", PROGRAM, path.trim()]).output();
    device.kill().unwrap();
    device.wait().unwrap();
    let output = output.unwrap();
    assert_eq!(
        String::from_utf8_lossy(&output.stdout),
        "done\n",
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}
