//! Numbers that protocols have in their messages, over time: values of J1939, NMEA 2000, OBD-II and the others, and states of CANopen's nodes
//! and drives, without a database.
//!
//! They are read once, some records at a time, and kept: a message of a protocol may be of many frames, so that it cannot be decoded from
//! its row when it is drawn.

use std::collections::BTreeMap;
use std::convert::Infallible;

use cantap_protocols::{Event, FieldSelection, FieldValue, Options, ReadItem, Reader};
use rustc_hash::FxHashMap;
use serde::Serialize;

use crate::error::EngineError;
use crate::series::{Block, Picture, merge};
use crate::store::Store;

/// More of them are counted only: bytes and texts of strangers can have any number.
const MOST_FIELDS: usize = 4096;
/// More values than this, at 16 bytes each, are counted only.
const MOST_VALUES: usize = 8_000_000;
/// With more texts than this, a number is no state.
const MOST_TEXTS: usize = 64;
/// So many parts make up a column of a picture, at least, where there are more values.
const PARTS_PER_COLUMN: usize = 8;
/// Records that are read together.
const BATCH: usize = 1024;

/// What tells a field from the others.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Key {
    channel: u8,
    name: String,
    /// See [`FieldValue::parts`].
    parts: [String; 3],
}

/// A field and its values.
struct Field {
    key: Key,
    unit: String,
    /// Its values with their texts, as bits; `None` once a value has none or there are too many: then it is no state.
    texts: Option<BTreeMap<u64, String>>,
    /// Times in nanoseconds.
    values: Vec<(i64, f64)>,
    is_sorted: bool,
}

/// All fields.
#[derive(Default)]
pub struct Fields {
    reader: Option<(Reader, FieldSelection)>,
    /// Rows that have been read.
    scanned: usize,
    is_over: bool,
    all: Vec<Field>,
    by_key: FxHashMap<Key, usize>,
    kept: usize,
    left_out: u64,
}

/// The answer to `fields` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct FieldsAnswer {
    fields: Vec<FieldInfo>,
    read: usize,
    left_out: u64,
}

/// `FieldInfo` in `api.ts`.
#[derive(Serialize)]
struct FieldInfo {
    key: usize,
    channel: u8,
    name: String,
    between: String,
    message: String,
    which: String,
    unit: String,
    count: usize,
    texts: Vec<Text>,
}

#[derive(Serialize)]
struct Text {
    value: f64,
    text: String,
}

impl Fields {
    /// Reads the next records, `most` of them; `is_complete`: none will come after those of the store.
    pub fn read(&mut self, store: &Store, is_complete: bool, most: usize, options: impl FnOnce() -> Options) {
        if self.is_over {
            return;
        }
        let (mut reader, mut selection) =
            self.reader.take().unwrap_or_else(|| (Reader::new(options()), FieldSelection::all()));
        let end = store.len().min(self.scanned.saturating_add(most));
        self.is_over = is_complete && end == store.len();
        let mut batch = Vec::with_capacity(BATCH);
        for row in self.scanned..end {
            batch.extend(store.record(row));
            if batch.len() == BATCH {
                self.take(&mut reader, &mut selection, &batch, true);
                batch.clear();
            }
        }
        self.take(&mut reader, &mut selection, &batch, !self.is_over);
        self.scanned = end;
        self.reader = Some((reader, selection));
    }

    fn take(
        &mut self,
        reader: &mut Reader,
        selection: &mut FieldSelection,
        records: &[cantap_trace::TraceRecord],
        more: bool,
    ) {
        let result: Result<(), Infallible> = reader.take(records, more, |item| {
            if let ReadItem::Event(event) = item {
                selection.take(&event).into_iter().for_each(|value| self.push(&event, value));
            }
            Ok(())
        });
        let Ok(()) = result;
    }

    fn push(&mut self, event: &Event, found: FieldValue<'_>) {
        let FieldValue { name, parts, unit, value, text } = found;
        if !value.is_finite() {
            return;
        }
        let key = Key { channel: event.channel, name, parts };
        let known = self.by_key.get(&key).copied();
        if self.kept >= MOST_VALUES || (known.is_none() && self.all.len() >= MOST_FIELDS) {
            self.left_out += 1;
            return;
        }
        let place = known.unwrap_or_else(|| {
            self.by_key.insert(key.clone(), self.all.len());
            let texts = Some(BTreeMap::new());
            self.all.push(Field { key, unit: unit.to_owned(), texts, values: Vec::new(), is_sorted: true });
            self.all.len() - 1
        });
        let field = &mut self.all[place];
        if let Some(texts) = &mut field.texts {
            match text {
                Some(text) if texts.contains_key(&value.to_bits()) || texts.len() < MOST_TEXTS => {
                    texts
                        .entry(value.to_bits())
                        .or_insert_with(|| cantap_trace::clean::line(text).into_owned());
                }
                _ => field.texts = None,
            }
        }
        field.is_sorted &= field.values.last().is_none_or(|(last_ns, _)| *last_ns <= event.time_ns);
        field.values.push((event.time_ns, value));
        self.kept += 1;
    }

    /// The first rows are no longer there, nor is what was before this time.
    pub fn forget_first(&mut self, forgotten: usize, begin_ns: i64) {
        self.scanned = self.scanned.saturating_sub(forgotten);
        for field in &mut self.all {
            let before = field.values.len();
            field.values.retain(|(time_ns, _)| *time_ns >= begin_ns);
            self.kept -= before - field.values.len();
        }
    }

    /// All of them, as the page lists them.
    pub fn answer(&self) -> FieldsAnswer {
        let clean = |text: &str| cantap_trace::clean::line(text).into_owned();
        let info = |(key, field): (usize, &Field)| {
            let texts = field.texts.iter().flatten();
            FieldInfo {
                key,
                channel: field.key.channel,
                name: field.key.name.clone(),
                between: clean(&field.key.parts[0]),
                message: clean(&field.key.parts[1]),
                which: clean(&field.key.parts[2]),
                unit: clean(&field.unit),
                count: field.values.len(),
                texts: texts
                    .map(|(value, text)| Text { value: f64::from_bits(*value), text: text.clone() })
                    .collect(),
            }
        };
        FieldsAnswer {
            fields: self.all.iter().enumerate().map(info).collect(),
            read: self.scanned,
            left_out: self.left_out,
        }
    }

    /// The values of the time from `from_ns` to `to_ns` in at most `columns` columns, with the last one before and the first one after it.
    pub fn picture(
        &mut self,
        key: usize,
        from_ns: i64,
        to_ns: i64,
        columns: usize,
    ) -> Result<Picture, EngineError> {
        let field = self.all.get_mut(key).ok_or(EngineError::NoSignal)?;
        if !std::mem::replace(&mut field.is_sorted, true) {
            field.values.sort_by_key(|(time_ns, _)| *time_ns);
        }
        let values = &field.values;
        let first = values.partition_point(|(time_ns, _)| *time_ns < from_ns);
        let end = values.partition_point(|(time_ns, _)| *time_ns <= to_ns).max(first);
        let block = |(time_ns, value): &(i64, f64)| Block::of(*time_ns, *value);
        let columns = columns.max(1);
        let inside = &values[first..end];
        // Of very many, some together: a column's edges are shifted by less than can be seen.
        let together = (inside.len() / (columns * PARTS_PER_COLUMN)).max(1);
        let parts = inside.chunks(together).filter_map(|chunk| {
            chunk.iter().map(block).reduce(|mut sum, next| {
                sum.add(&next);
                sum
            })
        });
        let merged = merge(&parts.collect::<Vec<_>>(), columns);
        let exact = merged.iter().all(Block::is_one) && merged.len() == inside.len();
        let before = first.checked_sub(1).map(|before| block(&values[before]));
        let after = values.get(end).map(block);
        let columns = before.into_iter().chain(merged).chain(after).collect();
        Ok(Picture { columns, values: inside.len(), exact })
    }
}
