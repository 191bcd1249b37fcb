//! Truncated, damaged and foreign files: readers never panic, return everything up to the cut, and say where
//! something is wrong and what was expected.

use crate::traces;

use std::fs;
use std::io::Cursor;
use std::path::Path;

use cantap_formats::{CsvDialect, Format, ReadOptions, TraceReader, open_reader};
use cantap_trace::TraceRecord;
use proptest::prelude::*;
use traces::mixed::assert_mixed_is_the_same;
use traces::{directory, file_name, odd, read, real, split, write};

/// Traffic of every kind, small enough to be cut at every byte.
fn records(directory: &Path, count: usize) -> Vec<TraceRecord> {
    let mut records = real(count);
    let last_ns = records.last().unwrap().time_ns;
    let odd = odd(directory);
    let shift_ns = last_ns + 1000 - odd[0].time_ns;
    records.extend(odd.iter().map(|record| TraceRecord { time_ns: record.time_ns + shift_ns, ..*record }));
    records
}

/// Every format's file.
fn files(test: &str, count: usize, compression: &str) -> Vec<(Format, Vec<u8>)> {
    let directory = directory(test);
    let records = records(&directory, count);
    Format::written()
        .map(|format| {
            let path = directory.join(file_name(format, compression));
            write(&path, format, &records);
            (format, fs::read(path).unwrap())
        })
        .collect()
}

fn read_bytes(format: Format, bytes: &[u8]) -> (Vec<TraceRecord>, Vec<String>) {
    // The others have no way of their own for plain frames, and are many.
    if !is_text(format) {
        assert_mixed_is_the_same(format, &ReadOptions::default(), bytes);
    }
    let source = Cursor::new(bytes.to_vec());
    match TraceReader::from_source("damaged", source, format, &ReadOptions::default()) {
        Ok(reader) => split(reader),
        Err(error) => (Vec::new(), vec![error.to_string()]),
    }
}

fn is_text(format: Format) -> bool {
    !matches!(format, Format::Blf | Format::Pcapng | Format::Mf4)
}

/// Formats with one record per line and nothing else of importance but the header.
const LINES: &[Format] =
    &[Format::Candump, Format::Csv(CsvDialect::Full), Format::Csv(CsvDialect::PythonCan)];

/// What remains after a cut are whole records and nothing misread from a part of one; and the reader reports the cut,
/// unless it is where a complete file could end.
#[test]
fn a_file_cut_at_any_byte_gives_everything_before_the_cut_and_says_so() {
    for (format, whole) in files("cut_anywhere", 12, "") {
        let (all, issues) = read_bytes(format, &whole);
        assert_eq!(issues, Vec::<String>::new(), "{format}");
        let mut rows_before = 0;
        for cut in 0..whole.len() {
            let (got, issues) = read_bytes(format, &whole[..cut]);
            let place = format!("{format} cut at {cut}: {issues:?}, {} records", got.len());
            let same = got.iter().zip(&all).take_while(|(got, all)| got == all).count();
            if same < got.len() {
                // A log's lines do not contain their length: the first frame of an identifier may be mistaken for a
                // shorter one.
                let id = |record: &TraceRecord| record.frame().map(|frame| (frame.id(), frame.is_remote()));
                let is_first = all[..same].iter().all(|record| id(record) != id(&got[same]));
                assert!(
                    format == Format::Candump && same + 1 == got.len() && is_first,
                    "{place}, {:?} instead of {:?}",
                    got[same],
                    all.get(same)
                );
            }
            let row = whole[..cut].rsplit(|byte| *byte == b'\n').next().unwrap();
            let could_end = match format {
                _ if cut == 0 => true,
                Format::Blf => false,
                // Blocks are whole words, and some end where one does.
                Format::Pcapng => cut % 4 == 0,
                // The last row is complete as far as it matters, or has not begun.
                _ => {
                    row.trim_ascii().is_empty()
                        || got.len() > rows_before
                        || [0, all.len()].contains(&got.len())
                }
            };
            assert!(could_end || issues.iter().any(|issue| issue.contains("ends inside")), "{place}");
            if row.is_empty() {
                rows_before = got.len();
            }
            if LINES.contains(&format) {
                let rows = whole[..cut].split(|byte| *byte == b'\n').count() - 1;
                let head = usize::from(format != Format::Candump);
                assert!(got.len() + head >= rows, "{place} of {rows} rows");
            }
        }
        // With one byte missing, at most one record is lost.
        let (got, _) = read_bytes(format, &whole[..whole.len() - 1]);
        assert!(got.len() + 1 >= all.len(), "{format}: {} of {}", got.len(), all.len());
    }
}

#[test]
fn a_compressed_file_cut_anywhere_gives_what_it_has_and_says_that_it_was_cut() {
    for compression in [".gz", ".zst", ".xz", ".lz4"] {
        for (format, whole) in files("cut_compressed", 300, compression) {
            let (all, _) = read_bytes(format, &whole);
            for cut in (1..whole.len()).step_by(whole.len() / 50) {
                let (got, issues) = read_bytes(format, &whole[..cut]);
                let sure = if is_text(format) { got.len().saturating_sub(1) } else { got.len() };
                assert!(got[..sure] == all[..sure], "{format}{compression} cut at {cut}");
                assert!(!issues.is_empty(), "{format}{compression} cut at {cut} of {}", whole.len());
            }
        }
    }
}

#[test]
fn no_flipped_byte_makes_a_reader_panic_or_invent_records() {
    for (format, mut bytes) in files("flipped", 12, "") {
        let (all, _) = read_bytes(format, &bytes);
        for at in 0..bytes.len() {
            let original = bytes[at];
            for value in [0, 0xFF, original ^ 1, original ^ 0x80, b'\n', b'9'] {
                bytes[at] = value;
                let (got, _) = read_bytes(format, &bytes);
                // A damaged error frame can read as two events, and so can all of them if the header is
                // damaged.
                assert!(got.len() <= 2 * all.len(), "{format} byte {at} = {value}: {}", got.len());
                if format == Format::Candump {
                    assert!(got.len() + 2 >= all.len(), "{format} byte {at} = {value}: {}", got.len());
                }
            }
            bytes[at] = original;
        }
    }
}

/// Where it is worth it, frames do not become records first.
#[test]
fn nearly_all_frames_of_blf_and_mf4_are_plain_ones() {
    for (format, bytes) in files("plain", 2000, "") {
        let source = Cursor::new(bytes);
        let mut reader = TraceReader::from_source("plain", source, format, &ReadOptions::default()).unwrap();
        let (mut frames, mut records, mut plain) = (Vec::new(), Vec::new(), 0);
        while reader.next_mixed(&mut frames, &mut records).is_some() {
            plain += frames.len() as u64;
        }
        let is_fast = matches!(format, Format::Blf | Format::Mf4);
        assert_eq!(is_fast, plain * 10 > reader.records() * 9, "{format}: {plain} of {}", reader.records());
    }
}

/// A file's containers are unpacked by all cores before they are needed, those of a pipe one after the other.
#[test]
fn a_file_gives_what_its_bytes_give_through_a_pipe_whole_and_damaged() {
    let directory = directory("cores");
    let path = directory.join("drive.blf");
    write(&path, Format::Blf, &real(60_000));
    let whole = fs::read(&path).unwrap();
    let damaged = |places: &[usize]| {
        let mut bytes = whole.clone();
        for at in places {
            bytes[*at] ^= 0x55;
        }
        bytes
    };
    let third = whole.len() / 3;
    let files = [
        whole.clone(),
        damaged(&[third]),
        damaged(&[third, third + 1, 2 * third, whole.len() - 1000]),
        // A container's signature, its own length, and the length of its objects.
        damaged(&[144]),
        damaged(&[144 + 9]),
        damaged(&[144 + 16 + 9]),
        whole[..2 * third].to_vec(),
        [&whole[..third], &whole[third + 77..]].concat(),
    ];
    for (number, bytes) in files.iter().enumerate() {
        fs::write(&path, bytes).unwrap();
        let (from_file, faults) = split(open_reader(&path, &ReadOptions::default()).unwrap());
        let (from_pipe, others) = read_bytes(Format::Blf, bytes);
        assert_eq!(faults.len(), others.len(), "{number}: {faults:?} {others:?}");
        // Nobody needs the length of the objects.
        assert_eq!(faults.is_empty(), matches!(number, 0 | 5), "{number}: {faults:?}");
        assert!(from_file == from_pipe, "{number}: {} and {} records", from_file.len(), from_pipe.len());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Damage in many places, with pieces missing, doubled and moved.
    #[test]
    fn no_damage_makes_a_reader_panic(
        seed in prop::collection::vec((any::<prop::sample::Index>(), any::<prop::sample::Index>(), any::<u8>(), 0..4_u8), 1..20),
    ) {
        for (format, mut bytes) in files("damaged", 40, "") {
            for (from, to, value, how) in &seed {
                let (from, to) = (from.index(bytes.len()), to.index(bytes.len()));
                let (from, to) = (from.min(to), from.max(to));
                match how {
                    0 => bytes[from] = *value,
                    1 => bytes.insert(from, *value),
                    2 => bytes.rotate_left(from),
                    _ if to - from < 200 && bytes.len() > 400 => drop(bytes.drain(from..to)),
                    _ => bytes[from..to.min(from + 4)].fill(*value),
                }
            }
            let bytes_in_file = bytes.len();
            let (records, issues) = read_bytes(format, &bytes);
            prop_assert!(records.len() + issues.len() <= bytes_in_file, "{}", format);
        }
    }

    /// Bytes that were never a trace.
    #[test]
    fn no_bytes_make_a_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..2000), text in "[ -~\r\n]{0,500}") {
        for format in Format::all() {
            read_bytes(format, &bytes);
            read_bytes(format, text.as_bytes());
        }
    }
}

/// One format's file must not trip another's reader: users mix up suffixes.
#[test]
fn every_reader_survives_every_other_formats_file() {
    for (format, bytes) in files("mistaken", 40, "") {
        for reader in Format::all() {
            let (records, issues) = read_bytes(reader, &bytes);
            let same = file_name(reader, "").rsplit('.').next() == file_name(format, "").rsplit('.').next();
            assert!(same || !issues.is_empty() || !records.is_empty(), "{format} as {reader}: silence");
        }
    }
}

#[test]
fn a_broken_line_is_named_by_file_and_line_with_what_was_expected_and_strict_ends_there() {
    let directory = directory("broken_line");
    let records = records(&directory, 20);
    for format in Format::written().filter(|format| is_text(*format) && *format != Format::Dif) {
        let path = directory.join(file_name(format, ""));
        write(&path, format, &records);
        let (whole, _) = read(&path);
        let text = fs::read_to_string(&path).unwrap();
        let mut lines: Vec<_> = text.lines().collect();
        // After the first frames and before the last, whatever the length of the header.
        let at = lines.len() - 16;
        lines.insert(at, "rubbish");
        fs::write(&path, lines.join("\n") + "\n").unwrap();
        let (left, issues) = read(&path);
        let place = format!("{}, line {}: expected ", path.display(), at + 1);
        assert!(issues.len() == 1 && issues[0].starts_with(&place), "{format}: {issues:?}");
        // In PEAK's files the second word is the first that matters.
        let found = if matches!(format, Format::Trc(_)) { "found nothing" } else { "found 'rubbish'" };
        assert!(issues[0].contains(found), "{issues:?}");
        assert_eq!(left, whole, "{format}");
        let options = ReadOptions { strict: true, ..ReadOptions::default() };
        let items: Vec<_> = open_reader(&path, &options).unwrap().collect();
        let before = items.iter().take_while(|item| item.is_ok()).count();
        assert!(before > 0 && before < whole.len() && items.len() == before + 1, "{format}: {before}");
    }
}

#[test]
fn damage_in_a_binary_file_is_named_by_its_offset() {
    for (format, mut bytes) in files("broken_object", 2000, "") {
        if is_text(format) {
            continue;
        }
        let middle = bytes.len() / 2;
        bytes[middle..middle + 64].fill(0xFF);
        let (_, issues) = read_bytes(format, &bytes);
        assert!(
            !issues.is_empty() && issues.iter().all(|issue| issue.starts_with("damaged, offset 0x")),
            "{issues:?}"
        );
    }
}
