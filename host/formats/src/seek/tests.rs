//! What is read by an index is what a reading of the whole file gives.

mod others;

use std::fs;
use std::path::Path;

use proptest::prelude::*;
use proptest::sample::Index as Any;

use super::{BLOCK_BYTES, IndexFolder};
use crate::file_writer::FileWriter;
use crate::output::Output;
use crate::time_range::{TimePoint, TimeRange};
use crate::{
    CsvDialect, Format, MemoryFile, ReadOptions, TraceReader, TraceWriter, TrcVersion, WriteOptions,
    open_reader,
};
use cantap_trace::testing::{data_record, record_or_fd};
use cantap_trace::{PlainFrame, TraceRecord};

/// What a reading gives: records of the range and issues in their order, and what is counted at the end.
#[derive(Debug, PartialEq, Eq)]
struct Read {
    items: Vec<String>,
    counts: (u64, u64, String, String),
    channels: std::collections::BTreeSet<u8>,
    /// How many records were read, of any time.
    handed_out: u64,
}

fn options(format: Format, index: Option<&Path>) -> ReadOptions {
    let index = index.map(IndexFolder::new);
    ReadOptions { format: Some(format), index, ..ReadOptions::default() }
}

fn read(path: &Path, options: &ReadOptions, range: TimeRange, is_mixed: bool) -> Read {
    let mut reader = open_reader(path, options).unwrap();
    let (mut range, mut items, mut handed_out) = (range, Vec::new(), 0);
    let mut channels = std::collections::BTreeSet::new();
    reader.within(&mut range).unwrap();
    let (mut frames, mut records) = (Vec::new(), Vec::new());
    loop {
        let next = if is_mixed {
            reader.next_mixed(&mut frames, &mut records)
        } else {
            reader.next_batch(&mut records)
        };
        match next {
            None => break,
            Some(Err(issue)) => items.push(issue.to_string()),
            Some(Ok(())) => {
                channels.extend(frames.iter().map(|frame| frame.channel));
                channels.extend(records.iter().map(|record| record.channel));
                handed_out += (frames.len() + records.len()) as u64;
                for frame in &frames {
                    let is_inside = range.contains(&data_record(frame.time_ns));
                    items.extend(is_inside.then(|| format!("{frame:?}")));
                }
                for record in &records {
                    // Whether a frame comes as a plain one may depend on what else is read at a time.
                    let plain = PlainFrame::of(record).filter(|_| is_mixed);
                    let text = plain.map_or_else(|| format!("{record:?}"), |frame| format!("{frame:?}"));
                    items.extend(range.contains(record).then_some(text));
                }
            }
        }
    }
    let counts = |reader: &TraceReader| {
        let kinds = |kinds: &crate::LeftOut| format!("{:?}", kinds.iter().collect::<Vec<_>>());
        (reader.records(), reader.issues(), kinds(reader.left_out()), kinds(reader.notes()))
    };
    channels.extend(reader.passed_channels());
    Read { items, counts: counts(&reader), channels, handed_out }
}

/// Each of these ranges, read by an index and without: both ways.
fn assert_same(path: &Path, format: Format, folder: &Path, ranges: &[TimeRange]) {
    for range in ranges {
        for is_mixed in [false, true] {
            let whole = read(path, &options(format, None), *range, is_mixed);
            let part = read(path, &options(format, Some(folder)), *range, is_mixed);
            let part = Read { handed_out: whole.handed_out, ..part };
            assert_same_items(&part, &whole, format);
        }
    }
}

/// Shows the first that differs: there may be thousands.
fn assert_same_items(part: &Read, whole: &Read, format: Format) {
    let differs = part.items.iter().zip(&whole.items).position(|(part, whole)| part != whole);
    let at = differs.unwrap_or(part.items.len().min(whole.items.len()));
    assert_eq!(part.items.get(at), whole.items.get(at), "{format}: {at}");
    assert_eq!((&part.counts, &part.channels), (&whole.counts, &whole.channels), "{format}");
}

/// A file in which a container has few records.
fn file(format: Format, records: &[TraceRecord]) -> Vec<u8> {
    let memory = MemoryFile::default();
    let output = Output::Stream(Box::new(memory.clone()));
    let mut writer = Box::new(FileWriter::new(output, format, &WriteOptions::default()));
    for few in records.chunks(40) {
        for record in few {
            writer.write(record).unwrap();
        }
        writer.flush().unwrap();
    }
    writer.finish().unwrap();
    memory.take()
}

fn indexes(folder: &Path) -> Vec<std::path::PathBuf> {
    fs::read_dir(folder).map_or(Vec::new(), |files| files.map(|file| file.unwrap().path()).collect())
}

const FORMATS: &[Format] = &[
    Format::Candump,
    Format::Blf,
    Format::Asc,
    Format::Trc(TrcVersion::V1_1),
    Format::Trc(TrcVersion::V2_1),
    Format::Csv(CsvDialect::PythonCan),
    Format::Csv(CsvDialect::Full),
    Format::Csv(CsvDialect::Analyser),
    Format::Csv(CsvDialect::Gvret),
    Format::Pcapng,
    Format::Mf4,
];

fn any_range(times: Vec<i64>) -> impl Strategy<Value = TimeRange> {
    let point = move || {
        let times = times.clone();
        (any::<Any>(), any::<bool>(), -1..2_i64).prop_map(move |(at, is_absolute, more)| {
            let time_ns = times[at.index(times.len())].saturating_add(more);
            if is_absolute {
                TimePoint::At(time_ns)
            } else {
                TimePoint::AfterFirst(time_ns.saturating_sub(times[0]))
            }
        })
    };
    (prop::option::weighted(0.8, point()), prop::option::weighted(0.8, point()))
        .prop_map(|(start, end)| TimeRange::new(start, end))
}

fn any_records() -> impl Strategy<Value = (Vec<TraceRecord>, Vec<TimeRange>)> {
    (prop::collection::vec(record_or_fd(1000), 1..400), any::<bool>()).prop_flat_map(
        |(mut records, is_sorted)| {
            if is_sorted {
                records.sort_by_key(|record| record.time_ns);
            }
            let times = records.iter().map(|record| record.time_ns).collect();
            (Just(records), prop::collection::vec(any_range(times), 1..6))
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Damage, growth and changes included.
    #[test]
    fn what_an_index_leaves_out_is_not_missed(
        (records, ranges) in any_records(),
        format in prop::sample::select(FORMATS),
        damage in prop::collection::vec((any::<Any>(), any::<u8>()), 0..3),
        first in prop::option::weighted(0.3, any::<Any>()),
        change in prop::option::weighted(0.3, (any::<Any>(), any::<u8>())),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let (path, indexes) = (folder.path().join("trace"), folder.path().join("indexes"));
        let mut bytes = file(format, &records);
        for (at, value) in damage {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        // It may have been shorter when it was read first.
        let len = first.map_or(bytes.len(), |first| first.index(bytes.len()));
        fs::write(&path, &bytes[..len]).unwrap();
        assert_same(&path, format, &indexes, &ranges[..1]);
        fs::write(&path, &bytes).unwrap();
        assert_same(&path, format, &indexes, &ranges);
        if let Some((at, value)) = change {
            let at = at.index(bytes.len());
            bytes[at] = value;
            fs::write(&path, &bytes).unwrap();
            let time = std::time::UNIX_EPOCH;
            fs::File::options().append(true).open(&path).unwrap().set_modified(time).unwrap();
            assert_same(&path, format, &indexes, &ranges);
        }
    }

    /// Whatever is in the file of an index, reading ends well; and if it is none, nothing is missed.
    #[test]
    fn an_index_that_is_damaged_is_not_used(at: Any, value: u8, keep in prop::option::of(any::<Any>())) {
        let folder = tempfile::tempdir().unwrap();
        let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
        let records: Vec<_> = (0..200).map(|at| data_record(at * 1_000_000)).collect();
        fs::write(&path, file(Format::Candump, &records)).unwrap();
        let range = TimeRange::new(Some(TimePoint::AfterFirst(150_000_000)), None);
        assert_same(&path, Format::Candump, &kept, &[range]);
        let index = indexes(&kept).pop().unwrap();
        let mut bytes = fs::read(&index).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = value;
        bytes.truncate(keep.map_or(bytes.len(), |keep| keep.index(bytes.len())));
        fs::write(&index, bytes).unwrap();
        assert_same(&path, Format::Candump, &kept, &[range]);
    }

    #[test]
    fn no_state_is_too_strange(state in prop::collection::vec(any::<u8>(), 0..100), format in prop::sample::select(FORMATS)) {
        let spec = crate::spec::FormatSpec::of(format);
        let mut decoder = (spec.reader)(&ReadOptions::default());
        let mut input = crate::input::Input::new(Box::new(std::io::Cursor::new("(1.0) can0 123#11\n")), false);
        if decoder.restore(&state).is_some() {
            let _ = decoder.batch(&mut input, &mut Vec::new());
        }
    }
}

#[test]
fn parts_outside_of_the_range_are_not_read() {
    for format in FORMATS {
        let folder = tempfile::tempdir().unwrap();
        let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
        let records: Vec<_> = (0..20_000).map(|at| data_record(at * 1_000_000)).collect();
        fs::write(&path, file(*format, &records)).unwrap();
        let range = TimeRange::new(
            Some(TimePoint::AfterFirst(5_000_000_000)),
            Some(TimePoint::AfterFirst(5_100_000_000)),
        );
        let first = read(&path, &options(*format, Some(&kept)), range, false);
        assert_eq!((first.handed_out, first.items.len()), (20_000, 100), "{format}");
        let second = read(&path, &options(*format, Some(&kept)), range, false);
        assert_same_items(&second, &first, *format);
        assert!(second.handed_out < 4_000, "{format}: {}", second.handed_out);
    }
}

/// A file that is played, at its own speed, makes none.
#[test]
fn an_index_that_is_only_used_is_not_made() {
    for format in FORMATS {
        let folder = tempfile::tempdir().unwrap();
        let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
        let records: Vec<_> = (0..2000).map(|at| data_record(at * 1_000_000)).collect();
        fs::write(&path, file(*format, &records)).unwrap();
        let made = options(*format, Some(&kept));
        let used = ReadOptions { index: Some(IndexFolder::new(&kept).only_used()), ..made.clone() };
        let all = |options: &ReadOptions| read(&path, options, TimeRange::default(), false);
        let before = all(&used);
        assert_eq!((indexes(&kept).len(), before.items.len()), (0, 2000), "{format}");
        all(&made);
        assert_eq!(indexes(&kept).len(), 1, "{format}");
        assert_same_items(&all(&used), &before, *format);
    }
}

#[test]
fn a_file_that_grew_keeps_its_index_and_one_that_was_changed_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
    let records: Vec<_> = (0..2000).map(|at| data_record(at * 1_000_000)).collect();
    let mut bytes = file(Format::Candump, &records);
    let options = options(Format::Candump, Some(&kept));
    let range = TimeRange::new(Some(TimePoint::AfterFirst(1_500_000_000)), None);
    let handed_out = || read(&path, &options, range, false).handed_out;
    fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert_eq!(handed_out(), 1000);
    fs::write(&path, &bytes).unwrap();
    assert!((1000..1200).contains(&handed_out()));
    assert!((500..700).contains(&handed_out()));
    // Only what is before the change is still known.
    let at = bytes.len() / 2 + BLOCK_BYTES;
    bytes[at] ^= 1;
    fs::write(&path, &bytes).unwrap();
    fs::File::options().append(true).open(&path).unwrap().set_modified(std::time::UNIX_EPOCH).unwrap();
    assert!((900..1200).contains(&handed_out()));
}

/// Found by random files: a place in the middle of a line.
#[test]
fn a_line_that_was_half_written_is_read_when_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
    let line = "(1.000000) can0 123#1122334455667788\n";
    let mut text = format!("{:#<192}\n", "") + &line.repeat(64);
    // The last block ends before the last line's end.
    assert_eq!(text.len() % BLOCK_BYTES, 1);
    fs::write(&path, &text[..text.len() - 1]).unwrap();
    let range = TimeRange::new(Some(TimePoint::At(5_000_000_000)), None);
    assert_same(&path, Format::Candump, &kept, &[range]);
    text += &line.repeat(10);
    text += "(9.000000) can0 123#11\nrubbish\n";
    fs::write(&path, &text).unwrap();
    assert_same(&path, Format::Candump, &kept, &[range]);
}

#[test]
fn a_file_that_was_replaced_has_another_first_record() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("trace"), folder.path().join("indexes"));
    let range = TimeRange::new(Some(TimePoint::AfterFirst(1_000_000_000)), None);
    for first_s in [1_000, 2_000, 500] {
        let records: Vec<_> =
            (0..2000).map(|at| data_record(first_s * 1_000_000_000 + at * 1_000_000)).collect();
        fs::write(&path, file(Format::Candump, &records)).unwrap();
        let written = std::time::UNIX_EPOCH + std::time::Duration::from_secs(first_s as u64);
        fs::File::options().append(true).open(&path).unwrap().set_modified(written).unwrap();
        assert_same(&path, Format::Candump, &kept, &[range]);
    }
}
