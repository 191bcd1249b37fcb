//! Messages of python-can as a table of records.

use std::sync::Arc;

use arrow_array::builder::{
    BinaryBuilder, BooleanBuilder, Float64Builder, StringBuilder, UInt8Builder, UInt32Builder,
};
use arrow_array::{ArrayRef, RecordBatch};
use cantap_columns::FrameColumns;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::PyString;

use crate::error::Error;
use crate::table::Table;

/// Messages are converted so many at a time.
const ROWS: usize = 65_536;

/// The columns of messages, in types that are converted further.
#[derive(Default)]
struct Columns {
    time: Float64Builder,
    channel: UInt8Builder,
    event: StringBuilder,
    id: UInt32Builder,
    extended: BooleanBuilder,
    remote: BooleanBuilder,
    fd: BooleanBuilder,
    brs: BooleanBuilder,
    esi: BooleanBuilder,
    direction: StringBuilder,
    dlc: UInt8Builder,
    data: BinaryBuilder,
}

impl Columns {
    fn push(&mut self, message: &Bound<'_, PyAny>) -> PyResult<()> {
        let py = message.py();
        let flag = |name| message.getattr(name)?.is_truthy();
        let id: u32 = message.getattr(pyo3::intern!(py, "arbitration_id"))?.extract()?;
        let time: f64 = message.getattr(pyo3::intern!(py, "timestamp"))?.extract()?;
        let is_error = flag(pyo3::intern!(py, "is_error_frame"))?;
        self.time.append_value(time);
        self.channel.append_value(channel(&message.getattr(pyo3::intern!(py, "channel"))?)?);
        self.event.append_value(if is_error { "bus-error" } else { "frame" });
        let (remote, fd) = (flag(pyo3::intern!(py, "is_remote_frame"))?, flag(pyo3::intern!(py, "is_fd"))?);
        if is_error {
            self.id.append_null();
            self.data.append_null();
            self.direction.append_null();
            self.dlc.append_null();
            for column in [&mut self.extended, &mut self.remote, &mut self.fd, &mut self.brs, &mut self.esi] {
                column.append_null();
            }
            return Ok(());
        }
        self.id.append_value(id);
        self.extended.append_value(flag(pyo3::intern!(py, "is_extended_id"))?);
        self.remote.append_value(remote);
        self.fd.append_value(fd);
        self.brs.append_value(fd && flag(pyo3::intern!(py, "bitrate_switch"))?);
        self.esi.append_value(fd && flag(pyo3::intern!(py, "error_state_indicator"))?);
        self.direction.append_value(if flag(pyo3::intern!(py, "is_rx"))? { "rx" } else { "tx" });
        if remote {
            let dlc: u8 = message.getattr(pyo3::intern!(py, "dlc"))?.extract()?;
            self.dlc.append_value(dlc);
            self.data.append_null();
        } else {
            self.dlc.append_null();
            let data: PyBackedBytes = message.getattr(pyo3::intern!(py, "data"))?.extract()?;
            self.data.append_value(&data[..]);
        }
        Ok(())
    }

    fn take(&mut self) -> Result<RecordBatch, Error> {
        let columns: Vec<(&str, ArrayRef)> = vec![
            ("time", Arc::new(self.time.finish())),
            ("channel", Arc::new(self.channel.finish())),
            ("event", Arc::new(self.event.finish())),
            ("id", Arc::new(self.id.finish())),
            ("extended", Arc::new(self.extended.finish())),
            ("remote", Arc::new(self.remote.finish())),
            ("fd", Arc::new(self.fd.finish())),
            ("brs", Arc::new(self.brs.finish())),
            ("esi", Arc::new(self.esi.finish())),
            ("direction", Arc::new(self.direction.finish())),
            ("dlc", Arc::new(self.dlc.finish())),
            ("data", Arc::new(self.data.finish())),
        ];
        let columns = columns.into_iter().map(|(name, column)| (name, column, true));
        let batch = RecordBatch::try_from_iter_with_nullable(columns);
        batch.map_err(|error| Error::Format(error.to_string()))
    }
}

/// A channel as a trace numbers it: python-can's numbers count from 0, and names such as `can0`, too.
fn channel(of: &Bound<'_, PyAny>) -> PyResult<u8> {
    if of.is_none() {
        return Ok(1);
    }
    let number = if let Ok(name) = of.cast::<PyString>() {
        let name = name.to_string();
        let digits = name.trim_end_matches(|letter: char| letter.is_ascii_digit()).len();
        if digits == name.len() { Some(0) } else { name[digits..].parse().ok() }
    } else {
        of.extract::<u32>().ok()
    };
    let number = number.and_then(|number| u8::try_from(number.checked_add(1)?).ok());
    number.ok_or_else(|| PyValueError::new_err(format!("the channel {of} has no number from 0 to 254")))
}

/// The records of python-can's messages: of a list, a reader of a log, a Bus.
pub fn table_of(messages: &Bound<'_, PyAny>) -> PyResult<Table> {
    let mut columns = Columns::default();
    let mut batches = Vec::new();
    let (mut rows, mut converted) = (0, 0);
    let mut frames = FrameColumns::default();
    let mut convert = |columns: &mut Columns, rows: usize| -> PyResult<RecordBatch> {
        let records =
            cantap_columns::records(&columns.take()?).map_err(|error| Error::from(error.after(converted)))?;
        converted = rows;
        for record in &records {
            frames.push(record);
        }
        Ok(frames.take())
    };
    for message in messages.try_iter()? {
        let message = message?;
        if !message.hasattr(pyo3::intern!(message.py(), "arbitration_id"))? {
            let kind = message.get_type().name()?;
            return Err(PyTypeError::new_err(format!(
                "messages of python-can are wanted, and one is of type {kind}"
            )));
        }
        columns.push(&message)?;
        rows += 1;
        if rows % ROWS == 0 {
            batches.push(convert(&mut columns, rows)?);
        }
    }
    if rows % ROWS != 0 {
        batches.push(convert(&mut columns, rows)?);
    }
    Ok(Table::new(FrameColumns::schema(), batches, None))
}

/// The same, for Python.
#[pyfunction]
pub fn table_of_messages(messages: &Bound<'_, PyAny>) -> PyResult<Table> {
    table_of(messages)
}

/// Adds the function to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_function(wrap_pyfunction!(table_of_messages, module)?)
}
