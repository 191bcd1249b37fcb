//! What the tests of all formats have in common: files in memory.

#[path = "../tests/it/traces/mixed.rs"]
mod mixed;

use std::io;

use super::file_writer::FileWriter;
use super::output::Output;
use super::{Format, LeftOut, MemoryFile, ReadOptions, TraceReader, TraceWriter, WriteOptions};
use cantap_trace::TraceRecord;

/// The file that a format makes of records, and what it could not carry.
pub(crate) fn write_with(options: &WriteOptions, records: &[TraceRecord]) -> (Vec<u8>, LeftOut) {
    let memory = MemoryFile::default();
    let output = Output::Stream(Box::new(memory.clone()));
    let mut writer = Box::new(FileWriter::new(output, options.format.unwrap(), options));
    for record in records {
        writer.write(record).unwrap();
    }
    let left_out = writer.finish().unwrap();
    (memory.take(), left_out)
}

/// The file that a text format makes of records.
pub(crate) fn write(format: Format, records: &[TraceRecord]) -> String {
    let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
    String::from_utf8(write_with(&options, records).0).unwrap()
}

/// The records in a file, and what is wrong with it.
pub(crate) fn read(format: Format, bytes: impl AsRef<[u8]>) -> (Vec<TraceRecord>, Vec<String>) {
    read_with(&ReadOptions { format: Some(format), ..ReadOptions::default() }, bytes)
}

/// The records in a file as candump writes them, and what is wrong with it.
pub(crate) fn as_log(format: Format, bytes: impl AsRef<[u8]>) -> (String, Vec<String>) {
    let (records, issues) = read(format, bytes);
    (write(Format::Candump, &records), issues)
}

/// As [`read`], with other options.
pub(crate) fn read_with(options: &ReadOptions, bytes: impl AsRef<[u8]>) -> (Vec<TraceRecord>, Vec<String>) {
    mixed::assert_mixed_is_the_same(options.format.unwrap(), options, bytes.as_ref());
    let source = io::Cursor::new(bytes.as_ref().to_vec());
    let reader = TraceReader::from_source("test", source, options.format.unwrap(), options).unwrap();
    let mut records = Vec::new();
    let mut issues = Vec::new();
    for item in reader {
        match item {
            Ok(record) => records.push(record),
            Err(issue) => issues.push(issue.to_string()),
        }
    }
    (records, issues)
}

/// Writes and reads; nothing may be left out or wrong.
pub(crate) fn round_trip(format: Format, records: &[TraceRecord]) -> Vec<TraceRecord> {
    let options = WriteOptions { format: Some(format), ..WriteOptions::default() };
    let (bytes, left_out) = write_with(&options, records);
    // The output here is not a plain file.
    let untold = [super::dif::ROWS_UNTOLD, super::mf4::COUNTS_UNTOLD];
    let left_out = left_out.iter().find(|(what, _)| !untold.contains(what));
    assert_eq!(left_out, None);
    let (records, issues) = read(format, bytes);
    assert_eq!(issues, Vec::<String>::new());
    records
}
