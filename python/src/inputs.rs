//! Where a trace comes from: a file of the system, or an object of Python that can be read like one.

use std::io::{self, Read};
use std::path::PathBuf;

use cantap_formats::time_range::TimeRange;
use cantap_formats::{OpenError, ReadOptions, TraceReader, open_reader, open_source};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;

use crate::error::Error;

/// Read from Python's objects at a time: a call costs as much as a hundred frames.
const CHUNK_BYTES: usize = 1 << 20;

/// One of the files of a trace.
pub enum TraceFile {
    /// In the file system.
    Path(PathBuf),
    /// Opened by Python, when it is its turn: the file's name, and a function that returns an object with `read`.
    Opened { name: String, open: Py<PyAny> },
}

impl<'py> FromPyObject<'_, 'py> for TraceFile {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        if let Ok((name, open)) = object.extract::<(String, Py<PyAny>)>() {
            return Ok(Self::Opened { name, open });
        }
        object.extract().map(Self::Path)
    }
}

impl TraceFile {
    /// As messages call it.
    pub fn name(&self) -> String {
        match self {
            Self::Path(path) => path.display().to_string(),
            Self::Opened { name, .. } => name.clone(),
        }
    }

    /// Opens it, to read what is in a range.
    pub fn open(&self, options: &ReadOptions, range: &mut TimeRange) -> Result<TraceReader, Error> {
        let opened = match self {
            Self::Path(path) => open_reader(path, options),
            Self::Opened { name, open } => open_source(name, PythonFile::open(open)?, options),
        };
        let mut reader = opened.map_err(Error::from)?;
        reader.within(range).map_err(|error| OpenError::Io(self.name(), error))?;
        Ok(reader)
    }
}

/// An object of Python that has the bytes of a file.
struct PythonFile {
    read: Py<PyAny>,
    close: Option<Py<PyAny>>,
    chunk: Option<PyBackedBytes>,
    at: usize,
}

impl PythonFile {
    fn open(open: &Py<PyAny>) -> Result<Self, Error> {
        Python::attach(|py| {
            let file = open.bind(py).call0()?;
            let read = file.getattr("read").map_err(|_| {
                PyTypeError::new_err(
                    "a file object is one that was opened for reading bytes: open(path, 'rb')",
                )
            })?;
            let close = file.getattr_opt("close")?.map(Bound::unbind);
            Ok::<_, PyErr>(Self { read: read.unbind(), close, chunk: None, at: 0 })
        })
        .map_err(Error::Python)
    }

    /// Asks Python for the next bytes.
    fn refill(&mut self) -> io::Result<()> {
        let chunk = Python::try_attach(|py| -> PyResult<PyBackedBytes> {
            let chunk = self.read.bind(py).call1((CHUNK_BYTES,))?;
            chunk.extract().map_err(|_| {
                let kind = chunk.get_type().name().map(|name| name.to_string()).unwrap_or_default();
                PyTypeError::new_err(format!(
                    "the file object returned {kind} instead of bytes; open the file with 'rb'"
                ))
            })
        });
        let chunk = chunk.ok_or_else(|| io::Error::other("Python is about to end"))?;
        self.chunk = Some(chunk.map_err(io::Error::other)?);
        self.at = 0;
        Ok(())
    }
}

impl Read for PythonFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.chunk.as_ref().is_none_or(|chunk| self.at >= chunk.len()) {
            self.refill()?;
        }
        let waiting = self.chunk.as_ref().map_or(&[][..], |chunk| &chunk[self.at..]);
        let count = waiting.len().min(buffer.len());
        buffer[..count].copy_from_slice(&waiting[..count]);
        self.at += count;
        Ok(count)
    }
}

impl Drop for PythonFile {
    fn drop(&mut self) {
        let Some(close) = self.close.take() else { return };
        // What was read is not worse for a file that cannot be closed.
        let _ = Python::try_attach(|py| close.bind(py).call0().map(drop));
    }
}
