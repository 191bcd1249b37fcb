//! A trace that arrives through a named pipe.

use std::io::Write;
use std::process::Command;

use cantap::wire::Refusal;
use cantap::wire::message::TxFrame;
use cantap::{Channel, Device, DeviceError, TraceEvent};
use cantap_adapters::{OpenError, Place};

use crate::{frames, losses, open, until_frame};

/// A device behind a named pipe, and what writes into it.
fn piped(scheme: &str, first: &[u8]) -> (Device, std::fs::File, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    let (for_writer, first) = (path.clone(), first.to_vec());
    let writer = std::thread::spawn(move || {
        let mut pipe = std::fs::File::create(for_writer).unwrap();
        pipe.write_all(&first).unwrap();
        pipe
    });
    let device = open(&format!("{scheme}:{}", path.display()));
    (device, writer.join().unwrap(), folder)
}

/// Why a file with this content is no trace.
fn no_trace(scheme: &str, content: &[u8]) -> String {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(&file, content).unwrap();
    let place: Place = format!("{scheme}:{}", file.path().display()).parse().unwrap();
    match cantap_adapters::open(&place).err().unwrap() {
        OpenError::NoTrace { reason, .. } => reason,
        other => panic!("{other}"),
    }
}

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

/// What candump writes to a screen, one format for another, and nothing.
#[test]
fn what_is_no_such_trace_is_refused_with_what_to_do() {
    let screen = b"  can0  123   [2]  11 22\n  can0  124   [0]\n  can0  125   [1]  33\n";
    let reason = no_trace("candump", screen);
    assert!(reason.contains("candump -L"), "{reason}");
    for content in [&b"(1700000000.000100) can0 123#1122\n"[..], &[0; 100], &[0xFF; 100]] {
        let reason = no_trace("pcapng", content);
        assert!(reason.contains("no pcapng"), "{reason}");
    }
    assert!(no_trace("candump", &[0; 100]).contains("candump -L"));
    assert!(no_trace("candump", b"").contains("its input has ended"));
}

#[test]
fn halves_endless_lines_zeros_and_absurd_stamps_cost_what_they_are_and_hold_up_nothing() {
    let (device, mut pipe, _folder) =
        piped("candump", b"(1700000000.000100) can0 123#1122\n(1700000000.0002");
    device.listen(Channel::Can1, 500_000).unwrap();
    // What is whole does not wait for the half behind it.
    assert_eq!(frames(&until_frame(&device, "123#1122")), ["123#1122"]);
    pipe.write_all(b"00) can0 124#\n").unwrap();
    let records = until_frame(&device, "124#");
    assert_eq!((frames(&records), losses(&records)), (vec!["124#".to_owned()], vec![]));
    // Longer than any line that is kept, without and with an end.
    for _ in 0..10 {
        pipe.write_all(&vec![b'x'; 1 << 20]).unwrap();
    }
    pipe.write_all(b"\n(1700000000.001000) can0 125#\n").unwrap();
    let records = until_frame(&device, "125#");
    assert_eq!(losses(&records), [("link", 1)]);
    pipe.write_all(b"(1700000000.00\x000200) can0 126#\n\0\0\0\n(1700000000.003000) can0 127#\n").unwrap();
    let records = until_frame(&device, "127#");
    assert_eq!(frames(&records), ["127#"]);
    assert!(!losses(&records).is_empty());
    // Stamps of no time there is, or of another.
    for stamp in ["0", "99999999999999.9", "18446744073709551616.0", "-5.0", "1700000000.004000"] {
        pipe.write_all(format!("({stamp}) can0 200#{:04X}\n", stamp.len()).as_bytes()).unwrap();
    }
    let records = until_frame(&device, "200#0011");
    let now_ns = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as i64;
    let mut last = i64::MIN;
    for record in records.iter().filter(|record| record.frame().is_some()) {
        assert!(record.time_ns >= last && record.time_ns <= now_ns, "{records:?}");
        last = record.time_ns;
    }
    let (all, lost) = (frames(&records).len(), losses(&records).len());
    assert_eq!(all + lost, 5, "{records:?}");
    // Its writer vanishes in the middle of a line, which is counted.
    pipe.write_all(b"(1700000000.005000) can0 7").unwrap();
    drop(pipe);
    let rest: Vec<_> = device.records().collect();
    let lost = rest
        .iter()
        .flatten()
        .filter(|record| matches!(record.event, TraceEvent::Lost { stage: Some(_), .. }))
        .count();
    assert_eq!(lost, 1, "{rest:?}");
    assert!(
        matches!(rest.last(), Some(Err(error)) if error.to_string().contains("its input has ended")),
        "{rest:?}"
    );
}

/// Blocks of pcapng that lie: each costs what it is, and what comes behind is found.
#[test]
fn a_pcapng_pipe_whose_lengths_lie_is_read_on() {
    let block = |kind: u32, body: &[u8]| {
        let len = (body.len() as u32 + 12).to_le_bytes();
        [&kind.to_le_bytes()[..], &len, body, &len].concat()
    };
    let packet = |id: u16| {
        let frame = [&[0, 0][..], &id.to_be_bytes(), &[1, 0, 0, 0, 0xAB, 0, 0, 0]].concat();
        let head = [0_u32, 0, u32::from(id), 9, 9].map(u32::to_le_bytes).concat();
        block(6, &[head, frame].concat())
    };
    let section =
        block(0x0A0D_0D0A, &[&0x1A2B_3C4D_u32.to_le_bytes()[..], &[1, 0, 0, 0], &[0xFF; 8]].concat());
    let interface = block(1, &[227, 0, 0, 0, 0, 0, 0, 0]);
    let (device, mut pipe, _folder) = piped("pcapng", &[&section[..], &interface, &packet(0x100)].concat());
    device.listen(Channel::Can1, 500_000).unwrap();
    until_frame(&device, "100#AB");
    let lengths = [u32::MAX, 0, 8, 7, 0x7FFF_FFF0, 0x0100_0000];
    let mut records = Vec::new();
    for (place, len) in (1..).zip(lengths) {
        let mut lies = packet(0x600 + place);
        lies[4..8].copy_from_slice(&len.to_le_bytes());
        pipe.write_all(&[lies, packet(0x200 + place), packet(0x300 + place)].concat()).unwrap();
        // Nothing more comes for now: what is whole does not wait for it.
        records.extend(until_frame(&device, &format!("{:03X}#AB", 0x300 + place)));
    }
    // Half a block, and after a while its end; and what is no block at all.
    pipe.write_all(&packet(0x3F0)[..20]).unwrap();
    device.status().unwrap();
    pipe.write_all(&packet(0x3F0)[20..]).unwrap();
    assert_eq!(frames(&until_frame(&device, "3F0#AB")), ["3F0#AB"]);
    pipe.write_all(&vec![0xA5; 1 << 20]).unwrap();
    pipe.write_all(&packet(0x3F1)).unwrap();
    let babbled = until_frame(&device, "3F1#AB");
    assert!((1..1000).contains(&losses(&babbled).len()), "{}", losses(&babbled).len());
    pipe.write_all(&packet(0x400)[..20]).unwrap();
    drop(pipe);
    let whole = (1..=6).flat_map(|place| [0x200, 0x300].map(|id| format!("{:03X}#AB", id + place)));
    assert_eq!(frames(&records), whole.collect::<Vec<_>>());
    let lost = losses(&records);
    assert!(lost.len() >= lengths.len() && lost.iter().all(|loss| *loss == ("link", 1)), "{lost:?}");
    let end = device.records().last().unwrap().unwrap_err();
    assert!(end.to_string().contains("its input has ended"), "{end}");
}
