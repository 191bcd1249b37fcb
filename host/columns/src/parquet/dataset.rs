//! Many files, in folders named after what their rows have in common: `vehicle=7/day=2026-03-01/channel=1/drive.parquet`.
//! Engines read such a folder as one table, and skip the files that are irrelevant to a query.

use std::fmt::{self, Write as _};
use std::fs;
use std::path::PathBuf;
use std::str::FromStr;

use cantap_trace::TraceRecord;
use jiff::Timestamp;
use jiff::tz::TimeZone;
use parquet::errors::ParquetError;
use rustc_hash::FxHashMap;

use super::{ParquetFile, Table};
use crate::{FrameColumns, signals};

/// What names a level of folders.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Key {
    /// A fixed name and value for all rows, such as `vehicle=7`.
    Fixed(String, String),
    /// The day, in UTC: `day=2026-03-01`.
    Day,
    /// The channel, from 1: `channel=1`.
    Channel,
}

/// Whether this name is already, or may be, a column of a dataset's tables or a folder.
fn is_taken(name: &str) -> bool {
    let of_signals = signals::fields();
    name == "day"
        || FrameColumns::schema().field_with_name(name).is_ok()
        || of_signals.iter().any(|field| field.name() == name)
}

/// A text that is not a [`Key`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{0}' is not a partition: write day, channel, or NAME=VALUE with a NAME that no column has")]
pub struct BadKey(String);

impl FromStr for Key {
    type Err = BadKey;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let word =
            |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        match text.split_once('=') {
            None if text == "day" => Ok(Self::Day),
            None if text == "channel" => Ok(Self::Channel),
            Some((name, value)) if word(name) && !value.is_empty() && !is_taken(name) => {
                Ok(Self::Fixed(name.to_owned(), value.to_owned()))
            }
            _ => Err(BadKey(text.to_owned())),
        }
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed(name, value) => write!(f, "{name}={value}"),
            Self::Day => f.write_str("day"),
            Self::Channel => f.write_str("channel"),
        }
    }
}

/// How many files are open at once; if there are more, the one unused for longest is finished, and its later rows go into
/// another file beside it.
const OPEN: usize = 32;

/// Day since 1970 and channel, as far as the keys need them.
type Place = (Option<i32>, Option<u8>);

/// A dataset being written. Columns given by the folders' names are not in the files.
pub struct Dataset<T, F> {
    folder: PathBuf,
    /// The files' name, without suffix.
    name: String,
    keys: Vec<Key>,
    table: F,
    open: FxHashMap<Place, Open<T>>,
    /// The number of files in each folder.
    files: FxHashMap<Place, u32>,
    used: u64,
}

struct Open<T> {
    file: ParquetFile<T>,
    used: u64,
}

impl<T: Table, F: Fn() -> T> Dataset<T, F> {
    /// A dataset in `folder`, which is created if it is missing. Its files are called `name`: writing the same trace again replaces
    /// them. `table` makes an empty table.
    pub fn new(folder: impl Into<PathBuf>, name: impl Into<String>, keys: Vec<Key>, table: F) -> Self {
        let (folder, name) = (folder.into(), name.into());
        let (open, files) = (FxHashMap::default(), FxHashMap::default());
        Self { folder, name, keys, table, open, files, used: 0 }
    }

    /// The table for this record. Rows are written when there are many.
    pub fn table_of(&mut self, record: &TraceRecord) -> Result<&mut T, ParquetError> {
        let day = self.keys.contains(&Key::Day).then(|| day_of(record.time_ns));
        let place = (day, self.keys.contains(&Key::Channel).then_some(record.channel));
        if !self.open.contains_key(&place) {
            if self.open.len() >= OPEN {
                let oldest = self.open.iter().min_by_key(|(_, open)| open.used).map(|(place, _)| *place);
                if let Some(open) = oldest.and_then(|place| self.open.remove(&place)) {
                    open.file.finish()?;
                }
            }
            let file = self.begin(place)?;
            self.open.insert(place, Open { file, used: 0 });
        }
        self.used += 1;
        let open = self.open.get_mut(&place).expect("it was opened above");
        open.used = self.used;
        open.file.flush()?;
        Ok(&mut open.file.table)
    }

    fn begin(&mut self, (day, channel): Place) -> Result<ParquetFile<T>, ParquetError> {
        let mut folder = self.folder.clone();
        for key in &self.keys {
            folder.push(match key {
                Key::Fixed(name, value) => format!("{name}={}", escaped(value)),
                Key::Day => format!("day={}", Date(day.unwrap_or_default())),
                Key::Channel => format!("channel={}", channel.unwrap_or_default()),
            });
        }
        fs::create_dir_all(&folder)?;
        let files = self.files.entry((day, channel)).or_default();
        *files += 1;
        let name = match files {
            1 => format!("{}.parquet", self.name),
            number => format!("{}-{number}.parquet", self.name),
        };
        let left_out: &[&str] = if channel.is_some() { &["channel"] } else { &[] };
        ParquetFile::create_without(&folder.join(name), (self.table)(), left_out)
    }

    /// Finishes all files.
    pub fn finish(self) -> Result<(), ParquetError> {
        let mut open: Vec<_> = self.open.into_iter().collect();
        open.sort_unstable_by_key(|(place, _)| *place);
        open.into_iter().try_for_each(|(_, open)| open.file.finish())
    }
}

/// Days since 1970.
fn day_of(time_ns: i64) -> i32 {
    time_ns.div_euclid(86_400_000_000_000) as i32
}

struct Date(i32);

impl fmt::Display for Date {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let time = Timestamp::from_second(i64::from(self.0) * 86_400).unwrap_or_default();
        write!(f, "{}", time.to_zoned(TimeZone::UTC).date())
    }
}

/// A value as part of a path, as Hive writes it: characters that would end the name or have a meaning there become `%` and
/// their number.
fn escaped(value: &str) -> String {
    let mut text = String::new();
    for character in value.chars() {
        if character.is_control() || "\"#%'*/:=?\\{}[]^ ".contains(character) {
            let mut bytes = [0; 4];
            for byte in character.encode_utf8(&mut bytes).bytes() {
                let _ = write!(text, "%{byte:02X}");
            }
        } else {
            text.push(character);
        }
    }
    // A folder with that name would be this one or the one above.
    if text.bytes().all(|byte| byte == b'.') { text.replace('.', "%2E") } else { text }
}
