//! Tables of records as files.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow_array::{RecordBatch, RecordBatchReader};
#[cfg(feature = "parquet")]
use cantap_columns::parquet::ParquetFile;
use cantap_columns::{FrameColumns, McapFile};
use cantap_formats::{Format, TraceWriter, WriteOptions, create_writer};
use cantap_signals::Decoder;
use pyo3::prelude::*;

use crate::database::Database;
use crate::error::Error;
use crate::report::{by_kind, from_json};
use crate::table::batches_of;
use crate::traces::each_part;

/// What a file does not carry, by kind.
type Counted = BTreeMap<String, u64>;

/// Writes a table of records as a trace. An older file with its name stays unchanged until this one is
/// complete.
#[pyfunction]
pub fn write<'py>(
    py: Python<'py>,
    table: &Bound<'py, PyAny>,
    path: PathBuf,
    format: Option<String>,
    zone: Option<String>,
    decoder: Option<(Py<Database>, Vec<String>)>,
) -> PyResult<Bound<'py, PyAny>> {
    let batches = batches_of(table)?;
    let schema = batches.schema();
    // Check this before creating anything; a table without rows must also be one of records.
    cantap_columns::records(&RecordBatch::new_empty(Arc::clone(&schema))).map_err(Error::from)?;
    let named = |name: &str| path.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case(name));
    let is = |name: &str| {
        format.as_deref().map_or_else(|| named(name), |format| format.eq_ignore_ascii_case(name))
    };
    let decoder = match (is("mcap"), decoder) {
        (true, Some((db, signals))) => Some((db.get().selecting(&signals)?, !signals.is_empty())),
        (true, None) => {
            return Err(Error::argument(
                "an MCAP file has the signals of frames; give their database with db=",
            )
            .into());
        }
        (false, Some(_)) => {
            return Err(Error::argument(
                "frames are written as they are; with db= their signals go into a file that ends in .mcap",
            )
            .into());
        }
        (false, None) => None,
    };
    let is_parquet = named("parquet");
    let (left_out, rows) = py.detach(|| -> Result<_, Error> {
        if let Some((decoder, is_chosen)) = &decoder {
            return write_mcap(batches, &path, decoder, *is_chosen);
        }
        if is_parquet && format.is_none() {
            return write_parquet(batches, &path);
        }
        let options = WriteOptions {
            format: format.as_deref().map(str::parse).transpose().map_err(Error::argument)?,
            zone: zone.as_deref().map(str::parse).transpose().map_err(Error::argument)?.unwrap_or_default(),
            ..WriteOptions::default()
        };
        write_trace(batches, &path, options)
    })?;
    let mut counts = serde_json::to_value(left_out).unwrap_or_default();
    for column in schema.fields().iter().map(|field| field.name()) {
        if FrameColumns::schema().column_with_name(column).is_none() && !is_about_rows(column) {
            counts[format!("the column '{column}'")] = rows.into();
        }
    }
    from_json(py, &counts.to_string())
}

/// Whether a column says where rows came from: that of `search`, and the index of pandas.
fn is_about_rows(column: &str) -> bool {
    column == "place" || column.starts_with("__index_level_")
}

#[cfg(not(feature = "parquet"))]
fn write_parquet(_: Box<dyn RecordBatchReader + Send>, path: &Path) -> Result<(Counted, usize), Error> {
    Err(Error::Format(format!(
        "{}: this build of cantap writes no Parquet; build it with the feature 'parquet', or pass the table's to_pyarrow() to \
         pyarrow.parquet.write_table",
        path.display()
    )))
}

#[cfg(feature = "parquet")]
fn write_parquet(batches: Box<dyn RecordBatchReader + Send>, path: &Path) -> Result<(Counted, usize), Error> {
    let mut file = ParquetFile::create(path, FrameColumns::default())?;
    let mut rows = 0;
    for batch in batches {
        each_part(batch, &mut rows, |records| {
            for record in records {
                file.table.push(record);
            }
            Ok(())
        })?;
        file.flush()?;
    }
    file.finish()?;
    Ok((Counted::new(), rows))
}

fn write_trace(
    batches: Box<dyn RecordBatchReader + Send>,
    path: &Path,
    mut options: WriteOptions,
) -> Result<(Counted, usize), Error> {
    let failed = |error: io::Error| match error.kind() {
        // The name indicates no format, or one that can only be read.
        io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported => Error::Format(error.to_string()),
        _ => Error::of_file(error, path),
    };
    if options.format.is_none() {
        options.format = Some(Format::of_path(path).map_err(|error| Error::Format(error.to_string()))?);
    }
    replacing(path, failed, |written| {
        let mut writer: Box<dyn TraceWriter> = create_writer(written, &options).map_err(failed)?;
        let mut rows = 0;
        for batch in batches {
            each_part(batch, &mut rows, |records| {
                records.iter().try_for_each(|record| writer.write(record).map_err(failed))
            })?;
        }
        Ok((by_kind(&writer.finish().map_err(failed)?), rows))
    })
}

/// The signals of frames, and what else happened. If they are chosen, a message without any of them is not there.
fn write_mcap(
    batches: Box<dyn RecordBatchReader + Send>,
    path: &Path,
    decoder: &Decoder,
    is_chosen: bool,
) -> Result<(Counted, usize), Error> {
    let failed = |error: io::Error| Error::of_file(error, path);
    replacing(path, failed, |written| {
        let out = BufWriter::new(fs::File::create(written).map_err(failed)?);
        let mut file = McapFile::new(out).map_err(failed)?;
        let (mut rows, mut unknown, mut values) = (0, 0_u64, Vec::new());
        for batch in batches {
            each_part(batch, &mut rows, |records| {
                for record in records {
                    let Some(frame) = record.frame() else {
                        file.push_event(record).map_err(failed)?;
                        continue;
                    };
                    match decoder.decode(record.channel, frame, &mut values) {
                        Some(_) if is_chosen && values.is_empty() => {}
                        Some(message) => {
                            file.push_values(decoder, record, message, &values).map_err(failed)?;
                        }
                        None => unknown += 1,
                    }
                }
                Ok(())
            })?;
        }
        let early = file.before_1970();
        file.finish().and_then(|mut out| out.flush()).map_err(failed)?;
        let left_out = [("frames that no database has", unknown), ("records from before 1970", early)];
        let left_out = left_out.into_iter().filter(|(_, count)| *count > 0);
        Ok((left_out.map(|(what, count)| (what.to_owned(), count)).collect(), rows))
    })
}

/// Writes a file that takes the place of an older one once it is complete. A pipe or a device is written to directly.
fn replacing<T>(
    path: &Path,
    failed: impl Fn(io::Error) -> Error,
    write: impl FnOnce(&Path) -> Result<T, Error>,
) -> Result<T, Error> {
    let is_file = !path.exists() || path.is_file();
    let temporary = if is_file { Temporary::next_to(path).map_err(&failed)? } else { None };
    let written = write(temporary.as_ref().map_or(path, |temporary| &temporary.0))?;
    if let Some(temporary) = &temporary {
        // A link remains a link.
        let place = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        fs::rename(&temporary.0, place).map_err(failed)?;
    }
    Ok(written)
}

/// A file that is removed on drop if it still exists. Its suffix is that of the final file, which determines format and
/// compression.
struct Temporary(PathBuf);

impl Temporary {
    fn next_to(path: &Path) -> io::Result<Option<Self>> {
        let place = if path.exists() { path.canonicalize()? } else { path.to_owned() };
        let Some(name) = place.file_name() else { return Ok(None) };
        let mut temporary = std::ffi::OsString::from(format!(".cantap-{}-", std::process::id()));
        temporary.push(name);
        let temporary = place.with_file_name(temporary);
        // In a common folder a stranger may have put a link there, which must be neither followed nor removed.
        fs::File::create_new(&temporary)?;
        Ok(Some(Self(temporary)))
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

/// Adds the function to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(write, module)?)
}
