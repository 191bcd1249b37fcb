//! The trace that a command writes.

use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use cantap::TraceRecord;
#[cfg(feature = "parquet")]
use cantap_columns::parquet::{Key, ParquetError};
use cantap_formats::{Format, LeftOut, TraceWriter, WriteOptions, create_writer};

#[cfg(feature = "parquet")]
use crate::columns::{self, FrameFiles};
use crate::usage_error::usage;
use cantap_work::atomic_file::AtomicFile;

/// A trace being written. An older file with its name stays unchanged until this one is complete.
pub struct TraceOutput {
    path: PathBuf,
    sink: Sink,
}

enum Sink {
    Trace {
        writer: Box<dyn TraceWriter>,
        replacement: Option<AtomicFile>,
    },
    #[cfg(feature = "parquet")]
    Columns(Box<FrameFiles>),
}

impl TraceOutput {
    /// Begins the file. If it `grows`, as with data from a bus, others may read it meanwhile: it is written in place, as are
    /// files of a series.
    pub fn create(path: &Path, options: &WriteOptions, grows: bool) -> anyhow::Result<Self> {
        #[cfg(feature = "parquet")]
        if options.format == Some(Format::Parquet) || options.format.is_none() && columns::is_parquet(path) {
            columns::check_file(path, options)?;
            return Self::of_columns(path, FrameFiles::file(path));
        }
        let options = &named(options.clone(), path)?;
        let is_whole = options.rotation.at.is_empty() && !grows;
        let replacement = if is_whole { AtomicFile::of(path) } else { None };
        let written = replacement.as_ref().map_or(path, |file| &file.temporary);
        let writer = create_writer(written, options).with_context(|| failed(path))?;
        Ok(Self { path: path.to_owned(), sink: Sink::Trace { writer, replacement } })
    }

    /// Begins a folder of Parquet files, each called `name`, in folders by these keys.
    #[cfg(feature = "parquet")]
    pub fn dataset(path: &Path, keys: Vec<Key>, name: &str) -> Self {
        Self { path: path.to_owned(), sink: Sink::Columns(Box::new(FrameFiles::dataset(path, keys, name))) }
    }

    #[cfg(feature = "parquet")]
    fn of_columns(path: &Path, files: Result<FrameFiles, ParquetError>) -> anyhow::Result<Self> {
        let files = files.with_context(|| failed(path))?;
        Ok(Self { path: path.to_owned(), sink: Sink::Columns(Box::new(files)) })
    }

    /// Adds a record.
    pub fn write(&mut self, record: &TraceRecord) -> anyhow::Result<()> {
        match &mut self.sink {
            Sink::Trace { writer, .. } => writer.write(record).with_context(|| failed(&self.path)),
            #[cfg(feature = "parquet")]
            Sink::Columns(files) => files.write(record).with_context(|| failed(&self.path)),
        }
    }

    /// Writes what is waiting in memory, if a reader could take it before the end.
    pub fn flush(&mut self) -> anyhow::Result<()> {
        match &mut self.sink {
            Sink::Trace { writer, .. } => writer.flush().with_context(|| failed(&self.path)),
            #[cfg(feature = "parquet")]
            Sink::Columns(_) => Ok(()),
        }
    }

    /// Ends it when reading the input has failed. A temporary file is dropped, and the existing one stays; a file written in place is
    /// ended properly, because its content may be nowhere else.
    pub fn give_up(self) -> anyhow::Result<()> {
        match self.sink {
            Sink::Trace { writer, replacement: None } => {
                writer.finish().with_context(|| failed(&self.path))?;
            }
            Sink::Trace { replacement: Some(_), .. } => {
                eprintln!(
                    "cantap: {} was not written; the trace could not be read to its end",
                    shown(&self.path)
                );
            }
            #[cfg(feature = "parquet")]
            Sink::Columns(_) => {}
        }
        Ok(())
    }

    /// Ends the file and puts it in its place. Reports what it could not carry, and returns that.
    pub fn finish(self) -> anyhow::Result<LeftOut> {
        let left_out = match self.sink {
            Sink::Trace { writer, replacement } => {
                let left_out = writer.finish().with_context(|| failed(&self.path))?;
                if let Some(file) = replacement {
                    file.put_in_place().with_context(|| failed(&self.path))?;
                }
                left_out
            }
            #[cfg(feature = "parquet")]
            Sink::Columns(files) => {
                files.finish().with_context(|| failed(&self.path))?;
                LeftOut::default()
            }
        };
        report(&left_out, &self.path);
        Ok(left_out)
    }
}

/// The options with the format of the file's name, if no other is given.
pub fn named(mut options: WriteOptions, path: &Path) -> anyhow::Result<WriteOptions> {
    #[cfg(not(feature = "parquet"))]
    if options.format == Some(Format::Parquet) {
        bail!(WITHOUT_PARQUET);
    }
    if options.format.is_none() && path.as_os_str() != "-" {
        #[cfg(not(feature = "parquet"))]
        refuse_parquet(path)?;
        let format = Format::of_path(path);
        let format = format.map_err(|error| io::Error::new(io::ErrorKind::InvalidInput, error));
        options.format = Some(format.with_context(|| failed(path))?);
    }
    Ok(options)
}

/// A build from the source tree omits what takes longest to compile.
#[cfg(not(feature = "parquet"))]
pub fn refuse_parquet(path: &Path) -> anyhow::Result<()> {
    if path.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case("parquet")) {
        bail!(WITHOUT_PARQUET);
    }
    Ok(())
}

#[cfg(not(feature = "parquet"))]
const WITHOUT_PARQUET: &str = "this build has no Parquet; add `--features parquet` to its command line, or install the command with \
     `cargo install --locked --path cli`";

/// Refuses, before a bus is listened to, a format that cannot be written while its records come.
pub fn refuse_unwritten(format: Format) -> anyhow::Result<()> {
    if format.is_written() {
        return Ok(());
    }
    let why = if format == Format::Parquet {
        "is complete only at its end; capture to a .log or .blf, and convert that with cantap convert"
            .to_owned()
    } else {
        format!("is only read; those that are written are {}", Format::written_names())
    };
    Err(usage(format!("{format} {why}")))
}

/// Refuses to overwrite what a bus said once and will not say again.
pub fn refuse_older(path: &Path, force: bool) -> anyhow::Result<()> {
    if path.is_file() && !force {
        bail!("'{}' already exists; choose another name, or overwrite it with --force", path.display());
    }
    Ok(())
}

/// A file's name in messages.
pub fn shown(path: &Path) -> String {
    if path.as_os_str() == "-" { "standard output".to_owned() } else { path.display().to_string() }
}

/// Reports what a finished file could not carry.
pub fn report(left_out: &LeftOut, path: &Path) {
    for (what, count) in left_out.iter() {
        eprintln!("cantap: {} does not carry {what} ({count})", shown(path));
    }
}

/// The message if it cannot be written.
pub fn failed(path: &Path) -> String {
    format!("cannot write {}", shown(path))
}

/// The trace of `cantap demo`.
pub fn of_demo(path: &Path, format: Option<Format>) -> anyhow::Result<Box<dyn cantap_demo::Output>> {
    let options = WriteOptions { format, ..WriteOptions::default() };
    Ok(Box::new(TraceOutput::create(path, &options, false)?))
}

impl cantap_demo::Output for TraceOutput {
    fn write(&mut self, record: &TraceRecord) -> anyhow::Result<()> {
        self.write(record)
    }

    fn finish(self: Box<Self>) -> anyhow::Result<()> {
        TraceOutput::finish(*self).map(drop)
    }
}
