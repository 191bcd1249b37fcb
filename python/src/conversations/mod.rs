//! What the frames of a trace or a device mean by its protocols, as tables.

mod columns;

use std::path::PathBuf;
use std::str::FromStr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use arrow_array::RecordBatch;
use cantap_protocols::{Options as BusOptions, Protocol, Reader};
use cantap_trace::TraceRecord;
use cantap_work::bus_description::BusDescription;
use cantap_work::report::Reporter;
use pyo3::prelude::*;

use self::columns::Rows;
use crate::channels::Channels;
use crate::database::Database;
use crate::error::{Error, of_database_file};
use crate::number::entry;
use crate::report::Report;
use crate::scan::warning;
use crate::source::Options;
use crate::table::{Table, batches_of};
use crate::traces::{each_part, walk};

/// What to read, as passed by the Python half.
pub struct WantedEvents {
    bus: BusOptions,
    rows: Rows,
    faults: bool,
    /// What of the files is not understood.
    notes: Vec<String>,
}

fn parsed<T: FromStr<Err: ToString>>(options: Borrowed<'_, '_, PyAny>, name: &str) -> PyResult<Vec<T>> {
    let texts: Vec<String> = entry(options, name, name)?;
    let values = texts.iter().map(|text| text.parse()).collect::<Result<_, T::Err>>();
    Ok(values.map_err(|error| Error::argument(format!("{name}: {}", error.to_string())))?)
}

impl<'py> FromPyObject<'_, 'py> for WantedEvents {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let (a2l, dsdl): (Vec<PathBuf>, Vec<PathBuf>) =
            (entry(object, "a2l", "a2l")?, entry(object, "dsdl", "dsdl")?);
        let (pairs, sheets, odx) = (parsed(object, "pair")?, parsed(object, "eds")?, parsed(object, "odx")?);
        let (xcp, ccp, subjects) =
            (parsed(object, "xcp")?, parsed(object, "ccp")?, parsed(object, "subject")?);
        let description = BusDescription {
            pairs: &pairs,
            sheets: &sheets,
            odx: &odx,
            a2l: &a2l,
            xcp: &xcp,
            ccp: &ccp,
            dsdl: &dsdl,
            subjects: &subjects,
        };
        let notes = Arc::new(Mutex::new(Vec::new()));
        let kept = Arc::clone(&notes);
        let reporter = Reporter::new(move |_, text| {
            kept.lock().unwrap_or_else(PoisonError::into_inner).push(text.to_owned());
        });
        let bus = description.options(&reporter).map_err(of_database_file)?;
        let database: Option<Py<Database>> = entry(object, "db", "db")?;
        let decoder = database.map(|database| Arc::clone(&database.get().decoder));
        let protocols: Vec<Protocol> = parsed(object, "protocol")?;
        let fields: Vec<String> = entry(object, "fields", "fields")?;
        let notes = notes.lock().unwrap_or_else(PoisonError::into_inner).clone();
        Ok(Self {
            bus: BusOptions { protocols, decoder, ..bus },
            rows: Rows::new(&fields)?,
            faults: entry(object, "faults", "faults")?,
            notes,
        })
    }
}

/// Records in, what they say out.
#[pyclass(module = "cantap", frozen)]
pub struct Conversations {
    /// `None` after the end.
    state: Mutex<Option<State>>,
}

struct State {
    reader: Reader,
    rows: Rows,
    batches: Vec<RecordBatch>,
    only_faults: bool,
    /// Without any given, they are looked for.
    is_looking: bool,
    /// How many events there were.
    events: u64,
    channels: Channels,
}

impl State {
    fn take(&mut self, records: &[TraceRecord], more: bool) {
        self.channels.extend(records.iter().map(|record| record.channel));
        let (rows, batches) = (&mut self.rows, &mut self.batches);
        let Ok(()) = self.reader.take(records, more, |read| {
            if let cantap_protocols::ReadItem::Event(event) = read {
                if !self.only_faults || event.is_fault() {
                    rows.push(self.events, &event);
                    batches.extend(rows.take_full());
                }
                self.events += 1;
            }
            Ok::<_, std::convert::Infallible>(())
        });
    }

    /// The rows so far.
    fn table(&mut self, report: Option<Py<Report>>) -> Table {
        let mut batches = std::mem::take(&mut self.batches);
        batches.push(self.rows.take());
        Table::new(self.rows.schema(), batches, report)
    }

    /// Reports at the end what was looked for in vain.
    fn warn(&self, py: Python<'_>) -> PyResult<()> {
        if self.is_looking && self.events == 0 && self.channels.iter().next().is_some() {
            return warning(
                py,
                "nothing that a protocol explains was found; name one, as with protocol=\"j1939\", to read everything by it",
            );
        }
        match self.rows.unmatched().as_slice() {
            [] => Ok(()),
            names => {
                warning(py, &format!("nothing had {}; fields=\"*\" shows what there is", names.join(", ")))
            }
        }
    }
}

fn ended() -> Error {
    Error::argument("these conversations are at their end; begin others")
}

#[pymethods]
impl Conversations {
    #[new]
    fn new(py: Python<'_>, wanted: WantedEvents) -> PyResult<Self> {
        for note in &wanted.notes {
            warning(py, note)?;
        }
        let WantedEvents { bus, rows, faults, .. } = wanted;
        let state = State {
            is_looking: bus.protocols.is_empty(),
            reader: Reader::new(bus),
            rows,
            batches: Vec::new(),
            only_faults: faults,
            events: 0,
            channels: Channels::default(),
        };
        Ok(Self { state: Mutex::new(Some(state)) })
    }

    /// What a trace says, from its beginning to its end.
    fn read(&self, py: Python<'_>, options: Options) -> PyResult<Table> {
        let mut state = self.state().take().ok_or_else(ended)?;
        let report = Report::default();
        walk(py, &options, &report, |records| {
            state.take(records, true);
            Ok(())
        })?;
        py.detach(|| state.take(&[], false));
        state.warn(py)?;
        Ok(state.table(Some(Py::new(py, report)?)))
    }

    /// What the records of a table complete; with `more` others follow.
    fn take(&self, py: Python<'_>, table: &Bound<'_, PyAny>, more: bool) -> PyResult<Table> {
        let mut state = self.state().take().ok_or_else(ended)?;
        let mut rows = 0;
        for batch in batches_of(table)? {
            py.detach(|| {
                each_part(batch, &mut rows, |records| {
                    state.take(records, true);
                    Ok(())
                })
            })?;
            py.check_signals()?;
        }
        if more {
            let table = state.table(None);
            *self.state() = Some(state);
            return Ok(table);
        }
        py.detach(|| state.take(&[], false));
        state.warn(py)?;
        Ok(state.table(None))
    }

    /// What was in progress at the end.
    fn finish(&self, py: Python<'_>) -> PyResult<Table> {
        let mut state = self.state().take().ok_or_else(ended)?;
        py.detach(|| state.take(&[], false));
        state.warn(py)?;
        Ok(state.table(None))
    }
}

impl Conversations {
    fn state(&self) -> MutexGuard<'_, Option<State>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
