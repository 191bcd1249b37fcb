//! One client: its requests are carried out, and those beyond its role are refused.

mod channels;
mod sending;

use std::io::{Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal};
use cantap_wire::message::{Defaults, Role, capability, write_response};
use cantap_wire::{Channel, Command, Hello, PROTOCOL_VERSION, Refusal, Reply, Request};

use crate::inbox::{Heard, Inbox};
use crate::news::News;
use crate::outbox::Outbox;
use crate::shared::{Refused, Shared};
use crate::state::{Member, State, Then};
use crate::stream::{ClientId, Views};
use crate::writer;

/// A client that has not greeted by this time is dropped.
const GREETING_TIMEOUT: Duration = Duration::from_secs(5);

/// Admits a client. Two separate threads serve it until either side ends.
pub fn admit(
    shared: &Arc<Shared>,
    mut input: Box<dyn Read + Send>,
    mut output: Box<dyn Write + Send>,
    name: &str,
    role: Role,
) -> Result<(), Refused> {
    let id = shared.next_client();
    let outbox = Arc::new(Outbox::new(shared.settings.most_records));
    {
        let mut state = shared.state();
        if state.is_over {
            return Err(Refused::Over);
        }
        if state.clients.len() >= shared.settings.most_clients {
            return Err(Refused::TooMany(state.clients.len()));
        }
        let member = Member {
            role,
            outbox: Arc::clone(&outbox),
            in_session: false,
            views: Views::default(),
            counts: Default::default(),
        };
        state.clients.insert(id, member);
        state.writers += 1;
    }
    let has_greeted = Arc::new(AtomicBool::new(false));
    let client = Client {
        shared: Arc::clone(shared),
        id,
        role,
        name: name.to_owned(),
        has_greeted: Arc::clone(&has_greeted),
        outbox: Arc::clone(&outbox),
    };
    let leave = |error| {
        shared.state().clients.remove(&id);
        Refused::Thread(error)
    };
    let (told, name) = (Arc::clone(shared), name.to_owned());
    let for_writer = Arc::clone(&outbox);
    std::thread::Builder::new()
        .name("cantap-to-client".to_owned())
        .spawn(move || {
            let reason = writer::run(&for_writer, &mut *output, id).err();
            for_writer.abandon();
            if has_greeted.load(Ordering::Relaxed) {
                told.tell(News::ClientLeft { client: name, reason });
            }
            told.has_written();
        })
        .map_err(|error| {
            shared.has_written();
            leave(error)
        })?;
    std::thread::Builder::new()
        .name("cantap-client".to_owned())
        .spawn(move || {
            client.serve(&mut *input);
            client.leave();
        })
        .map_err(|error| {
            outbox.close();
            leave(error)
        })?;
    Ok(())
}

/// A client, as seen by the thread that carries out its requests.
struct Client {
    shared: Arc<Shared>,
    id: ClientId,
    role: Role,
    name: String,
    /// Clients that connect without greeting are not reported.
    has_greeted: Arc<AtomicBool>,
    outbox: Arc<Outbox>,
}

impl Client {
    /// Reads until either side ends.
    fn serve(&self, input: &mut dyn Read) {
        let came = Instant::now();
        let mut inbox = Inbox::default();
        let mut bytes = [0; 4096];
        while !self.outbox.is_closed() {
            let len = match input.read(&mut bytes) {
                Ok(0) => return,
                Ok(len) => len,
                Err(error) if is_idle(&error) => 0,
                Err(_) => return,
            };
            let mut is_there = true;
            inbox.push(&bytes[..len], |heard| {
                is_there = is_there
                    && match heard {
                        Heard::Request(Request { id, command: Command::Hello { protocol } }) => {
                            self.greet(id, protocol)
                        }
                        Heard::Request(Request { id, command }) => {
                            let result = self.perform(command);
                            self.answer(id, &result)
                        }
                        Heard::Unreadable(id, refusal) => self.answer(id, &Err(refusal)),
                        Heard::Damaged => true,
                    };
            });
            if !is_there || !self.has_greeted.load(Ordering::Relaxed) && came.elapsed() > GREETING_TIMEOUT {
                return;
            }
        }
    }

    /// Gives back everything it had.
    fn leave(&self) {
        self.end_session();
        self.shared.state().clients.remove(&self.id);
        // What is waiting is written if anybody reads it.
        self.outbox.close();
    }

    /// Closes its channels unless others use them.
    fn end_session(&self) {
        let setup = self.setup();
        for channel in Channel::ALL {
            // If the board does not respond, its thread notices.
            let _ = self.close(channel);
        }
        drop(setup);
        let mut state = self.shared.state();
        if state.holder == Some(self.id) {
            state.holder = None;
        }
        if let Some(member) = state.clients.get_mut(&self.id) {
            member.in_session = false;
            member.views = Views::default();
            member.counts = Default::default();
        }
    }

    fn setup(&self) -> std::sync::MutexGuard<'_, ()> {
        self.shared.setup.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn answer(&self, id: u16, result: &Result<Reply, Refusal>) -> bool {
        self.outbox.answer(encoded(id, result))
    }

    /// Begins a session. Returns whether the client is still there.
    fn greet(&self, id: u16, protocol: u16) -> bool {
        if protocol != PROTOCOL_VERSION {
            return self.answer(id, &Err(Refusal::Protocol { device: PROTOCOL_VERSION }));
        }
        if !self.has_greeted.swap(true, Ordering::Relaxed) {
            self.shared.tell(News::ClientCame { client: self.name.clone(), role: self.role });
        }
        self.end_session();
        let mut state = self.shared.state();
        let Some(hello) = state.hello.clone() else {
            drop(state);
            return self.answer(id, &Err(Refusal::NoBoard));
        };
        // These are possible only for a program that has the port.
        let local = capability::SLCAN | capability::BOOTLOADER;
        let hello = Hello { capabilities: hello.capabilities & !local, ..hello };
        let ticks = state.latest_ticks;
        if let Some(member) = state.clients.get_mut(&self.id) {
            member.in_session = true;
            // Under the lock, so that nothing of the session can come before it.
            member.outbox.restart(encoded(id, &Ok(Reply::Hello(hello))), ticks);
        }
        true
    }

    fn perform(&self, command: Command) -> Result<Reply, Refusal> {
        if !self.with(|_, member| member.in_session) {
            return Err(Refusal::NoSession);
        }
        let result = self.perform_in_session(command);
        match result {
            // The board has gone meanwhile, and with it the session.
            Err(Refusal::NoBoard) if !self.with(|_, member| member.in_session) => Err(Refusal::NoSession),
            result => result,
        }
    }

    fn perform_in_session(&self, command: Command) -> Result<Reply, Refusal> {
        match command {
            // Greeting is handled elsewhere.
            Command::Hello { .. } => Err(Refusal::Malformed),
            Command::Open { channel, config } => {
                let _setup = self.setup();
                self.open(channel, config)
            }
            Command::Close { channel } => {
                let _setup = self.setup();
                self.close(channel).map(|()| Reply::Done)
            }
            Command::Status => self.status(),
            Command::Time | Command::Failures | Command::Registers { .. } => {
                self.shared.ask(command, Then::Nothing)
            }
            Command::SetFilters { channel, filters } => self.set_filters(channel, &filters),
            Command::Send { channel, frames } => self.send(channel, &frames),
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
            // A measurement's edges go to a single client: the one with the right to configure. It ends when
            // a channel opens.
            Command::Configure { .. }
            | Command::ClearDefaults
            | Command::MeasureEdges { .. }
            | Command::Edges => {
                self.shared.state().hold(self.id)?;
                self.shared.ask(command, Then::Nothing)
            }
            Command::SaveDefaults => self.save_defaults(),
            Command::Reset => {
                let mut state = self.shared.state();
                state.hold(self.id)?;
                if Channel::ALL.into_iter().any(|channel| state.others_on(self.id, channel).0) {
                    return Err(Refusal::OtherSettings);
                }
                drop(state);
                self.shared.ask(command, Then::Nothing)
            }
            // Whoever flashes a firmware is at the board.
            Command::Bootloader => Err(Refusal::Unsupported),
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
        for (channel, of_channel) in Channel::ALL.into_iter().zip(&mut status.channels) {
            let counts = &member.counts[channel.index()];
            of_channel.open = member.views[channel.index()].config;
            of_channel.frames = counts.frames;
            of_channel.lost_controller = counts.lost_controller;
            of_channel.lost_queue = counts.lost_queue;
            of_channel.transmitted = counts.transmitted;
            of_channel.transmit_failures = counts.transmit_failures;
            of_channel.tx_pending = state.under_way(self.id, channel) as u16;
        }
        Ok(Reply::Status(status))
    }
}

/// An answer as it goes over the wire.
fn encoded(id: u16, result: &Result<Reply, Refusal>) -> Vec<u8> {
    let mut message = vec![0; MAX_MESSAGE + CRC_LEN];
    let mut out = vec![0; MAX_ENCODED];
    // This cannot fail: the longest answer is shorter than the longest message.
    let len = write_response(id, result, &mut message[..MAX_MESSAGE])
        .and_then(|len| seal(&mut message, len, &mut out))
        .unwrap_or(0);
    out.truncate(len);
    out
}
