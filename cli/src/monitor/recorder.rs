//! Recording what comes, all of it, whatever is displayed.

use std::path::{Path, PathBuf};

use cantap::TraceRecord;
use cantap::formats::{LeftOut, TraceWriter, WriteOptions, create_writer};

use super::model::Recording;

/// A file that grows.
pub struct Recorder {
    path: PathBuf,
    writer: Box<dyn TraceWriter>,
    records: u64,
    since_ns: i64,
}

impl Recorder {
    /// Creates the file, in the format of its suffix.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let writer = create_writer(path, &WriteOptions::default())
            .map_err(|error| anyhow::anyhow!("cannot record to {}: {error}", path.display()))?;
        Ok(Self { path: path.to_owned(), writer, records: 0, since_ns: 0 })
    }

    /// Writes records.
    pub fn write(&mut self, records: &[TraceRecord]) -> std::io::Result<()> {
        for record in records {
            self.writer.write(record)?;
        }
        if self.records == 0 {
            self.since_ns = records.first().map_or(0, |record| record.time_ns);
        }
        self.records += records.len() as u64;
        Ok(())
    }

    /// Hands what was written to the system, and says how things are.
    pub fn state(&mut self) -> std::io::Result<Recording> {
        self.writer.flush()?;
        Ok(Recording {
            path: self.path.display().to_string(),
            records: self.records,
            bytes: std::fs::metadata(&self.path).map_or(0, |file| file.len()),
            since_ns: self.since_ns,
        })
    }

    /// Ends the file and says so in a sentence.
    pub fn finish(self) -> String {
        let (path, records) = (self.path.display().to_string(), self.records);
        match self.writer.finish() {
            Ok(left_out) if left_out.is_empty() => format!("{records} records are in {path}"),
            Ok(left_out) => format!("{records} records are in {path}, without {}", listed(&left_out)),
            Err(error) => format!("the end of {path} could not be written: {error}"),
        }
    }
}

fn listed(left_out: &LeftOut) -> String {
    let parts: Vec<_> = left_out.iter().map(|(what, count)| format!("{count} {what}")).collect();
    parts.join(", ")
}
