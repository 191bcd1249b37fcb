//! What was read from a file, and what was not.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use cantap_formats::{Fault, LeftOut, ReadIssue, TraceReader};
use cantap_trace::counted;
use cantap_trace::{TraceEvent, TraceRecord};
use pyo3::prelude::*;
use serde::{Deserialize, Serialize};

use crate::channels::Channels;

/// How many faults are kept as text.
const FAULTS_KEPT: usize = 20;

/// The numbers.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Counts {
    pub file: String,
    pub format: String,
    pub records_read: u64,
    pub records: u64,
    pub frames: u64,
    pub lost: u64,
    pub lost_at_least: bool,
    pub bus_errors: u64,
    pub decoded: u64,
    pub values: u64,
    pub issues: u64,
    pub is_cut: bool,
    pub faults: Vec<String>,
    pub left_out: BTreeMap<String, u64>,
    pub notes: BTreeMap<String, u64>,
    pub is_whole: bool,
    /// All channels in the file, before any filter.
    #[serde(default)]
    pub channels: Channels,
    /// What the file says about its measurement.
    #[serde(default)]
    pub properties: BTreeMap<String, String>,
    /// If there were several files: the counts of each that was read.
    #[serde(default)]
    pub files: Vec<Counts>,
}

impl Counts {
    /// Of a file of which nothing was read yet.
    pub fn of(file: String, reader: &TraceReader) -> Self {
        Self { file, format: reader.format().to_string(), ..Self::default() }
    }

    /// Adds those of another file; not to the list of files.
    pub fn add(&mut self, part: &Self) {
        self.records_read += part.records_read;
        self.records += part.records;
        self.frames += part.frames;
        self.lost += part.lost;
        self.lost_at_least |= part.lost_at_least;
        self.bus_errors += part.bus_errors;
        self.decoded += part.decoded;
        self.values += part.values;
        self.issues += part.issues;
        self.is_cut |= part.is_cut;
        self.is_whole &= part.is_whole;
        let room = FAULTS_KEPT - self.faults.len();
        self.faults.extend(part.faults.iter().take(room).cloned());
        for (sum, counts) in [(&mut self.left_out, &part.left_out), (&mut self.notes, &part.notes)] {
            for (what, count) in counts {
                *sum.entry(what.clone()).or_default() += count;
            }
        }
        self.channels.extend(part.channels.iter());
        if !self.format.split(", ").any(|format| format == part.format) {
            self.format = format!("{}, {}", self.format, part.format);
        }
        // What is different in each file is in the list.
        self.properties.clear();
    }

    /// Counts a record that is passed on.
    pub fn count(&mut self, record: &TraceRecord) {
        self.records += 1;
        match record.event {
            TraceEvent::Frame { .. } => self.frames += 1,
            TraceEvent::Lost { count, at_least, .. } => {
                self.lost += u64::from(count);
                self.lost_at_least |= at_least;
            }
            TraceEvent::BusError { .. } => self.bus_errors += 1,
            TraceEvent::ErrorsSuppressed { count } => self.bus_errors += u64::from(count),
            TraceEvent::State { .. }
            | TraceEvent::TransmitFailed { .. }
            | TraceEvent::Disturbed { .. }
            | TraceEvent::Lin { .. } => {}
        }
    }

    /// Counts frames that are handed on.
    pub fn count_frames(&mut self, frames: u64) {
        self.records += frames;
        self.frames += frames;
    }

    /// Counts what could not be read.
    pub fn fault(&mut self, issue: &ReadIssue) {
        self.issues += 1;
        self.is_cut |= matches!(issue.fault, Fault::Truncated(_));
        if self.faults.len() < FAULTS_KEPT {
            self.faults.push(issue.to_string());
        }
    }

    /// Takes over the reader's current counts.
    pub fn update(&mut self, reader: &TraceReader) {
        self.records_read = reader.records();
        self.left_out = by_kind(reader.left_out());
        self.notes = by_kind(reader.notes());
        self.properties =
            reader.properties().map(|(name, value)| (name.to_owned(), value.to_owned())).collect();
    }

    /// The percentage of the file's entries that is missing; an issue counts as one entry.
    pub fn missing_pct(&self) -> f64 {
        let missing = self.issues + self.left_out.values().sum::<u64>();
        missing as f64 * 100.0 / (self.records_read + missing).max(1) as f64
    }

    /// What is wrong with the file, in words, if anything.
    pub fn warning(&self) -> Option<String> {
        let first = self.faults.first()?;
        let more = self.issues - 1;
        let share = self.missing_pct();
        let others = match more {
            0 => String::new(),
            1 => ", and 1 more place".to_owned(),
            more => format!(", and {more}", more = counted(more, "more place")),
        };
        Some(format!("{first}{others}; {share:.2} % of the file could not be read (see the table's report)"))
    }
}

impl Counts {
    /// That none of the frames was decoded, in words; `None` if one was, or if there are none.
    pub fn nothing_decoded(&self) -> Option<String> {
        (self.frames > 0 && self.decoded == 0).then(|| {
            format!(
                "{}: none of its {} could be decoded with the database; is it the right one?",
                self.file,
                counted(self.frames, "frame")
            )
        })
    }
}

impl Counts {
    /// Which files have no record at all, in words; `None` if each has one.
    pub fn without_record(&self) -> Option<String> {
        let files = if self.files.is_empty() { std::slice::from_ref(self) } else { self.files.as_slice() };
        let empty: Vec<_> = files.iter().filter(|file| file.is_empty()).collect();
        match empty.as_slice() {
            [] => None,
            [file] => Some(format!("{}: it has no record", file.file)),
            [first, ..] => Some(format!("{}, and {} more: they have no record", first.file, empty.len() - 1)),
        }
    }

    /// Whether the file is as it should be and has nothing in it.
    fn is_empty(&self) -> bool {
        let nothing_else = self.left_out.is_empty() && self.channels == Channels::default();
        self.is_whole && self.issues == 0 && self.records_read == 0 && nothing_else
    }
}

/// Descriptions and counts.
pub fn by_kind(counts: &LeftOut) -> BTreeMap<String, u64> {
    counts.iter().map(|(what, count)| (what.to_owned(), count)).collect()
}

/// What was read from a file, and what could not be read.
#[pyclass(module = "cantap", frozen)]
#[derive(Clone, Default)]
pub struct Report(pub Arc<Mutex<Counts>>);

impl Report {
    /// The current counts.
    pub fn now(&self) -> Counts {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sets how many frames were decoded, and how many values they had: in the first file, the first two, and so on.
    pub fn set_decoded(&self, up_to_file: &[(u64, u64)]) {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        (counts.decoded, counts.values) = up_to_file.last().copied().unwrap_or_default();
        let mut before = (0, 0);
        for (file, up_to) in counts.files.iter_mut().zip(up_to_file) {
            (file.decoded, file.values) = (up_to.0 - before.0, up_to.1 - before.1);
            before = *up_to;
        }
    }

    /// Replaces everything but the list of files.
    pub fn set(&self, counts: Counts) {
        let mut now = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let files = std::mem::take(&mut now.files);
        *now = Counts { files, ..counts };
    }

    /// Adds one of several files to the list, once it was read.
    pub fn push_file(&self, counts: Counts) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).files.push(counts);
    }
}

#[pymethods]
impl Report {
    /// The file's name, as given.
    #[getter]
    fn file(&self) -> String {
        self.now().file
    }

    /// The format as which it was read.
    #[getter]
    fn format(&self) -> String {
        self.now().format
    }

    /// Records in the file, before any filter.
    #[getter]
    fn records_read(&self) -> u64 {
        self.now().records_read
    }

    /// The channels that the file has, before any filter.
    #[getter]
    fn channels(&self) -> Vec<u16> {
        self.now().channels.iter().map(u16::from).collect()
    }

    /// Records that passed the filters.
    #[getter]
    fn records(&self) -> u64 {
        self.now().records
    }

    /// Frames among them.
    #[getter]
    fn frames(&self) -> u64 {
        self.now().frames
    }

    /// Frames that are missing according to the trace.
    #[getter]
    fn lost(&self) -> u64 {
        self.now().lost
    }

    /// Whether there may be more missing than `lost`.
    #[getter]
    fn lost_at_least(&self) -> bool {
        self.now().lost_at_least
    }

    /// Bus errors, including those that were only counted.
    #[getter]
    fn bus_errors(&self) -> u64 {
        self.now().bus_errors
    }

    /// Frames that a database has a message for.
    #[getter]
    fn decoded(&self) -> u64 {
        self.now().decoded
    }

    /// Values in them.
    #[getter]
    fn values(&self) -> u64 {
        self.now().values
    }

    /// Places that could not be read.
    #[getter]
    fn issues(&self) -> u64 {
        self.now().issues
    }

    /// The first of them, in words.
    #[getter]
    fn faults(&self) -> Vec<String> {
        self.now().faults
    }

    /// Whether the file ends in the middle of something.
    #[getter]
    fn is_cut(&self) -> bool {
        self.now().is_cut
    }

    /// What is well-formed but not part of a CAN trace, by kind.
    #[getter]
    fn left_out(&self) -> BTreeMap<String, u64> {
        self.now().left_out
    }

    /// What is not wrong but should be known, by kind.
    #[getter]
    fn notes(&self) -> BTreeMap<String, u64> {
        self.now().notes
    }

    /// What an MF4 file says about its measurement, by name: device, session, author, the program that wrote it.
    #[getter]
    fn properties(&self) -> BTreeMap<String, String> {
        self.now().properties
    }

    /// The reports of the single files, if there were several.
    #[getter]
    fn files(&self) -> Vec<Self> {
        self.now().files.into_iter().map(|counts| Self(Arc::new(Mutex::new(counts)))).collect()
    }

    /// The percentage of the file's entries that could not be read or were left out.
    #[getter]
    fn missing_pct(&self) -> f64 {
        self.now().missing_pct()
    }

    /// Whether the file was read to its end and nothing of it is missing.
    #[getter]
    fn is_whole(&self) -> bool {
        let counts = self.now();
        counts.is_whole && counts.issues == 0
    }

    /// Everything as a dictionary.
    fn to_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let counts = self.now();
        let mut object = serde_json::to_value(&counts).unwrap_or_default();
        object["missing_pct"] = counts.missing_pct().into();
        object["is_whole"] = self.is_whole().into();
        object["channels"] = self.channels().into();
        let files: Vec<_> = self.now().files.into_iter().map(|file| file.file).collect();
        object["files"] = files.into();
        from_json(py, &object.to_string())
    }

    fn __repr__(&self) -> String {
        let Counts { file, format, records, frames, lost, issues, .. } = self.now();
        let state = if self.is_whole() { "whole" } else { "not whole" };
        format!(
            "<cantap.Report of {file} ({format}): {records}, {frames}, {lost} lost, {issues} issues, {state}>",
            records = counted(records, "record"),
            frames = counted(frames, "frame")
        )
    }

    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (String,))> {
        let make = py.get_type::<Self>().getattr("_from_json")?.unbind();
        Ok((make, (serde_json::to_string(&self.now()).unwrap_or_default(),)))
    }

    #[staticmethod]
    fn _from_json(text: &str) -> PyResult<Self> {
        let counts = serde_json::from_str(text);
        let counts: Counts =
            counts.map_err(|error| pyo3::exceptions::PyValueError::new_err(error.to_string()))?;
        Ok(Self(Arc::new(Mutex::new(counts))))
    }
}

/// The content of a JSON text, as Python objects.
pub fn from_json<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import("json")?.call_method1("loads", (text,))
}
