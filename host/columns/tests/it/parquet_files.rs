//! Parquet files and datasets hold what was put into them.
#![cfg(feature = "parquet")]

use std::fs::{self, File};
use std::path::Path;

use arrow_array::cast::AsArray;
use arrow_array::types::TimestampNanosecondType;
use cantap_columns::parquet::{Dataset, Key, ParquetFile, ParquetReader};
use cantap_columns::{FrameColumns, records};
use cantap_trace::{Direction, TraceEvent, TraceRecord};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

const DAY_NS: i64 = 86_400_000_000_000;

fn frame(time_ns: i64, channel: u8) -> TraceRecord {
    let frame = "123#DEADBEEF".parse().unwrap();
    TraceRecord {
        time_ns,
        device_ns: None,
        channel,
        event: TraceEvent::Frame { frame, direction: Direction::Tx, late: false },
    }
}

fn read(path: &Path) -> Vec<TraceRecord> {
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap();
    reader.build().unwrap().flat_map(|batch| records(&batch.unwrap()).unwrap()).collect()
}

#[test]
fn a_file_takes_the_place_of_an_older_one_only_when_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.parquet");
    fs::write(&path, "older").unwrap();
    let mut file = ParquetFile::create(&path, FrameColumns::default()).unwrap();
    let trace: Vec<_> = (0..200_000).map(|number| frame(number * 1_000, 1)).collect();
    for record in &trace {
        file.table.push(record);
        file.flush().unwrap();
    }
    assert_eq!(fs::read(&path).unwrap(), b"older");
    file.finish().unwrap();
    assert_eq!(read(&path), trace);
    drop(ParquetFile::create(&path, FrameColumns::default()).unwrap());
    let names: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names, ["drive.parquet"], "what was not finished leaves nothing behind");
}

#[test]
fn a_dataset_has_a_folder_for_each_day_and_channel() {
    let folder = tempfile::tempdir().unwrap();
    let keys = vec!["vehicle=a/b".parse().unwrap(), Key::Day, Key::Channel];
    let write = || {
        let mut dataset = Dataset::new(folder.path(), "drive", keys.clone(), FrameColumns::default);
        // Seventeen days of two channels are more files than are open at once; each is returned to.
        for turn in 0..2 {
            for day in 0..17 {
                for channel in [1, 2] {
                    let record = frame(day * DAY_NS + turn, channel);
                    dataset.table_of(&record).unwrap().push(&record);
                }
            }
        }
        dataset.finish().unwrap();
    };
    write();
    let first = listing(folder.path());
    assert!(first.contains(&"vehicle=a%2Fb/day=1970-01-17/channel=2/drive.parquet".to_owned()), "{first:?}");
    let path = |day: &str| folder.path().join("vehicle=a%2Fb").join(day).join("channel=1");
    let times = |name: &str| -> Vec<i64> {
        let reader =
            ParquetRecordBatchReaderBuilder::try_new(File::open(path("day=1970-01-02").join(name)).unwrap());
        let batch = reader.unwrap().build().unwrap().next().unwrap().unwrap();
        assert!(batch.column_by_name("channel").is_none(), "the folder says it");
        batch.column_by_name("time").unwrap().as_primitive::<TimestampNanosecondType>().values().to_vec()
    };
    assert_eq!([times("drive.parquet"), times("drive-2.parquet")], [[DAY_NS], [DAY_NS + 1]]);
    write();
    assert_eq!(listing(folder.path()), first, "written again it is the same");
}

fn listing(folder: &Path) -> Vec<String> {
    let mut names = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(inside) = folders.pop() {
        for entry in fs::read_dir(inside).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                names.push(path.strip_prefix(folder).unwrap().display().to_string());
            }
        }
    }
    names.sort_unstable();
    names
}

#[test]
fn folders_are_named_by_words() {
    assert_eq!("day".parse(), Ok(Key::Day));
    assert_eq!("vehicle=Ü 7".parse(), Ok(Key::Fixed("vehicle".into(), "Ü 7".into())));
    for text in ["", "days", "=7", "vehicle=", "a b=c", "../x=y", "id=3", "channel=1"] {
        assert!(text.parse::<Key>().is_err(), "{text}");
    }
}

/// Three groups of a thousand rows, as other programs write them.
fn three_groups(path: &Path) -> (Vec<TraceRecord>, Vec<u8>) {
    let trace: Vec<_> = (0..3000).map(|number| frame(number * 1_000, 1)).collect();
    let mut columns = FrameColumns::default();
    for record in &trace {
        columns.push(record);
    }
    let properties = parquet::file::properties::WriterProperties::builder()
        .set_max_row_group_row_count(Some(1000))
        .set_dictionary_enabled(false)
        .build();
    let file = File::create(path).unwrap();
    let mut writer =
        parquet::arrow::ArrowWriter::try_new(file, FrameColumns::schema(), Some(properties)).unwrap();
    writer.write(&columns.take()).unwrap();
    writer.close().unwrap();
    (trace, fs::read(path).unwrap())
}

#[test]
fn damage_in_a_group_of_rows_costs_that_group_and_says_how_many() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.parquet");
    let (trace, mut bytes) = three_groups(&path);
    let whole: Vec<_> = ParquetReader::open(File::open(&path).unwrap())
        .unwrap()
        .flat_map(|batch| records(&batch.unwrap()).unwrap())
        .collect();
    assert!(whole == trace);
    // The first bytes of a page in the middle group: its header says what it is.
    let metadata = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap();
    let at = metadata.metadata().row_group(1).column(0).byte_range().0 as usize;
    bytes[at..at + 8].fill(0xFF);
    let (mut read, mut lost) = (Vec::new(), Vec::new());
    for batch in ParquetReader::open(std::io::Cursor::new(bytes)).unwrap() {
        match batch {
            Ok(batch) => read.extend(records(&batch).unwrap()),
            Err(error) => lost.push((error.from, error.rows)),
        }
    }
    assert_eq!(lost, [(1000, 1000)]);
    assert!(read == [&trace[..1000], &trace[2000..]].concat(), "{}", read.len());
}
