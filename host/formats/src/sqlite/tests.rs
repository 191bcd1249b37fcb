//! Databases as python-can, rosbag2 and damage make them.

use super::super::tests;
use crate::{Format, ReadOptions, TraceReader};

/// A database in a file, made by these statements.
fn database(commands: &str) -> Vec<u8> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.db");
    let database = rusqlite::Connection::open(&path).unwrap();
    database.execute_batch(commands).unwrap();
    database.close().unwrap();
    std::fs::read(path).unwrap()
}

const TABLE: &str = "(ts REAL, arbitration_id INTEGER, extended INTEGER, remote INTEGER, error INTEGER, dlc INTEGER, data BLOB)";

#[test]
fn every_kind_of_row_is_read_whatever_the_table_is_called() {
    for name in ["messages", "\"a \"\"b; --\""] {
        let bytes = database(&format!(
            "CREATE TABLE other (x); CREATE TABLE {name} {TABLE};
             INSERT INTO {name} VALUES (1410714882.622188, 0x123, 0, 0, 0, 2, x'1122');
             INSERT INTO {name} VALUES (1410714882.622189, 0x18DAF110, 1, 0, 0, 8, x'0102030405060708');
             INSERT INTO {name} VALUES (1410714883, 0x123, 0, 1, 0, 4, x'');
             INSERT INTO {name} VALUES (1410714884.5, 0x124, 0, 0, 0, 12, x'000102030405060708090A0B');
             INSERT INTO {name} VALUES (1410714885.5, 0x40, 1, 0, 1, 8, x'0000000000000000');"
        ));
        assert_eq!(Format::of_content(&bytes), Some(Format::Sqlite));
        let (records, issues) = tests::read(Format::Sqlite, bytes);
        assert_eq!(issues, Vec::<String>::new());
        assert_eq!(
            tests::write(Format::Candump, &records),
            "(1410714882.622188) can0 123#1122\n(1410714882.622189) can0 18DAF110#0102030405060708\n\
             (1410714883.000000) can0 123#R4\n(1410714884.500000) can0 124##0000102030405060708090A0B\n\
             (1410714885.500000) can0 20000040#0000000000000000\n"
        );
    }
}

#[test]
fn rows_that_are_none_are_named_and_more_rows_than_are_asked_at_once_are_read() {
    let bytes = database(&format!(
        "CREATE TABLE messages {TABLE};
         WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 1999)
         INSERT INTO messages SELECT i, i % 2048, 0, 0, 0, 1, x'11' FROM n;
         UPDATE messages SET ts = 'noon' WHERE rowid = 1; UPDATE messages SET arbitration_id = -1 WHERE rowid = 2;
         UPDATE messages SET extended = 2 WHERE rowid = 3; UPDATE messages SET dlc = 2 WHERE rowid = 4;
         UPDATE messages SET data = 'text' WHERE rowid = 5; UPDATE messages SET arbitration_id = 2048 WHERE rowid = 6;
         UPDATE messages SET dlc = NULL WHERE rowid = 600; DELETE FROM messages WHERE rowid BETWEEN 700 AND 1400;"
    ));
    let (records, issues) = tests::read(Format::Sqlite, bytes);
    assert_eq!(records.len(), 2000 - 7 - 701);
    assert_eq!(
        issues,
        [
            "test, row 1: expected a time in seconds under ts, found 'noon'",
            "test, row 2: expected an identifier under arbitration_id, found '-1'",
            "test, row 3: expected 0 or 1 under extended, found '2'",
            "test, row 4: expected 2 data bytes, found '1'",
            "test, row 5: expected bytes under data, found 'text'",
            "test, row 6: expected an identifier that fits its format, found '800'",
            "test, row 600: expected a whole number under dlc, found 'nothing'",
        ]
    );
}

/// Found by random damage: reading never ended.
#[test]
fn pages_linked_to_a_circle_are_damage_and_have_an_end() {
    const PAGE: usize = 512;
    let mut bytes = database(&format!(
        "PRAGMA page_size = {PAGE}; CREATE TABLE messages {TABLE};
         WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 199)
         INSERT INTO messages SELECT i, 1, 0, 0, 0, 8, x'1122334455667788' FROM n;"
    ));
    let root = &mut bytes[PAGE..2 * PAGE];
    assert_eq!(root[0], 5, "an inner page of a table");
    let cell =
        |root: &[u8], at: usize| usize::from(u16::from_be_bytes([root[12 + 2 * at], root[13 + 2 * at]]));
    let (first, third) = (cell(root, 0), cell(root, 2));
    root.copy_within(first..first + 4, third);
    let (records, issues) = tests::read(Format::Sqlite, bytes);
    assert!(records.len() < 200, "{}", records.len());
    assert!(issues.len() == 1 && issues[0].contains("expected rows in their order"), "{issues:?}");
}

/// As rosbag2 lays it out, with messages as ROS 2 serializes them.
#[test]
fn a_bag_of_ros_2_is_read_by_topics_and_what_is_no_frame_is_counted() {
    let header = |seconds: &str| format!("00010000{seconds}0500000004000000{}00", "63616e");
    let frame = |seconds: &str| format!("{}23010000000000021122000000000000", header(seconds));
    let flexible = format!("{}f110da1801000c000c000000{}", header("02cd1554"), "07".repeat(12));
    let schema = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
         INSERT INTO topics VALUES (1, '/can1/from_can_bus', 'can_msgs/msg/Frame', 'cdr'), (2, '/can1/to_can_bus', 'can_msgs/msg/Frame', 'cdr'),
         (3, '/can0/from_can_bus_fd', 'ros2_socketcan_msgs/msg/FdFrame', 'cdr'), (4, '/chatter', 'std_msgs/msg/String', 'cdr');";
    let bytes = database(&format!(
        "{schema} INSERT INTO messages VALUES (1, 1, 1410714890000000001, x'{}'), (2, 2, 1410714890000000002, x'{}'),
         (3, 3, 3, x'{flexible}'), (4, 4, 4, x'00'), (5, 9, 5, x'00'), (6, 1, 6, x'0001'), (7, 1, 'noon', x'00');",
        frame("02cd1554"),
        frame("00000000").replace("0500000004", "0000000004"),
    ));
    let (records, issues) = tests::read(Format::Sqlite, bytes.clone());
    assert_eq!(
        tests::write(Format::Candump, &records),
        "(1410714882.000000) can1 123#1122\n(1410714890.000000) can1 123#1122 T\n\
         (1410714882.000000) can0 18DA10F1##0070707070707070707070707\n"
    );
    assert_eq!(
        issues,
        [
            "test, row 5: expected a message of a topic of the bag, found 'topic 9'",
            "test, row 6: expected a message with a CAN frame, found '2 bytes'",
            "test, row 7: expected a message with its topic, its time and its bytes, found 'something else'",
        ]
    );
    let options = ReadOptions::default();
    let source = std::io::Cursor::new(bytes);
    let mut reader = TraceReader::from_source("test", source, Format::Sqlite, &options).unwrap();
    assert_eq!(reader.by_ref().filter_map(Result::ok).count(), 3);
    assert_eq!((reader.notes().total(), reader.left_out().total()), (1, 1));
}

/// As `ros2 bag record --compression-mode message` writes them.
#[cfg(feature = "zstd")]
#[test]
fn messages_that_are_compressed_one_by_one_are_read() {
    let header = [&[0, 1, 0, 0][..], &[2, 0, 0, 0], &[5, 0, 0, 0], &[4, 0, 0, 0], b"can\0"].concat();
    let frame = [&header[..], &[0x23, 1, 0, 0, 0, 0, 0, 2, 0x11, 0x22, 0, 0, 0, 0, 0, 0]].concat();
    let hex = |bytes: &[u8]| bytes.iter().fold(String::new(), |text, byte| format!("{text}{byte:02x}"));
    let packed = zstd::encode_all(&frame[..], 3).unwrap();
    let twice = zstd::encode_all(&packed[..], 3).unwrap();
    let bytes = database(&format!(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
         INSERT INTO topics VALUES (1, '/a', 'can_msgs/msg/Frame', 'cdr');
         INSERT INTO messages VALUES (1, 1, 1, x'{}'), (2, 1, 2, x'{}'), (3, 1, 3, x'{}'), (4, 1, 4, x'{}');",
        hex(&packed),
        hex(&packed[..packed.len() - 3]),
        hex(&twice),
        hex(&frame),
    ));
    let (records, issues) = tests::read(Format::Sqlite, bytes);
    assert_eq!(
        tests::write(Format::Candump, &records),
        "(2.000000) can0 123#1122\n(2.000000) can0 123#1122\n"
    );
    assert_eq!(issues.len(), 2, "{issues:?}");
    assert!(issues.iter().all(|issue| issue.contains("damaged compressed data")), "{issues:?}");
}

/// A database that is too large for memory is read in its place, and so is the rest of a bag of several files.
#[test]
fn a_large_bag_is_read_where_it_is_and_what_is_no_frame_costs_nothing() {
    let frame = |n: u32| {
        format!(
            "00010000{:08x}0500000004000000{}00{}00000001{:02x}00000000000000",
            n.swap_bytes(),
            "63616e",
            "23010000",
            n % 256
        )
    };
    let rows: Vec<String> = (1..=40_u32).map(|n| format!("({}, 1, {n}, x'{}')", 2 * n, frame(n))).collect();
    let bag = |first: &str| {
        database(&format!(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
             INSERT INTO topics VALUES ({first}), (2, '/camera', 'sensor_msgs/msg/Image', 'cdr');
             WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 39)
             INSERT INTO messages SELECT 2 * i + 1, 2, i, zeroblob(4096) FROM n;
             INSERT INTO messages VALUES {};",
            rows.join(", ")
        ))
    };
    let folder = tempfile::tempdir().unwrap();
    for (name, topic) in [("bag_0.db3", "'/a'"), ("bag_1.db3", "'/b'")] {
        let bytes = bag(&format!("1, {topic}, 'can_msgs/msg/Frame', 'cdr'"));
        assert!(bytes.len() as u64 > super::IN_MEMORY_BYTES);
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    let mut reader = crate::open_reader(folder.path(), &ReadOptions::default()).unwrap();
    let records: Vec<_> = reader.by_ref().map(Result::unwrap).collect();
    // Another topic is another channel, also in the next file.
    assert_eq!(records.iter().map(|record| record.channel).collect::<Vec<_>>(), [[1; 40], [2; 40]].concat());
    assert_eq!(reader.left_out().total(), 80);
    // A file that is gone is named, and those behind it are read.
    std::fs::remove_file(folder.path().join("bag_0.db3")).unwrap();
    std::fs::write(folder.path().join("bag_2.db3"), bag("1, '/a', 'can_msgs/msg/Frame', 'cdr'")).unwrap();
    let metadata = "relative_file_paths:\n  - bag_1.db3\n  - bag_0.db3\n  - bag_2.db3\n";
    std::fs::write(folder.path().join("metadata.yaml"), metadata).unwrap();
    let (records, issues): (Vec<_>, Vec<_>) =
        crate::open_reader(folder.path(), &ReadOptions::default()).unwrap().partition(Result::is_ok);
    assert_eq!((records.len(), issues.len()), (80, 1));
    assert!(issues[0].as_ref().unwrap_err().to_string().contains("bag_0.db3"), "{issues:?}");
    let strict = ReadOptions { strict: true, ..ReadOptions::default() };
    assert_eq!(crate::open_reader(folder.path(), &strict).unwrap().flatten().count(), 40);
}

#[test]
fn what_is_no_such_database_is_told() {
    let other = database("CREATE TABLE songs (title)");
    let (_, issues) = tests::read(Format::Sqlite, other);
    assert!(
        issues.len() == 1 && issues[0].contains("a table with the columns ts, arbitration_id"),
        "{issues:?}"
    );
    let whole = database(&format!(
        "CREATE TABLE messages {TABLE};
         WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 999)
         INSERT INTO messages SELECT i, 1, 0, 0, 0, 1, x'11' FROM n;"
    ));
    for keep in [0, 20, 100, 4096, 5000, whole.len() / 2, whole.len() - 1] {
        let (records, issues) = tests::read(Format::Sqlite, &whole[..keep]);
        assert!(records.len() <= 1000 && issues.len() == 1, "{keep}: {} {issues:?}", records.len());
    }
    let mut journal = whole;
    journal[18..20].fill(2);
    let options = ReadOptions::default();
    let source = std::io::Cursor::new(journal);
    let mut reader = TraceReader::from_source("test", source, Format::Sqlite, &options).unwrap();
    assert_eq!(reader.by_ref().filter_map(Result::ok).count(), 1000);
    assert_eq!(reader.notes().iter().collect::<Vec<_>>(), [(super::UNTAKEN_JOURNAL, 1)]);
}
