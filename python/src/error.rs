//! What Python code catches.

use std::error::Error as _;
use std::io;
use std::path::Path;

use cantap::DeviceError as DeviceFault;
use cantap_address::LinkError;
use cantap_columns::BadColumns;
#[cfg(feature = "parquet")]
use cantap_columns::parquet::ParquetError;
use cantap_formats::{Fault, NothingRead, OpenError, ReadIssue};
use cantap_signals::condition::ConditionError;
use cantap_signals::encode::EncodeError;
use cantap_signals::{DatabaseError as DatabaseFault, SelectionError};
use pyo3::exceptions::{PyException, PyOSError, PyUserWarning, PyValueError};
use pyo3::prelude::*;

pyo3::create_exception!(cantap, CantapError, PyException, "The base of all errors of this package.");
pyo3::create_exception!(
    cantap,
    DeviceError,
    CantapError,
    "A device could not be opened, refused a request, or is gone."
);
pyo3::create_exception!(
    cantap,
    FormatError,
    CantapError,
    "A file is not a trace in a format that can be read or written."
);
pyo3::create_exception!(
    cantap,
    DatabaseError,
    CantapError,
    "A signal database cannot be used, or does not fit."
);
pyo3::create_exception!(
    cantap,
    CantapWarning,
    PyUserWarning,
    "Something was left out, and the rest can be used."
);

/// An error of this package's libraries.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file's error, with its name.
    #[error("{1}: {0}")]
    Io(#[source] io::Error, String),
    /// The file is not a trace in this format.
    #[error("{0}")]
    Format(String),
    /// A database's error.
    #[error("{0}")]
    Database(String),
    /// A device's error.
    #[error(transparent)]
    Device(#[from] DeviceFault),
    /// The device's address is wrong, or it cannot be reached.
    #[error("{0}")]
    Address(String),
    /// A wrong argument.
    #[error("{0}")]
    Argument(String),
    /// An exception raised by Python.
    #[error("{0}")]
    Python(#[from] PyErr),
}

impl Error {
    /// The system's error for a file.
    pub fn of_file(error: io::Error, path: &Path) -> Self {
        Self::Io(error, path.display().to_string())
    }

    /// A device that another process opened.
    pub fn other_process(address: &str) -> Self {
        Self::Address(format!(
            "'{address}' was opened by another process, before a fork; open it in the process that uses it"
        ))
    }

    /// A wrong argument, described in words.
    pub fn argument(words: impl ToString) -> Self {
        Self::Argument(words.to_string())
    }
}

/// The error of a file that describes something, as a database does.
pub fn of_database_file(error: anyhow::Error) -> Error {
    let (context, words) = (error.to_string(), format!("{error:#}"));
    match error.downcast::<io::Error>() {
        Ok(error) => Error::Io(error, context),
        Err(_) => Error::Database(words),
    }
}

/// The cause of an error, if its own message does not include it.
fn because(error: &LinkError) -> String {
    let cause = error.source().map(ToString::to_string);
    cause
        .filter(|cause| !error.to_string().contains(cause))
        .map(|cause| format!(": {cause}"))
        .unwrap_or_default()
}

impl From<LinkError> for Error {
    fn from(error: LinkError) -> Self {
        match error {
            LinkError::Device(error) => Self::Device(error),
            error => Self::Address(format!("{error}{}", because(&error))),
        }
    }
}

impl From<OpenError> for Error {
    fn from(error: OpenError) -> Self {
        match error {
            OpenError::Io(file, error) => Self::Io(error, file),
            error => Self::Format(error.to_string()),
        }
    }
}

impl From<ReadIssue> for Error {
    fn from(issue: ReadIssue) -> Self {
        match issue.fault {
            Fault::Io(error) => Self::Io(error, issue.file.to_string()),
            _ => Self::Format(issue.to_string()),
        }
    }
}

impl From<NothingRead> for Error {
    fn from(nothing: NothingRead) -> Self {
        Self::Format(nothing.to_string())
    }
}

impl From<BadColumns> for Error {
    fn from(error: BadColumns) -> Self {
        Self::Format(error.to_string())
    }
}

#[cfg(feature = "parquet")]
impl From<ParquetError> for Error {
    fn from(error: ParquetError) -> Self {
        Self::Format(error.to_string())
    }
}

impl From<DatabaseFault> for Error {
    fn from(error: DatabaseFault) -> Self {
        match error {
            DatabaseFault::Read { file, source } => Self::Io(source, file),
            error => Self::Database(error.to_string()),
        }
    }
}

impl From<SelectionError> for Error {
    fn from(error: SelectionError) -> Self {
        Self::Database(error.to_string())
    }
}

impl From<ConditionError> for Error {
    fn from(error: ConditionError) -> Self {
        Self::Argument(error.to_string())
    }
}

impl From<EncodeError> for Error {
    fn from(error: EncodeError) -> Self {
        Self::Database(error.to_string())
    }
}

impl From<Error> for PyErr {
    fn from(error: Error) -> Self {
        match error {
            // An object of Python that was read as a file raised it.
            Error::Io(error, file)
                if error.get_ref().is_some_and(<dyn std::error::Error + Send + Sync>::is::<PyErr>) =>
            {
                match error.downcast::<PyErr>() {
                    Ok(error) => error,
                    Err(error) => Error::Io(error, file).into(),
                }
            }
            // With number and name it becomes FileNotFoundError, PermissionError and so on.
            Error::Io(error, file) => match error.raw_os_error() {
                Some(number) => {
                    let text = error.to_string();
                    let text = text.split(" (os error").next().unwrap_or_default().to_owned();
                    PyOSError::new_err((number, text, file))
                }
                None if error.kind() == io::ErrorKind::Unsupported => FormatError::new_err(error.to_string()),
                None => PyOSError::new_err(format!("{file}: {error}")),
            },
            Error::Format(words) => FormatError::new_err(words),
            Error::Database(words) => DatabaseError::new_err(words),
            Error::Device(error) => DeviceError::new_err(error.to_string()),
            Error::Address(words) => DeviceError::new_err(words),
            Error::Argument(words) => PyValueError::new_err(words),
            Error::Python(error) => error,
        }
    }
}

/// Adds the exceptions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("CantapError", py.get_type::<CantapError>())?;
    module.add("DeviceError", py.get_type::<DeviceError>())?;
    module.add("FormatError", py.get_type::<FormatError>())?;
    module.add("DatabaseError", py.get_type::<DatabaseError>())?;
    module.add("CantapWarning", py.get_type::<CantapWarning>())
}
