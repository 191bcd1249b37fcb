//! Who must not get in, who must not be kept out, and what nobody may do to others: attacks that once worked, and attempts to get round what
//! mends them.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use cantap::device::encode;
use cantap::wire::message::{ChannelConfig, Mode, Periodic, Role, TxFrame};
use cantap::wire::{BitTiming, Command, PROTOCOL_VERSION, Refusal, Reply, Request};
use cantap::{Channel, Device, DeviceError, Direction, TraceEvent};
use cantap_serve::listen::{self, Listening};
use cantap_serve::{Board, News, Settings, connect, lines, socketcand};
use cantap_testing::process::wait_until;

pub const BITRATE_BPS: u32 = 500_000;

pub fn board_at(settings: Settings) -> (Arc<Board>, Receiver<News>) {
    let options: cantap_virtual::Options = "load=0".parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    let (news, told) = channel();
    let board = Board::start("board", connect, settings, move |of| drop(news.send(of))).unwrap();
    (Arc::new(board), told)
}

pub fn any_port() -> SocketAddr {
    "127.0.0.1:0".parse().unwrap()
}

pub fn client(board: &Board, name: &str, role: Role) -> Device {
    Device::over(board.link(name, role).unwrap(), name).unwrap()
}

fn over(server: &Listening) -> Device {
    let link = connect::tcp(&server.address().unwrap().to_string()).unwrap();
    Device::over(link, "client").unwrap()
}

fn normal() -> ChannelConfig {
    let timing = BitTiming::choose(36_000_000, BITRATE_BPS, None).unwrap();
    ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) }
}

fn dial(server: &Listening) -> TcpStream {
    let stream = TcpStream::connect(server.address().unwrap()).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    stream
}

/// Everything that a server says until it ends the connection.
fn all_from(mut stream: TcpStream) -> Vec<u8> {
    let mut heard = Vec::new();
    // Ended or cut off.
    let _ = stream.read_to_end(&mut heard);
    heard
}

/// A greeting, and requests to open a channel for sending and to send, as a web page would put them into a request's body.
pub fn speaks() -> Vec<u8> {
    let timing = BitTiming::choose(36_000_000, BITRATE_BPS, None).unwrap();
    let config = Some(ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) });
    let channel = Channel::Can1;
    let frame = TxFrame { tag: 7, frame: "6A5#BEEF".parse().unwrap(), at_ticks: None };
    let frames = [frame].into_iter().collect();
    let commands = [
        Command::Hello { protocol: PROTOCOL_VERSION },
        Command::Open { channel, config },
        Command::Send { channel, frames },
    ];
    let requests = commands.into_iter().zip(1..);
    let encoded = requests.map(|(command, id)| encode(&Request { id, command }).unwrap());
    [vec![0], encoded.collect::<Vec<_>>().concat()].concat()
}

/// What browsers, and other programs at a wrong port, put in front of a body.
pub fn headers(body: &[u8]) -> Vec<Vec<u8>> {
    let http = |first: &str| {
        format!(
            "{first}Host: 127.0.0.1:29537\r\nOrigin: http://evil.example\r\nContent-Length: {}\r\n\r\n",
            body.len()
        )
        .into_bytes()
    };
    vec![
        http("POST / HTTP/1.1\r\n"),
        http("PUT /< HTTP/1.1\r\n"),
        http("GET /%3C HTTP/1.1\r\nUpgrade: websocket\r\n"),
        b"OPTIONS * HTTP/1.1\r\n\r\n".to_vec(),
        b"EHLO x\r\n".to_vec(),
        b"SSH-2.0-x\r\n".to_vec(),
        vec![0x16, 3, 1, 2, 0, 1],
        b"garbage\0".to_vec(),
        vec![b'x'; 100_000],
        b"\r\n".to_vec(),
    ]
}

#[test]
fn nothing_behind_anything_else_than_a_greeting_is_carried_out() {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let native = listen::tcp(&board, any_port(), Role::Send).unwrap();
    let text = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Send).unwrap();
    let commands = b"< open can0 >< send 6A5 2 BE EF >< rawmode >".to_vec();
    for (server, body) in [(&native, speaks()), (&text, commands)] {
        for header in headers(&body) {
            let mut stream = dial(server);
            // In one piece, and with the body after a while.
            let _ = stream.write_all(&[header.clone(), body.clone()].concat());
            let heard = all_from(stream);
            assert!(heard.is_empty() || heard == b"< hi >", "{:?}", String::from_utf8_lossy(&heard));
            let mut stream = dial(server);
            let _ = stream.write_all(&header);
            std::thread::sleep(Duration::from_millis(20));
            let _ = stream.write_all(&body);
            let heard = all_from(stream);
            assert!(heard.is_empty() || heard == b"< hi >", "{:?}", String::from_utf8_lossy(&heard));
        }
    }
    // A first command that is none, though it looks like one: a page's own markup.
    let mut stream = dial(&text);
    stream.write_all(b"<html>< open can0 >< send 6A5 2 BE EF >").unwrap();
    assert_eq!(all_from(stream), b"< hi >< error unknown command >");
    // The same without anything in front is carried out.
    let mut stream = dial(&native);
    stream.write_all(&speaks()).unwrap();
    let is_sent = |record: &cantap::TraceRecord| {
        matches!(record.event, TraceEvent::Frame { direction: Direction::Tx, .. })
    };
    let mut records = listener.records();
    let sent = records.find(|record| record.as_ref().is_ok_and(is_sent)).unwrap().unwrap();
    assert_eq!(sent.frame().unwrap().to_string(), "6A5#BEEF");
    drop(stream);
    listener.stop().unwrap();
    assert_eq!(records.filter(|record| record.as_ref().is_ok_and(is_sent)).count(), 0);
    let said: Vec<String> = told.try_iter().map(|news| news.to_string()).collect();
    for protocol in ["HTTP, as a web browser does", "SSH", "SMTP", "TLS"] {
        let is_named = |line: &&String| {
            line.contains("was not let in") && line.ends_with(&format!("it speaks {protocol}"))
        };
        assert!(said.iter().filter(is_named).count() >= 2, "{protocol}: {said:#?}");
    }
}

/// A web page can also have a browser connect where nothing is taken, and then read what comes.
#[test]
fn a_browser_that_connects_to_the_lines_hears_nothing() {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let server = lines::listen(std::slice::from_ref(&board), any_port()).unwrap();
    let mut stream = dial(&server);
    stream.write_all(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n").unwrap();
    assert_eq!(all_from(stream), b"");
    wait_until("it is told", || told.try_iter().any(|news| news.to_string().contains("it speaks HTTP")));
}

/// Strangers who only connect keep nobody out, at their own listener or at another.
#[test]
fn silent_connections_take_nobody_s_place() {
    let folder = tempfile::tempdir().unwrap();
    let (board, _told) = board_at(Settings { most_clients: 8, ..Settings::at(BITRATE_BPS) });
    let native = listen::tcp(&board, any_port(), Role::Listen).unwrap();
    let text = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Listen).unwrap();
    let path = folder.path().join("a.sock");
    let _local = listen::unix(&board, &path, Role::Configure).unwrap();
    let mut held: Vec<TcpStream> = (0..100).flat_map(|_| [dial(&native), dial(&text)]).collect();
    // Some of them have opened a bus, and say no more.
    for stream in &mut held {
        let _ = stream.write_all(b"< open can0 >");
    }
    std::thread::sleep(Duration::from_millis(300));
    let own = Device::over(connect::unix(&path).unwrap(), "own").unwrap();
    own.listen(Channel::Can1, BITRATE_BPS).unwrap();
    over(&native).listen(Channel::Can1, BITRATE_BPS).unwrap();
    let mut client = dial(&text);
    client.write_all(b"< open can0 >").unwrap();
    let mut heard = String::new();
    let mut bytes = [0; 64];
    while !heard.contains("< ok >") {
        let len = client.read(&mut bytes).unwrap();
        assert!(len > 0, "{heard}");
        heard.push_str(&String::from_utf8_lossy(&bytes[..len]));
    }
}

#[test]
fn whoever_finds_no_place_learns_why() {
    let (board, _told) = board_at(Settings { most_clients: 2, ..Settings::at(BITRATE_BPS) });
    let native = listen::tcp(&board, any_port(), Role::Listen).unwrap();
    let _served = [over(&native), over(&native)];
    let link = connect::tcp(&native.address().unwrap().to_string()).unwrap();
    let refused = Device::over(link, "third").err().unwrap().to_string();
    assert!(refused.contains("its server refuses: there are 2 clients already"), "{refused}");
}

/// Neither names a bit rate, so neither configures anything.
#[test]
fn two_clients_send_on_two_channels() {
    let (board, _told) = board_at(Settings::at(BITRATE_BPS));
    let (one, other) = (client(&board, "one", Role::Send), client(&board, "other", Role::Send));
    let open = |device: &Device, channel| {
        let timing = device.timing(BITRATE_BPS).unwrap();
        let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
        device.open_channel(channel, Some(config))
    };
    open(&one, Channel::Can1).unwrap();
    open(&other, Channel::Can2).unwrap();
    open(&other, Channel::Can1).unwrap();
    // One that names another bit rate does, for that channel only.
    let (board, _told) = board_at(Settings::default());
    let (one, other) = (client(&board, "one", Role::Configure), client(&board, "other", Role::Configure));
    one.listen(Channel::Can1, BITRATE_BPS).unwrap();
    other.listen(Channel::Can2, 250_000).unwrap();
    one.close_channel(Channel::Can1).unwrap();
    let held = other.listen(Channel::Can1, 125_000);
    assert!(matches!(held, Err(DeviceError::Refused { refusal: Refusal::Held })), "{held:?}");
}

fn listens_only(device: &Device) -> bool {
    let registers = device.request(Command::Registers { channel: Channel::Can1 });
    // SILM, bit 31 of BTR (RM0090 Rev 21, 32.9.2).
    matches!(registers, Ok(Reply::Registers(registers)) if registers.now.btr >> 31 == 1)
}

/// A client written by hand: it says what it wants, and no more.
fn says_no_more(server: &Listening, commands: Vec<Command>) -> TcpStream {
    let mut stream = dial(server);
    let greeting = Command::Hello { protocol: PROTOCOL_VERSION };
    let mut bytes = vec![0];
    for (id, command) in (1..).zip(std::iter::once(greeting).chain(commands)) {
        bytes.extend(encode(&Request { id, command }).unwrap());
    }
    stream.write_all(&bytes).unwrap();
    stream
}

/// A stopped program's connection stays, and the system goes on taking what is sent to it.
#[test]
fn a_client_that_could_send_and_says_nothing_is_let_go_and_the_board_only_listens_again() {
    let settings = Settings { keep_mode: Duration::from_millis(100), ..Settings::at(BITRATE_BPS) };
    let (board, told) = board_at(settings);
    let server = listen::tcp(&board, any_port(), Role::Send).unwrap();
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    assert!(listens_only(&listener));
    // Programs of ours ask for the time.
    let lives = over(&server);
    lives.open_channel(Channel::Can1, Some(normal())).unwrap();
    std::thread::sleep(Duration::from_secs(6));
    lives.status().unwrap();
    assert!(!listens_only(&listener));
    drop(lives);
    wait_until("it only listens", || listens_only(&listener));
    let open = Command::Open { channel: Channel::Can1, config: Some(normal()) };
    let stopped = says_no_more(&server, vec![open]);
    wait_until("it is open for sending", || !listens_only(&listener));
    wait_until("it only listens", || listens_only(&listener));
    wait_until("it is told", || {
        told.try_iter().any(|news| {
            news.to_string().ends_with("was let go: it said nothing for 5 s, and might have sent")
        })
    });
    drop(stopped);
}

/// The messages of a socketcand client's server, up to the one that contains this.
fn read_until(stream: &mut TcpStream, wanted: &str) -> String {
    let mut heard = String::new();
    let mut bytes = [0; 4096];
    while !heard.contains(wanted) {
        let len = stream.read(&mut bytes).unwrap();
        assert!(len > 0, "{heard}");
        heard.push_str(&String::from_utf8_lossy(&bytes[..len]));
    }
    heard
}

/// Its connection may be that of a stopped program, which the system keeps up.
#[test]
fn a_socketcand_client_that_sends_no_more_does_not_keep_the_board_acknowledging() {
    let settings = Settings {
        keep_mode: Duration::from_millis(100),
        idle_sender: Some(Duration::from_millis(300)),
        ..Settings::at(BITRATE_BPS)
    };
    let (board, told) = board_at(settings);
    let server = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Send).unwrap();
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let mut stream = dial(&server);
    stream.write_all(b"< open can0 >< send 7A1 1 01 >").unwrap();
    let is_idle = |news: News| matches!(news, News::Idle { channel: Channel::Can1, .. });
    assert!(told.iter().any(is_idle));
    wait_until("it only listens", || listens_only(&listener));
    // It is still there, learns of the gap, and may send again; what the board sends for it is no silence.
    stream.write_all(b"< rawmode >< add 0 10000 7A2 1 02 >").unwrap();
    read_until(&mut stream, "< error 20000004 ");
    let mut records = listener.records();
    let is_periodic = |record: &Result<cantap::TraceRecord, _>| {
        record.as_ref().is_ok_and(|record| record.frame().is_some_and(|frame| frame.to_string() == "7A2#02"))
    };
    assert_eq!(records.by_ref().filter(is_periodic).take(100).count(), 100);
    assert!(!listens_only(&listener));
    stream.write_all(b"< delete 7A2 >").unwrap();
    assert!(told.iter().any(is_idle));
    wait_until("it only listens", || listens_only(&listener));
    // Both changes are gaps for the others, never a zero.
    listener.stop().unwrap();
    let off_bus = listener.counters().channels[0].off_bus;
    assert!(off_bus >= 3, "{off_bus}");
}

#[test]
fn a_socketcand_client_that_reads_no_more_is_let_go() {
    let options: cantap_virtual::Options = "load=100,frames=std0".parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    let settings = Settings { keep_mode: Duration::from_millis(100), ..Settings::at(BITRATE_BPS) };
    let (news, told) = channel();
    let board = Board::start("board", connect, settings, move |of| drop(news.send(of))).unwrap();
    let board = Arc::new(board);
    let server = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Send).unwrap();
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can2, BITRATE_BPS).unwrap();
    let mut stream = dial(&server);
    stream.write_all(b"< open can0 >< rawmode >< send 7A1 1 01 >").unwrap();
    let is_let_go = |news: News| news.to_string().ends_with("it took nothing for 5 s");
    assert!(told.iter().any(is_let_go));
    assert!(told.iter().any(|news| matches!(news, News::ClientLeft { .. })));
    wait_until("the board leaves the bus", || {
        let status = listener.request(Command::Registers { channel: Channel::Can1 });
        // INAK, bit 0 of MSR: initialisation (RM0090 Rev 21, 32.9.2).
        matches!(status, Ok(Reply::Registers(registers)) if registers.now.msr & 1 == 1)
    });
    // As long as its connection is there.
    drop(stream);
}

/// After its dead-man time the bus is silent, though the client's connection is still there.
#[test]
fn what_a_silent_client_sends_periodically_stops() {
    let settings = Settings { dead_man: Some(Duration::from_millis(500)), ..Settings::at(BITRATE_BPS) };
    let (board, told) = board_at(settings);
    let server = listen::tcp(&board, any_port(), Role::Send).unwrap();
    let listener = client(&board, "listener", Role::Send);
    listener.open_channel(Channel::Can1, Some(normal())).unwrap();
    let channel = Channel::Can1;
    let modifiers = [].into_iter().collect();
    let entry = Periodic { frame: "123#11".parse().unwrap(), period_ticks: 120_000, count: 0, modifiers };
    let commands = vec![
        Command::Open { channel, config: Some(normal()) },
        Command::SetPeriodic { channel, slot: 3, entry: Some(entry) },
    ];
    let _silent = says_no_more(&server, commands);
    wait_until("it is told", || told.try_iter().any(|news| matches!(news, News::DeadMan { .. })));
    // Its connection is still there. What was sent is followed by nothing.
    let mut records = listener.records();
    let mut sent = 0;
    loop {
        let batch = records.next_batch(Duration::from_millis(300)).unwrap().unwrap();
        if batch.is_empty() {
            break;
        }
        sent += batch.iter().filter(|record| record.frame().is_some()).count();
        assert!(sent < 1000, "it is sent for ever");
    }
    assert!(sent >= 2, "{sent}");
}

/// One client's change of mode costs the others frames: that is never a zero, and happens once.
#[test]
fn a_change_of_mode_is_a_counted_gap_and_the_mode_is_kept() {
    let (board, _told) = board_at(Settings::at(BITRATE_BPS));
    let server = socketcand::listen(std::slice::from_ref(&board), any_port(), Role::Send).unwrap();
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    for number in 0..5 {
        let mut stream = dial(&server);
        stream.write_all(format!("< open can0 >< send 7A1 1 0{number} >").as_bytes()).unwrap();
        let mut records = listener.records();
        let own = format!("7A1#0{number}");
        let mut is_own = |record: Result<cantap::TraceRecord, _>| {
            record.is_ok_and(|record| record.frame().is_some_and(|frame| frame.to_string() == own))
        };
        assert!(records.any(&mut is_own));
    }
    listener.stop().unwrap();
    let counters = listener.counters();
    assert_eq!(counters.channels[0].off_bus, 1, "{counters:?}");
    assert!(counters.channels[0].off_bus_ns > 0, "{counters:?}");
    assert_eq!((counters.channels[1].off_bus, counters.channels[0].lost()), (0, 0), "{counters:?}");
}

/// With the mode given to the server, no client takes the board off its bus.
#[test]
fn a_board_that_always_acknowledges_is_not_taken_off_its_bus() {
    let settings = Settings { always_acknowledges: true, ..Settings::at(BITRATE_BPS) };
    let (board, _told) = board_at(settings);
    let listener = client(&board, "listener", Role::Listen);
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    assert!(!listens_only(&listener));
    let sender = client(&board, "sender", Role::Send);
    sender.open_channel(Channel::Can1, Some(normal())).unwrap();
    drop(sender);
    listener.stop().unwrap();
    assert_eq!(listener.counters().channels[0].off_bus, 0);
    // A listener may send as little as before.
    let frame = TxFrame { tag: 1, frame: "123#".parse().unwrap(), at_ticks: None };
    assert!(client(&board, "other", Role::Listen).send(Channel::Can1, &[frame]).is_err());
}

/// That a server ends is what its clients are told, whatever they were asking for.
#[test]
fn a_request_while_the_server_ends_is_answered_with_that() {
    for _ in 0..20 {
        let (board, _told) = board_at(Settings::at(BITRATE_BPS));
        let device = client(&board, "busy", Role::Send);
        device.open_channel(Channel::Can1, Some(normal())).unwrap();
        let asks = std::thread::spawn(move || {
            let frame = TxFrame { tag: 1, frame: "123#".parse().unwrap(), at_ticks: None };
            loop {
                match device.send(Channel::Can1, &[frame]) {
                    Ok(_) | Err(DeviceError::Refused { refusal: Refusal::QueueFull { .. } }) => {}
                    Err(error) => return error.to_string(),
                }
            }
        });
        std::thread::sleep(Duration::from_millis(30));
        drop(board);
        let error = asks.join().unwrap();
        assert!(error.ends_with("its server has ended"), "{error}");
    }
}

/// Each report is a line on standard error and in the audit log: whoever may only listen could fill a disk with sessions of a few bytes.
#[test]
fn sessions_without_end_are_reported_up_to_a_limit_and_then_counted() {
    let (board, told) = board_at(Settings::at(BITRATE_BPS));
    let mut reports = 0;
    let left_out = loop {
        drop(client(&board, "flood", Role::Listen));
        let more = told.try_iter().find_map(|news| match news {
            News::SessionsMore { count } => Some(count),
            News::ClientCame { .. } | News::ClientLeft { .. } => {
                reports += 1;
                None
            }
            _ => None,
        });
        if let Some(count) = more {
            break count;
        }
    };
    // A thousand at once, of which the two channels that each client closes take half, and one every two seconds.
    assert!((400..1100).contains(&reports), "{reports}");
    assert!(left_out > 0);
}
