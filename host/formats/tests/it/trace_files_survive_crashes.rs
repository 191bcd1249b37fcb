//! A program that ends without warning leaves files that other programs can read: whatever was flushed is there and complete. The same
//! goes for anyone reading while a file is written.

use crate::traces;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use cantap_formats::{
    CsvDialect, Format, ReadOptions, RotateAt, Rotation, TrcVersion, WriteOptions, create_writer, open_reader,
};
use traces::{directory, file_name, options, read, real, write};

/// The options that write a format.
#[test]
fn what_was_flushed_is_a_whole_file_whatever_happens_afterwards() {
    let directory = directory("crashed");
    let records = real(3000);
    for format in Format::written() {
        for compression in ["", ".gz", ".zst", ".xz", ".lz4"] {
            let path = directory.join(file_name(format, compression));
            let mut writer = create_writer(&path, &options(format)).unwrap();
            for (at, record) in records.iter().enumerate() {
                writer.write(record).unwrap();
                if at == 999 || at == 1999 {
                    writer.flush().unwrap();
                }
            }
            // A killed program runs no destructors.
            std::mem::forget(writer);
            let (left, issues) = read(&path);
            let place = path.display();
            // More than was flushed is there if the writer's buffer was full. A provisional end is overwritten later, which
            // a compressed file does not allow: there the earlier analyser's tables lack the row held back for a loss after
            // it, and a DIF reader misses the row before the missing end.
            let without_end = usize::from(!compression.is_empty());
            let missing = match format {
                Format::Csv(CsvDialect::Analyser) => without_end,
                Format::Dif => 2 * without_end,
                _ => 0,
            };
            assert_eq!(
                issues.len(),
                if format == Format::Dif { without_end } else { 0 },
                "{place}: {issues:?}"
            );
            assert!(left.len() >= 2000 - missing, "{place}: {} of 2000", left.len());
            let same = directory.join(format!("whole-{}", file_name(format, "")));
            write(&same, format, &records[..left.len()]);
            assert!(left == read(&same).0, "{place}");
            // Nothing of a provisional end may remain between the rows. Statistics at the end of a pcapng file, and ASC's last line, are not
            // part of it: anyone who reads the growing file has read on past them.
            if compression.is_empty() && !matches!(format, Format::Blf) {
                let (left, whole) = (fs::read(&path).unwrap(), fs::read(&same).unwrap());
                assert!(whole.starts_with(&left), "{place}");
                assert!(
                    left.len() == whole.len() || matches!(format, Format::Asc | Format::Pcapng),
                    "{place}"
                );
            }
            test_by_its_own_program(&path);
        }
    }
}

/// Each record is read as soon as it is flushed. This does not apply to the tables of the earlier analyser, whose provisional end is
/// overwritten.
#[test]
fn a_file_can_be_followed_while_it_is_written() {
    let directory = directory("followed");
    let records = real(200);
    for format in [Format::Candump, Format::Asc, Format::Trc(TrcVersion::V2_1), Format::Pcapng] {
        let path = directory.join(file_name(format, ""));
        let mut writer = create_writer(&path, &options(format)).unwrap();
        let mut reader = None;
        for record in &records {
            writer.write(record).unwrap();
            writer.flush().unwrap();
            let reader = reader.get_or_insert_with(|| {
                let mut reader =
                    open_reader(&path, &ReadOptions { follow: true, ..ReadOptions::default() }).unwrap();
                let patience = Instant::now() + Duration::from_mins(1);
                reader.end_when(move || Instant::now() > patience);
                reader
            });
            let read = reader.next().unwrap_or_else(|| panic!("{format}: a record never came"));
            let read = read.unwrap_or_else(|issue| panic!("{format}: {issue}"));
            assert_eq!(read.event, record.event, "{format}");
        }
    }
}

/// gzip and zstd find nothing wrong with a file, if they are installed.
fn test_by_its_own_program(path: &Path) {
    let program = match path.extension().and_then(|suffix| suffix.to_str()) {
        Some("gz") => "gzip",
        Some("zst") => "zstd",
        Some("xz") => "xz",
        Some("lz4") => "lz4",
        _ => return,
    };
    if let Ok(output) = Command::new(program).arg("-t").arg(path).output() {
        assert!(output.status.success(), "{}: {}", path.display(), String::from_utf8_lossy(&output.stderr));
    }
}

/// A BLF is small: a piece that zstd compresses is of no use to a reader until it is complete.
#[test]
fn of_a_compressed_file_that_is_cut_only_the_end_is_missing() {
    let directory = directory("cut_late");
    let records = real(6158);
    // xz is left out: its unit is a longer stream.
    for compression in [".gz", ".zst", ".lz4"] {
        let path = directory.join(file_name(Format::Blf, compression));
        write(&path, Format::Blf, &records);
        let whole = fs::read(&path).unwrap();
        fs::write(&path, &whole[..whole.len() - whole.len() / 50]).unwrap();
        let (left, issues) = read(&path);
        assert!(!issues.is_empty(), "{compression}");
        // BLF's own containers, of 128 KiB before compression, are the rest.
        assert!(left.len() > 4000, "{compression}: {} of {}", left.len(), records.len());
        assert!(left == records[..left.len()], "{compression}");
    }
}

/// A conversion requests no flush.
#[test]
fn what_is_older_than_a_second_is_in_a_compressed_file_without_a_flush() {
    let directory = directory("unflushed");
    let records = real(usize::MAX);
    for compression in [".gz", ".zst", ".xz", ".lz4"] {
        let path = directory.join(file_name(Format::Candump, compression));
        let mut writer = create_writer(&path, &options(Format::Candump)).unwrap();
        let (before, after) = records.split_at(records.len() / 2);
        let mut write = |records: &[_]| records.iter().try_for_each(|record| writer.write(record)).unwrap();
        write(before);
        std::thread::sleep(Duration::from_millis(1050));
        write(after);
        std::mem::forget(writer);
        let (left, issues) = read(&path);
        assert_eq!(issues, Vec::<String>::new(), "{compression}");
        assert!(left.len() >= before.len(), "{compression}: {} of {}", left.len(), before.len());
    }
}

fn files(directory: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<_> = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// Each file of a series is valid on its own, by size and by time, in every format, and so is the last one after
/// a crash.
#[test]
fn every_file_of_a_row_is_whole_and_within_its_limit() {
    let records = real(usize::MAX);
    let span = Duration::from_secs(20);
    for format in Format::written() {
        for (compression, at) in [
            ("", RotateAt::Bytes(200_000)),
            (".gz", RotateAt::Bytes(200_000)),
            (".zst", RotateAt::Bytes(200_000)),
            ("", RotateAt::Time(span)),
            (".gz", RotateAt::Time(span)),
        ] {
            let directory = tempfile::tempdir().unwrap();
            let rotation = Rotation { at: vec![at], keep: None };
            let path = directory.path().join(file_name(format, compression));
            let mut writer = create_writer(&path, &WriteOptions { rotation, ..options(format) }).unwrap();
            for record in &records {
                writer.write(record).unwrap();
            }
            writer.flush().unwrap();
            std::mem::forget(writer);
            let place = format!("{format}{compression} {at:?}");
            let (mut frames, paths) = (0, files(directory.path()));
            for (at_file, path) in paths.iter().enumerate() {
                let (read, issues) = read(path);
                // As above: the last one has no end.
                let is_cut = format == Format::Dif && !compression.is_empty() && at_file + 1 == paths.len();
                assert_eq!(issues.len(), usize::from(is_cut), "{place} {}: {issues:?}", path.display());
                assert!(!read.is_empty(), "{place} {}", path.display());
                frames += read.len();
                match at {
                    RotateAt::Bytes(limit) => {
                        let size = path.metadata().unwrap().len();
                        assert!(size <= limit, "{place}: {size}");
                    }
                    RotateAt::Time(limit) => {
                        let spanned_ns = read.last().unwrap().time_ns - read[0].time_ns;
                        assert!(spanned_ns < limit.as_nanos() as i64, "{place}: {spanned_ns}");
                    }
                }
                test_by_its_own_program(path);
            }
            assert!(
                frames + 2 >= records.len(),
                "{place}: {frames} of {} in {} files",
                records.len(),
                paths.len()
            );
            let several = matches!(at, RotateAt::Time(_)) || compression.is_empty();
            assert!(!several || paths.len() > 1 || format == Format::Blf, "{place}: {} files", paths.len());
        }
    }
}
