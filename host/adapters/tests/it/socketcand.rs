//! A socketcand server, as its protocol's description and its raw mode have it.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};

use cantap::Channel;
use cantap::wire::message::capability;
use cantap_adapters::OpenError;

use crate::{frames, losses, open, send, until_frame};

/// Serves one client with this interface; passes on its messages.
fn start(interface: &'static str) -> (String, Receiver<TcpStream>, Receiver<String>) {
    let server = TcpListener::bind("127.0.0.1:0").unwrap();
    let place = server.local_addr().unwrap().to_string();
    let (to_test, streams) = channel();
    let (report, messages) = channel();
    std::thread::spawn(move || {
        let (mut stream, _) = server.accept().unwrap();
        to_test.send(stream.try_clone().unwrap()).unwrap();
        stream.write_all(b"< hi >").unwrap();
        let (mut message, mut byte) = (String::new(), [0]);
        while stream.read_exact(&mut byte).is_ok() {
            message.push(char::from(byte[0]));
            if byte[0] != b'>' {
                continue;
            }
            let answer = match message.as_str() {
                "< rawmode >" => "< ok >",
                open if open == format!("< open {interface} >") => "< ok >",
                open if open.starts_with("< open") => "< error could not open bus >",
                _ => "",
            };
            let _ = report.send(std::mem::take(&mut message));
            stream.write_all(answer.as_bytes()).unwrap();
        }
    });
    (place, streams, messages)
}

#[test]
fn frames_come_and_go_and_what_cannot_be_read_is_a_loss() {
    let (place, streams, messages) = start("can0");
    let device = open(&format!("socketcand://{place}/can0"));
    let mut server = streams.recv().unwrap();
    assert_ne!(device.hello().capabilities & capability::NO_BIT_RATE, 0);
    device.join(Channel::Can1, 500_000).unwrap();
    // Without data there are two blanks.
    for piece in [
        "< frame 123 1700000000.000100 1122 >< frame 00000123 1700000000.000200  ><",
        " frame 124 17000",
        "00000.000300  >< frame 999999999 1 00 >< frame 1 1 001 >",
    ] {
        server.write_all(piece.as_bytes()).unwrap();
    }
    server.write_all(format!("< {} ", "x".repeat(100_000)).as_bytes()).unwrap();
    server.write_all(b"< frame 7FF 1700000000.1 FF >").unwrap();
    let records = until_frame(&device, "7FF#FF");
    assert_eq!(frames(&records), ["123#1122", "00000123#", "124#", "7FF#FF"]);
    assert_eq!(losses(&records), [("link", 1); 3]);
    assert_eq!(send(&device, "5A1#0102").result.unwrap().to_string(), "5A1#0102");
    assert_eq!(messages.iter().nth(2).unwrap(), "< send 5A1 2 01 02 >");
    assert!(send(&device, "123#R").result.is_err());
}

/// No bytes are left out in silence: those between messages, and a message in which the next begins.
#[test]
fn what_is_no_message_is_a_loss_each_time_and_stamps_that_stand_still_are_not_believed() {
    let (place, streams, _messages) = start("can0");
    let device = open(&format!("socketcand://{place}/can0"));
    let mut server = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    server.write_all(b"< frame 1 1.0 >rubbish frame 2 2.0 >< frame 3 1.1< frame 4 1.2 >\n\n").unwrap();
    assert_eq!(losses(&until_frame(&device, "004#")), [("link", 1); 2]);
    let mut times = Vec::new();
    for id in 0x100..0x110 {
        std::thread::sleep(std::time::Duration::from_millis(10));
        server.write_all(format!("< frame {id:X} 1.2 >").as_bytes()).unwrap();
        times.extend(until_frame(&device, &format!("{id:X}#")).iter().map(|record| record.time_ns));
    }
    assert!(times.is_sorted(), "{times:?}");
    // The first 20 ms are believed.
    assert!(times[15] - times[0] >= 100_000_000, "{times:?}");
    let failures = device.failures().unwrap().last;
    assert!(failures.contains("stamps that stand still or go back"), "{failures}");
    assert!(
        failures.contains("1 bytes outside of messages") && failures.contains("1 messages without an end"),
        "{failures}"
    );
}

#[test]
fn an_interface_that_is_not_there_is_refused() {
    let (place, _streams, _messages) = start("can0");
    let place: cantap_adapters::Place = format!("socketcand://{place}/can7").parse().unwrap();
    assert!(matches!(cantap_adapters::open(&place), Err(OpenError::Refused { .. })));
}

/// Silence at each step is no refusal, and is not waited for without an end.
#[test]
fn one_that_stalls_while_it_is_opened_is_said_not_to_answer() {
    for greeting in ["", "< hi >", "< hi >< ok >"] {
        let server = TcpListener::bind("127.0.0.1:0").unwrap();
        let place: cantap_adapters::Place =
            format!("socketcand://{}/can0", server.local_addr().unwrap()).parse().unwrap();
        let stalls = std::thread::spawn(move || {
            let (mut stream, _) = server.accept().unwrap();
            stream.write_all(greeting.as_bytes()).unwrap();
            // Until it is given up.
            let _ = stream.read_to_end(&mut Vec::new());
        });
        let error = cantap_adapters::open(&place).err().unwrap();
        assert!(matches!(error, OpenError::Foreign { .. }), "{greeting}: {error}");
        stalls.join().unwrap();
    }
}

#[test]
fn pulled_out_it_ends_with_a_reason_and_nothing_captured_is_lost() {
    let (place, streams, _messages) = start("can0");
    let device = open(&format!("socketcand://{place}/can0"));
    let mut server = streams.recv().unwrap();
    device.listen(Channel::Can1, 500_000).unwrap();
    server.write_all(b"< frame 123 1.0 11 >< frame 124 1.1 22 >< frame 12").unwrap();
    server.shutdown(std::net::Shutdown::Both).unwrap();
    let records: Vec<_> = device.records().collect();
    let frames = records.iter().flatten().filter_map(|record| Some(record.frame()?.to_string()));
    assert_eq!(frames.collect::<Vec<_>>(), ["123#11", "124#22"]);
    let end = records.last().unwrap().as_ref().unwrap_err();
    assert!(matches!(end, cantap::DeviceError::Vanished { .. }), "{end}");
}
