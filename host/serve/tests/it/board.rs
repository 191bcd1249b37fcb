//! What a server expects of the board that it shares.

use cantap::device::{Link, PipeReader, PipeWriter, pipe};
use cantap::responder::{Inbox, Incoming, StreamEncoder, encode_response};
use cantap::wire::{Command, Hello, PROTOCOL_VERSION, Refusal, Reply};
use cantap::{DeviceError, device};
use cantap_serve::{Board, BoardError, Settings};
use std::io::Read;
use std::time::Duration;

fn hello() -> Hello {
    Hello {
        protocol: PROTOCOL_VERSION,
        firmware: [1, 2, 3],
        board: "fake".try_into().unwrap(),
        serial: "0001".try_into().unwrap(),
        channels: 2,
        tick_hz: 12_000_000,
        can_clock_hz: 36_000_000,
        queue_bytes: 98_304,
        tx_queue: 256,
        periodic_slots: 32,
        trigger_slots: 8,
        filter_banks: 28,
        capabilities: 0,
    }
}

/// Answers like a board that describes itself so, until the host is gone.
fn answer(hello: &Hello, mut input: PipeReader, mut output: PipeWriter) {
    let (mut inbox, mut stream) = (Inbox::default(), StreamEncoder::new());
    let mut bytes = [0; 512];
    loop {
        let len = match input.read(&mut bytes) {
            Ok(0) => return,
            Ok(len) => len,
            Err(error) if device::is_idle(&error) => 0,
            Err(error) => panic!("{error}"),
        };
        inbox.push(&bytes[..len], |incoming| {
            let Incoming::Request(request) = incoming else { return };
            let result = match request.command {
                Command::Hello { .. } => Ok(Reply::Hello(hello.clone())),
                Command::Time => Ok(Reply::Time(1)),
                Command::Defaults { .. } => Err(Refusal::NothingSaved),
                Command::Close { .. } => Ok(Reply::Done),
                _ => Err(Refusal::Unsupported),
            };
            stream.answer(&encode_response(request.id, &result));
        });
        if device::write_patiently(&mut output, stream.bytes(), Duration::MAX).is_err() {
            return;
        }
        stream.clear_bytes();
    }
}

fn start(hello: &Hello) -> Result<Board, BoardError> {
    let hello = hello.clone();
    let connect = Box::new(move |_: Option<&str>| {
        let (reader, output) = pipe(1 << 16);
        let (input, writer) = pipe(1 << 16);
        let hello = hello.clone();
        std::thread::spawn(move || answer(&hello, input, output));
        Ok(Link::new(reader, writer))
    });
    Board::start("fake", connect, Settings::default(), |_| {})
}

/// Times and loads are computed from what a board says of itself: the server refuses what cannot be, as a program does that has the board
/// to itself.
#[test]
fn a_board_that_says_impossible_things_of_itself_is_not_shared() {
    assert_eq!(start(&hello()).unwrap().hello(), Some(hello()));
    let Err(error) = start(&Hello { tick_hz: 0, ..hello() }) else { panic!("it is shared") };
    assert!(matches!(error, BoardError::Device(DeviceError::Impossible { .. })), "{error}");
}
