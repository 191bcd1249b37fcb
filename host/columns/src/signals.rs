//! A table with a row per decoded value.

use std::sync::Arc;

use arrow_array::RecordBatch;
use arrow_array::builder::{ArrayBuilder as _, BooleanBuilder, Float64Builder, UInt32Builder, UInt64Builder};
use arrow_array::types::Int32Type;
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use cantap_signals::{Decoder, Indicator, MessageRef, SignalValue};
use cantap_trace::{TraceEvent, TraceRecord};
use rustc_hash::FxHashMap;

use crate::events::{self, Events};
use crate::texts::{Interned, Texts};

/// Decoded values as columns, in the trace's order. Events other than frames have rows too, so that a gap in a series is
/// explained.
///
/// | column | type | of |
/// |---|---|---|
/// | `time` to `tag` | as [`crate::FrameColumns`]; `event` is `value` | every row |
/// | `id`, `extended` | the frame's identifier | values |
/// | `message`, `signal` | text | values |
/// | `value` | float64: the physical value; null where the frame says that there is none | values |
/// | `raw` | uint64: the bits | values |
/// | `text` | text: the value table's, or `error` and `not available` of J1939 | values that have one |
/// | `unit` | text | signals that have one |
pub struct SignalColumns {
    schema: SchemaRef,
    events: Events,
    id: UInt32Builder,
    extended: BooleanBuilder,
    message: Texts<Int32Type>,
    signal: Texts<Int32Type>,
    value: Float64Builder,
    raw: UInt64Builder,
    text: Texts<Int32Type>,
    unit: Texts<Int32Type>,
    /// Indexed by [`MessageRef::index`].
    keys: Arc<[MessageKeys]>,
    indicators: [i32; 2],
}

/// The value of the column `event` in rows with a value.
pub const VALUE: &str = "value";

/// The indexes of a message's texts in the columns.
struct MessageKeys {
    message: i32,
    signals: Vec<SignalKeys>,
}

struct SignalKeys {
    signal: i32,
    unit: Option<i32>,
    texts: FxHashMap<i64, i32>,
}

/// The columns' names and types.
pub fn fields() -> Vec<Field> {
    let mut fields = events::fields();
    let text = Texts::<Int32Type>::data_type();
    fields.extend([
        Field::new("id", DataType::UInt32, true),
        Field::new("extended", DataType::Boolean, true),
        Field::new("message", text.clone(), true),
        Field::new("signal", text.clone(), true),
        Field::new("value", DataType::Float64, true),
        Field::new("raw", DataType::UInt64, true),
        Field::new("text", text.clone(), true),
        Field::new("unit", text, true),
    ]);
    fields
}

impl SignalColumns {
    /// A table for the values found by this decoder.
    pub fn new(decoder: &Decoder) -> Self {
        let [mut messages, mut signals, mut texts, mut units] = [(); 4].map(|()| Interned::default());
        let indicators = [Indicator::Error, Indicator::NotAvailable].map(|what| texts.place(what.name()));
        let keys = decoder.messages().map(|(_, _, message)| {
            let signals = message.signals.iter().map(|signal| SignalKeys {
                signal: signals.place(&signal.label()),
                unit: (!signal.unit.is_empty()).then(|| units.place(&signal.unit)),
                texts: signal.values.iter().map(|(raw, text)| (raw, texts.place(text))).collect(),
            });
            let signals = signals.collect();
            MessageKeys { message: messages.place(&message.name), signals }
        });
        let keys = keys.collect();
        Self {
            schema: Arc::new(Schema::new(fields())),
            events: Events::new(VALUE),
            id: UInt32Builder::new(),
            extended: BooleanBuilder::new(),
            message: Texts::new(messages.into_texts()),
            signal: Texts::new(signals.into_texts()),
            value: Float64Builder::new(),
            raw: UInt64Builder::new(),
            text: Texts::new(texts.into_texts()),
            unit: Texts::new(units.into_texts()),
            keys,
            indicators,
        }
    }

    /// An empty table for the same decoder.
    #[must_use]
    pub fn another(&self) -> Self {
        Self {
            schema: Arc::clone(&self.schema),
            events: Events::new(VALUE),
            id: UInt32Builder::new(),
            extended: BooleanBuilder::new(),
            message: self.message.another(),
            signal: self.signal.another(),
            value: Float64Builder::new(),
            raw: UInt64Builder::new(),
            text: self.text.another(),
            unit: self.unit.another(),
            keys: Arc::clone(&self.keys),
            indicators: self.indicators,
        }
    }

    /// The table's columns.
    pub fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    /// Appends a row for each value of the frame. `values` and `reference` come from [`Decoder::decode`] of the table's decoder.
    pub fn push_values(
        &mut self,
        decoder: &Decoder,
        record: &TraceRecord,
        reference: MessageRef,
        values: &[SignalValue],
    ) {
        let (Some(frame), Some(keys)) = (record.frame(), self.keys.get(reference.index())) else { return };
        let message = decoder.message(reference);
        let (id, rows) = (frame.id(), values.len());
        self.events.push_n(record, rows);
        self.id.append_value_n(id.raw(), rows);
        self.extended.append_n(rows, id.is_extended());
        self.message.push_n(keys.message, rows);
        for value in values {
            let (signal, keys_of) =
                (&message.signals[value.signal as usize], &keys.signals[value.signal as usize]);
            let indicator = message.indicator(signal, value.raw);
            let text = match indicator {
                Some(Indicator::Error) => Some(self.indicators[0]),
                Some(Indicator::NotAvailable) => Some(self.indicators[1]),
                None => None,
            };
            // A value table may also name these values itself.
            let table = || signal.table_key(value.raw).and_then(|key| keys_of.texts.get(&key)).copied();
            let named = if keys_of.texts.is_empty() { None } else { table() };
            self.signal.push(keys_of.signal);
            self.value.append_option(indicator.is_none().then_some(value.value));
            self.raw.append_value(value.raw);
            self.text.push_option(named.or(text));
            self.unit.push_option(keys_of.unit);
        }
    }

    /// Appends a row for an event other than a frame; nothing for a frame.
    pub fn push_event(&mut self, record: &TraceRecord) {
        if matches!(record.event, TraceEvent::Frame { .. }) {
            return;
        }
        self.events.push(record);
        self.id.append_null();
        self.extended.append_null();
        self.message.push_option(None);
        self.signal.push_option(None);
        self.value.append_null();
        self.raw.append_null();
        self.text.push_option(None);
        self.unit.push_option(None);
    }

    /// The number of rows so far.
    pub fn rows(&self) -> usize {
        self.raw.len()
    }

    /// Returns the rows so far; the next ones start a new batch.
    pub fn take(&mut self) -> RecordBatch {
        let mut columns = self.events.take();
        columns.push(Arc::new(self.id.finish()));
        columns.push(Arc::new(self.extended.finish()));
        columns.extend([self.message.take(), self.signal.take()]);
        columns.push(Arc::new(self.value.finish()));
        columns.push(Arc::new(self.raw.finish()));
        columns.extend([self.text.take(), self.unit.take()]);
        RecordBatch::try_new(self.schema(), columns).expect("columns are as the schema says")
    }
}
