//! A trace as a series of files, each limited in size or time and each valid on its own: for captures that
//! run for days.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::compression::Compression;
use super::file_writer::FileWriter;
use super::left_out::LeftOut;
use super::rotation::RotateAt;
use super::writer::{TraceWriter, WriteOptions};
use cantap_trace::TraceRecord;

/// Room left below the size limit: two records in the most verbose format (DIF, one of them held back), and the end of
/// the file.
const RESERVE_BYTES: u64 = 1024;

/// Digits of the number in a file's name. More files than that get longer names.
const NUMBER_DIGITS: usize = 6;

/// The writer of a series of files.
pub(crate) struct Rotating {
    path: PathBuf,
    options: WriteOptions,
    number: u64,
    current: Box<FileWriter>,
    /// Time of the first record in the current file.
    since_ns: Option<i64>,
    made: VecDeque<PathBuf>,
    left_out: LeftOut,
}

/// `trace.log.gz` with number 7 is `trace-000007.log.gz`.
fn numbered(path: &Path, number: u64) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let bare = Compression::split(&name).0.len();
    let stem = name[..bare].rfind('.').filter(|at| *at > 0).unwrap_or(bare);
    let (stem, suffixes) = name.split_at(stem);
    path.with_file_name(OsString::from(format!("{stem}-{number:0NUMBER_DIGITS$}{suffixes}")))
}

/// Creates the next file. An existing one is never overwritten: it is an earlier capture.
fn create(path: &Path, number: &mut u64, options: &WriteOptions) -> io::Result<(PathBuf, Box<FileWriter>)> {
    loop {
        *number += 1;
        let name = numbered(path, *number);
        if !name.exists() {
            let writer = FileWriter::create(&name, options)?;
            return Ok((name, Box::new(writer)));
        }
    }
}

impl Rotating {
    pub(crate) fn create(path: &Path, options: &WriteOptions) -> io::Result<Self> {
        if path.as_os_str() == "-" {
            let message = "standard output cannot be split into files; name a file";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
        }
        let mut number = 0;
        let (name, current) = create(path, &mut number, options)?;
        Ok(Self {
            path: path.to_owned(),
            options: options.clone(),
            number,
            current,
            since_ns: None,
            made: VecDeque::from([name]),
            left_out: LeftOut::default(),
        })
    }

    fn full(&self, record: &TraceRecord, since_ns: i64) -> bool {
        self.options.rotation.at.iter().any(|at| match at {
            RotateAt::Bytes(limit) => self.current.size() + RESERVE_BYTES > *limit,
            RotateAt::Time(limit) => {
                i128::from(record.time_ns) - i128::from(since_ns) >= limit.as_nanos().cast_signed()
            }
        })
    }

    fn next_file(&mut self) -> io::Result<()> {
        // It must be valid before there is another, if only with a provisional end: the program may be killed at
        // any moment.
        self.current.flush()?;
        let (name, next) = create(&self.path, &mut self.number, &self.options)?;
        let full = std::mem::replace(&mut self.current, next);
        self.left_out.merge(&full.finish()?);
        self.made.push_back(name);
        while self.options.rotation.keep.is_some_and(|keep| self.made.len() > keep.max(1)) {
            if let Some(oldest) = self.made.pop_front() {
                match fs::remove_file(&oldest) {
                    // Somebody else removed it, which is what was wanted.
                    Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                    result => result?,
                }
            }
        }
        Ok(())
    }
}

impl TraceWriter for Rotating {
    fn write(&mut self, record: &TraceRecord) -> io::Result<()> {
        let since_ns = *self.since_ns.get_or_insert(record.time_ns);
        if self.full(record, since_ns) && self.current.has_records() {
            self.next_file()?;
            self.since_ns = Some(record.time_ns);
            self.current.write(record)?;
            // A file without even its header is not a trace, should the program be killed now.
            return self.current.flush();
        }
        self.current.write(record)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.current.flush()
    }

    fn remark(&mut self, channel: u8, text: &str) {
        self.current.remark(channel, text);
    }

    fn finish(mut self: Box<Self>) -> io::Result<LeftOut> {
        self.left_out.merge(&self.current.finish()?);
        Ok(self.left_out)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{ReadOptions, Rotation, create_writer, open_reader};
    use super::*;
    use cantap_trace::testing::data_record;

    #[test]
    fn the_number_stands_before_all_suffixes() {
        for (path, expected) in [
            ("trace.log", "trace-000007.log"),
            ("a.b/trace.v1.asc.gz", "a.b/trace.v1-000007.asc.gz"),
            ("trace", "trace-000007"),
            (".log", ".log-000007"),
            ("trace.zst", "trace-000007.zst"),
            ("trace.blf.xz", "trace-000007.blf.xz"),
            ("trace.log.LZ4", "trace-000007.log.LZ4"),
        ] {
            assert_eq!(numbered(Path::new(path), 7), Path::new(expected));
        }
    }

    /// Writes 1000 frames 1 s apart, and returns the files and the number of frames in each.
    fn rotate(name: &str, at: &str, keep: Option<usize>) -> Vec<(PathBuf, usize, u64)> {
        let dir = tempfile::tempdir().unwrap();
        let rotation = Rotation { at: vec![at.parse().unwrap()], keep };
        let options = WriteOptions { rotation, ..WriteOptions::default() };
        let mut writer = create_writer(dir.path().join(name), &options).unwrap();
        for second in 0..1000 {
            writer.write(&data_record(second * 1_000_000_000)).unwrap();
        }
        assert!(writer.finish().unwrap().is_empty());
        let mut files: Vec<_> =
            fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        let count = |path: PathBuf| {
            let frames = open_reader(&path, &ReadOptions::default()).unwrap().map(Result::unwrap).count();
            let size = path.metadata().unwrap().len();
            (path.file_name().unwrap().into(), frames, size)
        };
        files.into_iter().map(count).collect()
    }

    #[test]
    fn no_file_is_larger_than_the_limit_and_no_frame_is_lost() {
        let files = rotate("a.log", "10k", None);
        assert!(files.len() > 3, "{files:?}");
        assert!(files.iter().all(|(.., size)| *size <= 10_000), "{files:?}");
        assert_eq!(files.iter().map(|(_, frames, _)| frames).sum::<usize>(), 1000);
    }

    #[test]
    fn each_file_spans_the_time_asked_for_and_only_the_last_are_kept() {
        let files = rotate("a.log.gz", "5m", Some(2));
        let counts: Vec<_> =
            files.iter().map(|(name, frames, _)| (name.to_str().unwrap(), *frames)).collect();
        assert_eq!(counts, [("a-000003.log.gz", 300), ("a-000004.log.gz", 100)]);
    }

    #[test]
    fn earlier_files_are_never_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("a-000001.log"), "(1.0) can0 123#\n").unwrap();
        let rotation = Rotation { at: vec![RotateAt::Bytes(1)], keep: None };
        let options = WriteOptions { rotation, ..WriteOptions::default() };
        let mut writer = create_writer(dir.path().join("a.log"), &options).unwrap();
        writer.write(&data_record(0)).unwrap();
        writer.write(&data_record(1)).unwrap();
        writer.finish().unwrap();
        assert_eq!(fs::read_to_string(dir.path().join("a-000001.log")).unwrap(), "(1.0) can0 123#\n");
        assert!(dir.path().join("a-000003.log").exists());
    }
}
