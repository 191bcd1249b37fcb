//! The trace that is open: its records in columns, its figures, and what of it could not be read.

use cantap_analysis::stats::{Options, Statistics};
use cantap_formats::{Format, ReadOptions, TraceReader, open_source};
use cantap_trace::{TraceRecord, packed};

use crate::error::EngineError;
use crate::gaps::Gaps;
use crate::pieces::Pieces;
use crate::store::{BLOCK_ROWS, Store};

/// Reading goes on while so many bytes are there that have not been read; see [`crate::pieces`].
const RESERVE: u64 = 512 * 1024;
/// Above this many bytes, those that have been read are freed at once.
const KEPT: u64 = 512 * 1024 * 1024;
/// A file that must be there as a whole may have so many bytes: it is there twice, and the reader's copy grows by doubling.
const MOST_WHOLE: u64 = 768 * 1024 * 1024;
/// A format whose reader still runs dry after so many bytes is one that is read at many places.
const TRIED: u64 = 64 * 1024 * 1024;
/// More records than this do not fit in the 4 GiB that WebAssembly has, with what is computed from them.
const MOST_RECORDS: usize = 100_000_000;
/// A live trace keeps this many of its newest records unless it is told otherwise: 9 minutes of two saturated buses in about 240 MB.
const KEPT_LIVE: usize = 1 << 23;
/// When it has more, it forgets this part of them at once: forgetting costs more than keeping.
const FORGOTTEN_PART: usize = 8;
/// So many places that could not be read are shown one by one.
const ISSUES_SHOWN: usize = 20;

/// A trace.
pub struct Trace {
    name: String,
    size: Option<u64>,
    feed: Feed,
    /// The records and all that is computed while they are read.
    pub content: Content,
    format: Option<Format>,
    rates: Rates,
    /// Changes whenever the records begin anew.
    pub generation: u64,
}

/// What the user said of the channels' bit rates, in bit/s.
#[derive(Clone, Default)]
pub struct Rates {
    nominal: Vec<(u8, u32)>,
    data: Vec<(u8, u32)>,
}

/// What was read of a trace.
pub struct Content {
    /// The records.
    pub store: Store,
    /// Figures of channels and identifiers.
    pub statistics: Statistics,
    /// Where frames are missing.
    pub gaps: Gaps,
    issues: Vec<String>,
    more_issues: u64,
    /// What was left out and what should be known, by kind.
    kinds: Vec<(String, u64)>,
    /// Records that are not kept.
    beyond: u64,
    /// The time of the very first record, in nanoseconds.
    first_ns: Option<i64>,
    /// The number of the newest records that are kept, if older ones are forgotten.
    keep: Option<usize>,
    forgotten: usize,
}

/// Where the records come from.
enum Feed {
    /// A file.
    Pieces {
        pieces: Pieces,
        reader: Option<Box<TraceReader>>,
        reserve: u64,
        /// What the reader has filled last, which it fills again.
        batch: Vec<TraceRecord>,
    },
    /// Packed records as they come.
    Live,
    Complete,
}

/// What is known of how much was read.
#[derive(Clone, Copy)]
pub struct Progress {
    /// More will come.
    pub growing: bool,
    /// The part of the file that was read, from 0 to 1.
    pub part: Option<f64>,
}

impl Rates {
    /// Sets a channel's rates.
    pub fn set(&mut self, channel: u8, nominal: u32, data: Option<u32>) {
        let put = |rates: &mut Vec<(u8, u32)>, rate: Option<u32>| {
            rates.retain(|(of, _)| *of != channel);
            rates.extend(rate.map(|rate| (channel, rate)));
        };
        put(&mut self.nominal, Some(nominal));
        if data.is_some() {
            put(&mut self.data, data);
        }
    }

    /// The rates of a channel: nominal, data.
    pub fn of(&self, channel: u8) -> (Option<u32>, Option<u32>) {
        let of = |rates: &[(u8, u32)]| rates.iter().find(|(of, _)| *of == channel).map(|(_, rate)| *rate);
        (of(&self.nominal), of(&self.data))
    }

    fn statistics(&self) -> Statistics {
        let options = Options {
            channel_bitrate_bps: self.nominal.clone(),
            channel_data_bitrate_bps: self.data.clone(),
            ..Options::default()
        };
        // Slower rates, for which its windows would be too short, are refused before.
        Statistics::new(options)
            .or_else(|_| Statistics::new(Options::default()))
            .expect("the default options are possible")
    }
}

impl Content {
    fn new(rates: &Rates) -> Self {
        Self {
            store: Store::default(),
            statistics: rates.statistics(),
            gaps: Gaps::default(),
            issues: Vec::new(),
            more_issues: 0,
            kinds: Vec::new(),
            beyond: 0,
            first_ns: None,
            keep: None,
            forgotten: 0,
        }
    }

    fn push(&mut self, record: &TraceRecord) {
        if self.store.len() >= MOST_RECORDS {
            self.beyond += 1;
            return;
        }
        self.first_ns.get_or_insert(record.time_ns);
        self.store.push(record);
        self.statistics.push(record);
        self.gaps.push(record);
    }

    fn issue(&mut self, text: String) {
        if self.issues.len() < ISSUES_SHOWN { self.issues.push(text) } else { self.more_issues += 1 }
    }

    /// Nanoseconds of the first record, whether it is still kept or not: times count from there.
    pub fn origin_ns(&self) -> i64 {
        self.first_ns.unwrap_or(0)
    }

    /// Nanoseconds of the first record that is kept.
    pub fn begin_kept_ns(&self) -> i64 {
        if self.store.len() == 0 { 0 } else { self.store.time_ns(0) }
    }

    /// Records from the beginning that are no longer kept.
    pub const fn forgotten(&self) -> usize {
        self.forgotten
    }

    /// Forgets the oldest records if there are more than should be kept. Returns how many were forgotten.
    pub fn forget_oldest(&mut self) -> usize {
        let Some(keep) = self.keep.filter(|keep| self.store.len() > *keep) else { return 0 };
        let part = (keep / FORGOTTEN_PART).max(self.store.len() - keep);
        let forgotten = self.store.forget_blocks(part.div_ceil(BLOCK_ROWS));
        self.forgotten += forgotten;
        forgotten
    }

    /// Seconds since the first record.
    pub fn seconds(&self, time_ns: i64) -> f64 {
        time_ns.saturating_sub(self.origin_ns()) as f64 / 1e9
    }

    /// The time in nanoseconds; without one, that of before the beginning, or of after the end.
    pub fn begin_ns(&self, seconds: Option<f64>) -> i64 {
        seconds.map_or(i64::MIN, |seconds| self.origin_ns().saturating_add((seconds * 1e9).round() as i64))
    }

    /// The same for the end of a stretch.
    pub fn end_of_ns(&self, seconds: Option<f64>) -> i64 {
        seconds.map_or(i64::MAX, |seconds| self.begin_ns(Some(seconds)))
    }

    /// The time of the latest record in nanoseconds.
    pub fn end_ns(&self) -> i64 {
        self.statistics.last_ns().unwrap_or(0)
    }

    /// What was not read, with counts.
    pub fn unread(&self) -> Vec<(String, u64)> {
        let mut all: Vec<_> = self.issues.iter().map(|text| (text.clone(), 1)).collect();
        if self.more_issues > 0 {
            all.push(("more places could not be read".to_owned(), self.more_issues));
        }
        all.extend(self.kinds.iter().cloned());
        if self.beyond > 0 {
            let text = format!(
                "records are not shown, because a page holds {MOST_RECORDS} of them; split the trace with cantap convert --from and --to"
            );
            all.push((text, self.beyond));
        }
        if self.forgotten > 0 {
            let text = "records are no longer shown, because a live page keeps the newest ones; record to a file to keep all";
            all.push((text.to_owned(), self.forgotten as u64));
        }
        all
    }
}

impl Trace {
    /// Begins a trace with its first piece. Without a `size` and with `more` to come, it is live: chunks of [`packed`] records, each behind
    /// its length (4 bytes, little-endian), of which the newest `keep` are kept.
    pub fn open(
        name: &str,
        bytes: &[u8],
        more: bool,
        size: Option<u64>,
        keep: Option<usize>,
        rates: Rates,
        generation: u64,
    ) -> Result<Self, EngineError> {
        let is_live = more && size.is_none();
        let feed = if is_live {
            Feed::Live
        } else {
            Feed::Pieces { pieces: Pieces::default(), reader: None, reserve: RESERVE, batch: Vec::new() }
        };
        let mut content = Content::new(&rates);
        content.keep = is_live.then(|| keep.unwrap_or(KEPT_LIVE));
        let mut trace = Self { name: name.to_owned(), size, feed, content, format: None, rates, generation };
        trace.append(bytes, more)?;
        Ok(trace)
    }

    /// Adds the next piece.
    pub fn append(&mut self, bytes: &[u8], more: bool) -> Result<(), EngineError> {
        match &mut self.feed {
            Feed::Complete => Err(EngineError::Complete),
            Feed::Live => {
                let result = chunks(bytes, &mut self.content);
                if !more {
                    self.feed = Feed::Complete;
                    self.content.statistics.finish();
                }
                result
            }
            Feed::Pieces { pieces, .. } => {
                pieces.add(bytes, more);
                let result = self.read_on();
                if result.is_err() {
                    self.feed = Feed::Complete;
                }
                result
            }
        }
    }

    /// Adds records to a live trace.
    pub fn add(&mut self, records: &[TraceRecord]) {
        for record in records {
            self.content.push(record);
        }
    }

    fn read_on(&mut self) -> Result<(), EngineError> {
        loop {
            let Feed::Pieces { pieces, reader, reserve, batch } = &mut self.feed else { return Ok(()) };
            let is_complete = pieces.is_complete();
            let unread = pieces.received() - pieces.read_so_far();
            if !is_complete && unread < *reserve {
                return Ok(());
            }
            let more = if let Some(reader) = reader {
                take_batch(reader, batch, &mut self.content)
            } else {
                let opened = open_source(&self.name, pieces.clone(), &ReadOptions::default());
                if !pieces.ran_dry() {
                    let opened = opened?;
                    self.format = Some(opened.format());
                    *reader = Some(Box::new(opened));
                }
                true
            };
            if pieces.ran_dry() {
                // What it found may be wrong, such as a file that seems to be cut.
                *reader = None;
                *reserve = pieces.received() * 2;
                let is_too_large =
                    self.size.is_some_and(|size| size > MOST_WHOLE) && pieces.received() >= TRIED;
                if is_too_large || !pieces.rewind() {
                    return Err(EngineError::TooLarge);
                }
                self.content = Content::new(&self.rates);
                self.generation += 1;
                continue;
            }
            if pieces.read_so_far() > KEPT {
                pieces.drop_read();
            }
            if !more {
                let Some(reader) = reader.take() else { return Ok(()) };
                self.feed = Feed::Complete;
                count_kinds(&reader, &mut self.content);
                self.content.statistics.finish();
                return match reader.nothing_read() {
                    Some(nothing) if self.content.store.len() == 0 => Err(nothing.into()),
                    _ => Ok(()),
                };
            }
        }
    }

    /// Sets a channel's bit rates and computes everything anew that depends on them.
    pub fn set_rates(&mut self, rates: Rates) {
        let mut statistics = rates.statistics();
        let store = &self.content.store;
        (0..store.len()).filter_map(|row| store.record(row)).for_each(|record| statistics.push(&record));
        if matches!(self.feed, Feed::Complete) {
            statistics.finish();
        }
        self.content.statistics = statistics;
        self.rates = rates;
    }

    /// The file's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The format, once it is known.
    pub const fn format(&self) -> Option<Format> {
        self.format
    }

    /// How much was read.
    pub fn progress(&self) -> Progress {
        match &self.feed {
            Feed::Complete => Progress { growing: false, part: self.size.map(|_| 1.0) },
            Feed::Live => Progress { growing: true, part: None },
            Feed::Pieces { pieces, .. } => {
                let part = self.size.map(|size| (pieces.read_so_far() as f64 / size.max(1) as f64).min(1.0));
                Progress { growing: true, part }
            }
        }
    }
}

/// Takes chunks of packed records. Those before a fault are taken.
fn chunks(mut rest: &[u8], content: &mut Content) -> Result<(), EngineError> {
    let cut = packed::Damaged { at: 0, len: rest.len() };
    while !rest.is_empty() {
        let (length, after) = rest.split_first_chunk::<4>().ok_or(cut)?;
        let (chunk, after) = after.split_at_checked(u32::from_le_bytes(*length) as usize).ok_or(cut)?;
        packed::read(chunk, |record| content.push(record))?;
        rest = after;
    }
    Ok(())
}

/// Takes the next records, or the next issue; false at the end.
fn take_batch(reader: &mut TraceReader, batch: &mut Vec<TraceRecord>, content: &mut Content) -> bool {
    match reader.next_batch(batch) {
        Some(Ok(())) => batch.iter().for_each(|record| content.push(record)),
        Some(Err(issue)) => content.issue(issue.to_string()),
        None => return false,
    }
    true
}

/// Counts what the reader left out.
fn count_kinds(reader: &TraceReader, content: &mut Content) {
    let kinds =
        reader.left_out().iter().map(|(what, count)| (format!("no part of a CAN trace: {what}"), count));
    for (what, count) in kinds.chain(reader.notes().iter().map(|(what, count)| (what.to_owned(), count))) {
        match content.kinds.iter_mut().find(|(known, _)| *known == what) {
            Some((_, known)) => *known += count,
            None => content.kinds.push((what, count)),
        }
    }
}
