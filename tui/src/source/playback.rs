//! A file as the source, at its own pace or another one.

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use cantap::TraceRecord;
use cantap_formats::{OpenError, ReadOptions, TraceReader, open_reader};
use cantap_trace::playback::{Due, Playback};

use super::super::model::{Playing, SourceState};
use super::super::order::Order;
use super::super::plan::Plan;
use super::{FIGURES_EVERY, Source, Then, WAIT, lock};
use cantap_work::advice;

/// How many records are handed over under one lock.
const MOST_AT_ONCE: usize = 4096;

/// What could not be read: how often, and the first fault.
type Unread = Rc<RefCell<Option<(u64, String)>>>;

/// The readable records; the rest is counted.
struct Readable {
    reader: TraceReader,
    unread: Unread,
}

impl Readable {
    /// Opens the file at its beginning and forgets earlier counts.
    fn open(path: &Path, unread: &Unread) -> Result<Self, OpenError> {
        let reader = open_reader(path, &ReadOptions::default())?;
        unread.borrow_mut().take();
        Ok(Self { reader, unread: Rc::clone(unread) })
    }
}

impl Iterator for Readable {
    type Item = TraceRecord;

    fn next(&mut self) -> Option<TraceRecord> {
        loop {
            match self.reader.next()? {
                Ok(record) => return Some(record),
                Err(issue) => {
                    let mut unread = self.unread.borrow_mut();
                    unread.get_or_insert_with(|| (0, issue.to_string())).0 += 1;
                }
            }
        }
    }
}

/// The latest time in a file, determined while it is played: that requires reading the whole file.
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
    fn look_for(&self, path: &Path) {
        let (path, end_ns, is_over) = (path.to_owned(), Arc::clone(&self.end_ns), Arc::clone(&self.is_over));
        let body = move || {
            let Ok(records) = open_reader(&path, &ReadOptions::default()) else { return };
            let mut latest = i64::MIN;
            for record in records {
                if is_over.load(Ordering::Relaxed) {
                    return;
                }
                latest = record.map_or(latest, |record| latest.max(record.time_ns));
            }
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
        let unread = Unread::default();
        let start = Instant::now();
        let playback = Playback::new(|| Readable::open(path, &unread), start.elapsed());
        match playback {
            Ok(playback) => self.play(path, playback, &unread, start),
            Err(error) => {
                lock(self.model).source = SourceState::Gone(advice::explained(&error));
                self.wait_without_source();
            }
        }
    }

    fn play<F>(&mut self, path: &Path, mut playback: Player<F>, unread: &Unread, start: Instant)
    where
        F: FnMut() -> Result<Readable, OpenError>,
    {
        let length = Length::unknown();
        let mut is_looked_for = false;
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
                length.look_for(path);
            }
            if !due.is_empty() {
                self.take(&due);
                due.clear();
            }
            {
                let mut model = lock(self.model);
                model.unread.clone_from(&unread.borrow());
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
                    if time_ns < playback.position_ns(now) {
                        // Then what is shown is what the file has up to there, and nothing twice.
                        if let Err(error) = playback.start_over(now) {
                            self.notice(error.to_string());
                            continue;
                        }
                        lock(self.model).clear();
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
        model.interrupt();
        model.begin_statistics();
        drop(model);
        self.run_device(plan);
    }
}
