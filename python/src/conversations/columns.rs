//! What protocols say as columns. Names are those of `cantap conversations --json`.

use std::sync::{Arc, LazyLock};

use arrow_array::builder::{
    ArrayBuilder as _, BinaryBuilder, BooleanBuilder, Float64Builder, StringBuilder, StringDictionaryBuilder,
    TimestampNanosecondBuilder, UInt8Builder, UInt32Builder, UInt64Builder,
};
use arrow_array::types::Int32Type;
use arrow_array::{ArrayRef, RecordBatch};
use arrow_schema::{DataType, Field as Column, Schema, SchemaRef, TimeUnit};
use cantap_columns::BATCH_ROWS;
use cantap_protocols::{Event, Field, FieldSelection, Party, Value};

use crate::error::Error;

/// Texts of which most come again and again. Those of a later batch are those of the earlier ones, and more.
type Texts = StringDictionaryBuilder<Int32Type>;

/// Rows of one kind, in batches.
pub enum Rows {
    /// One for each event.
    Events(Box<EventColumns>),
    /// One for each of its fields that are selected.
    Fields(Box<FieldColumns>),
}

impl Rows {
    /// For each event, or for the fields that have one of these names; `*` is every field.
    pub fn new(fields: &[String]) -> Result<Self, Error> {
        if fields.is_empty() {
            return Ok(Self::Events(Box::default()));
        }
        let mut selection = FieldSelection::default();
        for pattern in fields.iter().filter(|pattern| *pattern != "*") {
            if !selection.add(pattern).map_err(Error::from)? {
                return Err(Error::argument(format!(
                    "'{pattern}' does not name a field; begin it with its protocol, as 'uds.did' or 'obd.*', or give '*' for all fields"
                )));
            }
        }
        let selection = (!fields.iter().any(|pattern| pattern == "*")).then_some(selection);
        Ok(Self::Fields(Box::new(FieldColumns { selection, ..FieldColumns::default() })))
    }

    /// The names and patterns to which nothing belonged so far.
    pub fn unmatched(&self) -> Vec<String> {
        match self {
            Self::Events(_) => Vec::new(),
            Self::Fields(table) => {
                let unmatched = table.selection.iter().flat_map(FieldSelection::unmatched);
                unmatched.map(str::to_owned).collect()
            }
        }
    }

    /// The table's columns.
    pub fn schema(&self) -> SchemaRef {
        match self {
            Self::Events(_) => Arc::clone(&EVENTS),
            Self::Fields(_) => Arc::clone(&FIELDS),
        }
    }

    /// Appends an event, the one with this number.
    pub fn push(&mut self, place: u64, event: &Event) {
        match self {
            Self::Events(table) => table.push(place, event),
            Self::Fields(table) => table.push(place, event),
        }
    }

    /// The rows so far, once there are enough for a batch.
    pub fn take_full(&mut self) -> Option<RecordBatch> {
        let rows = match self {
            Self::Events(table) => table.common.place.len(),
            Self::Fields(table) => table.common.place.len(),
        };
        (rows >= BATCH_ROWS).then(|| self.take())
    }

    /// The rows so far; the next ones start a new batch.
    pub fn take(&mut self) -> RecordBatch {
        let columns = match self {
            Self::Events(table) => table.take(),
            Self::Fields(table) => table.take(),
        };
        RecordBatch::try_new(self.schema(), columns).expect("columns are as the schema says")
    }
}

/// The columns that both kinds have.
#[derive(Default)]
struct Common {
    place: UInt64Builder,
    time: TimestampNanosecondBuilder,
    channel: UInt8Builder,
    protocol: Texts,
    kind: Texts,
    from: Texts,
    to: Texts,
    title: Texts,
}

fn time_type() -> DataType {
    DataType::Timestamp(TimeUnit::Nanosecond, Some("UTC".into()))
}

fn text_type() -> DataType {
    DataType::Dictionary(Box::new(DataType::Int32), Box::new(DataType::Utf8))
}

fn schema(columns: &[(&str, DataType, bool)]) -> SchemaRef {
    let common = [
        ("place", DataType::UInt64, false),
        ("time", time_type(), false),
        ("channel", DataType::UInt8, false),
        ("protocol", text_type(), false),
        ("kind", text_type(), false),
        ("from", text_type(), true),
        ("to", text_type(), true),
        ("title", text_type(), false),
    ];
    let columns = common.iter().chain(columns);
    let columns =
        columns.map(|(name, kind, may_be_missing)| Column::new(*name, kind.clone(), *may_be_missing));
    Arc::new(Schema::new(columns.collect::<Vec<_>>()))
}

impl Common {
    fn push(&mut self, place: u64, event: &Event) {
        let party = |party: Party| (party != Party::Unknown).then(|| party.to_string());
        self.place.append_value(place);
        self.time.append_value(event.time_ns);
        self.channel.append_value(event.channel);
        self.protocol.append_value(event.protocol.name());
        self.kind.append_value(event.kind.name());
        self.from.append_option(party(event.from));
        self.to.append_option(party(event.to));
        self.title.append_value(&event.title);
    }

    fn take(&mut self) -> Vec<ArrayRef> {
        vec![
            Arc::new(self.place.finish()),
            Arc::new(self.time.finish().with_timezone("UTC")),
            Arc::new(self.channel.finish()),
            texts(&mut self.protocol),
            texts(&mut self.kind),
            texts(&mut self.from),
            texts(&mut self.to),
            texts(&mut self.title),
        ]
    }
}

fn texts(column: &mut Texts) -> ArrayRef {
    Arc::new(column.finish_preserve_values())
}

/// A row for each event.
#[derive(Default)]
pub struct EventColumns {
    common: Common,
    start: TimestampNanosecondBuilder,
    fields: StringBuilder,
    response_ms: Float64Builder,
    data: BinaryBuilder,
    frames: UInt32Builder,
    trouble: Texts,
    trouble_text: Texts,
    frames_lost: BooleanBuilder,
    /// An event's fields as JSON.
    json: String,
}

static EVENTS: LazyLock<SchemaRef> = LazyLock::new(|| {
    schema(&[
        ("start", time_type(), false),
        ("fields", DataType::Utf8, false),
        ("response_ms", DataType::Float64, true),
        ("data", DataType::Binary, false),
        ("frames", DataType::UInt32, false),
        ("trouble", text_type(), true),
        ("trouble_text", text_type(), true),
        ("frames_lost", DataType::Boolean, false),
    ])
});

impl EventColumns {
    fn push(&mut self, place: u64, event: &Event) {
        self.common.push(place, event);
        self.start.append_value(event.start_ns);
        self.json.clear();
        event.push_fields_json(&mut self.json);
        self.fields.append_value(&self.json);
        self.response_ms.append_option(event.response_ns.map(|ns| ns as f64 / 1e6));
        self.data.append_value(&event.data);
        self.frames.append_value(event.frames);
        self.trouble.append_option(event.trouble.map(|trouble| trouble.code()));
        self.trouble_text.append_option(event.trouble.map(|trouble| trouble.to_string()));
        self.frames_lost.append_value(event.frames_lost);
    }

    fn take(&mut self) -> Vec<ArrayRef> {
        let mut columns = self.common.take();
        let rest: [ArrayRef; 8] = [
            Arc::new(self.start.finish().with_timezone("UTC")),
            Arc::new(self.fields.finish()),
            Arc::new(self.response_ms.finish()),
            Arc::new(self.data.finish()),
            Arc::new(self.frames.finish()),
            texts(&mut self.trouble),
            texts(&mut self.trouble_text),
            Arc::new(self.frames_lost.finish()),
        ];
        columns.extend(rest);
        columns
    }
}

/// A row for each selected field of an event.
#[derive(Default)]
pub struct FieldColumns {
    /// `None` for all.
    selection: Option<FieldSelection>,
    common: Common,
    name: Texts,
    value: Float64Builder,
    raw: UInt64Builder,
    text: Texts,
    unit: Texts,
}

static FIELDS: LazyLock<SchemaRef> = LazyLock::new(|| {
    schema(&[
        ("name", text_type(), false),
        ("value", DataType::Float64, true),
        ("raw", DataType::UInt64, true),
        ("text", text_type(), true),
        ("unit", text_type(), true),
    ])
});

impl FieldColumns {
    fn push(&mut self, place: u64, event: &Event) {
        let fields = match &mut self.selection {
            Some(selection) => selection.fields(event),
            None => FieldSelection::all_fields(event),
        };
        for (name, field) in fields {
            self.common.push(place, event);
            let Field { value, unit, .. } = field;
            let raw = match value {
                Value::Number(number) => u64::try_from(*number).ok(),
                Value::Hex(number, _) => Some(*number),
                _ => None,
            };
            self.name.append_value(name);
            self.value.append_option(value.as_number());
            self.raw.append_option(raw);
            self.text.append_option(field.text_for_tables());
            self.unit.append_option((!unit.is_empty()).then_some(unit));
        }
    }

    fn take(&mut self) -> Vec<ArrayRef> {
        let mut columns = self.common.take();
        let value: [ArrayRef; 2] = [Arc::new(self.value.finish()), Arc::new(self.raw.finish())];
        columns.push(texts(&mut self.name));
        columns.extend(value);
        columns.extend([texts(&mut self.text), texts(&mut self.unit)]);
        columns
    }
}
