//! What an engineer should look at first.

use std::collections::BTreeSet;

use cantap_analysis::stats::{Statistics, WorkLoad};
use cantap_protocols::{EventKind, Party};
use cantap_signals::{Decoder, Number};
use cantap_trace::counted;
use cantap_trace::{Id, Seconds, TraceEvent};
use serde::Serialize;

use crate::alarms::{self, Beyond};
use crate::conversations;
use crate::databases::Databases;
use crate::gaps::BUS_OFF;
use crate::identifiers::intact_intervals;
use crate::index::{Index, Place};
use crate::trace::Content;

/// A window with more load than this is worth a warning, in per cent.
const HIGH_LOAD_PCT: f64 = 70.0;
/// Trouble codes are looked for in so many records: reading all protocols takes about a second for each million.
const MOST_RECORDS_READ: usize = 2_000_000;
/// A pause of so many usual periods is a missing one.
const MISSING_PERIODS: i64 = 5;
/// Shorter ones are jitter, in nanoseconds.
const SHORTEST_PAUSE_NS: i64 = 20_000_000;
/// With fewer frames, an identifier has no usual period.
const FEWEST_PERIODS: usize = 10;
/// So many findings of one kind are listed.
const MOST_OF_A_KIND: usize = 50;

/// How much it matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Frames or figures are wrong or missing.
    Error,
    /// Something is not as it should be.
    Warning,
    /// Good to know.
    Info,
}

/// `Finding` in `api.ts`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// A sentence.
    pub text: String,
    /// Where to look: seconds since the first record.
    pub time: Option<f64>,
    /// From 1.
    pub channel: Option<u8>,
    /// The identifier.
    pub id: Option<u32>,
    /// Whether it has 29 bits.
    pub extended: bool,
}

impl Finding {
    /// Without a place.
    pub fn new(severity: Severity, text: impl Into<String>) -> Self {
        Self { severity, text: text.into(), time: None, channel: None, id: None, extended: false }
    }

    /// On a channel.
    #[must_use]
    pub fn on(self, channel: u8) -> Self {
        Self { channel: Some(channel), ..self }
    }

    /// At a time, in seconds since the first record.
    #[must_use]
    pub fn at(self, time: f64) -> Self {
        Self { time: Some(time), ..self }
    }

    /// Of an identifier.
    #[must_use]
    pub fn of(self, id: Id) -> Self {
        Self { id: Some(id.raw()), extended: id.is_extended(), ..self }
    }
}

/// All findings, the worst first.
pub fn all(content: &Content, index: &Index, databases: &Databases) -> Vec<Finding> {
    let mut found = Vec::new();
    losses(content, &mut found);
    unread(content, &mut found);
    channels(content, &mut found);
    missing_periods(content, index, databases.decoder(), &mut found);
    alarms(content, index, databases.decoder(), &mut found);
    trouble_codes(content, databases, &mut found);
    found.sort_by_key(|finding: &Finding| finding.severity);
    found
}

fn losses(content: &Content, found: &mut Vec<Finding>) {
    let gaps: Vec<_> = content.gaps.all(content.end_ns()).collect();
    for gap in gaps.iter().take(MOST_OF_A_KIND) {
        let (from, to) = (content.seconds(gap.from_ns), content.seconds(gap.to_ns));
        let span = format!("between {from:.6} and {to:.6} s");
        let finding = if gap.stage == BUS_OFF {
            Finding::new(
                Severity::Error,
                format!("Channel {}: the controller was bus-off {span}", gap.channel),
            )
        } else {
            let count = match (gap.count, gap.at_least) {
                (0, true) => "an unknown number of frames".to_owned(),
                (count, true) => format!("at least {}", counted(count, "frame")),
                (count, false) => counted(count, "frame"),
            };
            Finding::new(
                Severity::Error,
                format!("Channel {}: {count} lost {span} ({})", gap.channel, gap.stage),
            )
        };
        found.push(finding.on(gap.channel).at(from));
    }
    if let Some(more) = gaps.len().checked_sub(MOST_OF_A_KIND).filter(|more| *more > 0) {
        found.push(Finding::new(
            Severity::Error,
            format!("{more} in which frames are missing", more = counted(more, "more stretch")),
        ));
    }
}

fn unread(content: &Content, found: &mut Vec<Finding>) {
    let unread = content.unread();
    let total: u64 = unread.iter().map(|(_, count)| count).sum();
    if let Some((first, _)) = unread.first() {
        let text = format!("{} of the file not read as frames; the first: {first}", counted(total, "place"));
        found.push(Finding::new(Severity::Warning, text));
    }
}

fn channels(content: &Content, found: &mut Vec<Finding>) {
    let statistics: &Statistics = &content.statistics;
    let mut channels: Vec<_> = statistics.channels().iter().collect();
    channels.sort_by_key(|channel| channel.number);
    for channel in channels {
        let number = channel.number;
        let on =
            |severity, text: String| Finding::new(severity, format!("Channel {number}: {text}")).on(number);
        if channel.errors.total() > 0 {
            let first = first_error(content, number);
            let finding = on(Severity::Error, counted(channel.errors.total(), "bus error"));
            found.push(first.map_or(finding.clone(), |time| finding.at(time)));
        }
        if channel.transmit_failures > 0 {
            found.push(on(
                Severity::Warning,
                format!("{} not sent", counted(channel.transmit_failures, "frame")),
            ));
        }
        if channel.out_of_order > 0 {
            let text = format!(
                "{} with a time before that of the one before",
                counted(channel.out_of_order, "record")
            );
            found.push(on(Severity::Warning, text));
        }
        let summary = channel.load.as_ref().and_then(WorkLoad::mean_pct);
        if let Some(peak) =
            channel.peaks().find(|peak| peak.load_pct.is_some_and(|load| load >= HIGH_LOAD_PCT))
        {
            let load = peak.load_pct.unwrap_or_default();
            let text = format!("bus load of {load:.1} % in the busiest second");
            found.push(on(Severity::Warning, text).at(content.seconds(peak.start_ns)));
        }
        if let Some(mean) = summary {
            // What is there is not shown as nothing.
            let mean = if mean > 0.0 && mean < 0.05 { "< 0.1".to_owned() } else { format!("{mean:.1}") };
            found.push(on(Severity::Info, format!("mean bus load {mean} %")));
        } else if channel.frames > 1 {
            found.push(on(
                Severity::Info,
                "no bus load, because the bit rate is not known; give it to see the load".to_owned(),
            ));
        }
        if channel.late > 0 {
            let text = format!("{} whose time is an upper bound only", counted(channel.late, "frame"));
            found.push(on(Severity::Info, text));
        }
    }
}

/// The time of the first error record of a channel.
fn first_error(content: &Content, channel: u8) -> Option<f64> {
    let store = &content.store;
    let mut first = None;
    store.each_key(0, |row, key| {
        if first.is_none() && key.id.is_none() && key.channel == channel {
            let record = store.record(row);
            let is_error = record.is_some_and(|record| {
                matches!(record.event, TraceEvent::BusError { .. } | TraceEvent::ErrorsSuppressed { .. })
            });
            first = is_error.then(|| content.seconds(store.time_ns(row)));
        }
    });
    first
}

/// Identifiers that come regularly, and once did not.
fn missing_periods(content: &Content, index: &Index, decoder: &Decoder, found: &mut Vec<Finding>) {
    let gaps: Vec<_> = content.gaps.all(content.end_ns()).collect();
    let mut all: Vec<(i64, Finding)> = Vec::new();
    for (place, rows) in index.all() {
        let intervals = intact_intervals(place, rows, &content.store, &gaps);
        if intervals.len() < FEWEST_PERIODS {
            continue;
        }
        let mut sorted: Vec<i64> = intervals.iter().map(|intact| intact.interval.ns).collect();
        sorted.sort_unstable();
        let (median, high) = (sorted[sorted.len() / 2], sorted[sorted.len() * 9 / 10]);
        // Only what is regular can be missing.
        if median <= 0 || high > median.saturating_mul(2) {
            continue;
        }
        let limit = median.saturating_mul(MISSING_PERIODS).max(SHORTEST_PAUSE_NS);
        let pauses = || intervals.iter().filter(|intact| intact.interval.ns > limit);
        let Some(pause) = pauses().max_by_key(|intact| intact.interval.ns) else { continue };
        let longest = pause.interval.ns;
        let name = name(place, decoder);
        let more = match pauses().count() - 1 {
            0 => String::new(),
            more => format!(", and {more} more for a shorter time", more = counted(more, "time")),
        };
        let text = format!(
            "{name} did not come for {:.3} s; usually it comes every {:.1} ms{more}",
            longest as f64 / 1e9,
            median as f64 / 1e6
        );
        let begin = content.seconds(pause.from_ns);
        let finding = Finding::new(Severity::Warning, text).on(place.channel).of(place.id).at(begin);
        all.push((longest / median, finding));
    }
    if index.unlisted() > 0 {
        let text = format!(
            "{} whose identifiers are too many to be listed one by one",
            counted(index.unlisted(), "frame")
        );
        found.push(Finding::new(Severity::Warning, text));
    }
    all.sort_by_key(|(periods, _)| std::cmp::Reverse(*periods));
    let more = all.len().saturating_sub(MOST_OF_A_KIND);
    found.extend(all.into_iter().take(MOST_OF_A_KIND).map(|(_, finding)| finding));
    if more > 0 {
        found.push(Finding::new(
            Severity::Warning,
            format!("{more} did not come for some time", more = counted(more, "more identifier")),
        ));
    }
}

/// Signals that were beyond the limits of their alarms.
fn alarms(content: &Content, index: &Index, decoder: &Decoder, found: &mut Vec<Finding>) {
    let all = alarms::beyond(&content.store, index, decoder);
    found.extend(all.iter().take(MOST_OF_A_KIND).map(|beyond| {
        let Beyond { place, name, unit, is_above, limit, values, farthest, first_ns } = beyond;
        let (where_, most) = if *is_above { ("above", "largest") } else { ("below", "smallest") };
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let values = counted(*values, "value");
        let text = format!(
            "{name}: {values} {where_} {limit}{unit}, the {most} {}{unit}",
            Number::Real(*farthest).for_people()
        );
        Finding::new(Severity::Warning, text).on(place.channel).of(place.id).at(content.seconds(*first_ns))
    }));
    if let Some(more) = all.len().checked_sub(MOST_OF_A_KIND).filter(|more| *more > 0) {
        let text = format!("{} beyond their alarms", counted(more, "more signal"));
        found.push(Finding::new(Severity::Warning, text));
    }
}

/// `123 (Engine)`.
pub fn name(place: Place, decoder: &Decoder) -> String {
    match decoder.find(place.channel, place.id).map(|found| decoder.message(found)) {
        Some(message) => format!("{} ({})", place.id, message.name),
        None => place.id.to_string(),
    }
}

fn trouble_codes(content: &Content, databases: &Databases, found: &mut Vec<Finding>) {
    let records = content.store.len();
    let end = if records > MOST_RECORDS_READ { content.store.time_ns(MOST_RECORDS_READ) } else { i64::MAX };
    let mut known = BTreeSet::new();
    let mut listed = Vec::new();
    conversations::read(content, databases.conversations(), i64::MIN, end.saturating_sub(1), |event| {
        let Some(cantap_protocols::Value::Text(codes)) = event.field("codes").map(|field| &field.value)
        else {
            return;
        };
        if codes.is_empty() || listed.len() > MOST_OF_A_KIND {
            return;
        }
        // Whoever asks has none of them: they are of the one that answers.
        let is_exchange = matches!(event.kind, EventKind::Exchange | EventKind::Request);
        let owner = if is_exchange && event.to != Party::Unknown { event.to } else { event.from };
        let mut from = String::new();
        owner.push_to(&mut from);
        let codes = cantap_trace::clean::line(codes).into_owned();
        if known.insert((event.channel, from.clone(), codes.clone())) {
            let text =
                format!("Channel {}: trouble codes of {from} ({}): {codes}", event.channel, event.protocol);
            let finding = Finding::new(Severity::Warning, text).on(event.channel);
            listed.push(finding.at(content.seconds(event.time_ns)));
        }
    });
    if listed.len() > MOST_OF_A_KIND {
        listed.truncate(MOST_OF_A_KIND);
        listed.push(Finding::new(Severity::Warning, "more trouble codes: see the conversations"));
    }
    found.append(&mut listed);
    if end < i64::MAX {
        let until = Seconds(end.saturating_sub(content.origin_ns()));
        let text = format!(
            "Trouble codes were looked for in the first {MOST_RECORDS_READ} records, up to {until} s"
        );
        found.push(Finding::new(Severity::Info, text));
    }
}
