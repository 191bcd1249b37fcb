//! Columns for NumPy: bytes of one type, and which rows have a value.

use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float64Type, Int8Type, Int32Type, TimestampNanosecondType, UInt8Type, UInt32Type, UInt64Type,
};
use arrow_array::{Array, ArrowPrimitiveType, BinaryArray, StringArray};
use arrow_schema::DataType;
use pyo3::prelude::*;
use pyo3::types::PyBytes;

use crate::error::Error;

/// NumPy's name of the type, bytes, a mask of rows without a value if there are any (of each byte, if rows have different lengths), texts
/// for the numbers if there are any, bytes per row.
pub type Parts<'py> =
    (&'static str, Bound<'py, PyBytes>, Option<Bound<'py, PyBytes>>, Option<Vec<String>>, usize);

/// A column's parts.
pub fn parts<'py>(py: Python<'py>, column: &dyn Array) -> Result<Parts<'py>, Error> {
    let mask = (column.null_count() > 0).then(|| {
        let missing: Vec<u8> = (0..column.len()).map(|row| u8::from(column.is_null(row))).collect();
        PyBytes::new(py, &missing)
    });
    let numbers = |kind, bytes: &[u8], size| Ok((kind, PyBytes::new(py, bytes), mask.clone(), None, size));
    match column.data_type() {
        DataType::Timestamp(..) => numbers("datetime64[ns]", &bytes::<TimestampNanosecondType>(column), 8),
        DataType::UInt8 => numbers("uint8", &bytes::<UInt8Type>(column), 1),
        DataType::UInt32 => numbers("uint32", &bytes::<UInt32Type>(column), 4),
        DataType::UInt64 => numbers("uint64", &bytes::<UInt64Type>(column), 8),
        DataType::Float64 => numbers("float64", &bytes::<Float64Type>(column), 8),
        DataType::Boolean => {
            let values: Vec<u8> = column.as_boolean().values().iter().map(u8::from).collect();
            numbers("bool", &values, 1)
        }
        DataType::Binary => {
            let (rows, missing, width) = padded(column.as_binary());
            let missing = missing.contains(&1).then(|| PyBytes::new(py, &missing));
            Ok(("uint8", PyBytes::new(py, &rows), missing, None, width))
        }
        DataType::Dictionary(key, _) => {
            let dictionary = column.as_any_dictionary();
            let texts: &StringArray = dictionary.values().as_string();
            let texts = texts.iter().map(|text| text.unwrap_or_default().to_owned()).collect();
            let (kind, bytes, size) = match **key {
                DataType::Int8 => ("int8", bytes::<Int8Type>(dictionary.keys()), 1),
                _ => ("int32", bytes::<Int32Type>(dictionary.keys()), 4),
            };
            Ok((kind, PyBytes::new(py, &bytes), mask, Some(texts), size))
        }
        DataType::Utf8 => {
            let texts: &StringArray = column.as_string();
            let texts = texts.iter().map(|text| text.unwrap_or_default().to_owned()).collect();
            let keys: Vec<u8> = (0..column.len() as i32).flat_map(i32::to_ne_bytes).collect();
            Ok(("int32", PyBytes::new(py, &keys), mask, Some(texts), 4))
        }
        other => Err(Error::Format(format!("a column of {other} is not supported by NumPy"))),
    }
}

fn bytes<T: ArrowPrimitiveType>(column: &dyn Array) -> Vec<u8> {
    let values = column.as_primitive::<T>();
    values.values().inner().as_slice().to_vec()
}

/// Rows of one width, padded with zeros; and 1 for each byte that is only there for that.
fn padded(column: &BinaryArray) -> (Vec<u8>, Vec<u8>, usize) {
    let width = column.iter().flatten().map(<[u8]>::len).max().unwrap_or(0);
    let (mut rows, mut missing) = (vec![0; width * column.len()], vec![1; width * column.len()]);
    for (row, bytes) in column.iter().enumerate() {
        let bytes = bytes.unwrap_or_default();
        let place = row * width..row * width + bytes.len();
        rows[place.clone()].copy_from_slice(bytes);
        missing[place].fill(0);
    }
    (rows, missing, width)
}
