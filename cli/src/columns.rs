//! The Parquet files that commands write.

use std::path::Path;

use cantap::TraceRecord;
use cantap_columns::FrameColumns;
use cantap_columns::parquet::{Dataset, Key, ParquetError, ParquetFile, Table};
use cantap_formats::WriteOptions;

use crate::usage_error::usage;

/// Whether the name is that of a Parquet file.
pub fn is_parquet(path: &Path) -> bool {
    path.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case("parquet"))
}

/// The name of a dataset's files: that of the trace from which they are made, so that repeating it replaces them.
pub fn name_of(trace: &Path) -> &str {
    let name = trace.file_name().and_then(|name| name.to_str()).filter(|name| *name != "-");
    name.and_then(|name| name.split('.').find(|part| !part.is_empty())).unwrap_or("trace")
}

/// Refuses what a Parquet file cannot be: standard output, because it takes its name when it is complete, or a series of files.
pub fn check_file(path: &Path, options: &WriteOptions) -> anyhow::Result<()> {
    if path.as_os_str() == "-" {
        return Err(usage("Parquet is not written to standard output; give a file's name"));
    }
    if !options.rotation.at.is_empty() {
        return Err(usage(
            "Parquet files are not rotated; leave --rotate out, or convert with --partition day",
        ));
    }
    Ok(())
}

/// Refuses a file's name where a folder is needed.
pub fn refuse_file(folder: &Path) -> anyhow::Result<()> {
    if folder.as_os_str() == "-" || is_parquet(folder) || folder.is_file() {
        let shown = folder.display();
        return Err(usage(format!(
            "--partition makes a folder of files; {shown} is a file's name, give a folder's"
        )));
    }
    Ok(())
}

/// One file, or a folder of them.
pub enum Files<T, F> {
    One(Box<ParquetFile<T>>),
    Many(Box<Dataset<T, F>>),
}

impl<T: Table, F: Fn() -> T> Files<T, F> {
    /// The table for a record.
    pub fn table_of(&mut self, record: &TraceRecord) -> Result<&mut T, ParquetError> {
        match self {
            Self::One(file) => {
                file.flush()?;
                Ok(&mut file.table)
            }
            Self::Many(dataset) => dataset.table_of(record),
        }
    }

    pub fn finish(self) -> Result<(), ParquetError> {
        match self {
            Self::One(file) => file.finish(),
            Self::Many(dataset) => dataset.finish(),
        }
    }
}

/// A trace as Parquet.
pub struct FrameFiles(Files<FrameColumns, fn() -> FrameColumns>);

impl FrameFiles {
    pub fn file(path: &Path) -> Result<Self, ParquetError> {
        Ok(Self(Files::One(Box::new(ParquetFile::create(path, FrameColumns::default())?))))
    }

    pub fn dataset(folder: &Path, keys: Vec<Key>, name: &str) -> Self {
        Self(Files::Many(Box::new(Dataset::new(folder, name, keys, FrameColumns::default))))
    }

    pub fn write(&mut self, record: &TraceRecord) -> Result<(), ParquetError> {
        self.0.table_of(record)?.push(record);
        Ok(())
    }

    pub fn finish(self) -> Result<(), ParquetError> {
        self.0.finish()
    }
}
