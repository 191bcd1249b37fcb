//! Tables that any Arrow program takes without copying, through the PyCapsule interface.
//!
//! <https://arrow.apache.org/docs/format/CDataInterface/PyCapsuleInterface.html>

use std::ffi::CStr;
use std::sync::Arc;

use arrow_array::ffi::FFI_ArrowSchema;
use arrow_array::ffi_stream::{FFI_ArrowArrayStream, RecordBatchStreamReader};
use arrow_array::{
    Array, ArrayRef, RecordBatch, RecordBatchIterator, RecordBatchOptions, RecordBatchReader, StructArray,
    make_array, new_empty_array,
};
use arrow_data::ArrayData;
use arrow_data::transform::MutableArrayData;
use arrow_ipc::reader::StreamReader;
use arrow_ipc::writer::StreamWriter;
use arrow_schema::{ArrowError, DataType, SchemaRef};
use cantap_trace::counted;
use pyo3::exceptions::{PyAttributeError, PyKeyError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyCapsule, PyDict, PyList, PySlice, PyTuple};

use crate::error::FormatError;
use crate::numpy::{self, Parts};
use crate::report::Report;
use crate::values;

const STREAM: &CStr = c"arrow_array_stream";
const SCHEMA: &CStr = c"arrow_schema";
const ARRAY: &CStr = c"arrow_array";

/// What pickle needs to rebuild a table.
type Reduced<'py> = (Py<PyAny>, (Bound<'py, PyBytes>, Option<Py<Report>>));

/// A table in memory, in one or several batches.
#[pyclass(module = "cantap", frozen)]
pub struct Table {
    schema: SchemaRef,
    batches: Vec<RecordBatch>,
    report: Option<Py<Report>>,
}

fn arrow_error(error: ArrowError) -> PyErr {
    FormatError::new_err(error.to_string())
}

impl Table {
    /// From batches with this schema, and the report about their source.
    pub fn new(schema: SchemaRef, batches: Vec<RecordBatch>, report: Option<Py<Report>>) -> Self {
        Self { schema, batches, report }
    }

    /// From a single batch.
    pub fn of_batch(batch: RecordBatch) -> Self {
        Self { schema: batch.schema(), batches: vec![batch], report: None }
    }

    fn rows(&self) -> usize {
        self.batches.iter().map(RecordBatch::num_rows).sum()
    }
}

#[pymethods]
impl Table {
    /// The number of rows.
    #[getter]
    fn num_rows(&self) -> usize {
        self.rows()
    }

    /// The columns' names, in order.
    #[getter]
    fn column_names<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, self.schema.fields().iter().map(|field| field.name()))
    }

    /// Metadata of a column: its unit, its description.
    fn column_metadata<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyDict>> {
        let field = self.schema.field_with_name(name).map_err(|_| self.no_column(name))?;
        let about = PyDict::new(py);
        for (key, value) in field.metadata() {
            about.set_item(key, value)?;
        }
        Ok(about)
    }

    /// Metadata of the table: for example, its message.
    #[getter]
    fn metadata<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let about = PyDict::new(py);
        for (key, value) in self.schema.metadata() {
            about.set_item(key, value)?;
        }
        Ok(about)
    }

    /// What was read, and what could not be read; `None` for a table that was not read from anywhere.
    #[getter]
    fn report(&self, py: Python<'_>) -> Option<Py<Report>> {
        self.report.as_ref().map(|report| report.clone_ref(py))
    }

    /// The batches, each a table.
    fn batches(&self) -> Vec<Self> {
        self.batches.iter().cloned().map(Self::of_batch).collect()
    }

    /// A column's parts for NumPy, for the Python half.
    fn _parts<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Parts<'py>> {
        Ok(numpy::parts(py, self.column(name)?.as_ref())?)
    }

    /// A column's values as a list, for the Python half.
    fn _values<'py>(&self, py: Python<'py>, name: &str) -> PyResult<Bound<'py, PyList>> {
        values::values(py, self.column(name)?.as_ref())
    }

    /// The columns by name, each with its type.
    #[getter]
    fn schema<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let types = PyDict::new(slf.py());
        for field in slf.get().schema.fields() {
            types.set_item(field.name(), values::type_name(field.data_type()))?;
        }
        slf.py().import("cantap._columns")?.call_method1("Schema", (slf, types))
    }

    /// A column by its name; a row by its number; rows by a slice; several columns by a list of names.
    fn __getitem__<'py>(slf: &Bound<'py, Self>, key: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let (py, table) = (slf.py(), slf.get());
        if let Ok(name) = key.extract::<String>() {
            let column = Bound::new(py, table.select(std::slice::from_ref(&name))?)?;
            return py.import("cantap._columns")?.call_method1("Column", (column, name));
        }
        if let Ok(rows) = key.cast::<PySlice>() {
            let rows = rows.indices(table.rows().cast_signed())?;
            if rows.step != 1 {
                return Err(PyValueError::new_err(
                    "rows are taken in order, each of them: for others, use to_pyarrow() or to_polars()",
                ));
            }
            let (start, count) = (rows.start.unsigned_abs(), rows.slicelength);
            return Ok(Bound::new(py, table.slice(start, count))?.into_any());
        }
        let Ok(names) = key.extract::<Vec<String>>() else {
            // NumPy's arrays have it too, and refuse.
            if let Ok(number) = key.call_method0("__index__") {
                return py.import("cantap._columns")?.call_method1("row", (slf, number));
            }
            return Err(PyTypeError::new_err(
                "a table is asked for a column by its name, for columns by a list of names, for a row by its number, and for rows by a slice; \
                 rows that meet a condition are chosen in to_pandas() or to_polars()",
            ));
        };
        Ok(Bound::new(py, table.select(&names)?)?.into_any())
    }

    /// Whether it has a column of this name; of anything else, whether it is one of the rows.
    fn __contains__(slf: &Bound<'_, Self>, key: &Bound<'_, PyAny>) -> PyResult<bool> {
        match key.extract::<String>() {
            Ok(name) => Ok(slf.get().schema.index_of(&name).is_ok()),
            Err(_) => Self::__iter__(slf)?.contains(key),
        }
    }

    /// Only for names that it does not have: what to write instead.
    fn __getattr__(&self, name: &str) -> PyResult<()> {
        let advice = match self.schema.index_of(name) {
            Ok(_) => format!("a column is table['{name}']"),
            Err(_) => "what pandas and Polars can do, to_pandas() and to_polars() can".to_owned(),
        };
        Err(PyAttributeError::new_err(format!("a table has no attribute '{name}'; {advice}")))
    }

    /// What a notebook offers behind `table["`.
    fn _ipython_key_completions_<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        self.column_names(py)
    }

    /// Plots signals over time with Matplotlib.
    #[pyo3(signature = (*signals, ax=None, **options))]
    fn plot<'py>(
        slf: &Bound<'py, Self>,
        signals: &Bound<'py, PyTuple>,
        ax: Option<Bound<'py, PyAny>>,
        options: Option<Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let options = options.unwrap_or_else(|| PyDict::new(slf.py()));
        slf.py().import("cantap._plot")?.call_method1("plot", (slf, signals, ax, options))
    }

    fn _repr_html_<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("cantap._columns")?.call_method1("to_html", (slf,))
    }

    /// The columns as NumPy arrays, by name: times as datetime64, texts as objects, data bytes as a row of numbers for each frame.
    /// Missing values are masked.
    fn to_numpy<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("cantap._arrays")?.call_method1("to_numpy", (slf,))
    }

    /// The same table for pyarrow.
    fn to_pyarrow<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("pyarrow")?.call_method1("table", (slf,))
    }

    /// The same table for pandas.
    fn to_pandas<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        Self::to_pyarrow(slf)?.call_method0("to_pandas")
    }

    /// The same table for Polars.
    fn to_polars<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let polars = slf.py().import("polars")?;
        match polars.call_method1("DataFrame", (slf,)) {
            // Before 1.3 it takes pyarrow's tables only.
            Err(error) if error.is_instance_of::<PyTypeError>(slf.py()) => {
                polars.call_method1("from_arrow", (Self::to_pyarrow(slf)?,))
            }
            made => made,
        }
    }

    fn __len__(&self) -> usize {
        self.rows()
    }

    /// Its rows in order.
    fn __iter__<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        slf.py().import("cantap._columns")?.call_method1("rows", (slf,))
    }

    fn __repr__(&self) -> String {
        let names: Vec<_> = self.schema.fields().iter().map(|field| field.name().as_str()).collect();
        format!("<cantap.Table of {}: {}>", counted(self.rows(), "row"), names.join(", "))
    }

    fn __arrow_c_schema__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyCapsule>> {
        schema_capsule(py, &self.schema)
    }

    #[pyo3(signature = (requested_schema=None))]
    fn __arrow_c_stream__<'py>(
        &self,
        py: Python<'py>,
        requested_schema: Option<Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyCapsule>> {
        // Consumers that want other types convert: the interface allows that.
        drop(requested_schema);
        let batches = self.batches.clone().into_iter().map(Ok);
        stream_capsule(py, Box::new(RecordBatchIterator::new(batches, Arc::clone(&self.schema))))
    }

    #[pyo3(signature = (requested_schema=None))]
    fn __arrow_c_array__<'py>(
        &self,
        py: Python<'py>,
        requested_schema: Option<Bound<'py, PyAny>>,
    ) -> PyResult<(Bound<'py, PyCapsule>, Bound<'py, PyCapsule>)> {
        drop(requested_schema);
        let batch = self.one_batch()?;
        let (array, _) =
            arrow_array::ffi::to_ffi(&StructArray::from(batch).to_data()).map_err(arrow_error)?;
        Ok((self.__arrow_c_schema__(py)?, PyCapsule::new_with_value(py, array, ARRAY)?))
    }

    fn __reduce__<'py>(&self, py: Python<'py>) -> PyResult<Reduced<'py>> {
        let written = py.detach(|| {
            let mut writer = StreamWriter::try_new(Vec::new(), &self.schema)?;
            self.batches.iter().try_for_each(|batch| writer.write(batch))?;
            writer.into_inner()
        });
        let bytes = PyBytes::new(py, &written.map_err(arrow_error)?);
        let make = py.get_type::<Self>().getattr("_from_ipc")?.unbind();
        Ok((make, (bytes, self.report(py))))
    }

    #[staticmethod]
    fn _from_ipc(bytes: &[u8], report: Option<Py<Report>>) -> PyResult<Self> {
        let reader = StreamReader::try_new(bytes, None).map_err(arrow_error)?;
        let schema = reader.schema();
        let batches = reader.collect::<Result<_, _>>().map_err(arrow_error)?;
        Ok(Self { schema, batches, report })
    }
}

impl Table {
    /// Some of its columns, in this order.
    fn select(&self, names: &[String]) -> PyResult<Self> {
        let places = names.iter().map(|name| self.schema.index_of(name).map_err(|_| self.no_column(name)));
        let places = places.collect::<PyResult<Vec<_>>>()?;
        let schema = Arc::new(self.schema.project(&places).map_err(arrow_error)?);
        let batches = self.batches.iter().map(|batch| batch.project(&places));
        let batches = batches.collect::<Result<_, _>>().map_err(arrow_error)?;
        Ok(Self { schema, batches, report: None })
    }

    /// Some of its rows. Nothing is copied.
    fn slice(&self, mut start: usize, mut count: usize) -> Self {
        let mut batches = Vec::new();
        for batch in &self.batches {
            let rows = batch.num_rows();
            let here = rows.saturating_sub(start).min(count);
            if here > 0 {
                batches.push(batch.slice(start, here));
            }
            start = start.saturating_sub(rows);
            count -= here;
        }
        Self { schema: Arc::clone(&self.schema), batches, report: None }
    }

    fn no_column(&self, name: &str) -> PyErr {
        let names: Vec<_> = self.schema.fields().iter().map(|field| field.name().as_str()).collect();
        PyKeyError::new_err(format!("there is no column '{name}'; there are {}", names.join(", ")))
    }

    /// All rows of a column in one piece; nothing is copied if they already are, and nothing of other columns.
    fn column(&self, name: &str) -> PyResult<ArrayRef> {
        let place = self.schema.index_of(name).map_err(|_| self.no_column(name))?;
        match self.batches.as_slice() {
            [batch] => Ok(Arc::clone(batch.column(place))),
            [] => Ok(new_empty_array(self.schema.field(place).data_type())),
            batches => {
                let pieces: Vec<_> = batches.iter().map(|batch| batch.column(place).as_ref()).collect();
                joined(&pieces).map_err(arrow_error)
            }
        }
    }

    /// All rows in one batch; nothing is copied if they already are.
    pub fn one_batch(&self) -> PyResult<RecordBatch> {
        match self.batches.as_slice() {
            [batch] => Ok(batch.clone()),
            batches => {
                let columns = (0..self.schema.fields().len()).map(|place| {
                    let pieces: Vec<_> = batches.iter().map(|batch| batch.column(place).as_ref()).collect();
                    if pieces.is_empty() {
                        Ok(new_empty_array(self.schema.field(place).data_type()))
                    } else {
                        joined(&pieces)
                    }
                });
                let columns = columns.collect::<Result<_, _>>().map_err(arrow_error)?;
                let rows = batches.iter().map(RecordBatch::num_rows).sum();
                let options = RecordBatchOptions::new().with_row_count(Some(rows));
                RecordBatch::try_new_with_options(Arc::clone(&self.schema), columns, &options)
                    .map_err(arrow_error)
            }
        }
    }
}

/// The pieces of a column as one. Those of a dictionary, which may have different texts, are `arrow-select`'s business; the rest is copied here, because
/// that crate is not optimised (see `profile.wheel` in the workspace's Cargo.toml).
fn joined(pieces: &[&dyn Array]) -> Result<ArrayRef, ArrowError> {
    if pieces.iter().any(|piece| matches!(piece.data_type(), DataType::Dictionary(..))) {
        return arrow_select::concat::concat(pieces);
    }
    let parts: Vec<_> = pieces.iter().map(|piece| piece.to_data()).collect();
    let rows = parts.iter().map(ArrayData::len).sum();
    let mut whole = MutableArrayData::new(parts.iter().collect(), false, rows);
    for (place, part) in parts.iter().enumerate() {
        whole.try_extend(place, 0, part.len())?;
    }
    Ok(make_array(whole.freeze()))
}

/// The schema as a capsule.
pub fn schema_capsule<'py>(py: Python<'py>, schema: &SchemaRef) -> PyResult<Bound<'py, PyCapsule>> {
    let schema = FFI_ArrowSchema::try_from(schema.as_ref()).map_err(arrow_error)?;
    PyCapsule::new_with_value(py, schema, SCHEMA)
}

/// A stream of batches as a capsule.
pub fn stream_capsule(
    py: Python<'_>,
    reader: Box<dyn RecordBatchReader + Send>,
) -> PyResult<Bound<'_, PyCapsule>> {
    PyCapsule::new_with_value(py, FFI_ArrowArrayStream::new(reader), STREAM)
}

/// The batches of anything that has some: a table of this package, of pyarrow, pandas, Polars, DuckDB.
pub fn batches_of(object: &Bound<'_, PyAny>) -> PyResult<Box<dyn RecordBatchReader + Send>> {
    if let Ok(table) = object.cast::<Table>() {
        let table = table.get();
        let batches = table.batches.clone().into_iter().map(Ok);
        return Ok(Box::new(RecordBatchIterator::new(batches, Arc::clone(&table.schema))));
    }
    let Ok(export) = object.getattr("__arrow_c_stream__") else {
        let kind = object.get_type().name()?;
        return Err(PyTypeError::new_err(format!(
            "a table is wanted, of this package or of pyarrow, pandas, Polars or DuckDB; this is of type {kind}"
        )));
    };
    let capsule = export.call0()?.cast_into::<PyCapsule>()?;
    let pointer = capsule.pointer_checked(Some(STREAM))?.cast::<FFI_ArrowArrayStream>();
    // SAFETY: the name says that the capsule has an initialised stream, which the interface lets its only consumer take. The
    // original is then marked as released, which the capsule's destructor checks.
    let reader = unsafe { RecordBatchStreamReader::from_raw(pointer.as_ptr()) };
    Ok(Box::new(reader.map_err(arrow_error)?))
}
