//! One client: what it asks is done, and what it may not do is refused.

use std::io::{Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cantap::device::is_idle;
use cantap_wire::framing::{CRC_LEN, MAX_ENCODED, MAX_MESSAGE, seal};
use cantap_wire::message::{
    ChannelConfig, Defaults, Filter, FrameKind, Periodic, Role, Trigger, TxFrame, capability, write_response,
};
use cantap_wire::{Channel, Command, Hello, PROTOCOL_VERSION, Refusal, Reply, Request};

use crate::inbox::{Heard, Inbox};
use crate::news::News;
use crate::outbox::Outbox;
use crate::shared::{Refused, Shared, only_listens};
use crate::state::{Member, State, Table, Then, clears, for_all};
use crate::stream::{ClientId, Views};
use crate::writer;

/// A client that has not greeted by then is let go.
const GREETING_TIMEOUT: Duration = Duration::from_secs(5);
/// A channel that the board closes has said its last word by then.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);
/// What a board has captured when it is asked for its time has arrived by then.
const SETTLE_TIMEOUT: Duration = Duration::from_millis(30);
/// Frames that are given up have been reported by then.
const WITHDRAW_TIMEOUT: Duration = Duration::from_millis(500);
/// A client whose frames find the board's queue full, perhaps of another's, waits this long before it is refused.
const ROOM_TIMEOUT: Duration = Duration::from_millis(800);

/// Lets a client in. Two threads of its own serve it until either side ends.
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

/// A client, as the thread that does what it asks has it.
struct Client {
    shared: Arc<Shared>,
    id: ClientId,
    role: Role,
    name: String,
    /// Those who only knock are not reported to anybody.
    has_greeted: Arc<AtomicBool>,
    outbox: Arc<Outbox>,
}

/// How a channel comes to be a client's.
enum Way {
    /// It is open as the client wants it.
    Attach(ChannelConfig),
    /// It is closed.
    Open,
    /// It is open, and may be opened anew.
    Reopen(ChannelConfig),
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

    /// Gives back what it had.
    fn leave(&self) {
        self.end_session();
        self.shared.state().clients.remove(&self.id);
        // What waits is written if anybody reads it.
        self.outbox.close();
    }

    /// Closes its channels, as far as others do not use them.
    fn end_session(&self) {
        let setup = self.setup();
        for channel in Channel::ALL {
            // If the board does not follow, its thread notices.
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
        // What only one who has the port can do.
        let local = capability::SLCAN | capability::BOOTLOADER;
        let hello = Hello { capabilities: hello.capabilities & !local, ..hello };
        let ticks = state.latest_ticks;
        if let Some(member) = state.clients.get_mut(&self.id) {
            member.in_session = true;
            // Under the lock: nothing of the session can be put in before.
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
            // The board has gone meanwhile, and the session with it.
            Err(Refusal::NoBoard) if !self.with(|_, member| member.in_session) => Err(Refusal::NoSession),
            result => result,
        }
    }

    fn perform_in_session(&self, command: Command) -> Result<Reply, Refusal> {
        match command {
            // Greeted elsewhere.
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
            // A measurement has one to whom its edges go: who holds the right. It ends when a channel opens.
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
            // Whoever writes a firmware is beside the board.
            Command::Bootloader => Err(Refusal::Unsupported),
        }
    }

    /// Looks at what is known of it; of one that is not there any more, at nothing.
    fn with<T: Default>(&self, look: impl FnOnce(&State, &Member) -> T) -> T {
        let state = self.shared.state();
        state.clients.get(&self.id).map(|member| look(&state, member)).unwrap_or_default()
    }

    fn must_be(&self, needs: Role) -> Result<(), Refusal> {
        if self.role >= needs { Ok(()) } else { Err(Refusal::NotGranted { needs }) }
    }

    /// Whether the client may send, and has the channel open for it.
    fn may_transmit_on(&self, channel: Channel) -> Result<(), Refusal> {
        self.must_be(Role::Send)?;
        self.with(|_, member| {
            let view = &member.views[channel.index()];
            Some(match view.config {
                None => Err(Refusal::ChannelClosed),
                Some(_) if !view.transmits() => Err(Refusal::ListenOnly),
                Some(_) => Ok(()),
            })
        })
        .unwrap_or(Err(Refusal::NoSession))
    }

    fn is_open(&self, channel: Channel) -> bool {
        self.with(|_, member| member.views[channel.index()].config.is_some())
    }

    fn open(&self, channel: Channel, config: Option<ChannelConfig>) -> Result<Reply, Refusal> {
        if self.is_open(channel) {
            return Err(Refusal::ChannelOpen);
        }
        let base = self.shared.state().base[channel.index()];
        let wanted = match config.or(base) {
            Some(config) => config,
            None => match self.shared.ask(Command::Defaults { channel }, Then::Nothing)? {
                Reply::Defaults(saved) => saved.config,
                _ => return Err(Refusal::NothingSaved),
            },
        };
        let way = self.way(channel, &wanted)?;
        let then = || Then::Opened { client: Some((self.id, wanted)), channel };
        let config = Some(for_all(wanted));
        match way {
            Way::Attach(current) => {
                let given = ChannelConfig { timing: current.timing, ..wanted };
                self.shared.state().attach(self.id, channel, given);
                return Ok(Reply::Opened(given));
            }
            Way::Open => {
                self.shared.ask(Command::Open { channel, config }, then())?;
            }
            Way::Reopen(before) => {
                self.close_on_board(channel)?;
                if let Err(refusal) = self.shared.ask(Command::Open { channel, config }, then()) {
                    self.reopen(channel, before)?;
                    return Err(refusal);
                }
            }
        }
        Ok(Reply::Opened(wanted))
    }

    /// How the channel can come to be as the client wants it, if it may.
    fn way(&self, channel: Channel, wanted: &ChannelConfig) -> Result<Way, Refusal> {
        let mut state = self.shared.state();
        let (any_other, other_sends) = state.others_on(self.id, channel);
        let (base, current) = (state.base[channel.index()], state.open[channel.index()]);
        let is_base = base.is_some_and(|base| base.timing == wanted.timing);
        if !only_listens(wanted) {
            self.must_be(Role::Send)?;
        }
        let Some(current) = current else {
            if !is_base || !only_listens(wanted) {
                // Whoever may only listen takes the bit rate that there is.
                let other = base.is_some() && only_listens(wanted) && self.role < Role::Configure;
                state
                    .hold(self.id)
                    .map_err(|refusal| if other { Refusal::OtherSettings } else { refusal })?;
            }
            return Ok(Way::Open);
        };
        let is_same = current.timing == wanted.timing;
        if is_same && (only_listens(wanted) || for_all(*wanted) == current) {
            return Ok(Way::Attach(current));
        }
        // Others' stamps and loads are made with the timing that they know; senders count on their mode.
        if (any_other && !is_same) || other_sends {
            return Err(Refusal::OtherSettings);
        }
        state.hold(self.id)?;
        Ok(Way::Reopen(current))
    }

    /// Closes a channel on the board and waits for all that it had to say.
    fn close_on_board(&self, channel: Channel) -> Result<(), Refusal> {
        let stopped = |state: &State| state.stopped[channel.index()];
        let before = stopped(&self.shared.state());
        self.shared.ask(Command::Close { channel }, Then::Nothing)?;
        // If it never says so, the link has lost it.
        self.shared.wait_for(STOP_TIMEOUT, |state| stopped(state) != before || state.hello.is_none());
        self.shared.state().open[channel.index()] = None;
        Ok(())
    }

    /// Opens a channel for those who have it open, who miss what was on the bus meanwhile.
    fn reopen(&self, channel: Channel, config: ChannelConfig) -> Result<(), Refusal> {
        let opened = self
            .shared
            .ask(Command::Open { channel, config: Some(config) }, Then::Opened { client: None, channel });
        if opened.is_err() {
            // They must not believe in a quiet bus.
            self.shared.state().must_end = true;
        }
        opened.map(|_| ())
    }

    /// Gives a channel up. The board closes it if nobody else has it open, and only listens if nobody else sends.
    fn close(&self, channel: Channel) -> Result<(), Refusal> {
        if !self.is_open(channel) {
            return Ok(());
        }
        let sends = self.with(|_, member| member.views[channel.index()].transmits());
        let (any_other, other_sends) = self.shared.state().others_on(self.id, channel);
        if sends && any_other {
            self.clear_entries(channel);
            self.withdraw(channel, true)?;
        }
        let closed = if !any_other {
            self.close_on_board(channel)
        } else if sends && !other_sends {
            let current = self.shared.state().open[channel.index()];
            self.close_on_board(channel).and_then(|()| match current {
                Some(current) => {
                    self.shared.state().detach(self.id, channel);
                    self.reopen(channel, for_all(ChannelConfig::listen_only(current.timing)))
                }
                None => Ok(()),
            })
        } else {
            self.settle()
        };
        self.shared.state().detach(self.id, channel);
        closed
    }

    /// Waits for what the board has captured until now.
    fn settle(&self) -> Result<(), Refusal> {
        if let Reply::Time(ticks) = self.shared.ask(Command::Time, Then::Nothing)? {
            self.shared.wait_for(SETTLE_TIMEOUT, |state| state.latest_ticks >= ticks);
        }
        Ok(())
    }

    /// Takes the client's frames out of the board's queue. What others have in it is still sent.
    fn withdraw(&self, channel: Channel, is_closed: bool) -> Result<(), Refusal> {
        {
            let mut state = self.shared.state();
            if state.under_way(self.id, channel) == 0 {
                return Ok(());
            }
            for sent in state.sent.values_mut().filter(|sent| sent.channel == channel) {
                sent.keep = sent.client != self.id;
                sent.is_closed |= is_closed && sent.client == self.id;
            }
        }
        self.shared.ask(Command::Abort { channel }, Then::Nothing)?;
        let id = self.id;
        self.shared
            .wait_for(WITHDRAW_TIMEOUT, |state| state.under_way(id, channel) == 0 || state.hello.is_none());
        Ok(())
    }

    fn clear_entries(&self, channel: Channel) {
        let entries = self.shared.state().entries[channel.index()].of(self.id);
        for (table, entry) in entries {
            // If the board does not follow, its thread notices.
            let _ = self.shared.ask(clears(table, channel, entry), Then::Nothing);
            self.shared.state().entries[channel.index()].free(table, entry);
        }
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

    /// Filters are the server's: each client has its own, and the board hears for all.
    fn set_filters(&self, channel: Channel, filters: &[Filter]) -> Result<Reply, Refusal> {
        if !filters.iter().all(Filter::is_valid) {
            return Err(Refusal::BadId);
        }
        let mut state = self.shared.state();
        let banks_total = state.hello.as_ref().map_or(0, |hello| hello.filter_banks);
        let Some(member) = state.clients.get_mut(&self.id) else { return Err(Refusal::NoSession) };
        let view = &mut member.views[channel.index()];
        if view.config.is_some() {
            return Err(Refusal::ChannelOpen);
        }
        view.filters = filters.to_vec();
        Ok(Reply::Filters { banks_used: banks_of(filters).min(banks_total), banks_total })
    }

    fn send(&self, channel: Channel, frames: &[TxFrame]) -> Result<Reply, Refusal> {
        self.may_transmit_on(channel)?;
        if frames.iter().any(|frame| frame.tag >= cantap_wire::message::DEVICE_TAG) {
            return Err(Refusal::BadTag);
        }
        let deadline = Instant::now() + ROOM_TIMEOUT;
        loop {
            let noted: heapless::Vec<TxFrame, { cantap_wire::message::MAX_SEND }> = {
                let mut state = self.shared.state();
                let note =
                    |frame: &TxFrame| TxFrame { tag: state.note_sent(self.id, channel, *frame), ..*frame };
                frames.iter().map(note).collect()
            };
            let tags: Vec<u32> = noted.iter().map(|frame| frame.tag).collect();
            let result = self.shared.ask(Command::Send { channel, frames: noted }, Then::Nothing);
            if result.is_err() {
                let mut state = self.shared.state();
                for tag in tags {
                    state.sent.remove(&tag);
                }
            }
            match result {
                // Perhaps by another's frames: they leave.
                Err(Refusal::QueueFull { .. }) if Instant::now() < deadline && !self.outbox.is_closed() => {
                    std::thread::sleep(Duration::from_millis(2));
                }
                result => return result,
            }
        }
    }

    fn set_periodic(&self, channel: Channel, slot: u8, entry: Option<Periodic>) -> Result<Reply, Refusal> {
        let command = |slot, entry| Command::SetPeriodic { channel, slot, entry };
        let slots = self.with(|state, _| state.hello.as_ref().map_or(0, |hello| hello.periodic_slots));
        self.set_entry(Table::Periodic, channel, slot, slots, entry, command)
    }

    fn set_trigger(&self, channel: Channel, slot: u8, entry: Option<Trigger>) -> Result<Reply, Refusal> {
        let command = |slot, entry| Command::SetTrigger { channel, slot, entry };
        let slots = self.with(|state, _| state.hello.as_ref().map_or(0, |hello| hello.trigger_slots));
        self.set_entry(Table::Triggers, channel, slot, slots, entry, command)
    }

    fn set_entry<E>(
        &self,
        table: Table,
        channel: Channel,
        slot: u8,
        slots: u8,
        entry: Option<E>,
        command: impl Fn(u8, Option<E>) -> Command,
    ) -> Result<Reply, Refusal> {
        if slot >= slots {
            return Err(Refusal::BadSlot);
        }
        let Some(entry) = entry else {
            let found = self.shared.state().entries[channel.index()].find(table, self.id, slot);
            let Some(found) = found else { return Ok(Reply::Done) };
            let done = self.shared.ask(command(found, None), Then::Nothing)?;
            self.shared.state().entries[channel.index()].free(table, found);
            return Ok(done);
        };
        self.may_transmit_on(channel)?;
        let (had, taken) = {
            let entries = &mut self.shared.state().entries[channel.index()];
            let had = entries.find(table, self.id, slot);
            (had, entries.take(table, self.id, slot, slots))
        };
        // All of the board's are in use, the other clients' among them.
        let taken = taken.ok_or(Refusal::QueueFull { free: 0 })?;
        let result = self.shared.ask(command(taken, Some(entry)), Then::Nothing);
        if result.is_err() && had.is_none() {
            self.shared.state().entries[channel.index()].free(table, taken);
        }
        result
    }

    /// Stores what the client has configured, its filters among it, which the board does not have otherwise.
    fn save_defaults(&self) -> Result<Reply, Refusal> {
        let _setup = self.setup();
        self.shared.state().hold(self.id)?;
        let filters = self.with(|_, member| Some(member.views.clone())).ok_or(Refusal::NoSession)?;
        for (channel, view) in Channel::ALL.into_iter().zip(&filters) {
            let filters = heapless::Vec::from_slice(&view.filters).map_err(|_| Refusal::Malformed)?;
            self.shared.ask(Command::SetFilters { channel, filters }, Then::Nothing)?;
        }
        let saved = self.shared.ask(Command::SaveDefaults, Then::Nothing);
        for channel in Channel::ALL {
            let filters = heapless::Vec::new();
            self.shared.ask(Command::SetFilters { channel, filters }, Then::Nothing)?;
        }
        saved
    }
}

/// An answer as it goes over the wire.
fn encoded(id: u16, result: &Result<Reply, Refusal>) -> Vec<u8> {
    let mut message = vec![0; MAX_MESSAGE + CRC_LEN];
    let mut out = vec![0; MAX_ENCODED];
    // Cannot fail: the longest answer is shorter than the longest message.
    let len = write_response(id, result, &mut message[..MAX_MESSAGE])
        .and_then(|len| seal(&mut message, len, &mut out))
        .unwrap_or(0);
    out.truncate(len);
    out
}

/// Banks that filters would need on the board (docs/wire-protocol.md).
fn banks_of(filters: &[Filter]) -> u8 {
    let is_exact = |filter: &&Filter| {
        let all = if filter.extended { cantap_wire::Id::MAX_EXTENDED } else { cantap_wire::Id::MAX_STANDARD };
        filter.mask == all && filter.kind != FrameKind::Any
    };
    let count = |extended: bool, exact: bool| {
        filters.iter().filter(|filter| filter.extended == extended && is_exact(filter) == exact).count()
    };
    let banks = count(true, false)
        + count(true, true).div_ceil(2)
        + count(false, false).div_ceil(2)
        + count(false, true).div_ceil(4);
    banks.clamp(1, usize::from(u8::MAX)) as u8
}
