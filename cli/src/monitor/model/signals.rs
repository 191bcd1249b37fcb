//! Live values of signals, with their extremes and recent past.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;

use cantap::{Direction, TraceEvent, TraceFrame, TraceRecord};
use cantap_signals::{Alarm, Decoder, MessageRef, Signal, SignalValue};

/// Signals with a row; more than any screen shows.
const MOST_SIGNALS: usize = 1024;
/// Samples kept of each signal.
const MOST_SAMPLES: usize = 2048;
/// Values within this time become one sample with their extremes.
const SAMPLE_NS: i64 = 20_000_000;

/// Values of a short time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// When the last of them came.
    pub time_ns: i64,
    /// The smallest.
    pub min: f64,
    /// The largest.
    pub max: f64,
    /// The last.
    pub last: f64,
    /// Nothing is known of the time between the sample before and this one.
    pub after_gap: bool,
}

/// One signal on one channel.
#[derive(Clone, Debug)]
pub struct SignalRow {
    /// The channel, from 1.
    pub channel: u8,
    /// Its message.
    pub message: MessageRef,
    /// Its index in the message.
    pub signal: u32,
    /// The frame that had the last value.
    pub frame: TraceFrame,
    /// The last value's bits.
    pub raw: u64,
    /// The last value.
    pub value: f64,
    /// When it came.
    pub time_ns: i64,
    /// The smallest value so far.
    pub min: f64,
    /// The largest value so far.
    pub max: f64,
    /// The recent past, the newest last.
    pub samples: VecDeque<Sample>,
    /// In the graph.
    pub chosen: bool,
    /// Nothing is known of the time since the last sample.
    gap: bool,
}

impl SignalRow {
    /// The frame that had the last value, as a record.
    pub fn last(&self) -> TraceRecord {
        let event = TraceEvent::Frame { frame: self.frame, direction: Direction::Rx, late: false };
        TraceRecord { time_ns: self.time_ns, channel: self.channel, event }
    }
}

/// All signals seen, in order of appearance.
#[derive(Clone)]
pub struct SignalTable {
    decoder: Arc<Decoder>,
    rows: Vec<SignalRow>,
    places: HashMap<(u8, MessageRef, u32), usize>,
    values: Vec<SignalValue>,
    /// Names of signals that go into the graph when they are first seen.
    chosen: Vec<String>,
}

impl SignalTable {
    /// Nothing seen yet.
    pub fn new(decoder: Arc<Decoder>) -> Self {
        Self { decoder, rows: Vec::new(), places: HashMap::new(), values: Vec::new(), chosen: Vec::new() }
    }

    /// Takes a record.
    pub fn take(&mut self, record: &TraceRecord) {
        let Some(frame) = record.frame() else {
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
                self.rows.push(SignalRow {
                    channel: record.channel,
                    message,
                    signal: value.signal,
                    frame,
                    raw: value.raw,
                    value: value.value,
                    time_ns: record.time_ns,
                    min: value.value,
                    max: value.value,
                    samples: VecDeque::new(),
                    gap: false,
                    chosen: self.chosen.iter().any(|name| {
                        *name == self.decoder.message(message).signals[value.signal as usize].name
                    }),
                });
                self.places.insert(key, self.rows.len() - 1);
                self.rows.len() - 1
            }
            None => return,
        };
        let row = &mut self.rows[place];
        row.frame = frame;
        row.raw = value.raw;
        row.value = value.value;
        row.time_ns = record.time_ns;
        row.min = row.min.min(value.value);
        row.max = row.max.max(value.value);
        let (time_ns, last) = (record.time_ns, value.value);
        if last.is_nan() {
            // No value is none to draw, and what comes next does not continue what was before.
            row.gap = true;
            return;
        }
        // Time that runs backwards, as where a file begins anew, leaves nothing to compare with.
        if row.samples.back().is_some_and(|sample| time_ns < sample.time_ns) {
            row.samples.clear();
        }
        // A sample begins in its own slot of time, so that a fast signal does not stretch one for ever.
        let slot = time_ns.div_euclid(SAMPLE_NS);
        match row.samples.back_mut() {
            Some(sample) if sample.time_ns.div_euclid(SAMPLE_NS) == slot => {
                let (min, max) = (sample.min.min(last), sample.max.max(last));
                *sample = Sample { time_ns, min, max, last, ..*sample };
            }
            _ => {
                if row.samples.len() == MOST_SAMPLES {
                    row.samples.pop_front();
                }
                let after_gap = std::mem::take(&mut row.gap);
                row.samples.push_back(Sample { time_ns, min: last, max: last, last, after_gap });
            }
        }
    }

    /// Nothing is known of the time from here to the next values.
    pub fn interrupt(&mut self) {
        self.rows.iter_mut().for_each(|row| row.gap = true);
    }

    /// The rows.
    pub fn rows(&self) -> &[SignalRow] {
        &self.rows
    }

    /// A signal of this name goes into the graph when it is first seen.
    pub fn choose(&mut self, name: &str) {
        self.chosen.push(name.to_owned());
    }

    /// Puts a signal into the graph or takes it out.
    pub fn toggle(&mut self, row: usize) {
        if let Some(row) = self.rows.get_mut(row) {
            row.chosen = !row.chosen;
        }
    }

    /// What the database says about a row's signal.
    pub fn signal(&self, row: &SignalRow) -> &Signal {
        &self.decoder.message(row.message).signals[row.signal as usize]
    }

    /// The name of a row's message.
    pub fn message_name(&self, row: &SignalRow) -> &str {
        &self.decoder.message(row.message).name
    }

    /// The message that a frame is, by name.
    pub fn name_of(&self, record: &TraceRecord) -> Option<&str> {
        let message = self.decoder.find(record.channel, record.frame()?.id())?;
        Some(&self.decoder.message(message).name)
    }

    /// The value with its text and unit.
    pub fn text(&self, row: &SignalRow) -> String {
        let signal = self.signal(row);
        if let Some(indicator) = self.decoder.message(row.message).indicator(signal, row.raw) {
            return signal.text(row.raw).unwrap_or(indicator.name()).to_owned();
        }
        let number = signal.number(row.raw).for_people();
        match signal.text(row.raw) {
            Some(text) => format!("{number} ({text})"),
            None => format!("{number} {}", signal.unit).trim_end().to_owned(),
        }
    }

    /// As [`Self::text`] in so many columns: digits go before the unit does.
    pub fn short_text(&self, row: &SignalRow, columns: usize) -> String {
        let text = self.text(row);
        let signal = self.signal(row);
        if text.chars().count() <= columns
            || signal.unit.is_empty()
            || signal.text(row.raw).is_some()
            || row.value.is_nan()
        {
            return text.chars().take(columns).collect();
        }
        let room = columns.saturating_sub(signal.unit.chars().count() + 1);
        let fits = |text: &String| text.chars().count() <= room;
        let rounded = (0..=6).rev().map(|decimals| format!("{:.decimals$}", row.value)).find(fits);
        let number = rounded.unwrap_or_else(|| format!("{:.1e}", row.value));
        format!("{number} {}", signal.unit).chars().take(columns).collect()
    }

    /// The alarm that a row's value raises.
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

    /// Forgets all values.
    pub fn clear(&mut self) {
        self.rows.clear();
        self.places.clear();
    }
}
