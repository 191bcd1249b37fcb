//! Clients and servers that send anything: from a seed, so that what fails can be run again. Nobody panics, nobody hangs, and whoever comes
//! next is served.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cantap::device::{Link, encode};
use cantap::wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal, unseal};
use cantap::wire::message::Role;
use cantap::wire::{Command, PROTOCOL_VERSION, Request};
use cantap::{Channel, Device};
use cantap_serve::{Board, Settings, lines, listen, socketcand};
use cantap_testing::process::wait_until;

const BITRATE_BPS: u32 = 500_000;

/// xorshift64*, which needs no crate.
struct Random(u64);

impl Random {
    const fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) as usize % limit.max(1)
    }

    fn bytes(&mut self, most: usize) -> Vec<u8> {
        (0..=self.below(most)).map(|_| self.below(256) as u8).collect()
    }

    /// Changes a message in a few places.
    fn spoil(&mut self, message: &mut Vec<u8>) {
        const LIKED: [u8; 8] = [0, 1, 2, 0x41, 0x43, 0x7F, 0x80, 0xFF];
        for _ in 0..=self.below(3) {
            let at = self.below(message.len());
            match self.below(4) {
                0 if !message.is_empty() => message[at] = LIKED[self.below(LIKED.len())],
                1 => {
                    // A number that does not end, or a huge one.
                    let run = vec![0xFF; self.below(11) + 1];
                    message.splice(at..at, run);
                }
                2 if !message.is_empty() => {
                    let until = (at + self.below(9) + 1).min(message.len());
                    message.drain(at..until);
                }
                _ => {
                    let new = self.bytes(8);
                    message.splice(at..at, new);
                }
            }
        }
        message.truncate(MAX_MESSAGE);
    }
}

/// A message with a right CRC, between two zeros.
fn sealed(message: &[u8]) -> Vec<u8> {
    let mut buffer = [message, &[0; CRC_LEN]].concat();
    let mut out = vec![0; MAX_ENCODED];
    let len = seal(&mut buffer, message.len(), &mut out).unwrap_or(0);
    out.truncate(len);
    [&[0], out.as_slice()].concat()
}

fn unsealed(encoded: &[u8]) -> Option<Vec<u8>> {
    let mut out = vec![0; MAX_ENCODED];
    unseal(encoded, &mut out).ok().map(<[u8]>::to_vec)
}

/// Counts panics in threads of ours, which would otherwise go unseen.
fn panics() -> Arc<AtomicUsize> {
    let count = Arc::new(AtomicUsize::new(0));
    let (counted, before) = (Arc::clone(&count), std::panic::take_hook());
    std::panic::set_hook(Box::new(move |info| {
        if std::thread::current().name().is_some_and(|name| name.starts_with("cantap")) {
            counted.fetch_add(1, Ordering::Relaxed);
        }
        before(info);
    }));
    count
}

fn board() -> Arc<Board> {
    let options: cantap_virtual::Options = "load=30".parse().unwrap();
    let connect = Box::new(move |_: Option<&str>| Ok(cantap_virtual::start(options.clone())?.into_link()));
    Arc::new(Board::start("board", connect, Settings::at(BITRATE_BPS), |_| {}).unwrap())
}

/// What a hostile client of our own protocol sends.
fn native(random: &mut Random) -> Vec<u8> {
    let mut out = vec![0];
    if random.below(5) > 0 {
        out.extend(
            encode(&Request { id: 1, command: Command::Hello { protocol: PROTOCOL_VERSION } }).unwrap(),
        );
    }
    for id in 2..random.below(20) as u16 + 2 {
        let channel = Channel::ALL[random.below(2)];
        let command = match random.below(8) {
            0 => Command::Open { channel, config: None },
            1 => Command::Close { channel },
            2 => Command::Status,
            3 => Command::Abort { channel },
            4 => Command::SetPeriodic { channel, slot: random.below(256) as u8, entry: None },
            5 => Command::Identify { seconds: 255 },
            6 => Command::Hello { protocol: random.below(8) as u16 },
            _ => Command::Failures,
        };
        let request = encode(&Request { id, command }).unwrap();
        match (random.below(4), unsealed(&request[..request.len() - 1])) {
            (0, _) => out.extend(request),
            (1, _) => out.extend(random.bytes(300)),
            (_, Some(mut message)) => {
                random.spoil(&mut message);
                out.extend(sealed(&message));
            }
            _ => {}
        }
    }
    out
}

/// What a hostile client of socketcand sends.
fn text(random: &mut Random) -> Vec<u8> {
    const WORDS: [&str; 24] = [
        "open",
        "can0",
        "can1",
        "rawmode",
        "bcmmode",
        "controlmode",
        "send",
        "sendrtr",
        "add",
        "update",
        "delete",
        "filter",
        "muxfilter",
        "subscribe",
        "statistics",
        "echo",
        "0",
        "8",
        "-80",
        "7fffffffffffffffffff",
        "0x",
        "123",
        "B",
        "\u{202e}\u{9b}",
    ];
    let mut out = if random.below(3) > 0 { b"< open can0 >".to_vec() } else { Vec::new() };
    for _ in 0..random.below(40) {
        out.extend(b"< ");
        for _ in 0..random.below(12) {
            out.extend(WORDS[random.below(WORDS.len())].as_bytes());
            out.push(b' ');
        }
        out.extend(if random.below(4) == 0 { random.bytes(40) } else { b">".to_vec() });
    }
    out
}

/// Sends something in pieces, and ends in one of the ways in which a connection can.
fn attack(address: SocketAddr, bytes: &[u8], random: &mut Random) {
    let Ok(mut stream) = TcpStream::connect(address) else { return };
    let _ = stream.set_read_timeout(Some(Duration::from_millis(5)));
    let piece = random.below(bytes.len()) + 1;
    for bytes in bytes.chunks(piece.max(20)) {
        if stream.write_all(bytes).is_err() {
            return;
        }
        let _ = stream.read(&mut [0; 512]);
    }
    if random.below(2) == 0 {
        // Half open.
        let _ = stream.shutdown(Shutdown::Write);
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn whatever_clients_send_the_next_one_is_served() {
    let panics = panics();
    let board = board();
    let at = || "127.0.0.1:0".parse().unwrap();
    let doors = [
        listen::tcp(&board, at(), Role::Configure).unwrap(),
        socketcand::listen(std::slice::from_ref(&board), at(), Role::Send).unwrap(),
        lines::listen(std::slice::from_ref(&board), at()).unwrap(),
    ];
    let good = Device::over(board.link("good", Role::Listen).unwrap(), "good").unwrap();
    for channel in Channel::ALL {
        good.listen(channel, BITRATE_BPS).unwrap();
    }
    for seed in 0..60 {
        let mut random = Random::new(seed);
        for door in &doors {
            let bytes = match random.below(3) {
                0 => native(&mut random),
                1 => text(&mut random),
                _ => random.bytes(2000),
            };
            attack(door.address().unwrap(), &bytes, &mut random);
        }
    }
    wait_until("strangers are still there", || board.clients() <= 1);
    let next = Device::over(board.link("next", Role::Listen).unwrap(), "next").unwrap();
    next.listen(Channel::Can1, BITRATE_BPS).unwrap();
    assert!(next.records().next().unwrap().is_ok());
    good.stop().unwrap();
    let counters = good.counters();
    assert!(
        counters.channels.iter().all(|channel| channel.received > 0 && channel.lost() == 0),
        "{counters:?}"
    );
    assert_eq!(panics.load(Ordering::Relaxed), 0);
}

/// Between a real server and a client: messages are changed and sealed again.
struct Liar {
    reader: Box<dyn Read + Send>,
    random: Random,
    partial: Vec<u8>,
    out: Vec<u8>,
    messages: usize,
}

impl Read for Liar {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let mut bytes = [0; 4096];
        if self.out.is_empty() {
            let len = self.reader.read(&mut bytes)?;
            if len == 0 {
                return Ok(0);
            }
            for byte in &bytes[..len] {
                if *byte != 0 {
                    self.partial.push(*byte);
                    continue;
                }
                let encoded = std::mem::take(&mut self.partial);
                let Some(mut message) = unsealed(&encoded) else { continue };
                self.messages += 1;
                // The greeting mostly passes, so that there is something to lie about.
                let rarely = self.messages < 12 || message.first() != Some(&0);
                if self.random.below(if rarely { 50 } else { 3 }) == 0 {
                    self.random.spoil(&mut message);
                }
                self.out.extend(sealed(&message));
            }
            if self.out.is_empty() {
                return Err(io::ErrorKind::WouldBlock.into());
            }
        }
        let len = into.len().min(self.out.len());
        into[..len].copy_from_slice(&self.out[..len]);
        self.out.drain(..len);
        Ok(len)
    }
}

#[test]
fn a_server_that_lies_is_an_error_at_worst() {
    let panics = panics();
    let board = board();
    let mut heard = 0;
    for seed in 0..40 {
        let Link { reader, writer, keep_alive } = board.link("lied to", Role::Listen).unwrap();
        let (partial, out) = (Vec::new(), Vec::new());
        let liar = Liar { reader, random: Random::new(seed), partial, out, messages: 0 };
        let link = Link { reader: Box::new(liar), writer, keep_alive };
        let began = Instant::now();
        if let Ok(device) = Device::over(link, "liar") {
            let _ = device.listen(Channel::Can1, BITRATE_BPS);
            let _ = device.status();
            let mut records = device.records();
            for _ in 0..10 {
                let Ok(Some(batch)) = records.next_batch(Duration::from_millis(10)) else { break };
                heard += batch.len();
            }
            let _ = device.stop();
        }
        assert!(began.elapsed() < Duration::from_mins(1), "seed {seed} took {:?}", began.elapsed());
    }
    assert!(heard > 0, "nothing was lied about");
    assert_eq!(panics.load(Ordering::Relaxed), 0);
}
