//! A cannelloni tunnel: both directions, and who cannot use it.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use cantap::wire::message::{ChannelConfig, Mode, Role, TxFrame};
use cantap::{Channel, Device, TraceEvent};
use cantap_codecs::cannelloni::{Item, Writer, datagram, item};
use cantap_serve::cannelloni::{self, Tunnel};
use cantap_serve::listen::Listening;
use cantap_serve::{Board, News, Settings, metrics};
use cantap_testing::process::wait_until;

use crate::metrics::scrape;
use crate::strangers::{BITRATE_BPS, any_port, board_at, client};

struct Far {
    board: Arc<Board>,
    told: Receiver<News>,
    tunnel: Listening,
    peer: UdpSocket,
}

fn tunnel(role: Role) -> Far {
    let of_bus = format!("cantap_bitrate_bps{{board=\"board\",channel=\"2\"}} {BITRATE_BPS}");
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let peer = UdpSocket::bind("127.0.0.1:0").unwrap();
    peer.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let tunnel = cannelloni::open(Tunnel {
        board: Arc::clone(&board),
        channel: Channel::Can2,
        local: any_port(),
        peer: peer.local_addr().unwrap(),
        role,
    });
    let tunnel = tunnel.unwrap();
    peer.connect(tunnel.address().unwrap()).unwrap();
    let far = Far { board, told, tunnel, peer };
    // From then on, it has what is on the bus.
    let figures = metrics::listen(std::slice::from_ref(&far.board), any_port()).unwrap();
    wait_until("the tunnel has no bus", || scrape(&figures).contains(&of_bus));
    far
}

impl Far {
    fn tells(&self, wanted: &str) {
        let mut others = Vec::new();
        let is_it = |news: News| {
            others.push(news.to_string());
            news.to_string().contains(wanted)
        };
        assert!(self.told.iter().any(is_it), "{wanted}: {others:?}");
    }

    /// The next datagram's number, and its frames that are no error frames.
    fn next(&self) -> (u8, Vec<String>) {
        let mut bytes = [0; 2048];
        let len = self.peer.recv(&mut bytes).unwrap();
        let (header, mut rest) = datagram(&bytes[..len]).unwrap();
        let mut frames = Vec::new();
        for _ in 0..header.count {
            let (item, after) = item(rest).unwrap();
            rest = after;
            if let Item::Frame(frame) = item {
                frames.push(frame.to_string());
            }
        }
        assert!(rest.is_empty());
        (header.sequence, frames)
    }
}

fn with(sequence: u8, frames: &[&str]) -> Vec<u8> {
    let mut writer = Writer::default();
    for frame in frames {
        writer.push(&frame.parse().unwrap());
    }
    let mut bytes = writer.take().unwrap();
    bytes[2] = sequence;
    bytes
}

fn on_the_bus(board: &Board) -> Device {
    let device = client(board, "local", Role::Send);
    let timing = device.timing(BITRATE_BPS).unwrap();
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
    device.open_channel(Channel::Can2, Some(config)).unwrap();
    device
}

/// Another client, which only listens.
fn another(board: &Board) -> Device {
    let device = client(board, "other", Role::Listen);
    device.listen(Channel::Can2, BITRATE_BPS).unwrap();
    device
}

/// The frames that a client receives.
fn seen(device: &Device) -> impl Iterator<Item = String> {
    device.records().map(Result::unwrap).filter_map(|record| match record.event {
        TraceEvent::Frame { frame, .. } => Some(frame.to_string()),
        _ => None,
    })
}

fn send(device: &Device, frame: &str) {
    let frame = TxFrame { tag: 1, frame: frame.parse().unwrap(), at_ticks: None };
    device.send(Channel::Can2, &[frame]).unwrap();
}

#[test]
fn what_is_on_the_bus_comes_out_at_the_peer_numbered_and_in_order() {
    let far = tunnel(Role::Listen);
    let local = on_the_bus(&far.board);
    let sent = ["123#11", "7FF#R4", "1ABCDEF0#0102030405060708", "124#"];
    for frame in sent {
        send(&local, frame);
    }
    let mut frames = Vec::new();
    let mut numbers = Vec::new();
    while frames.len() < sent.len() {
        let (number, some) = far.next();
        numbers.push(number);
        frames.extend(some);
    }
    assert_eq!(frames, sent);
    assert_eq!(numbers, (0..numbers.len() as u8).collect::<Vec<_>>());
}

#[test]
fn the_peer_sends_in_order_and_does_not_hear_itself() {
    let far = tunnel(Role::Send);
    let other = another(&far.board);
    let mut seen = seen(&other);
    far.peer.send(&with(250, &["123#11", "124#22"])).unwrap();
    assert_eq!([(); 2].map(|()| seen.next().unwrap()), ["123#11", "124#22"]);
    // Two are missing, which is said; what there is, is sent.
    far.peer.send(&with(253, &["125#"])).unwrap();
    assert_eq!(seen.next().unwrap(), "125#");
    far.tells("are missing");
    // Others' frames are what the peer hears.
    let local = on_the_bus(&far.board);
    send(&local, "126#");
    let heard = loop {
        let (_, frames) = far.next();
        if !frames.is_empty() {
            break frames;
        }
    };
    assert_eq!(heard, ["126#"]);
}

/// A network may double a datagram: a frame must not be on the bus twice for that. What a datagram hides or lacks is reported, with numbers.
#[test]
fn a_datagram_that_comes_twice_is_sent_once_and_what_is_wrong_with_one_is_reported() {
    let far = tunnel(Role::Send);
    let other = another(&far.board);
    let mut seen = seen(&other);
    let twice = with(0, &["123#11"]);
    far.peer.send(&twice).unwrap();
    far.peer.send(&twice).unwrap();
    far.tells("came twice; what it holds was not sent again");
    far.peer.send(&with(1, &["124#22"])).unwrap();
    assert_eq!([(); 2].map(|()| seen.next().unwrap()), ["123#11", "124#22"]);
    // It says that it has one frame, and holds three.
    let mut hiding = with(5, &["125#", "126#", "127#"]);
    hiding[4] = 1;
    far.peer.send(&hiding).unwrap();
    far.tells(
        "3 datagrams before this one are missing; 10 bytes behind the frames that a datagram says it has",
    );
    assert_eq!(seen.next().unwrap(), "125#");
    let mut cut = with(6, &["128#", "129#"]);
    cut[4] = 4;
    far.peer.send(&cut).unwrap();
    far.tells("it sent a datagram that ends before 2 of its frames");
    assert_eq!([(); 2].map(|()| seen.next().unwrap()), ["128#", "129#"]);
}

#[test]
fn a_peer_that_may_only_listen_sends_nothing() {
    let far = tunnel(Role::Listen);
    far.peer.send(&with(0, &["123#11"])).unwrap();
    far.tells("not sent: 1 frame: it may only listen");
    assert!(far.board.clients() == 1);
}

/// Datagrams have no sender that could be trusted, and must have no answer: others would receive it.
#[test]
fn strangers_datagrams_are_not_taken_and_nothing_is_answered() {
    let far = tunnel(Role::Send);
    let other = another(&far.board);
    let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
    stranger.set_read_timeout(Some(Duration::from_millis(500))).unwrap();
    for bytes in [with(0, &["123#11"]), vec![], vec![2, 0, 0, 0, 0], vec![0; 1400]] {
        stranger.send_to(&bytes, far.tunnel.address().unwrap()).unwrap();
    }
    assert!(stranger.recv(&mut [0; 2048]).is_err(), "an answer to a stranger");
    // The peer's own garbage harms nothing and has no answer either.
    let cut = with(1, &["124#22"]);
    for bytes in [
        vec![],
        vec![2],
        vec![1, 0, 0, 0, 0],
        vec![2, 0, 0, 0xFF, 0xFF],
        cut[..cut.len() - 1].to_vec(),
        vec![0xFF; 9001],
    ] {
        far.peer.send(&bytes).unwrap();
    }
    far.tells("too long");
    far.peer.set_read_timeout(Some(Duration::from_millis(500))).unwrap();
    assert!(far.peer.recv(&mut [0; 2048]).is_err(), "an answer");
    far.peer.send(&with(0, &["7FF#"])).unwrap();
    assert_eq!(seen(&other).next().as_deref(), Some("7FF#"));
}

#[test]
fn addresses_of_the_network_only_listen() {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    // It need not be there: nothing is connected in UDP. 192.0.2.0/24 is nobody's.
    let opened = cannelloni::open(Tunnel {
        board: Arc::clone(&board),
        channel: Channel::Can1,
        local: "0.0.0.0:0".parse().unwrap(),
        peer: "192.0.2.1:20000".parse().unwrap(),
        role: Role::Send,
    });
    match opened {
        Ok(_tunnel) => {
            let came = told.iter().find(|news| matches!(news, News::ClientCame { .. }));
            assert!(matches!(came, Some(News::ClientCame { role: Role::Listen, .. })), "{came:?}");
        }
        // Without any network there is no way there.
        Err(error) => assert_eq!(error.kind(), std::io::ErrorKind::NetworkUnreachable),
    }
}

/// Nothing shows it but an answer of the other computer, which UDP's senders seldom look at.
#[test]
fn datagrams_that_nobody_listened_for_are_counted() {
    let far = tunnel(Role::Listen);
    let device = on_the_bus(&far.board);
    // The port is free from now on.
    let Far { board, told, tunnel, peer } = far;
    drop(peer);
    for _ in 0..5 {
        send(&device, "123#11");
        std::thread::sleep(Duration::from_millis(30));
    }
    drop(tunnel);
    let is_it = |news: News| matches!(&news, News::LeftOut { what, .. } if what.contains("datagrams that nobody listened for"));
    assert!(told.iter().any(is_it));
    drop((device, board));
}
