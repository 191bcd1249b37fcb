//! What the device's thread and the pages' threads share.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap_work::report::Severity;
use serde::Serialize;
use serde_json::Value;

use crate::backlog::Backlog;
use crate::request::Request;
use crate::state::State;
use crate::visits::Visitor;

/// So many notices are kept for pages.
const NOTICES: usize = 64;
/// Requests that may wait for the device's thread.
const WAITING: usize = 64;

/// A request's answer, or why it is refused.
pub type Answer = Result<Value, String>;

/// A request on its way to the device's thread.
pub struct Order {
    /// What is asked for.
    pub request: Request,
    /// Who asks.
    pub page: Arc<Visitor>,
    /// Where the answer goes; nobody may be there any more.
    pub answer: SyncSender<Answer>,
}

/// Something that happened.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Notice {
    /// From 1.
    pub number: u64,
    /// `info` or `warning`.
    pub level: &'static str,
    /// A sentence.
    pub text: String,
}

/// See the module's description.
pub struct Shared {
    /// What was received.
    pub backlog: Backlog,
    state: Mutex<Versioned>,
    notices: Mutex<VecDeque<Notice>>,
    orders: SyncSender<Order>,
    /// Pages whose connection is open.
    pages: AtomicUsize,
    started: Instant,
    /// Milliseconds from `started` to the latest message of any page.
    latest_message_ms: AtomicU64,
    is_over: AtomicBool,
}

struct Versioned {
    version: u64,
    state: State,
}

impl Shared {
    /// And where orders arrive.
    pub fn new(state: State) -> (Self, Receiver<Order>) {
        let (orders, receiver) = sync_channel(WAITING);
        let shared = Self {
            backlog: Backlog::default(),
            state: Mutex::new(Versioned { version: 1, state }),
            notices: Mutex::default(),
            orders,
            pages: AtomicUsize::new(0),
            started: Instant::now(),
            latest_message_ms: AtomicU64::new(0),
            is_over: AtomicBool::new(false),
        };
        (shared, receiver)
    }

    fn versioned(&self) -> MutexGuard<'_, Versioned> {
        // Every holder leaves it consistent.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes the state.
    pub fn change<T>(&self, change: impl FnOnce(&mut State) -> T) -> T {
        let mut versioned = self.versioned();
        let before = versioned.state.clone();
        let result = change(&mut versioned.state);
        versioned.version += u64::from(versioned.state != before);
        result
    }

    /// The state, if it is another than that of this version.
    pub fn state_after(&self, version: u64) -> Option<(u64, State)> {
        let versioned = self.versioned();
        (versioned.version != version).then(|| (versioned.version, versioned.state.clone()))
    }

    /// A copy of the state.
    pub fn state(&self) -> State {
        self.versioned().state.clone()
    }

    /// Tells pages something.
    pub fn notify(&self, severity: Severity, text: impl Into<String>) {
        let mut notices = self.notices.lock().unwrap_or_else(PoisonError::into_inner);
        let number = notices.back().map_or(1, |last| last.number + 1);
        let level = if severity == Severity::Warning { "warning" } else { "info" };
        notices.push_back(Notice { number, level, text: text.into() });
        if notices.len() > NOTICES {
            notices.pop_front();
        }
    }

    /// Notices after the one with this number.
    pub fn notices_after(&self, number: u64) -> Vec<Notice> {
        let notices = self.notices.lock().unwrap_or_else(PoisonError::into_inner);
        notices.iter().filter(|notice| notice.number > number).cloned().collect()
    }

    /// Passes a request on; its answer comes later. An error if too many are waiting.
    pub fn order(&self, request: Request, page: Arc<Visitor>) -> Result<Receiver<Answer>, String> {
        let (answer, receiver) = sync_channel(1);
        let passed = self.orders.try_send(Order { request, page, answer });
        passed.map_err(|_| "the device has not answered the requests before; try again".to_owned())?;
        Ok(receiver)
    }

    /// A page comes; `None` if there are `most` already.
    pub fn enter(&self, most: usize) -> Option<Page<'_>> {
        let enter = |pages| (pages < most).then_some(pages + 1);
        let before = self.pages.fetch_update(Ordering::Relaxed, Ordering::Relaxed, enter).ok()?;
        self.change(|state| state.pages = before + 1);
        self.note_activity();
        Some(Page(self))
    }

    /// Whether any page is open.
    pub fn has_pages(&self) -> bool {
        self.pages.load(Ordering::Relaxed) > 0
    }

    /// A page has shown that it is there.
    pub fn note_activity(&self) {
        self.latest_message_ms.store(self.started.elapsed().as_millis() as u64, Ordering::Relaxed);
    }

    /// How long no page has shown that it is there.
    pub fn silence(&self) -> Duration {
        let latest = Duration::from_millis(self.latest_message_ms.load(Ordering::Relaxed));
        self.started.elapsed().saturating_sub(latest)
    }

    /// The server ends.
    pub fn end(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Whether the server ends.
    pub fn is_over(&self) -> bool {
        self.is_over.load(Ordering::Relaxed)
    }
}

/// A page that is there.
pub struct Page<'a>(&'a Shared);

impl Drop for Page<'_> {
    fn drop(&mut self) {
        let before = self.0.pages.fetch_sub(1, Ordering::Relaxed);
        self.0.change(|state| state.pages = before.saturating_sub(1));
    }
}
