//! A table of one message: a row per frame, a column per signal.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_array::builder::{
    ArrayBuilder as _, Float64Builder, TimestampNanosecondBuilder, UInt8Builder, UInt32Builder,
};
use arrow_array::types::Int32Type;
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use cantap_signals::{Message, Signal, SignalValue};
use cantap_trace::TraceRecord;

use crate::events;
use crate::texts::Texts;

/// One message's frames as columns: `time`, `channel`, `id`, then for each signal its physical value as float64 under its own name,
/// null where the frame does not have it; for a signal with a value table also `NAME.text`. Unit, description, range and cycle
/// time are the columns' and the table's metadata.
pub struct MessageColumns {
    schema: SchemaRef,
    time: TimestampNanosecondBuilder,
    channel: UInt8Builder,
    id: UInt32Builder,
    signals: Vec<Column>,
}

struct Column {
    value: Float64Builder,
    text: Option<(Texts<Int32Type>, HashMap<i64, i32>)>,
}

impl MessageColumns {
    /// A table for this message.
    pub fn new(message: &Message) -> Self {
        let mut fields = events::fields();
        fields.truncate(2);
        fields.push(Field::new("id", DataType::UInt32, false));
        let mut signals = Vec::new();
        for signal in &message.signals {
            let label = signal.label();
            fields.push(Field::new(&*label, DataType::Float64, true).with_metadata(metadata(signal)));
            let text = (!signal.values.is_empty()).then(|| {
                fields.push(Field::new(format!("{label}.text"), Texts::<Int32Type>::data_type(), true));
                let places = signal.values.iter().enumerate().map(|(place, (raw, _))| (raw, place as i32));
                (Texts::new(signal.values.iter().map(|(_, text)| text)), places.collect())
            });
            signals.push(Column { value: Float64Builder::new(), text });
        }
        let mut about = HashMap::from([("message".to_owned(), message.name.clone())]);
        about.insert("id".to_owned(), message.id.to_string());
        if !message.description.is_empty() {
            about.insert("description".to_owned(), message.description.clone());
        }
        if let Some(cycle_ms) = message.cycle_ms {
            about.insert("cycle_ms".to_owned(), cycle_ms.to_string());
        }
        Self {
            schema: Arc::new(Schema::new_with_metadata(fields, about)),
            time: TimestampNanosecondBuilder::new().with_timezone(events::UTC),
            channel: UInt8Builder::new(),
            id: UInt32Builder::new(),
            signals,
        }
    }

    /// The table's columns.
    pub fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    /// Appends a row for a frame of the message, with the values that were decoded from it; nothing for another record.
    pub fn push(&mut self, message: &Message, record: &TraceRecord, values: &[SignalValue]) {
        let Some(frame) = record.frame() else { return };
        self.time.append_value(record.time_ns);
        self.channel.append_value(record.channel);
        self.id.append_value(frame.id().raw());
        for value in values {
            let signal = &message.signals[value.signal as usize];
            let column = &mut self.signals[value.signal as usize];
            let is_value = message.indicator(signal, value.raw).is_none();
            column.value.append_option(is_value.then_some(value.value));
            if let Some((texts, places)) = &mut column.text {
                texts.push_option(signal.table_key(value.raw).and_then(|key| places.get(&key)).copied());
            }
        }
        let rows = self.time.len();
        for column in self.signals.iter_mut().filter(|column| column.value.len() < rows) {
            column.value.append_null();
            if let Some((texts, _)) = &mut column.text {
                texts.push_option(None);
            }
        }
    }

    /// Rows so far.
    pub fn rows(&self) -> usize {
        self.time.len()
    }

    /// The rows so far; the next ones begin a new batch.
    pub fn take(&mut self) -> RecordBatch {
        let mut columns: Vec<ArrayRef> =
            vec![Arc::new(self.time.finish()), Arc::new(self.channel.finish()), Arc::new(self.id.finish())];
        for column in &mut self.signals {
            columns.push(Arc::new(column.value.finish()));
            columns.extend(column.text.as_mut().map(|(texts, _)| texts.take()));
        }
        RecordBatch::try_new(self.schema(), columns).expect("columns are as the schema says")
    }
}

fn metadata(signal: &Signal) -> HashMap<String, String> {
    let mut about = HashMap::new();
    for (key, text) in [("unit", &signal.unit), ("description", &signal.description)] {
        if !text.is_empty() {
            about.insert(key.to_owned(), text.clone());
        }
    }
    for (key, limit) in [("min", signal.min), ("max", signal.max)] {
        if let Some(limit) = limit {
            about.insert(key.to_owned(), limit.to_string());
        }
    }
    about
}
