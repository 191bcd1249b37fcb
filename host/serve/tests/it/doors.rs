//! The doors for protocols that are not ours admit clients by the same rules: what a crowd, a dawdler and a stranger get at each of them.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cantap::wire::message::Role;
use cantap::{Channel, TraceEvent};
use cantap_codecs::cannelloni::put;
use cantap_serve::listen::Listening;
use cantap_serve::{Board, News, Settings, cannelloni_tcp, gvret, socketcand};

use crate::strangers::{BITRATE_BPS, any_port, board_at, client, headers};

/// A kind of door.
struct Kind {
    open: fn(&Arc<Board>, SocketAddr) -> std::io::Result<Listening>,
    /// What a client says first, and the end of what it hears then.
    greeting: &'static [u8],
    answer: &'static [u8],
    /// What is said before any client has said anything.
    first: &'static [u8],
    /// Has a frame sent once the greeting was said.
    frame: Vec<u8>,
}

fn kinds() -> [Kind; 3] {
    let mut frame = Vec::new();
    put(&"6A5#BEEF".parse().unwrap(), &mut frame);
    [
        Kind {
            open: |board, at| gvret::listen(std::slice::from_ref(board), at, Role::Send),
            greeting: &[0xE7, 0xE7, 0xF1, 9],
            answer: &[0xF1, 9, 0xDE, 0xAD],
            first: b"",
            frame: vec![0xF1, 0, 0xA5, 6, 0, 0, 0, 2, 0xBE, 0xEF, 0],
        },
        Kind {
            open: |board, at| cannelloni_tcp::listen(board, Channel::Can1, at, Role::Send),
            greeting: b"CANNELLONIv1",
            answer: b"CANNELLONIv1",
            first: b"",
            frame,
        },
        Kind {
            open: |board, at| socketcand::listen(std::slice::from_ref(board), at, Role::Send),
            greeting: b"< open can0 >",
            answer: b"< ok >",
            first: b"< hi >",
            frame: b"< send 6A5 2 BE EF >".to_vec(),
        },
    ]
}

fn board() -> (Arc<Board>, Receiver<News>) {
    board_at(Settings { most_clients: 4, ..Settings::at(BITRATE_BPS) })
}

fn dial(server: &Listening) -> TcpStream {
    let stream = TcpStream::connect(server.address().unwrap()).unwrap();
    stream.set_read_timeout(Some(Duration::from_mins(1))).unwrap();
    stream
}

/// Everything until the server ends the connection.
fn rest(stream: &mut TcpStream) -> Vec<u8> {
    let mut heard = Vec::new();
    // Ended or cut off.
    let _ = stream.read_to_end(&mut heard);
    heard
}

fn hears(stream: &mut TcpStream, wanted: &[u8]) {
    let (mut heard, mut bytes) = (Vec::new(), [0; 64]);
    while !heard.ends_with(wanted) {
        let len = stream.read(&mut bytes).unwrap();
        assert_ne!(len, 0, "{}", String::from_utf8_lossy(&heard));
        heard.extend_from_slice(&bytes[..len]);
    }
}

#[test]
fn a_crowd_that_only_begins_to_greet_keeps_nobody_out() {
    for kind in kinds() {
        let (board, _told) = board();
        let server = (kind.open)(&board, any_port()).unwrap();
        let crowd: Vec<TcpStream> = (0..50)
            .map(|_| {
                let mut stream = dial(&server);
                // It may have been let go for the next one already.
                let _ = stream.write_all(&kind.greeting[..kind.greeting.len() - 2]);
                stream
            })
            .collect();
        let mut good = dial(&server);
        good.write_all(kind.greeting).unwrap();
        hears(&mut good, kind.answer);
        drop(crowd);
    }
}

/// However it stretches its greeting.
#[test]
fn one_that_greets_a_byte_at_a_time_is_gone_before_the_end_of_it() {
    for kind in &kinds()[..2] {
        let (board, _told) = board();
        let server = (kind.open)(&board, any_port()).unwrap();
        let mut dawdler = dial(&server);
        let (last, before) = kind.greeting.split_last().unwrap();
        for byte in before {
            let _ = dawdler.write_all(&[*byte]);
            std::thread::sleep(Duration::from_secs(6) / before.len() as u32);
        }
        let _ = dawdler.write_all(&[*last]);
        assert_eq!(rest(&mut dawdler), b"");
    }
}

/// A page of another origin, by whatever name it reaches this computer; mail, SSH and TLS at a wrong port; and garbage.
#[test]
fn nothing_behind_anything_else_than_a_greeting_is_sent() {
    for kind in kinds() {
        let (board, _told) = board();
        let server = (kind.open)(&board, any_port()).unwrap();
        let listener = client(&board, "listener", Role::Listen);
        listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
        let body = [kind.greeting, &kind.frame].concat();
        for header in headers(&body) {
            for pause in [Duration::ZERO, Duration::from_millis(20)] {
                let mut stream = dial(&server);
                // Either way it may be cut off meanwhile.
                let _ = stream.write_all(&header);
                std::thread::sleep(pause);
                let _ = stream.write_all(&body);
                let heard = rest(&mut stream);
                assert!(heard.is_empty() || heard == kind.first, "{}", String::from_utf8_lossy(&heard));
            }
        }
        let mut good = dial(&server);
        good.write_all(kind.greeting).unwrap();
        hears(&mut good, kind.answer);
        good.write_all(&kind.frame).unwrap();
        // The first frame on the bus, and the only one.
        let is_frame = |event: &TraceEvent| matches!(event, TraceEvent::Frame { .. });
        let mut frames = listener.records().map(Result::unwrap).filter(|record| is_frame(&record.event));
        assert_eq!(frames.next().unwrap().frame().unwrap().to_string(), "6A5#BEEF");
        listener.stop().unwrap();
        assert_eq!(frames.count(), 0);
    }
}

#[test]
fn a_port_is_one_server_s_and_free_again_after_it() {
    for kind in kinds() {
        let (board, _told) = board();
        let first = (kind.open)(&board, any_port()).unwrap();
        let at = first.address().unwrap();
        let second = (kind.open)(&board, at);
        assert_eq!(second.err().map(|error| error.kind()), Some(std::io::ErrorKind::AddrInUse));
        drop(first);
        (kind.open)(&board, at).unwrap();
    }
}
