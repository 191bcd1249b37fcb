//! Runs each of the examples against the virtual device.

#![allow(dead_code, reason = "their `main` and what it needs")]
#![allow(clippy::duplicate_mod, reason = "each example is a program of its own")]

use std::time::Duration;

use cantap::Device;
use cantap::replay::Accuracy;
use cantap_formats::{ReadOptions, open_reader};

#[path = "../../examples/capture_to_file.rs"]
mod capture_to_file;
#[path = "../../examples/live_signals.rs"]
mod live_signals;
#[path = "../../examples/periodic.rs"]
mod periodic;
#[path = "../../examples/replay.rs"]
mod replay;
#[path = "../../examples/reply.rs"]
mod reply;

const LOG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/data/engine.log");

fn virtual_device(options: &str) -> Device {
    cantap_virtual::open(options.parse().unwrap()).unwrap()
}

#[test]
fn a_capture_has_every_frame_of_both_channels_in_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("capture.blf");
    let device = virtual_device("load=30,bitrate=500k");
    let (frames, lost) = capture_to_file::capture(&device, &file, Duration::from_millis(300)).unwrap();
    let read = open_reader(&file, &ReadOptions::default()).unwrap();
    let read = read.filter(|record| record.as_ref().unwrap().frame().is_some()).count();
    assert!(frames > 100 && lost == 0 && read as u64 == frames, "{frames} {lost} {read}");
}

#[test]
fn signals_are_shown_as_they_were_sent() {
    let device = virtual_device(&format!("bitrate=500k,log={LOG}"));
    let last = live_signals::show(&device, 40).unwrap();
    assert_eq!(last, "Speed = 98 km/h, EngineSpeed = 2850 rpm, Ignition = 1 (on)");
}

#[test]
fn periodic_frames_count_and_bear_their_checksum() {
    let sent = periodic::repeat(&virtual_device("load=0,bitrate=500k"), 18).unwrap();
    let counters: Vec<u8> = sent.iter().map(|frame| frame.data()[0]).collect();
    assert_eq!(counters, (0..18).map(|count| count % 16).collect::<Vec<_>>());
    for frame in sent {
        let (checksum, data) = frame.data().split_last().unwrap();
        assert_eq!(*checksum, crc8_j1850(data), "{frame}");
    }
}

/// As defined, one bit at a time: polynomial 0x1D, initial value and final exclusive-or 0xFF.
fn crc8_j1850(data: &[u8]) -> u8 {
    let crc = data.iter().fold(0xFF, |crc: u8, byte| {
        (0..8).fold(crc ^ byte, |crc, _| if crc & 0x80 == 0 { crc << 1 } else { crc << 1 ^ 0x1D })
    });
    crc ^ 0xFF
}

#[test]
fn a_question_is_answered() {
    let answer = reply::ask(&virtual_device("load=0,bitrate=500k,wire=joined")).unwrap();
    assert_eq!(answer.to_string(), "7E8#0462F19001");
}

#[test]
fn a_replay_keeps_the_files_times() {
    // A computer that stands still for longer than frames are handed over ahead sends them late: one run in time shows it.
    let mut runs = (0..10).map(|_| replay::replay(&virtual_device("load=0,bitrate=500k"), LOG).unwrap());
    let in_time = |run: &Accuracy| run.frames == 40 && run.late_us < 1.0 && run.early_us < 1.0;
    assert!(runs.any(|run| in_time(&run)));
}
