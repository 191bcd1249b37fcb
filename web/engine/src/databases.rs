//! The databases: those that were opened, the user's own, and the keys by which the page names messages and signals.

use std::collections::BTreeSet;
use std::sync::Arc;

use cantap_protocols::Options;
use cantap_signals::{
    ByteOrder, Database, Decoder, Message, MessageRef, Multiplexed, Signal, Source, ValueKind,
};
use cantap_trace::TraceRecord;
use rustc_hash::FxHashMap;
use serde::Serialize;

use crate::descriptions::{Connections, Descriptions};
use crate::error::EngineError;
use crate::index::{Index, Place};
use crate::own_database::{OwnDatabase, ValueText};

/// Bits of a key that are the signal's place in its message.
const SIGNAL_BITS: u32 = 20;

/// What was taken from a database, or from a description of what conversations are about: then `messages` are what it describes.
#[derive(Serialize)]
pub struct Loaded {
    messages: usize,
    signals: usize,
    warnings: Vec<String>,
}

impl Loaded {
    /// Of this database.
    pub fn of(database: &Database) -> Self {
        Self {
            messages: database.messages.len(),
            signals: database.messages.iter().map(|message| message.signals.len()).sum(),
            warnings: database.warnings.iter().map(ToString::to_string).collect(),
        }
    }
}

/// A message where it occurs, or where it could.
#[derive(Clone, Copy)]
struct Entry {
    message: MessageRef,
    /// `None` if it does not occur.
    place: Option<Place>,
}

/// One signal of an identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SignalPlace {
    /// The message in the decoder.
    pub message: MessageRef,
    /// The signal's index in it.
    pub signal: usize,
    /// Where it occurs; `None` if it does not.
    pub place: Option<Place>,
}

/// All databases.
pub struct Databases {
    sources: Vec<Source>,
    /// What the user made.
    pub own: OwnDatabase,
    decoder: Decoder,
    entries: Vec<Entry>,
    by_place: FxHashMap<Place, usize>,
    descriptions: Descriptions,
}

impl Default for Databases {
    fn default() -> Self {
        Self {
            sources: Vec::new(),
            own: OwnDatabase::default(),
            decoder: Decoder::new(Vec::new()),
            entries: Vec::new(),
            by_place: FxHashMap::default(),
            descriptions: Descriptions::default(),
        }
    }
}

impl Databases {
    /// Adds a description, or a database for one channel or all; one of the same name and channel is replaced.
    pub fn add(&mut self, name: &str, bytes: &[u8], channel: Option<u8>) -> Result<Loaded, EngineError> {
        if Descriptions::are_in(name) {
            let (messages, warnings) = self.descriptions.add(name, bytes)?;
            return Ok(Loaded { messages, signals: 0, warnings });
        }
        let database = cantap_signals::parse(name, bytes)?;
        let loaded = Loaded::of(&database);
        self.sources.retain(|source| source.database.file != database.file || source.channel != channel);
        self.sources.push(Source { channel, database });
        self.rebuild();
        Ok(loaded)
    }

    /// See [`Descriptions::connect`].
    pub fn connect(&mut self, connections: &Connections) -> Result<(), EngineError> {
        self.descriptions.connect(connections)
    }

    /// Compiles them anew; all keys of before are void.
    pub fn rebuild(&mut self) {
        let mut sources = self.sources.clone();
        if let Some(own) = self.own.database() {
            // A channel that has databases of its own does not look into those for all.
            let channels: BTreeSet<_> = sources.iter().map(|source| source.channel).chain([None]).collect();
            let of = |channel| Source { channel, database: own.clone() };
            sources.extend(channels.into_iter().map(of));
        }
        self.decoder = Decoder::new(sources);
        self.entries.clear();
        self.by_place.clear();
    }

    /// The decoder of all of them.
    pub const fn decoder(&self) -> &Decoder {
        &self.decoder
    }

    /// How conversations are read.
    pub fn conversations(&self) -> Options {
        Options { decoder: Some(Arc::new(self.decoder.clone())), ..self.descriptions.options().clone() }
    }

    /// The message of an identifier.
    pub fn message(&self, place: Place) -> Option<&Message> {
        self.decoder.find(place.channel, place.id).map(|found| self.decoder.message(found))
    }

    /// Gives keys to messages that have none yet. A key stays what it is while the trace grows.
    fn extend(&mut self, index: &Index) {
        if self.entries.is_empty() {
            let all = self.decoder.messages().map(|(message, ..)| Entry { message, place: None });
            self.entries = all.collect();
        }
        for (place, _) in index.all() {
            if self.by_place.contains_key(&place) {
                continue;
            }
            let Some(message) = self.decoder.find(place.channel, place.id) else { continue };
            let entry = Entry { message, place: Some(place) };
            let first = self.entries.get_mut(message.index()).filter(|first| first.place.is_none());
            let key = if let Some(first) = first {
                *first = entry;
                message.index()
            } else {
                self.entries.push(entry);
                self.entries.len() - 1
            };
            self.by_place.insert(place, key);
        }
    }

    /// All messages for the page.
    pub fn messages(&mut self, index: &Index) -> Vec<MessageInfo> {
        self.extend(index);
        let info = |(key, entry): (usize, &Entry)| {
            let message = self.decoder.message(entry.message);
            let channel =
                entry.place.map(|place| place.channel).or_else(|| self.decoder.channel(entry.message));
            let id = entry.place.map_or(message.id, |place| place.id);
            MessageInfo {
                key: key as u64,
                name: message.name.clone(),
                channel,
                id: id.raw(),
                extended: id.is_extended(),
                length: message.length,
                count: entry.place.map_or(0, |place| index.frames(place)),
                comment: message.description.clone(),
                signals: signal_infos(message, key),
            }
        };
        self.entries.iter().enumerate().map(info).collect()
    }

    /// The signals of an identifier, for the page.
    pub fn signals_of(&mut self, place: Place, index: &Index) -> Vec<SignalInfo> {
        self.extend(index);
        let Some(message) = self.decoder.find(place.channel, place.id) else { return Vec::new() };
        let key = self.by_place.get(&place).copied().unwrap_or(message.index());
        signal_infos(self.decoder.message(message), key)
    }

    /// What a signal's key means.
    pub fn signal(&self, key: u64) -> Result<SignalPlace, EngineError> {
        let (entry, signal) = ((key >> SIGNAL_BITS) as usize, (key & ((1 << SIGNAL_BITS) - 1)) as usize);
        let entry = self.entries.get(entry).ok_or(EngineError::NoSignal)?;
        let message = self.decoder.message(entry.message);
        message.signals.get(signal).ok_or(EngineError::NoSignal)?;
        Ok(SignalPlace { message: entry.message, signal, place: entry.place })
    }

    /// The signals of a record, those too that this frame does not carry.
    pub fn values(&self, record: &TraceRecord) -> Vec<Value> {
        let mut values = Vec::new();
        let found = record.frame().and_then(|frame| self.decoder.decode(record.channel, frame, &mut values));
        let Some(message) = found.map(|found| self.decoder.message(found)) else { return Vec::new() };
        let one = |(place, signal): (usize, &Signal)| {
            let value = values.iter().rfind(|value| value.signal as usize == place);
            let reading = value.map(|value| cantap_signals::Reading::of(message, value));
            let number = reading.as_ref().and_then(|reading| reading.number);
            let text = reading.as_ref().map_or(String::new(), |reading| match reading.text_or_indicator() {
                Some(text) => text.to_owned(),
                None => number.map_or(String::new(), |number| signal.for_people(number).to_string()),
            });
            let value = number.map(cantap_signals::Number::as_f64).filter(|value| value.is_finite());
            Value { name: signal.label().into_owned(), number: value, text, unit: signal.unit.clone() }
        };
        message.signals.iter().enumerate().map(one).collect()
    }
}

/// A message for the page: `MessageInfo` in `api.ts`.
#[derive(Serialize)]
pub struct MessageInfo {
    key: u64,
    name: String,
    channel: Option<u8>,
    id: u32,
    extended: bool,
    length: u16,
    count: usize,
    comment: String,
    signals: Vec<SignalInfo>,
}

/// A signal for the page: `SignalInfo` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct SignalInfo {
    key: u64,
    name: String,
    unit: String,
    comment: String,
    min: Option<f64>,
    max: Option<f64>,
    alarms: AlarmLimits,
    texts: Vec<ValueText>,
    start_bit: u16,
    bit_length: u16,
    little_endian: bool,
    signed: bool,
    float: bool,
    factor: f64,
    offset: f64,
    multiplex: String,
}

/// Physical values; `None` without one.
#[derive(Serialize)]
struct AlarmLimits {
    min: Option<f64>,
    max: Option<f64>,
}

/// A signal's value for the page: `SignalValue` in `api.ts`.
#[derive(Serialize)]
pub struct Value {
    name: String,
    #[serde(rename = "value")]
    number: Option<f64>,
    text: String,
    unit: String,
}

fn signal_infos(message: &Message, key: usize) -> Vec<SignalInfo> {
    let info = |(place, signal): (usize, &Signal)| SignalInfo {
        key: (key as u64) << SIGNAL_BITS | place as u64,
        name: signal.label().into_owned(),
        unit: signal.unit.clone(),
        comment: signal.description.clone(),
        min: signal.min,
        max: signal.max,
        alarms: AlarmLimits { min: signal.alarms.min, max: signal.alarms.max },
        texts: texts(signal),
        start_bit: signal.start,
        bit_length: signal.length,
        little_endian: signal.order == ByteOrder::Little,
        signed: !matches!(signal.kind, ValueKind::Unsigned),
        float: matches!(signal.kind, ValueKind::Half | ValueKind::Single | ValueKind::Double),
        factor: signal.factor,
        offset: signal.offset,
        multiplex: multiplex(signal),
    };
    message.signals.iter().enumerate().map(info).collect()
}

/// The texts of a signal by its physical values, as graphs have them.
fn texts(signal: &Signal) -> Vec<ValueText> {
    let physical = |raw: i64| raw as f64 * signal.factor + signal.offset;
    signal
        .values
        .iter()
        .map(|(raw, text)| ValueText { value: physical(raw), text: text.to_owned() })
        .collect()
}

/// As a DBC writes it: `M`, `m3`, `m3M`; with several values `m3-5,7`.
pub fn multiplex(signal: &Signal) -> String {
    let mut text = String::new();
    if let Some(Multiplexed { values, .. }) = &signal.multiplexed {
        let one = |range: &std::ops::RangeInclusive<u64>| match (range.start(), range.end()) {
            (first, last) if first == last => first.to_string(),
            (first, last) => format!("{first}-{last}"),
        };
        text = format!("m{}", values.iter().map(one).collect::<Vec<_>>().join(","));
    }
    if signal.is_switch {
        text.push('M');
    }
    text
}
