//! A single file.

use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;

use super::Table;
use crate::BATCH_ROWS;

/// Rows in a row group: the unit that a reader looking for an interval of time skips or takes.
const GROUP_ROWS: usize = 1 << 19;
/// The default of zstd's own command.
const ZSTD_LEVEL: i32 = 3;

/// A Parquet file that takes its name only when it is complete: an older file with that name stays unchanged
/// until then.
pub struct ParquetFile<T> {
    /// Put rows into this, and call [`Self::flush`] now and then.
    pub table: T,
    writer: ArrowWriter<BufWriter<File>>,
    /// The indexes of the columns written.
    columns: Vec<usize>,
    temporary: Temporary,
    path: PathBuf,
}

/// Removed on drop if it still exists.
struct Temporary(PathBuf);

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

impl<T: Table> ParquetFile<T> {
    /// Starts a file in an existing folder.
    pub fn create(path: &Path, table: T) -> Result<Self, ParquetError> {
        Self::create_without(path, table, &[])
    }

    /// Starts a file without these columns: some readers refuse files that repeat what a folder's name says.
    pub(super) fn create_without(path: &Path, table: T, left_out: &[&str]) -> Result<Self, ParquetError> {
        let name = path.file_name().ok_or_else(|| io::Error::from(io::ErrorKind::InvalidFilename))?;
        let mut temporary = std::ffi::OsString::from(format!(".cantap-{}-", std::process::id()));
        temporary.push(name);
        let temporary = path.with_file_name(temporary);
        // In a common folder a stranger may have put a link there, which must be neither followed nor removed.
        let file = BufWriter::new(File::create_new(&temporary)?);
        let temporary = Temporary(temporary);
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL)?))
            .set_max_row_group_row_count(Some(GROUP_ROWS))
            .set_created_by(concat!("cantap ", env!("CARGO_PKG_VERSION")).to_owned())
            .build();
        let schema = table.columns();
        let is_kept = |column: &usize| !left_out.contains(&schema.field(*column).name().as_str());
        let columns: Vec<usize> = (0..schema.fields().len()).filter(is_kept).collect();
        let schema = Arc::new(schema.project(&columns)?);
        let writer = ArrowWriter::try_new(file, schema, Some(properties))?;
        Ok(Self { table, writer, columns, temporary, path: path.to_owned() })
    }

    /// Writes the table's rows if there are enough for a batch.
    pub fn flush(&mut self) -> Result<(), ParquetError> {
        if self.table.waiting() < BATCH_ROWS { Ok(()) } else { self.write() }
    }

    fn write(&mut self) -> Result<(), ParquetError> {
        self.writer.write(&self.table.batch().project(&self.columns)?)
    }

    /// Writes the rest, and puts the file in its place.
    pub fn finish(mut self) -> Result<(), ParquetError> {
        if self.table.waiting() > 0 {
            self.write()?;
        }
        let file = self.writer.into_inner()?;
        file.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        fs::rename(&self.temporary.0, &self.path)?;
        Ok(())
    }
}
