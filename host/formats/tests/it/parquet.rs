//! Tables in Parquet: ours give back what was written, those of others what their columns say, and damage costs as little as it can.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use arrow_array::{
    ArrayRef, BinaryArray, BooleanArray, Float64Array, Int64Array, RecordBatch, StringArray,
    TimestampMicrosecondArray,
};
use arrow_schema::SchemaRef;
use cantap_columns::parquet::{ParquetFile, Table};
use cantap_columns::{FrameColumns, SignalColumns};
use cantap_formats::{Columns, Format, ReadOptions, open_reader};
use cantap_signals::{Decoder, Source, dbc};
use cantap_trace::TraceRecord;
use cantap_trace::testing::record_lin_or_can;
use proptest::prelude::*;

use crate::traces::{directory, read, split};

fn write_records(path: &Path, records: &[TraceRecord]) {
    let mut file = ParquetFile::create(path, FrameColumns::default()).unwrap();
    for record in records {
        file.table.push(record);
        file.flush().unwrap();
    }
    file.finish().unwrap();
}

/// A table of any columns.
struct Any(Option<RecordBatch>, SchemaRef);

impl Table for Any {
    fn columns(&self) -> SchemaRef {
        Arc::clone(&self.1)
    }

    fn waiting(&self) -> usize {
        self.0.as_ref().map_or(0, RecordBatch::num_rows)
    }

    fn batch(&mut self) -> RecordBatch {
        self.0.take().unwrap()
    }
}

fn write_table<const N: usize>(path: &Path, columns: [(&str, ArrayRef); N]) {
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let schema = batch.schema();
    ParquetFile::create(path, Any(Some(batch), schema)).unwrap().finish().unwrap();
}

fn lines(records: &[TraceRecord]) -> Vec<String> {
    let line = |record: &TraceRecord| {
        format!(
            "{} {} {}",
            record.time_ns,
            record.channel,
            record.frame().map_or_else(String::new, ToString::to_string)
        )
    };
    records.iter().map(line).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn what_was_written_is_what_is_read(wanted in prop::collection::vec(record_lin_or_can(1), 0..400)) {
        let path = directory("parquet_round_trip").join("a.parquet");
        write_records(&path, &wanted);
        let mut reader = open_reader(&path, &ReadOptions::default()).unwrap();
        prop_assert_eq!(reader.format(), Format::Parquet);
        let (found, issues) = split(&mut reader);
        prop_assert_eq!(issues, Vec::<String>::new());
        prop_assert_eq!(found, wanted);
        prop_assert!(reader.left_out().is_empty() && reader.notes().is_empty());
    }
}

/// More rows than a batch and than a group have.
#[test]
fn a_long_file_comes_back_whole_and_its_content_shows_its_format() {
    let path = directory("parquet_long").join("a.bin");
    let record = |at: i64| TraceRecord {
        time_ns: at * 1000,
        device_ns: None,
        channel: (at % 3) as u8,
        event: cantap_trace::TraceEvent::Frame {
            frame: format!("{:03X}#{at:08X}", at % 2048).parse().unwrap(),
            direction: cantap_trace::Direction::Rx,
            late: false,
        },
    };
    let wanted: Vec<_> = (0..600_000).map(record).collect();
    write_records(&path, &wanted);
    let (found, issues) = read(&path);
    assert!(found == wanted && issues.is_empty(), "{} {issues:?}", found.len());
}

#[test]
fn tables_of_others_are_known_by_the_names_of_their_columns() {
    let path = directory("parquet_of_others").join("a.parquet");
    let ids: ArrayRef = Arc::new(Int64Array::from(vec![0x123, 0x18DA_F110, 0x7FF]));
    let texts: ArrayRef = Arc::new(StringArray::from(vec!["11 22", "", "0102030405060708"]));
    let wanted = [
        "1700000000000001000 1 123#1122",
        "1700000000000002000 1 18DAF110#",
        "1700000000000003000 2 7FF#0102030405060708",
    ];

    let times: ArrayRef = Arc::new(TimestampMicrosecondArray::from(vec![
        1_700_000_000_000_001,
        1_700_000_000_000_002,
        1_700_000_000_000_003,
    ]));
    let labels: ArrayRef = Arc::new(StringArray::from(vec!["a,b", "\t", "\""]));
    let bus: ArrayRef = Arc::new(Int64Array::from(vec![0, 0, 1]));
    write_table(
        &path,
        [("label", labels), ("Timestamp", times), ("CAN ID", ids.clone()), ("Bus", bus), ("Data", texts)],
    );
    let mut reader = open_reader(&path, &ReadOptions::default()).unwrap();
    let (found, issues) = split(&mut reader);
    assert_eq!((lines(&found), issues), (wanted.map(str::to_owned).to_vec(), vec![]));
    assert!(reader.notes().iter().any(|(note, _)| note.contains("no place in a trace")));

    // A column for each byte, empty behind a frame's length, as pandas has it; times in floating-point seconds.
    let times: ArrayRef = Arc::new(Float64Array::from(vec![1.5, 2.25]));
    let byte = |bytes: [Option<f64>; 2]| Arc::new(Float64Array::from(bytes.to_vec())) as ArrayRef;
    let ids: ArrayRef = Arc::new(StringArray::from(vec!["1A0", "7DF"]));
    let rtr: ArrayRef = Arc::new(BooleanArray::from(vec![false, true]));
    let [one, two] = [byte([Some(17.0), None]), byte([Some(255.0), None])];
    write_table(&path, [("time", times), ("id", ids), ("D0", one), ("D1", two), ("RTR", rtr)]);
    let (found, issues) = read(&path);
    assert_eq!(
        (lines(&found), issues),
        (vec!["1500000000 1 1A0#11FF".to_owned(), "2250000000 1 7DF#R".to_owned()], vec![])
    );
}

#[test]
fn columns_that_are_not_known_are_asked_for_and_taken() {
    let path = directory("parquet_columns").join("a.parquet");
    let times: ArrayRef = Arc::new(Int64Array::from(vec![1000, 2000, 3000]));
    let who: ArrayRef = Arc::new(StringArray::from(vec!["291", "292", "5000"]));
    let what: ArrayRef = Arc::new(BinaryArray::from(vec![&[1_u8, 2][..], &[], &[0; 11]]));
    write_table(&path, [("when", times), ("who", who), ("what", what)]);
    let (found, issues) = read(&path);
    assert!(found.is_empty());
    assert_eq!(issues.len(), 1, "{issues:?}");
    assert!(issues[0].contains("--columns") && issues[0].contains("when, who, what"), "{issues:?}");
    let columns: Columns = "time=when:us,id=who:dec,data=what".parse().unwrap();
    let options = ReadOptions { columns: Some(columns), ..ReadOptions::default() };
    let (found, issues) = split(open_reader(&path, &options).unwrap());
    assert_eq!(lines(&found), ["1000000 1 123#0102", "2000000 1 124#"], "{issues:?}");
    // Eleven bytes are no frame: the row is named.
    assert!(issues.len() == 1 && issues[0].contains("row 3"), "{issues:?}");
}

/// One bad row costs itself alone.
#[test]
fn a_row_that_is_no_record_is_named_and_the_others_are_read() {
    let path = directory("parquet_bad_rows").join("a.parquet");
    let times: ArrayRef = Arc::new(Float64Array::from((0..1000).map(f64::from).collect::<Vec<_>>()));
    let id = |at: i64| if at % 100 == 7 { 0x2000_0000 + at } else { at };
    let ids: ArrayRef = Arc::new(Int64Array::from((0..1000).map(id).collect::<Vec<_>>()));
    let data: ArrayRef = Arc::new((0..1000).map(|at| (at != 500).then_some("00")).collect::<StringArray>());
    write_table(&path, [("time", times), ("id", ids), ("data", data)]);
    let (found, issues) = read(&path);
    assert_eq!((found.len(), issues.len()), (989, 11), "{issues:?}");
    assert!(issues[0].contains("row 8:") && issues[0].contains("29 bits"), "{}", issues[0]);
    assert!(issues[5].contains("row 501:") && issues[5].contains("no data"), "{}", issues[5]);
    let strict = ReadOptions { strict: true, ..ReadOptions::default() };
    let (found, issues) = split(open_reader(&path, &strict).unwrap());
    assert_eq!((found.len(), issues.len()), (7, 1));
}

#[test]
fn decoded_values_are_counted_and_not_taken_for_frames() {
    let path = directory("parquet_values").join("a.parquet");
    let text = "BO_ 291 M: 1 A\n SG_ S : 0|8@1+ (1,0) [0|0] \"\" A\n";
    let decoder =
        Decoder::new(vec![Source { channel: None, database: dbc::parse("a.dbc", text.as_bytes()).unwrap() }]);
    let mut file = ParquetFile::create(&path, SignalColumns::new(&decoder)).unwrap();
    let mut values = Vec::new();
    let frame = TraceRecord {
        time_ns: 1,
        device_ns: None,
        channel: 1,
        event: cantap_trace::TraceEvent::Frame {
            frame: "123#11".parse().unwrap(),
            direction: cantap_trace::Direction::Rx,
            late: false,
        },
    };
    let reference = decoder.decode(1, frame.frame().unwrap(), &mut values).unwrap();
    let lost = cantap_trace::TraceEvent::Lost { stage: None, count: 3, at_least: false };
    file.table.push_values(&decoder, &frame, reference, &values);
    file.table.push_event(&TraceRecord { event: lost, ..frame });
    file.table.push_values(&decoder, &frame, reference, &values);
    file.finish().unwrap();
    let mut reader = open_reader(&path, &ReadOptions::default()).unwrap();
    let (found, issues) = split(&mut reader);
    assert_eq!((found.len(), found[0].event, issues), (1, lost, vec![]));
    assert_eq!(
        reader.left_out().iter().collect::<Vec<_>>(),
        [("decoded values, whose frames are not in the table", 2)]
    );
}

#[test]
fn a_file_without_its_end_says_that_nothing_of_it_can_be_read() {
    let path = directory("parquet_cut").join("a.parquet");
    let wanted: Vec<_> = (0..200).map(sample).collect();
    write_records(&path, &wanted);
    let whole = fs::read(&path).unwrap();
    for len in [4, 5, 12, whole.len() / 2, whole.len() - 1] {
        fs::write(&path, &whole[..len]).unwrap();
        let mut reader = open_reader(&path, &ReadOptions::default()).unwrap();
        let (found, issues) = split(&mut reader);
        assert!(found.is_empty() && issues.len() == 1, "{len}: {issues:?}");
        assert!(issues[0].contains("directory at the end"), "{issues:?}");
        assert!(reader.nothing_read().is_some());
    }
}

fn sample(at: i64) -> TraceRecord {
    let frame = format!("{:03X}#{at:04X}", at % 2048).parse().unwrap();
    let event =
        cantap_trace::TraceEvent::Frame { frame, direction: cantap_trace::Direction::Tx, late: false };
    TraceRecord { time_ns: at, device_ns: None, channel: 2, event }
}

/// The crate that reads Parquet is written for files of friends.
#[test]
fn no_changed_byte_is_a_panic_or_takes_all_memory() {
    let path = directory("parquet_changed").join("a.parquet");
    let wanted: Vec<_> = (0..200).map(sample).collect();
    write_records(&path, &wanted);
    let whole = fs::read(&path).unwrap();
    for at in 4..whole.len() {
        for change in [0x01, 0x80, 0xFF] {
            let mut bytes = whole.clone();
            bytes[at] ^= change;
            let reader = cantap_formats::open_source(
                "a.parquet",
                std::io::Cursor::new(bytes),
                &ReadOptions::default(),
            );
            let (found, _) = split(reader.unwrap());
            assert!(found.len() <= 1000, "{at} {change}: {}", found.len());
        }
    }
}
