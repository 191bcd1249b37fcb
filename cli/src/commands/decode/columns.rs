//! Parquet files, for engines.

use std::collections::{HashMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

use cantap::TraceRecord;
use cantap_columns::parquet::{Dataset, Key, ParquetError, ParquetFile};
use cantap_columns::{FrameColumns, MessageColumns, SignalColumns, WideColumns};
use cantap_signals::{Decoder, MessageRef};

use super::decoded::Decoded;
use super::wide::Rows;
use crate::columns::Files;

type NewTable = Box<dyn Fn() -> SignalColumns>;

/// A row per value.
pub struct Long(Files<SignalColumns, NewTable>);

impl Long {
    /// One file.
    pub fn file(path: &Path, decoder: &Decoder) -> Result<Self, ParquetError> {
        Ok(Self(Files::One(Box::new(ParquetFile::create(path, SignalColumns::new(decoder))?))))
    }

    /// A folder of files, each called `name`, in folders by these keys.
    pub fn dataset(folder: &Path, keys: Vec<Key>, name: &str, decoder: &Decoder) -> Self {
        let first = SignalColumns::new(decoder);
        let table: NewTable = Box::new(move || first.another());
        Self(Files::Many(Box::new(Dataset::new(folder, name, keys, table))))
    }

    pub fn push(&mut self, decoder: &Decoder, decoded: &Decoded) -> Result<(), ParquetError> {
        let table = self.0.table_of(decoded.record)?;
        table.push_values(decoder, decoded.record, decoded.reference, decoded.values);
        Ok(())
    }

    pub fn push_event(&mut self, record: &TraceRecord) -> Result<(), ParquetError> {
        self.0.table_of(record)?.push_event(record);
        Ok(())
    }

    pub fn finish(self) -> Result<(), ParquetError> {
        self.0.finish()
    }
}

/// A file for each message, and one for events other than frames.
pub struct PerMessage {
    folder: PathBuf,
    files: HashMap<MessageRef, ParquetFile<MessageColumns>>,
    names: HashSet<String>,
    events: Option<ParquetFile<FrameColumns>>,
}

/// The file for events other than frames.
const EVENTS: &str = "events";

impl PerMessage {
    pub fn new(folder: &Path) -> Result<Self, ParquetError> {
        fs::create_dir_all(folder)?;
        let names = HashSet::from([EVENTS.to_owned()]);
        Ok(Self { folder: folder.to_owned(), files: HashMap::new(), names, events: None })
    }

    pub fn push(&mut self, decoder: &Decoder, decoded: &Decoded) -> Result<(), ParquetError> {
        let Decoded { record, reference, message, values, .. } = decoded;
        if !self.files.contains_key(reference) {
            let fit = |c: char| if c.is_alphanumeric() || "-_ ".contains(c) { c } else { '_' };
            let mut name: String = message.name.chars().map(fit).collect();
            // Some file systems ignore the case of letters.
            while !self.names.insert(name.to_lowercase()) {
                name = format!("{name}-{}", message.id);
            }
            let path = self.folder.join(format!("{name}.parquet"));
            self.files
                .insert(*reference, ParquetFile::create(&path, MessageColumns::new(decoder, *reference))?);
        }
        let file = self.files.get_mut(reference).expect("it was made above");
        file.table.push_values(record, values);
        file.flush()
    }

    pub fn push_event(&mut self, record: &TraceRecord) -> Result<(), ParquetError> {
        if self.events.is_none() {
            let path = self.folder.join(format!("{EVENTS}.parquet"));
            self.events = Some(ParquetFile::create(&path, FrameColumns::default())?);
        }
        let file = self.events.as_mut().expect("it was made above");
        file.table.push(record);
        file.flush()
    }

    pub fn finish(self) -> Result<(), ParquetError> {
        self.files.into_values().try_for_each(ParquetFile::finish)?;
        self.events.map_or(Ok(()), ParquetFile::finish)
    }
}

/// A table of signals side by side.
pub struct WideFile {
    path: PathBuf,
    file: Option<Box<ParquetFile<WideColumns>>>,
}

impl WideFile {
    pub fn new(path: &Path) -> Self {
        Self { path: path.to_owned(), file: None }
    }

    pub fn finish(self) -> Result<(), ParquetError> {
        self.file.map_or(Ok(()), |file| file.finish())
    }
}

impl Rows for WideFile {
    fn begin(&mut self, names_and_units: &[(String, String)]) -> anyhow::Result<()> {
        let names = names_and_units.iter().map(|(name, unit)| (name.as_str(), unit.as_str()));
        self.file = Some(Box::new(ParquetFile::create(&self.path, WideColumns::new(names))?));
        Ok(())
    }

    fn row<'a>(&mut self, time_ns: i64, cells: impl Iterator<Item = &'a str>) -> anyhow::Result<()> {
        if let Some(file) = &mut self.file {
            file.table.push(time_ns, cells.map(|cell| cell.parse().ok()));
            file.flush()?;
        }
        Ok(())
    }
}
