use cantap_can::Frame;
use cantap_trace::Id;

use super::*;
use crate::active::testing::{Say, arrives, disturbed, run};

const MS: u64 = 1_000_000;
const TIMES: ScanTimes = ScanTimes { listen_ns: 500 * MS, pace_ns: 20 * MS, wait_ns: 1000 * MS };

fn frame_of(id: Id, bytes: &[u8]) -> Frame {
    let mut data = [0xAA; 8];
    data[..bytes.len()].copy_from_slice(bytes);
    Frame::data_frame(id, &data).unwrap()
}

fn standard(id: u32, bytes: &[u8]) -> Frame {
    frame_of(Id::standard_truncated(id), bytes)
}

fn extended(id: u32, bytes: &[u8]) -> Frame {
    frame_of(Id::extended_truncated(id), bytes)
}

fn scan(questions: &Questions) -> ServerScan {
    ServerScan::new(questions, TIMES)
}

fn shown(scan: &ServerScan) -> Vec<String> {
    let text = |found: &FoundServer| {
        let request = found.request.map_or_else(|| "?".to_owned(), |request| request.to_string());
        let to_all = if found.functional { " all" } else { "" };
        format!("{request}:{}{to_all} {:?}", found.server, found.reply)
    };
    scan.found().map(text).collect()
}

/// A prompt server, a late one, one that refuses, one that says "pending" first, one that only answers questions to all, one with 29 bits.
fn several(id: Id, data: &[u8], say: &mut Say) {
    assert!(data.contains(&0x3E), "{data:02X?}");
    let is_to_all = id.raw() == 0x7DF;
    if is_to_all || id.raw() == 0x7E0 {
        say.push((2 * MS, standard(0x7E8, &[2, 0x7E, 0])));
    }
    if id.raw() == 0x7E1 {
        say.push((900 * MS, standard(0x7E9, &[2, 0x7E, 0])));
    }
    if is_to_all || id.raw() == 0x7E2 {
        say.push((20 * MS, standard(0x7EA, &[3, 0x7F, 0x3E, 0x11])));
    }
    if id.raw() == 0x7E3 {
        say.push((20 * MS, standard(0x7EB, &[3, 0x7F, 0x3E, 0x78])));
        say.push((400 * MS, standard(0x7EB, &[2, 0x7E, 0])));
    }
    if is_to_all {
        say.push((5 * MS, standard(0x7EC, &[2, 0x7E, 0])));
    }
    if id.raw() == 0x18DA_10F1 {
        say.push((2 * MS, extended(0x18DA_F110, &[1, 0x7E])));
    }
}

#[test]
fn every_kind_of_server_is_found_with_its_request() {
    let questions = Questions::standard();
    let mut scan = scan(&questions);
    let (took_ns, sent) = run(&mut scan, &mut several, arrives);
    assert_eq!(
        shown(&scan),
        [
            "7E0:7E8 all Positive",
            "7E1:7E9 Positive",
            "7E2:7EA all Refusal(17)",
            "7E3:7EB Positive",
            "?:7EC all Positive",
            "18DA10F1:18DAF110 Positive",
        ]
    );
    assert_eq!((sent.len(), questions.all().len()), (265, 265));
    assert!(sent.iter().all(|frame| frame.data()[..3] == [2, 0x3E, 0]), "nothing else is ever sent");
    assert!(took_ns < 10_000 * MS, "{took_ns}");
    assert!(scan.not_asked().is_empty() && scan.too_many() == 0 && scan.unasked().count() == 0);
    let late = scan.found().find(|found| found.server.id.raw() == 0x7E9).unwrap();
    assert!((900 * MS..905 * MS).contains(&late.after_ns), "{}", late.after_ns);
}

/// One address may be answered by 7E8's kind, by +20 and by -280: which request a late answer belongs to is asked again.
#[test]
fn of_makers_with_different_offsets_the_right_request_is_found() {
    let mut questions = Questions::default();
    for maker in Maker::all() {
        questions.add_maker(maker);
    }
    assert!(questions.left_out() > 60_000);
    let mut peer = |id: Id, data: &[u8], say: &mut Say| {
        let late = 300 * MS;
        match (id.raw(), data[0]) {
            (0x743, 2) => say.push((late, standard(0x763, &[2, 0x7E, 0]))),
            (0x75B, 2) => say.push((2 * MS, standard(0x7C5, &[2, 0x7E, 0]))),
            (0x6F1, 0x12) => say.push((late, standard(0x612, &[0xF1, 2, 0x7E, 0]))),
            (0x6F1, 0xEF) => say.push((10 * MS, standard(0x640, &[0xF1, 3, 0x7F, 0x3E, 0x12]))),
            (0x750, 0x6D) => say.push((late, standard(0x758, &[0x6D, 2, 0x7E, 0]))),
            _ => {}
        }
    };
    let mut scan = scan(&questions);
    let (_, sent) = run(&mut scan, &mut peer, arrives);
    assert_eq!(
        shown(&scan),
        [
            "6F1/12:612/F1 Positive",
            "?:640/F1 all Refusal(18)",
            "750/6D:758/6D Positive",
            "743:763 Positive",
            "75B:7C5 Positive",
        ]
    );
    assert!(sent.len() < questions.all().len() + 30, "{}", sent.len());
}

#[test]
fn identifiers_with_which_others_send_are_left_out() {
    let mut scan = scan(&Questions::standard());
    assert_eq!(scan.next(1), None);
    // Another tester, and a node that sends with an identifier of requests; while it listens, it asks nothing.
    scan.hear(2, Id::standard_truncated(0x7E0), &[2, 0x3E, 0]);
    scan.hear(3, Id::standard_truncated(0x7E8), &[2, 0x7E, 0]);
    scan.hear(4, Id::extended_truncated(0x18DB_33F1), &[2, 0x3E, 0x80]);
    let (_, sent) = run(&mut scan, &mut several, arrives);
    assert!(sent.iter().all(|frame| !matches!(frame.id().raw(), 0x7E0 | 0x18DB_33F1)));
    let not_asked: Vec<_> = scan.not_asked().iter().map(|endpoint| endpoint.id.raw()).collect();
    assert_eq!(not_asked, [0x18DB_33F1, 0x7E0]);
    assert_eq!(scan.unasked().map(|endpoint| endpoint.id.raw()).collect::<Vec<_>>(), [0x7E8]);
    // What it says to the other tester does not make it ours.
    assert!(!shown(&scan).iter().any(|line| line.contains("7E8")), "{:?}", shown(&scan));
}

/// Servers that send answers without end, and frames that are none.
#[test]
fn a_flood_is_one_server_and_memory_stays_bounded() {
    let mut peer = |id: Id, _: &[u8], say: &mut Say| {
        if id.raw() == 0x7E0 {
            say.extend((0..2000).map(|at| (at * MS / 10, standard(0x7E8, &[2, 0x7E, 0]))));
        }
        if id.raw() == 0x7DF {
            say.extend((0..2000).map(|at| (MS + at, extended(at as u32, &[2, 0x7E, 0]))));
        }
        for bytes in [
            &[3, 0x7E, 0, 0][..],
            &[2, 0x7E, 1],
            &[3, 0x7F, 0x10, 0x11],
            &[0x10, 0x7E, 0],
            &[8, 0x7E, 0],
            &[],
        ] {
            say.push((MS, standard(0x7EF, bytes)));
        }
    };
    let mut scan = scan(&Questions::standard());
    let (took_ns, sent) = run(&mut scan, &mut peer, arrives);
    assert!(took_ns < 30_000 * MS && sent.len() == 265);
    assert_eq!(scan.found().count(), MOST_FOUND / 2 + 1);
    assert!(shown(&scan).iter().any(|line| line.starts_with("7E0:7E8")));
    assert!(scan.too_many() > 0);
    assert!(!shown(&scan).iter().any(|line| line.contains("7EF")));
}

#[test]
fn a_bus_that_loses_and_doubles_frames_ends_it_in_time_and_makes_no_server() {
    let mut random = fastrand::Rng::with_seed(5);
    for _ in 0..20 {
        let mut scan = scan(&Questions::standard());
        let (took_ns, _) = run(&mut scan, &mut several, disturbed(&mut random, 3));
        assert!(took_ns < 20_000 * MS, "{took_ns}");
        let real = [0x7E8, 0x7E9, 0x7EA, 0x7EB, 0x7EC, 0x18DA_F110];
        assert!(scan.found().all(|found| real.contains(&found.server.id.raw())), "{:?}", shown(&scan));
    }
}
