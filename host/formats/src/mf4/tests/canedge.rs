//! Files in the two layouts of CANedge loggers, made by hand: bytes in the records of another group, parts that are constants of their group,
//! lengths that a table gives. asammdf reads the same from them, and we read what it makes of them.

mod file;
mod group;
mod layouts;

use std::process::Command;

use super::super::super::tests;
use super::super::encode::{Blocks, Part};
use super::HEADER_AT;
use crate::{Format, ReadOptions, TraceReader};
use file::{Form, Layout, file};
use group::{BYTES, FLOAT, UNSIGNED, conversion};
use layouts::{Frame, first_layout, second_layout};

/// Time in microseconds, channel, and the frame in candump's form, with `T` for a sent one.
const FRAMES: [(u64, u8, &str); 12] = [
    (100, 1, "123#11223344"),
    (250, 2, "18DAF110#0210030000000000"),
    (300, 1, "7FF#"),
    (300, 1, "12345678#A1A2A3 T"),
    (420, 1, "321##0AABBCC"),
    (530, 2, "322##1AABBCCDDEEFF0011"),
    (640, 1, "1ABCDEF0##3112233445566778899AABBCC"),
    (650, 2, "100##0000102030405060708090A0B0C0D0E0F T"),
    (700, 1, "1FFFFFFF##1FF"),
    (810, 1, "0AA#R3"),
    (900, 2, "00000001#R8"),
    (999, 1, "001#00 T"),
];

/// Both layouts in all forms.
fn files() -> Vec<(String, Vec<u8>)> {
    let frames = FRAMES.map(Frame::of);
    let layouts: [(&str, Layout); 2] = [("first", first_layout), ("second", second_layout)];
    let forms = [Form::Unfinished, Form::Finished, Form::Sorted];
    let each = layouts.into_iter().flat_map(|layout| forms.map(|form| (layout, form)));
    each.map(|((name, layout), form)| (format!("{name}-{form:?}"), file(layout, form, &frames))).collect()
}

/// Sorted by time, then as text: groups of their own have no order at the same time.
fn sorted(log: &str) -> Vec<String> {
    let mut lines: Vec<_> = log.lines().map(str::to_owned).collect();
    lines.sort();
    lines
}

fn expected() -> Vec<String> {
    let line = |(us, bus, frame): (u64, u8, &str)| {
        let (frame, direction) = frame.strip_suffix(" T").map_or((frame, ""), |frame| (frame, " T"));
        format!("(1410714882.{us:06}) can{} {frame}{direction}", bus - 1)
    };
    sorted(&FRAMES.map(line).join("\n"))
}

/// What we read, without its bus errors, and what is left out.
fn read(name: &str, file: &[u8]) -> (Vec<String>, usize, Vec<(&'static str, u64)>) {
    let (records, issues) = tests::read(Format::Mf4, file);
    assert_eq!(issues, Vec::<String>::new(), "{name}");
    let frames: Vec<_> = records.iter().filter(|record| record.frame().is_some()).copied().collect();
    let source = std::io::Cursor::new(file.to_vec());
    let mut reader = TraceReader::from_source(name, source, Format::Mf4, &ReadOptions::default()).unwrap();
    assert_eq!(reader.by_ref().count(), records.len(), "{name}");
    let left_out = reader.left_out().iter().collect();
    (sorted(&tests::write(Format::Candump, &frames)), records.len() - frames.len(), left_out)
}

/// Real files of these layouts gave not a single frame: of a value of type byte array elsewhere, the place in the record was taken for bytes,
/// and parts that are constants of their group were looked for in the record.
#[test]
fn files_of_canedge_loggers_are_read_in_both_layouts_finished_or_not_sorted_or_not() {
    for (name, file) in files() {
        let (frames, errors, left_out) = read(&name, &file);
        assert_eq!(frames, expected(), "{name}");
        // An error frame, and two frames of LIN.
        let expected = if name.starts_with("first") { 3 } else { 0 };
        assert_eq!((errors, left_out), (expected, vec![]), "{name}");
        let (records, _) = tests::read(Format::Mf4, &file);
        let lin: Vec<_> = records.iter().filter_map(|record| record.lin().map(ToString::to_string)).collect();
        let expected = "LIN frame 3F: FD FD FD FD FD FD FD FD".to_owned();
        assert_eq!(lin, if name.starts_with("first") { vec![expected; 2] } else { Vec::new() }, "{name}");
    }
}

/// asammdf reads the frames that we read, and we read what it makes of these files: finished, sorted, in three ways of compression.
#[test]
fn asammdf_agrees_about_these_files_and_about_what_it_makes_of_them() {
    const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/mf4_peer.py");
    let Some(python) = cantap_testing::peers::python_with("asammdf") else { return };
    let directory = tempfile::tempdir().unwrap();
    let mut command = Command::new(python);
    command.arg(SCRIPT);
    for (name, file) in files() {
        let path = directory.path().join(format!("{name}.mf4"));
        std::fs::write(&path, file).unwrap();
        command.arg(path);
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    // It says nothing of remote frames that it could say of data frames.
    let expected: Vec<_> = expected().into_iter().filter(|line| !line.contains("#R")).collect();
    let mut count = 0;
    for theirs in text.split("file ").skip(1) {
        let (name, log) = theirs.split_once('\n').unwrap();
        assert_eq!(sorted(log), expected, "{name}");
        count += 1;
    }
    assert_eq!(count, 6);
    for (name, _) in files() {
        for compression in 0..3 {
            let path = directory.path().join(format!("{name}-{compression}.mf4"));
            let (frames, errors, _) = read(&name, &std::fs::read(path).unwrap());
            let frames: Vec<_> = frames.into_iter().filter(|line| !line.contains("#R")).collect();
            assert_eq!(frames, expected, "{name} {compression}");
            assert_eq!(errors, if name.starts_with("first") { 3 } else { 0 }, "{name} {compression}");
        }
    }
}

/// A value that never comes is said, and the frames behind it are read.
#[test]
fn a_frame_whose_bytes_are_missing_does_not_take_the_others_with_it() {
    let frames = FRAMES.map(Frame::of);
    let mut file = file(first_layout, Form::Unfinished, &frames);
    // The record of the second frame says another place.
    let place = memchr::memmem::find_iter(&file, &8_u64.to_le_bytes()).last().unwrap();
    file[place..place + 8].copy_from_slice(&7_u64.to_le_bytes());
    let (records, issues) = tests::read(Format::Mf4, &file);
    let frames = records.iter().filter(|record| record.frame().is_some()).count();
    assert_eq!(frames, FRAMES.len() - 1);
    assert!(issues.len() == 1 && issues[0].contains("1 frame without theirs, the first at"), "{issues:?}");
}

/// `cat a.mf4 b.mf4` gave the first one, and nothing was said of the second.
#[test]
fn a_second_file_behind_the_first_is_told_with_its_place() {
    for (name, file) in files() {
        for gap in [0, 3, 4096] {
            let joined = [&file[..], &vec![0; gap], &file].concat();
            let (records, issues) = tests::read(Format::Mf4, &joined);
            let frames = records.iter().filter(|record| record.frame().is_some()).count();
            let place = format!("tail -c +{} FILE", file.len() + gap + 1);
            if gap == 0 {
                assert_eq!((frames, issues.len()), (FRAMES.len(), 1), "{name}: {issues:?}");
            }
            // Behind data whose length is unknown, anything else than records is damage.
            if gap == 0 || !name.ends_with("Unfinished") {
                assert!(issues.iter().any(|issue| issue.contains(&place)), "{name} {gap}: {issues:?}");
            }
        }
        // Anything else behind it is none.
        let (_, issues) = tests::read(Format::Mf4, [&file[..], &[0; 99]].concat());
        assert!(name.ends_with("Unfinished") || issues.is_empty(), "{name}: {issues:?}");
    }
}

/// A channel of limited length has its length in another one; bits behind the record say which values are none.
#[test]
fn limited_values_and_conversions_into_texts_and_invalid_values_are_read_by_the_same_rule() {
    let mut blocks = Blocks(vec![0; HEADER_AT as usize + 104]);
    let texts = |blocks: &mut Blocks, keys: [f64; 2], texts: [&str; 2]| {
        let texts = texts.map(|text| blocks.text(*b"##TX", text));
        let mut data = vec![7, 0, 0, 0, 3, 0, 2, 0];
        data.resize(24, 0);
        data.extend(keys.iter().flat_map(|key| key.to_le_bytes()));
        blocks.push(*b"##CC", &[0, 0, 0, 0, texts[0], texts[1], 0], &data)
    };
    // The reverse of what the raw values would say.
    let direction = texts(&mut blocks, [0.0, 1.0], ["Tx", "Rx"]);
    // For readers only.
    let bus = texts(&mut blocks, [3.0, 4.0], ["engine", "body"]);
    let id = conversion(&mut blocks, 1, &[256.0, 2.0]);
    let channel = |blocks: &mut Blocks, next, name, kind, part: Part, conversion, invalid: Option<u32>| {
        let name = blocks.text(*b"##TX", name);
        let at = blocks.channel(next, name, [kind, 0], &part, [0, conversion, 0]);
        if let Some(bit) = invalid {
            super::patch(blocks, at, 24 + 8 * 8 + 12, 2);
            super::patch(blocks, at, 24 + 8 * 8 + 16, bit);
        }
        at
    };
    let size = channel(&mut blocks, 0, "size", 0, ("", 11, 0, 8, UNSIGNED), 0, None);
    let mut parts = channel(&mut blocks, size, "F.DataBytes", 5, ("", 12, 0, 64, BYTES), 0, None);
    super::patch(&mut blocks, parts, super::LINK_TO_DATA, size as u32);
    parts = channel(&mut blocks, parts, "F.Dir", 0, ("", 10, 0, 1, UNSIGNED), direction, Some(0));
    parts = channel(&mut blocks, parts, "F.BusChannel", 0, ("", 10, 1, 7, UNSIGNED), bus, Some(1));
    parts = channel(&mut blocks, parts, "F.ID", 0, ("", 8, 0, 16, UNSIGNED), id, Some(2));
    let frame = channel(&mut blocks, 0, "CAN_DataFrame", 0, ("", 8, 0, 96, BYTES), 0, None);
    super::patch(&mut blocks, frame, 24 + 8, parts as u32);
    let name = blocks.text(*b"##TX", "t");
    let seconds = ("", 0, 0, 64, FLOAT);
    let time = blocks.channel(frame, name, [2, 1], &seconds, [0, 0, 0]);
    let group = super::group(&mut blocks, 1, 0, 20, [0, time, 0]);
    super::patch(&mut blocks, group, 24 + 6 * 8 + 28, 1);
    let rows: [(u16, u8, u8, u8); 5] =
        [(1, 3 << 1, 2, 0), (2, 4 << 1 | 1, 8, 0), (3, 3 << 1, 0, 1), (4, 4 << 1 | 1, 1, 2), (5, 0, 1, 4)];
    let mut data = Vec::new();
    for (at, (id, bits, len, invalid)) in rows.into_iter().enumerate() {
        data.extend((at as f64 * 0.001).to_le_bytes());
        data.extend(id.to_le_bytes());
        data.extend([bits, len, 1, 2, 3, 4, 5, 6, 7, 8, invalid]);
    }
    super::patch(&mut blocks, group, 24 + 6 * 8 + 8, rows.len() as u32);
    let data = blocks.push(*b"##DT", &[], &data);
    let file = super::finish(blocks, group, data, 0, 0);
    let (frames, _, left_out) = read("limited", &file);
    assert_eq!(
        frames,
        [
            "(1410714882.000000) can2 102#0102 T",
            "(1410714882.001000) can3 104#0102030405060708",
            "(1410714882.002000) can2 106#",
            "(1410714882.003000) can0 108#01",
        ]
    );
    assert_eq!(left_out, [("records that are marked as invalid", 1)]);
}
