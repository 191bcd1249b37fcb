//! Signal databases.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;

use cantap_columns::MessageColumns;
use cantap_signals::{Decoder, Selection, Source};
use cantap_trace::counted;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::channels::Named;
use crate::error::Error;
use crate::frame::Frame;
use crate::grammar::OfTrace;
use crate::selection::{only, selection};
use crate::table::Table;

/// Compiled databases: loaded once, used for any number of traces, devices and frames, in any thread.
#[pyclass(module = "cantap", frozen)]
pub struct Database {
    pub decoder: Arc<Decoder>,
    /// The files, for pickling.
    files: Vec<(Option<u8>, PathBuf)>,
    is_j1939: bool,
    warnings: Vec<String>,
}

impl Database {
    /// The channels that have a database of their own.
    pub fn named_channels(&self) -> Option<Named> {
        Named::by("db", self.files.iter().filter_map(|(channel, _)| *channel))
    }

    /// A decoder for these signals only; for all if there are no patterns.
    pub fn selecting(&self, patterns: &[String]) -> Result<Arc<Decoder>, Error> {
        if patterns.is_empty() {
            return Ok(Arc::clone(&self.decoder));
        }
        let mut decoder = (*self.decoder).clone();
        decoder.select(&Selection::new(patterns)?)?;
        Ok(Arc::new(decoder))
    }
}

#[pymethods]
impl Database {
    #[new]
    fn new(files: Vec<(Option<OfTrace>, PathBuf)>, j1939: bool) -> PyResult<Self> {
        let files: Vec<_> =
            files.into_iter().map(|(channel, path)| (channel.map(|channel| channel.0), path)).collect();
        if files.is_empty() {
            return Err(Error::argument("no database is given; name at least one file").into());
        }
        let mut sources = Vec::new();
        let mut warnings = Vec::new();
        for (channel, path) in &files {
            let database = cantap_signals::load(path).map_err(Error::from)?;
            warnings.extend(database.warnings.iter().map(|fault| format!("{}: {fault}", database.file)));
            sources.push(Source { channel: *channel, database });
        }
        let mut decoder = Decoder::new(sources);
        if j1939 {
            decoder.assume_j1939();
        }
        for replaced in decoder.overrides() {
            let (file, by, count) = (&replaced.file, &replaced.by, replaced.messages.len());
            warnings.push(format!(
                "{by} replaces {count} of {file}'s messages, such as {}",
                replaced.messages[0]
            ));
        }
        Ok(Self { decoder: Arc::new(decoder), files, is_j1939: j1939, warnings })
    }

    /// The virtual car's database.
    #[staticmethod]
    fn of_virtual_car() -> PyResult<Self> {
        let database = cantap_virtual::car::database().map_err(Error::from)?;
        let decoder = Decoder::new(vec![Source { channel: None, database }]);
        Ok(Self { decoder: Arc::new(decoder), files: Vec::new(), is_j1939: false, warnings: Vec::new() })
    }

    /// What is wrong with the files although they are usable.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.warnings.clone()
    }

    /// The names of all messages.
    #[getter]
    fn message_names(&self) -> Vec<String> {
        self.decoder.messages().map(|(_, _, message)| message.name.clone()).collect()
    }

    /// The signals of a message: name, unit and description of each.
    fn signals_of<'py>(&self, py: Python<'py>, message: &str) -> PyResult<Vec<Bound<'py, PyDict>>> {
        let found = self.decoder.messages().find(|(_, _, known)| known.name == message);
        let Some((_, _, found)) = found else {
            return Err(Error::Database(format!("the database has no message '{message}'")).into());
        };
        found
            .signals
            .iter()
            .map(|signal| {
                let about = PyDict::new(py);
                about.set_item("name", signal.label())?;
                about.set_item("unit", &signal.unit)?;
                about.set_item("description", &signal.description)?;
                Ok(about)
            })
            .collect()
    }

    /// A message's table without rows, with these signals.
    fn _schema_of(&self, message: &str, signals: Vec<String>) -> PyResult<Table> {
        let decoder = self.selecting(&signals)?;
        let found = decoder.messages().find(|(_, _, known)| known.name == message);
        let Some((reference, _, found)) = found else {
            return Err(Error::Database(format!("the database has no message '{message}'")).into());
        };
        let batch = MessageColumns::new(&decoder, reference).take();
        Ok(Table::of_batch(match selection(&signals)? {
            Some(chosen) => only(&batch, found, &chosen),
            None => batch,
        }))
    }

    /// The names of all signals.
    fn _signal_names(&self) -> HashSet<String> {
        self.decoder.signals().map(|(_, _, signal)| signal.label().into_owned()).collect()
    }

    /// The frame of a message with these values.
    #[pyo3(signature = (message, signals=None, *, channel=None))]
    fn encode(
        &self,
        message: &str,
        signals: Option<&Bound<'_, PyDict>>,
        channel: Option<OfTrace>,
    ) -> PyResult<Frame> {
        self.frame(message, signals, channel)
    }

    /// The message of a frame, and its values; `None` if no database has it.
    #[pyo3(signature = (frame, *, channel=OfTrace(1)))]
    fn decode<'py>(
        &self,
        py: Python<'py>,
        frame: &Bound<'py, PyAny>,
        channel: OfTrace,
    ) -> PyResult<Option<(String, Bound<'py, PyDict>)>> {
        self.values(py, frame, channel)
    }

    fn __repr__(&self) -> String {
        let files: Vec<_> = self.files.iter().map(|(_, path)| path.display().to_string()).collect();
        let files = if files.is_empty() { "the virtual car".to_owned() } else { files.join(", ") };
        format!("<cantap.Database of {files}: {}>", counted(self.decoder.messages().count(), "message"))
    }

    #[expect(clippy::type_complexity, reason = "what pickle wants")]
    fn __reduce__(&self, py: Python<'_>) -> PyResult<(Py<PyAny>, (Vec<(Option<u8>, PathBuf)>, bool))> {
        if self.files.is_empty() {
            let make = py.get_type::<Self>().getattr("_of_virtual_car")?.unbind();
            return Ok((make, (Vec::new(), false)));
        }
        Ok((py.get_type::<Self>().into_any().unbind(), (self.files.clone(), self.is_j1939)))
    }

    #[staticmethod]
    fn _of_virtual_car(_files: Vec<(Option<u8>, PathBuf)>, _j1939: bool) -> PyResult<Self> {
        Self::of_virtual_car()
    }
}
