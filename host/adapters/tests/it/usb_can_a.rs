//! USB-CAN-A adapters: a stand-in after kobolt/usb-can and python-can, which is a peer here, too.

use std::process::Command;
use std::sync::{Arc, Mutex};

use cantap::wire::Refusal;
use cantap::{Channel, DeviceError, TraceEvent};
use cantap_adapters::{ListenOnly, OpenError, Place, row};
use cantap_testing::peers;

use crate::port::Port;
use crate::{frames, losses, open, send, until, until_frame};

/// How the stand-in behaves.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Manner {
    /// Answers the question for its state.
    Answers,
    /// The same, and has three frames to tell behind each answer.
    Talks,
    /// Answers nothing.
    Mute,
    /// Answers the first question, and nothing more.
    Stalls,
    /// Is set to packets of fixed length, and ignores its settings.
    Fixed,
}

/// What a program has sent to it.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Seen {
    /// Bit rate's number, kind of identifier, mode.
    Settings([u8; 3]),
    Question,
    Frame(Vec<u8>),
}

struct StandIn {
    port: Port,
    seen: Arc<Mutex<Vec<Seen>>>,
}

const TALK: [&[u8]; 3] =
    [b"\xAA\xC2\x23\x01\xDE\xAD\x55", b"\xAA\xE0\xF0\xDE\xBC\x1A\x55", b"\xAA\xD0\x56\x04\x55"];

/// A packet with its sum.
fn packet(content: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xAA, 0x55];
    bytes.extend_from_slice(content);
    bytes.resize(19, 0);
    let sum = bytes[2..].iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    bytes.push(sum);
    bytes
}

impl StandIn {
    fn start(manner: Manner) -> Self {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let log = Arc::clone(&seen);
        let mut bytes: Vec<u8> = Vec::new();
        let mut questions = 0;
        let port = Port::start(move |byte| {
            bytes.push(byte);
            if bytes[0] != 0xAA {
                bytes.clear();
            }
            let len = match bytes.get(1) {
                None => 2,
                Some(0x55) => 20,
                Some(kind) => {
                    let is_remote = kind & 0x10 != 0;
                    3 + if kind & 0x20 == 0 { 2 } else { 4 }
                        + usize::from(if is_remote { 0 } else { kind & 15 })
                }
            };
            if bytes.len() < len {
                return Vec::new();
            }
            let whole = std::mem::take(&mut bytes);
            let (is_packet, kind) = (whole[1] == 0x55, whole[2]);
            assert!(!is_packet || whole == packet(&whole[2..19]), "{whole:X?}");
            let (seen, answer) = match kind {
                _ if !is_packet => (Seen::Frame(whole), Vec::new()),
                0x12 => (Seen::Settings([whole[3], whole[4], whole[13]]), Vec::new()),
                _ => (Seen::Question, packet(&[4, 100, 3])),
            };
            let is_question = seen == Seen::Question;
            log.lock().unwrap().push(seen);
            questions += u32::from(is_question);
            match manner {
                Manner::Stalls if questions > 1 => Vec::new(),
                Manner::Fixed if is_question => packet(&[1, 1, 1, 0x23, 1]),
                Manner::Mute | Manner::Fixed => Vec::new(),
                Manner::Talks if is_question => [answer, TALK.concat()].concat(),
                Manner::Answers | Manner::Talks | Manner::Stalls => answer,
            }
        });
        Self { port, seen }
    }

    fn address(&self) -> String {
        format!("usb-can-a:{}", self.port.path)
    }

    /// What it has seen, without questions.
    fn seen(&self) -> Vec<Seen> {
        let seen = self.seen.lock().unwrap();
        seen.iter().filter(|seen| **seen != Seen::Question).cloned().collect()
    }
}

fn settings(rate: u8, ids: u8, mode: u8) -> Seen {
    Seen::Settings([rate, ids, mode])
}

fn open_error(address: &str) -> OpenError {
    cantap_adapters::open(&address.parse::<Place>().unwrap()).err().unwrap()
}

#[test]
fn it_is_silent_before_and_after_and_hears_both_kinds_of_frames() {
    let adapter = StandIn::start(Manner::Answers);
    let device = open(&adapter.address());
    assert_eq!((device.hello().board.as_str(), device.hello().channels), ("usb-can-a", 1));
    let row = row(&device.hello().board).unwrap();
    assert_eq!(row.listen_only, ListenOnly::Unconfirmed);
    assert!(!row.losses.are_counted() && row.limits.unwrap().contains("does not say"));
    let bad = device.listen(Channel::Can1, 83_333).unwrap_err();
    assert!(matches!(bad, DeviceError::Refused { refusal: Refusal::BadTiming }), "{bad}");
    device.listen(Channel::Can1, 250_000).unwrap();
    let all = [TALK.concat(), b"\xAA\xD3\x57\x04\0\0\0\x55\xAA\xC0\xFF\x07\x55".to_vec()].concat();
    for piece in all.chunks(4) {
        adapter.port.says(piece);
    }
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["123#DEAD", "1ABCDEF0#", "456#R", "457#R3", "7FF#"]);
    assert_eq!(losses(&records), []);
    device.stop().unwrap();
    drop(device);
    let silent = settings(3, 1, 2);
    assert_eq!(adapter.seen(), [silent.clone(), silent.clone(), settings(5, 1, 2), silent]);
}

#[test]
fn what_is_sent_is_handed_over_and_counters_are_told() {
    let adapter = StandIn::start(Manner::Answers);
    let device = open(&format!("{}?ids=extended", adapter.address()));
    assert_eq!(device.hello().board.as_str(), "usb-can-a-extended");
    device.join(Channel::Can1, 1_000_000).unwrap();
    for frame in ["123#DEAD", "1ABCDEF0#0102030405060708", "123#R4", "1ABCDEF0#R"] {
        assert_eq!(send(&device, frame).result.unwrap().to_string(), frame);
    }
    // The second it has for each question, a state comes.
    let records = until(&device, |record| matches!(record.event, TraceEvent::State { .. }));
    let TraceEvent::State { state, counters } = records.last().unwrap().event else { unreachable!() };
    assert_eq!((state, counters), (cantap::wire::record::ErrorState::Warning, Some((3, 100))));
    device.stop().unwrap();
    let sent = [
        &b"\xAA\xC2\x23\x01\xDE\xAD\x55"[..],
        b"\xAA\xE8\xF0\xDE\xBC\x1A\x01\x02\x03\x04\x05\x06\x07\x08\x55",
        b"\xAA\xD4\x23\x01\x55",
        b"\xAA\xF0\xF0\xDE\xBC\x1A\x55",
    ];
    let seen = adapter.seen();
    assert!(seen.contains(&settings(1, 2, 0)), "{seen:?}");
    let frames: Vec<Seen> = seen.into_iter().filter(|seen| matches!(seen, Seen::Frame(_))).collect();
    assert_eq!(frames, sent.map(|bytes| Seen::Frame(bytes.to_vec())));
}

#[test]
fn one_that_answers_nothing_is_opened_and_that_is_said() {
    let adapter = StandIn::start(Manner::Mute);
    let device = open(&adapter.address());
    let failures = device.failures().unwrap();
    assert!(failures.last.contains("whether an adapter is there is not known"), "{failures:?}");
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.port.says(TALK[0]);
    let records = until_frame(&device, "123#DEAD");
    assert_eq!(records[0].event, TraceEvent::UNCOUNTED);
    device.stop().unwrap();
}

#[test]
fn what_is_no_such_adapter_is_refused_with_what_to_do() {
    // A GPS, a line at the wrong speed, one that returns what it is sent, and one that never stops.
    let mut number = 0u8;
    let others: [Box<dyn FnMut(u8) -> Vec<u8> + Send>; 4] = [
        Box::new(|_| b"$GPGGA,123519,4807.038,N\r\n".to_vec()),
        Box::new(move |_| {
            number = number.wrapping_mul(37).wrapping_add(11);
            vec![number & 0x7F, 0, 0xFE]
        }),
        Box::new(|byte| vec![byte]),
        Box::new(|_| vec![0xAA; 4096]),
    ];
    for other in others {
        let port = Port::start(other);
        let error = open_error(&format!("usb-can-a:{}", port.path));
        assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
        assert!(error.to_string().contains("(@BAUD)"), "{error}");
    }
    let adapter = StandIn::start(Manner::Fixed);
    let error = open_error(&adapter.address());
    assert!(matches!(error, OpenError::Channel { .. }), "{error}");
    assert!(error.to_string().contains("variable length"), "{error}");
}

#[test]
fn no_frame_is_made_of_the_pieces_of_two() {
    let adapter = StandIn::start(Manner::Answers);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    // The data are what ends a message, which makes it as hard as it can be.
    for data in [0x99, 0x55, 0xAA] {
        let message = |id: u8| [&[0xAA, 0xC8, id, 1][..], &[data; 8], &[0x55]].concat();
        for cut in 1..13 {
            let bytes = [&message(0x11)[..cut], &message(cut as u8 + 0x20), b"\xAA\xC0\xFF\x07\x55"].concat();
            adapter.port.says(bytes);
            let records = until_frame(&device, "7FF#");
            let whole = format!("1{:02X}#{}", cut + 0x20, format!("{data:02X}").repeat(8));
            assert_eq!(frames(&records), [whole, "7FF#".to_owned()], "{data:X} {cut}");
            let lost = losses(&records);
            assert!(!lost.is_empty() && lost.iter().all(|loss| *loss == ("link", 1)), "{lost:?}");
        }
    }
    device.stop().unwrap();
}

#[test]
fn half_a_message_and_babbling_are_losses_and_hold_up_nothing() {
    // One that answers would put its state behind the half.
    let adapter = StandIn::start(Manner::Mute);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.port.says(b"\xAA\xC8\x23\x01\x11");
    // Its end does not come, and nothing else either.
    let records = until(&device, |record| matches!(record.event, TraceEvent::Lost { stage: Some(_), .. }));
    assert_eq!(losses(&records), [("link", 1)]);
    // Now it comes: the same loss.
    adapter.port.says(b"\x22\x33\x55");
    adapter.port.says(TALK[0]);
    let records = until_frame(&device, "123#DEAD");
    assert_eq!((frames(&records), losses(&records)), (vec!["123#DEAD".to_owned()], vec![]));
    // Lengths and identifiers that lie, a packet whose sum is wrong, one of unknown kind, two answers to no question.
    adapter.port.says(b"\xAA\xCF\x23\x01\xAA\xC0\x00\x08\x55\xAA\x55\x04\x09");
    adapter.port.says([vec![0; 16], packet(&[0x77]), packet(&[4, 0, 0]), packet(&[4, 255, 255])].concat());
    for _ in 0..64 {
        adapter.port.says(vec![0xC8; 4096]);
    }
    adapter.port.says(b"\xAA\xC0\xFF\x07\x55");
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["7FF#"]);
    assert!((1..100).contains(&losses(&records).len()), "{}", losses(&records).len());
    let failures = device.failures().unwrap().last;
    for kind in ["messages without an end", "bytes that are no message", "packets of unknown kind"] {
        assert!(failures.contains(kind), "{failures}");
    }
    device.stop().unwrap();
}

#[test]
fn pulled_out_or_set_anew_it_ends_with_a_reason_and_nothing_captured_is_lost() {
    for is_pulled in [true, false] {
        let adapter = StandIn::start(Manner::Answers);
        let device = open(&adapter.address());
        device.listen(Channel::Can1, 500_000).unwrap();
        for id in 0..100 {
            adapter.port.says([0xAA, 0xC0, id, 0, 0x55]);
        }
        until_frame(&device, "063#");
        if is_pulled {
            adapter.port.pull();
        } else {
            adapter.port.says(packet(&[1, 1, 1, 0x23, 1]));
        }
        let end = device.records().find_map(Result::err).unwrap();
        assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
        assert!(is_pulled || end.to_string().contains("variable length"), "{end}");
        assert_eq!(device.counters().channels[0].received, 100);
    }
}

/// Its questions stay without an answer: it is heard all the same, and told to be silent at the end.
#[test]
fn one_that_answers_no_more_holds_up_nothing() {
    let adapter = StandIn::start(Manner::Stalls);
    let device = open(&adapter.address());
    device.listen(Channel::Can1, 500_000).unwrap();
    while adapter.seen.lock().unwrap().iter().filter(|seen| **seen == Seen::Question).count() < 4 {
        device.status().unwrap();
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    adapter.port.says(TALK[0]);
    let records = until_frame(&device, "123#DEAD");
    assert_eq!((frames(&records), losses(&records)), (vec!["123#DEAD".to_owned()], vec![]));
    device.stop().unwrap();
    drop(device);
    assert_eq!(adapter.seen().last(), Some(&settings(3, 1, 2)));
}

/// What python-can writes to the same stand-in, and what it reads there.
#[test]
fn python_can_says_and_hears_the_same() {
    const PROGRAM: &str = r#"
import sys, can
bus = can.Bus(interface="seeedstudio", channel=sys.argv[1], bitrate=125000, frame_type="EXT", operation_mode="silent")
bus.send(can.Message(arbitration_id=0x123, data=[0xDE, 0xAD], is_extended_id=False))
bus.send(can.Message(arbitration_id=0x1ABCDEF0, data=range(1, 9), is_extended_id=True))
bus.send(can.Message(arbitration_id=0x123, is_remote_frame=True, dlc=4, is_extended_id=False))
bus.status_frame()
for _ in range(3):
    frame = bus.recv(20)
    print(f"{frame.arbitration_id:X}", int(frame.is_extended_id), int(frame.is_remote_frame), bytes(frame.data).hex())
bus.shutdown()
"#;
    let Some(python) = peers::python_with("can, serial") else { return };
    let adapter = StandIn::start(Manner::Talks);
    let output = Command::new(python).args(["-c", PROGRAM, &adapter.port.path]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let heard = String::from_utf8(output.stdout).unwrap();
    assert_eq!(heard.lines().collect::<Vec<_>>(), ["123 0 0 dead", "1ABCDEF0 1 0 ", "456 0 1 "]);
    let theirs = adapter.seen();
    let adapter = StandIn::start(Manner::Answers);
    let device = open(&format!("{}?ids=extended", adapter.address()));
    device.join(Channel::Can1, 125_000).unwrap();
    for frame in ["123#DEAD", "1ABCDEF0#0102030405060708", "123#R4"] {
        send(&device, frame).result.unwrap();
    }
    device.close_channel(Channel::Can1).unwrap();
    device.listen(Channel::Can1, 125_000).unwrap();
    device.stop().unwrap();
    let ours = adapter.seen();
    assert_eq!(theirs[0], settings(7, 2, 2));
    assert!(theirs.iter().all(|seen| ours.contains(seen)), "{theirs:?}\n{ours:?}");
}
