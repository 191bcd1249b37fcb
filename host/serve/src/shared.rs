//! What the threads of a shared board have in common: its state, the connection to it, and requests to it.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cantap::DeviceError;
use cantap::session::Requests;
use cantap_wire::message::{ChannelConfig, Mode};
use cantap_wire::{CHANNELS, Command, Refusal, Reply};
use serde_json::json;

use crate::audit::{Audit, who};
use crate::client::budget::{Budget, Budgets};
use crate::lock::lock;
use crate::log_limit::LogLimit;
use crate::news::News;
use crate::outbox::MOST_RECORDS;
use crate::permissions::{Denied, Permissions, Permit};
use crate::state::{State, Then};
use crate::stream::ClientId;

/// The longest time a board takes to answer: saving takes two seconds.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(3);

/// How a board is shared.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The bit rate of each channel's bus, in bit/s, for clients that choose none. Without one, it is the one saved on the board, if any;
    /// otherwise a client has to choose it, which requires [`Role::Configure`](crate::Role::Configure).
    pub bitrates_bps: [Option<u32>; CHANNELS],
    /// Limit for records waiting for a slow client.
    pub most_records: usize,
    /// Limit for clients at a time, at each listener and of this process.
    pub most_clients: usize,
    /// A channel that was opened for sending stays so for this long after the last client that may send on it has left, if others have
    /// it open: each change of mode costs them some frames.
    pub keep_mode: Duration,
    /// How channels are opened for clients that only listen: with `true`, so that the board acknowledges, and no client that sends takes
    /// it off the bus.
    pub always_acknowledges: bool,
    /// A board that is not there at the start is waited for.
    pub waits_for_board: bool,
    /// A client whose first frame opened a channel for sending, because its protocol has no other way to ask for that, only listens again
    /// after sending nothing for this long; `None` for never. Until then the board acknowledges for it, and nobody knows whether it is
    /// still there.
    pub idle_sender: Option<Duration>,
    /// Periodic frames and replies of a client on another computer that has said nothing for this long are stopped; `None` for never.
    pub dead_man: Option<Duration>,
}

impl Settings {
    /// The same bit rate for both channels, in bit/s.
    pub fn at(bitrate_bps: u32) -> Self {
        Self { bitrates_bps: [Some(bitrate_bps); CHANNELS], ..Self::default() }
    }
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            bitrates_bps: [None; CHANNELS],
            most_records: MOST_RECORDS,
            most_clients: 32,
            keep_mode: Duration::from_secs(10),
            always_acknowledges: false,
            waits_for_board: false,
            idle_sender: Some(Duration::from_mins(1)),
            dead_man: Some(Duration::from_secs(2)),
        }
    }
}

/// Shared by the threads.
pub(crate) struct Shared {
    pub name: String,
    pub settings: Settings,
    /// Requests to the board, while it is there.
    pub requests: Mutex<Option<Arc<Requests<Then>>>>,
    pub state: Mutex<State>,
    /// Something has arrived from the board.
    pub changed: Condvar,
    /// Held while opening or closing channels: one at a time.
    pub setup: Mutex<()>,
    pub quit: AtomicBool,
    pub next_client: AtomicU64,
    pub news: Box<dyn Fn(News) + Send + Sync>,
    pub refusals: Mutex<LogLimit>,
    /// The same for requests that are not permitted or not done.
    pub not_permitted: Mutex<LogLimit>,
    /// The same for what sessions do that are let in.
    pub sessions: Mutex<LogLimit>,
    /// Those of certificates, and the number of the board's first channel.
    pub permissions: Mutex<Option<(Arc<Permissions>, usize)>>,
    /// What each certificate's clients may still send.
    pub budgets: Mutex<Budgets>,
    pub audit: Mutex<Option<Arc<Audit>>>,
    /// Connections and requests that were refused.
    pub refused: AtomicU64,
    /// Pages that are open.
    pub pages: AtomicU64,
}

impl Shared {
    pub fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    pub fn tell(&self, news: News) {
        let limit = match news {
            News::Refused { .. } => Some(&self.refusals),
            News::NotPermitted { .. } | News::NotDone { .. } => Some(&self.not_permitted),
            News::ClientCame { .. } | News::ClientLeft { .. } | News::Asked { .. } | News::LeftOut { .. } => {
                if self.passes_session() {
                    self.report(news);
                }
                return;
            }
            _ => None,
        };
        if let Some(limit) = limit {
            self.refused.fetch_add(1, Ordering::Relaxed);
            let Some(count) = lock(limit).pass(Instant::now()) else { return };
            if count > 0 {
                self.report(News::RefusedMore { count });
            }
        }
        self.report(news);
    }

    /// Whether what a session does is reported now. Sessions that come and leave as fast as they can must not fill a disk either; how many
    /// reports are missing is one.
    pub fn passes_session(&self) -> bool {
        let passed = lock(&self.sessions).pass(Instant::now());
        if let Some(count @ 1..) = passed {
            self.report(News::SessionsMore { count });
        }
        passed.is_some()
    }

    fn report(&self, news: News) {
        self.note(|| {
            let mut event = news.client().map_or_else(|| json!({}), who);
            event["event"] = json!(news.event());
            event["text"] = json!(news.to_string());
            event
        });
        (self.news)(news);
    }

    /// What the client with a certificate of this name may do now, unless nothing is restricted, and the number of the board's first
    /// channel, from 0.
    pub fn permit_of(&self, certificate: &str) -> Result<Option<(Permit, usize)>, Denied> {
        let permissions = lock(&self.permissions).clone();
        let Some((permissions, number)) = permissions else { return Ok(None) };
        Ok(Some((permissions.of(certificate)?.clone(), number)))
    }

    /// What all clients with a certificate of this name may still send.
    pub fn budget_of(&self, certificate: &str) -> Arc<Mutex<Budget>> {
        let budgets = lock(&self.budgets).clone();
        Arc::clone(lock(&budgets).entry(certificate.to_owned()).or_default())
    }

    /// Adds to the audit log, if there is one.
    pub fn note(&self, event: impl FnOnce() -> serde_json::Value) {
        let audit = lock(&self.audit).clone();
        if let Some(audit) = audit {
            let mut event = event();
            event["board"] = json!(self.name);
            audit.note(event);
        }
    }

    pub fn next_client(&self) -> ClientId {
        self.next_client.fetch_add(1, Ordering::Relaxed)
    }

    /// Sends a request to the board and waits for its answer. `then` is done in the order of its stream.
    pub fn ask(&self, command: Command, then: Then) -> Result<Reply, Refusal> {
        let requests = self.requests()?;
        let pending = requests.send(command, then).map_err(|error| self.not_sent(&error))?;
        pending.answer_within(ANSWER_TIMEOUT).unwrap_or(Err(Refusal::NoBoard))
    }

    /// Sends a request for whose answer nobody waits.
    pub fn send_unattended(&self, command: Command, then: Then) {
        if let Ok(requests) = self.requests() {
            // If it fails, the session with the board ends.
            let _ = requests.send_unattended(command, then).map_err(|error| self.not_sent(&error));
        }
    }

    fn requests(&self) -> Result<Arc<Requests<Then>>, Refusal> {
        lock(&self.requests).clone().ok_or(Refusal::NoBoard)
    }

    fn not_sent(&self, error: &DeviceError) -> Refusal {
        if matches!(error, DeviceError::RequestTooLong) {
            return Refusal::Malformed;
        }
        self.end_session("it does not take requests any more");
        Refusal::NoBoard
    }

    /// Ends the session with the board.
    pub fn end_session(&self, reason: &str) {
        if let Ok(requests) = self.requests() {
            requests.end(reason);
        }
    }

    /// Nothing more is written to a client.
    pub fn has_written(&self) {
        self.state().writers -= 1;
        self.changed.notify_all();
    }

    /// Waits until `is_there` finds what it looks for in the board's messages, at most `timeout`. Returns
    /// whether it did.
    pub fn wait_for(&self, timeout: Duration, mut is_there: impl FnMut(&State) -> bool) -> bool {
        let waited = self.changed.wait_timeout_while(self.state(), timeout, |state| !is_there(state));
        !waited.unwrap_or_else(PoisonError::into_inner).1.timed_out()
    }
}

/// Why a client was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// There are as many as allowed.
    #[error("there are {0} clients already")]
    TooMany(usize),
    /// Its certificate's permissions do not let it in.
    #[error(transparent)]
    NotPermitted(Denied),
    /// Its certificate is not trusted any more.
    #[error("{0}")]
    NotTrusted(String),
    /// The server is ending.
    #[error("the server ends")]
    Over,
    /// The system could not start a thread.
    #[error("the system refused a thread: {0}")]
    Thread(#[source] std::io::Error),
}

/// Whether a mode only listens.
pub(crate) const fn only_listens(config: &ChannelConfig) -> bool {
    matches!(config.mode, Mode::ListenOnly)
}
