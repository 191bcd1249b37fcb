//! A part of the trace as a file in any format.

use cantap_formats::{Format, MemoryFile, WriteOptions, create_stream_writer};
use serde::Serialize;

use crate::error::EngineError;
use crate::message::{Bytes, Sections};
use crate::store::Store;
use crate::views::Rows;

/// An answer to `export` in `api.ts`.
#[derive(Serialize)]
pub struct Exported {
    name: String,
    bytes: Bytes,
    omitted: Vec<String>,
}

/// A format for the page.
#[derive(Serialize)]
pub struct FormatInfo {
    name: String,
    extension: &'static str,
    about: String,
}

/// All formats that can be written.
pub fn formats() -> Vec<FormatInfo> {
    let info = |format: Format| FormatInfo {
        name: format.to_string(),
        extension: format.suffix(),
        about: format!("{format} (.{})", format.suffix()),
    };
    Format::written().map(info).collect()
}

/// Writes the rows whose time lies in the stretch.
pub fn export(
    rows: Rows<'_>,
    store: &Store,
    (from_ns, to_ns): (i64, i64),
    trace_name: &str,
    format: &str,
    sections: &mut Sections,
) -> Result<Exported, EngineError> {
    let failed = |error: &dyn std::fmt::Display| EngineError::Export(format.to_owned(), error.to_string());
    let format_of: Format = format.parse().map_err(|error: cantap_formats::UnknownFormat| failed(&error))?;
    let file = MemoryFile::default();
    let options = WriteOptions { format: Some(format_of), ..WriteOptions::default() };
    let mut writer =
        create_stream_writer(Box::new(file.clone()), &options).map_err(|error| failed(&error))?;
    for row in 0..rows.len() {
        let Some(record) = rows.record(row).and_then(|row| store.record(row)) else { continue };
        if (from_ns..=to_ns).contains(&record.time_ns) {
            writer.write(&record).map_err(|error| failed(&error))?;
        }
    }
    let omitted = writer.finish().map_err(|error| failed(&error))?;
    Ok(Exported {
        name: format!("{}-part.{}", stem(trace_name), format_of.suffix()),
        bytes: sections.bytes(&file.take()),
        omitted: omitted.iter().map(|(what, count)| format!("{what} ({count})")).collect(),
    })
}

/// A file's name without its suffixes.
fn stem(name: &str) -> &str {
    let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
    name.split_once('.').map_or(name, |(stem, _)| stem)
}
