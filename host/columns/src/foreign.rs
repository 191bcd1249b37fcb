//! Tables that other programs made: their columns as ours.
//!
//! What is unambiguous is converted without a loss; anything else is an error that says what to give instead. What a column that is not
//! there stands for is said at [`crate::records`].

use std::ops::Range;
use std::sync::Arc;

use arrow_array::builder::BinaryBuilder;
use arrow_array::cast::AsArray;
use arrow_array::types::{
    ArrowPrimitiveType, DurationMicrosecondType, DurationMillisecondType, DurationNanosecondType,
    DurationSecondType, Float32Type, Float64Type, Int64Type, TimestampMicrosecondType,
    TimestampMillisecondType, TimestampNanosecondType, TimestampSecondType, UInt8Type, UInt32Type,
    UInt64Type,
};
use arrow_array::{
    Array, ArrayRef, BinaryArray, BooleanArray, PrimitiveArray, RecordBatch, StringArray, UInt8Array,
    downcast_integer_array, new_null_array,
};
use arrow_schema::{DataType, Field, Schema, TimeUnit};

use crate::bad::BadColumns;
use crate::frames::{FRAME, FrameColumns};

/// The batch with all columns of [`FrameColumns`], in types that are ours; texts may be plain. It is unchanged if it already is like that.
pub fn with_our_columns(batch: &RecordBatch) -> Result<RecordBatch, BadColumns> {
    let ours = FrameColumns::schema();
    let is_ours = |field: &Arc<Field>| {
        batch.column_by_name(field.name()).is_some_and(|column| column.data_type() == field.data_type())
    };
    if ours.fields().iter().all(is_ours) {
        return Ok(batch.clone());
    }
    let has_events = batch.column_by_name("event").is_some();
    let (mut fields, mut columns) = (Vec::new(), Vec::new());
    for field in ours.fields() {
        let name = field.name();
        let column: ArrayRef = match batch.column_by_name(name) {
            Some(column) => converted(column, name, field.data_type())?,
            None => missing(batch, name, field.data_type(), has_events)?,
        };
        fields.push(Field::new(name, column.data_type().clone(), true));
        columns.push(column);
    }
    Ok(RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)?)
}

/// What stands for a column that is not there.
fn missing(
    batch: &RecordBatch,
    name: &str,
    ours: &DataType,
    has_events: bool,
) -> Result<ArrayRef, BadColumns> {
    let rows = batch.num_rows();
    let wanted = match name {
        "time" => TIME,
        // Events other than frames have neither.
        "id" if !has_events => WHOLE,
        "data" if !has_events => DATA,
        "channel" => return Ok(Arc::new(UInt8Array::from_value(1, rows))),
        "event" => return Ok(Arc::new(StringArray::from_iter_values((0..rows).map(|_| FRAME)))),
        _ if *ours == DataType::Boolean => return Ok(Arc::new(BooleanArray::new_null(rows))),
        _ => return Ok(new_null_array(plain(ours), rows)),
    };
    let names: Vec<_> = batch.schema().fields().iter().map(|field| field.name().clone()).collect();
    let found = format!("there is none among {}", names.join(", "));
    Err(BadColumns::Column { column: name.to_owned(), wanted, found })
}

/// The type without a dictionary.
fn plain(kind: &DataType) -> &DataType {
    if let DataType::Dictionary(_, of) = kind { of } else { kind }
}

const TIME: &str = "a timestamp, or float64 with seconds";
const WHOLE: &str = "whole numbers";
const FLAG: &str = "bool";
const TEXT: &str = "text";
const DATA: &str = "binary, lists of bytes, or text with hexadecimal digits";

fn converted(column: &ArrayRef, name: &str, ours: &DataType) -> Result<ArrayRef, BadColumns> {
    if column.data_type() == ours {
        return Ok(Arc::clone(column));
    }
    let column = without_dictionary(column)?;
    let array = column.as_ref();
    let (wanted, result) = match plain(ours) {
        _ if *array.data_type() == DataType::Null => {
            return Ok(new_null_array(plain(ours), array.len()));
        }
        DataType::Timestamp(..) => (TIME, time(array)),
        DataType::Boolean => (FLAG, flags(array)),
        DataType::UInt8 => (WHOLE, whole::<UInt8Type>(array)),
        DataType::UInt32 => (WHOLE, whole::<UInt32Type>(array)),
        DataType::UInt64 => (WHOLE, whole::<UInt64Type>(array)),
        DataType::Binary => (DATA, data(array)),
        _ => (TEXT, Ok(texts(array))),
    };
    match result {
        Ok(Some(converted)) => Ok(converted),
        Ok(None) => Err(BadColumns::Column {
            column: name.to_owned(),
            wanted,
            found: format!("this one is {}", array.data_type()),
        }),
        Err(BadCell { row, what }) => Err(BadColumns::Row { row, what: format!("{name}: {what}") }),
    }
}

/// A value that cannot be taken.
pub struct BadCell {
    pub row: usize,
    pub what: String,
}

/// The column in our type; `None` if its own is none of those that are taken.
pub type Converted = Result<Option<ArrayRef>, BadCell>;

pub fn without_dictionary(column: &ArrayRef) -> Result<ArrayRef, BadColumns> {
    let Some(dictionary) = column.as_any_dictionary_opt() else { return Ok(Arc::clone(column)) };
    Ok(arrow_select::take::take(dictionary.values().as_ref(), dictionary.keys(), None)?)
}

/// Whole numbers, possibly in a floating-point column, where "not a number" is how programs say that there is none; texts only with
/// `0x`: without, nobody knows whether they are decimal.
pub fn numbers(array: &dyn Array) -> Result<Option<Vec<Option<i64>>>, BadCell> {
    if let Some(texts) = texts_of(array) {
        let number = |(row, text): (usize, Option<&str>)| {
            let Some(text) = text else { return Ok(None) };
            let digits = text.trim().strip_prefix("0x").or_else(|| text.trim().strip_prefix("0X"));
            let number = digits.and_then(|digits| i64::from_str_radix(digits, 16).ok());
            let what = || format!("'{text}' may be hexadecimal or decimal; write 0x123, or give numbers");
            number.map(Some).ok_or_else(|| BadCell { row, what: what() })
        };
        return texts.into_iter().enumerate().map(number).collect::<Result<_, _>>().map(Some);
    }
    let floats: Vec<Option<f64>> = match array.data_type() {
        DataType::Float32 => array.as_primitive::<Float32Type>().iter().map(|at| at.map(f64::from)).collect(),
        DataType::Float64 => array.as_primitive::<Float64Type>().iter().collect(),
        DataType::Null => return Ok(Some(vec![None; array.len()])),
        _ => {
            let all = downcast_integer_array!(
                array => array.iter().map(|at| at.map(signed)).collect(),
                _ => return Ok(None)
            );
            let all: Vec<Option<Result<i64, String>>> = all;
            let fitting = |(row, at): (usize, Option<Result<i64, String>>)| {
                at.transpose().map_err(|at| BadCell { row, what: format!("{at} is too large") })
            };
            return all.into_iter().enumerate().map(fitting).collect::<Result<_, _>>().map(Some);
        }
    };
    let number = |(row, at): (usize, Option<f64>)| match at {
        Some(at) if at.fract() == 0.0 && at.abs() < EXACT => Ok(Some(at as i64)),
        Some(at) if !at.is_nan() => Err(BadCell { row, what: format!("{at} is not a whole number") }),
        _ => Ok(None),
    };
    floats.into_iter().enumerate().map(number).collect::<Result<_, _>>().map(Some)
}

/// The number, or its text if it is too large.
fn signed<N: TryInto<i64> + Copy + ToString>(number: N) -> Result<i64, String> {
    number.try_into().map_err(|_| number.to_string())
}

/// Below it, floating-point numbers have every whole one.
const EXACT: f64 = 9_007_199_254_740_992.0;

fn whole<T: ArrowPrimitiveType<Native: TryFrom<i64>>>(array: &dyn Array) -> Converted {
    let Some(numbers) = numbers(array)? else { return Ok(None) };
    let fitting = |(row, number): (usize, Option<i64>)| {
        let Some(number) = number else { return Ok(None) };
        let fits = T::Native::try_from(number).ok();
        fits.map(Some).ok_or_else(|| BadCell { row, what: format!("{number} is out of range") })
    };
    let found: PrimitiveArray<T> = numbers.into_iter().enumerate().map(fitting).collect::<Result<_, _>>()?;
    Ok(Some(Arc::new(found)))
}

fn flags(array: &dyn Array) -> Converted {
    if array.as_string_opt::<i32>().is_some() {
        return Ok(None);
    }
    let Some(numbers) = numbers(array)? else { return Ok(None) };
    let flag = |(row, number): (usize, Option<i64>)| match number {
        Some(0) => Ok(Some(false)),
        Some(1) => Ok(Some(true)),
        None => Ok(None),
        Some(other) => Err(BadCell { row, what: format!("{other} is neither true nor false") }),
    };
    let found: BooleanArray = numbers.into_iter().enumerate().map(flag).collect::<Result<_, _>>()?;
    Ok(Some(Arc::new(found)))
}

pub fn texts_of(array: &dyn Array) -> Option<Vec<Option<&str>>> {
    Some(match array.data_type() {
        DataType::Utf8 => array.as_string::<i32>().iter().collect(),
        DataType::LargeUtf8 => array.as_string::<i64>().iter().collect(),
        DataType::Utf8View => array.as_string_view().iter().collect(),
        _ => return None,
    })
}

fn texts(array: &dyn Array) -> Option<ArrayRef> {
    texts_of(array).map(|texts| Arc::new(StringArray::from(texts)) as ArrayRef)
}

/// Times. Without a zone they are UTC, as NumPy's are; durations count from the trace's start. Whole numbers do not say their unit.
pub fn time(array: &dyn Array) -> Converted {
    let ns: PrimitiveArray<TimestampNanosecondType> = match array.data_type() {
        DataType::Timestamp(TimeUnit::Second, _) => scaled::<TimestampSecondType>(array, 1_000_000_000)?,
        DataType::Timestamp(TimeUnit::Millisecond, _) => {
            scaled::<TimestampMillisecondType>(array, 1_000_000)?
        }
        DataType::Timestamp(TimeUnit::Microsecond, _) => scaled::<TimestampMicrosecondType>(array, 1000)?,
        DataType::Timestamp(TimeUnit::Nanosecond, _) => scaled::<TimestampNanosecondType>(array, 1)?,
        DataType::Duration(TimeUnit::Second) => scaled::<DurationSecondType>(array, 1_000_000_000)?,
        DataType::Duration(TimeUnit::Millisecond) => scaled::<DurationMillisecondType>(array, 1_000_000)?,
        DataType::Duration(TimeUnit::Microsecond) => scaled::<DurationMicrosecondType>(array, 1000)?,
        DataType::Duration(TimeUnit::Nanosecond) => scaled::<DurationNanosecondType>(array, 1)?,
        DataType::Float64 => {
            let ns = |(row, seconds): (usize, Option<f64>)| match seconds.filter(|seconds| !seconds.is_nan())
            {
                Some(seconds) => {
                    let ns = ns_of_seconds(seconds);
                    ns.map(Some).ok_or_else(|| BadCell {
                        row,
                        what: format!("{seconds} s is out of range; seconds are wanted"),
                    })
                }
                None => Ok(None),
            };
            array.as_primitive::<Float64Type>().iter().enumerate().map(ns).collect::<Result<_, _>>()?
        }
        _ => return Ok(None),
    };
    Ok(Some(Arc::new(ns)))
}

fn scaled<T: ArrowPrimitiveType<Native = i64>>(
    array: &dyn Array,
    unit_ns: i64,
) -> Result<PrimitiveArray<TimestampNanosecondType>, BadCell> {
    let array: PrimitiveArray<Int64Type> = array.as_primitive::<T>().reinterpret_cast();
    let ns = |(row, units): (usize, Option<i64>)| {
        let Some(units) = units else { return Ok(None) };
        let ns = units.checked_mul(unit_ns);
        ns.map(Some).ok_or_else(|| BadCell { row, what: "is not between the years 1677 and 2262".to_owned() })
    };
    array.iter().enumerate().map(ns).collect()
}

/// The nanoseconds of the shortest decimal number that is this one: 1700000000.123456 s are exactly so many microseconds, although the
/// floating-point number next to that is not.
fn ns_of_seconds(seconds: f64) -> Option<i64> {
    if seconds.abs() >= 9.2e9 {
        return None;
    }
    let text = format!("{:.9}", seconds.abs());
    let shortest = seconds.abs().to_string();
    let (whole, fraction) = match shortest.split_once('.') {
        Some((whole, fraction)) if fraction.len() <= 9 => (whole, fraction),
        // More digits than nanoseconds: rounded.
        Some(_) => text.split_once('.')?,
        None => (shortest.as_str(), ""),
    };
    let ns = whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?;
    let ns = ns.checked_add(format!("{fraction:0<9}").parse().ok()?)?;
    Some(if seconds < 0.0 { -ns } else { ns })
}

pub fn data(array: &dyn Array) -> Converted {
    let mut found = BinaryBuilder::new();
    match array.data_type() {
        DataType::LargeBinary => array.as_binary::<i64>().iter().for_each(|bytes| found.append_option(bytes)),
        DataType::BinaryView => array.as_binary_view().iter().for_each(|bytes| found.append_option(bytes)),
        DataType::FixedSizeBinary(_) => {
            array.as_fixed_size_binary().iter().for_each(|bytes| found.append_option(bytes));
        }
        DataType::List(_) => {
            let lists = array.as_list::<i32>();
            let ends = lists.value_offsets();
            return lists_of_bytes(array, lists.values(), |row| ends[row] as usize..ends[row + 1] as usize);
        }
        DataType::LargeList(_) => {
            let lists = array.as_list::<i64>();
            let ends = lists.value_offsets();
            return lists_of_bytes(array, lists.values(), |row| ends[row] as usize..ends[row + 1] as usize);
        }
        DataType::FixedSizeList(_, width) => {
            let width = *width as usize;
            return lists_of_bytes(array, array.as_fixed_size_list().values(), |row| {
                row * width..(row + 1) * width
            });
        }
        _ => {
            let Some(texts) = texts_of(array) else { return Ok(None) };
            for (row, text) in texts.into_iter().enumerate() {
                let bytes = text.map(|text| {
                    hex(text).ok_or_else(|| BadCell {
                        row,
                        what: format!("'{text}' is not pairs of hexadecimal digits"),
                    })
                });
                found.append_option(bytes.transpose()?);
            }
        }
    }
    Ok(Some(Arc::new(found.finish())))
}

fn lists_of_bytes(lists: &dyn Array, values: &ArrayRef, range: impl Fn(usize) -> Range<usize>) -> Converted {
    // The row of a wrong value is not known there.
    let numbers = match values.data_type() {
        kind if kind.is_integer() || kind.is_floating() || kind.is_null() => numbers(values.as_ref()),
        _ => return Ok(None),
    };
    let row_of = |at: usize| (0..lists.len()).find(|row| range(*row).contains(&at)).unwrap_or(0);
    let numbers = numbers.map_err(|bad| BadCell { row: row_of(bad.row), ..bad })?.unwrap_or_default();
    let bytes = |row: usize| {
        let byte = |number: &Option<i64>| {
            let byte = number.and_then(|number| u8::try_from(number).ok());
            let found = || number.map_or("nothing".to_owned(), |number| number.to_string());
            byte.ok_or_else(|| BadCell { row, what: format!("{} is not a byte", found()) })
        };
        let of_row = lists.is_valid(row).then(|| numbers[range(row)].iter().map(byte).collect());
        of_row.transpose()
    };
    let found: Vec<Option<Vec<u8>>> = (0..lists.len()).map(bytes).collect::<Result<_, _>>()?;
    Ok(Some(Arc::new(found.iter().map(Option::as_deref).collect::<BinaryArray>())))
}

/// The bytes of pairs of hexadecimal digits, with or without spaces between them.
fn hex(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    for pairs in text.split_ascii_whitespace() {
        for pair in pairs.as_bytes().chunks(2) {
            let [high, low] = pair else { return None };
            let digit = |digit: &u8| char::from(*digit).to_digit(16);
            bytes.push((digit(high)? << 4 | digit(low)?) as u8);
        }
    }
    Some(bytes)
}
