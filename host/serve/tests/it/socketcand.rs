//! The socketcand protocol and candump lines over TCP: the protocol page's transcripts, and unmodified
//! python-can.
//!
//! Python is `CANTAP_PYTHON`, otherwise `python3`; without python-can the test says that it was skipped, unless
//! `CANTAP_REQUIRE_PEERS=1`.

use cantap_testing::peers;
use cantap_testing::process::wait_until;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use cantap::Device;
use cantap::wire::message::{ChannelConfig, Mode, Role, TxFrame};
use cantap::{Channel, Direction, TraceEvent};
use cantap_serve::listen::Listening;
use cantap_serve::{Board, Settings, lines, socketcand};

const BITRATE_BPS: u32 = 500_000;

fn board(options: &str) -> Arc<Board> {
    let options: cantap_virtual::Options = options.parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), |_| {}).unwrap())
}

fn listen(board: &Arc<Board>, role: Role) -> Listening {
    socketcand::listen(std::slice::from_ref(board), "127.0.0.1:0".parse().unwrap(), role).unwrap()
}

/// A client that reads carefully: by messages between `<` and `>`.
struct Client {
    stream: TcpStream,
    text: String,
}

impl Client {
    fn new(server: &Listening) -> Self {
        let stream = TcpStream::connect(server.address().unwrap()).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let mut client = Self { stream, text: String::new() };
        assert_eq!(client.one(), "< hi >");
        client
    }

    fn say(&mut self, text: &str) {
        self.stream.write_all(text.as_bytes()).unwrap();
    }

    fn ask(&mut self, text: &str) -> String {
        self.say(text);
        self.one()
    }

    /// The next message.
    fn one(&mut self) -> String {
        self.next(Duration::from_secs(5)).expect("a message")
    }

    fn next(&mut self, timeout: Duration) -> Option<String> {
        let deadline = Instant::now() + timeout;
        loop {
            if let Some(end) = self.text.find('>') {
                let rest = self.text.split_off(end + 1);
                return Some(std::mem::replace(&mut self.text, rest));
            }
            if Instant::now() >= deadline {
                return None;
            }
            let mut bytes = [0; 4096];
            if let Ok(len) = self.stream.read(&mut bytes) {
                if len == 0 {
                    return None;
                }
                self.text.push_str(std::str::from_utf8(&bytes[..len]).unwrap());
            }
        }
    }
}

/// A program on the same bus, using our own protocol.
fn other(board: &Board) -> Device {
    let device = Device::over(board.link("other", Role::Send).unwrap(), "other").unwrap();
    let timing = device.timing(BITRATE_BPS).unwrap();
    let config = ChannelConfig { mode: Mode::Normal, ..ChannelConfig::listen_only(timing) };
    device.open_channel(Channel::Can1, Some(config)).unwrap();
    device
}

fn send(device: &Device, frame: &str) {
    let frame = TxFrame { tag: 1, frame: frame.parse().unwrap(), at_ticks: None };
    device.send(Channel::Can1, &[frame]).unwrap();
}

/// A message without its time.
fn timeless(message: &str) -> String {
    let words: Vec<&str> = message.splitn(5, ' ').collect();
    assert!(words[3].contains('.'), "{message}");
    [words[1], words[2], words[4]].join(" ")
}

#[test]
fn raw_mode_tells_every_frame_and_sends() {
    let board = board("load=0");
    let server = listen(&board, Role::Send);
    let other = other(&board);
    let mut client = Client::new(&server);
    assert_eq!(client.ask("< echo >"), "< echo >");
    assert_eq!(client.ask("< rawmode >"), "< error open a bus first >");
    assert_eq!(client.ask("< open can0 >"), "< ok >");
    assert_eq!(client.ask("< rawmode >"), "< ok >");
    for frame in ["123#11223344", "1AAAAAAA#01F1", "123#", "00000123#R2"] {
        send(&other, frame);
    }
    let heard: Vec<String> = (0..4).map(|_| timeless(&client.one())).collect();
    assert_eq!(heard, ["frame 123 11223344 >", "frame 1AAAAAAA 01F1 >", "frame 123  >", "rtr 00000123 2 >"]);
    // It does not receive its own frames; others do.
    client.say("< send 7FF 2 ffffffffffffff80 1 >< sendrtr 123 3 >");
    send(&other, "321#99");
    let mut own = Vec::new();
    let mut records = other.records();
    while own.len() < 2 {
        let record = records.next().unwrap().unwrap();
        if let TraceEvent::Frame { frame, direction: Direction::Tx, .. } = record.event {
            own.extend(
                Some(frame.to_string()).filter(|frame| frame.starts_with("7FF") || frame.contains('R')),
            );
        }
    }
    // The first one is the other program's.
    assert_eq!(own.iter().filter(|frame| *frame == "7FF#8001").count(), 1, "{own:?}");
    client.say("< isotpmode >");
    let mut rest: Vec<String> = std::iter::from_fn(|| client.next(Duration::from_millis(500))).collect();
    rest.retain(|said| !said.starts_with("< error 2"));
    rest.sort();
    assert_eq!(rest.len(), 2, "{rest:?}");
    assert_eq!(rest[0], "< error unknown command >");
    assert_eq!(timeless(&rest[1]), "frame 321 99 >");
}

#[test]
fn bcm_mode_sends_again_and_again_by_the_board_s_clock_and_tells_what_was_subscribed_to() {
    let board = board("load=0");
    let server = listen(&board, Role::Send);
    let other = other(&board);
    let mut records = other.records();
    let mut client = Client::new(&server);
    // Two commands sent together get two answers.
    client.say("< open can0 >< subscribe 0 0 123 >< filter 0 0 124 1 F0 >< add 0 5000 200 2 1 FF >");
    assert_eq!(client.one(), "< ok >");
    let mut times = Vec::new();
    while times.len() < 40 {
        let record = records.next().unwrap().unwrap();
        if record.frame().is_some_and(|frame| frame.to_string() == "200#01FF") {
            times.push(record.time_ns);
        }
    }
    // UTC itself is estimated again now and then, moving by some microseconds.
    assert!(times.windows(2).all(|pair| (pair[1] - pair[0] - 5_000_000).abs() < 500_000), "{times:?}");
    client.say("< update 200 1 AA >");
    while records.next().unwrap().unwrap().frame().is_none_or(|frame| frame.to_string() != "200#AA") {}
    client.say("< delete 200 >");
    for frame in ["123#11", "125#", "124#11", "124#12", "124#21", "123#R"] {
        send(&other, frame);
    }
    // It was off the bus for a moment when it began to send.
    assert_eq!(timeless(&client.one()), "error 20000004 83 01 00 00 00 00 00 00  >");
    let heard: Vec<String> = (0..4).map(|_| timeless(&client.one())).collect();
    assert_eq!(heard, ["frame 123 11  >", "frame 124 11  >", "frame 124 21  >", "rtr 123 0 >"]);
    assert_eq!(client.ask("< delete 200 >"), "< error nothing is sent periodically as 200 >");
    assert_eq!(client.ask("< add 1000 0 200 0 >"), "< error the board's longest period is 357 s >");
    assert_eq!(client.ask("< send 123 2 11 >"), "< error the number of bytes is wrong in 'send 123 2 11' >");
}

#[test]
fn control_mode_tells_statistics_and_a_listener_sends_nothing() {
    let board = board("load=20");
    let server = listen(&board, Role::Listen);
    let mut client = Client::new(&server);
    client.say("< open can1 >< controlmode >< statistics 100 >");
    assert_eq!([client.one(), client.one()], ["< ok >", "< ok >"]);
    let stat = client.one();
    let numbers: Vec<u64> = stat.split(' ').filter_map(|word| word.parse().ok()).collect();
    assert!(stat.starts_with("< stat ") && numbers.len() == 4 && numbers[1] > 0, "{stat}");
    assert_eq!((numbers[2], numbers[3]), (0, 0));
    client.say("< statistics 0 >< send 123 0 >");
    let refused = loop {
        let said = client.one();
        if !said.starts_with("< stat") {
            break said;
        }
    };
    assert!(
        refused.starts_with("< error the device refused: its server does not let this client"),
        "{refused}"
    );
    let mut stranger = Client::new(&server);
    assert_eq!(stranger.ask("< open can7 >"), "< error could not open bus >");
    assert_eq!(stranger.next(Duration::from_secs(2)), None);
}

#[test]
fn lines_are_a_candump_log_of_all_channels() {
    let board = board("load=10");
    let server = lines::listen(std::slice::from_ref(&board), "127.0.0.1:0".parse().unwrap()).unwrap();
    let mut stream = TcpStream::connect(server.address().unwrap()).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    let mut text = String::new();
    while text.lines().count() < 100 {
        let mut bytes = [0; 4096];
        let len = stream.read(&mut bytes).unwrap();
        text.push_str(std::str::from_utf8(&bytes[..len]).unwrap());
    }
    let (whole, _) = text.rsplit_once('\n').unwrap();
    for line in whole.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        assert!(matches!(words[1], "can0" | "can1") && words[2].contains('#') && words.len() == 3, "{line}");
    }
    assert!(whole.contains(" can0 ") && whole.contains(" can1 "));
    drop(stream);
    wait_until("its place is not free", || board.clients() == 0);
}

/// The protocol page's own texts, in order: `>` is the client's, `<` the server's, where a time is written as T, and `!` what
/// another node sends.
const PAGE: &str = "
> < can0 B 500000 0 0 0 0 0 0 0 >
< < ok >
> < can0 C 0 0 0 >
< < ok >
> < open can0 >
< < ok >
> < add 1 0 123 8 11 22 33 44 55 66 77 88 >
< < error 20000004 T 83 01 00 00 00 00 00 00  >
> < add 0 20000 123 4 42 42 42 42 >
> < update 123 3 11 22 33 >
> < delete 123 >
> < send 123 0 >
> < send 1AAAAAAA 2 1 F1 >
> < sendrtr 123 0 >
> < sendrtr 1AAAAAAA 2 >
> < filter 0 0 123 1 FF >
! 123#11
< < frame 123 T 11  >
! 123#11
> < filter 0 0 123 8 FF 00 F8 00 00 00 00 00 >
! 123#1100080000000000
< < frame 123 T 11 00 08 00 00 00 00 00  >
! 123#11FF0F0000000000
> < filter 1 500000 123 8 FF 00 F8 00 00 00 00 00 >
! 123#2200080000000000
< < frame 123 T 22 00 08 00 00 00 00 00  >
> < muxfilter 0 0 123 2 FF 00 00 00 00 00 00 00 33 FF FF FF FF FF FF FF >
! 123#3301000000000000
< < frame 123 T 33 01 00 00 00 00 00 00  >
! 123#5601000000000000
> < subscribe 0 0 123 >
! 123#11223344
< < frame 123 T 11 22 33 44  >
> < unsubscribe 123 >
! 123#11223344
> < echo >
< < echo >
> < rawmode >
< < ok >
! 123#11223344
< < frame 123 T 11223344 >
! 123#R4
< < rtr 123 T 4 >
> < bcmmode >
< < ok >
! 123#11223344
> < controlmode >
< < ok >
> < isotpmode >
< < error unknown command >
";

#[test]
fn the_protocol_page_is_a_transcript() {
    let board = board("load=0");
    let server = listen(&board, Role::Send);
    let other = other(&board);
    let mut records = other.records();
    let mut client = Client::new(&server);
    for line in PAGE.lines().filter(|line| !line.is_empty()) {
        let (who, text) = line.split_at(2);
        match who {
            "> " => client.say(text),
            "! " => {
                // By then the client's commands have been carried out.
                assert_eq!(client.ask("< echo >"), "< echo >", "before {line}");
                send(&other, text);
                while records.next().unwrap().unwrap().frame().is_none_or(|frame| frame.to_string() != text) {
                }
                // Another thread sends this to the client, and the client's next command must not overtake
                // it.
                std::thread::sleep(Duration::from_millis(150));
            }
            _ => {
                let said = client.one();
                let mut words: Vec<&str> = said.split(' ').collect();
                if words[1] != "error" || words.len() > 6 {
                    words.iter_mut().filter(|word| word.contains('.')).for_each(|word| *word = "T");
                }
                assert_eq!(words.join(" "), text);
            }
        }
    }
    // Every frame of the page's examples, except for the interval of 10 µs, which no bus can carry.
    other.stop().unwrap();
    assert_eq!(client.next(Duration::from_millis(300)), None);
}

/// A frame held back by an interval is sent when that is over, even if nothing else is on the bus.
#[test]
fn a_throttled_frame_is_passed_on_on_a_silent_bus() {
    let board = board("load=0");
    let server = listen(&board, Role::Listen);
    let other = other(&board);
    let mut client = Client::new(&server);
    assert_eq!(client.ask("< open can0 >"), "< ok >");
    client.say("< subscribe 0 300000 123 >");
    assert_eq!(client.ask("< echo >"), "< echo >");
    for frame in ["123#01", "123#02", "123#03"] {
        send(&other, frame);
    }
    assert_eq!(timeless(&client.one()), "frame 123 01  >");
    assert_eq!(timeless(&client.one()), "frame 123 03  >");
}

/// SavvyCAN compares the result of one read, and reconnects after ten seconds without a byte.
#[test]
fn savvycan_stays_connected_on_a_silent_bus() {
    let board = board("load=0");
    let server = listen(&board, Role::Listen);
    let mut stream = TcpStream::connect(server.address().unwrap()).unwrap();
    stream.set_read_timeout(Some(Duration::from_millis(9500))).unwrap();
    let mut read = |said: &str| {
        stream.write_all(said.as_bytes()).unwrap();
        let mut bytes = [0; 4096];
        let len = stream.read(&mut bytes).unwrap();
        String::from_utf8_lossy(&bytes[..len]).into_owned()
    };
    assert_eq!(read(""), "< hi >");
    assert_eq!(read("< open can0 >"), "< ok >");
    assert_eq!(read("< rawmode >"), "< ok >");
    let silent_since = Instant::now();
    assert_eq!(read(""), "< echo >");
    assert!(silent_since.elapsed() > Duration::from_secs(5), "a bus with traffic needs none");
}

/// Finds the server by its beacon, receives frames with and without data, sends, and has one sent repeatedly.
const PROGRAM: &str = r#"
import sys, time, can
from can.interfaces.socketcand import socketcand
# What the server says on a silent bus, python-can passes over.
assert socketcand.convert_ascii_message_to_can_message("< echo >") is None
port = int(sys.argv[1])
# It takes the first beacon that comes, which may be another test's.
for attempt in range(30):
    found = [config for config in can.detect_available_configs("socketcand") if config["port"] == port]
    if found:
        break
assert [config["channel"] for config in found] == ["can0", "can1"], found
bus = can.Bus(interface="socketcand", host="127.0.0.1", port=port, channel="can0")
frames = [bus.recv(5) for _ in range(200)]
assert all(frame is not None for frame in frames)
assert any(frame.dlc == 0 for frame in frames) and any(frame.dlc == 8 and len(frame.data) == 8 for frame in frames)
assert any(frame.is_extended_id for frame in frames) and any(not frame.is_extended_id for frame in frames)
assert all(abs(frame.timestamp - time.time()) < 60 for frame in frames)
stamps = [frame.timestamp for frame in frames]
assert stamps == sorted(stamps)
bus.send(can.Message(arbitration_id=0x123, data=[0x80, 2, 3], is_extended_id=False))
bus.send(can.Message(arbitration_id=0x1ABBCCDD, data=[255], is_extended_id=True))
time.sleep(0.5)
bus.shutdown()
print("done")
"#;

#[test]
fn python_can_finds_hears_and_sends() {
    let Some(python) = peers::python_with("can") else { return };
    let board = board("load=30");
    let server = listen(&board, Role::Send);
    let listener = Device::over(board.link("listener", Role::Listen).unwrap(), "listener").unwrap();
    listener.listen(Channel::Can1, BITRATE_BPS).unwrap();
    let port = server.address().unwrap().port().to_string();
    let output = Command::new(&python).args(["-c", PROGRAM, &port]).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(String::from_utf8_lossy(&output.stdout), "done\n", "{errors}");
    listener.stop().unwrap();
    let sent: Vec<String> = listener
        .records()
        .filter_map(|record| match record.unwrap().event {
            TraceEvent::Frame { frame, direction: Direction::Tx, .. } => Some(frame.to_string()),
            _ => None,
        })
        .collect();
    assert_eq!(sent, ["123#800203", "1ABBCCDD#FF"]);
}
