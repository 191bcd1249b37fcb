//! What a server knows about its board and the clients who share it. It is protected by one lock, which nobody holds while
//! waiting for anything.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Instant;

use cantap_wire::message::{ChannelConfig, DEVICE_TAG, Mode, Role, TRIGGER_TAG};
use cantap_wire::record::{ErrorState, LossStage, Record, TransmitFailure};
use cantap_wire::{CHANNELS, Channel, Command, Event, Hello, Refusal};

use crate::outbox::{Item, Outbox};
use crate::stream::{ClientId, Counts, Entry, Owner, Views};
use crate::to_send::ToSend;
use crate::totals::{Totals, count};

/// Tags in a board's queue wrap here: far below the board's own tags, far above the number in flight.
const TAGS: u32 = 1 << 30;

/// One client.
pub struct Member {
    /// It takes one of the board's places, because it has none at a listener.
    pub is_counted: bool,
    pub role: Role,
    pub outbox: Arc<Outbox>,
    /// It has greeted, and its session is not over.
    pub in_session: bool,
    pub views: Views,
    pub counts: [Counts; CHANNELS],
}

/// A frame in the board's queue, or in a mailbox.
pub struct Sent {
    pub client: ClientId,
    /// With the client's tag.
    pub frame: ToSend,
    pub channel: Channel,
    /// Another client's frames are being withdrawn: this one must be sent again.
    pub keep: bool,
    /// The client has closed the channel, which is reported as the reason.
    pub is_closed: bool,
}

/// What to do when an answer arrives, in the order of the stream.
#[derive(Default)]
pub enum Then {
    /// Nothing.
    #[default]
    Nothing,
    /// The channel is open on the board; it becomes this client's, if there is one.
    Opened { client: Option<(ClientId, ChannelConfig)>, channel: Channel },
    /// A frame was sent again.
    SentAgain(u32),
}

/// One of the board's tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Table {
    Periodic,
    Triggers,
}

impl Table {
    /// The first tag of its entries.
    pub const fn tag(self) -> u32 {
        match self {
            Self::Periodic => DEVICE_TAG,
            Self::Triggers => TRIGGER_TAG,
        }
    }
}

/// Which client has which entries of the board's tables on one channel, and the client's own numbers for
/// them.
#[derive(Default)]
pub struct Entries {
    periodic: BTreeMap<u8, (ClientId, u8)>,
    triggers: BTreeMap<u8, (ClientId, u8)>,
    /// Whose an entry was that is free again, by its first tag and its number: its last frames may be confirmed after it is cleared.
    former: BTreeMap<(u32, u8), (ClientId, u8)>,
}

impl Entries {
    fn table(&mut self, table: Table) -> &mut BTreeMap<u8, (ClientId, u8)> {
        match table {
            Table::Periodic => &mut self.periodic,
            Table::Triggers => &mut self.triggers,
        }
    }

    /// The board's entry for a client's, if it has one.
    pub fn find(&mut self, table: Table, client: ClientId, slot: u8) -> Option<u8> {
        self.table(table).iter().find(|(_, owner)| **owner == (client, slot)).map(|(entry, _)| *entry)
    }

    /// The same, or a free one.
    pub fn take(&mut self, table: Table, client: ClientId, slot: u8, slots: u8) -> Option<u8> {
        let found = self.find(table, client, slot);
        let table = self.table(table);
        // Each client gets its own number if it is free, so that a single client sees the board's tables as
        // they are.
        let entry = found
            .or_else(|| std::iter::once(slot).chain(0..slots).find(|entry| !table.contains_key(entry)))?;
        table.insert(entry, (client, slot));
        Some(entry)
    }

    pub fn free(&mut self, table: Table, entry: u8) {
        if let Some(owner) = self.table(table).remove(&entry) {
            self.former.insert((table.tag(), entry), owner);
        }
    }

    /// Every entry of a client, with its own number for it.
    pub fn of(&mut self, client: ClientId) -> Vec<(Table, u8, u8)> {
        let mut all = Vec::new();
        for table in [Table::Periodic, Table::Triggers] {
            let owned = self.table(table).iter().filter(|(_, (owner, _))| *owner == client);
            all.extend(owned.map(|(entry, (_, slot))| (table, *entry, *slot)));
        }
        all
    }

    /// The client to whom one of the board's own tags belongs, and its number there.
    fn owner(&self, tag: u32) -> Option<Owner> {
        let (table, entries) = if tag >= TRIGGER_TAG {
            (Table::Triggers, &self.triggers)
        } else {
            (Table::Periodic, &self.periodic)
        };
        let entry = u8::try_from(tag - table.tag()).ok()?;
        let (client, slot) = entries.get(&entry).or_else(|| self.former.get(&(table.tag(), entry)))?;
        Some(Owner { client: *client, tag: table.tag() + u32::from(*slot) })
    }

    pub fn clear(&mut self) {
        *self = Self::default();
    }
}

/// The whole state.
#[derive(Default)]
pub struct State {
    /// The board, while it is there.
    pub hello: Option<Hello>,
    /// How each channel is opened unless a client that may change it does.
    pub base: [Option<ChannelConfig>; CHANNELS],
    /// How each channel is open on the board.
    pub open: [Option<ChannelConfig>; CHANNELS],
    controller: [Option<(ErrorState, u8, u8)>; CHANNELS],
    /// Device time of the latest record.
    pub latest_ticks: u64,
    /// How often each channel has stopped.
    pub stops: [u32; CHANNELS],
    pub clients: BTreeMap<ClientId, Member>,
    /// The client with the right to configure each channel.
    holders: [Option<ClientId>; CHANNELS],
    /// Who is closing a channel that the board closes: it sees no gap behind its end.
    pub closing: [Option<ClientId>; CHANNELS],
    /// Since when each channel is open for sending though nobody may send on it any more.
    pub kept: [Option<Instant>; CHANNELS],
    pub sent: HashMap<u32, Sent>,
    next_tag: u32,
    pub entries: [Entries; CHANNELS],
    /// Frames to send once more, with their channel, when the lock is free.
    pub again: Vec<(Channel, ToSend)>,
    /// Since the start, without what connected clients have lost.
    totals: Totals,
    /// Number of clients being written to.
    pub writers: usize,
    /// The server is ending: nobody else is admitted.
    pub is_over: bool,
}

impl State {
    /// Records a frame that is going to the board. Returns its tag there.
    pub fn note_sent(&mut self, client: ClientId, channel: Channel, frame: ToSend) -> u32 {
        let tag = self.next_tag;
        self.next_tag = (tag + 1) % TAGS;
        self.sent.insert(tag, Sent { client, frame, channel, keep: false, is_closed: false });
        tag
    }

    /// Number of a client's frames in flight on a channel.
    pub fn under_way(&self, client: ClientId, channel: Channel) -> usize {
        self.sent.values().filter(|sent| sent.client == client && sent.channel == channel).count()
    }

    /// What was counted since the start.
    pub fn totals(&self) -> Totals {
        let mut totals = self.totals;
        self.clients.values().for_each(|member| member.outbox.add_lost(&mut totals));
        totals
    }

    /// Frames of each channel were lost in front of a client that is fed from its own queue.
    pub fn count_lost(&mut self, lost: [u64; CHANNELS]) {
        for (of, lost) in self.totals.iter_mut().zip(lost) {
            of.lost_host += lost;
        }
    }

    /// Removes a client.
    pub fn remove(&mut self, client: ClientId) {
        if let Some(member) = self.clients.remove(&client) {
            member.outbox.add_lost(&mut self.totals);
        }
    }

    /// Whether another client has a channel open, and whether one of them may send on it.
    pub fn others_on(&self, client: ClientId, channel: Channel) -> (bool, bool) {
        let others = self.clients.iter().filter(|(id, _)| **id != client);
        others
            .map(|(_, member)| &member.views[channel.index()])
            .fold((false, false), |(any, senders), view| {
                (any || view.config.is_some(), senders || view.transmits())
            })
    }

    /// How many others have a channel open.
    pub fn listeners(&self, client: ClientId, channel: Channel) -> usize {
        let others = self.clients.iter().filter(|(id, _)| **id != client);
        others.filter(|(_, member)| member.views[channel.index()].config.is_some()).count()
    }

    /// Gives a client the right to configure channels, if it may have it: all of them or none.
    pub fn hold(&mut self, client: ClientId, channels: &[Channel]) -> Result<(), Refusal> {
        let role = self.clients.get(&client).map_or(Role::Listen, |member| member.role);
        if role < Role::Configure {
            return Err(Refusal::NotGranted { needs: Role::Configure });
        }
        let is_free = |channel: &Channel| self.holders[channel.index()].is_none_or(|holder| holder == client);
        if !channels.iter().all(is_free) {
            return Err(Refusal::Held);
        }
        for channel in channels {
            self.holders[channel.index()] = Some(client);
        }
        Ok(())
    }

    /// Checks that a client has the right to configure a channel, whichever.
    pub fn must_hold_any(&mut self, client: ClientId) -> Result<(), Refusal> {
        if self.holders.contains(&Some(client)) {
            return Ok(());
        }
        self.hold(client, &Channel::ALL)
    }

    /// Takes the right to configure from a client.
    pub fn release(&mut self, client: ClientId) {
        self.holders.iter_mut().filter(|holder| **holder == Some(client)).for_each(|holder| *holder = None);
    }

    /// Takes a record from the board. Returns how it is passed on to the clients, if it is.
    pub fn take(&mut self, ticks: u64, record: Record) -> Option<Entry> {
        // Stamps can be corrected to before an earlier record.
        self.latest_ticks = self.latest_ticks.max(ticks);
        let mut entry = Entry { ticks, record, owner: None };
        let event = match record {
            Record::Event(event) => event,
            Record::TransmittedFd(sent) => {
                entry.owner = self.owner_of_sent(sent.tag, sent.channel);
                return Some(entry);
            }
            Record::Received(_) | Record::ReceivedFd(_) => return Some(entry),
        };
        match event {
            Event::Stopped { .. } => return None,
            Event::State { channel, state, tec, rec } => {
                self.controller[channel.index()] = Some((state, tec, rec));
            }
            Event::Transmitted { tag, channel, .. } => {
                entry.owner = self.owner_of_sent(tag, channel);
            }
            Event::TransmitFailed { channel, tag, reason } => match self.sent.remove(&tag) {
                Some(sent) if sent.keep && reason == TransmitFailure::Aborted => {
                    let client = sent.client;
                    let again = self.note_sent(client, channel, sent.frame);
                    self.again.push((channel, sent.frame.tagged(again)));
                    return None;
                }
                Some(sent) => {
                    entry.owner = Some(Owner { client: sent.client, tag: sent.frame.tag() });
                    let reason = if sent.is_closed { TransmitFailure::Closed } else { reason };
                    entry.record = Record::Event(Event::TransmitFailed { channel, tag, reason });
                }
                None => entry.owner = self.entries[channel.index()].owner_of_own(tag),
            },
            _ => {}
        }
        Some(entry)
    }

    /// Whose frame it was that the board has sent, if it was a client's.
    fn owner_of_sent(&mut self, tag: u32, channel: Channel) -> Option<Owner> {
        match self.sent.remove(&tag) {
            Some(sent) => Some(Owner { client: sent.client, tag: sent.frame.tag() }),
            None => self.entries[channel.index()].owner_of_own(tag),
        }
    }

    /// A frame that should have been sent again was not accepted.
    pub fn give_up(&mut self, tag: u32) -> Option<Entry> {
        let Sent { client, frame, channel, is_closed, .. } = self.sent.remove(&tag)?;
        let reason = if is_closed { TransmitFailure::Closed } else { TransmitFailure::Aborted };
        let mut entry =
            Entry::event(self.latest_ticks, Event::TransmitFailed { channel, tag: frame.tag(), reason });
        entry.owner = Some(Owner { client, tag: frame.tag() });
        Some(entry)
    }

    /// The board has left a channel's bus. Whoever has it open, and is not the one who closes it, misses what is on the bus from here until
    /// it is opened again: a gap.
    pub fn stopped(&mut self, channel: Channel, ticks: u64) {
        self.latest_ticks = self.latest_ticks.max(ticks);
        self.stops[channel.index()] += 1;
        if let Some(client) = self.closing[channel.index()].take() {
            self.detach(client, channel);
        }
        let gap = Event::Lost { channel, stage: LossStage::Link, count: 0, at_least: true };
        self.deliver(&mut vec![Entry::event(ticks, gap)]);
    }

    /// Passes records to every client. Nobody waits.
    pub fn deliver(&mut self, chunk: &mut Vec<Entry>) {
        if chunk.is_empty() {
            return;
        }
        for entry in &*chunk {
            count(&mut self.totals, entry);
        }
        let chunk = std::mem::take(chunk).into();
        for (id, member) in &mut self.clients {
            if member.in_session {
                member.outbox.offer(&chunk, *id, &member.views, &mut member.counts);
            }
        }
    }

    /// The board has opened a channel.
    pub fn opened(&mut self, channel: Channel, config: ChannelConfig) {
        self.open[channel.index()] = Some(config);
        self.controller[channel.index()] = None;
        self.kept[channel.index()] = None;
        self.entries[channel.index()].clear();
    }

    /// A client has a channel from here on.
    pub fn attach(&mut self, client: ClientId, channel: Channel, config: ChannelConfig) {
        let ticks = self.latest_ticks;
        let controller = self.controller[channel.index()];
        let Some(member) = self.clients.get_mut(&client) else { return };
        let view = &mut member.views[channel.index()];
        view.config = Some(config);
        member.outbox.push(Item::Attach(channel, view.clone(), ticks));
        if let Some((state, tec, rec)) = controller.filter(|(state, ..)| *state != ErrorState::Active) {
            let state = Entry::event(ticks, Event::State { channel, state, tec, rec });
            member.outbox.offer(&Arc::from([state]), client, &member.views, &mut member.counts);
        }
    }

    /// Nothing more of a channel follows for a client.
    pub fn detach(&mut self, client: ClientId, channel: Channel) {
        let ticks = self.latest_ticks;
        if let Some(member) = self.clients.get_mut(&client)
            && member.views[channel.index()].config.take().is_some()
        {
            member.outbox.detach(channel, ticks);
        }
    }

    /// The board's channels are closed, whatever was requested of it.
    pub fn forget_board(&mut self) {
        self.hello = None;
        self.open = [None; CHANNELS];
        self.controller = [None; CHANNELS];
        self.holders = [None; CHANNELS];
        self.closing = [None; CHANNELS];
        self.kept = [None; CHANNELS];
        self.sent.clear();
        self.again.clear();
        self.entries = Default::default();
    }
}

impl Entries {
    /// Like [`Self::owner`], for any tag.
    fn owner_of_own(&self, tag: u32) -> Option<Owner> {
        (tag >= DEVICE_TAG).then(|| self.owner(tag)).flatten()
    }
}

/// How a channel is opened on the board for all who share it: what a client wants left out is left out by the
/// server.
pub const fn for_all(config: ChannelConfig) -> ChannelConfig {
    let sends = !matches!(config.mode, Mode::ListenOnly);
    ChannelConfig {
        timing: config.timing,
        mode: config.mode,
        one_shot: sends && config.one_shot,
        manual_recovery: sends && config.manual_recovery,
        omit_data: false,
        omit_stamps: false,
    }
}

/// A request that concerns an entry of a table.
pub fn clears(table: Table, channel: Channel, slot: u8) -> Command {
    match table {
        Table::Periodic => Command::SetPeriodic { channel, slot, entry: None },
        Table::Triggers => Command::SetTrigger { channel, slot, entry: None },
    }
}
