//! One identifier: its last frame at a time, its bits, its periods.

use cantap_trace::{Interval, TraceEvent};
use serde::Serialize;

use crate::databases::{Databases, SignalInfo, Value};
use crate::gaps::Gap;
use crate::index::{Index, Place, first_after, window};
use crate::message::{Floats, Integers, Sections};
use crate::row::hex;
use crate::store::Store;
use crate::trace::Content;

/// Periods and changes are those of so many frames before the time.
const RECENT: usize = 512;
/// The bits of the longest frame.
const MOST_BITS: usize = 512;
/// Stretches of a histogram, of which the last reaches to the longest period.
const BINS: usize = 60;

/// `IdRow` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct IdRow {
    channel: u8,
    id: u32,
    extended: bool,
    message: Option<String>,
    count: usize,
    period: Option<PeriodOf>,
    last_time: f64,
    last_data: String,
    changed: Floats,
    signals: Vec<Value>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct PeriodOf {
    median: f64,
    min: f64,
    max: f64,
    by_device: bool,
}

/// All identifiers that came up to a time.
pub fn rows_at(
    at_ns: i64,
    content: &Content,
    index: &Index,
    databases: &Databases,
    sections: &mut Sections,
) -> Vec<IdRow> {
    let store = &content.store;
    let mut rows: Vec<IdRow> = Vec::new();
    for (place, list) in index.all() {
        let count = first_after(list, store, at_ns);
        let Some(record) = count.checked_sub(1).and_then(|last| store.record(list[last] as usize)) else {
            continue;
        };
        let recent = &list[count.saturating_sub(RECENT)..count];
        let frame = record.frame();
        let data = frame.map_or(&[][..], |frame| frame.data());
        rows.push(IdRow {
            channel: place.channel,
            id: place.id.raw(),
            extended: place.id.is_extended(),
            message: databases.message(place).map(|message| message.name.clone()),
            count: index.frames(place) - (list.len() - count),
            period: period(recent, store),
            last_time: content.seconds(record.time_ns),
            last_data: hex(data),
            changed: sections.floats(&changes(recent, content, data.len())),
            signals: databases.values(&record),
        });
    }
    rows.sort_by_key(|row| (row.channel, row.extended, row.id));
    rows
}

fn period(recent: &[u32], store: &Store) -> Option<PeriodOf> {
    let between = |pair: &[u32]| store.interval(pair[0] as usize, pair[1] as usize);
    let mut intervals: Vec<Interval> = recent.windows(2).map(between).collect();
    let by_device = intervals.iter().all(|interval| interval.by_device);
    intervals.sort_unstable_by_key(|interval| interval.ns);
    let seconds = |interval: &Interval| interval.ns as f64 / 1e9;
    let (min, max) = (seconds(intervals.first()?), seconds(intervals.last()?));
    Some(PeriodOf { median: seconds(&intervals[intervals.len() / 2]), min, max, by_device })
}

/// A row's data bytes.
fn data_of(store: &Store, row: u32, bytes: &mut Vec<u8>) {
    bytes.clear();
    if let Some((data, len)) = store.short_data(row as usize) {
        bytes.extend_from_slice(&data[..len]);
    } else if let Some(TraceEvent::Frame { frame, .. }) =
        store.record(row as usize).map(|record| record.event)
    {
        bytes.extend_from_slice(frame.data());
    }
}

/// For each bit, first byte and highest bit first, when it last changed; not-a-number if it did not.
fn changes(recent: &[u32], content: &Content, bytes: usize) -> Vec<f64> {
    let mut changed = vec![f64::NAN; bytes * 8];
    let mut left = changed.len();
    let (mut later, mut earlier) = (Vec::new(), Vec::new());
    if let Some(last) = recent.last() {
        data_of(&content.store, *last, &mut later);
    }
    for pair in recent.windows(2).rev() {
        if left == 0 {
            break;
        }
        data_of(&content.store, pair[0], &mut earlier);
        if earlier != later {
            let time = content.seconds(content.store.time_ns(pair[1] as usize));
            for (byte, (a, b)) in earlier.iter().zip(&later).enumerate() {
                for bit in (0..8).filter(|bit| (a ^ b) >> (7 - bit) & 1 == 1) {
                    if let Some(changed) = changed.get_mut(byte * 8 + bit).filter(|changed| changed.is_nan())
                    {
                        *changed = time;
                        left -= 1;
                    }
                }
            }
        }
        std::mem::swap(&mut earlier, &mut later);
    }
    changed
}

/// `BitGrid` in `api.ts`.
#[derive(Serialize)]
pub struct BitGrid {
    length: usize,
    flips: Integers,
    ones: Integers,
    frames: usize,
    signals: Vec<SignalInfo>,
}

/// How often each bit changed, and was 1, from one time to another.
pub fn bits(
    place: Place,
    from_ns: i64,
    to_ns: i64,
    store: &Store,
    index: &Index,
    databases: &mut Databases,
    sections: &mut Sections,
) -> BitGrid {
    let rows = window(index.rows(place), store, from_ns, to_ns);
    let (mut flips, mut ones) = (vec![0_u32; MOST_BITS], vec![0_u32; MOST_BITS]);
    let (mut length, mut frames) = (0, 0);
    let (mut bytes, mut before) = (Vec::new(), Vec::new());
    let mut has_before = false;
    for row in rows {
        data_of(store, *row, &mut bytes);
        frames += 1;
        length = length.max(bytes.len());
        for (at, byte) in bytes.iter().enumerate() {
            count(*byte, &mut ones[at * 8..at * 8 + 8]);
            if has_before && let Some(before) = before.get(at) {
                count(byte ^ before, &mut flips[at * 8..at * 8 + 8]);
            }
        }
        std::mem::swap(&mut bytes, &mut before);
        has_before = true;
    }
    BitGrid {
        length,
        flips: sections.integers(&flips[..length * 8]),
        ones: sections.integers(&ones[..length * 8]),
        frames,
        signals: databases.signals_of(place, index),
    }
}

/// Counts the bits of a byte that are 1, the highest first.
fn count(mut byte: u8, counts: &mut [u32]) {
    while byte != 0 {
        let highest = byte.leading_zeros();
        counts[highest as usize] += 1;
        byte &= !(0x80 >> highest);
    }
}

/// The answer to `periods` in `api.ts`.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub struct Periods {
    edges: Floats,
    counts: Integers,
    min: f64,
    max: f64,
    mean: f64,
    deviation: f64,
    by_device: bool,
}

/// A histogram of an identifier's periods, without those in which frames of the channel were lost.
pub fn periods(place: Place, content: &Content, index: &Index, sections: &mut Sections) -> Periods {
    let intervals = intact_intervals(
        place,
        index.rows(place),
        &content.store,
        &content.gaps.all(content.end_ns()).collect::<Vec<_>>(),
    );
    let by_device = intervals.iter().all(|intact| intact.interval.by_device);
    let mut seconds: Vec<f64> = intervals.iter().map(|intact| intact.interval.ns as f64 / 1e9).collect();
    seconds.sort_by(f64::total_cmp);
    let (Some(min), Some(max)) = (seconds.first().copied(), seconds.last().copied()) else {
        let (edges, counts) = (sections.floats(&[]), sections.integers(&[]));
        return Periods { edges, counts, min: 0.0, max: 0.0, mean: 0.0, deviation: 0.0, by_device: false };
    };
    let count = seconds.len() as f64;
    let mean = seconds.iter().sum::<f64>() / count;
    let deviation = (seconds.iter().map(|one| (one - mean).powi(2)).sum::<f64>() / count).sqrt();
    // A few long pauses would leave one bin for everything else.
    let usual = seconds[(seconds.len() - 1) * 995 / 1000];
    let top = if max > min + (usual - min) * 2.0 { usual } else { max };
    let mut edges: Vec<f64> = if top > min {
        (0..=BINS).map(|bin| min + (top - min) * bin as f64 / BINS as f64).collect()
    } else {
        // All of the usual ones are equal.
        vec![min, min.max(1e-9) * 1.000_001]
    };
    if let Some(last) = edges.last().copied().filter(|last| *last < max) {
        edges.push(if max > last { max } else { last });
    }
    let mut counts = vec![0_u32; edges.len() - 1];
    for one in &seconds {
        let bin = edges.partition_point(|edge| edge <= one).saturating_sub(1).min(counts.len() - 1);
        counts[bin] += 1;
    }
    let (edges, counts) = (sections.floats(&edges), sections.integers(&counts));
    Periods { edges, counts, min, max, mean, deviation, by_device }
}

/// From one frame of an identifier to the next.
pub struct Intact {
    /// When the first one was.
    pub from_ns: i64,
    /// How long it took.
    pub interval: Interval,
}

/// The intervals between an identifier's frames, without those with a gap of the channel in them.
pub fn intact_intervals(place: Place, rows: &[u32], store: &Store, gaps: &[Gap]) -> Vec<Intact> {
    let mut gaps: Vec<_> = gaps.iter().filter(|gap| gap.channel == place.channel).collect();
    gaps.sort_by_key(|gap| gap.from_ns);
    let mut gaps = gaps.into_iter().peekable();
    let time = |row: &u32| store.time_ns(*row as usize);
    let mut intervals = Vec::with_capacity(rows.len());
    for pair in rows.windows(2) {
        let (from, to) = (time(&pair[0]), time(&pair[1]));
        // A gap ends with a frame, perhaps this one, and begins with one.
        while gaps.next_if(|gap| gap.to_ns <= from).is_some() {}
        if gaps.peek().is_none_or(|gap| gap.from_ns >= to) {
            let interval = store.interval(pair[0] as usize, pair[1] as usize);
            intervals.push(Intact { from_ns: from, interval });
        }
    }
    intervals
}
