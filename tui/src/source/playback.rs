//! A file as the source, at its own pace or another one.

use std::cell::{Cell, RefCell};
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use cantap::TraceRecord;
use cantap_formats::time_range::{TimePoint, TimeRange};
use cantap_formats::{IndexFolder, OpenError, ReadOptions, TraceReader, open_reader};
use cantap_trace::playback::{Due, Playback};

use super::super::model::{Playing, SourceState};
use super::super::order::Order;
use super::super::plan::Plan;
use super::{FIGURES_EVERY, Source, Then, WAIT, lock};
use cantap_work::advice;

/// How many records are handed over under one lock.
const MOST_AT_ONCE: usize = 4096;

/// What is known of the records that are being played.
#[derive(Default)]
struct Progress {
    /// What could not be read: how often, and the first fault.
    unread: RefCell<Option<(u64, String)>>,
    /// How many of the file's records were read or passed over.
    records: Cell<u64>,
    /// What the file has said of its channels: from 1, bit/s.
    bit_rates: RefCell<Vec<(u8, u32)>>,
    /// What is played when the playback starts over, if not all of the file.
    jump: RefCell<Option<Readable>>,
}

/// The readable records; the rest is counted.
struct Readable {
    reader: TraceReader,
    progress: Rc<Progress>,
    /// Those that come first, in reverse.
    first: Vec<TraceRecord>,
    /// Earlier ones are left out.
    from_ns: i64,
}

/// A jump shows this much of what is before its destination: the rows and the trace are then not empty.
const BEFORE_JUMP_NS: i64 = 2_000_000_000;

/// Where no more records than this lie between, a jump goes through them, so that everything stays counted: they take a tenth of a second.
const GONE_THROUGH: u64 = if cfg!(test) { 500 } else { 100_000 };

/// No jump where more records than this would have to be read for it: in most of the file something is wrong, which is reported each time.
const MOST_READ: u64 = 500_000;

impl Readable {
    /// Opens the file at its beginning, or goes on with a jump, and forgets earlier counts.
    fn open(path: &Path, indexes: Option<&IndexFolder>, progress: &Rc<Progress>) -> Result<Self, OpenError> {
        if let Some(jump) = progress.jump.take() {
            return Ok(jump);
        }
        // The first screen of a file of many blocks is there at once, too, if they are known.
        let index = indexes.map(|indexes| indexes.clone().only_used());
        let reader = open_reader(path, &ReadOptions { index, ..ReadOptions::default() })?;
        progress.unread.take();
        Ok(Self { reader, progress: Rc::clone(progress), first: Vec::new(), from_ns: i64::MIN })
    }

    /// Opens a file whose index is known at a little before a time, without most of what comes earlier. `None` if there is little to pass over after
    /// the first `between` records, or no index.
    fn open_at(
        path: &Path,
        indexes: Option<&IndexFolder>,
        time_ns: i64,
        between: u64,
        progress: &Rc<Progress>,
    ) -> Option<Self> {
        let from_ns = time_ns.saturating_sub(BEFORE_JUMP_NS);
        let options = ReadOptions { index: Some(indexes?.clone()), ..ReadOptions::default() };
        let mut reader = open_reader(path, &options).ok()?;
        reader.within(&mut TimeRange::new(Some(TimePoint::At(from_ns)), None)).ok()?;
        let (mut first, mut issues) = (Vec::new(), Vec::new());
        while first.iter().all(|record: &TraceRecord| record.time_ns < from_ns) {
            match reader.next_batch(&mut first)? {
                Ok(()) => {}
                Err(issue) => issues.push(issue.to_string()),
            }
            if reader.records() - reader.passed_records() > MOST_READ {
                return None;
            }
        }
        if reader.passed_records() <= between.saturating_add(GONE_THROUGH) {
            return None;
        }
        first.reverse();
        let count = issues.len() as u64;
        progress.unread.replace(issues.into_iter().next().map(|first| (count, first)));
        Some(Self { reader, progress: Rc::clone(progress), first, from_ns })
    }

    fn any_next(&mut self) -> Option<TraceRecord> {
        if let Some(record) = self.first.pop() {
            return Some(record);
        }
        loop {
            match self.reader.next()? {
                Ok(record) => return Some(record),
                Err(issue) => {
                    let mut unread = self.progress.unread.borrow_mut();
                    unread.get_or_insert_with(|| (0, issue.to_string())).0 += 1;
                }
            }
        }
    }
}

impl Iterator for Readable {
    type Item = TraceRecord;

    fn next(&mut self) -> Option<TraceRecord> {
        loop {
            let record = self.any_next()?;
            self.progress.records.set(self.reader.records());
            let known = self.reader.bit_rates();
            if known.len() != self.progress.bit_rates.borrow().len() {
                known.clone_into(&mut self.progress.bit_rates.borrow_mut());
            }
            if record.time_ns >= self.from_ns {
                return Some(record);
            }
        }
    }
}

/// The latest time in a file, determined while it is played: that requires reading the whole file, once if it can have an index.
struct Length {
    /// [`i64::MIN`] until it is known.
    end_ns: Arc<AtomicI64>,
    is_over: Arc<AtomicBool>,
}

impl Length {
    fn unknown() -> Self {
        Self { end_ns: Arc::new(AtomicI64::new(i64::MIN)), is_over: Arc::default() }
    }

    /// Starts determining it. If the system refuses a thread, it stays unknown.
    fn look_for(&self, path: &Path, indexes: Option<&IndexFolder>) {
        let (path, end_ns, is_over) = (path.to_owned(), Arc::clone(&self.end_ns), Arc::clone(&self.is_over));
        let options = ReadOptions { index: indexes.cloned(), ..ReadOptions::default() };
        let body = move || {
            let Ok(mut reader) = open_reader(&path, &options) else { return };
            // Nothing is that late: an index passes over all that it knows.
            if reader.within(&mut TimeRange::new(Some(TimePoint::At(i64::MAX)), None)).is_err() {
                return;
            }
            let mut latest = i64::MIN;
            for record in reader.by_ref() {
                if is_over.load(Ordering::Relaxed) {
                    return;
                }
                latest = record.map_or(latest, |record| latest.max(record.time_ns));
            }
            let latest = latest.max(reader.passed_latest_ns().unwrap_or(i64::MIN));
            // Who knows the end may jump: the index is there by now.
            drop(reader);
            end_ns.store(latest, Ordering::Relaxed);
        };
        let _ = std::thread::Builder::new().name("cantap-length".to_owned()).spawn(body);
    }

    /// It is the latest time played, now that everything has been played.
    fn is(&self, latest_ns: i64) {
        self.end_ns.fetch_max(latest_ns, Ordering::Relaxed);
    }

    fn known(&self) -> Option<i64> {
        Some(self.end_ns.load(Ordering::Relaxed)).filter(|end_ns| *end_ns != i64::MIN)
    }
}

impl Drop for Length {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
    }
}

/// A file is played for this long before its length is determined: a short one may have ended by then.
const LENGTH_AFTER: Duration = Duration::from_millis(300);

/// The engine that plays a file.
type Player<F> = Playback<F, Readable>;

impl Source<'_> {
    pub(super) fn run_file(&mut self, path: &Path) {
        let progress = Rc::default();
        let start = Instant::now();
        let indexes = self.indexes.clone();
        let playback = Playback::new(|| Readable::open(path, indexes.as_ref(), &progress), start.elapsed());
        match playback {
            Ok(playback) => self.play(path, playback, &progress, start),
            Err(error) => {
                lock(self.model).source = SourceState::Gone(advice::explained(&error));
                self.wait_without_source();
            }
        }
    }

    fn play<F>(&mut self, path: &Path, mut playback: Player<F>, progress: &Rc<Progress>, start: Instant)
    where
        F: FnMut() -> Result<Readable, OpenError>,
    {
        let length = Length::unknown();
        let mut is_looked_for = false;
        let mut is_concluded = false;
        let first_ns = playback.position_ns(start.elapsed());
        let mut latest_ns = i64::MIN;
        // The destination while seeking.
        let mut seek: Option<i64> = None;
        let mut due = Vec::with_capacity(MOST_AT_ONCE);
        let mut next_figures = Instant::now();
        loop {
            let mut wait = WAIT;
            let mut ended = false;
            while due.len() < MOST_AT_ONCE {
                if let Some(time_ns) = seek {
                    match playback.forward_to(time_ns, start.elapsed()) {
                        Some(record) => {
                            due.push(record);
                            continue;
                        }
                        None => seek = None,
                    }
                }
                match playback.poll(start.elapsed()) {
                    Ok(Due::Record(record)) => {
                        due.push(record);
                        continue;
                    }
                    Ok(Due::Wait(time)) => wait = time.min(WAIT),
                    Ok(Due::Paused) => {}
                    Ok(Due::Ended) => ended = true,
                    Err(error) => {
                        self.notice(error.to_string());
                        ended = true;
                    }
                }
                break;
            }
            if due.len() == MOST_AT_ONCE {
                wait = Duration::ZERO;
            }
            latest_ns = due.iter().fold(latest_ns, |latest_ns, record| latest_ns.max(record.time_ns));
            if ended {
                length.is(latest_ns);
            } else if !is_looked_for && start.elapsed() >= LENGTH_AFTER {
                is_looked_for = true;
                length.look_for(path, self.indexes.as_ref());
            }
            if !due.is_empty() {
                {
                    let statistics = &mut lock(self.model).seen.statistics;
                    for (channel, bps) in progress.bit_rates.borrow().iter() {
                        statistics.learn_bitrate(*channel, *bps);
                    }
                }
                self.take(&due);
                due.clear();
            }
            {
                let mut model = lock(self.model);
                // Whatever goes back begins anew.
                if ended && !std::mem::replace(&mut is_concluded, ended) {
                    model.conclude();
                }
                is_concluded = ended;
                model.unread.clone_from(&progress.unread.borrow());
                model.source = SourceState::Playing(Playing {
                    factor: playback.factor(),
                    paused: playback.is_paused(),
                    looped: playback.is_looped(),
                    ended,
                    seeking: seek.is_some(),
                    first_ns,
                    position_ns: playback.position_ns(start.elapsed()),
                    end_ns: length.known(),
                });
            }
            if Instant::now() >= next_figures {
                next_figures = Instant::now() + FIGURES_EVERY;
                self.show_recording();
            }
            let now = start.elapsed();
            match self.orders.recv_timeout(wait) {
                Ok(Order::Faster) => playback.faster(now),
                Ok(Order::Slower) => playback.slower(now),
                Ok(Order::Step) => playback.step(now),
                Ok(Order::TogglePause) if playback.is_paused() => playback.resume(now),
                Ok(Order::TogglePause) => playback.pause(now),
                Ok(Order::ToggleLoop) => playback.set_looped(!playback.is_looped()),
                Ok(Order::Seek(time_ns)) => {
                    let is_ahead = time_ns >= playback.position_ns(now);
                    let between = if is_ahead { progress.records.get() } else { 0 };
                    // Without an index, all that is before would have to be read in one go.
                    let jump = length.known().and_then(|_| {
                        Readable::open_at(path, self.indexes.as_ref(), time_ns, between, progress)
                    });
                    let counted_from_ns = jump.as_ref().map(|jump| jump.from_ns.max(first_ns));
                    if jump.is_some() || !is_ahead {
                        // Then what is shown is what the file has up to there, or from a time on, and nothing twice.
                        progress.jump.replace(jump);
                        if let Err(error) = playback.start_over(now) {
                            self.notice(error.to_string());
                            continue;
                        }
                        let mut model = lock(self.model);
                        model.clear();
                        model.counted_from_ns = counted_from_ns;
                        model.first_ns = counted_from_ns.map(|_| first_ns);
                    }
                    seek = Some(time_ns);
                }
                Ok(order) => match self.follow(order) {
                    Then::GoOn | Then::Autobaud => {}
                    Then::Reopen(plan) => return self.leave_file(plan),
                    Then::Quit => return,
                },
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    /// The file cannot be opened; the user may select a device.
    fn wait_without_source(&mut self) {
        while let Ok(order) = self.orders.recv() {
            match self.follow(order) {
                Then::GoOn | Then::Autobaud => {}
                Then::Reopen(plan) => return self.leave_file(plan),
                Then::Quit => return,
            }
        }
    }

    fn leave_file(&mut self, plan: Plan) {
        let mut model = lock(self.model);
        model.unread = None;
        model.first_ns = None;
        model.counted_from_ns = None;
        model.interrupt();
        model.begin_statistics();
        drop(model);
        self.run_device(plan);
    }
}

#[cfg(test)]
mod tests;
