//! python-can's SQLite: one table with the columns of its CSV, `ts`, `arbitration_id`, `extended`, `remote`, `error`, `dlc`, `data`,
//! and likewise without channel, direction and CAN FD's flags. The table may have any name. Or a bag of ROS 2.
//!
//! The file is loaded into memory, which SQLite reads as well as a file, so that compressed files and pipes can be read, too.

use std::io;

use cantap_trace::counted;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags, Row};

use super::codec::Decode;
use super::csv::{Message, python_time_ns};
use super::error_frames::ErrorFrames;
use super::found::Found;
use super::input::Input;
use super::issue::{Fault, Place};
use super::ros::database::{self, Bag};
use super::whole::{MAX_MEMORY_BYTES, Whole};
use cantap_trace::{TraceEvent, TraceRecord};

const COLUMNS: [&str; 7] = ["ts", "arbitration_id", "extended", "remote", "error", "dlc", "data"];

const UNTAKEN_JOURNAL: &str = "the database has a journal beside it (write-ahead log): what is only there and not in the file itself is not read";

/// Rows requested from the database at a time.
const ROWS: i64 = 512;

/// Reads a database of either kind.
#[derive(Default)]
pub(crate) struct Decoder {
    state: State,
    errors: ErrorFrames,
    /// What the last rows contained, the last one first.
    found: Vec<Found>,
}

#[derive(Default)]
enum State {
    #[default]
    Closed,
    Open {
        database: Connection,
        query: String,
        /// The topics, if it is a bag of ROS 2 and no table of python-can's.
        bag: Option<Bag>,
        /// The last row that was read.
        row: i64,
        is_cut: bool,
    },
    Ended,
}

/// What is known of a database before it is queried.
struct Opened {
    database: Connection,
    /// There is a journal beside it.
    has_journal: bool,
    /// The file is shorter than its header says.
    is_cut: bool,
}

/// The whole database in memory.
fn open(mut file: Whole) -> io::Result<Opened> {
    /// Where the header says how the file is written and read: 1 with a rollback journal, 2 with a write-ahead log.
    const VERSIONS: std::ops::Range<usize> = 18..20;
    if file.len() > MAX_MEMORY_BYTES {
        let message = "an SQLite database of more than 1 GiB is not read; give the part that you need";
        return Err(io::Error::new(io::ErrorKind::OutOfMemory, message));
    }
    let mut bytes = file.read_at(0, file.len() as usize)?;
    let is_cut = head_says(&bytes).is_none_or(|len| len > file.len());
    let mut has_journal = false;
    for version in bytes.get_mut(VERSIONS).unwrap_or_default() {
        // In memory there is no journal beside it, and SQLite would not open it.
        has_journal |= *version == 2;
        *version = 1;
    }
    let len = bytes.len();
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let database = Connection::open_in_memory_with_flags(flags).and_then(|mut database| {
        database.deserialize_read_exact("main", io::Cursor::new(bytes), len, true)?;
        // Nothing that a stranger put into the file is executed.
        database.execute_batch("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON")?;
        Ok(database)
    });
    Ok(Opened { database: database.map_err(io::Error::other)?, has_journal, is_cut })
}

/// The file's length according to its header; 0 if an earlier version left it out, `None` if the header is incomplete.
fn head_says(bytes: &[u8]) -> Option<u64> {
    let head: &[u8; 100] = bytes.first_chunk()?;
    let word = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let page = match u16::from_be_bytes([head[16], head[17]]) {
        1 => 65_536,
        bytes => u64::from(bytes),
    };
    // The number of pages is valid if it was written by the last change.
    Some(if word(24) == word(92) { page * u64::from(word(28)) } else { 0 })
}

/// The first table with the columns, in double quotes.
fn table(database: &Connection) -> rusqlite::Result<Option<String>> {
    let mut tables =
        database.prepare("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY rowid")?;
    let names = tables.query_map([], |row| row.get::<_, String>(0))?;
    for name in names {
        let quoted = format!("\"{}\"", name?.replace('"', "\"\""));
        let mut columns = database.prepare(&format!("PRAGMA table_info({quoted})"))?;
        let columns: Vec<String> =
            columns.query_map([], |row| row.get::<_, String>(1))?.collect::<Result<_, _>>()?;
        if COLUMNS.iter().all(|wanted| columns.iter().any(|column| column.eq_ignore_ascii_case(wanted))) {
            return Ok(Some(quoted));
        }
    }
    Ok(None)
}

const CUT: Fault = Fault::Truncated("the database");

fn of_database(error: &rusqlite::Error) -> Fault {
    Fault::malformed("an SQLite database that is whole", error.to_string().as_bytes())
}

impl Decoder {
    /// The state in which reading begins, and what to report about it.
    fn open(&mut self, input: &mut Input) -> io::Result<State> {
        let file = input.whole()?;
        if file.len() == 0 {
            return Ok(State::Ended);
        }
        let Opened { database, has_journal, is_cut } = open(file)?;
        if has_journal {
            self.found.push(Found::Note(UNTAKEN_JOURNAL));
        }
        let opened = table(&database).and_then(|table| match table {
            Some(table) => Ok(Some((format!("rowid, {} FROM {table}", COLUMNS.join(", ")), None))),
            None => Ok(Bag::open(&database)?.map(|bag| (database::COLUMNS.to_owned(), Some(bag)))),
        });
        let fault = match opened {
            Ok(Some((columns, bag))) => {
                let query = format!("SELECT {columns} WHERE rowid > ? ORDER BY rowid LIMIT {ROWS}");
                return Ok(State::Open { database, query, bag, row: i64::MIN, is_cut });
            }
            Ok(None) => {
                let columns = COLUMNS.join(", ");
                let expected = format!("a table with the columns {columns}, or the topics of a bag of ROS 2");
                Fault::malformed(expected, b"no such table")
            }
            Err(_) if is_cut => CUT,
            Err(error) => of_database(&error),
        };
        self.found.push(Found::Issue(Place::Offset(0), fault));
        Ok(State::Ended)
    }

    /// Reads the next rows into `found`; false at the end.
    fn rows(&mut self) -> bool {
        let State::Open { database, query, bag, row: last, is_cut } = &mut self.state else { return false };
        let before = self.found.len();
        let (errors, found) = (&mut self.errors, &mut self.found);
        let result = database.prepare(query).and_then(|mut statement| {
            let mut rows = statement.query([*last])?;
            while let Some(row) = rows.next()? {
                let number = row.get(0)?;
                // In a damaged file, pages can be linked in a circle.
                if number <= *last {
                    return Ok(false);
                }
                *last = number;
                if let Some(bag) = bag {
                    if let Err(fault) = bag.message(row, errors, found) {
                        found.push(Found::Issue(Place::Row(number), fault));
                    }
                    continue;
                }
                match record(row, errors) {
                    Ok((record, second)) => {
                        found.push(Found::Record(record));
                        found.extend(second.map(|event| Found::Record(TraceRecord { event, ..record })));
                        found.extend(std::iter::from_fn(|| errors.note()).map(Found::Note));
                    }
                    Err(fault) => found.push(Found::Issue(Place::Row(*last), fault)),
                }
            }
            Ok(true)
        });
        let fault = match result {
            Ok(true) if !*is_cut || found.len() > before => None,
            _ if *is_cut => Some(CUT),
            Err(error) => Some(of_database(&error)),
            Ok(_) => Some(Fault::malformed("rows in their order", b"one of before")),
        };
        if let Some(fault) = fault {
            found.push(Found::Issue(Place::Row(last.saturating_add(1)), fault));
            self.state = State::Ended;
        }
        self.found[before..].reverse();
        self.found.len() > before
    }
}

impl Decode for Decoder {
    fn needs_one_line(&self) -> bool {
        false
    }

    fn next(&mut self, input: &mut Input) -> io::Result<Found> {
        if matches!(self.state, State::Closed) {
            self.state = self.open(input)?;
        }
        if self.found.is_empty() && !self.rows() {
            self.state = State::Ended;
        }
        Ok(self.found.pop().unwrap_or(Found::End))
    }
}

/// The content of a row. SQLite allows any type in any column.
fn record(row: &Row<'_>, errors: &mut ErrorFrames) -> Result<(TraceRecord, Option<TraceEvent>), Fault> {
    let value = |column: usize| row.get_ref(column).map_err(|error| of_database(&error));
    let whole = |column: usize| match value(column)? {
        ValueRef::Integer(number) => Ok(number),
        other => Err(wrong_type(column, "a whole number", other)),
    };
    let flag = |column: usize| match whole(column)? {
        0 => Ok(false),
        1 => Ok(true),
        other => Err(wrong_type(column, "0 or 1", ValueRef::Integer(other))),
    };
    let time = match value(1)? {
        // The shortest digits for this number: those that were written.
        ValueRef::Real(seconds) => python_time_ns(format!("{seconds}").as_bytes()),
        ValueRef::Integer(seconds) => seconds.checked_mul(super::text::NS_PER_S),
        _ => None,
    };
    let time_ns =
        time.ok_or_else(|| wrong_type(1, "a time in seconds", value(1).unwrap_or(ValueRef::Null)))?;
    let id = whole(2)?;
    let id = u32::try_from(id).map_err(|_| wrong_type(2, "an identifier", ValueRef::Integer(id)))?;
    let [extended, remote, error] = [flag(3)?, flag(4)?, flag(5)?];
    let len = whole(6)?;
    let len = u64::try_from(len).map_err(|_| wrong_type(6, "a length", ValueRef::Integer(len)))?;
    let data = match value(7)? {
        ValueRef::Blob(data) => data,
        ValueRef::Null => &[],
        other => return Err(wrong_type(7, "bytes", other)),
    };
    let (event, second) = Message { id, extended, remote, error, len }.event(data, errors)?;
    Ok((TraceRecord { time_ns, device_ns: None, channel: 1, event }, second))
}

fn wrong_type(column: usize, expected: &str, found: ValueRef<'_>) -> Fault {
    let found = match found {
        ValueRef::Null => "nothing".to_owned(),
        ValueRef::Integer(number) => number.to_string(),
        ValueRef::Real(number) => number.to_string(),
        ValueRef::Text(text) => String::from_utf8_lossy(text).into_owned(),
        ValueRef::Blob(bytes) => counted(bytes.len(), "byte"),
    };
    Fault::malformed(format!("{expected} under {}", COLUMNS[column - 1]), found.as_bytes())
}

#[cfg(test)]
mod tests {
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
}
