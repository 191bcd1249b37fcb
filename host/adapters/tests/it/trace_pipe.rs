//! A trace that arrives through a named pipe.

use std::io::Write;
use std::process::Command;

use cantap::wire::Refusal;
use cantap::wire::message::TxFrame;
use cantap::{Channel, DeviceError};

use crate::{frames, losses, open, until_frame};

#[test]
fn lines_arrive_as_they_are_written_and_the_end_of_the_pipe_is_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    let for_writer = path.clone();
    let (release, released) = std::sync::mpsc::channel::<()>();
    let writer = std::thread::spawn(move || {
        let mut pipe = std::fs::File::create(for_writer).unwrap();
        pipe.write_all(b"(1700000000.000100) can0 123#1122\n").unwrap();
        released.recv().unwrap();
        pipe.write_all(b"what\n(1700000000.001100) can0 00000123#R T\n(1700000000.002100) can0 124##3AA\n")
            .unwrap();
        pipe.write_all(b"(1700000000.003100) can0 125#\n").unwrap();
    });
    let device = open(&format!("candump:{}", path.display()));
    assert_eq!(device.hello().board.as_str(), "trace-pipe");
    let refused = device.join(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::Refused { refusal: Refusal::Unsupported }), "{refused}");
    device.listen(Channel::Can1, 500_000).unwrap();
    let frame = "123#".parse().unwrap();
    let refused = device.send(Channel::Can1, &[TxFrame { tag: 7, frame, at_ticks: None }]).unwrap_err();
    assert!(matches!(refused, DeviceError::Refused { refusal: Refusal::ListenOnly }), "{refused}");
    assert_eq!(frames(&until_frame(&device, "123#1122")), ["123#1122"]);
    release.send(()).unwrap();
    let records = until_frame(&device, "125#");
    assert_eq!(frames(&records), ["00000123#R", "124##3AA", "125#"]);
    assert_eq!(losses(&records), [("link", 1)]);
    writer.join().unwrap();
    let end = device.records().last().unwrap().unwrap_err();
    assert!(end.to_string().contains("its input has ended"), "{end}");
}

#[test]
fn a_pipe_faster_than_any_bus_waits_and_loses_nothing() {
    const FRAMES: u64 = 60_000;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log");
    let line = |number: u64| format!("(1700000000.{number:06}) can0 123#{number:016X}\n");
    std::fs::write(&path, (0..FRAMES).map(line).collect::<String>()).unwrap();
    let device = open(&format!("candump:{}", path.display()));
    device.listen(Channel::Can1, 500_000).unwrap();
    let received = device.records().map_while(Result::ok).filter(|record| record.frame().is_some()).count();
    let counters = device.counters().channels[0];
    assert_eq!((received as u64, counters.received, counters.lost()), (FRAMES, FRAMES, 0));
}
