//! `cantap virtual` as any program sees it: a serial port that loses nothing and keeps nothing for the next program.
#![cfg(unix)]

use std::io::{ErrorKind, Read, Write};
use std::time::{Duration, Instant};

use cantap::wire::framing::{self, CRC_LEN, MAX_REQUEST, max_encoded_len};
use cantap::wire::message::ChannelConfig;
use cantap::wire::{BitTiming, Channel, Command, Decoded, Decoder, PROTOCOL_VERSION, Request};
use cantap_virtual::open_terminal;
use serialport::{SerialPort, TTYPort};

/// Nothing here takes this long, however busy the machine is.
const PATIENCE: Duration = Duration::from_mins(1);

fn open(path: &str) -> TTYPort {
    serialport::new(path, 115_200).timeout(Duration::from_millis(20)).open_native().unwrap()
}

fn request(id: u16, command: Command) -> Vec<u8> {
    let (mut message, mut out) = ([0; MAX_REQUEST + CRC_LEN], vec![0; max_encoded_len(MAX_REQUEST)]);
    let len = framing::encode(&Request { id, command }, &mut message, &mut out).unwrap();
    out.truncate(len);
    out
}

fn hello(id: u16) -> Vec<u8> {
    [vec![0], request(id, Command::Hello { protocol: PROTOCOL_VERSION })].concat()
}

/// The first `count` answers' numbers, in order.
fn answers(port: &mut impl Read, decoder: &mut Decoder, count: usize) -> Vec<u16> {
    let mut ids = Vec::new();
    let started = Instant::now();
    let mut bytes = [0; 4096];
    while ids.len() < count {
        assert!(started.elapsed() < PATIENCE, "{} of {count} answers", ids.len());
        match port.read(&mut bytes) {
            Ok(len) => decoder.push(&bytes[..len], |decoded| {
                if let Decoded::Response(response) = decoded {
                    ids.push(response.id);
                }
            }),
            Err(error) => assert_eq!(error.kind(), ErrorKind::TimedOut),
        }
    }
    ids
}

#[test]
fn requests_that_a_program_writes_before_it_reads_are_all_answered() {
    let terminal = open_terminal("load=0".parse().unwrap()).unwrap();
    let mut port = open(terminal.path());
    let mut writer = port.try_clone_native().unwrap();
    let mut bytes = hello(0);
    let mut count = 1;
    while bytes.len() < 60 * 1024 {
        bytes.extend(request(count, Command::Time));
        count += 1;
    }
    let writing = std::thread::spawn(move || {
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            match writer.write(rest) {
                Ok(len) => rest = &rest[len..],
                Err(error) => assert_eq!(error.kind(), ErrorKind::TimedOut),
            }
        }
    });
    // Long enough for anyone who waits 50 ms for room to give up.
    std::thread::sleep(Duration::from_millis(500));
    let ids = answers(&mut port, &mut Decoder::new(), usize::from(count));
    assert!(ids.iter().copied().eq(0..count));
    writing.join().unwrap();
}

#[test]
fn nothing_of_a_closed_session_reaches_the_next_program() {
    let _turn = cantap_testing::process::turn();
    let terminal = open_terminal("load=100,frames=std8".parse().unwrap()).unwrap();
    for _ in 0..3 {
        let mut port = open(terminal.path());
        port.write_all(&hello(1)).unwrap();
        answers(&mut port, &mut Decoder::new(), 1);
        let timing = BitTiming::choose(36_000_000, 1_000_000, None).unwrap();
        for channel in Channel::ALL {
            let config = Some(ChannelConfig::listen_only(timing));
            port.write_all(&request(2, Command::Open { channel, config })).unwrap();
        }
        // Until everything on the way is full.
        std::thread::sleep(Duration::from_millis(300));
        assert!(port.bytes_to_read().unwrap() > 0);
        drop(port);
        // Starting the next program takes longer in practice.
        std::thread::sleep(Duration::from_millis(200));
        let mut port = open(terminal.path());
        std::thread::sleep(Duration::from_millis(50));
        let left = port.read(&mut [0; 4096]);
        assert_eq!(left.unwrap_err().kind(), ErrorKind::TimedOut);
    }
}

/// They once waited in the terminal and were carried out or refused when the next program opened it.
#[test]
fn requests_that_a_program_left_unread_are_not_the_next_one_s() {
    let terminal = open_terminal("load=0".parse().unwrap()).unwrap();
    for _ in 0..10 {
        let mut port = open(terminal.path());
        port.write_all(&hello(77)).unwrap();
        assert_eq!(answers(&mut port, &mut Decoder::new(), 1), [77]);
        let left: Vec<u8> = (5000..5050).flat_map(|id| request(id, Command::Time)).collect();
        port.write_all(&left).unwrap();
        drop(port);
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
fn the_first_request_is_answered_however_soon_the_port_is_opened_again() {
    let _turn = cantap_testing::process::turn();
    let terminal = open_terminal("load=100,frames=std8".parse().unwrap()).unwrap();
    let timing = BitTiming::choose(36_000_000, 1_000_000, None).unwrap();
    for id in 0..100 {
        let mut port = open(terminal.path());
        port.write_all(&hello(id)).unwrap();
        let mut decoder = Decoder::new();
        while answers(&mut port, &mut decoder, 1) != [id] {}
        // Left in the middle of everything.
        let config = Some(ChannelConfig::listen_only(timing));
        port.write_all(&request(1000, Command::Open { channel: Channel::Can1, config })).unwrap();
        answers(&mut port, &mut decoder, 1);
        port.write_all(&request(1001, Command::Time)[..5]).unwrap();
        drop(port);
        // From immediately to beyond the time after which a closed port is noticed.
        std::thread::sleep(Duration::from_micros(u64::from(id % 30) * 700));
    }
}
