//! Live values of signals, with their extremes and recent past.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use cantap::{Direction, TraceEvent, TraceFrame, TraceRecord};
use cantap_signals::{Alarm, Decoder, MessageRef, Selection, SelectionError, Signal, SignalValue};
use cantap_work::cut::cut;

use super::series::{BLOCK_BYTES, Series};

/// Limit for rows; more than fit on any screen.
const MOST_SIGNALS: usize = 1024;
/// The recent past keeps the last value in each such interval.
const RECENT_STEP_NS: i64 = 100_000_000;
/// How many of these it keeps: a little more than eight seconds.
const MOST_RECENT: usize = 90;
/// Minimum memory for the graph's values, in bytes.
const LEAST_ROOM: usize = 16 * BLOCK_BYTES;

/// One signal on one channel.
#[derive(Clone, Debug)]
pub struct SignalRow {
    /// The channel, from 1.
    pub channel: u8,
    /// Its message.
    pub message: MessageRef,
    /// Its index in the message.
    pub signal: u32,
    /// The frame with the last value.
    pub frame: TraceFrame,
    /// The last value's bits.
    pub raw: u64,
    /// The last value.
    pub value: f64,
    /// The time of the last value.
    pub time_ns: i64,
    /// When the value last changed.
    pub changed_ns: i64,
    /// The smallest value so far.
    pub min: f64,
    /// The largest value so far.
    pub max: f64,
    /// Values of the last seconds with their times, a few per second, the newest last.
    pub recent: VecDeque<(i64, f64)>,
    /// All its values, while it is in the graph.
    pub series: Option<Series>,
}

impl SignalRow {
    /// The frame with the last value, as a record.
    pub fn last(&self) -> TraceRecord {
        let event = TraceEvent::Frame { frame: self.frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: self.time_ns, device_ns: None, channel: self.channel, event }
    }
}

/// A signal in a frame, as text.
pub struct Decoded {
    /// The signal's name.
    pub name: String,
    /// Its value with text and unit.
    pub text: String,
    /// The alarm that it raises, if any.
    pub alarm: Option<Alarm>,
}

/// All signals seen, in order of appearance.
#[derive(Clone)]
pub struct SignalTable {
    decoder: Arc<Decoder>,
    rows: Vec<SignalRow>,
    places: HashMap<(u8, MessageRef, u32), usize>,
    values: Vec<SignalValue>,
    /// Patterns of signals to add to the graph when they are first seen.
    chosen: Vec<Selection>,
    /// Which signals were in the graph when everything was forgotten, and which were not.
    decided: HashMap<(u8, MessageRef, u32), bool>,
    /// Memory for the values of the signals in the graph, in bytes.
    room: usize,
}

impl SignalTable {
    /// Nothing has been seen yet. The values of signals in the graph take at most this many bytes.
    pub fn new(decoder: Arc<Decoder>, room: usize) -> Self {
        Self {
            decoder,
            rows: Vec::new(),
            places: HashMap::new(),
            values: Vec::new(),
            chosen: Vec::new(),
            decided: HashMap::new(),
            room: room.max(LEAST_ROOM),
        }
    }

    /// Uses other databases from now on. Nothing has been seen yet; signals with the same names as those in the graph will be
    /// added again.
    pub fn set_decoder(&mut self, decoder: Arc<Decoder>) {
        let graphed = self.rows.iter().filter(|row| row.series.is_some());
        let names = graphed.map(|row| format!("{}.{}", self.message_name(row), self.signal(row).name));
        let names: Vec<_> = names.map(|name| glob_escaped(&name)).collect();
        self.decoder = decoder;
        self.clear();
        self.decided.clear();
        self.chosen.extend(names.iter().filter_map(|name| Selection::new(&[name]).ok()));
    }

    /// Takes a record.
    pub fn take(&mut self, record: &TraceRecord) {
        let Some(frame) = record.frame() else {
            if matches!(record.event, TraceEvent::Lost { .. }) {
                self.interrupt_channel(record.channel);
            }
            return;
        };
        let mut values = std::mem::take(&mut self.values);
        if let Some(message) = self.decoder.decode(record.channel, frame, &mut values) {
            for value in &values {
                self.value(record, *frame, message, value);
            }
        }
        self.values = values;
    }

    fn value(&mut self, record: &TraceRecord, frame: TraceFrame, message: MessageRef, value: &SignalValue) {
        let key = (record.channel, message, value.signal);
        let place = match self.places.get(&key) {
            Some(place) => *place,
            None if self.rows.len() < MOST_SIGNALS => {
                let described = self.decoder.message(message);
                let signal = &described.signals[value.signal as usize];
                let by_pattern = || self.chosen.iter().any(|chosen| chosen.matches(described, signal));
                let is_chosen = self.decided.get(&key).copied().unwrap_or_else(by_pattern);
                self.rows.push(SignalRow {
                    channel: record.channel,
                    message,
                    signal: value.signal,
                    frame,
                    raw: value.raw,
                    value: value.value,
                    time_ns: record.time_ns,
                    changed_ns: record.time_ns,
                    min: value.value,
                    max: value.value,
                    recent: VecDeque::new(),
                    series: is_chosen.then(Series::default),
                });
                self.places.insert(key, self.rows.len() - 1);
                self.rows.len() - 1
            }
            None => return,
        };
        let row = &mut self.rows[place];
        if row.raw != value.raw {
            row.changed_ns = record.time_ns;
        }
        row.frame = frame;
        row.raw = value.raw;
        row.value = value.value;
        row.time_ns = record.time_ns;
        row.min = row.min.min(value.value);
        row.max = row.max.max(value.value);
        keep_recent(&mut row.recent, record.time_ns, value.value);
        if let Some(series) = &mut row.series {
            let blocks = series.blocks();
            series.push(record.time_ns, value.value);
            if series.blocks() > blocks {
                self.make_room();
            }
        }
    }

    /// Drops the oldest values of the signals in the graph.
    fn make_room(&mut self) {
        while self.graph_bytes() > self.room {
            let graphed = self.rows.iter_mut().filter_map(|row| row.series.as_mut());
            // The one that goes back farthest; current values must stay.
            let Some(oldest) =
                graphed.filter(|series| series.blocks() > 1).min_by_key(|series| series.first_ns())
            else {
                return;
            };
            oldest.cut();
        }
    }

    fn series(&self) -> impl Iterator<Item = &Series> {
        self.rows.iter().filter_map(|row| row.series.as_ref())
    }

    fn graph_bytes(&self) -> usize {
        self.series().map(|series| series.blocks() * BLOCK_BYTES).sum()
    }

    /// The number of values kept for the graph, the bytes that they take, and the limit in bytes.
    pub fn graph_memory(&self) -> (usize, usize, usize) {
        (self.series().map(Series::len).sum(), self.graph_bytes(), self.room)
    }

    /// Nothing is known about the time from here to the next values.
    pub fn interrupt(&mut self) {
        self.rows.iter_mut().filter_map(|row| row.series.as_mut()).for_each(Series::interrupt);
    }

    /// Frames of a channel are missing here: they may have contained any signal.
    fn interrupt_channel(&mut self, channel: u8) {
        let of_channel = self.rows.iter_mut().filter(|row| row.channel == channel);
        of_channel.filter_map(|row| row.series.as_mut()).for_each(Series::interrupt);
    }

    /// The rows.
    pub fn rows(&self) -> &[SignalRow] {
        &self.rows
    }

    /// Adds signals that match a pattern, such as `Speed` or `Engine.*`, to the graph when they are first seen. Fails if no signal
    /// of the databases matches.
    pub fn choose(&mut self, pattern: &str) -> Result<(), SelectionError> {
        let selection = Selection::new(&[pattern])?;
        selection.check(&self.decoder.messages().map(|(_, _, message)| message))?;
        self.chosen.push(selection);
        Ok(())
    }

    /// Adds a signal to the graph, with its past values, or removes it.
    pub fn toggle(&mut self, row: usize, past: impl Iterator<Item = TraceRecord>) {
        let Some(row) = self.rows.get_mut(row) else {
            return;
        };
        if row.series.take().is_some() {
            return;
        }
        let mut series = Series::default();
        let mut values = Vec::new();
        for record in past.filter(|record| record.channel == row.channel) {
            match (record.event, record.frame()) {
                (TraceEvent::Lost { .. }, _) => series.interrupt(),
                (_, Some(frame)) if self.decoder.find(row.channel, frame.id()) == Some(row.message) => {
                    self.decoder.decode(row.channel, frame, &mut values);
                    if let Some(value) = values.iter().find(|value| value.signal == row.signal) {
                        series.push(record.time_ns, value.value);
                    }
                }
                _ => {}
            }
        }
        row.series = Some(series);
        self.make_room();
    }

    /// The database's definition of a row's signal.
    pub fn signal(&self, row: &SignalRow) -> &Signal {
        &self.decoder.message(row.message).signals[row.signal as usize]
    }

    /// The name of a row's message.
    pub fn message_name(&self, row: &SignalRow) -> &str {
        &self.decoder.message(row.message).name
    }

    /// `Message.Signal`, the name used in searches.
    pub fn full_name(&self, row: &SignalRow) -> String {
        format!("{}.{}", self.message_name(row), self.signal(row).label())
    }

    /// The name of a frame's message.
    pub fn name_of(&self, record: &TraceRecord) -> Option<&str> {
        let message = self.decoder.find(record.channel, record.frame()?.id())?;
        Some(&self.decoder.message(message).name)
    }

    /// The value with its text and unit.
    pub fn text(&self, row: &SignalRow) -> String {
        self.raw_text(row.message, row.signal, row.raw)
    }

    fn raw_text(&self, message: MessageRef, signal: u32, raw: u64) -> String {
        let message = self.decoder.message(message);
        let signal = &message.signals[signal as usize];
        if let Some(indicator) = message.indicator(signal, raw) {
            return signal.text(raw).unwrap_or(indicator.name()).to_owned();
        }
        let number = signal.for_people(signal.number(raw));
        match signal.text(raw) {
            Some(text) => format!("{number} ({text})"),
            None => format!("{number} {}", signal.unit).trim_end().to_owned(),
        }
    }

    /// The content of a frame, signal by signal.
    pub fn in_frame(&self, channel: u8, frame: &TraceFrame) -> Vec<Decoded> {
        let mut values = Vec::new();
        let Some(message) = self.decoder.decode(channel, frame, &mut values) else {
            return Vec::new();
        };
        let decoded = values.iter().map(|value| {
            let signal = &self.decoder.message(message).signals[value.signal as usize];
            Decoded {
                name: signal.label().into_owned(),
                text: self.raw_text(message, value.signal, value.raw),
                alarm: signal.alarms.check(value.value),
            }
        });
        decoded.collect()
    }

    /// Like [`Self::text`], in this many columns: digits take precedence over the unit.
    pub fn short_text(&self, row: &SignalRow, columns: usize) -> String {
        let text = self.text(row);
        let signal = self.signal(row);
        if text.chars().count() <= columns
            || signal.unit.is_empty()
            || signal.text(row.raw).is_some()
            || row.value.is_nan()
        {
            return cut(&text, columns);
        }
        let room = columns.saturating_sub(signal.unit.chars().count() + 1);
        let fits = |text: &String| text.chars().count() <= room;
        let rounded = (0..=6).rev().map(|decimals| format!("{:.decimals$}", row.value)).find(fits);
        let number = rounded.unwrap_or_else(|| format!("{:.1e}", row.value));
        cut(&format!("{number} {}", signal.unit), columns)
    }

    /// The alarm that a row's value raises, if any.
    pub fn alarm(&self, row: &SignalRow) -> Option<Alarm> {
        self.signal(row).alarms.check(row.value)
    }

    /// Whether there is any database.
    pub fn has_database(&self) -> bool {
        self.decoder.messages().next().is_some()
    }

    /// The databases.
    pub fn decoder(&self) -> &Arc<Decoder> {
        &self.decoder
    }

    /// Forgets all values; signals in the graph return when they are seen again.
    pub fn clear(&mut self) {
        for row in self.rows.drain(..) {
            self.decided.insert((row.channel, row.message, row.signal), row.series.is_some());
        }
        self.places.clear();
    }
}

/// A name as a pattern that matches nothing else.
fn glob_escaped(name: &str) -> String {
    let escape = |character: char| match character {
        '*' | '?' | '[' => format!("[{character}]"),
        other => other.to_string(),
    };
    name.chars().map(escape).collect()
}

/// Keeps the last value in each interval.
fn keep_recent(recent: &mut VecDeque<(i64, f64)>, time_ns: i64, value: f64) {
    if value.is_nan() {
        return;
    }
    // If time goes back, as where a file restarts, there is nothing to compare with.
    if recent.back().is_some_and(|(last_ns, _)| time_ns < *last_ns) {
        recent.clear();
    }
    let step = |time_ns: i64| time_ns.div_euclid(RECENT_STEP_NS);
    match recent.back_mut() {
        Some(last) if step(last.0) == step(time_ns) => *last = (time_ns, value),
        _ => {
            if recent.len() == MOST_RECENT {
                recent.pop_front();
            }
            recent.push_back((time_ns, value));
        }
    }
}
