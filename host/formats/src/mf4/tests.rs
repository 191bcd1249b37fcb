//! Files arranged like those of other programs, made by hand: bytes stored apart from their records, data in
//! lists, compressed.

pub(crate) mod any_layout;
mod canedge;

use std::io::Write;

use super::super::tests;
use super::encode::Blocks;
use super::{FILE_MAGIC, HEADER_AT, UNFINISHED_MAGIC};
use crate::{Format, ReadOptions, TraceReader};

const START_NS: u64 = 1_410_714_882_000_000_000;

/// A record has a time, an identifier, a length code and the position of its bytes.
const RECORD_BYTES: usize = 21;
const LINK_TO_DATA: usize = 24 + 5 * 8;

fn records() -> Vec<(u32, Vec<u8>)> {
    (0..100).map(|at| (0x100 + at, vec![at as u8; at as usize % 9])).collect()
}

/// The expected log of these.
fn log() -> String {
    let line = |(at, (id, bytes)): (usize, (u32, Vec<u8>))| {
        let data = bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat();
        format!("(1410714882.{:06}) can1 {id:03X}#{data}\n", at * 500)
    };
    records().into_iter().enumerate().map(line).collect::<Vec<_>>().concat()
}

fn record(at: usize, id: u32, len: usize, place: u64) -> Vec<u8> {
    let mut record = (at as f64 * 0.0005).to_le_bytes().to_vec();
    record.extend(id.to_le_bytes());
    record.push(len as u8);
    record.extend(place.to_le_bytes());
    assert_eq!(record.len(), RECORD_BYTES);
    record
}

/// A file's blocks up to its group of frames; also returns the addresses of that group and of its bytes
/// channel.
fn begin() -> (Blocks, u64, usize) {
    let mut blocks = Blocks(vec![0; HEADER_AT as usize + 104]);
    let mut names =
        ["t", "CAN_DataFrame", "CAN_DataFrame.ID", "CAN_DataFrame.DLC", "CAN_DataFrame.DataBytes", "CAN2"]
            .map(|name| blocks.text(*b"##TX", name));
    let bytes = blocks.channel(0, names[4], [1, 0], &("", 13, 0, 64, 0), [0; 3]);
    let code = blocks.channel(bytes, names[3], [0, 0], &("", 12, 0, 4, 0), [0; 3]);
    let id = blocks.channel(code, names[2], [0, 0], &("", 8, 0, 32, 0), [0; 3]);
    let frame = blocks.channel(0, names[1], [0, 0], &("", 8, 0, 104, 10), [id, 0, 0]);
    let time = blocks.channel(frame, names[0], [2, 1], &("", 0, 0, 64, 4), [0; 3]);
    let source = blocks.push(*b"##SI", &[std::mem::take(&mut names[5]), 0, 0], &[2, 2, 0, 0, 0, 0, 0, 0]);
    let group = group(&mut blocks, 1, 0, RECORD_BYTES as u32, [0, time, source]);
    (blocks, group, bytes as usize)
}

fn group(blocks: &mut Blocks, id: u64, flags: u16, bytes: u32, [next, first, source]: [u64; 3]) -> u64 {
    let mut data = id.to_le_bytes().to_vec();
    data.extend(100_u64.to_le_bytes());
    data.extend(flags.to_le_bytes());
    data.extend([b'.', 0, 0, 0, 0, 0]);
    data.extend(bytes.to_le_bytes());
    data.extend([0; 4]);
    blocks.push(*b"##CG", &[next, first, 0, source, 0, 0], &data)
}

fn finish(mut blocks: Blocks, group: u64, data: u64, id_bytes: u8, open: u16) -> Vec<u8> {
    let data_group = blocks.push(*b"##DG", &[0, group, data, 0], &[id_bytes, 0, 0, 0, 0, 0, 0, 0]);
    let mut header = Blocks(Vec::new());
    let mut date = START_NS.to_le_bytes().to_vec();
    date.resize(32, 0);
    header.push(*b"##HD", &[data_group, 0, 0, 0, 0, 0], &date);
    let mut file = blocks.0;
    file[HEADER_AT as usize..][..104].copy_from_slice(&header.0);
    file[..8].copy_from_slice(if open == 0 { FILE_MAGIC } else { UNFINISHED_MAGIC });
    file[8..12].copy_from_slice(b"4.10");
    file[60..62].copy_from_slice(&open.to_le_bytes());
    file
}

fn as_log(file: &[u8]) -> (String, Vec<String>) {
    tests::as_log(Format::Mf4, file)
}

/// A block of compressed data, transposed if there are columns.
fn packed(blocks: &mut Blocks, of: [u8; 2], bytes: &[u8], columns: usize) -> u64 {
    let mut stored = bytes.to_vec();
    let rows = bytes.len().checked_div(columns).unwrap_or(0);
    for (at, byte) in bytes[..rows * columns].iter().enumerate() {
        stored[at % columns * rows + at / columns] = *byte;
    }
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(&stored).unwrap();
    let stored = encoder.finish().unwrap();
    let mut data = vec![of[0], of[1], u8::from(columns > 0), 0];
    data.extend((columns as u32).to_le_bytes());
    data.extend((bytes.len() as u64).to_le_bytes());
    data.extend((stored.len() as u64).to_le_bytes());
    data.extend(stored);
    blocks.push(*b"##DZ", &[], &data)
}

/// A list of blocks, the last of which continues in a second list.
fn list(blocks: &mut Blocks, data: &[u64]) -> u64 {
    let (last, first) = data.split_last().unwrap();
    let second = blocks.push(*b"##DL", &[0, *last], &[0; 8]);
    let links: Vec<u64> = [second].iter().chain(first).copied().collect();
    let first = blocks.push(*b"##DL", &links, &[0; 8]);
    blocks.push(*b"##HL", &[first], &[0; 8])
}

#[test]
fn bytes_in_a_stream_of_their_own_and_data_in_lists_plain_and_compressed_are_read() {
    let (mut blocks, group, bytes) = begin();
    let (mut data, mut values) = (Vec::new(), Vec::new());
    for (at, (id, value)) in records().into_iter().enumerate() {
        data.extend(record(at, id, value.len(), values.len() as u64));
        values.extend((value.len() as u32).to_le_bytes());
        values.extend(value);
    }
    // Records and values continue across blocks.
    let (first, rest) = data.split_at(1000);
    let (second, third) = rest.split_at(500);
    let pieces = [
        packed(&mut blocks, *b"DT", first, RECORD_BYTES),
        blocks.push(*b"##DT", &[], second),
        packed(&mut blocks, *b"DT", third, 0),
    ];
    let data = list(&mut blocks, &pieces);
    let (first, second) = values.split_at(333);
    let pieces = [packed(&mut blocks, *b"SD", first, 0), blocks.push(*b"##SD", &[], second)];
    let values = list(&mut blocks, &pieces);
    blocks.0[bytes + LINK_TO_DATA..][..8].copy_from_slice(&values.to_le_bytes());
    let file = finish(blocks, group, data, 0, 0);
    assert_eq!(as_log(&file), (log(), Vec::new()));
    // Cut before the group and the lists, nothing can be read, which is reported.
    for keep in [file.len() - 1, file.len() / 2, 200, 70, 3] {
        let (log, issues) = as_log(&file[..keep]);
        assert!(log.is_empty() && issues.len() == 1, "{keep}: {issues:?}");
    }
}

/// As asammdf writes groups in version 4.2 on request: lists with another name, containing blocks of values.
#[test]
fn the_lists_of_4_2_are_read_and_the_bits_that_lie_apart_say_what_is_valid() {
    for apart in [false, true] {
        let (mut blocks, group, bytes) = begin();
        let (mut data, mut values, mut bits) = (Vec::new(), Vec::new(), Vec::new());
        for (at, (id, value)) in records().into_iter().enumerate() {
            data.extend(record(at, id, value.len(), values.len() as u64));
            values.extend((value.len() as u32).to_le_bytes());
            values.extend(value);
            bits.push(if at % 10 == 0 { 2 } else { 1 });
        }
        let values = blocks.push(*b"##SD", &[], &values);
        blocks.0[bytes + LINK_TO_DATA..][..8].copy_from_slice(&values.to_le_bytes());
        // Blocks need not end with a record, but where bits lie apart each has those of its own.
        let (first, rest) = data.split_at(50 * RECORD_BYTES);
        let (second, third) = rest.split_at(25 * RECORD_BYTES);
        let first = packed(&mut blocks, *b"DV", first, RECORD_BYTES);
        let second = blocks.push(*b"##DV", &[], second);
        let third = blocks.push(*b"##DV", &[], third);
        let flags = if apart { 1_u32 << 31 } else { 0 };
        let fields = |count: u32| [flags.to_le_bytes(), count.to_le_bytes()].concat();
        let list = if apart {
            // Of two bits the second one counts.
            patch(&mut blocks, group, 24 + 6 * 8 + 28, 1);
            for at in channels_of(&blocks) {
                patch(&mut blocks, at, 24 + 8 * 8 + 12, 2);
                patch(&mut blocks, at, 24 + 8 * 8 + 16, 1);
            }
            let of_first = packed(&mut blocks, *b"DI", &bits[..50], 0);
            let of_third = blocks.push(*b"##DI", &[], &bits[75..]);
            let end = blocks.push(*b"##LD", &[0, third, of_third], &fields(1));
            // No bits: all of the second block is valid.
            blocks.push(*b"##LD", &[end, first, second, of_first, 0], &fields(2))
        } else {
            let end = blocks.push(*b"##LD", &[0, third], &fields(1));
            blocks.push(*b"##LD", &[end, first, second], &fields(2))
        };
        let file = finish(blocks, group, list, 0, 0);
        let valid = |at: usize| !apart || !at.is_multiple_of(10) || (50..75).contains(&at);
        let expected: Vec<_> = log()
            .lines()
            .enumerate()
            .filter(|(at, _)| valid(*at))
            .map(|(_, line)| format!("{line}\n"))
            .collect();
        assert_eq!(as_log(&file), (expected.concat(), Vec::new()), "{apart}");
        let source = std::io::Cursor::new(file);
        let mut reader =
            TraceReader::from_source("a.mf4", source, Format::Mf4, &ReadOptions::default()).unwrap();
        assert_eq!(reader.by_ref().count(), expected.len());
        let left_out: Vec<_> = reader.left_out().iter().collect();
        assert_eq!(left_out, if apart { vec![("records that are marked as invalid", 7)] } else { vec![] });
    }
}

/// Writes a number into a block.
fn patch(blocks: &mut Blocks, block: u64, at: usize, value: u32) {
    blocks.0[block as usize + at..][..4].copy_from_slice(&value.to_le_bytes());
}

/// The addresses of all channels so far.
fn channels_of(blocks: &Blocks) -> Vec<u64> {
    memchr::memmem::find_iter(&blocks.0, b"##CN").map(|at| at as u64).collect()
}

/// Times in the records of another group, as MDF 4.2 has them in columns.
#[test]
fn the_times_of_frames_may_be_the_records_of_another_group() {
    const REMOTE_MASTER: u16 = 8;
    for (remote, cut) in [(true, 0), (true, 8), (false, 0)] {
        let (mut blocks, old, bytes) = begin();
        let mut values = Vec::new();
        let (mut times, mut data) = (Vec::new(), Vec::new());
        for (at, (id, value)) in records().into_iter().enumerate() {
            let record = record(at, id, value.len(), values.len() as u64);
            times.extend(&record[..8]);
            data.extend([&[0; 8], &record[8..]].concat());
            values.extend((value.len() as u32).to_le_bytes());
            values.extend(value);
        }
        let values = blocks.push(*b"##SD", &[], &values);
        blocks.0[bytes + LINK_TO_DATA..][..8].copy_from_slice(&values.to_le_bytes());
        // The group of frames begins with the channel behind that of times.
        let (time, source) = (link(&blocks, old, 1), link(&blocks, old, 3));
        let frame = link(&blocks, time, 0);
        blocks.0[time as usize + 24..][..8].copy_from_slice(&0_u64.to_le_bytes());
        let master = group(&mut blocks, 0, 0, 8, [0, time, source]);
        let flags = if remote { REMOTE_MASTER } else { 0 };
        let of_frames = group(&mut blocks, 0, flags, RECORD_BYTES as u32, [0, frame, source]);
        let at = of_frames as usize;
        // One link more: to the group of times.
        let mut with_master = blocks.0[at..].to_vec();
        with_master[8..16].copy_from_slice(&(24 + 7 * 8 + 32_u64).to_le_bytes());
        with_master[16..24].copy_from_slice(&7_u64.to_le_bytes());
        with_master.splice(24 + 6 * 8..24 + 6 * 8, master.to_le_bytes());
        blocks.0.splice(at.., with_master);
        let times = blocks.push(*b"##DT", &[], &times[..times.len() - cut]);
        let data = packed(&mut blocks, *b"DT", &data, RECORD_BYTES);
        let second = blocks.push(*b"##DG", &[0, of_frames, data, 0], &[0; 8]);
        let mut file = finish(blocks, master, times, 0, 0);
        // The group of data of the times, the last block, goes on with that of the frames.
        let first = memchr::memmem::rfind(&file, b"##DG").unwrap();
        file[first + 24..][..8].copy_from_slice(&second.to_le_bytes());
        let (read, issues) = as_log(&file);
        match (remote, cut) {
            (false, _) => assert!(issues[0].contains("a group of frames without times"), "{issues:?}"),
            (true, 0) => assert_eq!((read, issues), (log(), Vec::new())),
            _ => {
                assert_eq!(read.lines().count(), 99);
                assert!(
                    issues.len() == 1 && issues[0].contains("the times of a group of frames"),
                    "{issues:?}"
                );
            }
        }
    }
}

fn link(blocks: &Blocks, block: u64, at: usize) -> u64 {
    u64::from_le_bytes(*blocks.0[block as usize + 24 + 8 * at..].first_chunk().unwrap())
}

/// Found with asammdf's files: a measurement gave an empty trace, which looked like success.
#[test]
fn a_measurement_without_a_bus_is_nothing_that_could_be_read() {
    let (blocks, group, _) = begin();
    let mut file = finish(blocks, group, 0, 0, 0);
    let names: Vec<_> = memchr::memmem::find_iter(&file, b"CAN_DataFrame").collect();
    for at in names {
        file[at..][..3].copy_from_slice(b"Eng");
    }
    let source = std::io::Cursor::new(file);
    let mut reader =
        TraceReader::from_source("drive.mf4", source, Format::Mf4, &ReadOptions::default()).unwrap();
    assert_eq!(reader.by_ref().count(), 0);
    let nothing = reader.nothing_read().unwrap().to_string();
    assert!(nothing.ends_with("mf4 without traffic of CAN: groups of measured signals (1)"), "{nothing}");
}

/// A logger writes the bytes of a frame before or after it, and does not finish the file.
#[test]
fn bytes_in_records_of_another_group_are_found_before_and_behind_also_by_their_order() {
    for by_order in [false, true] {
        let (mut blocks, frames, bytes) = begin();
        let values = group(&mut blocks, 2, 1, 0, [0; 3]);
        // The group of values follows that of frames.
        blocks.0[frames as usize + 24..][..8].copy_from_slice(&values.to_le_bytes());
        blocks.0[bytes + LINK_TO_DATA..][..8].copy_from_slice(&values.to_le_bytes());
        let (mut data, mut place) = (Vec::new(), 0);
        for (at, (id, value)) in records().into_iter().enumerate() {
            let place_told = if by_order { 0 } else { place };
            let frame = [vec![1], record(at, id, value.len(), place_told)].concat();
            let value = [&[2][..], &(value.len() as u32).to_le_bytes(), &value].concat();
            place += value.len() as u64 - 1;
            let (first, second) = if at % 3 == 0 { (frame, value) } else { (value, frame) };
            data.extend(first);
            data.extend(second);
        }
        let open = if by_order { 0x45 } else { 5 };
        // The last block's length was not written.
        let group_at = blocks.0.len() as u64;
        let data_at = group_at + 24 + 32 + 8;
        let mut file = finish(blocks, frames, data_at, 1, open);
        file.extend([&b"##DT\0\0\0\0"[..], &24_u64.to_le_bytes(), &[0; 8], &data].concat());
        assert_eq!(as_log(&file), (log(), Vec::new()), "{by_order}");
        let (cut, issues) = as_log(&file[..file.len() - 3]);
        assert!(log().starts_with(&cut) && cut.lines().count() == 99, "{cut}");
        assert_eq!(issues.len(), 1, "{issues:?}");
    }
}

/// As [`begin`], with what was received in records with number 1, what was sent in such with number 3, and the bytes of both in those with 2.
fn begin_scattered() -> (Blocks, u64) {
    let (mut blocks, received, bytes) = begin();
    let link = |blocks: &Blocks, at: usize| {
        u64::from_le_bytes(blocks.0[received as usize + 24 + at * 8..][..8].try_into().unwrap())
    };
    let values = group(&mut blocks, 2, 1, 0, [0; 3]);
    let of_sent = [values, link(&blocks, 1), link(&blocks, 3)];
    let sent = group(&mut blocks, 3, 0, RECORD_BYTES as u32, of_sent);
    blocks.0[received as usize + 24..][..8].copy_from_slice(&sent.to_le_bytes());
    blocks.0[bytes + LINK_TO_DATA..][..8].copy_from_slice(&values.to_le_bytes());
    (blocks, received)
}

/// As CANedge loggers write them: what was sent stands behind the response to it. Each group is in order, and so is what is read.
#[test]
fn records_of_several_groups_in_one_stream_come_in_the_order_of_time() {
    let (blocks, received) = begin_scattered();
    // Every tenth is sent, and comes four frames late.
    let is_sent = |at: usize| at.is_multiple_of(10);
    let mut order: Vec<usize> = (0..100).collect();
    order.sort_by_key(|at| if is_sent(*at) { at * 2 + 9 } else { at * 2 });
    assert_eq!(order[..6], [1, 2, 3, 4, 0, 5]);
    let (mut data, mut place) = (Vec::new(), 0);
    for at in order {
        let (id, value) = &records()[at];
        data.push(if is_sent(at) { 3 } else { 1 });
        data.extend(record(at, *id, value.len(), place));
        data.extend([&[2][..], &(value.len() as u32).to_le_bytes(), value].concat());
        place += 4 + value.len() as u64;
    }
    let data_at = blocks.0.len() as u64 + 24 + 32 + 8;
    let mut file = finish(blocks, received, data_at, 1, 5);
    file.extend([&b"##DT\0\0\0\0"[..], &24_u64.to_le_bytes(), &[0; 8], &data].concat());
    assert_eq!(as_log(&file), (log(), Vec::new()));
}

/// A frame in a file whose records say of which of two groups they are, and have their bytes in records of a third.
#[derive(Clone, Debug)]
pub(crate) struct Scattered {
    /// Half a millisecond after the last, and so many more.
    pub pause: u16,
    pub is_sent: bool,
    /// So many frames late in the file, if it is sent.
    pub late: u8,
    pub value: Vec<u8>,
    pub value_first: bool,
}

/// Such a file, as loggers leave it unfinished: a tenth of a frame may stand behind its successors.
pub(crate) fn scattered(frames: &[Scattered], by_order: bool) -> Vec<u8> {
    let (blocks, received) = begin_scattered();
    let mut at = 0;
    let times: Vec<usize> = frames
        .iter()
        .map(|frame| {
            at += usize::from(frame.pause) + 1;
            at
        })
        .collect();
    let mut order: Vec<usize> = (0..frames.len()).collect();
    order.sort_by_key(|at| at + if frames[*at].is_sent { usize::from(frames[*at].late) } else { 0 });
    let (mut data, mut place) = (Vec::new(), 0);
    for at in order {
        let Scattered { is_sent, value, value_first, .. } = &frames[at];
        let told = if by_order { 0 } else { place };
        let group = if *is_sent { 3 } else { 1 };
        let frame = [vec![group], record(times[at], at as u32 % 0x800, value.len(), told)].concat();
        place += 4 + value.len() as u64;
        let value = [&[2][..], &(value.len() as u32).to_le_bytes(), value].concat();
        let (first, second) = if *value_first { (value, frame) } else { (frame, value) };
        data.extend(first);
        data.extend(second);
    }
    let data_at = blocks.0.len() as u64 + 24 + 32 + 8;
    let mut file = finish(blocks, received, data_at, 1, if by_order { 0x45 } else { 5 });
    file.extend([&b"##DT\0\0\0\0"[..], &24_u64.to_le_bytes(), &[0; 8], &data].concat());
    file
}

/// Found by random damage: a cut after the version's first digits crashed the program.
#[test]
fn a_file_cut_in_its_first_bytes_is_named() {
    for len in 8..64 {
        let (log, issues) = as_log(&b"MDF     4.10    asammdf 8.8.28          "[..len.min(40)]);
        assert!(
            log.is_empty() && issues.len() == 1 && issues[0].contains("ends inside"),
            "{len}: {issues:?}"
        );
    }
    let (_, issues) = as_log(b"MDF     3.30    ");
    assert!(issues.len() == 1 && issues[0].contains("MDF 3.30"), "{issues:?}");
}

#[test]
fn what_is_no_mdf_4_is_named() {
    for (file, message) in [
        (
            b"MDF     3.30    ".to_vec(),
            "expected MDF 4.0 or later, into which programs for MDF convert older files, found MDF 3.30",
        ),
        (b"rubbish and more".to_vec(), "expected a file that begins with 'MDF', found 'rubbish '"),
        (b"MDF     4.10    ".to_vec(), "the file ends inside what describes the measurement"),
    ] {
        let (records, issues) = tests::read(Format::Mf4, file);
        assert!(records.is_empty() && issues.len() == 1 && issues[0].contains(message), "{issues:?}");
    }
}
