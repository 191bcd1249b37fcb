use super::super::SENT_TOPIC;
use super::*;
use crate::Format;
use crate::tests::{as_log, read};

/// What the library of MCAP's makers wrote: `can_msgs/Frame` on two topics, `FdFrame` on another, a text, in chunks with zstd and checksums.
const THEIRS: &[u8] = include_bytes!("../../../tests/data/can_msgs_zstd.mcap");

fn lines(bytes: &[u8]) -> (Vec<String>, Vec<String>) {
    let (text, issues) = as_log(Format::Mcap, bytes);
    (text.lines().map(str::to_owned).collect(), issues)
}

type Kinds = Vec<(&'static str, u64)>;

fn left_out_and_notes(bytes: &[u8]) -> (Kinds, Kinds) {
    let source = io::Cursor::new(bytes.to_vec());
    let options = crate::ReadOptions::default();
    let mut reader = crate::TraceReader::from_source("t", source, Format::Mcap, &options).unwrap();
    while reader.next().is_some() {}
    (reader.left_out().iter().collect(), reader.notes().iter().collect())
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn record(op: u8, parts: &[&[u8]]) -> Vec<u8> {
    let body = parts.concat();
    [&[op][..], &(body.len() as u64).to_le_bytes(), &body].concat()
}

/// A file without chunks, of ROS 1's messages.
fn ros1(messages: &[Vec<u8>]) -> Vec<u8> {
    let schema = record(op::SCHEMA, &[&[1, 0], &text("can_msgs/Frame"), &text("ros1msg"), &text("")]);
    let channel =
        record(op::CHANNEL, &[&[7, 0], &[1, 0], &text("/can0/received_messages"), &text("ros1"), &[0; 4]]);
    [
        Mcap::MAGIC,
        &record(1, &[&text("ros1"), &text("")]),
        &schema,
        &channel,
        &messages.concat(),
        &record(op::DATA_END, &[&[0; 4]]),
        Mcap::MAGIC,
    ]
    .concat()
}

fn ros1_message(channel: u8, seconds: u32, id: u32, flags: [u8; 3], dlc: u8) -> Vec<u8> {
    let times = 1_410_714_882_000_000_005_u64.to_le_bytes();
    let stamp = [&[9, 0, 0, 0][..], &seconds.to_le_bytes(), &[1, 0, 0, 0], &text("can")].concat();
    let frame = [&id.to_le_bytes()[..], &flags, &[dlc, 1, 2, 3, 4, 5, 6, 7, 8]].concat();
    record(op::MESSAGE, &[&[channel, 0], &[0; 4], &times, &times, &stamp, &frame])
}

#[test]
fn frames_of_every_kind_have_the_time_of_their_message_and_the_channel_of_their_topic() {
    assert_eq!(Format::of_content(THEIRS), Some(Format::Mcap));
    let (lines, issues) = lines(THEIRS);
    assert_eq!(issues, Vec::<String>::new());
    assert_eq!(lines.len(), 46, "{lines:?}");
    for (line, expected) in lines.iter().zip([
        "(1410714882.622188001) can0 123#1122",
        "(1410714882.700000) can0 18DAF110#0001020304050607 T",
        "(1410714882.800000) can1 321##0000102030405060708090A0B",
        "(1410714882.900000) can0 123#R4",
        "(1410714882.910000) can0 20000088#0000040000000000",
        // Its own time is zero.
        "(1410714882.000006) can0 124#07",
    ]) {
        let (time, frame) = expected.split_once(") ").unwrap();
        assert!(line.starts_with(&time[..18]) && line.contains(frame), "{line} {expected}");
    }
    assert!(lines[45].contains("(1410714883.039000) can0 204#2727272727000000"), "{}", lines[45]);
    assert_eq!(left_out_and_notes(THEIRS), (vec![(OTHER_MESSAGES, 10)], vec![(SENT_TOPIC, 1)]));
}

#[test]
fn messages_of_ros_1_and_files_without_chunks_are_read() {
    let messages = [
        ros1_message(7, 1_410_714_882, 0x123, [0; 3], 2),
        ros1_message(7, 1_410_714_883, 0x1ABC_DEF0, [0, 1, 0], 8),
        ros1_message(7, 0, 0x123, [1, 0, 0], 3),
        ros1_message(8, 0, 0x123, [0; 3], 3),
        ros1_message(7, 0, 0x823, [0; 3], 3),
        ros1_message(7, 0, 0x123, [0; 3], 16),
    ];
    let (lines, issues) = lines(&ros1(&messages));
    let frames = ["123#0102", "1ABCDEF0#0102030405060708", "123#R3"];
    assert_eq!(lines.len(), frames.len(), "{lines:?}");
    assert!(lines.iter().zip(frames).all(|(line, frame)| line.contains(frame)), "{lines:?}");
    for (issue, expected) in issues.iter().zip(["channel 8", "an identifier up to 7FF", "a frame's length"]) {
        assert!(issue.contains(expected), "{issue}");
    }
    assert_eq!(issues.len(), 3, "{issues:?}");
}

#[test]
fn a_cut_file_gives_what_is_before_the_cut_and_says_so() {
    let whole = read(Format::Mcap, THEIRS).0;
    let mut most = 0;
    for len in (1..100).chain((100..THEIRS.len()).step_by(29)) {
        let (records, issues) = read(Format::Mcap, &THEIRS[..len]);
        assert!(whole.starts_with(&records), "{len}");
        assert!(records.len() >= most, "{len}");
        most = records.len();
        assert!(issues.len() <= 1 && (records.len() == whole.len() || issues.len() == 1), "{len} {issues:?}");
    }
    assert_eq!(most, whole.len());
}

#[test]
fn each_change_of_a_byte_is_seen_or_changes_nothing_and_later_chunks_are_read() {
    let whole = read(Format::Mcap, THEIRS).0;
    let mut fewest = usize::MAX;
    for at in (0..100).chain((100..THEIRS.len()).step_by(31)) {
        let mut bytes = THEIRS.to_vec();
        bytes[at] ^= if at % 2 == 0 { 0x81 } else { 0xFF };
        let (records, issues) = read(Format::Mcap, &bytes);
        let is_seen = !issues.is_empty() || records == whole;
        assert!(is_seen || left_out_and_notes(&bytes).0.len() > 1, "{at:#x}");
        if at < Mcap::MAGIC.len() {
            fewest = fewest.min(records.len());
        }
    }
    assert_eq!(fewest, whole.len(), "a wrong beginning costs no chunk");
}

/// A chunk whose kind became another one is passed over, but not in silence.
#[test]
fn a_chunk_of_another_kind_is_an_issue() {
    let whole = read(Format::Mcap, THEIRS).0;
    let at = (0..THEIRS.len()).find(|at| Mcap::chunk(&THEIRS[*at..]).is_some()).unwrap();
    for kind in (0..op::FIRST_PRIVATE).filter(|kind| *kind != op::CHUNK) {
        let mut bytes = THEIRS.to_vec();
        bytes[at] = kind;
        let (records, issues) = read(Format::Mcap, &bytes);
        assert!(records.len() < whole.len() && !issues.is_empty(), "{kind}: {issues:?}");
    }
    let mut bytes = THEIRS.to_vec();
    bytes[at] = 1;
    let issues = read(Format::Mcap, &bytes).1;
    let expected = "expected 56 messages in ";
    assert!(issues.last().unwrap().contains(expected), "{issues:?}");
}

#[test]
fn lengths_that_lie_take_no_memory_and_end_nothing_before_them() {
    let message = ros1_message(7, 1_410_714_882, 0x123, [0; 3], 2);
    for lie in [0, 5, 1 << 20, 1 << 40, u64::MAX] {
        let mut second = message.clone();
        second[1..9].copy_from_slice(&u64::to_le_bytes(lie));
        let (records, issues) = read(Format::Mcap, ros1(&[message.clone(), second, message.clone()]));
        assert!(!records.is_empty() && !issues.is_empty(), "{lie}: {issues:?}");
    }
    let chunk = |len: u64, compression: &str, records: &[u8]| {
        record(op::CHUNK, &[&[0; 24], &[0; 4], &text(compression), &len.to_le_bytes(), records])
    };
    for (chunk, is_fine) in [
        (chunk(message.len() as u64, "", &message), true),
        (chunk(1 << 62, "", &message), false),
        (chunk(message.len() as u64, "brotli", &message), false),
        (chunk(message.len() as u64, "zstd", &message), false),
        (chunk(message.len() as u64 - 1, "", &message[..message.len() - 1]), false),
    ] {
        let (records, issues) = read(Format::Mcap, ros1(&[message.clone(), chunk]));
        assert_eq!(records.len(), 1 + usize::from(is_fine), "{issues:?}");
        assert_eq!(issues.len(), usize::from(!is_fine), "{issues:?}");
    }
}

/// As `ros2 bag record` leaves it: a folder, with a new file whenever one is full. Without metadata, the files' numbers are their order.
#[test]
fn a_folder_with_several_files_is_one_trace() {
    let folder = tempfile::tempdir().unwrap();
    let one: Vec<_> = crate::open_source("a.mcap", THEIRS, &crate::ReadOptions::default()).unwrap().collect();
    for number in [0, 1, 2] {
        std::fs::write(folder.path().join(format!("bag_{number}.mcap")), THEIRS).unwrap();
    }
    let read = || {
        let mut reader = crate::open_reader(folder.path(), &crate::ReadOptions::default()).unwrap();
        let (mut records, mut batch) = (Vec::new(), Vec::new());
        while let Some(read) = reader.next_batch(&mut batch) {
            read.unwrap();
            records.append(&mut batch);
        }
        let notes: Vec<_> = reader.notes().iter().map(|(what, _)| what).collect();
        (records, notes.contains(&crate::ros::folder::NO_METADATA))
    };
    let one: Vec<_> = one.into_iter().map(Result::unwrap).collect();
    assert_eq!(read(), ([one.clone(), one.clone(), one.clone()].concat(), true));
    let metadata =
        "rosbag2_bagfile_information:\n  relative_file_paths:\n    - bag_0.mcap\n    - bag_1.mcap\n";
    std::fs::write(folder.path().join("metadata.yaml"), metadata).unwrap();
    assert_eq!(read(), ([one.clone(), one].concat(), false));
    // Whatever is wrong in a file is said of that file.
    std::fs::write(folder.path().join("bag_1.mcap"), &THEIRS[..THEIRS.len() / 2]).unwrap();
    let mut reader = crate::open_reader(folder.path(), &crate::ReadOptions::default()).unwrap();
    let issue = reader.find_map(Result::err).unwrap().to_string();
    assert!(issue.contains("bag_1.mcap"), "{issue}");
    std::fs::write(folder.path().join("metadata.yaml"), "relative_file_paths:\n  - ../other_0.mcap\n")
        .unwrap();
    let error = crate::open_reader(folder.path(), &crate::ReadOptions::default()).err().unwrap();
    assert!(error.to_string().contains("a file outside of it"), "{error}");
}
