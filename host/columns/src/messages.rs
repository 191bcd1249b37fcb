//! A table of one message: a row per frame, a column per signal.

use std::collections::HashMap;
use std::sync::Arc;

use arrow_array::builder::{ArrayBuilder as _, Float64Builder};
use arrow_array::types::Int32Type;
use arrow_array::{ArrayRef, RecordBatch, TimestampNanosecondArray, UInt8Array, UInt32Array};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use cantap_signals::{Decoder, MessageRef, MessageRows, Signal, SignalRows, SignalValue};
use cantap_trace::{Id, PlainFrame, TraceRecord};
use rustc_hash::FxHashMap;

use crate::events;
use crate::names::{ColumnNames, text_column};
use crate::texts::{Interned, Texts};

/// One message's frames as columns: `time`, `channel`, `id`, then for each signal its physical value as float64 under its own name,
/// null if the frame does not have it; for a signal with a value table also `NAME.text`. A signal whose name another column has
/// already is called `MESSAGE.NAME`. Unit, description, range and cycle time are in the metadata of the columns and the table.
pub struct MessageColumns {
    schema: SchemaRef,
    /// Columns that every row has.
    time_ns: Vec<i64>,
    channel: Vec<u8>,
    id: Vec<u32>,
    signals: Vec<Column>,
    /// Frames that are not in the columns yet. Columns are built once the number of rows is known, because a column that grows is copied again and
    /// again; for the same reason these frames are kept in blocks.
    full: Vec<Vec<PlainFrame>>,
    full_rows: usize,
    last: Vec<PlainFrame>,
    rows: MessageRows,
    values: u64,
    scratch: Scratch,
}

/// How many frames stand in a block: as many as [`MessageRows`] decodes at once.
const BLOCK_FRAMES: usize = 512;

struct Column {
    value: Float64Builder,
    text: Option<(Texts<Int32Type>, Keys)>,
}

/// The texts' indexes, by a signal's value in the frame.
enum Keys {
    /// For a short signal, by its bits; [`NO_TEXT`] if the table has none.
    ByBits(Vec<i32>),
    /// By [`Signal::table_key`].
    ByValue(FxHashMap<i64, i32>),
}

const NO_TEXT: i32 = -1;

#[derive(Default)]
struct Scratch {
    values: Vec<SignalValue>,
    is_value: Vec<bool>,
    keys: Vec<i32>,
    is_text: Vec<bool>,
}

impl Keys {
    /// Longer signals have a table by value rather than by bits.
    const MOST_BITS: u16 = 8;

    /// The column for a signal's texts, and their indexes in it.
    fn of(signal: &Signal) -> (Texts<Int32Type>, Self) {
        // Two values may have the same text, which is in the column's texts once: programs that read it demand that.
        let mut texts = Interned::default();
        let places: FxHashMap<i64, i32> =
            signal.values.iter().map(|(value, text)| (value, texts.place(text))).collect();
        let keys = Self::by_places(signal, places);
        (Texts::new(texts.into_texts()), keys)
    }

    fn by_places(signal: &Signal, places: FxHashMap<i64, i32>) -> Self {
        if !(1..=Self::MOST_BITS).contains(&signal.length) {
            return Self::ByValue(places);
        }
        let place = |raw| signal.table_key(raw).and_then(|key| places.get(&key)).copied();
        Self::ByBits((0..1 << signal.length).map(|raw| place(raw).unwrap_or(NO_TEXT)).collect())
    }

    /// Appends those of several values.
    fn get_all(&self, signal: &Signal, raw: &[u64], keys: &mut Vec<i32>) {
        match self {
            Self::ByBits(places) => {
                keys.extend(raw.iter().map(|raw| places.get(*raw as usize).copied().unwrap_or(NO_TEXT)));
            }
            Self::ByValue(_) => keys.extend(raw.iter().map(|raw| self.get(signal, *raw))),
        }
    }

    fn get(&self, signal: &Signal, raw: u64) -> i32 {
        match self {
            Self::ByBits(places) => places.get(raw as usize).copied(),
            Self::ByValue(places) => signal.table_key(raw).and_then(|key| places.get(&key)).copied(),
        }
        .unwrap_or(NO_TEXT)
    }
}

impl MessageColumns {
    /// A table for a message of this decoder: of its signals, those chosen up to now have values.
    pub fn new(decoder: &Decoder, reference: MessageRef) -> Self {
        let message = decoder.message(reference);
        let mut fields = events::fields();
        fields.truncate(2);
        fields.push(Field::new("id", DataType::UInt32, false));
        let mut names = ColumnNames::of(&fields);
        let mut signals = Vec::new();
        for signal in &message.signals {
            let has_texts = !signal.values.is_empty();
            let name = names.choose(&signal.label(), &message.name, has_texts);
            fields.push(Field::new(&*name, DataType::Float64, true).with_metadata(metadata(signal)));
            let text = has_texts.then(|| {
                fields.push(Field::new(text_column(&name), Texts::<Int32Type>::data_type(), true));
                Keys::of(signal)
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
            time_ns: Vec::new(),
            channel: Vec::new(),
            id: Vec::new(),
            signals,
            full: Vec::new(),
            full_rows: 0,
            last: Vec::new(),
            rows: decoder.rows(reference),
            values: 0,
            scratch: Scratch::default(),
        }
    }

    /// The table's columns.
    pub fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    /// Whether a frame of so many bytes has a value for the table, whatever they are: chosen signals may be there in some frames only.
    pub fn has_value(&self, data_len: usize) -> bool {
        self.rows.is_certain(data_len)
    }

    /// Appends a row for a data frame of the message, decoding it; nothing for another record.
    #[inline]
    pub fn push(&mut self, record: &TraceRecord) {
        let Some(frame) = record.frame() else { return };
        match PlainFrame::of(record) {
            Some(frame) => self.push_frame(&frame),
            None => self.push_one(record.time_ns, record.channel, frame.id(), frame.data()),
        }
    }

    /// Appends a row for a frame of the message, as [`Self::push`] does for its record.
    #[inline]
    pub fn push_frame(&mut self, frame: &PlainFrame) {
        if self.last.len() < self.last.capacity() {
            self.last.push(*frame);
        } else {
            self.push_beyond(frame);
        }
    }

    /// A frame that begins a block, or must not be in one.
    #[cold]
    #[inline(never)]
    fn push_beyond(&mut self, frame: &PlainFrame) {
        if self.rows.message().container.is_some() {
            let bytes = frame.data.to_le_bytes();
            self.push_one(frame.time_ns, frame.channel, frame.id, &bytes[..usize::from(frame.len)]);
            return;
        }
        let full = std::mem::replace(&mut self.last, Vec::with_capacity(BLOCK_FRAMES));
        if !full.is_empty() {
            self.full_rows += full.len();
            self.full.push(full);
        }
        self.last.push(*frame);
    }

    /// Appends a row for a frame that cannot be decoded together with others.
    fn push_one(&mut self, time_ns: i64, channel: u8, id: Id, data: &[u8]) {
        let mut values = std::mem::take(&mut self.scratch.values);
        values.clear();
        self.rows.one(data, &mut values);
        self.push_row(time_ns, channel, id, &values);
        self.scratch.values = values;
    }

    /// Appends a row for a frame of the message, with the values decoded from it; nothing for another record.
    pub fn push_values(&mut self, record: &TraceRecord, values: &[SignalValue]) {
        let Some(frame) = record.frame() else { return };
        self.push_row(record.time_ns, record.channel, frame.id(), values);
    }

    fn push_row(&mut self, time_ns: i64, channel: u8, id: Id, values: &[SignalValue]) {
        self.decode();
        self.time_ns.push(time_ns);
        self.channel.push(channel);
        self.id.push(id.raw());
        self.values += values.len() as u64;
        let message = self.rows.message();
        for value in values {
            let signal = &message.signals[value.signal as usize];
            let column = &mut self.signals[value.signal as usize];
            let is_value = message.indicator(signal, value.raw).is_none();
            column.value.append_option(is_value.then_some(value.value));
            if let Some((texts, keys)) = &mut column.text {
                texts.push_option(Some(keys.get(signal, value.raw)).filter(|key| *key != NO_TEXT));
            }
        }
        self.fill();
    }

    fn waiting_rows(&self) -> usize {
        self.full_rows + self.last.len()
    }

    /// How many values at most the frames have that wait for being decoded.
    pub(crate) fn waiting_cells(&self) -> usize {
        self.waiting_rows() * self.signals.len()
    }

    /// Decodes the frames that wait for it.
    pub(crate) fn decode(&mut self) {
        let count = self.waiting_rows();
        if count == 0 {
            return;
        }
        let Self { time_ns, channel, id, signals, full, full_rows, last, rows, values, scratch, .. } = self;
        time_ns.reserve(count);
        channel.reserve(count);
        id.reserve(count);
        for mut block in full.drain(..).chain([std::mem::take(last)]) {
            time_ns.extend(block.iter().map(|frame| frame.time_ns));
            channel.extend(block.iter().map(|frame| frame.channel));
            id.extend(block.iter().map(|frame| frame.id.raw()));
            rows.push_words(block.iter().map(|frame| (frame.data, frame.len)));
            rows.decode(|message, found| {
                let signal = &message.signals[found.signal as usize];
                let column = &mut signals[found.signal as usize];
                column.expect(count);
                column.push(signal, &found, scratch);
                let there = |there: &[bool]| there.iter().filter(|there| **there).count();
                *values += found.there.map_or(found.raw.len(), there) as u64;
            });
            block.clear();
            *last = block;
        }
        *full_rows = 0;
        self.fill();
    }

    /// Appends nulls to columns without a value in the last rows.
    fn fill(&mut self) {
        let rows = self.time_ns.len();
        for column in &mut self.signals {
            let missing = rows - column.value.len();
            if missing > 0 {
                column.value.append_nulls(missing);
                if let Some((texts, _)) = &mut column.text {
                    texts.push_none(missing);
                }
            }
        }
    }

    /// The number of rows so far.
    pub fn rows(&self) -> usize {
        self.time_ns.len() + self.waiting_rows()
    }

    /// The number of values decoded so far, including those that only say that there is none.
    pub fn values(&mut self) -> u64 {
        self.decode();
        self.values
    }

    /// Returns the rows so far; the next ones start a new batch.
    pub fn take(&mut self) -> RecordBatch {
        self.decode();
        let time = TimestampNanosecondArray::from(std::mem::take(&mut self.time_ns));
        let mut columns: Vec<ArrayRef> = vec![
            Arc::new(time.with_timezone(events::UTC)),
            Arc::new(UInt8Array::from(std::mem::take(&mut self.channel))),
            Arc::new(UInt32Array::from(std::mem::take(&mut self.id))),
        ];
        for column in &mut self.signals {
            columns.push(Arc::new(column.value.finish()));
            columns.extend(column.text.as_mut().map(|(texts, _)| texts.take()));
        }
        RecordBatch::try_new(self.schema(), columns).expect("columns are as the schema says")
    }
}

impl Column {
    /// Makes room for so many rows in a column that has none yet.
    fn expect(&mut self, rows: usize) {
        if self.value.is_empty() {
            self.value = Float64Builder::with_capacity(rows);
            if let Some((texts, _)) = &mut self.text {
                texts.expect(rows);
            }
        }
    }

    /// Appends a signal's values in several frames.
    fn push(&mut self, signal: &Signal, rows: &SignalRows, scratch: &mut Scratch) {
        let is_there = |at: usize| rows.there.is_none_or(|there| there[at]);
        match (rows.there, rows.indicators) {
            (None, None) => self.value.append_slice(rows.value),
            (Some(there), None) => self.value.append_values(rows.value, there),
            (_, Some(indicators)) => {
                let is_value = |(at, is_indicator): (usize, &bool)| !is_indicator && is_there(at);
                scratch.is_value.clear();
                scratch.is_value.extend(indicators.iter().enumerate().map(is_value));
                self.value.append_values(rows.value, &scratch.is_value);
            }
        }
        if let Some((texts, keys)) = &mut self.text {
            scratch.keys.clear();
            keys.get_all(signal, rows.raw, &mut scratch.keys);
            if rows.there.is_none() && !scratch.keys.contains(&NO_TEXT) {
                texts.push_slice(&scratch.keys);
                return;
            }
            scratch.is_text.clear();
            let is_text = |(at, key): (usize, &i32)| *key != NO_TEXT && is_there(at);
            scratch.is_text.extend(scratch.keys.iter().enumerate().map(is_text));
            texts.push_all(&scratch.keys, &scratch.is_text);
        }
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
