//! What the tests of trace files have in common: records to write, and writing and reading files the way a
//! program that uses the library does.

#![allow(dead_code, reason = "each test file uses some of them")]

pub mod mixed;

use std::path::{Path, PathBuf};

use cantap_formats::{ChannelInfo, Format, LeftOut, ReadOptions, WriteOptions, create_writer, open_reader};
use cantap_trace::{TraceEvent, TraceRecord};

/// A boat's bus (gpsd's test data): one channel, extended identifiers, microseconds.
pub const REAL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/nmea2000.log.gz");

/// Everything but ordinary frames, on two channels, sent and received: short and long length codes, remote
/// frames, errors, states and losses.
pub const ODD: &str = "(1410714882.000000) can0 000#\n\
    (1410714882.000100) can1 7FF#01 T\n\
    (1410714882.000200) can0 00000000#0102\n\
    (1410714882.000300) can1 1FFFFFFF#FF00FF00FF00FF00 T\n\
    (1410714882.000400) can0 123#R\n\
    (1410714882.000500) can0 00000123#R8\n\
    (1410714882.000600) can1 20000088#0000040000000000\n\
    (1410714883.500000) can0 123#1122334455667788\n\
    (1410714884.000000) can0 20000004#0010000000000000\n\
    (1410714884.000001) can0 20000040#0000000000000000\n\
    (1410714884.100000) can1 321#AA\n";

/// A file name for a format, by which reading detects it.
pub fn file_name(format: Format, compression: &str) -> String {
    let suffix = match format {
        Format::Candump | Format::Busmaster => "log",
        Format::Asc => "asc",
        Format::Blf => "blf",
        Format::Trc(_) | Format::CanHacker | Format::Carbus => "trc",
        Format::Csv(_) | Format::CanEdgeCsv | Format::UsbCan | Format::Saleae => "csv",
        Format::Pcapng => "pcapng",
        Format::Dif => "dif",
        Format::Mf4 => "mf4",
        Format::Pcap => "pcap",
        Format::CandumpScreen
        | Format::Kvaser
        | Format::Printer
        | Format::CanKing
        | Format::BatteryEmulator
        | Format::Nmea2000
        | Format::Labelled
        | Format::Slcan
        | Format::RosEcho
        | Format::Table
        | Format::EspHome
        | Format::Sigrok
        | Format::TraceWindow => "txt",
        Format::Sqlite => "db",
        Format::Parquet => "parquet",
        Format::Json => "jsonl",
        Format::Rlog => "rlog",
        Format::Mcap => "mcap",
        Format::RosBag => "bag",
        Format::CanServer => "cslog",
        Format::Actisense => "ebl",
        Format::Crtd => "crtd",
        Format::Microchip => "can",
        new => panic!("{new} has no suffix here yet"),
    };
    format!("{format}.{suffix}{compression}")
}

/// Writes a file and returns what it could not carry. Bit rates are in it, which other programs must not mind.
pub fn write(path: &Path, format: Format, records: &[TraceRecord]) -> LeftOut {
    let mut writer = create_writer(path, &options(format)).unwrap();
    for record in records {
        writer.write(record).unwrap();
    }
    writer.finish().unwrap()
}

/// For files that say the bit rates, where they have a place for them.
pub fn options(format: Format) -> WriteOptions {
    let rate = |(channel, bps)| ChannelInfo { channel, bitrate_bps: Some(bps), description: String::new() };
    // In pcapng each of them would be an interface, whatever comes.
    let rates: &[_] = if format == Format::Pcapng { &[] } else { &[(1, 500_000), (2, 83_333)] };
    let channels = rates.iter().copied().map(rate).collect();
    WriteOptions { format: Some(format), channels, ..WriteOptions::default() }
}

/// A file's records and the messages about it.
pub fn read(path: impl AsRef<Path>) -> (Vec<TraceRecord>, Vec<String>) {
    split(open_reader(path, &ReadOptions::default()).unwrap())
}

/// Separates records from messages.
pub fn split(
    items: impl Iterator<Item = Result<TraceRecord, cantap_formats::ReadIssue>>,
) -> (Vec<TraceRecord>, Vec<String>) {
    let (mut records, mut issues) = (Vec::new(), Vec::new());
    for item in items {
        match item {
            Ok(record) => records.push(record),
            Err(issue) => issues.push(issue.to_string()),
        }
    }
    (records, issues)
}

/// The first records of the real file.
pub fn real(count: usize) -> Vec<TraceRecord> {
    open_reader(REAL, &ReadOptions::default()).unwrap().take(count).map(Result::unwrap).collect()
}

/// The unusual records.
pub fn odd(directory: &Path) -> Vec<TraceRecord> {
    let path = directory.join("odd.log");
    std::fs::write(&path, ODD).unwrap();
    let (records, issues) = read(&path);
    assert_eq!(issues, Vec::<String>::new());
    records
}

/// A separate directory for each test.
pub fn directory(test: &str) -> PathBuf {
    let directory = Path::new(env!("CARGO_TARGET_TMPDIR")).join(test);
    std::fs::create_dir_all(&directory).unwrap();
    directory
}

/// Only the frames.
pub fn frames(records: &[TraceRecord]) -> Vec<TraceRecord> {
    records.iter().filter(|record| matches!(record.event, TraceEvent::Frame { .. })).copied().collect()
}
