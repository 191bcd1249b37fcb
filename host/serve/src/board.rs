//! The shared board: the session with it, which starts again whenever the board is there, and requests to it.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cantap::DeviceError;
use cantap::device::{Link, pipe};
use cantap::session::Session;
use cantap_wire::message::{ChannelConfig, EndReason, Role, capability};
use cantap_wire::{BitTiming, CHANNELS, Channel, Command, Hello, Reply};

use crate::audit::Audit;
use crate::board_figures::BoardFigures;
use crate::client::admission::{self, Guest};
use crate::lock::lock;
use crate::log_limit::LogLimit;
use crate::modes;
use crate::news::News;
use crate::permissions::Permissions;
#[cfg(feature = "tls")]
use crate::permissions::{Denied, Permit};
use crate::shared::{Refused, Settings, Shared};
use crate::state::Then;
use crate::upstream::{Upstream, end_sessions};

/// Connects to the board: the one with this serial number, if one was there before and can be found by it.
pub type Connect = Box<dyn FnMut(Option<&str>) -> Result<Link, ConnectError> + Send>;
/// Why connecting failed.
pub type ConnectError = Box<dyn std::error::Error + Send + Sync>;

/// Why a board cannot be shared.
#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    /// It is there, but something is wrong with it.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// It cannot be reached.
    #[error(transparent)]
    Connect(ConnectError),
}

impl BoardError {
    /// Whether the board is not there, or another program has it, which may change: what is wrong with one that is there does not mend itself.
    pub const fn is_absent(&self) -> bool {
        matches!(
            self,
            Self::Connect(_) | Self::Device(DeviceError::NotFound { .. } | DeviceError::Busy { .. })
        )
    }
}

/// Time from a failure to the next try.
const RETRY_AFTER: Duration = Duration::from_millis(500);
/// Time limit for each request before there are clients.
const SETUP_TIMEOUT: Duration = Duration::from_millis(700);
/// How often to check whether the server should end.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// How long a server that is ending waits for its clients to take its last messages.
const LAST_WORDS: Duration = Duration::from_millis(1500);
/// Bytes on their way to a client in this process, and from it.
const PIPE_BYTES: usize = 64 * 1024;

/// A shared board. Dropping it ends every session, and the board leaves its buses: see [`Board::end`].
pub struct Board {
    shared: Arc<Shared>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Board {
    /// Begins a session with a board, which must be there now and may go and come back later; messages call it `name`. `news` is
    /// called with what happens, from any thread, and must not block.
    pub fn start(
        name: &str,
        connect: Connect,
        settings: Settings,
        news: impl Fn(News) + Send + Sync + 'static,
    ) -> Result<Self, BoardError> {
        let shared = Arc::new(Shared {
            name: name.to_owned(),
            settings,
            requests: Mutex::new(None),
            state: Mutex::default(),
            changed: Condvar::new(),
            setup: Mutex::default(),
            quit: AtomicBool::new(false),
            next_client: AtomicU64::new(1),
            news: Box::new(news),
            refusals: Mutex::new(LogLimit::of_refusals()),
            not_permitted: Mutex::new(LogLimit::of_refusals()),
            sessions: Mutex::new(LogLimit::of_sessions()),
            permissions: Mutex::default(),
            budgets: Mutex::default(),
            audit: Mutex::default(),
            refused: AtomicU64::new(0),
            pages: AtomicU64::new(0),
        });
        let (first, began) = std::sync::mpsc::channel();
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("cantap-board".to_owned())
            .spawn(move || run(&for_thread, connect, first))
            .map_err(DeviceError::Thread)?;
        let board = Self { shared, threads: Mutex::new(vec![thread]) };
        match began.recv() {
            Ok(Ok(())) => {
                let shared = Arc::clone(&board.shared);
                let modes = std::thread::Builder::new().name("cantap-modes".to_owned());
                lock(&board.threads)
                    .push(modes.spawn(move || modes::run(&shared)).map_err(DeviceError::Thread)?);
                Ok(board)
            }
            Ok(Err(error)) => Err(error),
            Err(_) => Err(DeviceError::WrongReply.into()),
        }
    }

    /// The board's description of itself, while it is there.
    pub fn hello(&self) -> Option<Hello> {
        self.shared.state().hello.clone()
    }

    /// Its name in messages.
    pub fn name(&self) -> &str {
        &self.shared.name
    }

    /// The bit rate of each channel for clients that choose none, in bit/s.
    pub fn bitrates_bps(&self) -> [Option<u32>; CHANNELS] {
        let state = self.shared.state();
        let clock_hz = state.hello.as_ref().map_or(1, |hello| hello.can_clock_hz);
        state.base.map(|config| config.and_then(|config| config.timing.known_bitrate_bps(clock_hz)))
    }

    /// The number of clients.
    pub fn clients(&self) -> usize {
        self.shared.state().clients.len()
    }

    /// From now on, clients with certificates may do only what these permit; those without, what their roles allow. `number` is the
    /// board's among those of the server, from 0: channels are numbered across them, as everywhere. Clients that are connected notice at
    /// once.
    pub fn permit_only(&self, permissions: Arc<Permissions>, number: usize) {
        let mut current = lock(&self.shared.permissions);
        if current.is_none() {
            *lock(&self.shared.budgets) = Arc::clone(&permissions.budgets);
        }
        *current = Some((permissions, number));
    }

    /// Who does what is recorded there from now on.
    pub fn record_to(&self, audit: Arc<Audit>) {
        *lock(&self.shared.audit) = Some(audit);
    }

    /// What the client with a certificate of this name may do, unless nothing is restricted.
    #[cfg(feature = "tls")]
    pub(crate) fn permit_of(&self, certificate: &str) -> Result<Option<Permit>, Denied> {
        self.shared.permit_of(certificate).map(|found| found.map(|(permit, _)| permit))
    }

    pub(crate) fn figures(&self) -> BoardFigures {
        let state = self.shared.state();
        let clock_hz = state.hello.as_ref().map_or(1, |hello| hello.can_clock_hz);
        BoardFigures {
            is_there: state.hello.is_some(),
            clients: state.clients.len() as u64,
            places: self.shared.settings.most_clients as u64,
            pages: self.shared.pages.load(Ordering::Relaxed),
            refused: self.shared.refused.load(Ordering::Relaxed),
            counts_losses: state.hello.as_ref().is_none_or(Hello::counts_losses),
            channels: state.totals(),
            bitrates_bps: state
                .open
                .map(|open| open.and_then(|config| config.timing.known_bitrate_bps(clock_hz))),
        }
    }

    /// Frames of each channel were lost in front of a client of this process.
    pub(crate) fn count_lost(&self, lost: [u64; CHANNELS]) {
        self.shared.state().count_lost(lost);
    }

    /// A page on it has come, or has left.
    pub fn count_page(&self, came: bool) {
        let pages = &self.shared.pages;
        if came {
            pages.fetch_add(1, Ordering::Relaxed)
        } else {
            pages.fetch_sub(1, Ordering::Relaxed)
        };
    }

    /// Reports something to whoever runs the server, and to the audit log: a listener outside of this crate does.
    pub fn tell(&self, news: News) {
        self.shared.tell(news);
    }

    /// Admits a client that talks through a stream at the other end of a line that can break without notice, for which the dead-man time
    /// applies ([`Settings::dead_man`]); messages call it `name`. Reading from `input` must return within a fraction of a second, as with a
    /// [`Link`]'s reader. Returns once the client is admitted; separate threads serve it.
    pub fn admit_remote(
        &self,
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        name: &str,
        role: Role,
    ) -> Result<(), Refused> {
        self.admit_guest(input, output, Guest { is_remote: true, ..Guest::of_board(name, role) })
    }

    pub(crate) fn admit_guest(
        &self,
        input: impl Read + Send + 'static,
        output: impl Write + Send + 'static,
        guest: Guest,
    ) -> Result<(), Refused> {
        admission::admit(&self.shared, Box::new(input), Box::new(output), guest)
    }

    /// Admits a client in this process, which makes a device from this link.
    pub fn link(&self, name: &str, role: Role) -> Result<Link, Refused> {
        self.link_of(Guest::of_board(name, role))
    }

    /// The same for a client that has its place at a listener already.
    pub(crate) fn link_placed(&self, name: &str, role: Role) -> Result<Link, Refused> {
        self.link_of(Guest { is_counted: false, ..Guest::of_board(name, role) })
    }

    /// The same for a guest.
    pub(crate) fn link_of(&self, guest: Guest) -> Result<Link, Refused> {
        let (reader, output) = pipe(PIPE_BYTES);
        let (input, writer) = pipe(PIPE_BYTES);
        self.admit_guest(input, output, guest)?;
        Ok(Link::new(reader, writer))
    }

    /// See [`Settings::idle_sender`].
    pub(crate) fn idle_sender(&self) -> Option<Duration> {
        self.shared.settings.idle_sender
    }

    /// Limit for records waiting for a slow client.
    pub(crate) fn most_records(&self) -> usize {
        self.shared.settings.most_records
    }

    /// Limit for clients at one listener.
    pub(crate) fn most_clients(&self) -> usize {
        self.shared.settings.most_clients
    }
}

impl Board {
    /// Ends every session; the board leaves its buses. A server that ends calls it, because connections have a board for as long as they last.
    pub fn end(&self) {
        self.shared.quit.store(true, Ordering::Relaxed);
        for thread in std::mem::take(&mut *lock(&self.threads)) {
            let _ = thread.join();
        }
        // Clients that are still reading learn that it is over.
        self.shared.wait_for(LAST_WORDS, |state| state.writers == 0);
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        self.end();
    }
}

/// The thread's body: one session with the board after another.
fn run(shared: &Arc<Shared>, mut connect: Connect, first: Sender<Result<(), BoardError>>) {
    let mut first = Some(first);
    let mut serial: Option<String> = None;
    let mut reported: Option<String> = None;
    while !shared.quit.load(Ordering::Relaxed) {
        let connected = connect(serial.as_deref()).map_err(|source| match source.downcast::<DeviceError>() {
            Ok(error) => BoardError::Device(*error),
            Err(source) => BoardError::Connect(source),
        });
        let session = connected.and_then(|link| Ok(begin(shared, link)?));
        match session {
            Ok(session) => {
                serial = Some(session.hello().serial.as_str().to_owned());
                reported = None;
                match first.take() {
                    // If whoever started it has gone meanwhile, `quit` is set.
                    Some(first) => drop(first.send(Ok(()))),
                    None => shared.tell(News::BoardBack { board: shared.name.clone() }),
                }
                if let Some(error) = serve(shared, session) {
                    shared.tell(News::BoardLost { board: shared.name.clone(), reason: error.to_string() });
                }
            }
            Err(error) => {
                if let Some(first) = first.take() {
                    if !(shared.settings.waits_for_board && error.is_absent()) {
                        let _ = first.send(Err(error));
                        return;
                    }
                    let _ = first.send(Ok(()));
                }
                let reason = error.to_string();
                if reported.as_ref() != Some(&reason) {
                    shared.tell(News::BoardLost { board: shared.name.clone(), reason: reason.clone() });
                    reported = Some(reason);
                }
            }
        }
        let retry_at = Instant::now() + RETRY_AFTER;
        while Instant::now() < retry_at && !shared.quit.load(Ordering::Relaxed) {
            std::thread::sleep(LOOK_EVERY);
        }
    }
    let mut state = shared.state();
    state.is_over = true;
    state.clients.values().for_each(|member| member.outbox.close());
}

/// Greets the board, and finds out what must be known before the first request of a client. From then on, clients may send requests.
fn begin(shared: &Arc<Shared>, link: Link) -> Result<Session<Then>, DeviceError> {
    let session = Session::begin(link, &shared.name, Upstream::new(Arc::clone(shared)))?;
    let hello = session.hello();
    let ask = |command| session.requests().send(command, Then::Nothing)?.reply_within(SETUP_TIMEOUT);
    let mut base = [None; CHANNELS];
    for channel in Channel::ALL.into_iter().take(usize::from(hello.channels)) {
        base[channel.index()] = match shared.settings.bitrates_bps[channel.index()] {
            Some(bitrate_bps) => {
                let timing = BitTiming::choose(hello.can_clock_hz, bitrate_bps, None)
                    .map_err(|reason| DeviceError::BitRate { bitrate_bps, reason })?;
                Some(ChannelConfig::listen_only(timing))
            }
            None => match ask(Command::Defaults { channel }) {
                Ok(Reply::Defaults(saved)) => Some(ChannelConfig::listen_only(saved.config.timing)),
                Ok(_) | Err(DeviceError::Refused { .. })
                    if hello.capabilities & capability::NO_BIT_RATE != 0 =>
                {
                    Some(ChannelConfig::listen_only(BitTiming::UNKNOWN))
                }
                Ok(_) | Err(DeviceError::Refused { .. }) => None,
                Err(error) => return Err(error),
            },
        };
    }
    let Reply::Time(ticks) = ask(Command::Time)? else { return Err(DeviceError::WrongReply) };
    // First of all: a client that finds the board must find the way to it.
    *lock(&shared.requests) = Some(Arc::clone(session.requests()));
    let mut state = shared.state();
    state.base = base;
    state.latest_ticks = ticks;
    state.hello = Some(hello.clone());
    drop(state);
    Ok(session)
}

/// Waits until the board is gone. Returns the reason, or `None` if the server should end.
fn serve(shared: &Shared, session: Session<Then>) -> Option<DeviceError> {
    let gone = loop {
        if let Some(gone) = session.requests().wait_until_gone(LOOK_EVERY) {
            break Some(gone);
        }
        if shared.quit.load(Ordering::Relaxed) {
            session.leave_buses();
            break None;
        }
    };
    drop(session);
    // It may have gone before its clients could know of it.
    end_sessions(shared, EndReason::BoardLost);
    gone
}
