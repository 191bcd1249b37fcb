use super::*;
use crate::active::testing::{Peer, Say, arrives, disturbed, run};

const MS: u64 = 1_000_000;

/// A server according to CiA 301, with a single object.
struct Server {
    object: Vec<u8>,
    has_blocks: bool,
    sending: Vec<u8>,
    toggle: u8,
    block_at: usize,
    writing: Vec<u8>,
    block_size: u8,
    next: u8,
    last_came: bool,
    /// How many of the next frames of a written block are lost on their way.
    deaf: u32,
}

impl Server {
    fn new(object: &[u8]) -> Self {
        Self {
            object: object.to_vec(),
            has_blocks: true,
            sending: vec![],
            toggle: 0,
            block_at: 0,
            writing: vec![],
            block_size: 10,
            next: 1,
            last_came: false,
            deaf: 0,
        }
    }

    fn block(&mut self, say: &mut Say) {
        let mut at = self.block_at;
        for number in 1..=127 {
            let end = self.sending.len().min(at + 7);
            let mut frame = [0; 8];
            frame[0] = number | u8::from(end == self.sending.len()) << 7;
            frame[1..=end - at].copy_from_slice(&self.sending[at..end]);
            say.push((u64::from(number) * MS, answer(frame)));
            at = end;
            if end == self.sending.len() {
                break;
            }
        }
    }
}

fn answer(bytes: [u8; 8]) -> Frame {
    Frame::from_bus(Id::standard_truncated(0x585), false, 8, bytes)
}

impl Peer for Server {
    fn hear(&mut self, id: Id, data: &[u8], say: &mut Say) {
        assert_eq!(id.raw(), 0x605);
        let data: [u8; 8] = data.try_into().unwrap();
        let size = (self.object.len() as u32).to_le_bytes();
        let mut reply = |bytes: [u8; 8]| say.push((MS, answer(bytes)));
        let with = |command: u8, rest: [u8; 4]| {
            [command, data[1], data[2], data[3], rest[0], rest[1], rest[2], rest[3]]
        };
        if self.next > 0 && self.block_at == usize::MAX {
            // Within a block being written.
            if self.deaf > 0 {
                self.deaf -= 1;
                if data[0] & 0x80 == 0 && data[0] & 0x7F < self.block_size {
                    return;
                }
            }
            let (number, last) = (data[0] & 0x7F, data[0] & 0x80 != 0);
            if number == self.next {
                self.writing.extend(&data[1..]);
                self.next += 1;
                self.last_came = last;
            }
            if last || number == self.block_size {
                reply([0xA2, self.next - 1, self.block_size, 0, 0, 0, 0, 0]);
                self.next = 1;
                if self.last_came {
                    self.block_at = 0;
                }
            }
            return;
        }
        match data[0] {
            0x80 | 0xA1 => {}
            0x40 if (1..=4).contains(&self.object.len()) => {
                let mut rest = [0; 4];
                rest[..self.object.len()].copy_from_slice(&self.object);
                reply(with(0x43 | (4 - self.object.len() as u8) << 2, rest));
            }
            0x40 => {
                (self.sending, self.toggle) = (self.object.clone(), 0);
                reply(with(0x41, size));
            }
            0x60 | 0x70 => {
                assert_eq!(data[0] >> 4 & 1, self.toggle);
                let rest = self.sending.split_off(self.sending.len().min(7));
                let part = std::mem::replace(&mut self.sending, rest);
                let mut frame = [0; 8];
                frame[0] = self.toggle << 4 | (7 - part.len() as u8) << 1 | u8::from(self.sending.is_empty());
                frame[1..=part.len()].copy_from_slice(&part);
                self.toggle ^= 1;
                reply(frame);
            }
            0xA4 | 0xC6 if !self.has_blocks => reply(with(0x80, abort::COMMAND.to_le_bytes())),
            0xA4 => {
                (self.sending, self.block_at) = (self.object.clone(), 0);
                reply(with(0xC6, size));
            }
            0xA3 => self.block(say),
            0xA2 => {
                self.block_at += 7 * usize::from(data[1]);
                if self.block_at >= self.sending.len() {
                    let unused = ((7 - self.sending.len() % 7) % 7) as u8;
                    let [low, high] = crc_of(&self.sending).to_le_bytes();
                    reply([0xC1 | unused << 2, low, high, 0, 0, 0, 0, 0]);
                } else {
                    self.block(say);
                }
            }
            0x23 | 0x27 | 0x2B | 0x2F => {
                self.object = data[4..8 - usize::from(data[0] >> 2 & 3)].to_vec();
                reply(with(0x60, [0; 4]));
            }
            0x21 => {
                (self.writing, self.toggle) = (vec![], 0);
                reply(with(0x60, [0; 4]));
            }
            0xC6 => {
                (self.writing, self.next, self.block_at, self.last_came) = (vec![], 1, usize::MAX, false);
                reply(with(0xA4, [self.block_size, 0, 0, 0]));
            }
            command if command & 0xE3 == 0xC1 => {
                let used = self.writing.len() - usize::from(command >> 2 & 7);
                self.writing.truncate(used);
                assert_eq!(crc_of(&self.writing), u16::from_le_bytes([data[1], data[2]]));
                self.object = self.writing.clone();
                reply([0xA1, 0, 0, 0, 0, 0, 0, 0]);
            }
            command if command >> 5 == 0 => {
                assert_eq!(command >> 4 & 1, self.toggle);
                self.writing.extend(&data[1..8 - usize::from(command >> 1 & 7)]);
                if command & 1 != 0 {
                    self.object = self.writing.clone();
                }
                reply([0x20 | self.toggle << 4, 0, 0, 0, 0, 0, 0, 0]);
                self.toggle ^= 1;
            }
            other => panic!("{other:02X}"),
        }
    }
}

fn client(job: SdoJob, by_blocks: bool) -> SdoClient {
    SdoClient::new(SdoIds::of(5), 0x2000, 1, job, by_blocks, 500 * MS)
}

fn bytes(length: usize) -> Vec<u8> {
    (0..length).map(|at| (at * 5 + 1) as u8).collect()
}

fn transfer(mut client: SdoClient, server: &mut impl Peer) -> Result<Vec<u8>, SdoError> {
    run(&mut client, server, arrives);
    client.finish()
}

#[test]
fn objects_of_any_length_are_read_and_written_in_every_way() {
    for length in [0, 1, 3, 4, 5, 7, 8, 14, 69, 70, 71, 889, 890, 2000] {
        for by_blocks in [false, true] {
            // An empty block has no frame that could say so.
            if length > 0 || !by_blocks {
                let mut server = Server::new(&bytes(length));
                assert_eq!(
                    transfer(client(SdoJob::Read, by_blocks), &mut server),
                    Ok(bytes(length)),
                    "{length}"
                );
            }
            let mut server = Server::new(&[9]);
            let written = transfer(client(SdoJob::Write(bytes(length)), by_blocks), &mut server);
            assert_eq!((written, server.object), (Ok(vec![]), bytes(length)), "{length} {by_blocks}");
        }
    }
}

#[test]
fn frames_of_a_written_block_that_were_lost_are_sent_again() {
    let mut server = Server::new(&[9]);
    server.deaf = 25;
    assert_eq!(transfer(client(SdoJob::Write(bytes(300)), true), &mut server), Ok(vec![]));
    assert_eq!(server.object, bytes(300));
}

#[test]
fn a_node_that_refuses_is_understood_by_name() {
    let mut server = Server::new(&bytes(30));
    server.has_blocks = false;
    let error = transfer(client(SdoJob::Read, true), &mut server).unwrap_err();
    assert_eq!(error, SdoError::Aborted { code: abort::COMMAND });
    assert!(error.to_string().contains("command specifier not valid or unknown (05040001)"), "{error}");
}

/// Every misbehaviour of a node gives an error in bounded time, and the node is told.
#[test]
fn whatever_the_node_does_there_is_an_end() {
    let fails = |by_blocks: bool, job: SdoJob, lie: &dyn Fn(&[u8], &mut Say)| {
        let mut client = client(job, by_blocks);
        let mut peer = |_: Id, data: &[u8], say: &mut Say| lie(data, say);
        let (took_ns, sent) = run(&mut client, &mut peer, arrives);
        assert!(took_ns < 60_000 * MS, "{took_ns}");
        (client.finish().unwrap_err(), sent.last().unwrap().data()[0])
    };
    let begin = |say: &mut Say, frame: [u8; 8]| say.push((MS, answer(frame)));
    let (error, last) = fails(false, SdoJob::Read, &|_, _| {});
    assert_eq!((error, last), (SdoError::NoAnswer { after_ms: 500, done: 0 }, 0x80));
    // The same toggle bit for ever; empty segments for ever; more than was announced; a command out of place.
    let segments = |frame: [u8; 8]| {
        move |data: &[u8], say: &mut Say| match data[0] {
            0x40 => begin(say, [0x41, 0, 0x20, 1, 20, 0, 0, 0]),
            0x80 => {}
            _ => begin(say, frame),
        }
    };
    for (frame, code) in [
        ([0x00, 1, 2, 3, 4, 5, 6, 7], abort::TOGGLE),
        ([0x0E, 0, 0, 0, 0, 0, 0, 0], abort::LENGTH),
        ([0x01, 1, 2, 3, 4, 5, 6, 7], abort::LENGTH),
        ([0xE0, 0, 0, 0, 0, 0, 0, 0], abort::COMMAND),
    ] {
        let (error, last) = fails(false, SdoJob::Read, &segments(frame));
        assert!(matches!(error, SdoError::Wrong { code: is, .. } if is == code), "{frame:02X?}: {error}");
        assert_eq!(last, 0x80);
    }
    // Blocks: the wrong numbers for ever, a wrong CRC.
    let (error, _) = fails(true, SdoJob::Read, &|data, say| match data[0] {
        0xA4 => begin(say, [0xC4, 0, 0x20, 1, 0, 0, 0, 0]),
        0x80 => {}
        _ => begin(say, [0x85, 0, 0, 0, 0, 0, 0, 0]),
    });
    assert!(matches!(error, SdoError::Wrong { code: abort::SEQUENCE, .. }), "{error}");
    let (error, _) = fails(true, SdoJob::Read, &|data, say| match data[0] {
        0xA4 => begin(say, [0xC4, 0, 0x20, 1, 0, 0, 0, 0]),
        0xA3 => begin(say, [0x81, 1, 2, 3, 4, 5, 6, 7]),
        0xA2 => begin(say, [0xC1, 0, 0, 0, 0, 0, 0, 0]),
        _ => {}
    });
    assert!(matches!(error, SdoError::Wrong { code: abort::CRC, .. }), "{error}");
    // A written block that is never understood.
    let (error, _) = fails(true, SdoJob::Write(bytes(100)), &|data, say| match data[0] {
        0xC6 => begin(say, [0xA4, 0, 0x20, 1, 4, 0, 0, 0]),
        4 => begin(say, [0xA2, 0, 4, 0, 0, 0, 0, 0]),
        _ => {}
    });
    assert!(matches!(error, SdoError::Wrong { code: abort::SEQUENCE, .. }), "{error}");
}

/// What is reported as read is what is there, whatever is dropped, doubled or swapped.
#[test]
fn no_disturbance_makes_a_wrong_value() {
    let mut random = fastrand::Rng::with_seed(301);
    let (mut whole, mut failed) = (0, 0);
    for _ in 0..600 {
        let object = bytes(random.usize(1..400));
        let mut server = Server::new(&object);
        let mut client = client(SdoJob::Read, random.bool());
        run(&mut client, &mut server, disturbed(&mut random, 20));
        match client.finish() {
            Ok(read) => {
                assert_eq!(read, object);
                whole += 1;
            }
            Err(_) => failed += 1,
        }
    }
    assert!(whole > 50 && failed > 50, "{whole} {failed}");
}

#[test]
fn a_loss_ends_segments() {
    let mut client = client(SdoJob::Read, false);
    assert!(client.next(0).is_some());
    client.sent(1);
    client.gap(2);
    assert_eq!(client.next(3).unwrap().data()[0], 0x80);
    assert_eq!(client.finish(), Err(SdoError::FramesLost));
}

/// Not when 16 MiB have come.
#[test]
fn a_node_that_sends_more_than_it_announced_is_stopped_at_once() {
    for by_blocks in [false, true] {
        let mut client = client(SdoJob::Read, by_blocks);
        let mut node = |_: Id, data: &[u8], say: &mut Say| match data[0] {
            0x40 => say.push((MS, answer([0x41, 0, 0x20, 1, 10, 0, 0, 0]))),
            0xA4 => say.push((MS, answer([0xC6, 0, 0x20, 1, 10, 0, 0, 0]))),
            0x60 | 0x70 => say.push((MS, answer([data[0] & 0x10, 1, 2, 3, 4, 5, 6, 7]))),
            0xA3 => say.extend(
                (1..127).map(|number| (MS * u64::from(number), answer([number, 1, 2, 3, 4, 5, 6, 7]))),
            ),
            _ => {}
        };
        let (_, sent) = run(&mut client, &mut node, arrives);
        assert!(sent.len() < 6 && sent.last().unwrap().data()[0] == 0x80, "{sent:?}");
        assert!(matches!(client.finish(), Err(SdoError::Wrong { code: abort::LENGTH, done: 14..=21 })));
    }
}

#[test]
fn an_answer_of_less_than_8_bytes_is_no_answer() {
    let mut client = client(SdoJob::Read, false);
    let short = Frame::data_frame(Id::standard_truncated(0x585), &[0x43, 0, 0x20, 1, 9]).unwrap();
    let mut node = |_: Id, data: &[u8], say: &mut Say| {
        if data[0] == 0x40 {
            say.push((MS, short));
        }
    };
    let (_, sent) = run(&mut client, &mut node, arrives);
    assert_eq!(sent.last().unwrap().data(), [0x80, 0, 0x20, 1, 0x10, 0, 7, 6]);
    assert_eq!(client.finish(), Err(SdoError::Wrong { code: abort::LENGTH, done: 0 }));
}

/// Otherwise its server would be busy for as long as it waits.
#[test]
fn a_node_is_told_when_a_transfer_is_cancelled() {
    let mut new = client(SdoJob::Read, true);
    assert_eq!(new.cancel(), None);
    assert!(new.next(0).is_some());
    new.sent(1);
    new.hear(2, Id::standard_truncated(0x585), &[0xC4, 0, 0x20, 1, 0, 0, 0, 0]);
    assert!(new.next(3).is_some());
    assert_eq!(new.cancel().unwrap().data(), [0x80, 0, 0x20, 1, 0, 0, 0, 8]);
    assert!(new.is_done() && new.cancel().is_none() && new.next(4).is_none());
    assert_eq!(new.finish(), Err(SdoError::Cancelled { done: 0 }));
}

/// A node that sends frames for ever, none of which continues the block.
#[test]
fn a_block_that_does_not_go_on_is_given_up_in_time() {
    for number in [1, 5, 127] {
        let mut client = SdoClient::new(SdoIds::of(5), 0x2000, 1, SdoJob::Read, true, 1000 * MS);
        let mut peer = |_: Id, data: &[u8], say: &mut Say| match data[0] {
            0xA4 => say.push((MS, answer([0xC2, data[1], data[2], data[3], 100, 0, 0, 0]))),
            0xA3 => {
                // The first one continues it, and then never another.
                say.extend((0..3000).map(|at| (at * 10 * MS, answer([number, 1, 2, 3, 4, 5, 6, 7]))));
            }
            _ => {}
        };
        let (took_ns, sent) = run(&mut client, &mut peer, arrives);
        let error = client.finish().unwrap_err();
        assert!(matches!(error, SdoError::Stalled { .. } | SdoError::Wrong { .. }), "{number}: {error}");
        assert!(took_ns < 6000 * MS, "{number}: {took_ns}");
        assert_eq!(sent.last().unwrap().data()[0], 0x80, "{number}");
    }
}

/// The end of a block that is missing again and again: fewer tries than the number allows, if each takes long.
#[test]
fn a_block_without_an_end_is_asked_for_again_for_a_bounded_time() {
    let mut client = SdoClient::new(SdoIds::of(5), 0x2000, 1, SdoJob::Read, true, 1000 * MS);
    let mut peer = |_: Id, data: &[u8], say: &mut Say| match data[0] {
        0xA4 => say.push((MS, answer([0xC2, data[1], data[2], data[3], 100, 0, 0, 0]))),
        0xA3 => say.push((MS, answer([1, 1, 2, 3, 4, 5, 6, 7]))),
        _ => {}
    };
    let (took_ns, _) = run(&mut client, &mut peer, arrives);
    assert!(matches!(client.finish(), Err(SdoError::NoAnswer { .. } | SdoError::Stalled { .. })));
    assert!(took_ns < 6000 * MS, "{took_ns}");
}

/// A node that answers each request just in time.
#[test]
fn a_transfer_ends_when_patience_does() {
    let mut client = SdoClient::new(SdoIds::of(5), 0x2000, 1, SdoJob::Read, false, 1000 * MS);
    client.set_patience(60_000 * MS);
    let mut toggle = 0x10;
    let mut peer = |_: Id, data: &[u8], say: &mut Say| match data[0] {
        0x40 => say.push((900 * MS, answer([0x40, data[1], data[2], data[3], 0, 0, 0, 0]))),
        0x80 => {}
        _ => {
            toggle ^= 0x10;
            say.push((900 * MS, answer([toggle, 1, 2, 3, 4, 5, 6, 7])));
        }
    };
    let (took_ns, sent) = run(&mut client, &mut peer, arrives);
    assert!((60_000 * MS..62_000 * MS).contains(&took_ns), "{took_ns}");
    assert!(matches!(client.finish(), Err(SdoError::TooSlow { after_s: 60, done: 455.. })));
    assert_eq!(sent.last().unwrap().data()[0], 0x80);
}

/// Two clients on one channel: what the node answers may be for the other, and an abort would end its transfer.
#[test]
fn another_client_of_the_same_channel_ends_it() {
    let mut client = SdoClient::new(SdoIds::of(5), 0x2000, 1, SdoJob::Read, false, 1000 * MS);
    client.hear(0, SdoIds::of(5).request, &[0x40, 0, 0x10, 0, 0, 0, 0, 0]);
    assert!(client.next(1).is_some() && !client.is_done());
    client.sent(2);
    client.hear(3, SdoIds::of(6).request, &[0x40, 0, 0x20, 1, 0, 0, 0, 0]);
    assert!(!client.is_done());
    client.hear(3, SdoIds::of(5).request, &[0x40, 0, 0x20, 1, 0, 0, 0, 0]);
    assert!(client.is_done());
    assert_eq!(client.next(4), None);
    assert_eq!(client.finish(), Err(SdoError::OtherClient { done: 0 }));
}
