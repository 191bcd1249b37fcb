//! Columns for Python without NumPy: their values as a list, and their types by name.

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, TimestampNanosecondType, UInt8Type, UInt32Type, UInt64Type};
use arrow_array::{Array, ArrowPrimitiveType, StringArray};
use arrow_schema::DataType;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyList};

use crate::error::Error;

/// A column's type, as docs/columns.md calls it.
pub fn type_name(kind: &DataType) -> String {
    match kind {
        DataType::Timestamp(..) => "timestamp[ns, UTC]".to_owned(),
        DataType::Dictionary(..) | DataType::Utf8 => "text".to_owned(),
        DataType::Boolean => "bool".to_owned(),
        other => other.to_string().to_lowercase(),
    }
}

/// A column's values; `None` where there is none. Times are nanoseconds.
pub fn values<'py>(py: Python<'py>, column: &dyn Array) -> PyResult<Bound<'py, PyList>> {
    fn numbers<'py, T>(py: Python<'py>, column: &dyn Array) -> PyResult<Bound<'py, PyList>>
    where
        T: ArrowPrimitiveType,
        T::Native: IntoPyObject<'py>,
    {
        PyList::new(py, column.as_primitive::<T>().iter())
    }
    match column.data_type() {
        DataType::Timestamp(..) => numbers::<TimestampNanosecondType>(py, column),
        DataType::UInt8 => numbers::<UInt8Type>(py, column),
        DataType::UInt32 => numbers::<UInt32Type>(py, column),
        DataType::UInt64 => numbers::<UInt64Type>(py, column),
        DataType::Float64 => numbers::<Float64Type>(py, column),
        DataType::Boolean => PyList::new(py, column.as_boolean().iter()),
        DataType::Binary => {
            let bytes = column.as_binary::<i32>().iter();
            PyList::new(py, bytes.map(|bytes| bytes.map(|bytes| PyBytes::new(py, bytes))).collect::<Vec<_>>())
        }
        DataType::Dictionary(..) => {
            let dictionary = column.as_any_dictionary();
            let texts: &StringArray = dictionary.values().as_string();
            // There are no texts if no row has one.
            let keys = if texts.is_empty() { vec![0; column.len()] } else { dictionary.normalized_keys() };
            let text = |(row, key): (usize, &usize)| column.is_valid(row).then(|| texts.value(*key));
            PyList::new(py, keys.iter().enumerate().map(text).collect::<Vec<_>>())
        }
        DataType::Utf8 => PyList::new(py, column.as_string::<i32>().iter()),
        other => Err(Error::Format(format!("a column of {other} has no values for Python")).into()),
    }
}
