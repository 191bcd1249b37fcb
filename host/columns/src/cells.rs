//! Columns of any table as texts, for readers of tables that know what the columns mean but not their types.

use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type};
use arrow_array::{Array, RecordBatch};
use arrow_schema::DataType;

use crate::bad::BadColumns;
use crate::foreign::{data, numbers, texts_of, time, without_dictionary};

/// How the cells of a column are written as text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CellKind {
    /// A moment or a duration: seconds with nine digits behind the point.
    Time,
    /// A number in decimal digits; yes and no are 1 and 0.
    Number,
    /// Bytes in pairs of hexadecimal digits.
    Bytes,
    /// A text, as it is.
    Text,
}

impl CellKind {
    /// That of a column of this type; `None` if it is none that cells are made of, such as a structure.
    pub fn of(kind: &DataType) -> Option<Self> {
        Some(match kind {
            DataType::Timestamp(..) | DataType::Duration(_) => Self::Time,
            DataType::Boolean | DataType::Float32 | DataType::Float64 | DataType::Null => Self::Number,
            DataType::Binary
            | DataType::LargeBinary
            | DataType::BinaryView
            | DataType::FixedSizeBinary(_)
            | DataType::List(_)
            | DataType::LargeList(_)
            | DataType::FixedSizeList(..) => Self::Bytes,
            DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => Self::Text,
            DataType::Dictionary(_, of) => return Self::of(of),
            _ if kind.is_integer() => Self::Number,
            _ => return None,
        })
    }
}

/// The cells of a batch's column; `None` where there is nothing.
///
/// # Errors
/// If its type is not one of [`CellKind`], or a value is out of range.
pub fn cells(batch: &RecordBatch, column: usize) -> Result<Vec<Option<String>>, BadColumns> {
    let name = || batch.schema_ref().field(column).name().clone();
    let array = without_dictionary(batch.column(column))?;
    let array = array.as_ref();
    let bad_type = || BadColumns::Column {
        column: name(),
        wanted: "numbers, texts, times or bytes",
        found: format!("this one is {}", array.data_type()),
    };
    let found = match CellKind::of(array.data_type()).ok_or_else(bad_type)? {
        CellKind::Text => {
            let texts = texts_of(array).unwrap_or_default();
            return Ok(texts.into_iter().map(|text| text.map(str::to_owned)).collect());
        }
        CellKind::Time => time(array).map(|times| times.map(|times| seconds(times.as_ref()))),
        // Ours, which needs no conversion.
        CellKind::Bytes if *array.data_type() == DataType::Binary => Ok(Some(hex(array))),
        CellKind::Bytes => data(array).map(|bytes| bytes.map(|bytes| hex(bytes.as_ref()))),
        CellKind::Number => match array.data_type() {
            DataType::Float32 => Ok(Some(floats(array.as_primitive::<Float32Type>().iter()))),
            DataType::Float64 => Ok(Some(floats(array.as_primitive::<Float64Type>().iter()))),
            DataType::Boolean => {
                let one = |is: Option<bool>| is.map(|is| u8::from(is).to_string());
                Ok(Some(array.as_boolean().iter().map(one).collect()))
            }
            _ => numbers(array).map(|found| {
                found.map(|found| found.into_iter().map(|at| at.map(|at| at.to_string())).collect())
            }),
        },
    };
    found
        .map_err(|bad| BadColumns::Row { row: bad.row, what: format!("{}: {}", name(), bad.what) })?
        .ok_or_else(bad_type)
}

fn seconds(times: &dyn Array) -> Vec<Option<String>> {
    const NS_PER_S: u64 = 1_000_000_000;
    let text = |ns: i64| {
        let (sign, ns) = (if ns < 0 { "-" } else { "" }, ns.unsigned_abs());
        format!("{sign}{}.{:09}", ns / NS_PER_S, ns % NS_PER_S)
    };
    let times = times.as_primitive::<arrow_array::types::TimestampNanosecondType>();
    times.iter().map(|ns| ns.map(text)).collect()
}

fn hex(bytes: &dyn Array) -> Vec<Option<String>> {
    let digit = |bits: u8| char::from_digit(u32::from(bits), 16).unwrap_or_default().to_ascii_uppercase();
    let text = |bytes: &[u8]| bytes.iter().flat_map(|byte| [digit(byte >> 4), digit(byte & 15)]).collect();
    bytes.as_binary::<i32>().iter().map(|bytes| bytes.map(text)).collect()
}

/// "Not a number" is how programs say that there is none.
fn floats<N: Into<f64>>(numbers: impl Iterator<Item = Option<N>>) -> Vec<Option<String>> {
    let text = |number: f64| (!number.is_nan()).then(|| number.to_string());
    numbers.map(|number| number.and_then(|number| text(number.into()))).collect()
}
