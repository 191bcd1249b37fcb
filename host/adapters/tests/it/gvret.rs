//! A GVRET adapter that reads and writes as ESP32RET does, on TCP.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};

use cantap::wire::Refusal;
use cantap::{Channel, DeviceError, TraceEvent};

use crate::{frames, losses, open, send, until_frame};

/// The two buses' settings as last set, and each frame that was to be sent.
#[derive(Debug, PartialEq, Eq)]
enum Seen {
    Buses([u32; 2]),
    Frame(Vec<u8>),
}

/// What it answers to a command that asks for something.
fn answer(command: u8, buses: [u32; 2], honours_listening: bool) -> Option<Vec<u8>> {
    let bus = |setting: u32| {
        let listens = u8::from(setting >> 29 & 1 == 1 && honours_listening);
        let mut bytes = vec![u8::from(setting >> 30 & 1 == 1) | listens << 4];
        bytes.extend_from_slice(&(setting & 0xF_FFFF).to_le_bytes());
        bytes
    };
    Some(match command {
        6 => [vec![0xF1, 6], bus(buses[0]), bus(buses[1])].concat(),
        7 => vec![0xF1, 7, 0x6A, 2, 0x20, 0, 0, 0],
        9 => vec![0xF1, 9, 0xDE, 0xAD],
        12 => vec![0xF1, 12, 2],
        _ => return None,
    })
}

/// Serves one client, passes on what it does, and returns the stream to it. One that is deaf to `LISTENS` says so.
fn start(honours_listening: bool) -> (String, Receiver<TcpStream>, Receiver<Seen>) {
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("gvret:tcp://{}", server.local_addr().unwrap());
    let (to_test, streams) = channel();
    let (report, seen) = channel();
    std::thread::spawn(move || {
        let (mut stream, _) = server.accept().unwrap();
        to_test.send(stream.try_clone().unwrap()).unwrap();
        let mut buses = [0u32; 2];
        let mut one = [0];
        let mut read = |stream: &mut TcpStream| stream.read_exact(&mut one).map(|()| one[0]);
        while let Ok(byte) = read(&mut stream) {
            if byte != 0xF1 {
                continue;
            }
            let answer: Vec<u8> = match read(&mut stream).unwrap() {
                0 => {
                    let mut head = [0; 6];
                    for byte in &mut head {
                        *byte = read(&mut stream).unwrap();
                    }
                    let data = (0..=usize::from(head[5] & 15)).map(|_| read(&mut stream).unwrap());
                    let data: Vec<u8> = data.collect();
                    report.send(Seen::Frame([&head[..], &data].concat())).unwrap();
                    continue;
                }
                5 => {
                    for bus in &mut buses {
                        let bytes = [(); 4].map(|()| read(&mut stream).unwrap());
                        *bus = u32::from_le_bytes(bytes);
                    }
                    report.send(Seen::Buses(buses)).unwrap();
                    continue;
                }
                command => match answer(command, buses, honours_listening) {
                    Some(answer) => answer,
                    None => continue,
                },
            };
            stream.write_all(&answer).unwrap();
        }
    });
    (address, streams, seen)
}

/// A received frame as the adapter sends it.
fn received(time_us: u32, id: u32, bus: u8, data: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xF1, 0];
    bytes.extend_from_slice(&time_us.to_le_bytes());
    bytes.extend_from_slice(&id.to_le_bytes());
    bytes.push(data.len() as u8 | bus << 4);
    bytes.extend_from_slice(data);
    bytes.push(0);
    bytes
}

#[test]
fn two_buses_are_heard_with_the_adapter_s_own_intervals_and_both_are_off_until_asked() {
    let (address, streams, seen) = start(true);
    let device = open(&address);
    let mut adapter = streams.recv().unwrap();
    assert_eq!(seen.recv().unwrap(), Seen::Buses([1 << 31; 2]));
    assert_eq!((device.hello().board.as_str(), device.hello().channels), ("gvret", 2));
    device.listen(Channel::Can1, 500_000).unwrap();
    assert_eq!(seen.recv().unwrap(), Seen::Buses([0xE000_0000 + 500_000, 1 << 31]));
    device.listen(Channel::Can2, 250_000).unwrap();
    // Over the wrap of the clock, in pieces, with rubbish and a CAN FD frame between.
    let fd = [&[0xF1, 20, 0, 0, 0, 0, 1, 0, 0, 0, 12, 1], &[0; 12][..], &[0]].concat();
    let bytes = [
        received(u32::MAX - 99, 0x123, 0, &[0xAA]),
        received(u32::MAX - 49, 0x8000_0001 | 0x1ABC_0000, 1, &[]),
        vec![0x55, 0x66],
        fd,
        received(900, 0x124, 0, &[1, 2, 3, 4, 5, 6, 7, 8]),
    ]
    .concat();
    for piece in bytes.chunks(5) {
        adapter.write_all(piece).unwrap();
    }
    let records = until_frame(&device, "124#0102030405060708");
    assert_eq!(frames(&records), ["123#AA", "1ABC0001#", "124#0102030405060708"]);
    assert_eq!(losses(&records), [("link", 1), ("link", 1)]);
    let times: Vec<i64> =
        records.iter().filter(|record| record.frame().is_some()).map(|record| record.time_ns).collect();
    // 1000 us, to a tick or two, and to how much earlier a later frame arrived while the clock settles.
    assert!((times[2] - times[0]).abs_diff(1_000_000) < 1_000_000, "{times:?}");
    device.stop().unwrap();
}

/// A frame of a bus with CAN FD, as the adapter sends it.
fn received_fd(time_us: u32, id: u32, bus: u8, data: &[u8]) -> Vec<u8> {
    let head = [&[0xF1, 20][..], &time_us.to_le_bytes(), &id.to_le_bytes(), &[data.len() as u8, bus]];
    [&head.concat()[..], data, &[0]].concat()
}

/// The address says that the bus runs CAN FD; what no frame can be is a loss, and a bus that there is not is counted.
#[test]
fn frames_of_a_bus_with_can_fd_are_read_if_the_address_has_its_data_bit_rate() {
    let (address, streams, seen) = start(true);
    let device = open(&format!("{address}?data-bitrate=2M"));
    let mut adapter = streams.recv().unwrap();
    assert_eq!(device.hello().board, "gvret-fd");
    device.join(Channel::Can2, 500_000).unwrap();
    let data: Vec<u8> = (0xC0..=0xFF).collect();
    let bytes = [
        received_fd(1000, 0x98DA_F110, 1, &data),
        received_fd(1100, 0x123, 1, &[0x5A]),
        // Nine bytes, an identifier of twelve bits, a bus that there is not, a length that lies.
        received_fd(1200, 0x123, 1, &[0; 9]),
        received_fd(1300, 0x800, 1, &[1]),
        received_fd(1400, 0x123, 7, &[1]),
        received_fd(1500, 0x124, 255, &[1]),
        received(1600, 0x125, 1, &[0xA5]),
    ]
    .concat();
    for piece in bytes.chunks(7) {
        adapter.write_all(piece).unwrap();
    }
    let records = until_frame(&device, "125#A5");
    let long = data.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat();
    assert_eq!(frames(&records), [format!("18DAF110##1{long}"), "123##15A".to_owned(), "125#A5".to_owned()]);
    assert_eq!(losses(&records), [("link", 1), ("link", 1)]);
    let failures = device.failures().unwrap();
    assert!(failures.last.contains("2 frames of a third or higher bus"), "{failures:?}");
    // Cut in the middle, and nothing more: that is no frame, and its end ends the session.
    adapter.write_all(&received_fd(1700, 0x126, 1, &data)[..40]).unwrap();
    adapter.shutdown(std::net::Shutdown::Both).unwrap();
    let rest: Vec<_> = device.records().collect();
    assert!(
        rest.iter().all(|record| record.as_ref().map_or(true, |record| record.frame().is_none())),
        "{rest:?}"
    );
    // None is sent: what the adapter would make of it is not known.
    assert!(!device.hello().sends_fd());
    drop(seen);
}

/// Half a message, and then whole ones: no frame is made of bytes of two.
#[test]
fn no_frame_is_made_of_the_pieces_of_two() {
    let (address, streams, _seen) = start(true);
    let device = open(&address);
    let mut adapter = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    let whole = received(1000, 0x123, 0, &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]);
    for cut in 11..whole.len() {
        let next = received(2000 + cut as u32, 0x200 + cut as u32, 0, &[0x99; 8]);
        adapter.write_all(&[&whole[..cut], &next, &received(3000, 0x7FF, 0, &[])].concat()).unwrap();
        let records = until_frame(&device, "7FF#");
        let expected = [format!("{:03X}#9999999999999999", 0x200 + cut), "7FF#".to_owned()];
        assert_eq!(frames(&records), expected, "{cut}");
        assert_eq!(losses(&records), [("link", 1)], "{cut}");
    }
}

/// A clock that stands still, goes back and leaps: each frame is there, in order, and no later than it arrived.
#[test]
fn absurd_stamps_cost_no_frame_and_are_counted() {
    let (address, streams, _seen) = start(true);
    let device = open(&address);
    let mut adapter = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    let stamps: [fn(u32) -> u32; 4] = [
        |_| 7_000_000,
        |number| 90_000_000 - number * 100,
        |number| number.wrapping_mul(2_654_435_761),
        |number| if number.is_multiple_of(2) { u32::MAX } else { 0 },
    ];
    let mut last = i64::MIN;
    for (kind, stamp) in (1..).zip(stamps) {
        for number in 0..60 {
            std::thread::sleep(std::time::Duration::from_millis(1));
            adapter.write_all(&received(stamp(number), 0x100 * kind + number, 0, &[])).unwrap();
        }
        let records = until_frame(&device, &format!("{:03X}#", 0x100 * kind + 59));
        let expected: Vec<String> = (0..60).map(|number| format!("{:03X}#", 0x100 * kind + number)).collect();
        assert_eq!(frames(&records), expected);
        let now = std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap().as_nanos() as i64;
        // They have been placed in this computer's time, and are no clock of a device's any more.
        assert!(records.iter().all(|record| record.device_ns.is_none()), "{records:?}");
        for time_ns in records.iter().filter(|record| record.frame().is_some()).map(|record| record.time_ns) {
            assert!(time_ns >= last && time_ns <= now, "{time_ns} after {last}, before {now}");
            last = time_ns;
        }
    }
    let failures = device.failures().unwrap().last;
    assert!(failures.contains("stamps that stand still or go back"), "{failures}");
    assert!(failures.contains("stamps that contradict their arrival"), "{failures}");
    assert_eq!(device.counters().channels[0].lost(), 0);
}

#[test]
fn one_that_does_not_listen_silently_is_not_left_open() {
    let (address, _streams, seen) = start(false);
    let device = open(&address);
    let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
    assert!(matches!(refused, DeviceError::Refused { refusal: Refusal::Unsupported }), "{refused}");
    let off = Seen::Buses([1 << 31; 2]);
    // It is tried, and then off again, which the adapter may learn only after the refusal.
    assert!(seen.iter().any(|set| set != off));
    assert_eq!(seen.iter().next(), Some(off));
    device.join(Channel::Can1, 500_000).unwrap();
}

#[test]
fn a_frame_is_handed_over_and_one_that_cannot_be_is_reported_as_not_sent() {
    let (address, _streams, seen) = start(true);
    let device = open(&address);
    device.join(Channel::Can1, 500_000).unwrap();
    assert_eq!(send(&device, "1ABCDEF0#1122").result.unwrap().to_string(), "1ABCDEF0#1122");
    let sent = seen.iter().find(|seen| matches!(seen, Seen::Frame(_))).unwrap();
    assert_eq!(sent, Seen::Frame(vec![0xF0, 0xDE, 0xBC, 0x9A, 0, 2, 0x11, 0x22, 0]));
    assert!(send(&device, "123#R").result.is_err());
}

#[test]
fn a_connection_that_ends_ends_the_session_with_its_reason() {
    let (address, streams, _seen) = start(true);
    let device = open(&address);
    let mut adapter = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    adapter.write_all(&received(1, 1, 0, &[])).unwrap();
    adapter.shutdown(std::net::Shutdown::Both).unwrap();
    let records: Vec<_> = device.records().collect();
    // It counts no losses, which its stream begins with.
    assert_eq!(records[0].as_ref().unwrap().event, TraceEvent::UNCOUNTED);
    assert_eq!(records[1].as_ref().unwrap().frame().unwrap().to_string(), "001#");
    let error = records.last().unwrap().as_ref().unwrap_err();
    assert!(matches!(error, DeviceError::Vanished { .. }), "{error}");
}

#[test]
fn one_that_says_something_else_without_an_end_is_not_waited_for() {
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let place: cantap_adapters::Place =
        format!("gvret:tcp://{}", server.local_addr().unwrap()).parse().unwrap();
    let babbler = std::thread::spawn(move || {
        let (mut stream, _) = server.accept().unwrap();
        while stream.write_all(&[0xF1, 0, 0xFF, 0xF1, 0x30]).is_ok() {}
    });
    assert!(matches!(cantap_adapters::open(&place), Err(cantap_adapters::OpenError::Foreign { .. })));
    babbler.join().unwrap();
}

/// An adapter on a serial port, which answers nothing any more once it stalls.
#[cfg(unix)]
fn on_a_port(stalls: &std::sync::Arc<std::sync::atomic::AtomicBool>) -> crate::port::Port {
    let stalls = std::sync::Arc::clone(stalls);
    let (mut bytes, mut buses) = (Vec::<u8>::new(), [0; 2]);
    crate::port::Port::start(move |byte| {
        if stalls.load(std::sync::atomic::Ordering::Relaxed) {
            return Vec::new();
        }
        bytes.push(byte);
        let &[0xF1, command, ref rest @ ..] = &bytes[..] else {
            if bytes != [0xF1] {
                bytes.clear();
            }
            return Vec::new();
        };
        if command == 5 && rest.len() < 8 {
            return Vec::new();
        }
        if let Some((settings, [])) = rest.split_first_chunk::<8>() {
            buses = [0, 4].map(|at| u32::from_le_bytes(settings[at..at + 4].try_into().unwrap()));
        }
        bytes.clear();
        answer(command, buses, true).unwrap_or_default()
    })
}

/// The same on a serial port: set to listen, heard, and pulled out.
#[cfg(unix)]
#[test]
fn on_a_serial_port_it_is_the_same() {
    let port = on_a_port(&std::sync::Arc::default());
    let device = open(&format!("gvret:{}", port.path));
    device.listen(Channel::Can1, 500_000).unwrap();
    port.says(received(1000, 0x123, 0, &[0xAA]));
    until_frame(&device, "123#AA");
    // Half a frame, and babbling behind it.
    port.says(
        [&received(2000, 0x124, 0, &[0xBB; 8])[..9], &[0xC8; 4096], &received(3000, 0x7FF, 0, &[])].concat(),
    );
    let records = until_frame(&device, "7FF#");
    assert_eq!(frames(&records), ["7FF#"]);
    assert!((1..100).contains(&losses(&records).len()), "{:?}", losses(&records));
    port.pull();
    let end = device.records().find_map(Result::err).unwrap();
    assert!(matches!(end, DeviceError::Vanished { .. }), "{end}");
}

/// Whether its channel is being opened or is open.
#[cfg(unix)]
#[test]
fn one_that_stalls_is_refused_or_waited_for_and_holds_up_nothing() {
    for options in ["", "?data-bitrate=2M"] {
        let stalls = std::sync::Arc::default();
        let port = on_a_port(&stalls);
        let device = open(&format!("gvret:{}{options}", port.path));
        stalls.store(true, std::sync::atomic::Ordering::Relaxed);
        let refused = device.listen(Channel::Can1, 500_000).unwrap_err();
        assert!(matches!(refused, DeviceError::Refused { refusal: Refusal::Hardware }), "{refused}");
        device.status().unwrap();
        stalls.store(false, std::sync::atomic::Ordering::Relaxed);
        device.listen(Channel::Can1, 500_000).unwrap();
        stalls.store(true, std::sync::atomic::Ordering::Relaxed);
        // The rest of a frame comes late, and is that frame.
        let frame = received(1000, 0x123, 0, &[0xAA; 4]);
        port.says(&frame[..8]);
        device.status().unwrap();
        port.says(&frame[8..]);
        assert_eq!(frames(&until_frame(&device, "123#AAAAAAAA")), ["123#AAAAAAAA"]);
        // It does not answer when it is closed either.
        device.stop().unwrap();
    }
}

/// With a data bit rate, too, and while its channel is open.
#[test]
fn babbling_of_one_with_can_fd_is_losses_and_holds_up_nothing() {
    let (address, streams, _seen) = start(true);
    let device = open(&format!("{address}?data-bitrate=2M"));
    let mut adapter = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    let mut number = 1u32;
    let babble = std::iter::repeat_with(|| {
        number = number.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (number >> 24) as u8 & 0x7F
    });
    adapter.write_all(&babble.take(1 << 20).collect::<Vec<_>>()).unwrap();
    // What hides in it ends before this.
    adapter.write_all(&[0; 200]).unwrap();
    adapter.write_all(&received(1000, 0x7FF, 0, &[0xA5])).unwrap();
    let records = until_frame(&device, "7FF#A5");
    assert_eq!(frames(&records), ["7FF#A5"]);
    assert!((1..1000).contains(&losses(&records).len()), "{}", losses(&records).len());
    assert!(device.failures().unwrap().last.contains("bytes that are no message"));
}
