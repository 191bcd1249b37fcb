//! A table with signals side by side: a row per time, a column per signal.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_array::builder::{ArrayBuilder as _, Float64Builder, TimestampNanosecondBuilder};
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field, Schema, SchemaRef};

use crate::events;
use crate::names::ColumnNames;

/// Signals side by side: `time`, then a float64 for each name, null if there is no value at that time. A signal called `time` has
/// the column `signal.time`.
pub struct WideColumns {
    schema: SchemaRef,
    time: TimestampNanosecondBuilder,
    values: Vec<Float64Builder>,
}

impl WideColumns {
    /// A table with a column for each of these names, with their units as metadata.
    pub fn new<'a>(names_and_units: impl IntoIterator<Item = (&'a str, &'a str)>) -> Self {
        let mut fields = events::fields();
        fields.truncate(1);
        let mut names = ColumnNames::of(&fields);
        fields.extend(names_and_units.into_iter().map(|(name, unit)| {
            let field = Field::new(names.choose(name, "signal", false), DataType::Float64, true);
            if unit.is_empty() {
                field
            } else {
                field.with_metadata(HashMap::from([("unit".to_owned(), unit.to_owned())]))
            }
        }));
        let values = fields[1..].iter().map(|_| Float64Builder::new()).collect();
        let schema = Arc::new(Schema::new(fields));
        Self { schema, time: TimestampNanosecondBuilder::new().with_timezone(events::UTC), values }
    }

    /// The table's columns.
    pub fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    /// Appends a row. Columns beyond the last value get null.
    pub fn push(&mut self, time_ns: i64, values: impl IntoIterator<Item = Option<f64>>) {
        self.time.append_value(time_ns);
        let mut values = values.into_iter();
        for column in &mut self.values {
            column.append_option(values.next().flatten());
        }
    }

    /// The number of rows so far.
    pub fn rows(&self) -> usize {
        self.time.len()
    }

    /// Returns the rows so far; the next ones start a new batch.
    pub fn take(&mut self) -> RecordBatch {
        let mut columns: Vec<ArrayRef> = vec![Arc::new(self.time.finish())];
        columns.extend(self.values.iter_mut().map(|values| Arc::new(values.finish()) as ArrayRef));
        RecordBatch::try_new(self.schema(), columns).expect("columns are as the schema says")
    }
}
