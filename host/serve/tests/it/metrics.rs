//! What a server counts, and who may ask for it.

use std::io::{Read, Write};
use std::net::TcpStream;

use cantap::Channel;
use cantap::wire::message::Role;
use cantap_serve::listen::Listening;
use cantap_serve::{Settings, metrics};

use crate::strangers::{BITRATE_BPS, any_port, board_at, client};

/// The whole answer to what is asked, in two pieces.
fn ask(server: &Listening, request: &str) -> String {
    let mut stream = TcpStream::connect(server.address().unwrap()).unwrap();
    let (first, rest) = request.split_at(request.len() / 2);
    let _ = stream.write_all(first.as_bytes());
    let _ = stream.write_all(rest.as_bytes());
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    String::from_utf8(answer).unwrap()
}

pub fn scrape(server: &Listening) -> String {
    let host = server.address().unwrap();
    let answer = ask(server, &format!("GET /metrics HTTP/1.1\r\nHost: {host}\r\n\r\n"));
    assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
    answer
}

pub fn figure(text: &str, name: &str) -> u64 {
    let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("{name} in {text}")).parse().unwrap()
}

#[test]
fn clients_and_frames_are_counted() {
    let (board, _told) = board_at(Settings::at(BITRATE_BPS));
    let server = metrics::listen(std::slice::from_ref(&board), any_port()).unwrap();
    let before = scrape(&server);
    assert_eq!(figure(&before, "cantap_board_up{board=\"board\"}"), 1);
    assert_eq!(figure(&before, "cantap_clients{board=\"board\"}"), 0);
    let sender = client(&board, "sender", Role::Send);
    let timing = sender.timing(BITRATE_BPS).unwrap();
    let listen = cantap::wire::message::ChannelConfig::listen_only(timing);
    let mode = cantap::wire::message::Mode::Normal;
    sender
        .open_channel(Channel::Can2, Some(cantap::wire::message::ChannelConfig { mode, ..listen }))
        .unwrap();
    let frame = cantap::wire::message::TxFrame { tag: 1, frame: "123#0011".parse().unwrap(), at_ticks: None };
    sender.send(Channel::Can2, &[frame]).unwrap();
    let mut records = sender.records();
    assert!(records.any(|record| record.is_ok_and(|record| record.frame().is_some())));
    let after = scrape(&server);
    assert_eq!(figure(&after, "cantap_clients{board=\"board\"}"), 1);
    assert_eq!(figure(&after, "cantap_frames_sent_total{board=\"board\",channel=\"2\"}"), 1);
    let bits = u64::from(cantap::bits_on_bus(&frame.frame));
    assert_eq!(figure(&after, "cantap_bus_bits_total{board=\"board\",channel=\"2\"}"), bits);
    assert_eq!(figure(&after, "cantap_bitrate_bps{board=\"board\",channel=\"2\"}"), u64::from(BITRATE_BPS));
    assert_eq!(figure(&after, "cantap_frames_lost_total{board=\"board\",channel=\"2\",stage=\"host\"}"), 0);
}

/// Attacks: other requests, other names, requests without end, and connections that say nothing.
#[test]
fn whoever_asks_for_anything_else_gets_nothing_and_keeps_nobody_out() {
    let (board, _told) = board_at(Settings::at(BITRATE_BPS));
    let server = metrics::listen(std::slice::from_ref(&board), any_port()).unwrap();
    let _silent: Vec<TcpStream> =
        (0..50).map(|_| TcpStream::connect(server.address().unwrap()).unwrap()).collect();
    for (request, status) in [
        ("POST /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n", "HTTP/1.1 405 "),
        ("GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", "HTTP/1.1 404 "),
        ("GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n", "HTTP/1.1 421 "),
        ("< open can0 >< send 123 0 >\r\n\r\n", "HTTP/1.1 400 "),
    ] {
        let answer = ask(&server, request);
        assert!(answer.starts_with(status) && !answer.contains("cantap_"), "{request}: {answer}");
    }
    let endless = format!("GET /metrics HTTP/1.1\r\nHost: localhost\r\nX: {}", "x".repeat(100_000));
    assert_eq!(ask(&server, &endless), "");
    scrape(&server);
}
