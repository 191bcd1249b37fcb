use super::super::SENT_TOPIC;
use super::*;
use crate::Format;
use crate::tests::{as_log, read};

/// What the Python package `rosbags` wrote: `can_msgs/Frame` on two topics and a text, in chunks with LZ4.
const THEIRS: &[u8] = include_bytes!("../../../tests/data/can_msgs_lz4.bag");

fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let mut head = Vec::new();
    for (name, value) in fields {
        head.extend(((name.len() + 1 + value.len()) as u32).to_le_bytes());
        head.extend([name.as_bytes(), b"=", value].concat());
    }
    [&(head.len() as u32).to_le_bytes()[..], &head, &(data.len() as u32).to_le_bytes(), data].concat()
}

fn connection() -> Vec<u8> {
    let text = b"type=can_msgs/Frame";
    let data = [&(text.len() as u32).to_le_bytes()[..], text].concat();
    record(&[("op", &[op::CONNECTION]), ("topic", b"/can1/received_messages"), ("conn", &[0; 4])], &data)
}

fn message() -> Vec<u8> {
    let seconds = 1_410_714_882_u32.to_le_bytes();
    let header = [&[0; 4][..], &seconds, &[0; 4], &[3, 0, 0, 0], b"can"].concat();
    let frame = [&0x123_u32.to_le_bytes()[..], &[0, 0, 0, 2], &[0x11, 0x22, 0, 0, 0, 0, 0, 0]].concat();
    let time = [&seconds[..], &[0; 4]].concat();
    record(&[("op", &[op::MESSAGE]), ("conn", &[0; 4]), ("time", &time)], &[header, frame].concat())
}

fn bag(records: &[Vec<u8>]) -> Vec<u8> {
    [Bag::MAGIC, &records.concat()].concat()
}

#[test]
fn frames_of_every_kind_have_the_time_of_their_message_and_the_channel_of_their_topic() {
    assert_eq!(Format::of_content(THEIRS), Some(Format::RosBag));
    let (log, issues) = as_log(Format::RosBag, THEIRS);
    assert_eq!(issues, Vec::<String>::new());
    let lines: Vec<_> = log.lines().collect();
    assert_eq!(lines.len(), 25, "{lines:?}");
    for (line, expected) in lines.iter().zip([
        "(1410714882.622188001) can0 123#1122",
        "(1410714882.700000) can1 18DAF110#0001020304050607 T",
        "(1410714882.900000) can0 123#R4",
        "(1410714882.910000) can0 20000088#0000040000000000",
        // Its own time is zero.
        "(1410714882.000005) can0 124#07",
    ]) {
        let (time, frame) = expected.split_once(") ").unwrap();
        assert!(line.starts_with(&time[..18]) && line.contains(frame), "{line} {expected}");
    }
    assert!(lines[24].contains("(1410714883.019000) can0 204#1313131313000000"), "{}", lines[24]);
    let source = io::Cursor::new(THEIRS);
    let options = crate::ReadOptions::default();
    let mut reader = crate::TraceReader::from_source("t", source, Format::RosBag, &options).unwrap();
    assert_eq!(reader.by_ref().count(), 25);
    assert_eq!(reader.left_out().iter().collect::<Vec<_>>(), [(OTHER_MESSAGES, 5)]);
    assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(SENT_TOPIC, 1)]);
}

#[test]
fn a_cut_bag_gives_what_is_before_the_cut_and_says_so() {
    let whole = read(Format::RosBag, THEIRS).0;
    let mut most = 0;
    for len in (1..100).chain((100..THEIRS.len()).step_by(61)) {
        let (records, issues) = read(Format::RosBag, &THEIRS[..len]);
        assert!(whole.starts_with(&records) && records.len() >= most, "{len}");
        most = records.len();
        assert!(issues.len() <= 1 && (records.len() == whole.len() || issues.len() == 1), "{len} {issues:?}");
    }
    assert_eq!(most, whole.len());
}

#[test]
fn no_change_of_a_byte_is_a_panic_and_a_wrong_beginning_costs_no_chunk() {
    let whole = read(Format::RosBag, THEIRS).0;
    // Behind its head, the first record is filled up with blanks. LZ4 has no checksum here, so that a changed byte may be one of a frame.
    for at in (0..100).chain((4100..THEIRS.len()).step_by(31)) {
        let mut bytes = THEIRS.to_vec();
        bytes[at] ^= 0x81;
        let (records, issues) = read(Format::RosBag, &bytes);
        if at < Bag::MAGIC.len() {
            assert!(records.len() == whole.len() && !issues.is_empty(), "{at:#x} {issues:?}");
        }
    }
}

/// A chunk whose kind became another one is passed over, but not in silence; so is one that the index has and the bag has not.
#[test]
fn a_chunk_of_another_kind_is_an_issue() {
    let whole = read(Format::RosBag, THEIRS).0;
    let at = (0..THEIRS.len()).find(|at| Bag::chunk(&THEIRS[*at..]).is_some()).unwrap();
    let kind_at = at + memchr::memmem::find(&THEIRS[at..], b"op=").unwrap() + 3;
    for kind in (0..=u8::MAX).filter(|kind| *kind != op::CHUNK) {
        let mut bytes = THEIRS.to_vec();
        bytes[kind_at] = kind;
        let (records, issues) = read(Format::RosBag, &bytes);
        assert!(records.len() < whole.len() && !issues.is_empty(), "{kind}: {issues:?}");
    }
    let count_at = memchr::memmem::find(THEIRS, b"chunk_count=").unwrap() + 12;
    let mut bytes = THEIRS.to_vec();
    bytes[count_at] += 1;
    let (records, issues) = read(Format::RosBag, &bytes);
    assert!(records.len() == whole.len() && issues.len() == 1, "{issues:?}");
    assert!(issues[0].contains("as the file's end says"), "{issues:?}");
}

#[test]
fn lengths_that_lie_take_no_memory_and_end_nothing_before_them() {
    let chunk = |compression: &[u8], size: usize, data: &[u8]| {
        let size = (size as u32).to_le_bytes();
        record(&[("op", &[op::CHUNK]), ("compression", compression), ("size", &size)], data)
    };
    let inside = [connection(), message()].concat();
    for (records, frames) in [
        (vec![connection(), message()], 1),
        (vec![chunk(b"none", inside.len(), &inside), message()], 2),
        (vec![chunk(b"none", inside.len() - 1, &inside[..inside.len() - 1]), message()], 1),
        (vec![chunk(b"none", 7, &inside), connection(), message()], 0),
        (vec![chunk(b"xz", inside.len(), &inside), chunk(b"none", inside.len(), &inside)], 1),
        (vec![message(), connection(), message()], 1),
        (vec![connection(), record(&[("op", &[op::MESSAGE]), ("conn", &[0; 4])], b"short"), message()], 1),
    ] {
        let (found, issues) = read(Format::RosBag, bag(&records));
        assert_eq!(found.len(), frames, "{issues:?}");
        // Each lacks at least its index.
        assert!(!issues.is_empty(), "{records:?}");
    }
    for lie in [0, 1 << 20, u32::MAX] {
        for at in 0..2 {
            let mut second = message();
            let at = if at == 0 { 0 } else { second.len() - 39 };
            second[at..at + 4].copy_from_slice(&u32::to_le_bytes(lie));
            let (found, issues) = read(Format::RosBag, bag(&[connection(), message(), second, message()]));
            assert!(!found.is_empty() && found.len() <= 3 && !issues.is_empty(), "{lie} {issues:?}");
        }
    }
}
