use super::parts::MOST_BYTES;
use super::*;
use crate::active::testing::{Say, arrives, disturbed, run};

const NAME: u64 = 0x8000_0000_0000_0005;

fn bytes(length: usize) -> Vec<u8> {
    (0..length).map(|at| (at * 3 + 1) as u8).collect()
}

/// A frame of a message.
fn of(source: u8, pgn: u32, to: u8, data: &[u8]) -> Frame {
    frame(6, pgn, source, to, data)
}

fn nobody() -> impl FnMut(Id, &[u8], &mut Say) {
    |_, _, _| {}
}

#[test]
fn an_address_is_claimed_for_a_quarter_of_a_second() {
    let mut station = Station::new(NAME, 0x80, StationJob::Claim);
    let (took_ns, sent) = run(&mut station, &mut nobody(), arrives);
    assert_eq!(sent.iter().map(ToString::to_string).collect::<Vec<_>>(), ["18EEFF80#0500000000000080"]);
    assert!((250 * MS..260 * MS).contains(&took_ns), "{took_ns}");
    assert_eq!((station.address(), station.finish()), (0x80, Ok(vec![])));
}

/// The lower NAME wins; a node that can takes another address; one that cannot gives up, and announces it.
#[test]
fn an_address_that_is_taken_is_given_up() {
    let claims = |own: u64, other: u64| {
        let peer = move |id: Id, _: &[u8], say: &mut Say| {
            if Header::of(id).unwrap().source == 0x80 {
                say.push((MS, of(0x80, CLAIM, GLOBAL, &other.to_le_bytes())));
                say.push((2 * MS, of(0x81, CLAIM, GLOBAL, &other.to_le_bytes())));
            }
        };
        let mut once = 0;
        let mut station = Station::new(own, 0x80, StationJob::Claim);
        // A peer that objected repeatedly would be misbehaving.
        let mut peer = |id: Id, data: &[u8], say: &mut Say| {
            once += 1;
            if once == 1 {
                peer(id, data, say);
            }
        };
        let (_, sent) = run(&mut station, &mut peer, arrives);
        (station.address(), station.finish(), sent.len())
    };
    assert_eq!(claims(NAME, NAME + 1), (0x80, Ok(vec![]), 2));
    // The other node has 81, too.
    assert_eq!(claims(NAME, 1), (0x82, Ok(vec![]), 3));
    let (address, ended, _) = claims(5, 1);
    assert_eq!((address, ended), (NULL, Err(StationError::AddressTaken { address: 0x80, name: 1 })));
}

fn request(to: u8, mut answer: impl FnMut(&mut Say)) -> (Result<Vec<GroupAnswer>, StationError>, Vec<Frame>) {
    let mut station = Station::with_address(NAME, 0x80, StationJob::Request { pgn: 0xFECA, to });
    let mut peer = |id: Id, data: &[u8], say: &mut Say| {
        if Header::of(id).unwrap().pgn == REQUEST {
            assert_eq!(data, [0xCA, 0xFE, 0]);
            answer(say);
        }
    };
    let (_, sent) = run(&mut station, &mut peer, arrives);
    (station.finish(), sent)
}

#[test]
fn a_group_is_asked_for_and_answered_in_every_way() {
    let data = [0, 0xFF, 1, 2, 3, 4, 0xFF, 0xFF];
    let one = |from| GroupAnswer { from, data: data.to_vec() };
    let (answers, _) = request(3, |say| {
        say.push((MS, of(4, 0xFECA, GLOBAL, &data)));
        say.push((2 * MS, of(3, 0xFECB, GLOBAL, &data)));
        say.push((3 * MS, of(3, 0xFECA, GLOBAL, &data)));
    });
    assert_eq!(answers, Ok(vec![one(3)]));
    // From all: as many answers as there are.
    let (answers, _) = request(GLOBAL, |say| {
        say.push((MS, of(4, 0xFECA, GLOBAL, &data)));
        say.push((3 * MS, of(3, 0xFECA, GLOBAL, &data)));
    });
    assert_eq!(answers, Ok(vec![one(4), one(3)]));
    let (answers, _) = request(3, |_| {});
    assert_eq!(answers, Err(StationError::NoAnswer { after_ms: 1250 }));
    let (answers, _) = request(3, |say| {
        say.push((MS, of(3, ACKNOWLEDGE, GLOBAL, &[1, 255, 255, 255, 0x80, 0xCA, 0xFE, 0])));
    });
    assert_eq!(answers, Err(StationError::NotAcknowledged { from: 3, control: 1 }));
    // In many frames to all.
    let long = bytes(20);
    let (answers, _) = request(3, |say| {
        say.push((MS, of(3, CONTROL, GLOBAL, &[32, 20, 0, 3, 255, 0xCA, 0xFE, 0])));
        for number in 1..=3_u8 {
            let mut frame = vec![number];
            frame.extend(long.iter().skip(usize::from(number - 1) * 7).take(7));
            frame.resize(8, 0xFF);
            say.push((u64::from(number) * 60 * MS, of(3, DATA, GLOBAL, &frame)));
        }
    });
    assert_eq!(answers, Ok(vec![GroupAnswer { from: 3, data: long }]));
    // A node that sends it every second on its own is heard for as long as the others.
    let (answers, _) = request(GLOBAL, |say| {
        say.extend((0..200).map(|at| (at * 1000 * MS, of(4, 0xFECA, GLOBAL, &data))));
    });
    assert_eq!(answers, Ok(vec![one(4), one(4)]));
    // An answer that stops in the middle.
    let (answers, _) = request(3, |say| {
        say.push((MS, of(3, CONTROL, GLOBAL, &[32, 20, 0, 3, 255, 0xCA, 0xFE, 0])));
        say.push((2 * MS, of(3, DATA, GLOBAL, &[1; 8])));
    });
    assert_eq!(answers, Err(StationError::Silent { from: 3, after_ms: 750, done: 1, total: 3 }));
}

/// Two stations: one sends, the other requests the frames. Whatever arrives is what was sent, no matter what is dropped, doubled
/// or swapped.
#[test]
fn long_messages_arrive_whole_or_not_at_all() {
    let mut random = fastrand::Rng::with_seed(1939);
    let (mut whole, mut failed) = (0, 0);
    for round in 0..300 {
        let message = bytes(if round == 0 { MOST_BYTES } else { random.usize(9..400) });
        let job = StationJob::Send { pgn: 0xD000, to: 3, priority: 6, data: message.clone() };
        let mut station = Station::with_address(NAME, 0x80, job);
        let mut incoming: Option<Incoming> = None;
        let mut got = None;
        let mut peer = |id: Id, data: &[u8], say: &mut Say| {
            let header = Header::of(id).unwrap();
            let data: [u8; 8] = data.try_into().unwrap();
            match (header.pgn, data[0]) {
                (CONTROL, 16) => incoming = Incoming::connection(0, header, data),
                (CONTROL, 255) => incoming = None,
                (DATA, _) if incoming.as_mut().is_some_and(|incoming| incoming.take(0, data)) => {
                    let done = incoming.take().unwrap();
                    say.extend(done.last_word(3).map(|word| (MS, word)));
                    got = Some(done.into_data());
                }
                _ => {}
            }
            if let Some(incoming) = &mut incoming {
                let now_ns = if incoming.due_ns() == 0 { 0 } else { incoming.due_ns() - 1 };
                if let Ok(Some(asks)) = incoming.next(now_ns, 3) {
                    say.push((MS, asks));
                }
            }
        };
        if round < 50 {
            run(&mut station, &mut peer, arrives);
        } else {
            run(&mut station, &mut peer, disturbed(&mut random, 15));
        }
        match (station.finish(), got) {
            (Ok(_), got) => {
                assert_eq!(got, Some(message));
                whole += 1;
            }
            (Err(_), Some(got)) => assert_eq!(got, message),
            (Err(_), None) => failed += 1,
        }
    }
    assert!(whole > 50 && failed > 20, "{whole} {failed}");
}

#[test]
fn a_message_to_all_keeps_its_distances() {
    let job = StationJob::Send { pgn: 0xFEEC, to: GLOBAL, priority: 6, data: bytes(17) };
    let mut station = Station::with_address(NAME, 0x80, job);
    let (took_ns, sent) = run(&mut station, &mut nobody(), arrives);
    assert_eq!(
        sent.iter().map(ToString::to_string).collect::<Vec<_>>(),
        [
            "1CECFF80#20110003FFECFE00",
            "1CEBFF80#010104070A0D1013",
            "1CEBFF80#0216191C1F222528",
            "1CEBFF80#032B2E31FFFFFFFF",
        ]
    );
    assert!(took_ns >= 150 * MS, "{took_ns}");
}

/// Every misbehaviour of a receiver gives an error in bounded time.
#[test]
fn whatever_the_receiver_does_there_is_an_end() {
    let send = |lie: &dyn Fn(u8, &mut Say)| {
        let job = StationJob::Send { pgn: 0xD000, to: 3, priority: 6, data: bytes(100) };
        let mut station = Station::with_address(NAME, 0x80, job);
        let mut peer = |_: Id, data: &[u8], say: &mut Say| lie(data[0], say);
        let (took_ns, _) = run(&mut station, &mut peer, arrives);
        assert!(took_ns < 100_000 * MS);
        station.finish().unwrap_err()
    };
    let control =
        |bytes: [u8; 3]| of(3, CONTROL, 0x80, &[bytes[0], bytes[1], bytes[2], 255, 255, 0, 0xD0, 0]);
    assert_eq!(send(&|_, _| {}), StationError::Silent { from: 3, after_ms: 1250, done: 0, total: 15 });
    assert_eq!(
        send(&|first, say| if first == 16 {
            say.push((MS, control([255, 2, 255])));
        }),
        StationError::Aborted { from: 3, reason: 2 }
    );
    // Waits for ever, requests the same for ever, requests frames that do not exist.
    let holds = |first: u8, say: &mut Say| {
        if first == 16 {
            say.extend((0..200).map(|at| (at * 500 * MS, control([17, 0, 255]))));
        }
    };
    assert!(matches!(send(&holds), StationError::Endless { .. }));
    // A frame, then as many holds as may be, then the next frame: seldom enough to be allowed, and never done.
    let slow = |_: u8, say: &mut Say| {
        say.extend((0..50).map(|at| (at * 1000 * MS, control([17, 0, 255]))));
        say.push((50_000 * MS, control([17, 1, 1])));
    };
    assert_eq!(send(&slow), StationError::TooSlow { after_ms: 60_000 });
    let same = |_: u8, say: &mut Say| say.push((MS, control([17, 1, 1])));
    assert!(matches!(send(&same), StationError::Endless { .. }));
    let beyond = |_: u8, say: &mut Say| say.push((MS, control([17, 1, 99])));
    assert!(matches!(send(&beyond), StationError::Endless { .. }));
}

/// A request for address claims is answered.
#[test]
fn the_address_is_told_to_who_asks_for_it() {
    let mut station = Station::with_address(NAME, 0x80, StationJob::Request { pgn: 0xFECA, to: 3 });
    assert!(station.next(0).is_some());
    station.sent(1);
    station.hear(2, of(9, REQUEST, GLOBAL, &three(CLAIM)).id(), &three(CLAIM));
    assert_eq!(station.next(3).unwrap().to_string(), "18EEFF80#0500000000000080");
}

/// Who objects for ever, with a NAME that does not win, holds nothing up.
#[test]
fn an_objection_that_does_not_end_is_answered_and_outlasted() {
    let mut station = Station::new(NAME, 0x80, StationJob::Claim);
    let mut peer = |id: Id, _: &[u8], say: &mut Say| {
        if Header::of(id).unwrap().pgn == CLAIM {
            say.push((100 * MS, of(0x80, CLAIM, GLOBAL, &(NAME + 1).to_le_bytes())));
        }
    };
    let (took_ns, sent) = run(&mut station, &mut peer, arrives);
    assert!((250 * MS..300 * MS).contains(&took_ns), "{took_ns}");
    assert_eq!((sent.len(), station.finish()), (3, Ok(vec![])));
}

/// A node that never claimed the address uses it: it is told once, and whoever asked is told, too.
#[test]
fn a_node_with_our_address_is_noticed() {
    let mut station = Station::with_address(NAME, 0x80, StationJob::Request { pgn: 0xFECA, to: 3 });
    assert!(station.next(0).is_some());
    station.sent(1);
    for at in 2..5 {
        station.hear(at, of(0x80, REQUEST, 3, &three(0xFECA)).id(), &three(0xFECA));
    }
    assert_eq!(station.next(5).unwrap().to_string(), "18EEFF80#0500000000000080");
    assert_eq!((station.next(6), station.imposters()), (None, 3));
}

/// The other side of a message of many frames does not wait for the rest.
#[test]
fn a_connection_that_is_ended_from_outside_is_aborted() {
    let job = StationJob::Send { pgn: 0xD000, to: 3, priority: 6, data: bytes(100) };
    let mut station = Station::with_address(NAME, 0x80, job);
    assert_eq!(station.cancel(), None);
    assert!(station.next(0).is_some());
    station.sent(1);
    assert_eq!(station.cancel().unwrap().to_string(), "1CEC0380#FF02FFFFFF00D000");
    assert_eq!((station.next(2), station.finish()), (None, Err(StationError::Cancelled)));
    let mut station = Station::with_address(NAME, 0x80, StationJob::Request { pgn: 0xFECA, to: 3 });
    assert!(station.next(0).is_some());
    station.sent(1);
    assert_eq!(station.cancel(), None);
    let asks = of(3, CONTROL, 0x80, &[16, 20, 0, 3, 255, 0xCA, 0xFE, 0]);
    station.hear(2, asks.id(), asks.data());
    assert_eq!(station.cancel().unwrap().to_string(), "1CEC0380#FF02FFFFFFCAFE00");
}

/// Each has its own counter, the pause counts from one beginning to the next, and the address is defended meanwhile.
#[test]
fn a_fast_packet_is_sent_again_and_again_with_the_next_counter() {
    let data = bytes(20);
    let job = StationJob::SendFast { pgn: 0x1_F805, to: GLOBAL, priority: 3, data: data.clone() };
    let mut station = Station::with_address(NAME, 0x80, job);
    let mut peer = nobody();
    let (first_ns, sent) = run(&mut station, &mut peer, arrives);
    assert_eq!(first_ns, 1 + 3 * crate::active::testing::FRAME_NS);
    let texts: Vec<_> = sent.iter().map(ToString::to_string).collect();
    assert_eq!(
        texts,
        ["0DF80580#00140104070A0D10", "0DF80580#011316191C1F2225", "0DF80580#02282B2E3134373A"]
    );
    station.send_again(100 * MS);
    assert!(!station.is_done() && station.due_ns() == Some(1 + 100 * MS));
    // Somebody asks for it meanwhile.
    station.hear(50 * MS, frame(6, REQUEST, 3, GLOBAL, &three(CLAIM)).id(), &three(CLAIM));
    assert_eq!(station.next(50 * MS).unwrap().to_string(), "18EEFF80#0500000000000080");
    station.sent(50 * MS);
    assert_eq!(station.next(99 * MS), None);
    let frames: Vec<_> = std::iter::from_fn(|| station.next(101 * MS)).collect();
    assert_eq!(frames.iter().map(|frame| frame.data()[0]).collect::<Vec<_>>(), [0x20, 0x21, 0x22]);
    (0..3).for_each(|_| station.sent(102 * MS));
    assert!(station.is_done() && station.finish() == Ok(vec![]));
}
