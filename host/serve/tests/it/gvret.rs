//! GVRET over TCP: what SavvyCAN sends (`connections/gvretserial.cpp`), byte for byte, and what strangers send.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cantap::wire::message::{ChannelConfig, Mode, Role, TxFrame};
use cantap::{Channel, Device, TraceEvent};
use cantap_codecs::gvret::{Bus, Command, Message, message};
use cantap_serve::listen::Listening;
use cantap_serve::{Board, News, Settings, gvret};

use crate::strangers::{BITRATE_BPS, any_port, board_at, client};

/// `GVRetSerial::deviceConnected`.
const GREETING: [u8; 12] = [0xE7, 0xE7, 0xF1, 0x0C, 0xF1, 0x06, 0xF1, 0x07, 0xF1, 0x01, 0xF1, 0x09];

struct Program {
    stream: TcpStream,
    bytes: Vec<u8>,
}

impl Program {
    fn connect(server: &Listening) -> Self {
        let stream = TcpStream::connect(server.address().unwrap()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        Self { stream, bytes: Vec::new() }
    }

    fn write(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).unwrap();
    }

    fn ask(&mut self, command: Command) -> Message {
        let mut bytes = Vec::new();
        command.put(&mut bytes);
        self.write(&bytes);
        self.next()
    }

    /// The next message.
    fn next(&mut self) -> Message {
        loop {
            if let Some((message, len)) = message(&self.bytes) {
                self.bytes.drain(..len);
                return message;
            }
            let mut bytes = [0; 4096];
            let len = self.stream.read(&mut bytes).unwrap();
            assert!(len > 0, "the server has ended the connection");
            self.bytes.extend_from_slice(&bytes[..len]);
        }
    }

    /// Everything until the server ends the connection.
    fn rest(mut self) -> Vec<u8> {
        let mut rest = Vec::new();
        let _ = self.stream.read_to_end(&mut rest);
        rest
    }
}

fn listening(most: Role) -> (Arc<Board>, Receiver<News>, Listening) {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let server = gvret::listen(std::slice::from_ref(&board), any_port(), most).unwrap();
    (board, told, server)
}

fn on_the_bus(board: &Board, channel: Channel) -> Device {
    let device = client(board, "local", Role::Send);
    let timing = device.timing(BITRATE_BPS).unwrap();
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
    device.open_channel(channel, Some(config)).unwrap();
    device
}

fn send(device: &Device, channel: Channel, frame: &str) {
    let frame = TxFrame { tag: 1, frame: frame.parse().unwrap(), at_ticks: None };
    device.send(channel, &[frame]).unwrap();
}

fn tells(told: &Receiver<News>, wanted: &str) {
    let mut others = Vec::new();
    let is_it = |news: News| {
        others.push(news.to_string());
        news.to_string().contains(wanted)
    };
    assert!(told.iter().any(is_it), "{wanted}: {others:?}");
}

#[test]
fn savvycan_connects_and_sees_what_is_on_both_buses() {
    let (board, _told, server) = listening(Role::Listen);
    let mut program = Program::connect(&server);
    program.write(&GREETING);
    let bus = Bus { is_on: true, only_listens: true, bitrate_bps: BITRATE_BPS };
    assert_eq!(program.next(), Message::Number(2));
    assert_eq!(program.next(), Message::Buses([bus; 2]));
    assert!(matches!(program.next(), Message::Info { build: 343.. }));
    let Message::Time(synchronised_us) = program.next() else { panic!("no time") };
    assert_eq!(program.next(), Message::Alive);
    assert_eq!(program.ask(Command::GetFurtherBuses), Message::Other);
    let local = on_the_bus(&board, Channel::Can1);
    let second = on_the_bus(&board, Channel::Can2);
    send(&local, Channel::Can1, "123#1122");
    let mut stamps = Vec::new();
    let mut frame = |program: &mut Program| match program.next() {
        Message::Frame { stamp_us, bus, frame } => {
            stamps.push(stamp_us);
            (bus, frame.to_string())
        }
        other => panic!("{other:?}"),
    };
    assert_eq!(frame(&mut program), (0, "123#1122".to_owned()));
    // There are no remote frames in the protocol: the next one is the next that there is a message for.
    send(&second, Channel::Can2, "7FF#R4");
    send(&second, Channel::Can2, "1ABCDEF0#0102030405060708");
    assert_eq!(frame(&mut program), (1, "1ABCDEF0#0102030405060708".to_owned()));
    // Stamps have the clock that was asked for, in the order of the bus.
    assert!(stamps.windows(2).all(|pair| pair[1].wrapping_sub(pair[0]) < 60_000_000), "{stamps:?}");
    assert!(stamps[0].wrapping_sub(synchronised_us) < 60_000_000, "{stamps:?} {synchronised_us}");
}

#[test]
fn what_the_protocol_has_no_message_for_is_counted_and_said() {
    let (board, told, server) = listening(Role::Listen);
    let mut program = Program::connect(&server);
    assert_eq!(program.ask(Command::KeepAlive), Message::Alive);
    let local = on_the_bus(&board, Channel::Can1);
    for frame in ["123#R4", "124#R0", "125#"] {
        send(&local, Channel::Can1, frame);
    }
    // The change of mode by the other client is a gap, and it was on the bus before the frame.
    assert!(matches!(program.next(), Message::Frame { .. }));
    drop(program);
    let mut all = String::new();
    while !all.contains("2 remote frames") {
        let Ok(news) = told.recv_timeout(Duration::from_secs(20)) else { panic!("{all}") };
        all += &news.to_string();
    }
    assert!(all.contains("was not told of"), "{all}");
}

#[test]
fn sending_takes_the_right_to_and_the_sender_does_not_hear_itself() {
    let (board, told, server) = listening(Role::Send);
    let other = client(&board, "other", Role::Listen);
    other.listen(Channel::Can2, BITRATE_BPS).unwrap();
    let mut program = Program::connect(&server);
    let Message::Buses([_, bus]) = program.ask(Command::GetBuses) else { panic!("no buses") };
    assert_eq!(bus, Bus { is_on: true, only_listens: false, bitrate_bps: BITRATE_BPS });
    // `GVRetSerial::piSendFrame`: on the second bus.
    program.write(&[0xF1, 0, 0x23, 1, 0, 0, 1, 2, 0xAA, 0xBB, 0]);
    let seen = other.records().map(Result::unwrap).find_map(|record| match record.event {
        TraceEvent::Frame { frame, .. } => Some((record.channel, frame.to_string())),
        _ => None,
    });
    assert_eq!(seen, Some((2, "123#AABB".to_owned())));
    assert_eq!(program.ask(Command::KeepAlive), Message::Alive);
    // What is no frame is not sent, and what comes behind it is read.
    program.write(&[&[0xF1, 0, 0x23, 1, 0, 0, 0, 9][..], &[0; 10]].concat());
    tells(&told, "a length that no frame has");
    program.write(&[&[0xF1, 0, 0x23, 1, 0, 0, 0, 12][..], &[0; 13]].concat());
    tells(&told, "a CAN FD frame, which the board cannot send");
    program.write(&[0xF1, 0, 0x23, 1, 0, 0, 3, 0, 0]);
    tells(&told, "bus 3 is not open");
    assert_eq!(program.ask(Command::KeepAlive), Message::Alive);
    // At its own wish it only listens.
    let listens = Bus { is_on: true, only_listens: true, bitrate_bps: BITRATE_BPS };
    let mut command = Vec::new();
    Command::SetBuses([(listens, Some(true)); 2]).put(&mut command);
    // The zero that SavvyCAN sends behind it.
    command.push(0);
    program.write(&command);
    assert_eq!(program.ask(Command::GetBuses), Message::Buses([listens; 2]));
    program.write(&[0xF1, 0, 0x23, 1, 0, 0, 1, 0, 0]);
    tells(&told, "opened to listen only");
}

#[test]
fn whoever_may_only_listen_changes_nothing() {
    let (board, told, server) = listening(Role::Listen);
    let other = client(&board, "other", Role::Listen);
    other.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let mut program = Program::connect(&server);
    let is = Bus { is_on: true, only_listens: true, bitrate_bps: BITRATE_BPS };
    let wanted = Bus { bitrate_bps: 250_000, only_listens: false, ..is };
    let mut command = Vec::new();
    Command::SetBuses([(wanted, Some(false)); 2]).put(&mut command);
    program.write(&command);
    tells(&told, "bus 0 stays as it is");
    assert_eq!(program.ask(Command::GetBuses), Message::Buses([is; 2]));
    program.write(&[0xF1, 0, 0x23, 1, 0, 0, 0, 0, 0]);
    tells(&told, "opened to listen only");
    // It may switch off what it does not want to see, and on again.
    for is_on in [false, true] {
        let mut command = Vec::new();
        let second = (Bus { is_on, ..is }, Some(true));
        Command::SetBuses([(is, Some(true)), second]).put(&mut command);
        program.write(&command);
        let Message::Buses([first, second]) = program.ask(Command::GetBuses) else { panic!("no buses") };
        assert_eq!((first.is_on, second.is_on), (true, is_on));
    }
    // The bus is what it was for the others.
    assert_eq!(board.clients(), 2);
    assert!(other.status().unwrap().channels[0].open.is_some_and(|config| config.mode == Mode::ListenOnly));
}

#[test]
fn strangers_are_told_nothing_and_no_garbage_is_skipped() {
    let (board, told, server) = listening(Role::Send);
    let other = client(&board, "other", Role::Listen);
    other.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let frame = [0xF1, 0, 0x23, 1, 0, 0, 0, 1, 0xAA, 0];
    for (stranger, reason) in [
        (&b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n"[..], "it speaks HTTP"),
        (b"GET / HTTP/1.1\r\n\r\n", "it speaks HTTP"),
        (&[0x16, 3, 1, 2, 0], "it speaks TLS"),
        (b"< open can0 >", "it speaks socketcand"),
        (&[0xF1, 99], "it does not begin with this protocol's greeting"),
        (&[0], "it does not begin with this protocol's greeting"),
        (&[0xE7, 0xE7, b'x'], "it does not begin with this protocol's greeting"),
    ] {
        let mut program = Program::connect(&server);
        program.write(&[stranger, &frame].concat());
        let heard = program.rest();
        assert!(heard.is_empty(), "{stranger:?}: {heard:?}");
        tells(&told, reason);
    }
    // Neither after the greeting: data behind garbage must not become a frame on the bus.
    let mut program = Program::connect(&server);
    program.write(&[&[0xF1, 9, 0xAA][..], &frame].concat());
    assert_eq!(program.rest(), [0xF1, 9, 0xDE, 0xAD]);
    tells(&told, "bytes that are no command");
    // And nobody waits for one who says nothing, or greets without an end.
    let silent = Program::connect(&server);
    assert!(silent.rest().is_empty());
    let mut polite = Program::connect(&server);
    for _ in 0..200 {
        if polite.stream.write_all(&[0xE7; 100]).is_err() {
            break;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(polite.rest().is_empty());
    assert!(other.status().unwrap().channels[0].frames == 0);
}

#[test]
fn a_client_that_stops_leaves_its_place_and_the_bus() {
    let (board, _told, server) = listening(Role::Send);
    for _ in 0..40 {
        let mut program = Program::connect(&server);
        assert_eq!(program.ask(Command::KeepAlive), Message::Alive);
        program.stream.shutdown(Shutdown::Both).unwrap();
    }
    let mut program = Program::connect(&server);
    assert_eq!(program.ask(Command::KeepAlive), Message::Alive);
    // The rest is noticed within a fraction of a second each.
    let began = std::time::Instant::now();
    while board.clients() > 1 {
        assert!(began.elapsed() < Duration::from_secs(30), "{}", board.clients());
        std::thread::sleep(Duration::from_millis(20));
    }
}
