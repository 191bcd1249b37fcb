//! Frames out of signals, one or whole tables of them, and back.

use std::collections::BTreeMap;
use std::sync::Arc;

use arrow_array::builder::BinaryBuilder;
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type,
    UInt64Type,
};
use arrow_array::{Array, ArrayRef, BooleanArray, RecordBatch, UInt32Array};
use arrow_schema::DataType;
use cantap_columns::FrameColumns;
use cantap_signals::encode::{EncodeError, Input, encode_message};
use cantap_signals::{Decoder, Indicator, Message, MessageRef, Number, SignalValue};
use cantap_trace::counted;
use cantap_trace::fd::FD_LENGTHS;
use cantap_trace::{Frame as ClassicFrame, TraceFrame, TraceRecord};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyString};

use crate::database::Database;
use crate::error::Error;
use crate::frame::{AnyFrame, Frame, Record};
use crate::grammar::OfTrace;
use crate::messages::table_of;
use crate::scan::warning;
use crate::table::{Table, batches_of};

/// What a signal's column of texts is called, after the signal's name.
const TEXT: &str = ".text";

/// A value as it was given to Python.
fn input(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Input> {
    if let Ok(text) = value.cast::<PyString>() {
        return Ok(Input::Text(text.to_string()));
    }
    if let Ok(integer) = value.extract::<i64>() {
        return Ok(Input::Integer(integer.into()));
    }
    if let Ok(integer) = value.extract::<u64>() {
        return Ok(Input::Integer(integer.into()));
    }
    value.extract::<f64>().map(Input::Real).map_err(|_| {
        let kind = value.get_type().name().map(|name| name.to_string()).unwrap_or_default();
        PyTypeError::new_err(format!(
            "{name}: a value is a number, or a text of the signal's table, not {kind}"
        ))
    })
}

/// A message of exactly this name. A channel's own database comes before one for all channels.
fn named(decoder: &Decoder, name: &str, id: Option<&str>, channel: Option<u8>) -> Option<MessageRef> {
    let mut of_all = None;
    for (reference, of, message) in decoder.messages() {
        let suits = channel.is_none() || of.is_none() || of == channel;
        if message.name != name || !suits || id.is_some_and(|id| message.id.to_string() != id) {
            continue;
        }
        if of.is_some() {
            return Some(reference);
        }
        of_all = of_all.or(Some(reference));
    }
    of_all
}

/// A message of this name; `NAME-ID` and `NAME-ID-CHANNEL`, as tables of decoded messages with one name are called, too.
fn find(decoder: &Decoder, name: &str, channel: Option<u8>) -> Result<MessageRef, Error> {
    let with_id = |name: &str| {
        let (name, id) = name.rsplit_once('-')?;
        named(decoder, name, Some(id), channel)
    };
    let found = named(decoder, name, None, channel).or_else(|| with_id(name)).or_else(|| {
        let (name, _) = name.rsplit_once('-')?;
        with_id(name)
    });
    found.ok_or_else(|| {
        let near = cantap_signals::encode::encode(decoder, channel, name).err();
        near.map_or_else(|| Error::Database(format!("no database has a message '{name}'")), Error::from)
    })
}

impl Database {
    /// The frame of a message with these values.
    pub fn frame(
        &self,
        message: &str,
        signals: Option<&Bound<'_, PyDict>>,
        channel: Option<OfTrace>,
    ) -> PyResult<Frame> {
        let found = find(&self.decoder, message, channel.map(|channel| channel.0))?;
        let of = self.decoder.message(found);
        let (mut inputs, mut texts): (Vec<(String, Input)>, Vec<_>) = (Vec::new(), Vec::new());
        for (name, value) in signals.into_iter().flatten() {
            let name: String = name.extract()?;
            if value.is_none() {
                continue;
            }
            let given = input(&name, &value)?;
            match name.strip_suffix(TEXT).filter(|_| of.signal(&name).is_none()) {
                Some(signal) => texts.push((signal.to_owned(), given)),
                None => inputs.push((own_name(of, &name).to_owned(), given)),
            }
        }
        // Of a decoded frame, a text says no more than its value.
        texts.retain(|(signal, _)| inputs.iter().all(|(name, _)| name != signal));
        inputs.extend(texts);
        let data = encode_message(of, &inputs).map_err(Error::from)?;
        let frame = ClassicFrame::data_frame(of.id, &data).ok_or_else(|| {
            Error::Database(format!(
                "message {message} has {}, and a frame of classical CAN has 8; cantap.encode makes CAN FD frames for a trace",
                counted(of.length, "byte")
            ))
        })?;
        Ok(Frame(frame.into()))
    }

    /// The message of a frame, and its values; `None` if no database has it.
    pub fn values<'py>(
        &self,
        py: Python<'py>,
        frame: &Bound<'py, PyAny>,
        channel: OfTrace,
    ) -> PyResult<Option<(String, Bound<'py, PyDict>)>> {
        let Some(frame) = any_frame(frame)? else { return Ok(None) };
        let mut values: Vec<SignalValue> = Vec::new();
        let Some(found) = self.decoder.decode(channel.0, &frame, &mut values) else { return Ok(None) };
        let message = self.decoder.message(found);
        let by_name = PyDict::new(py);
        for value in &values {
            let signal = &message.signals[value.signal as usize];
            let indicator = message.indicator(signal, value.raw);
            let name = signal.label();
            by_name.set_item(
                &*name,
                indicator.is_none().then(|| signal.for_programs(Number::Real(value.value)).as_f64()),
            )?;
            if let Some(text) = signal.text(value.raw).or(indicator.map(Indicator::name)) {
                by_name.set_item(format!("{name}{TEXT}"), text)?;
            }
        }
        Ok(Some((message.name.clone(), by_name)))
    }
}

/// A frame of this package, a text, or a message of python-can. `None` for what a trace has besides, such as error frames.
fn any_frame(object: &Bound<'_, PyAny>) -> PyResult<Option<TraceFrame>> {
    if let Ok(record) = object.cast::<Record>() {
        return Ok(record.get().0.frame().copied());
    }
    if object.hasattr("arbitration_id")? {
        let table = table_of(PyList::new(object.py(), [object])?.as_any())?;
        let records = cantap_columns::records(&table.one_batch()?).map_err(Error::from)?;
        return Ok(records.first().and_then(|record| record.frame().copied()));
    }
    object.extract::<AnyFrame>().map(|frame| Some(frame.0))
}

/// A column's signal: one whose name was taken has its message's in front.
fn own_name<'a>(message: &Message, column: &'a str) -> &'a str {
    let bare = column.strip_prefix(message.name.as_str()).and_then(|rest| rest.strip_prefix('.'));
    bare.filter(|bare| message.signal(column).is_none() && message.signal(bare).is_some()).unwrap_or(column)
}

/// A column of signals.
struct SignalColumn {
    signal: String,
    /// Only used where there is no value.
    is_text: bool,
    column: ArrayRef,
}

impl SignalColumn {
    /// The value in a row; `None` where there is none.
    fn input(&self, row: usize) -> Option<Input> {
        let column = self.column.as_ref();
        if column.is_null(row) {
            return None;
        }
        macro_rules! integer {
            ($kind:ty) => {
                Some(Input::Integer(column.as_primitive::<$kind>().value(row).into()))
            };
        }
        let real = |value: f64| (!value.is_nan()).then_some(Input::Real(value));
        match column.data_type() {
            DataType::Int8 => integer!(Int8Type),
            DataType::Int16 => integer!(Int16Type),
            DataType::Int32 => integer!(Int32Type),
            DataType::Int64 => integer!(Int64Type),
            DataType::UInt8 => integer!(UInt8Type),
            DataType::UInt16 => integer!(UInt16Type),
            DataType::UInt32 => integer!(UInt32Type),
            DataType::UInt64 => integer!(UInt64Type),
            DataType::Float32 => real(column.as_primitive::<Float32Type>().value(row).into()),
            DataType::Float64 => real(column.as_primitive::<Float64Type>().value(row)),
            DataType::Boolean => Some(Input::Integer(column.as_boolean().value(row).into())),
            DataType::Utf8 => Some(Input::Text(column.as_string::<i32>().value(row).to_owned())),
            DataType::LargeUtf8 => Some(Input::Text(column.as_string::<i64>().value(row).to_owned())),
            DataType::Utf8View => Some(Input::Text(column.as_string_view().value(row).to_owned())),
            _ => None,
        }
    }

    /// The columns of a batch that are signals.
    fn all(batch: &RecordBatch, message: &Message) -> Result<Vec<Self>, Error> {
        let mut all = Vec::new();
        for (field, column) in batch.schema().fields().iter().zip(batch.columns()) {
            let name = field.name().as_str();
            if OURS.contains(&name) || name.starts_with("__index_level_") {
                continue;
            }
            let text = name.strip_suffix(TEXT).filter(|_| message.signal(name).is_none());
            let signal = own_name(message, text.unwrap_or(name)).to_owned();
            let column = without_dictionary(column)?;
            let kind = column.data_type();
            let is_known = kind.is_integer()
                || kind.is_string()
                || matches!(kind, DataType::Float32 | DataType::Float64 | DataType::Boolean | DataType::Null);
            if !is_known {
                return Err(Error::Format(format!(
                    "{}: the column '{name}' is {kind}, and a signal's values are numbers or texts",
                    message.name
                )));
            }
            all.push(Self { signal, is_text: text.is_some(), column });
        }
        Ok(all)
    }
}

/// The columns that are not signals.
const OURS: [&str; 3] = ["time", "channel", "id"];

fn without_dictionary(column: &ArrayRef) -> Result<ArrayRef, Error> {
    let Some(dictionary) = column.as_any_dictionary_opt() else { return Ok(Arc::clone(column)) };
    let taken = arrow_select::take::take(dictionary.values().as_ref(), dictionary.keys(), None);
    taken.map_err(|error| Error::Format(error.to_string()))
}

/// As long as a frame can be: CAN FD has no frames of 9 to 11 bytes, for example.
fn padded(mut bytes: Vec<u8>) -> Vec<u8> {
    if bytes.len() > 8 {
        let length = FD_LENGTHS.into_iter().map(usize::from).find(|length| *length >= bytes.len());
        bytes.resize(length.unwrap_or(bytes.len()), 0);
    }
    bytes
}

/// Makes frames out of tables of signals, and counts the values that a database does not allow although they fit.
struct TableEncoder<'a> {
    decoder: &'a Decoder,
    records: Vec<TraceRecord>,
    /// By signal.
    beyond_limits: BTreeMap<String, u64>,
}

impl TableEncoder<'_> {
    fn push(&mut self, name: &str, batch: &RecordBatch, rows_before: usize) -> Result<(), Error> {
        let first_channel = batch.column_by_name("channel").filter(|column| !column.is_empty());
        let channel =
            first_channel.and_then(|column| column.as_primitive_opt::<UInt8Type>()).map(|of| of.value(0));
        let decoder = self.decoder;
        let message = decoder.message(find(decoder, name, channel)?);
        let columns = SignalColumn::all(batch, message)?;
        let mut data = BinaryBuilder::new();
        for row in 0..batch.num_rows() {
            let bytes = self
                .data(message, &columns, row)
                .map_err(|error| Error::Database(format!("{name}, row {}: {error}", rows_before + row)))?;
            data.append_value(padded(bytes));
        }
        self.take_frames(name, message, batch, Arc::new(data.finish()), rows_before)
    }

    /// A row's data bytes.
    fn data(
        &mut self,
        message: &Message,
        columns: &[SignalColumn],
        row: usize,
    ) -> Result<Vec<u8>, EncodeError> {
        let mut inputs: Vec<(String, Input)> = Vec::new();
        let (texts, values): (Vec<_>, Vec<_>) = columns.iter().partition(|column| column.is_text);
        for column in values.into_iter().chain(texts) {
            let is_given = column.is_text && inputs.iter().any(|(signal, _)| *signal == column.signal);
            if let Some(input) = column.input(row).filter(|_| !is_given) {
                inputs.push((column.signal.clone(), input));
            }
        }
        loop {
            match encode_message(message, &inputs) {
                // What was on a bus may be again; that is for the caller to know.
                Err(EncodeError::Limits { signal, raw, .. })
                    if inputs
                        .iter()
                        .any(|(name, input)| *name == signal && !matches!(input, Input::Raw(_))) =>
                {
                    *self.beyond_limits.entry(signal.clone()).or_default() += 1;
                    if let Some((_, input)) = inputs.iter_mut().find(|(name, _)| *name == signal) {
                        *input = Input::Raw(raw);
                    }
                }
                made => return made,
            }
        }
    }

    /// Frames with the batch's times and channels, and these data.
    fn take_frames(
        &mut self,
        name: &str,
        message: &Message,
        batch: &RecordBatch,
        data: ArrayRef,
        rows_before: usize,
    ) -> Result<(), Error> {
        let rows = batch.num_rows();
        let is_fd = data.as_binary::<i32>().iter().flatten().any(|bytes| bytes.len() > 8);
        let id: ArrayRef = match batch.column_by_name("id") {
            Some(id) => Arc::clone(id),
            None => Arc::new(UInt32Array::from_value(message.id.raw(), rows)),
        };
        let flag = |value| Arc::new(BooleanArray::from(vec![value; rows])) as ArrayRef;
        let mut columns = vec![
            ("id", id),
            ("extended", flag(message.id.is_extended())),
            ("fd", flag(is_fd)),
            ("data", data),
        ];
        for kept in ["time", "channel"] {
            columns.extend(batch.column_by_name(kept).map(|column| (kept, Arc::clone(column))));
        }
        let columns = columns.into_iter().map(|(name, column)| (name, column, true));
        let frames = RecordBatch::try_from_iter_with_nullable(columns);
        let frames = frames.map_err(|error| Error::Format(error.to_string()))?;
        let records = cantap_columns::records(&frames);
        self.records
            .extend(records.map_err(|error| Error::Format(format!("{name}: {}", error.after(rows_before))))?);
        Ok(())
    }
}

/// Frames out of tables of signals by their messages' names, in the order of their times.
#[pyfunction]
pub fn encode_tables(
    py: Python<'_>,
    tables: Vec<(String, Bound<'_, PyAny>)>,
    db: Py<Database>,
) -> PyResult<Table> {
    let decoder = Arc::clone(&db.get().decoder);
    let mut encoder = TableEncoder { decoder: &decoder, records: Vec::new(), beyond_limits: BTreeMap::new() };
    for (name, table) in tables {
        let mut rows = 0;
        for batch in batches_of(&table)? {
            let batch = batch.map_err(|error| Error::Format(error.to_string()))?;
            py.detach(|| encoder.push(&name, &batch, rows))?;
            rows += batch.num_rows();
            py.check_signals()?;
        }
    }
    let TableEncoder { mut records, beyond_limits, .. } = encoder;
    let batch = py.detach(|| {
        records.sort_by_key(|record| record.time_ns);
        let mut columns = FrameColumns::default();
        for record in &records {
            columns.push(record);
        }
        columns.take()
    });
    if !beyond_limits.is_empty() {
        let signals: Vec<_> =
            beyond_limits.iter().map(|(signal, count)| format!("{signal} ({count})")).collect();
        warning(
            py,
            &format!(
                "values that the database does not allow were encoded all the same: {}",
                signals.join(", ")
            ),
        )?;
    }
    Ok(Table::of_batch(batch))
}

/// Adds the functions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(encode_tables, module)?)
}
