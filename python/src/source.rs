//! The requested records of a trace file.

use std::path::PathBuf;
use std::sync::Arc;

use cantap_formats::time_range::{TimePoint, TimeRange};
use cantap_formats::{Fault, Format, IndexFolder, ReadOptions, TraceReader, Zone};
use cantap_signals::Decoder;
use cantap_trace::counted;
use cantap_trace::filter::{Filter, passes};
use cantap_trace::{PlainFrame, TraceRecord};
use pyo3::prelude::*;

use crate::channels::Named;
use crate::database::Database;
use crate::error::Error;
use crate::grammar::OfTrace;
use crate::inputs::TraceFile;
use crate::number::entry;
use crate::report::{Counts, Report};

/// What to read from a file, as passed by the Python half.
pub struct Options {
    pub files: Arc<Vec<TraceFile>>,
    pub format: Option<String>,
    pub zone: Option<String>,
    pub strict: bool,
    pub filters: Vec<String>,
    pub channels: Vec<u8>,
    pub start: Option<String>,
    pub end: Option<String>,
    pub db: Option<Py<Database>>,
    pub signals: Vec<String>,
    /// Where indexes of large files are; without it, where the user's are.
    pub indexes: Option<PathBuf>,
}

impl<'py> FromPyObject<'_, 'py> for Options {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let channels: Vec<OfTrace> = entry(object, "channels", "channel")?;
        Ok(Self {
            files: Arc::new(entry(object, "files", "path")?),
            format: entry(object, "format", "format")?,
            zone: entry(object, "zone", "zone")?,
            strict: entry(object, "strict", "strict")?,
            filters: entry(object, "filters", "filter")?,
            channels: channels.into_iter().map(|channel| channel.0).collect(),
            start: entry(object, "start", "start")?,
            end: entry(object, "end", "end")?,
            db: entry(object, "db", "db")?,
            signals: entry(object, "signals", "signals")?,
            indexes: if object.contains("indexes")? { entry(object, "indexes", "indexes")? } else { None },
        })
    }
}

impl Options {
    /// The decoder, if a database was given.
    pub fn decoder(&self) -> Result<Option<Arc<Decoder>>, Error> {
        match &self.db {
            Some(database) => database.get().selecting(&self.signals).map(Some),
            None if self.signals.is_empty() => Ok(None),
            None => Err(Error::argument("signals are chosen out of a database; give one with db=")),
        }
    }

    /// The channels that they name.
    pub fn named_channels(&self) -> Vec<Named> {
        let database = self.db.as_ref().and_then(|database| database.get().named_channels());
        Named::by("channel", self.channels.iter().copied()).into_iter().chain(database).collect()
    }

    pub fn read(&self) -> Result<ReadOptions, Error> {
        let format = self.format.as_deref().map(str::parse::<Format>).transpose().map_err(Error::argument)?;
        let zone = self.zone.as_deref().map(str::parse::<Zone>).transpose().map_err(Error::argument)?;
        Ok(ReadOptions {
            format,
            strict: self.strict,
            zone: zone.unwrap_or_default(),
            index: self.indexes.clone().map(IndexFolder::new).or_else(cantap_work::cache::indexes),
            ..ReadOptions::default()
        })
    }
}

/// Files being read, one after another.
pub struct TraceSource {
    reader: TraceReader,
    read: ReadOptions,
    files: Arc<Vec<TraceFile>>,
    /// The sum of those before, under the first one's name; `None` while that is read.
    before: Option<Counts>,
    /// The place of the current one.
    file: usize,
    strict: bool,
    filters: Vec<Filter>,
    channels: Vec<u8>,
    window: TimeRange,
    is_all: bool,
    /// Of the current file.
    pub counts: Counts,
    report: Report,
}

impl TraceSource {
    /// Opens the file. Progress is recorded in the report.
    pub fn open(options: &Options, report: Report) -> Result<Self, Error> {
        let read = options.read()?;
        let filters =
            options.filters.iter().map(|text| text.parse::<Filter>()).collect::<Result<Vec<_>, _>>();
        let point = |text: &Option<String>| text.as_deref().map(str::parse::<TimePoint>).transpose();
        let start = point(&options.start).map_err(Error::argument)?;
        let end = point(&options.end).map_err(Error::argument)?;
        let filters = filters.map_err(Error::argument)?;
        let Some(first) = options.files.first() else {
            return Err(Error::argument("no file is given; name at least one"));
        };
        let mut window = TimeRange::new(start, end);
        let reader = first.open(&read, &mut window)?;
        let counts = Counts::of(first.name(), &reader);
        report.set(counts.clone());
        let is_all = filters.is_empty() && options.channels.is_empty() && start.is_none() && end.is_none();
        let channels = options.channels.clone();
        Ok(Self {
            reader,
            read,
            files: Arc::clone(&options.files),
            before: None,
            file: 0,
            strict: options.strict,
            filters,
            channels,
            window,
            is_all,
            counts,
            report,
        })
    }

    /// Replaces the content of `records` with the next ones, perhaps none; false at the end.
    pub fn next_batch(&mut self, records: &mut Vec<TraceRecord>) -> Result<bool, Error> {
        self.next_of(None, records)
    }

    /// The same, where of data frames that come first nothing is wanted but what is decoded.
    pub fn next_mixed(
        &mut self,
        frames: &mut Vec<PlainFrame>,
        records: &mut Vec<TraceRecord>,
    ) -> Result<bool, Error> {
        frames.clear();
        // What is chosen is chosen among records.
        let is_all = self.is_all;
        self.next_of(Some(frames).filter(|_| is_all), records)
    }

    fn next_of(
        &mut self,
        mut frames: Option<&mut Vec<PlainFrame>>,
        records: &mut Vec<TraceRecord>,
    ) -> Result<bool, Error> {
        loop {
            let read = match &mut frames {
                Some(frames) => self.reader.next_mixed(frames, records),
                None => self.reader.next_batch(records),
            };
            match read {
                None => break,
                Some(Ok(())) => {
                    if let Some(frames) = &frames {
                        self.counts.count_frames(frames.len() as u64);
                        self.counts.channels.extend(frames.iter().map(|frame| frame.channel));
                    }
                    self.counts.channels.extend(records.iter().map(|record| record.channel));
                    self.choose(records);
                    for record in records.iter() {
                        self.counts.count(record);
                    }
                    return Ok(true);
                }
                Some(Err(issue)) => {
                    self.counts.fault(&issue);
                    // If the system stops delivering a file, nobody must think that this was all of it.
                    if self.strict || matches!(issue.fault, Fault::Io(_)) {
                        self.tell();
                        return Err(issue.into());
                    }
                }
            }
        }
        records.clear();
        if let Some(frames) = &mut frames {
            frames.clear();
        }
        let is_at_its_end = !std::mem::replace(&mut self.counts.is_whole, true);
        self.tell();
        if let Some(nothing) = self.reader.nothing_read() {
            return Err(nothing.into());
        }
        if self.files.len() > 1 && is_at_its_end {
            self.report.push_file(self.counts.clone());
        }
        let Some(next) = self.files.get(self.file + 1) else { return Ok(false) };
        self.reader = next.open(&self.read, &mut self.window)?;
        let counts = Counts::of(next.name(), &self.reader);
        let done = std::mem::replace(&mut self.counts, counts);
        match &mut self.before {
            Some(before) => before.add(&done),
            None => self.before = Some(done),
        }
        self.file += 1;
        // Its records follow with the next call.
        Ok(true)
    }

    /// Brings the report up to date.
    pub fn tell(&mut self) {
        self.counts.update(&self.reader);
        self.counts.channels.extend(self.reader.passed_channels());
        self.report.set(self.all_counts());
    }

    /// Which of the files is being read.
    pub fn file(&self) -> usize {
        self.file
    }

    /// Of all files so far, without a list of them. One alone stays as it is.
    pub fn all_counts(&self) -> Counts {
        let Some(before) = &self.before else { return self.counts.clone() };
        let mut all = before.clone();
        all.add(&self.counts);
        all.file = format!("{} from {} to {}", counted(self.file + 1, "file"), before.file, self.counts.file);
        all
    }

    fn choose(&mut self, records: &mut Vec<TraceRecord>) {
        if self.is_all {
            return;
        }
        let Self { filters, channels, window, .. } = self;
        records.retain(|record| {
            // The window starts at the trace's first record, whatever its channel.
            let inside = window.contains(record);
            inside && (channels.is_empty() || channels.contains(&record.channel)) && passes(filters, record)
        });
    }
}
