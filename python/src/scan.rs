//! A trace as batches of columns.

use std::sync::{Arc, Mutex, PoisonError};

use arrow_array::{RecordBatch, RecordBatchReader};
use arrow_schema::{ArrowError, SchemaRef};
use cantap_columns::{FrameColumns, SignalColumns};
use cantap_signals::{Decoder, MessageRef, SignalValue};
use cantap_trace::{TraceFrame, TraceRecord};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyCapsule, PyTuple};

use crate::channels::Named;
use crate::error::{CantapWarning, Error};
use crate::number::Whole;
use crate::report::{Counts, Report};
use crate::source::{Options, TraceSource};
use crate::table::{Table, stream_capsule};

/// What the rows contain.
enum Columns {
    Frames(Box<FrameColumns>),
    Values { table: Box<SignalColumns>, decoder: Arc<Decoder>, values: Vec<SignalValue>, chosen: bool },
}

impl Columns {
    fn new(options: &Options) -> Result<Self, Error> {
        Ok(match options.decoder()? {
            None => Self::Frames(Box::default()),
            Some(decoder) => Self::Values {
                table: Box::new(SignalColumns::new(&decoder)),
                decoder,
                values: Vec::new(),
                chosen: !options.signals.is_empty(),
            },
        })
    }

    fn schema(&self) -> SchemaRef {
        match self {
            Self::Frames(_) => FrameColumns::schema(),
            Self::Values { table, .. } => table.schema(),
        }
    }

    fn rows(&self) -> usize {
        match self {
            Self::Frames(table) => table.rows(),
            Self::Values { table, .. } => table.rows(),
        }
    }

    fn take(&mut self) -> RecordBatch {
        match self {
            Self::Frames(table) => table.take(),
            Self::Values { table, .. } => table.take(),
        }
    }

    /// Appends a record; returns how many values it has, if it is a frame of a message.
    fn push(&mut self, record: &TraceRecord) -> Option<usize> {
        match self {
            Self::Frames(table) => {
                table.push(record);
                None
            }
            Self::Values { table, decoder, values, chosen } => {
                let Some(frame) = record.frame() else {
                    table.push_event(record);
                    return None;
                };
                let message = decode(decoder, record.channel, frame, values, *chosen)?;
                table.push_values(decoder, record, message, values);
                Some(values.len())
            }
        }
    }

    /// What [`Self::push`] would append.
    fn count(&mut self, record: &TraceRecord) -> Counted {
        let Self::Values { decoder, values, chosen, .. } = self else { return Counted::Row };
        let Some(frame) = record.frame() else { return Counted::Row };
        match decode(decoder, record.channel, frame, values, *chosen) {
            Some(_) => Counted::Values(values.len() as u64),
            None => Counted::Nothing,
        }
    }
}

/// The rows of a record.
enum Counted {
    /// One for the record itself.
    Row,
    /// One for each value of a frame of a message.
    Values(u64),
    /// A frame that no database has.
    Nothing,
}

/// A frame's values. With chosen signals only, a message without any of them is not counted.
fn decode(
    decoder: &Decoder,
    channel: u8,
    frame: &TraceFrame,
    values: &mut Vec<SignalValue>,
    chosen: bool,
) -> Option<MessageRef> {
    let message = decoder.decode(channel, frame, values)?;
    (!values.is_empty() || !chosen).then_some(message)
}

/// Turns records into batches.
pub struct Pipeline {
    source: TraceSource,
    columns: Columns,
    /// Records read but not yet in a batch; those before `at` are.
    waiting: Vec<TraceRecord>,
    at: usize,
    batch_rows: usize,
    ended: bool,
}

impl Pipeline {
    fn open(options: &Options, batch_rows: usize, report: Report) -> Result<Self, Error> {
        if batch_rows == 0 {
            return Err(Error::argument("a batch has at least one row"));
        }
        let columns = Columns::new(options)?;
        let source = TraceSource::open(options, report)?;
        Ok(Self { source, columns, waiting: Vec::new(), at: 0, batch_rows, ended: false })
    }

    /// How many rows the rest has, which costs much less than making them.
    fn count(&mut self) -> Result<u64, Error> {
        let mut rows = 0;
        while !self.ended {
            for record in &self.waiting[self.at..] {
                rows += match self.columns.count(record) {
                    Counted::Values(values) => {
                        self.source.counts.decoded += 1;
                        self.source.counts.values += values;
                        values
                    }
                    Counted::Row => 1,
                    Counted::Nothing => 0,
                };
            }
            self.at = 0;
            self.ended = !self.source.next_batch(&mut self.waiting)?;
        }
        self.source.tell();
        Ok(rows)
    }

    /// The next batch: with as many rows as requested, or up to one frame's values more; fewer at the end.
    fn next(&mut self) -> Result<Option<RecordBatch>, Error> {
        while !self.ended {
            if self.at == self.waiting.len() {
                self.at = 0;
                self.ended = !self.source.next_batch(&mut self.waiting)?;
                continue;
            }
            while self.at < self.waiting.len() && self.columns.rows() < self.batch_rows {
                if let Some(values) = self.columns.push(&self.waiting[self.at]) {
                    self.source.counts.decoded += 1;
                    self.source.counts.values += values as u64;
                }
                self.at += 1;
            }
            if self.columns.rows() >= self.batch_rows {
                break;
            }
        }
        self.source.tell();
        let is_last = self.columns.rows() == 0;
        Ok((!is_last).then(|| self.columns.take()))
    }
}

/// A trace being read, batch by batch: memory does not grow with the file.
#[pyclass(module = "cantap", frozen)]
pub struct Scan {
    schema: SchemaRef,
    /// With a database.
    decodes: bool,
    report: Py<Report>,
    named: Vec<Named>,
    state: Mutex<State>,
}

/// The state of a scan.
enum State {
    /// Between two batches.
    Ready(Box<Pipeline>),
    /// A thread is making a batch.
    Busy,
    /// At its end, closed, or handed over.
    Ended,
}

/// Reports what could not be read, files without a record, and channels that were named although the file does not have them, as Python
/// warnings.
pub fn warn(py: Python<'_>, report: &Report, named: &[Named]) -> PyResult<()> {
    warnings(&report.now(), named).try_for_each(|text| warning(py, &text))
}

fn warnings(counts: &Counts, named: &[Named]) -> impl Iterator<Item = String> {
    let missing = |named: &Named| named.missing_in(&counts.file, &counts.channels);
    let of_file = counts.warning().into_iter().chain(counts.without_record());
    of_file.chain(named.iter().filter_map(missing))
}

/// Issues a Python warning for the caller of the function in Python's half.
pub fn warning(py: Python<'_>, text: &str) -> PyResult<()> {
    let text = std::ffi::CString::new(text.replace('\0', " "))?;
    PyErr::warn(py, &py.get_type::<CantapWarning>(), &text, 2)
}

/// Reports that a database has none of the frames, as a Python warning: it is likely to be another bus's.
pub fn warn_if_nothing_decoded(py: Python<'_>, report: &Report) -> PyResult<()> {
    match report.now().nothing_decoded() {
        Some(text) => warning(py, &text),
        None => Ok(()),
    }
}

impl Scan {
    /// Takes the pipeline; `None` at the end.
    fn take(&self) -> PyResult<Option<Box<Pipeline>>> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        match std::mem::replace(&mut *state, State::Busy) {
            State::Ready(pipeline) => Ok(Some(pipeline)),
            State::Busy => Err(PyRuntimeError::new_err(
                "another thread is reading this scan; give each thread one of its own",
            )),
            State::Ended => {
                *state = State::Ended;
                Ok(None)
            }
        }
    }

    fn put_back(&self, state: State) {
        *self.state.lock().unwrap_or_else(PoisonError::into_inner) = state;
    }

    fn next_batch(&self, py: Python<'_>) -> PyResult<Option<RecordBatch>> {
        let Some(mut pipeline) = self.take()? else { return Ok(None) };
        let batch = py.detach(|| {
            let batch = pipeline.next();
            // After an error, and at the end, the file is closed.
            self.put_back(if matches!(batch, Ok(Some(_))) { State::Ready(pipeline) } else { State::Ended });
            batch
        })?;
        if batch.is_none() {
            warn(py, self.report.get(), &self.named)?;
            if self.decodes {
                warn_if_nothing_decoded(py, self.report.get())?;
            }
        }
        Ok(batch)
    }
}

#[pymethods]
impl Scan {
    #[new]
    fn new(py: Python<'_>, options: Options, batch_rows: Whole<usize>) -> PyResult<Self> {
        let report = Report::default();
        let for_pipeline = report.clone();
        let pipeline = py.detach(|| Pipeline::open(&options, batch_rows.0, for_pipeline))?;
        let schema = pipeline.columns.schema();
        let decodes = options.db.is_some();
        Ok(Self {
            schema,
            decodes,
            report: Py::new(py, report)?,
            named: options.named_channels(),
            state: Mutex::new(State::Ready(Box::new(pipeline))),
        })
    }

    /// What was read so far, and what could not be read.
    #[getter]
    fn report(&self, py: Python<'_>) -> Py<Report> {
        self.report.clone_ref(py)
    }

    /// The columns' names, in order.
    #[getter]
    fn column_names<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, self.schema.fields().iter().map(|field| field.name()))
    }

    /// The rest, as one table.
    fn read_all(&self, py: Python<'_>) -> PyResult<Table> {
        let mut batches = Vec::new();
        while let Some(batch) = self.next_batch(py)? {
            batches.push(batch);
            py.check_signals()?;
        }
        Ok(Table::new(Arc::clone(&self.schema), batches, Some(self.report.clone_ref(py))))
    }

    /// How many rows the rest has; they are not made.
    fn _count(&self, py: Python<'_>) -> PyResult<u64> {
        let Some(mut pipeline) = self.take()? else { return Ok(0) };
        let rows = py.detach(|| {
            let rows = pipeline.count();
            self.put_back(State::Ended);
            rows
        })?;
        warn(py, self.report.get(), &self.named)?;
        Ok(rows)
    }

    /// Closes the file.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        let pipeline = self.take()?;
        self.put_back(State::Ended);
        py.detach(|| drop(pipeline));
        Ok(())
    }

    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Table>> {
        Ok(self.next_batch(py)?.map(Table::of_batch))
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_args))]
    fn __exit__(&self, py: Python<'_>, _args: &Bound<'_, PyTuple>) -> PyResult<()> {
        self.close(py)
    }

    fn __repr__(&self) -> String {
        let Counts { file, format, .. } = self.report.get().now();
        format!("<cantap.Scan of {file} ({format})>")
    }

    fn __arrow_c_schema__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyCapsule>> {
        crate::table::schema_capsule(py, &self.schema)
    }

    #[pyo3(signature = (requested_schema=None))]
    fn __arrow_c_stream__<'py>(
        &self,
        py: Python<'py>,
        requested_schema: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyCapsule>> {
        drop(requested_schema);
        let Some(pipeline) = self.take()? else {
            return Err(PyRuntimeError::new_err("this scan is at its end, or was taken; begin another one"));
        };
        self.put_back(State::Ended);
        stream_capsule(
            py,
            Box::new(Stream {
                pipeline,
                decodes: self.decodes,
                schema: Arc::clone(&self.schema),
                named: self.named.clone(),
                ended: false,
            }),
        )
    }
}

/// The rest of a scan, handed over to a consumer.
struct Stream {
    pipeline: Box<Pipeline>,
    decodes: bool,
    schema: SchemaRef,
    named: Vec<Named>,
    ended: bool,
}

impl Iterator for Stream {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        match self.pipeline.next() {
            Ok(Some(batch)) => Some(Ok(batch)),
            Ok(None) => {
                self.ended = true;
                // The caller may not hold Python's lock, so a Python warning is impossible.
                let counts = self.pipeline.source.all_counts();
                let nothing = self.decodes.then(|| counts.nothing_decoded()).flatten();
                for text in warnings(&counts, &self.named).chain(nothing) {
                    eprintln!("cantap: {text}");
                }
                None
            }
            Err(error) => {
                self.ended = true;
                Some(Err(ArrowError::ExternalError(Box::new(error))))
            }
        }
    }
}

impl RecordBatchReader for Stream {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
