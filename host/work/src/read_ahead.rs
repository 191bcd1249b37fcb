//! A trace that is read by a thread of its own, some batches ahead of whoever goes through them.

use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::thread::{self, JoinHandle};
use std::{io, panic, vec};

use cantap::TraceRecord;
use cantap_formats::time_range::TimeRange;
use cantap_formats::{LeftOut, NothingRead, ReadIssue, TraceReader};

use crate::missing::Missing;

/// Items that are passed on together; a batch of records is one. Waking the other thread for each of them would take
/// longer than to read it.
const GROUP: usize = 16;
/// Groups that may wait: a megabyte and a half of records.
const MOST_WAITING: usize = 4;

/// What comes next in a trace.
enum Next {
    /// Records, at least one.
    Records(Vec<TraceRecord>),
    /// A place that could not be read, and the number of such places so far.
    Issue(ReadIssue, u64),
    /// The end, and whether that is all.
    End(Option<NothingRead>),
}

/// What is known once this much was read.
#[derive(Clone, Default)]
struct Known {
    missing: Missing,
    notes: LeftOut,
    bit_rates: Vec<(u8, u32)>,
}

type Item = (Next, Known);

/// The next of a trace that was read ahead.
pub enum Progress {
    /// There are records.
    Records,
    /// A place that could not be read, and the number of such places so far.
    Issue(ReadIssue, u64),
    /// The end; with the reason if nothing at all was read.
    End(Option<NothingRead>),
}

/// The thread and what it has read.
pub struct ReadAhead {
    source: Source,
    group: vec::IntoIter<Item>,
    known: Known,
}

enum Source {
    /// Nobody has asked for a record.
    Waiting(Box<TraceReader>),
    Reading {
        groups: Receiver<Vec<Item>>,
        /// Batches whose memory may be used again.
        used: Sender<Vec<TraceRecord>>,
        thread: JoinHandle<()>,
    },
    Ended,
}

impl ReadAhead {
    /// Reading begins when the first records are asked for.
    pub fn new(reader: TraceReader) -> Self {
        Self {
            source: Source::Waiting(Box::new(reader)),
            group: Vec::new().into_iter(),
            known: Known::default(),
        }
    }

    /// Ends a growing file as soon as `stop` returns true. Without effect once it is being read.
    pub fn end_when(&mut self, stop: fn() -> bool) {
        if let Source::Waiting(reader) = &mut self.source {
            reader.end_when(stop);
        }
    }

    /// Leaves out what an index shows to be outside of a range; see [`TraceReader::within`].
    pub fn within(&mut self, range: &mut TimeRange) -> io::Result<()> {
        match &mut self.source {
            Source::Waiting(reader) => reader.within(range),
            _ => Ok(()),
        }
    }

    /// Whether nothing more has been read yet.
    pub fn would_wait(&mut self) -> bool {
        if self.group.len() > 0 {
            return false;
        }
        let Source::Reading { groups, .. } = &self.source else { return false };
        match groups.try_recv() {
            Ok(group) => {
                self.group = group.into_iter();
                false
            }
            Err(TryRecvError::Empty) => true,
            Err(TryRecvError::Disconnected) => false,
        }
    }

    /// What is missing from the records that were taken.
    pub fn missing(&self) -> Missing {
        self.known.missing.clone()
    }

    /// As [`TraceReader::bit_rates`], of what was handed out so far.
    pub const fn bit_rates(&self) -> &[(u8, u32)] {
        self.known.bit_rates.as_slice()
    }

    /// What else is known about the file so far, and how often.
    pub const fn notes(&self) -> &LeftOut {
        &self.known.notes
    }

    /// Replaces the content of `records` with the next ones; leaves none if something else comes first. The error is that
    /// there is no thread to be had.
    pub fn next(&mut self, records: &mut Vec<TraceRecord>) -> io::Result<Progress> {
        records.clear();
        self.source = match std::mem::replace(&mut self.source, Source::Ended) {
            Source::Waiting(reader) => start(*reader)?,
            source => source,
        };
        let Some((next, known)) = self.item() else { return Ok(Progress::End(None)) };
        self.known = known;
        Ok(match next {
            Next::Records(batch) => {
                let before = std::mem::replace(records, batch);
                if let Source::Reading { used, .. } = &self.source {
                    // At the file's end nobody wants it.
                    let _ = used.send(before);
                }
                Progress::Records
            }
            Next::Issue(issue, number) => Progress::Issue(issue, number),
            Next::End(nothing) => Progress::End(nothing),
        })
    }

    fn item(&mut self) -> Option<Item> {
        if let Some(item) = self.group.next() {
            return Some(item);
        }
        let Source::Reading { groups, .. } = &self.source else { return None };
        if let Ok(group) = groups.recv() {
            self.group = group.into_iter();
            return self.group.next();
        }
        // Without an end only if it panicked.
        if let Source::Reading { thread, .. } = std::mem::replace(&mut self.source, Source::Ended)
            && let Err(panicked) = thread.join()
        {
            panic::resume_unwind(panicked);
        }
        None
    }
}

fn start(reader: TraceReader) -> io::Result<Source> {
    let (filled, groups) = sync_channel(MOST_WAITING);
    let (used, again) = channel();
    let thread = thread::Builder::new().name("trace".to_owned());
    let thread = thread.spawn(move || read(reader, &filled, &again))?;
    Ok(Source::Reading { groups, used, thread })
}

/// The thread. It ends with the trace, or when nobody takes what it has read.
fn read(mut reader: TraceReader, filled: &SyncSender<Vec<Item>>, used: &Receiver<Vec<TraceRecord>>) {
    let mut group = Vec::with_capacity(GROUP);
    loop {
        let mut records = used.try_recv().unwrap_or_default();
        let next = match reader.next_batch(&mut records) {
            Some(Ok(())) => Next::Records(records),
            Some(Err(issue)) => Next::Issue(issue, reader.issues()),
            None => Next::End(reader.nothing_read()),
        };
        let is_end = matches!(next, Next::End(_));
        let (notes, bit_rates) = (reader.notes().clone(), reader.bit_rates().to_vec());
        group.push((next, Known { missing: Missing::of(&reader), notes, bit_rates }));
        if is_end || group.len() == GROUP || reader.would_wait() {
            let group = std::mem::replace(&mut group, Vec::with_capacity(GROUP));
            if filled.send(group).is_err() || is_end {
                return;
            }
        }
    }
}
