//! python-can's SQLite: one table with the columns of its CSV, `ts`, `arbitration_id`, `extended`, `remote`, `error`, `dlc`, `data`,
//! and likewise without channel, direction and CAN FD's flags. The table may have any name. Or a bag of ROS 2.
//!
//! The file is loaded into memory, which SQLite reads as well as a file, so that compressed files and pipes can be read, too. Only a larger one is
//! read where it is.

#[cfg(test)]
mod tests;

use std::fs::File;
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
use super::ros::Topics;
use super::ros::database::Bag;
use super::whole::MAX_MEMORY_BYTES;
use cantap_trace::{TraceEvent, TraceRecord};

const COLUMNS: [&str; 7] = ["ts", "arbitration_id", "extended", "remote", "error", "dlc", "data"];

const UNTAKEN_JOURNAL: &str = "the database has a journal beside it (write-ahead log): what is only there and not in the file itself is not read";

/// Of the file's header.
const HEAD_BYTES: u64 = 100;

/// Up to here a database is read into memory, where nothing that another program does to the file changes it.
const IN_MEMORY_BYTES: u64 = if cfg!(test) { 64 << 10 } else { MAX_MEMORY_BYTES };

/// Rows requested from the database at a time.
const ROWS: i64 = 512;

/// Reads a database of either kind.
#[derive(Default)]
pub(crate) struct Decoder {
    state: State,
    errors: ErrorFrames,
    /// What the last rows contained, the last one first.
    found: Vec<Found>,
    /// The topics of a bag that were met, also in the files of it before this one.
    topics: Topics,
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

/// Opens a database: the whole in memory, or in its place if it is too large for that.
fn open(input: &mut Input) -> io::Result<Option<Opened>> {
    /// Where the header says how the file is written and read: 1 with a rollback journal, 2 with a write-ahead log.
    const VERSIONS: std::ops::Range<usize> = 18..20;
    let in_place = input.file().map(File::try_clone).transpose()?;
    let mut file = input.whole()?;
    let len = file.len();
    if len == 0 {
        return Ok(None);
    }
    let head = file.read_at(0, len.min(HEAD_BYTES) as usize)?;
    let is_cut = head_says(&head).is_none_or(|said| said > len);
    let has_journal = head.get(VERSIONS).is_some_and(|versions| versions.contains(&2));
    let database = if let Some(file) = in_place.filter(|_| len > IN_MEMORY_BYTES) {
        open_in_place(&file)?
    } else {
        let mut bytes = file.read_at(0, len as usize)?;
        // In memory there is no journal beside it, and SQLite would not open it.
        bytes.get_mut(VERSIONS).unwrap_or_default().iter_mut().for_each(|version| *version = 1);
        in_memory(bytes).map_err(io::Error::other)?
    };
    // Nothing that a stranger put into the file is executed.
    let safe = database.execute_batch("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON");
    safe.map_err(io::Error::other)?;
    Ok(Some(Opened { database, has_journal, is_cut }))
}

fn in_memory(bytes: Vec<u8>) -> rusqlite::Result<Connection> {
    let len = bytes.len();
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let mut database = Connection::open_in_memory_with_flags(flags)?;
    database.deserialize_read_exact("main", io::Cursor::new(bytes), len, true)?;
    Ok(database)
}

/// A file that is open, by its descriptor: whatever has its name by now. As one that nobody changes, so that nothing is written beside it, and a journal
/// there is not looked at.
#[cfg(unix)]
fn open_in_place(file: &File) -> io::Result<Connection> {
    use std::os::fd::AsRawFd as _;
    let uri = format!("file:/dev/fd/{}?immutable=1", file.as_raw_fd());
    let flags =
        OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    Connection::open_with_flags(uri, flags).map_err(io::Error::other)
}

#[cfg(not(unix))]
fn open_in_place(_file: &File) -> io::Result<Connection> {
    let message =
        "an SQLite database of more than 1 GiB is read on Linux and macOS alone; give the part that you need";
    Err(io::Error::new(io::ErrorKind::OutOfMemory, message))
}

/// The file's length according to its header; 0 if an earlier version left it out, `None` if the header is incomplete.
fn head_says(bytes: &[u8]) -> Option<u64> {
    let head: &[u8; HEAD_BYTES as usize] = bytes.first_chunk()?;
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
        let Some(Opened { database, has_journal, is_cut }) = open(input)? else {
            return Ok(State::Ended);
        };
        if has_journal {
            self.found.push(Found::Note(UNTAKEN_JOURNAL));
        }
        let opened = table(&database).and_then(|table| match table {
            Some(table) => Ok(Some((format!("rowid, {} FROM {table}", COLUMNS.join(", ")), None))),
            None => Ok(Bag::open(&database, &mut self.topics)?.map(|bag| (bag.columns(), Some(bag)))),
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

    fn begin_next_file(&mut self) {
        self.state = State::Closed;
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
