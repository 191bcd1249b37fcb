//! Files in the two layouts of CANedge loggers, made by hand: bytes in the records of another group, parts that are constants of their group,
//! lengths that a table gives. asammdf reads the same from them, and we read what it makes of them.

use std::process::Command;

use super::super::super::tests;
use super::super::encode::{Blocks, Part};
use super::{FILE_MAGIC, HEADER_AT, START_NS, UNFINISHED_MAGIC};
use crate::{Format, ReadOptions, TraceReader};

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

/// How a logger leaves a file, and what its makers' program makes of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// Numbers of records and the length of the data are missing.
    Unfinished,
    Finished,
    /// Each group by itself, and its values in a stream.
    Sorted,
}

/// A channel: its type, its field, and what its values are made of.
struct Channel {
    name: &'static str,
    kind: u8,
    part: Part,
    conversion: u64,
    /// The number of the group with its values, or 0.
    values: u8,
}

/// A group and its records.
struct Group {
    number: u8,
    name: String,
    bytes: u32,
    time: (Part, u64),
    channels: Vec<Channel>,
    records: u64,
    data: Vec<u8>,
    values: Vec<u8>,
}

const VARIABLE: u8 = 1;
const VIRTUAL: u8 = 6;
const UNSIGNED: u8 = 0;
const FLOAT: u8 = 4;
const BYTES: u8 = 10;

/// A frame in the parts that a logger writes.
#[derive(Clone, Debug)]
struct Frame {
    time_us: u64,
    bus: u8,
    id: u32,
    is_extended: bool,
    is_sent: bool,
    is_remote: bool,
    flags: Option<u8>,
    code: u8,
    bytes: Vec<u8>,
}

impl Frame {
    fn of((time_us, bus, text): (u64, u8, &str)) -> Self {
        let (text, is_sent) = text.strip_suffix(" T").map_or((text, false), |text| (text, true));
        let (id, rest) = text.split_once('#').unwrap();
        let (flags, data) = match rest.strip_prefix('#') {
            Some(rest) => (rest[..1].parse().ok(), &rest[1..]),
            None => (None, rest),
        };
        let hex = |at: usize| u8::from_str_radix(&data[at..at + 2], 16).unwrap();
        let bytes: Vec<_> =
            if data.starts_with('R') { Vec::new() } else { (0..data.len()).step_by(2).map(hex).collect() };
        let code = match data.strip_prefix('R') {
            Some(code) => code.parse().unwrap(),
            None => {
                cantap_trace::fd::FD_LENGTHS.iter().position(|len| usize::from(*len) == bytes.len()).unwrap()
                    as u8
            }
        };
        let (is_extended, is_remote) = (id.len() == 8, data.starts_with('R'));
        let id = u32::from_str_radix(id, 16).unwrap();
        Self { time_us, bus, id, is_extended, is_sent, is_remote, flags, code, bytes }
    }
}

fn conversion(blocks: &mut Blocks, kind: u8, values: &[f64]) -> u64 {
    let mut data = vec![kind, 0, 0, 0, 0, 0, values.len() as u8, 0];
    data.resize(24, 0);
    data.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    blocks.push(*b"##CC", &[0; 4], &data)
}

fn field(name: &'static str, byte: u32, bit: u8, bits: u32) -> Channel {
    Channel { name, kind: 0, part: ("", byte, bit, bits, UNSIGNED), conversion: 0, values: 0 }
}

/// The first layout: all frames in one group, all parts in the record but the bytes, which are in another group; times are floating-point
/// numbers of nanoseconds.
fn first_layout(blocks: &mut Blocks, frames: &[Frame]) -> Vec<Group> {
    let ns = conversion(blocks, 1, &[0.0, 1e-9]);
    let bytes = |values| Channel {
        kind: VARIABLE,
        part: ("", 14, 0, 64, BYTES),
        values,
        ..field("DataBytes", 0, 0, 0)
    };
    let group = |number, name: &str, bytes, channels| {
        let (time, data) = ((("", 0, 0, 64, FLOAT), ns), Vec::new());
        Group { number, name: name.into(), bytes, time, channels, records: 0, data, values: Vec::new() }
    };
    let parts = || {
        vec![
            field("BusChannel", 8, 1, 2),
            field("ID", 8, 3, 29),
            field("IDE", 8, 0, 1),
            field("DLC", 13, 4, 4),
            field("DataLength", 12, 1, 7),
            field("Dir", 12, 0, 1),
        ]
    };
    let flags = [field("EDL", 13, 0, 1), field("ESI", 13, 2, 1), field("BRS", 13, 1, 1), bytes(2)];
    let mut data = group(1, "CAN_DataFrame", 22, parts().into_iter().chain(flags).collect());
    let mut remote = group(4, "CAN_RemoteFrame", 14, parts());
    let mut errors =
        group(3, "CAN_ErrorFrame", 9, vec![field("BusChannel", 8, 0, 2), field("ErrorType", 8, 2, 6)]);
    let lin_bytes = Channel { part: ("", 11, 0, 64, BYTES), ..field("DataBytes", 0, 0, 0) };
    let mut lin =
        group(6, "LIN_Frame", 19, vec![field("BusChannel", 8, 0, 2), field("ID", 8, 2, 6), lin_bytes]);
    for frame in frames {
        let group = if frame.is_remote { &mut remote } else { &mut data };
        group.records += 1;
        group.data.extend((frame.time_us as f64 * 1000.0).to_le_bytes());
        let word = frame.id << 3 | u32::from(frame.bus) << 1 | u32::from(frame.is_extended);
        group.data.extend(word.to_le_bytes());
        group.data.push((frame.bytes.len() as u8) << 1 | u8::from(frame.is_sent));
        let flags = frame.flags.map_or(0, |flags| 1 | (flags & 1) << 1 | (flags >> 1) << 2);
        group.data.push(frame.code << 4 | flags);
        if !frame.is_remote {
            group.data.extend((group.values.len() as u64).to_le_bytes());
            group.values.extend((frame.bytes.len() as u32).to_le_bytes());
            group.values.extend(&frame.bytes);
        }
    }
    errors.records = 1;
    errors.data = [&1_500_000_f64.to_le_bytes()[..], &[2 << 2 | 1]].concat();
    lin.records = 2;
    lin.data = [1_600_000_f64, 1_700_000_f64]
        .iter()
        .flat_map(|time| [&time.to_le_bytes()[..], &[0xFD; 11]].concat())
        .collect();
    vec![data, errors, remote, lin]
}

/// The second layout: a group for each bus, direction, kind of identifier and length; times are counters of microseconds. What is the same in
/// all records of a group is no field, and the length comes from the code by a table.
fn second_layout(blocks: &mut Blocks, frames: &[Frame]) -> Vec<Group> {
    let us = conversion(blocks, 1, &[0.0, 1e-6]);
    let lengths = cantap_trace::fd::FD_LENGTHS.iter().enumerate();
    let lengths: Vec<_> = lengths.flat_map(|(code, len)| [code as f64, f64::from(*len)]).collect();
    let lengths = conversion(blocks, 5, &lengths);
    let mut constants: Vec<_> = (0..3).map(|value| conversion(blocks, 1, &[f64::from(value), 0.0])).collect();
    let mut constant = move |name, value: u8| {
        let conversion = constants.get_mut(usize::from(value)).copied().unwrap();
        Channel { kind: VIRTUAL, conversion, ..field(name, 0, 0, 0) }
    };
    let mut groups: Vec<Group> = Vec::new();
    for frame in frames {
        let kind = match (frame.is_remote, frame.flags, frame.bytes.len() > 8) {
            (true, ..) => "RTR",
            (_, None, _) => "",
            (_, Some(_), false) => "FD_DLC_up_to_8",
            (_, Some(_), true) => "FD_DLC_over_8",
        };
        let name = format!("CAN{}_{}_{}_{kind}", frame.bus, frame.is_sent, frame.is_extended);
        let at = groups.iter().position(|group| group.name == name).unwrap_or_else(|| {
            let number = 2 * groups.len() as u8 + 64;
            let id_bytes = if frame.is_extended { 4 } else { 2 };
            let code = 6 + id_bytes;
            let mut channels = vec![
                constant("BusChannel", frame.bus),
                field("ID", 6, 0, if frame.is_extended { 29 } else { 11 }),
                constant("IDE", u8::from(frame.is_extended)),
                field("DLC", code, 0, 4),
                Channel { conversion: lengths, ..field("DataLength", code, 0, 4) },
                constant("Dir", u8::from(frame.is_sent)),
            ];
            if frame.flags.is_some() {
                channels.extend([constant("EDL", 1), field("ESI", code, 7, 1), field("BRS", code, 6, 1)]);
            }
            let bytes_at = code + 1;
            let bytes = match kind {
                "RTR" => bytes_at,
                "FD_DLC_over_8" => {
                    let part = ("", bytes_at, 0, 32, BYTES);
                    channels.push(Channel {
                        kind: VARIABLE,
                        part,
                        values: number + 1,
                        ..field("DataBytes", 0, 0, 0)
                    });
                    bytes_at + 4
                }
                _ => {
                    channels
                        .push(Channel { part: ("", bytes_at, 0, 64, BYTES), ..field("DataBytes", 0, 0, 0) });
                    bytes_at + 8
                }
            };
            let time = (("", 0, 0, 48, UNSIGNED), us);
            let (data, values) = (Vec::new(), Vec::new());
            groups.push(Group { number, name, bytes, time, channels, records: 0, data, values });
            groups.len() - 1
        });
        let group = &mut groups[at];
        group.records += 1;
        group.data.extend(&frame.time_us.to_le_bytes()[..6]);
        group.data.extend(&frame.id.to_le_bytes()[..if frame.is_extended { 4 } else { 2 }]);
        let flags = frame.flags.map_or(0, |flags| (flags & 1) << 6 | (flags >> 1) << 7);
        group.data.push(frame.code | flags);
        match kind {
            "RTR" => {}
            "FD_DLC_over_8" => {
                group.data.extend((group.values.len() as u32).to_le_bytes());
                group.values.extend((frame.bytes.len() as u32).to_le_bytes());
                group.values.extend(&frame.bytes);
            }
            _ => group.data.extend(frame.bytes.iter().copied().chain([0xFF; 8]).take(8)),
        }
    }
    groups
}

impl Group {
    /// What its channels are parts of.
    fn prefix(&self) -> &str {
        match (self.name.contains("RTR"), self.name.split_once('_')) {
            (true, _) => "CAN_RemoteFrame",
            (_, Some((bus, _))) if bus.starts_with("CAN") && bus.len() == 4 => "CAN_DataFrame",
            _ => &self.name,
        }
    }

    /// Its block; `values`: where those of a variable channel are.
    fn block(&self, blocks: &mut Blocks, next: u64, values: u64, is_counted: bool) -> u64 {
        let prefix = self.prefix();
        let mut parts = 0;
        for channel in self.channels.iter().rev() {
            let name = blocks.text(*b"##TX", &format!("{prefix}.{}", channel.name));
            parts = blocks.channel(parts, name, [channel.kind, 0], &channel.part, [0, channel.conversion, 0]);
            if channel.values > 0 {
                super::patch(blocks, parts, super::LINK_TO_DATA, values as u32);
            }
        }
        let whole = ("", self.time.0.3 / 8, 0, 8 * self.bytes - self.time.0.3, BYTES);
        let name = blocks.text(*b"##TX", prefix);
        let whole = blocks.channel(0, name, [0, 0], &whole, [parts, 0, 0]);
        let name = blocks.text(*b"##TX", "Timestamp");
        let time = blocks.channel(whole, name, [2, 1], &self.time.0, [0, self.time.1, 0]);
        let name = blocks.text(*b"##TX", &self.name);
        let bus = if prefix.starts_with("LIN") { 3 } else { 2 };
        let source = blocks.push(*b"##SI", &[name, name, 0], &[2, bus, 0, 0, 0, 0, 0, 0]);
        let mut data = u64::from(self.number).to_le_bytes().to_vec();
        data.extend(if is_counted { self.records } else { 0 }.to_le_bytes());
        data.extend([6, 0, b'.', 0, 0, 0, 0, 0]);
        data.extend(self.bytes.to_le_bytes());
        data.extend([0; 4]);
        blocks.push(*b"##CG", &[next, time, name, source, 0, 0], &data)
    }

    fn has_values(&self) -> bool {
        self.channels.iter().any(|channel| channel.values > 0)
    }

    /// Its records, each with its number before it and the value behind it, by the time in the first six bytes of layouts of counters or as a
    /// floating-point number.
    fn rows(&self) -> Vec<(u64, Vec<u8>)> {
        let mut values = &self.values[..];
        let of_record = |record: &[u8]| {
            let time: [u8; 8] = *record.first_chunk().unwrap();
            let us = if self.time.0.4 == FLOAT {
                (f64::from_le_bytes(time) / 1000.0).round() as u64
            } else {
                u64::from_le_bytes(time) & ((1 << 48) - 1)
            };
            let mut row = [&[self.number][..], record].concat();
            if self.has_values() {
                let len = 4 + u32::from_le_bytes(*values.first_chunk().unwrap()) as usize;
                let (value, rest) = values.split_at(len);
                row.push(self.channels.iter().map(|channel| channel.values).max().unwrap());
                row.extend(value);
                values = rest;
            }
            (us, row)
        };
        self.data.chunks_exact(self.bytes as usize).map(of_record).collect()
    }
}

/// A file of these frames.
fn file(layout: fn(&mut Blocks, &[Frame]) -> Vec<Group>, form: Form, frames: &[Frame]) -> Vec<u8> {
    let mut blocks = Blocks(vec![0; HEADER_AT as usize + 104]);
    let groups = layout(&mut blocks, frames);
    let comment = "<HDcomment><TX/><common_properties><tree name=\"Device Information\">\
                   <e name=\"serial number\" ro=\"true\">00000001</e></tree></common_properties></HDcomment>";
    let comment = blocks.text(*b"##MD", comment);
    let is_counted = form != Form::Unfinished;
    let mut next_data = 0;
    if form == Form::Sorted {
        for group in groups.iter().rev() {
            let values = if group.has_values() { blocks.push(*b"##SD", &[], &group.values) } else { 0 };
            let block = group.block(&mut blocks, 0, values, true);
            let data = blocks.push(*b"##DT", &[], &group.data);
            next_data = blocks.push(*b"##DG", &[next_data, block, data, 0], &[0; 8]);
        }
    } else {
        let mut next = 0;
        for group in groups.iter().rev() {
            let mut values = 0;
            if group.has_values() {
                let number = group.channels.iter().map(|channel| channel.values).max().unwrap();
                let mut data = u64::from(number).to_le_bytes().to_vec();
                data.extend(if is_counted { group.records } else { 0 }.to_le_bytes());
                data.extend([1, 0, 0, 0, 0, 0, 0, 0]);
                data.extend(if is_counted { group.values.len() as u64 } else { 0 }.to_le_bytes());
                next = blocks.push(*b"##CG", &[next, 0, 0, 0, 0, 0], &data);
                values = next;
            }
            next = group.block(&mut blocks, next, values, is_counted);
        }
        let mut rows: Vec<_> = groups.iter().flat_map(Group::rows).collect();
        rows.sort_by_key(|(us, _)| *us);
        let rows = rows.into_iter().map(|(_, row)| row).collect::<Vec<_>>().concat();
        let data_at = blocks.0.len() as u64 + 24 + 4 * 8 + 8;
        next_data = blocks.push(*b"##DG", &[0, next, data_at, 0], &[1, 0, 0, 0, 0, 0, 0, 0]);
        let len = if is_counted { 24 + rows.len() as u64 } else { 24 };
        blocks.0.extend([&b"##DT\0\0\0\0"[..], &len.to_le_bytes(), &[0; 8], &rows].concat());
    }
    let mut date = START_NS.to_le_bytes().to_vec();
    date.extend([0, 0, 0, 0, 2, 0, 0, 0]);
    date.resize(32, 0);
    let mut header = Blocks(Vec::new());
    header.push(*b"##HD", &[next_data, 0, 0, 0, 0, comment], &date);
    let mut file = blocks.0;
    file[HEADER_AT as usize..][..104].copy_from_slice(&header.0);
    file[..8].copy_from_slice(if is_counted { FILE_MAGIC } else { UNFINISHED_MAGIC });
    file[8..24].copy_from_slice(b"4.11    CE     \0");
    file[28..30].copy_from_slice(&411_u16.to_le_bytes());
    file[60..62].copy_from_slice(&(if is_counted { 0 } else { 0x25_u16 }).to_le_bytes());
    file
}

type Layout = fn(&mut Blocks, &[Frame]) -> Vec<Group>;

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
        let expected = if name.starts_with("first") { (1, vec![("events of LIN", 2)]) } else { (0, vec![]) };
        assert_eq!((errors, left_out), expected, "{name}");
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
            assert_eq!(errors, usize::from(name.starts_with("first")), "{name} {compression}");
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
    assert!(issues.len() == 1 && issues[0].contains("1 frames without theirs, the first at"), "{issues:?}");
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
