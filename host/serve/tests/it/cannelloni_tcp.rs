//! cannelloni's tunnels over TCP: both directions, and what a stranger or a liar gets.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cantap::wire::message::{ChannelConfig, Mode, Role, TxFrame};
use cantap::{Channel, Device, TraceEvent};
use cantap_codecs::cannelloni::{GREETING, Item, Stream, put};
use cantap_serve::listen::Listening;
use cantap_serve::{Board, News, Settings, cannelloni_tcp};

use crate::strangers::{BITRATE_BPS, any_port, board_at, client};

struct Door {
    board: Arc<Board>,
    told: Receiver<News>,
    listening: Listening,
}

fn door(role: Role) -> Door {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let listening = cannelloni_tcp::listen(&board, Channel::Can2, any_port(), role).unwrap();
    Door { board, told, listening }
}

impl Door {
    fn dial(&self) -> TcpStream {
        let stream = TcpStream::connect(self.listening.address().unwrap()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream
    }

    /// A client that has greeted and was greeted.
    fn enter(&self) -> TcpStream {
        let mut stream = self.dial();
        stream.write_all(GREETING).unwrap();
        let mut greeting = [0; 12];
        stream.read_exact(&mut greeting).unwrap();
        assert_eq!(&greeting, GREETING);
        stream
    }

    fn tells(&self, wanted: &str) {
        let mut others = Vec::new();
        let is_it = |news: News| {
            others.push(news.to_string());
            news.to_string().contains(wanted)
        };
        assert!(self.told.iter().any(is_it), "{wanted}: {others:?}");
    }

    /// Another client, which only listens.
    fn another(&self) -> Device {
        let device = client(&self.board, "other", Role::Listen);
        device.listen(Channel::Can2, BITRATE_BPS).unwrap();
        device
    }
}

fn bytes(frames: &[&str]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for frame in frames {
        put(&frame.parse().unwrap(), &mut bytes);
    }
    bytes
}

/// So many frames that a client receives, without error frames.
fn frames(stream: &mut TcpStream, count: usize) -> Vec<String> {
    let (mut read, mut frames) = (Stream::default(), Vec::new());
    // Its greeting was taken before.
    read.push(GREETING);
    let mut bytes = [0; 1024];
    while frames.len() < count {
        let len = stream.read(&mut bytes).unwrap();
        assert_ne!(len, 0, "{frames:?}");
        read.push(&bytes[..len]);
        let take = |item: Item| {
            if let Item::Frame(frame) = item {
                frames.push(frame.to_string());
            }
        };
        read.frames(take).unwrap();
    }
    frames
}

/// The frames on the bus.
fn seen(device: &Device) -> impl Iterator<Item = String> {
    device.records().map(Result::unwrap).filter_map(|record| match record.event {
        TraceEvent::Frame { frame, .. } => Some(frame.to_string()),
        _ => None,
    })
}

#[test]
fn what_is_on_the_bus_comes_out_and_what_a_client_sends_is_on_the_bus() {
    let door = door(Role::Send);
    let (mut far, other) = (door.enter(), door.another());
    let mut seen = seen(&other);
    let sent = ["123#11", "7FF#R4", "1ABCDEF0#0102030405060708", "124#"];
    for piece in bytes(&sent).chunks(3) {
        far.write_all(piece).unwrap();
    }
    assert_eq!([(); 4].map(|()| seen.next().unwrap()), sent);
    // Others' frames are what it hears, and not its own.
    let local = client(&door.board, "local", Role::Send);
    let config = ChannelConfig {
        mode: Mode::Normal,
        ..ChannelConfig::listen_only(local.timing(BITRATE_BPS).unwrap())
    };
    local.open_channel(Channel::Can2, Some(config)).unwrap();
    for frame in ["126#", "127#77"] {
        let frame = TxFrame { tag: 1, frame: frame.parse().unwrap(), at_ticks: None };
        local.send(Channel::Can2, &[frame]).unwrap();
    }
    assert_eq!(frames(&mut far, 2), ["126#", "127#77"]);
}

#[test]
fn one_that_may_only_listen_sends_nothing() {
    let door = door(Role::Listen);
    let mut far = door.enter();
    far.write_all(&bytes(&["123#11"])).unwrap();
    door.tells("not sent: 1 frame: it may only listen");
}

/// A web page can make a browser send any body behind its headers: nothing before the greeting is skipped, and nothing is answered.
#[test]
fn a_stranger_is_told_nothing_and_nothing_of_it_is_sent() {
    let door = door(Role::Send);
    let other = door.another();
    let frames = [GREETING.to_vec(), bytes(&["6A5#BEEF"])].concat();
    for (first, reason) in [
        (&b"POST / HTTP/1.1\r\n\r\n"[..], "it speaks HTTP"),
        (b"CANNELLONIv2", "does not begin with this protocol's greeting"),
        (b"\0", "does not begin with this protocol's greeting"),
    ] {
        let mut stranger = door.dial();
        stranger.write_all(&[first, &frames].concat()).unwrap();
        let mut heard = Vec::new();
        // Ended or cut off.
        let _ = stranger.read_to_end(&mut heard);
        assert_eq!(heard, [0; 0]);
        door.tells(reason);
    }
    // One that lies about a length sends what it sent before, and nothing behind it.
    let mut liar = door.enter();
    let lie = [&bytes(&["123#11"])[..], &[0, 0, 1, 0x23, 9], &[0; 9], &bytes(&["6A5#BEEF"])].concat();
    liar.write_all(&lie).unwrap();
    door.tells("it sent what is no frame");
    let mut honest = door.enter();
    honest.write_all(&bytes(&["7FF#"])).unwrap();
    let mut seen = seen(&other);
    assert_eq!([(); 2].map(|()| seen.next().unwrap()), ["123#11", "7FF#"]);
}
