//! One byte of every line is changed: each line is a record, a known other thing that is counted, or an issue.

use std::io::{Cursor, Read};
use std::path::Path;

use cantap_formats::{
    CsvDialect, Format, ReadOptions, TraceReader, TrcVersion, WriteOptions, create_writer, open_reader,
};
use cantap_trace::{Direction, FdFrame, TraceEvent, TraceRecord};

const LINES: usize = 4000;

/// Real traffic, and an FD frame in every tenth place where the format has them.
fn records(fd: bool) -> Vec<TraceRecord> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/nmea2000.log.gz");
    let records = open_reader(path, &ReadOptions::default()).unwrap().map(Result::unwrap).take(LINES);
    let flexible = |(at, record): (usize, TraceRecord)| match record.frame().copied() {
        Some(frame) if fd && at % 10 == 0 => {
            let data: Vec<u8> = (0..[12_u8, 20, 64][at / 10 % 3]).map(|byte| byte.wrapping_mul(7)).collect();
            let frame = FdFrame::new(frame.id(), at % 20 == 0, false, &data).unwrap().into();
            TraceRecord {
                event: TraceEvent::Frame { frame, direction: Direction::Tx, late: false },
                ..record
            }
        }
        _ => record,
    };
    records.enumerate().map(flexible).collect()
}

#[test]
fn with_one_byte_changed_in_every_line_none_is_lost_without_being_counted() {
    let directory = tempfile::tempdir().unwrap();
    for (format, fd) in [
        (Format::Candump, true),
        (Format::Asc, true),
        (Format::Trc(TrcVersion::V2_1), true),
        (Format::Trc(TrcVersion::V2_0), true),
        (Format::Trc(TrcVersion::V1_3), false),
        (Format::Trc(TrcVersion::V1_1), false),
        (Format::Trc(TrcVersion::V1_0), false),
        (Format::Csv(CsvDialect::PythonCan), false),
        (Format::Csv(CsvDialect::Full), true),
    ] {
        let path = directory.path().join("whole");
        let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
        let mut writer = create_writer(&path, &options).unwrap();
        for record in records(fd) {
            writer.write(&record).unwrap();
        }
        writer.finish().unwrap();
        let mut text = Vec::new();
        std::fs::File::open(&path).unwrap().read_to_end(&mut text).unwrap();
        for seed in 0..2 {
            let mut random = fastrand::Rng::with_seed(seed);
            let whole: Vec<Vec<u8>> =
                text.split_inclusive(|byte| *byte == b'\n').map(<[u8]>::to_vec).collect();
            let mut lines = whole.clone();
            // Heads and what stands behind the last row stay whole.
            let head = lines.iter().position(|line| is_row(format, line)).unwrap();
            for line in &mut lines[head..head + LINES] {
                let at =
                    random.usize(..line.len() - line.iter().rev().take_while(|byte| **byte < b' ').count());
                let old = line[at];
                while line[at] == old || matches!(line[at], b'\n' | b'\r') {
                    line[at] = random.u8(..);
                }
            }
            // Each with the head and a whole row alone: a line that says two things would make up for one that is lost.
            let before = whole[..=head].concat();
            let mut issues = 0;
            for line in &lines[head..head + LINES] {
                let source = Cursor::new([&before[..], line].concat());
                let mut reader =
                    TraceReader::from_source("damaged", source, format, &ReadOptions::default()).unwrap();
                let found: Vec<_> = reader.by_ref().collect();
                let counted = found.len() as u64 + reader.left_out().total() + reader.notes().total();
                // A comment is one of its own kind, which the program that made it may have written.
                let is_comment = matches!(format, Format::Candump) && line.starts_with(b"#");
                assert!(counted > 1 || is_comment, "{format:?}: {:?}", String::from_utf8_lossy(line));
                issues += usize::from(found.iter().any(Result::is_err));
            }
            // A test that damages nothing would show nothing.
            assert!(issues > LINES / 20, "{format:?}: {issues}");
        }
    }
}

fn is_row(format: Format, line: &[u8]) -> bool {
    let text = line.trim_ascii_start();
    match format {
        Format::Asc => text.first().is_some_and(u8::is_ascii_digit) && !text.ends_with(b"measurement\n"),
        Format::Trc(_) => !text.starts_with(b";"),
        Format::Csv(_) => text.first().is_some_and(u8::is_ascii_digit),
        _ => true,
    }
}
