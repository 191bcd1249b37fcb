//! A file as the source, at its own pace or another one.

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

use cantap::TraceRecord;
use cantap_formats::{OpenError, ReadOptions, TraceReader, open_reader};
use cantap_trace::playback::{Due, Playback};

use super::super::model::SourceState;
use super::super::order::Order;
use super::super::plan::Plan;
use super::{FIGURES_EVERY, Source, Then, WAIT, lock};
use crate::advice;

/// Records handed over under one lock.
const MOST_AT_ONCE: usize = 4096;

/// What could not be read: how often, and what was wrong first.
type Unread = Rc<RefCell<Option<(u64, String)>>>;

/// The records that can be read; the rest is counted.
struct Readable {
    reader: TraceReader,
    unread: Unread,
}

impl Readable {
    /// Opens the file at its beginning and forgets what was counted before.
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

impl Source<'_> {
    pub(super) fn run_file(&mut self, path: &Path) {
        let unread = Unread::default();
        let start = Instant::now();
        let mut playback = match Playback::new(|| Readable::open(path, &unread), start.elapsed()) {
            Ok(playback) => playback,
            Err(error) => {
                lock(self.model).source = SourceState::Gone(advice::told(&error));
                return self.wait_without_source();
            }
        };
        let mut due = Vec::with_capacity(MOST_AT_ONCE);
        let mut next_figures = Instant::now();
        loop {
            let mut wait = WAIT;
            let mut ended = false;
            while due.len() < MOST_AT_ONCE {
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
            if !due.is_empty() {
                self.take(&due);
                due.clear();
            }
            {
                let mut model = lock(self.model);
                model.unread.clone_from(&unread.borrow());
                model.source = SourceState::Playing {
                    factor: playback.factor(),
                    paused: playback.is_paused(),
                    looped: playback.is_looped(),
                    ended,
                };
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

    /// The file cannot be opened; the user may choose a device.
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
