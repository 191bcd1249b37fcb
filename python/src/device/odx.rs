//! Descriptions of ECUs (ODX), for Python.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use cantap_protocols::iso_tp::Pair;
use cantap_protocols::odx::{Descriptions, Ecu, Physical, Reading};
use cantap_trace::counted;
use cantap_work::odx::{OdxPath, load};
use cantap_work::report::Reporter;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use super::lock::lock;
use crate::error::Error;

/// What PDX packages and ODX documents say of ECUs: names of requests, and the values of their answers.
#[pyclass(module = "cantap", frozen)]
pub struct Odx {
    descriptions: Arc<Descriptions>,
    /// As given, for pickling.
    files: Vec<PathBuf>,
    warnings: Vec<String>,
}

impl Odx {
    fn ecu(&self, pair: &str) -> Result<&Ecu, Error> {
        let pair = pair.parse::<Pair>().map_err(Error::argument)?;
        self.descriptions.of(Some(pair.a), Some(pair.b)).map(|ecu| &**ecu).ok_or_else(|| {
            Error::argument(format!(
                "no ECU of the description has {pair}; give its identifiers, or say which layer is meant, as FILE:LAYER"
            ))
        })
    }
}

/// A value for Python.
fn value(py: Python<'_>, value: &Physical) -> PyResult<Py<PyAny>> {
    Ok(match value {
        Physical::Int(number) => number.into_pyobject(py)?.into_any().unbind(),
        Physical::Real(number) => number.into_pyobject(py)?.into_any().unbind(),
        Physical::Text(text) | Physical::Meaning(_, text) => text.into_pyobject(py)?.into_any().unbind(),
        Physical::Bytes(bytes) => PyBytes::new(py, bytes).into_any().unbind(),
    })
}

/// What of an answer has no value.
fn missing(reading: &Reading) -> Option<String> {
    if let Some((place, _)) = &reading.stop {
        return Some(if place.is_empty() { "its end".to_owned() } else { place.clone() });
    }
    let count = reading.undescribed.len();
    (count > 0).then(|| format!("{} that the description does not have", counted(count, "byte")))
}

#[pymethods]
impl Odx {
    #[new]
    fn new(py: Python<'_>, files: Vec<PathBuf>) -> PyResult<Self> {
        let paths = files.iter().map(|path| path.to_string_lossy().parse::<OdxPath>());
        let paths = paths.collect::<Result<Vec<_>, _>>().map_err(Error::argument)?;
        let heard = Arc::new(Mutex::new(Vec::new()));
        let notes = Arc::clone(&heard);
        let reporter = Reporter::new(move |_, text| lock(&notes).push(text.to_owned()));
        let loaded = py.detach(|| load(&paths, &reporter)).map_err(|error| {
            match error.downcast::<std::io::Error>() {
                Ok(error) => Error::Io(
                    error,
                    files.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", "),
                ),
                Err(error) => Error::Database(format!("{error:#}")),
            }
        })?;
        let descriptions =
            loaded.ok_or_else(|| Error::argument("no description is given; name at least one file"))?;
        let warnings = lock(&heard).clone();
        Ok(Self { descriptions, files, warnings })
    }

    /// What is not evaluated, in words.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.warnings.clone()
    }

    /// The ECUs: the name of each, and the pairs of its identifiers.
    #[getter]
    fn ecus(&self) -> Vec<(String, Vec<String>)> {
        let ecus = self.descriptions.ecus();
        ecus.iter()
            .map(|ecu| (ecu.name().to_owned(), ecu.pairs().iter().map(ToString::to_string).collect()))
            .collect()
    }

    /// The identifiers of its only ECU.
    fn _only_pair(&self) -> Option<String> {
        let mut pairs = self.descriptions.pairs();
        pairs.next().filter(|_| pairs.next().is_none()).map(|pair| pair.to_string())
    }

    /// The requests of an ECU by name: bytes, and what else whoever asks has to give.
    fn requests<'py>(&self, py: Python<'py>, pair: &str) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for request in self.ecu(pair)?.requests() {
            all.set_item(request.name, (PyBytes::new(py, &request.bytes), request.open))?;
        }
        Ok(all)
    }

    /// The bytes of the request with this name that begins with these.
    fn _request<'py>(
        &self,
        py: Python<'py>,
        pair: &str,
        name: &str,
        begins: Vec<u8>,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let request = self.ecu(pair)?.request(name, &begins).map_err(Error::argument)?;
        if !request.open.is_empty() {
            let words = format!("{name} also needs {}; give the request's bytes", request.open.join(", "));
            return Err(Error::argument(words).into());
        }
        Ok(PyBytes::new(py, &request.bytes))
    }

    /// What an answer says: its values by name, and what of it has none.
    fn _values<'py>(
        &self,
        py: Python<'py>,
        pair: &str,
        request: Vec<u8>,
        answer: Vec<u8>,
    ) -> PyResult<(Bound<'py, PyDict>, Option<String>)> {
        let described = self.ecu(pair)?.describe(Some(&request), Some(&answer));
        let reading = described.and_then(|described| described.response);
        let Some(reading) = reading else {
            return Ok((PyDict::new(py), Some("all of it".to_owned())));
        };
        let values = PyDict::new(py);
        for decoded in reading.values.iter().filter(|decoded| !decoded.is_constant) {
            values.set_item(&decoded.path, value(py, &decoded.value)?)?;
        }
        Ok((values, missing(&reading)))
    }

    fn __repr__(&self) -> String {
        let names: Vec<_> = self.descriptions.ecus().iter().map(|ecu| ecu.name().to_owned()).collect();
        format!("<cantap.Odx of {}>", names.join(", "))
    }

    fn __reduce__(&self, py: Python<'_>) -> (Py<PyAny>, (Vec<PathBuf>,)) {
        (py.get_type::<Self>().into_any().unbind(), (self.files.clone(),))
    }
}
