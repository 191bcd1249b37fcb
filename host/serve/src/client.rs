//! One client: its requests are carried out, and those beyond its role are refused.

pub mod admission;
pub mod budget;
mod channels;
mod sending;

use std::cell::Cell;
use std::io::Read;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use cantap::device::{channel_number, is_idle};
use cantap::responder::{Inbox, Incoming, encode_response};
use cantap_wire::message::{Defaults, Role, capability};
use cantap_wire::{CHANNELS, Channel, Command, Hello, PROTOCOL_VERSION, Refusal, Reply, Request};
use serde_json::{Value, json};

use self::budget::Budget;
use crate::audit::who;
use crate::flow::read_ack;
use crate::foreign;
use crate::lock::lock;
use crate::news::News;
use crate::outbox::Outbox;
use crate::permissions::{Denied, Permit};
use crate::places::{GREETING_TIMEOUT, Place};
use crate::shared::Shared;
use crate::state::{Member, State, Then};
use crate::stream::{ClientId, View, Views};
use crate::to_send::ToSend;

/// A client that may send and says nothing for this long is let go, because the board acknowledges for it. Programs of ours say something
/// twice a second.
const SENDER_TIMEOUT: Duration = Duration::from_secs(5);
/// How often to check whether a client may still be there, and to record how much it sent.
const CHECK_EVERY: Duration = Duration::from_secs(1);
/// A read takes 50 ms. During the rest of a longer pass, the computer was too busy to listen, for which a client is not to blame.
const LONGEST_PASS: Duration = Duration::from_millis(100);

/// Who a client is, as its certificate says.
pub struct Identity {
    /// The certificate's name.
    pub certificate: String,
    /// Whether it is still trusted. An error says why not.
    pub check: Box<dyn Fn() -> Result<(), String> + Send>,
}

/// A client, as seen by the thread that carries out its requests.
struct Client {
    shared: Arc<Shared>,
    id: ClientId,
    role: Role,
    name: String,
    /// After this silence, what it sends on its own is stopped.
    dead_man: Option<Duration>,
    identity: Option<Identity>,
    /// What it may do, and the number of the board's first channel, from 0.
    permit: Option<(Permit, usize)>,
    /// The certificate's, which its other connections use as well.
    budget: Arc<Mutex<Budget>>,
    /// Frames sent on each channel that are not recorded yet.
    sent: Mutex<[u64; CHANNELS]>,
    place: Option<Place>,
    has_greeted: Arc<AtomicBool>,
    /// Why it was let go. Clients that connect and say nothing are not reported.
    let_go: Arc<Mutex<Option<String>>>,
    outbox: Arc<Outbox>,
}

impl Client {
    /// Reads until either side ends.
    fn serve(&self, input: &mut dyn Read) {
        let came = Instant::now();
        let mut inbox = Inbox::default();
        let mut first = Vec::new();
        let mut silence = Silence::default();
        let checked_at = Cell::new(came);
        let mut bytes = [0; 4096];
        while !self.outbox.is_closed() {
            let len = match input.read(&mut bytes) {
                Ok(0) => return,
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(_) => return,
            };
            let bytes = &bytes[..len];
            if len > 0
                && let Some(place) = &self.place
            {
                place.spoke();
            }
            let is_stranger = |first: &[u8], inbox: &Inbox| {
                !self.has_greeted() && (foreign::protocol(first).is_some() || inbox.is_overlong())
            };
            if !self.has_greeted() && first.len() < foreign::ENOUGH {
                let zeros =
                    if first.is_empty() { bytes.iter().take_while(|byte| **byte == 0).count() } else { 0 };
                first.extend(bytes.iter().skip(zeros).take(foreign::ENOUGH));
            }
            let mut goes_on = !is_stranger(&first, &inbox);
            // What waits in one piece can take long: for as long as it does not read its answers.
            inbox.push(bytes, |incoming| {
                goes_on = goes_on && self.may_stay(&checked_at) && self.take(incoming);
            });
            if !self.has_greeted() && !first.is_empty() && (!goes_on || is_stranger(&first, &inbox)) {
                self.let_go(foreign::reason(&first));
                return;
            }
            if !goes_on || !self.has_greeted() && came.elapsed() > GREETING_TIMEOUT {
                return;
            }
            if !self.may_stay(&checked_at) {
                return;
            }
            let silent = silence.pass(len > 0);
            if silent >= SENDER_TIMEOUT && self.with(|_, member| member.views.iter().any(View::transmits)) {
                self.let_go(format!(
                    "it said nothing for {} s, and might have sent",
                    SENDER_TIMEOUT.as_secs()
                ));
                return;
            }
            if let Some(after) = self.dead_man.filter(|after| silent >= *after) {
                self.stop_entries(after);
            }
        }
    }

    /// Checks now and then whether it may stay, and records how much it sent.
    fn may_stay(&self, checked_at: &Cell<Instant>) -> bool {
        if checked_at.get().elapsed() < CHECK_EVERY {
            return true;
        }
        checked_at.set(Instant::now());
        self.record_sent();
        self.check().map_err(|reason| self.let_go(reason)).is_ok()
    }

    /// Takes what it said. Returns whether it may go on.
    fn take(&self, incoming: Incoming<'_>) -> bool {
        match incoming {
            Incoming::Request(Request { id, command: Command::Hello { protocol } }) => {
                self.greet(id, protocol)
            }
            Incoming::Other(message) if let Some(bytes) = read_ack(message) => {
                self.outbox.acknowledge(bytes);
                true
            }
            // Whoever does not begin with a greeting is no client.
            _ if !self.has_greeted() => false,
            Incoming::Request(Request { id, command }) => {
                let result = self.perform(command);
                self.answer(id, &result)
            }
            Incoming::Unreadable(id, refusal) => self.answer(id, &Err(refusal)),
            Incoming::Other(_) | Incoming::Damaged => true,
        }
    }

    fn has_greeted(&self) -> bool {
        self.has_greeted.load(Ordering::Relaxed)
    }

    /// Notes why it is let go.
    fn let_go(&self, reason: String) {
        *lock(&self.let_go) = Some(reason);
    }

    /// Gives back everything it had.
    fn leave(&self) {
        self.record_sent();
        self.end_session();
        self.shared.state().remove(self.id);
        // What is waiting is written if anybody reads it.
        self.outbox.close();
    }

    /// Whether it may stay: what it showed is still trusted, and its permissions are what they were when it came.
    fn check(&self) -> Result<(), String> {
        let Some(identity) = &self.identity else { return Ok(()) };
        (identity.check)()?;
        let now = self.shared.permit_of(&identity.certificate).map_err(|denied| denied.to_string())?;
        if now == self.permit { Ok(()) } else { Err("its permissions have changed".to_owned()) }
    }

    /// Checks that its permissions cover something, for which it would need this role. The log says what is missing.
    fn must_be_permitted(
        &self,
        needs: Role,
        check: impl FnOnce(&Permit, usize) -> Result<(), Denied>,
    ) -> Result<(), Refusal> {
        let Some((permit, number)) = &self.permit else { return Ok(()) };
        check(permit, *number).map_err(|denied| {
            let (client, reason) = (self.name.clone(), denied.to_string());
            self.shared.tell(News::NotPermitted { client, reason });
            Refusal::NotGranted { needs }
        })
    }

    /// Checks that its permissions cover channels that it is about to configure.
    fn must_have(&self, these: &[Channel]) -> Result<(), Refusal> {
        self.must_be_permitted(Role::Configure, |permit, number| {
            these.iter().try_for_each(|channel| permit.channel(channel_number(number, *channel)))
        })
    }

    /// Adds to the audit log what it did, for which there is a channel.
    fn note(&self, event: &str, channel: Channel, more: impl FnOnce() -> Value) {
        self.shared.note(|| {
            let mut noted = who(&self.name);
            noted["event"] = json!(event);
            noted["channel"] = json!(channel.number());
            if let (Value::Object(noted), Value::Object(more)) = (&mut noted, more()) {
                noted.extend(more);
            }
            noted
        });
    }

    /// The same for what every session does.
    fn note_session(&self, event: &str, channel: Channel, more: impl FnOnce() -> Value) {
        if self.shared.passes_session() {
            self.note(event, channel, more);
        }
    }

    /// Records that it closes a channel, if it has that open: clients close both to be sure.
    fn note_closed(&self, channel: Channel) {
        if self.is_open(channel) {
            self.note_session("closed", channel, || json!({}));
        }
    }

    /// Records how many frames it sent since the last time.
    fn record_sent(&self) {
        let sent = std::mem::take(&mut *lock(&self.sent));
        for (channel, frames) in Channel::ALL.into_iter().zip(sent).filter(|(_, frames)| *frames > 0) {
            self.note("sent", channel, || json!({ "frames": frames }));
        }
    }

    /// Closes its channels unless others use them.
    fn end_session(&self) {
        let setup = self.setup();
        for channel in Channel::ALL {
            self.note_closed(channel);
            // If the board does not respond, its thread notices.
            let _ = self.close(channel);
        }
        drop(setup);
        let mut state = self.shared.state();
        state.release(self.id);
        if let Some(member) = state.clients.get_mut(&self.id) {
            member.in_session = false;
            member.views = Views::default();
            member.counts = Default::default();
        }
    }

    fn setup(&self) -> MutexGuard<'_, ()> {
        lock(&self.shared.setup)
    }

    fn answer(&self, id: u16, result: &Result<Reply, Refusal>) -> bool {
        match result {
            // That the session is over, and why, comes first.
            Err(Refusal::NoSession) => self.outbox.answer_in_turn(encode_response(id, result)),
            _ => self.outbox.answer(encode_response(id, result)),
        }
    }

    /// Begins a session. Returns whether the client is still there.
    fn greet(&self, id: u16, protocol: u16) -> bool {
        if protocol != PROTOCOL_VERSION {
            return self.answer(id, &Err(Refusal::Protocol { device: PROTOCOL_VERSION }));
        }
        if !self.has_greeted.swap(true, Ordering::Relaxed) {
            if let Some(place) = &self.place {
                place.is_served();
            }
            self.shared.tell(News::ClientCame { client: self.name.clone(), role: self.role });
        }
        self.end_session();
        let mut state = self.shared.state();
        let Some(hello) = state.hello.clone() else {
            drop(state);
            return self.answer(id, &Err(Refusal::NoBoard));
        };
        // These are possible only for a program that has the port to itself.
        let local = capability::SLCAN | capability::BOOTLOADER | capability::GATEWAY;
        let hello = Hello { capabilities: hello.capabilities & !local, ..hello };
        let ticks = state.latest_ticks;
        if let Some(member) = state.clients.get_mut(&self.id) {
            member.in_session = true;
            // Under the lock, so that nothing of the session can come before it.
            member.outbox.restart(encode_response(id, &Ok(Reply::Hello(hello))), ticks);
        }
        true
    }

    fn perform(&self, command: Command) -> Result<Reply, Refusal> {
        if !self.with(|_, member| member.in_session) {
            return Err(Refusal::NoSession);
        }
        let result = self.perform_in_session(command);
        match result {
            // The board has gone meanwhile, and with it the session and its channels.
            Err(_) if !self.with(|_, member| member.in_session) => Err(Refusal::NoSession),
            result => result,
        }
    }

    fn perform_in_session(&self, command: Command) -> Result<Reply, Refusal> {
        let changes = match &command {
            Command::ClearDefaults => Some("clears the saved settings"),
            Command::SaveDefaults => Some("saves settings"),
            Command::Configure { .. } => Some("configures"),
            Command::Reset => Some("restarts the board"),
            _ => None,
        };
        let result = self.carry_out(command);
        if let Err(Refusal::NotGranted { needs }) = result
            && self.role < needs
        {
            let reason = format!("it may {}, and asked for what needs the right to {needs}", self.role);
            self.shared.tell(News::NotPermitted { client: self.name.clone(), reason });
        }
        if let (Some(changes), Ok(_)) = (changes, &result) {
            self.shared.note(|| {
                let mut noted = who(&self.name);
                noted["event"] = json!("changed");
                noted["text"] = json!(changes);
                noted
            });
        }
        result
    }

    fn carry_out(&self, command: Command) -> Result<Reply, Refusal> {
        match command {
            // Greeting is handled elsewhere.
            Command::Hello { .. } => Err(Refusal::Malformed),
            Command::Open { channel, config } => {
                let _setup = self.setup();
                let opened = self.open(channel, config);
                if let Ok(Reply::Opened(config)) = &opened {
                    let clock_hz = self.shared.state().hello.as_ref().map_or(1, |hello| hello.can_clock_hz);
                    let bitrate_bps = config.timing.known_bitrate_bps(clock_hz);
                    let mode = config.mode.name();
                    self.note_session(
                        "opened",
                        channel,
                        || json!({ "mode": mode, "bitrate_bps": bitrate_bps }),
                    );
                }
                opened
            }
            Command::Close { channel } => {
                let _setup = self.setup();
                self.note_closed(channel);
                self.close(channel).map(|()| Reply::Done)
            }
            Command::Status => self.status(),
            Command::Time | Command::Failures | Command::Registers { .. } => {
                self.shared.ask(command, Then::Nothing)
            }
            Command::SetFilters { channel, filters } => self.set_filters(channel, &filters),
            Command::Send { channel, frames } => {
                self.send(channel, &frames.into_iter().map(ToSend::Classic).collect())
            }
            Command::SendFd { channel, frames } => {
                self.send(channel, &frames.into_iter().map(ToSend::Fd).collect())
            }
            Command::Abort { channel } => self.withdraw(channel, false).map(|()| Reply::Done),
            Command::SetPeriodic { channel, slot, entry } => self.set_periodic(channel, slot, entry),
            Command::SetTrigger { channel, slot, entry } => self.set_trigger(channel, slot, entry),
            Command::Recover { channel } => {
                self.may_transmit_on(channel)?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::Identify { .. } => {
                self.must_be(Role::Configure)?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::Defaults { channel } => {
                let base = self.shared.state().base.get(channel.index()).copied().flatten();
                match base {
                    Some(config) => Ok(Reply::Defaults(Defaults { config, filters: heapless::Vec::new() })),
                    None => self.shared.ask(command, Then::Nothing),
                }
            }
            // A measurement's edges go to a single client: the one with the right to configure the channel. It ends when a
            // channel opens.
            Command::Configure { channel, .. } | Command::MeasureEdges { channel: Some(channel) } => {
                self.must_have(&[channel])?;
                self.shared.state().hold(self.id, &[channel])?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::ClearDefaults => {
                self.must_have(&Channel::ALL)?;
                self.shared.state().hold(self.id, &Channel::ALL)?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::MeasureEdges { channel: None } | Command::Edges => {
                self.shared.state().must_hold_any(self.id)?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::SaveDefaults => {
                self.must_have(&Channel::ALL)?;
                self.save_defaults()
            }
            Command::Reset => {
                self.must_have(&Channel::ALL)?;
                let mut state = self.shared.state();
                state.hold(self.id, &Channel::ALL)?;
                if Channel::ALL.into_iter().any(|channel| state.others_on(self.id, channel).0) {
                    return Err(Refusal::OtherSettings);
                }
                drop(state);
                self.shared.ask(command, Then::Nothing)
            }
            // Whoever flashes a firmware is at the board, and a gateway needs both channels to itself.
            Command::Bootloader
            | Command::SetGatewayRule { .. }
            | Command::StartGateway
            | Command::StopGateway
            | Command::GatewayStatus { .. }
            | Command::GatewayRule { .. }
            | Command::SaveGateway
            | Command::UnlockDisturbance { .. }
            | Command::Disturb { .. } => Err(Refusal::Unsupported),
        }
    }

    /// Looks up something about it; returns the default if it is not there any more.
    fn with<T: Default>(&self, look: impl FnOnce(&State, &Member) -> T) -> T {
        let state = self.shared.state();
        state.clients.get(&self.id).map(|member| look(&state, member)).unwrap_or_default()
    }

    fn must_be(&self, needs: Role) -> Result<(), Refusal> {
        if self.role >= needs { Ok(()) } else { Err(Refusal::NotGranted { needs }) }
    }

    fn status(&self) -> Result<Reply, Refusal> {
        let Reply::Status(mut status) = self.shared.ask(Command::Status, Then::Nothing)? else {
            return Err(Refusal::Hardware);
        };
        let state = self.shared.state();
        let Some(member) = state.clients.get(&self.id) else { return Err(Refusal::NoSession) };
        let given_up = self.outbox.given_up();
        for (channel, of_channel) in Channel::ALL.into_iter().zip(&mut status.channels) {
            let counts = &member.counts[channel.index()];
            of_channel.open = member.views[channel.index()].config;
            of_channel.frames = counts.frames.wrapping_add(given_up[channel.index()]);
            of_channel.lost_controller = counts.lost_controller;
            of_channel.lost_queue = counts.lost_queue;
            of_channel.transmitted = counts.transmitted;
            of_channel.transmit_failures = counts.transmit_failures;
            of_channel.tx_pending = state.under_way(self.id, channel) as u16;
        }
        Ok(Reply::Status(status))
    }
}

/// For how long a client has said nothing while it was listened to.
#[derive(Default)]
struct Silence {
    since: Duration,
    passed_at: Option<Instant>,
}

impl Silence {
    /// One pass is over, in which it said something or not. Returns its silence.
    fn pass(&mut self, spoke: bool) -> Duration {
        let now = Instant::now();
        let passed = self.passed_at.replace(now).map_or(Duration::ZERO, |at| now - at);
        self.since = if spoke { Duration::ZERO } else { self.since + passed.min(LONGEST_PASS) };
        self.since
    }
}

#[cfg(test)]
mod tests;
