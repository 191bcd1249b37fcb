use super::*;
use crate::active::testing::{Say, arrives, disturbed, run};

fn endpoint(text: &str) -> Endpoint {
    format!("{text}:7FF").parse::<crate::iso_tp::Pair>().map(|pair| pair.a).unwrap()
}

fn physical(request: &[u8]) -> Exchange {
    with(request, TransferSettings::default())
}

fn with(request: &[u8], settings: TransferSettings) -> Exchange {
    let (to, from) = (endpoint("7E0"), endpoint("7E8"));
    let answerer = Answerer::One { from, flow_to: to };
    Exchange::new(to, answerer, request.to_vec(), settings, ResponseTiming::default())
}

/// A server that follows ISO 15765-2, and its side effects.
struct Server {
    answers: Vec<Vec<u8>>,
    block_size: u8,
    separation: u8,
    waits: u32,
    receiving: Vec<u8>,
    length: usize,
    left: u8,
    sending: Vec<u8>,
    at: usize,
    number: u8,
    requests: Vec<Vec<u8>>,
}

const MS: u64 = 1_000_000;

impl Server {
    fn new(answers: &[&[u8]]) -> Self {
        Self {
            answers: answers.iter().map(|answer| answer.to_vec()).collect(),
            block_size: 0,
            separation: 0,
            waits: 0,
            receiving: vec![],
            length: 0,
            left: 0,
            sending: vec![],
            at: 0,
            number: 1,
            requests: vec![],
        }
    }

    fn frame(bytes: &[u8]) -> Frame {
        Frame::data_frame(Id::standard_truncated(0x7E8), bytes).unwrap()
    }

    fn flow(&self, say: &mut Say) {
        for wait in 0..self.waits {
            say.push((u64::from(wait) * 500 * MS, Self::frame(&[0x31, 0, 0])));
        }
        say.push((u64::from(self.waits) * 500 * MS, Self::frame(&[0x30, self.block_size, self.separation])));
    }

    fn whole(&mut self, request: Vec<u8>, say: &mut Say) {
        self.requests.push(request);
        for (after, answer) in (1..).zip(self.answers.clone()) {
            if answer.len() <= 7 {
                say.push((after * 40 * MS, Self::frame(&[&[answer.len() as u8], &answer[..]].concat())));
            } else {
                let head = [0x10 | (answer.len() >> 8) as u8, answer.len() as u8];
                say.push((after * 40 * MS, Self::frame(&[&head, &answer[..6]].concat())));
                (self.sending, self.at, self.number) = (answer, 6, 1);
            }
        }
    }
}

impl super::super::testing::Peer for Server {
    fn hear(&mut self, id: Id, data: &[u8], say: &mut Say) {
        assert_eq!(id.raw(), 0x7E0);
        match data[0] >> 4 {
            0 => self.whole(data[1..=usize::from(data[0])].to_vec(), say),
            1 => {
                self.length = usize::from(data[0] & 15) << 8 | usize::from(data[1]);
                self.receiving = data[2..].to_vec();
                self.left = self.block_size;
                self.flow(say);
            }
            2 => {
                self.receiving.extend(&data[1..]);
                if self.receiving.len() >= self.length {
                    self.receiving.truncate(self.length);
                    let request = std::mem::take(&mut self.receiving);
                    self.whole(request, say);
                } else if self.block_size > 0 {
                    self.left -= 1;
                    if self.left == 0 {
                        self.left = self.block_size;
                        self.flow(say);
                    }
                }
            }
            _ => {
                assert_eq!(data[0], 0x30);
                let mut after = 0;
                let mut block = data[1];
                while self.at < self.sending.len() {
                    let end = self.sending.len().min(self.at + 7);
                    after += MS;
                    say.push((
                        after,
                        Self::frame(&[&[0x20 | self.number], &self.sending[self.at..end]].concat()),
                    ));
                    (self.at, self.number) = (end, (self.number + 1) & 15);
                    block = block.wrapping_sub(1);
                    if block == 0 {
                        break;
                    }
                }
            }
        }
    }
}

fn answers(mut exchange: Exchange, server: &mut Server) -> Result<Vec<Vec<u8>>, ExchangeError> {
    run(&mut exchange, server, arrives);
    exchange.finish().map(|(answers, _)| answers.into_iter().map(|answer| answer.data).collect())
}

fn long(sid: u8, length: usize) -> Vec<u8> {
    let mut data = vec![sid, 0xF1, 0x90];
    data.extend((3..length).map(|at| (at * 7) as u8));
    data
}

#[test]
fn requests_and_answers_of_any_length_arrive_whole() {
    for length in [3, 7, 8, 13, 14, 62, 200, 4095, 5000] {
        // This server supports only short lengths; longer messages are requested from it.
        let (request, answer) = (long(0x2E, length.min(4095)), long(0x6E, length.min(4095)));
        for (block_size, separation) in [(0, 0), (1, 0), (8, 2), (3, 0xF5)] {
            let mut server = Server::new(&[&answer]);
            (server.block_size, server.separation) = (block_size, separation);
            let settings = TransferSettings {
                block_size: 15 - block_size,
                padding: None,
                ..TransferSettings::default()
            };
            assert_eq!(answers(with(&request, settings), &mut server), Ok(vec![answer.clone()]), "{length}");
            assert_eq!(server.requests, std::slice::from_ref(&request));
        }
    }
}

#[test]
fn the_least_distance_that_the_server_asks_for_is_kept() {
    let mut server = Server::new(&[&[0x6E, 0xF1, 0x90]]);
    server.separation = 20;
    let mut exchange = physical(&long(0x2E, 6 + 7 * 10));
    let (took_ns, sent) = run(&mut exchange, &mut server, arrives);
    assert_eq!(sent.len(), 11);
    assert!(took_ns >= 9 * 20 * MS, "{took_ns}");
}

#[test]
fn answers_that_are_pending_are_waited_for() {
    let mut server = Server::new(&[&[0x7F, 0x22, 0x78], &[0x7F, 0x22, 0x78], &long(0x62, 30)]);
    let mut exchange = physical(&[0x22, 0xF1, 0x90]);
    run(&mut exchange, &mut server, arrives);
    let (answers, _) = exchange.finish().unwrap();
    assert_eq!((answers[0].pending, &answers[0].data), (2, &long(0x62, 30)));
}

#[test]
fn refusals_are_answers_and_those_of_another_request_are_none() {
    let refused = |answer: &[u8]| {
        let mut server = Server::new(&[answer]);
        let mut exchange = physical(&[0x22, 0xF1, 0x90]);
        run(&mut exchange, &mut server, arrives);
        exchange.finish().map(|(answers, _)| answers[0].refusal())
    };
    assert_eq!(refused(&[0x7F, 0x22, 0x31]), Ok(Some(0x31)));
    for other in [&[0x7F, 0x10, 0x12][..], &[0x62, 0xF1, 0x8C, 1], &[0x50, 3], &[0x62]] {
        assert_eq!(
            refused(other),
            Err(ExchangeError::NoAnswer { after_ms: 1000, others: 1 }),
            "{other:02X?}"
        );
    }
}

#[test]
fn a_request_that_wants_no_answer_ends_well_without_one() {
    assert_eq!(answers(physical(&[0x3E, 0x80]), &mut Server::new(&[])), Ok(vec![]));
    assert_eq!(
        answers(physical(&[0x3E, 0x00]), &mut Server::new(&[])),
        Err(ExchangeError::NoAnswer { after_ms: 1000, others: 0 })
    );
    assert_eq!(
        answers(physical(&[0x3E, 0x80]), &mut Server::new(&[&[0x7F, 0x3E, 0x12]])),
        Ok(vec![vec![0x7F, 0x3E, 0x12]])
    );
}

#[test]
fn all_who_answer_a_request_to_all_are_heard() {
    let mut exchange = Exchange::new(
        endpoint("7DF"),
        Answerer::Any11Bit,
        vec![0x09, 0x02],
        TransferSettings::default(),
        ResponseTiming::default(),
    );
    let frame = |id: u32, bytes: &[u8]| Frame::data_frame(Id::standard_truncated(id), bytes).unwrap();
    let mut flows = Vec::new();
    let mut peer = |id: Id, data: &[u8], say: &mut Say| {
        if id.raw() == 0x7DF {
            say.push((5 * MS, frame(0x7E9, &[3, 0x49, 2, 1])));
            say.push((6 * MS, frame(0x7E8, &[0x10, 10, 0x49, 2, 1, b'V', b'I', b'N'])));
            // Broken: the second frame is missing.
            say.push((7 * MS, frame(0x7EA, &[0x10, 20, 0x49, 2, 1, 1, 2, 3])));
            say.push((8 * MS, frame(0x7EA, &[0x22, 0, 0, 0, 0, 0, 0, 0])));
            say.push((9 * MS, frame(0x6E8, &[3, 0x49, 2, 1])));
        } else {
            flows.push((id.raw(), data[0]));
            if id.raw() == 0x7E0 {
                say.push((500 * MS, frame(0x7E8, &[0x21, 1, 2, 3, 4])));
            }
        }
    };
    run(&mut exchange, &mut peer, arrives);
    let (answers, broken) = exchange.finish().unwrap();
    let said: Vec<_> = answers.iter().map(|answer| (answer.from.id.raw(), answer.data.len())).collect();
    assert_eq!(said, [(0x7E9, 3), (0x7E8, 10)]);
    assert_eq!(broken.len(), 1);
    assert_eq!(flows, [(0x7E0, 0x30), (0x7E2, 0x30)]);
}

/// Every misbehaviour of a peer gives an error in bounded time.
#[test]
fn whatever_the_server_does_there_is_an_end() {
    let frame = |bytes: &[u8]| Frame::data_frame(Id::standard_truncated(0x7E8), bytes).unwrap();
    let fails = |request: &[u8], lie: &dyn Fn(&[u8], &mut Say)| {
        let mut exchange = physical(request);
        let mut peer = |_: Id, data: &[u8], say: &mut Say| lie(data, say);
        let (took_ns, _) = run(&mut exchange, &mut peer, arrives);
        (took_ns / 1_000_000_000, exchange.finish().unwrap_err())
    };
    // Pending for ever.
    let (seconds, error) = fails(&[0x22, 0xF1, 0x90], &|_, say| {
        say.extend((0..100).map(|n| (n * 1000 * MS, frame(&[3, 0x7F, 0x22, 0x78]))));
    });
    assert!(seconds <= 61 && matches!(error, ExchangeError::EndlessPending { .. }), "{error}");
    // An answer that goes on for ever, a block at a time, is not called pending.
    let (seconds, error) = fails(&[0x22, 0xF1, 0x90], &|data, say| {
        if data[0] == 3 {
            say.push((0, frame(&[0x1F, 0xFF, 0x62, 0xF1, 0x90, 1, 2, 3])));
            say.extend(
                (1..500).map(|n| (n * 900 * MS, frame(&[0x20 | (n & 15) as u8, 0, 0, 0, 0, 0, 0, 0]))),
            );
        }
    });
    assert_eq!((seconds, error), (60, ExchangeError::TooSlow { after_ms: 60_000 }));
    // A request that is taken a frame at a time, after as many waits as may be each time.
    let (seconds, error) = fails(&long(0x2E, 4095), &|_, say| {
        say.extend((0..10).map(|n| (n * 900 * MS, frame(&[0x31, 0, 0]))));
        say.push((9000 * MS, frame(&[0x30, 1, 0])));
    });
    assert_eq!((seconds, error), (60, ExchangeError::RequestTooSlow { after_ms: 60_000 }));
    // Pending, and then nothing more.
    let (seconds, error) = fails(&[0x22, 0xF1, 0x90], &|_, say| say.push((0, frame(&[3, 0x7F, 0x22, 0x78]))));
    assert_eq!((seconds, error), (5, ExchangeError::NothingAfterPending { times: 1, after_ms: 5000 }));
    // Wait for ever, overflow, silence, nonsense.
    let request = long(0x2E, 40);
    let (_, error) = fails(&request, &|_, say| {
        say.extend((0..1000).map(|n| (n * 900 * MS, frame(&[0x31, 0, 0]))));
    });
    assert!(matches!(error, ExchangeError::Request(TransferError::EndlessWait { times: 11, .. })), "{error}");
    let (_, error) = fails(&request, &|_, say| say.push((0, frame(&[0x32, 0, 0]))));
    assert_eq!(error, ExchangeError::Request(TransferError::Overflow { length: 40 }));
    let (seconds, error) = fails(&request, &|_, _| {});
    assert!(
        seconds == 1 && matches!(error, ExchangeError::Request(TransferError::NoFlowControl { .. })),
        "{error}"
    );
    let (_, error) = fails(&request, &|_, say| say.push((0, frame(&[0x35, 0, 0]))));
    assert!(matches!(error, ExchangeError::Answer { error: TransferError::Malformed(_), .. }), "{error}");
    // Wrong numbers, an answer that stops, one with an implausible length.
    let begin = frame(&[0x10, 20, 0x62, 0xF1, 0x90, 1, 2, 3]);
    let (_, error) = fails(&[0x22, 0xF1, 0x90], &|data, say| match data[0] {
        3 => say.push((0, begin)),
        _ => say.push((0, frame(&[0x23, 0, 0, 0, 0, 0, 0, 0]))),
    });
    let expected = TransferError::Sequence { expected: 1, got: 3, received: 6, length: 20 };
    assert_eq!(error, ExchangeError::Answer { from: endpoint("7E8"), error: expected });
    let (_, error) = fails(&[0x22, 0xF1, 0x90], &|data, say| {
        if data[0] == 3 {
            say.push((0, begin));
        }
    });
    assert!(matches!(
        error,
        ExchangeError::Answer { error: TransferError::NextMissing { received: 6, .. }, .. }
    ));
    let (_, error) =
        fails(&[0x22, 0xF1, 0x90], &|_, say| say.push((0, frame(&[0x10, 0, 0xFF, 0xFF, 0xFF, 0xFF, 1, 2]))));
    assert!(matches!(error, ExchangeError::Answer { error: TransferError::TooLong { .. }, .. }), "{error}");
}

/// What another tester asked the same ECU may have been answered, and not our request.
#[test]
fn another_tester_is_noticed() {
    let heard = |theirs: &[u8], answer: &[u8]| {
        let mut exchange = physical(&[0x22, 0xF1, 0x90]);
        assert!(exchange.next(0).is_some());
        exchange.sent(1);
        exchange.hear(2, Id::standard_truncated(0x7E0), theirs);
        // Their flow control, and what is not theirs.
        exchange.hear(3, Id::standard_truncated(0x7E0), &[0x30, 0, 0]);
        exchange.hear(3, Id::standard_truncated(0x7E1), theirs);
        exchange.hear(4, Id::standard_truncated(0x7E8), answer);
        assert!(exchange.is_done());
        (exchange.rivals(), exchange.doubtful())
    };
    assert_eq!(heard(&[2, 0x3E, 0], &[4, 0x62, 0xF1, 0x90, 1]), (1, 0));
    assert_eq!(heard(&[3, 0x22, 1, 2], &[3, 0x7F, 0x22, 0x31]), (1, 1));
    assert_eq!(heard(&[0x30, 0, 0], &[3, 0x7F, 0x22, 0x31]), (0, 0));
}

#[test]
fn a_loss_in_the_middle_of_an_answer_is_its_end() {
    let mut exchange = physical(&[0x22, 0xF1, 0x90]);
    assert!(exchange.next(0).is_some());
    exchange.sent(1);
    exchange.hear(2, Id::standard_truncated(0x7E8), &[0x10, 20, 0x62, 0xF1, 0x90, 1, 2, 3]);
    exchange.gap(3);
    let error = exchange.finish().unwrap_err();
    assert!(matches!(error, ExchangeError::Answer { error: TransferError::FramesLost, .. }), "{error}");
}

/// If the device has sent flow control, it is not sent again; if its reply went to another frame, it is.
#[test]
fn flow_control_by_the_device_is_not_sent_twice() {
    let first = [0x10, 20, 0x62, 0xF1, 0x90, 1, 2, 3];
    let server = Id::standard_truncated(0x7E8);
    let mut exchange = physical(&[0x22, 0xF1, 0x90]);
    let [(from, reply)] = exchange.device_replies(&[])[..] else { panic!("one server, one reply") };
    exchange.flow_by_device(from);
    assert_eq!((from.id, reply.to_string()), (server, "7E0#300000CCCCCCCCCC".to_owned()));
    assert!(exchange.next(0).is_some());
    exchange.sent(1);
    exchange.hear(2, server, &first);
    assert_eq!(exchange.next(3), None);
    // Nothing follows: the device has not sent it, and there is still time until the server gives up.
    let due_ns = exchange.due_ns().unwrap();
    assert!(due_ns <= 200_000_000, "{due_ns}");
    assert_eq!(exchange.next(due_ns), Some(reply));
    assert_eq!(exchange.next(due_ns + 1), None);
    let mut exchange = physical(&[0x22, 0xF1, 0x90]);
    exchange.flow_by_device(from);
    assert!(exchange.next(0).is_some());
    exchange.sent(1);
    exchange.hear(2, server, &first);
    exchange.hear(3, server, &[0x21, 4, 5, 6, 7, 8, 9, 10]);
    assert_eq!(exchange.next(due_ns), None, "it has begun to come");
    let mut exchange = physical(&[0x22, 0xF1, 0x90]);
    exchange.flow_by_device(from);
    assert!(exchange.next(0).is_some());
    exchange.sent(1);
    exchange.hear(2, server, &[3, 0x7F, 0x22, 0x78]);
    exchange.hear(3, server, &first);
    assert_eq!(exchange.next(4), Some(reply));
}

/// If many are asked, each server that the device answers has a reply of its own; the others are answered from here.
#[test]
fn the_device_sends_flow_control_to_several_servers() {
    let plain = |id| Endpoint { id: Id::standard_truncated(id), address: None };
    let settings = TransferSettings { padding: None, ..TransferSettings::default() };
    let to = plain(0x7DF);
    let mut exchange = Exchange::new(to, Answerer::Any11Bit, vec![9, 2], settings, ResponseTiming::default());
    assert!(exchange.has_long_answer());
    let replies = exchange.device_replies(&[plain(0x7E8), plain(0x7EA), plain(0x123)]);
    let said: Vec<_> = replies.iter().map(|(from, reply)| format!("{} {reply}", from.id)).collect();
    assert_eq!(said, ["7E8 7E0#300000", "7EA 7E2#300000"]);
    for (from, _) in &replies {
        exchange.flow_by_device(*from);
    }
    assert!(exchange.next(0).is_some());
    exchange.sent(1);
    let first = [0x10, 20, 0x49, 2, 1, 1, 2, 3];
    exchange.hear(2, Id::standard_truncated(0x7E8), &first);
    exchange.hear(3, Id::standard_truncated(0x7EA), &first);
    assert_eq!(exchange.next(4), None);
    exchange.hear(5, Id::standard_truncated(0x7E9), &first);
    assert_eq!(exchange.next(6).map(|frame| frame.to_string()), Some("7E1#300000".to_owned()));
}

/// Replies are set where one is sure to be needed.
#[test]
fn only_what_is_long_by_the_standards_has_a_long_answer() {
    let is_long = |request: &[u8]| physical(request).has_long_answer();
    for request in [&[9, 2][..], &[9, 0x0A], &[0x22, 0xF1, 0x90], &[0x22, 1, 2, 3, 4, 5, 6]] {
        assert!(is_long(request), "{request:02X?}");
    }
    for request in
        [&[9, 0][..], &[9, 6], &[1, 0x0C], &[3], &[0x22, 0xF1, 0x8C], &[0x22, 1, 2, 3, 4], &[0x19, 2, 0xFF]]
    {
        assert!(!is_long(request), "{request:02X?}");
    }
}

/// A message reported as complete is what was sent, whatever is dropped, doubled or swapped.
#[test]
fn no_disturbance_makes_a_wrong_answer() {
    let mut random = fastrand::Rng::with_seed(16);
    let (mut whole, mut failed) = (0, 0);
    for _ in 0..600 {
        let answer = long(0x62, random.usize(3..150));
        let mut server = Server::new(&[&answer]);
        let settings = TransferSettings { block_size: random.u8(0..5), ..TransferSettings::default() };
        let mut exchange = with(&[0x22, 0xF1, 0x90], settings);
        let fate = disturbed(&mut random, 12);
        run(&mut exchange, &mut server, fate);
        match exchange.finish() {
            Ok((answers, _)) => {
                assert_eq!(answers[0].data, answer);
                whole += 1;
            }
            Err(_) => failed += 1,
        }
    }
    assert!(whole > 50 && failed > 50, "{whole} {failed}");
}
