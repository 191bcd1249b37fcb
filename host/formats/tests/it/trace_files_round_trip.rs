//! Every format returns what was written, plain and compressed, and reports what it could not carry.

use crate::traces;

use cantap_formats::{
    CsvDialect, DifConvention, Format, LeftOut, LineEnd, TableStyle, TrcVersion, WriteOptions, create_writer,
};
use cantap_trace::testing;
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use proptest::prelude::*;
use traces::{directory, file_name, read, real, write};

/// The resolution of a format's times.
fn resolution_ns(format: Format) -> i64 {
    match format {
        Format::Trc(TrcVersion::V1_0) => 1_000_000,
        Format::Trc(TrcVersion::V1_1) => 100_000,
        Format::Candump | Format::Asc | Format::Trc(_) => 1000,
        Format::Blf | Format::Csv(_) | Format::Pcapng | Format::Dif | Format::Mf4 => 1,
        new => panic!("{new} has no resolution here yet"),
    }
}

/// Whether records or parts of them are missing from a file, rather than just the number of its rows.
fn lacks_records(left_out: &LeftOut) -> bool {
    left_out.iter().any(|(what, _)| {
        !what.starts_with("the number of rows") && !what.starts_with("the numbers of records")
    })
}

#[test]
fn a_number_of_rows_that_cannot_be_written_afterwards_is_named() {
    let directory = directory("totals");
    for (name, named) in
        [("a.dif", 0), ("a.dif.gz", 1), ("a.blf", 0), ("a.blf.zst", 0), ("a.mf4", 0), ("a.mf4.xz", 1)]
    {
        let path = directory.join(name);
        let left_out = write(&path, Format::of_path(&path).unwrap(), &real(10));
        let counts = left_out.iter().filter(|(what, _)| what.starts_with("the number")).count();
        assert_eq!(counts, named, "{name}: {left_out:?}");
    }
}

#[test]
fn real_traffic_survives_every_format_plain_and_compressed() {
    let directory = directory("real_traffic");
    let written = real(usize::MAX);
    assert_eq!(written.len(), 10_495, "frames in the real file");
    for format in Format::written() {
        for compression in ["", ".gz", ".zst", ".xz", ".lz4"] {
            let path = directory.join(file_name(format, compression));
            let left_out = write(&path, format, &written);
            let (records, issues) = read(&path);
            assert_eq!(issues, Vec::<String>::new(), "{}", path.display());
            assert_eq!(records.len(), written.len(), "{}", path.display());
            for (record, original) in records.iter().zip(&written) {
                let off_ns = original.time_ns - record.time_ns;
                assert!(off_ns.abs() < resolution_ns(format), "{}: {off_ns} ns", path.display());
                let expected = TraceRecord { time_ns: record.time_ns, ..*original };
                assert_eq!(*record, expected, "{}", path.display());
            }
            assert_eq!(!lacks_records(&left_out), records == written, "{}: {left_out:?}", path.display());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// The user learns of everything that a file does not carry.
    #[test]
    fn nothing_is_lost_without_being_counted(
        records in prop::collection::vec(testing::record(1000), 0..16),
        compression in prop::sample::select(vec!["", ".gz", ".zst"]),
    ) {
        let directory = tempfile::tempdir().unwrap();
        for format in Format::written() {
            let path = directory.path().join(file_name(format, compression));
            let left_out = write(&path, format, &records);
            let (read, issues) = read(&path);
            prop_assert_eq!(issues, Vec::<String>::new(), "{}", format);
            prop_assert_eq!(!lacks_records(&left_out), read == records, "{}: {:?}\n{:?}\n{:?}", format, left_out, read, records);
        }
    }

    /// Whatever a format could read can be written again in the same format without loss.
    #[test]
    fn a_second_trip_through_the_same_format_changes_nothing(
        records in prop::collection::vec(testing::record(1), 0..16),
    ) {
        let directory = tempfile::tempdir().unwrap();
        for format in Format::written() {
            let path = directory.path().join(file_name(format, ""));
            write(&path, format, &records);
            let (once, _) = read(&path);
            write(&path, format, &once);
            prop_assert_eq!(read(&path).0, once, "{}", format);
        }
    }
}

/// The formats that carry everything carry times that others cannot.
#[test]
fn nanoseconds_and_late_marks_survive_in_our_own_table_and_in_pcapng() {
    let directory = directory("own_table");
    let event =
        TraceEvent::Frame { frame: "123#DEADBEEF".parse().unwrap(), direction: Direction::Tx, late: true };
    let records = [-1, 0, i64::from(u32::MAX) * 1_000_000_001].map(|time_ns| TraceRecord {
        time_ns,
        device_ns: None,
        channel: 255,
        event,
    });
    let carrying = [Format::Csv(CsvDialect::Full), Format::Pcapng];
    for format in carrying {
        let path = directory.join(file_name(format, ""));
        assert!(write(&path, format, &records).is_empty(), "{format}");
        assert_eq!(read(&path), (records.to_vec(), Vec::new()), "{format}");
    }
    // The others report what they leave out.
    for format in Format::written().filter(|format| !carrying.contains(format)) {
        let left_out = write(&directory.join(file_name(format, "")), format, &records);
        let late: Vec<_> = left_out.iter().filter(|(what, _)| what.contains("upper bounds")).collect();
        assert!(matches!(late[..], [(_, 3)]), "{format}: {left_out:?}");
    }
}

/// What Vector's programs write before a frame is sent is counted and named, but is not a frame.
#[test]
fn requests_to_send_are_passed_over_and_counted() {
    let path = directory("requests").join("requests.asc");
    let rows = "1.0 1 123 TxRq d 1 11\n1.001 1 123 Tx d 1 11\n1.5 1 123 TxRq d 1 22\n1.501 1 123 Tx d 1 22\n";
    std::fs::write(
        &path,
        format!("date Sat Sep 30 15:06:13.191 2017\nbase hex  timestamps absolute\n{rows}"),
    )
    .unwrap();
    let mut reader = cantap_formats::open_reader(&path, &cantap_formats::ReadOptions::default()).unwrap();
    assert_eq!(reader.by_ref().map(Result::unwrap).count(), 2);
    let notes: Vec<_> =
        reader.notes().iter().map(|(what, count)| (what.contains("requests to send"), count)).collect();
    assert_eq!(notes, [(true, 2)]);
}

/// Reading detects for which spreadsheet a table was written.
#[test]
fn the_earlier_analysers_tables_read_back_in_every_style() {
    let directory = directory("table_styles");
    let records = real(300);
    for (separator, decimal_mark) in [(b';', b','), (b',', b'.'), (b'\t', b','), (b';', b'.')] {
        for line_end in [LineEnd::CrLf, LineEnd::Lf] {
            for dif in [DifConvention::Columns, DifConvention::Rows] {
                let table = TableStyle { separator, decimal_mark, line_end, dif };
                for format in [Format::Csv(CsvDialect::Analyser), Format::Dif] {
                    let path = directory.join(file_name(format, ""));
                    let options = WriteOptions { format: Some(format), table, ..WriteOptions::default() };
                    let mut writer = create_writer(&path, &options).unwrap();
                    for record in &records {
                        writer.write(record).unwrap();
                    }
                    assert!(writer.finish().unwrap().is_empty());
                    let (read, issues) = read(&path);
                    assert_eq!(issues, Vec::<String>::new(), "{format} {table:?}");
                    assert!(read == records, "{format} {table:?}: {} of {}", read.len(), records.len());
                }
            }
        }
    }
}
