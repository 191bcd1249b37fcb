//! Numbers and other arguments from Python. What is out of range is a `ValueError`, and what has a wrong type a `TypeError` that says
//! which argument it was. What users write in the command's grammar is in [`crate::grammar`].

use pyo3::exceptions::{PyOverflowError, PyTypeError, PyValueError};
use pyo3::prelude::*;

/// A whole number in the range of its type.
#[derive(Clone, Copy)]
pub struct Whole<T>(pub T);

/// A type of whole numbers, with its range.
pub trait Ranged {
    /// The range in words.
    fn range() -> String;
}

macro_rules! ranged {
    ($($number:ty),+) => {$(
        impl Ranged for $number {
            fn range() -> String {
                format!("{} to {}", Self::MIN, Self::MAX)
            }
        }
    )+};
}

ranged!(u8, u16, u32, u64, usize, i64);

impl<'a, 'py, T> FromPyObject<'a, 'py> for Whole<T>
where
    T: FromPyObject<'a, 'py, Error = PyErr> + Ranged,
{
    type Error = PyErr;

    fn extract(object: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        object.extract::<T>().map(Self).map_err(|error| {
            if error.is_instance_of::<PyOverflowError>(object.py()) {
                PyValueError::new_err(format!("{} is out of range: give {}", short(object), T::range()))
            } else {
                error
            }
        })
    }
}

/// A number in words, unless it has too many digits for a message.
pub fn short(object: Borrowed<'_, '_, PyAny>) -> String {
    object
        .str()
        .map(|text| text.to_string())
        .ok()
        .filter(|text| text.len() <= 40)
        .unwrap_or_else(|| "this number".to_owned())
}

/// An entry of a dictionary that Python's half made of a function's arguments. An error says which it was.
pub fn entry<'py, T>(options: Borrowed<'_, 'py, PyAny>, key: &str, argument: &str) -> PyResult<T>
where
    T: for<'a> FromPyObject<'a, 'py>,
{
    let value = options.get_item(key)?;
    value.extract().map_err(|error: <T as FromPyObject<'_, 'py>>::Error| {
        let (error, py): (PyErr, _) = (error.into(), options.py());
        let words = format!("{argument}: {}", error.value(py));
        if error.is_instance_of::<PyTypeError>(py) {
            PyTypeError::new_err(words)
        } else if error.is_instance_of::<PyValueError>(py) {
            PyValueError::new_err(words)
        } else {
            error
        }
    })
}
