//! The other end of a cannelloni tunnel over TCP, as its `doc/tcp_protocol.md` has it.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};

use cantap::{Channel, DeviceError, TraceEvent};
use cantap_adapters::{OpenError, Place};

use crate::{frames, losses, open, send, send_fd, until_frame};

const GREETING: &[u8] = b"CANNELLONIv1";

/// A session with an end that greets as it should, and the end.
fn greeted() -> (cantap::Device, TcpStream) {
    greeted_with(&[])
}

/// The same with something right behind the greeting.
fn greeted_with(more: &'static [u8]) -> (cantap::Device, TcpStream) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("cannelloni:tcp://{}", listener.local_addr().unwrap());
    let far = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut greeting = [0; 12];
        stream.read_exact(&mut greeting).unwrap();
        assert_eq!(greeting, GREETING);
        // In pieces, as TCP may have it.
        stream.write_all(&GREETING[..5]).unwrap();
        stream.write_all(&[&GREETING[5..], more].concat()).unwrap();
        stream
    });
    let device = open(&address);
    (device, far.join().unwrap())
}

/// Why an end that answers so, and then nothing, is not opened.
fn open_error(answer: &'static [u8], again: bool) -> OpenError {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let place: Place = format!("cannelloni:tcp://{}", listener.local_addr().unwrap()).parse().unwrap();
    let far = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        while stream.write_all(answer).is_ok() && again {}
        let _ = stream.read_to_end(&mut Vec::new());
    });
    let error = cantap_adapters::open(&place).err().unwrap();
    far.join().unwrap();
    error
}

#[test]
fn frames_of_all_kinds_come_and_go() {
    let (device, mut far) = greeted();
    assert_eq!(device.hello().board.as_str(), "cannelloni-tcp");
    device.join(Channel::Can1, 500_000).unwrap();
    let bytes = [
        &[0, 0, 1, 0x23, 1, 0xAA][..],
        &[0x80, 0, 0, 1, 0],
        // A remote frame, and one of CAN FD that switches its bit rate.
        &[0x40, 0, 7, 0xFF, 4],
        &[0x98, 0xDA, 0xF1, 0x10, 0xC0, 1],
        &[0xA5; 64],
        // An error frame.
        &[0x20, 0, 0, 0x88, 8, 0, 0, 4, 0, 0, 0, 0, 0],
        &[0, 0, 7, 0xFE, 0],
    ]
    .concat();
    for piece in bytes.chunks(7) {
        far.write_all(piece).unwrap();
    }
    let records = until_frame(&device, "7FE#");
    let long = format!("18DAF110##1{}", "A5".repeat(64));
    assert_eq!(frames(&records), ["123#AA", "00000001#", "7FF#R4", &long, "7FE#"]);
    assert!(records.iter().any(|record| matches!(
        record.event,
        TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. }
    )));
    assert_eq!(losses(&records), []);
    assert_eq!(send(&device, "1ABCDEF0#11").result.unwrap().to_string(), "1ABCDEF0#11");
    assert_eq!(send(&device, "123#R4").result.unwrap().to_string(), "123#R4");
    send_fd(&device, "123##1AABB").result.unwrap();
    let mut bytes = [0; 11 + 5 + 8];
    far.read_exact(&mut bytes[..6 + 5 + 8]).unwrap();
    assert_eq!(bytes[..6], [0x9A, 0xBC, 0xDE, 0xF0, 1, 0x11]);
    assert_eq!(bytes[6..11], [0x40, 0, 1, 0x23, 4]);
    assert_eq!(bytes[11..19], [0, 0, 1, 0x23, 0x82, 1, 0xAA, 0xBB]);
}

/// A wrong greeting, one of another service, one that never ends, an end before it.
#[test]
fn what_does_not_greet_so_is_refused() {
    for (answer, again) in
        [(&b"CANNELLONIv2"[..], false), (b"SSH-2.0-OpenSSH", false), (b"CANNELLONIV1", true), (b"\0", true)]
    {
        let error = open_error(answer, again);
        assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
        assert!(error.to_string().contains("cannelloni over TCP (-C s)"), "{error}");
    }
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let place: Place = format!("cannelloni:tcp://{}", listener.local_addr().unwrap()).parse().unwrap();
    let far = std::thread::spawn(move || drop(listener.accept().unwrap()));
    assert!(matches!(cantap_adapters::open(&place), Err(OpenError::Foreign { .. })));
    far.join().unwrap();
    // Half a greeting, and then nothing.
    let error = open_error(&GREETING[..11], false);
    assert!(matches!(error, OpenError::Foreign { .. }), "{error}");
}

/// What comes in one piece with the greeting was on the bus before the channel was opened: it does not wait for the next frame, to get its time.
#[test]
fn a_frame_right_behind_the_greeting_is_not_kept_for_later() {
    let (device, mut far) = greeted_with(&[0, 0, 1, 0x23, 1, 0xAA, 0, 0]);
    device.listen(Channel::Can1, 500_000).unwrap();
    // Nor is the frame cut that has begun.
    far.write_all(&[1, 0x24, 0]).unwrap();
    let records = until_frame(&device, "124#");
    assert_eq!((frames(&records), losses(&records)), (vec!["124#".to_owned()], vec![]));
}

/// A length that lies leaves nobody knowing where the next frame begins: no frame is made of what comes then.
#[test]
fn a_frame_that_cannot_be_ends_the_session_and_no_frame_is_made_of_what_follows() {
    let lies: [&[u8]; 4] = [
        // Nine bytes, a length that CAN FD has no code for, an identifier of twelve bits, everything at once.
        &[0, 0, 1, 0x23, 9],
        &[0, 0, 1, 0x23, 0x89, 0],
        &[0, 0, 8, 0, 1],
        &[0xFF; 5],
    ];
    for lie in lies {
        let (device, mut far) = greeted();
        device.listen(Channel::Can1, 500_000).unwrap();
        far.write_all(&[0, 0, 1, 0x23, 1, 0xAA]).unwrap();
        far.write_all(lie).unwrap();
        // In which there are frames, and which never ends.
        let rest = [0, 0, 1, 0x24, 1, 0xBB].repeat(1000);
        let babbler = std::thread::spawn(move || while far.write_all(&rest).is_ok() {});
        let records: Vec<_> = device.records().collect();
        let whole: Vec<_> = records.iter().filter_map(|record| record.as_ref().ok().copied()).collect();
        assert_eq!(frames(&whole), ["123#AA"], "{lie:?}");
        assert_eq!(losses(&whole), [("link", 1)], "{lie:?}");
        let end = records.last().unwrap().as_ref().unwrap_err();
        assert!(end.to_string().contains("no frame of cannelloni's"), "{end}");
        drop(device);
        babbler.join().unwrap();
    }
}

#[test]
fn one_that_stalls_is_waited_for_and_one_that_goes_ends_the_session_with_what_it_had_begun() {
    let (device, mut far) = greeted();
    device.listen(Channel::Can1, 500_000).unwrap();
    far.write_all(&[0, 0, 1, 0x23, 2, 0xAA]).unwrap();
    // Half a frame holds up nothing.
    device.status().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(200));
    far.write_all(&[0xBB, 0, 0, 1]).unwrap();
    until_frame(&device, "123#AABB");
    far.shutdown(Shutdown::Both).unwrap();
    let records: Vec<_> = device.records().collect();
    let whole: Vec<_> = records.iter().filter_map(|record| record.as_ref().ok().copied()).collect();
    assert_eq!((frames(&whole), losses(&whole)), (Vec::<String>::new(), vec![("link", 1)]));
    let end = records.last().unwrap().as_ref().unwrap_err();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
}
