//! What a client sends: frames, periodic entries, replies. Each client has its own numbers for them, and they go with it when it leaves.

use std::time::{Duration, Instant};

use cantap_wire::message::{Periodic, Role, Trigger};
use cantap_wire::record::TransmitFailure;
use cantap_wire::{Channel, Command, Event, Refusal, Reply};

use serde_json::json;

use super::Client;
use super::budget::Holder;
use crate::News;
use crate::lock::lock;
use crate::permissions::Denied;
use crate::state::{Table, Then, clears};
use crate::stream::{Entry, Owner};
use crate::to_send::{self, Batch, ToSend};

/// Withdrawn frames have been reported by this time.
const WITHDRAW_TIMEOUT: Duration = Duration::from_millis(500);
/// How long a client whose frames find the board's queue full, perhaps with another client's, waits before it is
/// refused.
const ROOM_TIMEOUT: Duration = Duration::from_millis(800);

impl Client {
    /// Checks that the client may send, and has the channel open for it.
    pub(super) fn may_transmit_on(&self, channel: Channel) -> Result<(), Refusal> {
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

    pub(super) fn send(&self, channel: Channel, frames: &Batch) -> Result<Reply, Refusal> {
        self.may_transmit_on(channel)?;
        if frames.iter().any(|frame| frame.tag() >= cantap_wire::message::DEVICE_TAG) {
            return Err(Refusal::BadTag);
        }
        self.must_be_permitted(Role::Send, |permit, _| {
            frames.iter().try_for_each(|frame| permit.send(frame.id()))
        })?;
        let deadline = Instant::now() + ROOM_TIMEOUT;
        self.take_from_budget(frames.len(), deadline)?;
        loop {
            let noted: Batch = {
                let mut state = self.shared.state();
                let note = |frame: &ToSend| frame.tagged(state.note_sent(self.id, channel, *frame));
                frames.iter().map(note).collect()
            };
            let tags: Vec<u32> = noted.iter().map(ToSend::tag).collect();
            let result = self.shared.ask(to_send::command(channel, &noted), Then::Nothing);
            if result.is_err() {
                let mut state = self.shared.state();
                for tag in tags {
                    state.sent.remove(&tag);
                }
            }
            match result {
                // Perhaps it is full with another client's frames: they will leave.
                Err(Refusal::QueueFull { .. }) if Instant::now() < deadline && !self.outbox.is_closed() => {
                    std::thread::sleep(Duration::from_millis(2));
                }
                result => {
                    if result.is_ok() {
                        lock(&self.sent)[channel.index()] += frames.len() as u64;
                    }
                    return result;
                }
            }
        }
    }

    /// Waits until so many more frames are permitted.
    fn take_from_budget(&self, frames: usize, deadline: Instant) -> Result<(), Refusal> {
        let Some(most) = self.frames_per_second() else { return Ok(()) };
        while !lock(&self.budget).take(frames, most, Instant::now()) {
            if Instant::now() >= deadline || self.outbox.is_closed() {
                let (client, reason) = (self.name.clone(), Denied::Rate(most).to_string());
                self.shared.tell(News::NotPermitted { client, reason });
                return Err(Refusal::QueueFull { free: 0 });
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    /// Takes the first frame of a periodic entry out of the budget. Returns whether the one that it replaces was stopped for that, because it
    /// leaves nothing.
    fn take_first_of_entry(&self, channel: Channel, slot: u8, rate: f64) -> Result<bool, Refusal> {
        let deadline = Instant::now() + ROOM_TIMEOUT;
        let Some(most) = self.frames_per_second() else { return Ok(false) };
        let found = self.shared.state().entries[channel.index()].find(Table::Periodic, self.id, slot);
        let of = (self.holder(), channel, slot);
        let pause = || lock(&self.budget).pause_for(of, rate, most, Instant::now(), ROOM_TIMEOUT);
        if let Some((found, pause)) = found.and_then(|found| Some((found, pause()?))) {
            self.shared.ask(clears(Table::Periodic, channel, found), Then::Nothing)?;
            std::thread::sleep(pause);
            return Ok(true);
        }
        self.take_from_budget(1, deadline).map(|()| false)
    }

    /// The client, as its certificate's budget knows it.
    fn holder(&self) -> Holder {
        (self.permit.as_ref().map_or(0, |(_, number)| *number), self.id)
    }

    /// What it sends periodically on a channel is gone.
    pub(super) fn clear_budget(&self, channel: Channel) {
        if let Some(most) = self.frames_per_second() {
            lock(&self.budget).clear((self.holder(), channel), most, Instant::now());
        }
    }

    fn frames_per_second(&self) -> Option<u32> {
        self.permit.as_ref().and_then(|(permit, _)| permit.frames_per_second)
    }

    /// Takes the client's frames out of the board's queue. Those of others are still sent.
    pub(super) fn withdraw(&self, channel: Channel, is_closed: bool) -> Result<(), Refusal> {
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

    /// Clears what it has in the board's tables. Returns each entry's tag.
    pub(super) fn clear_entries(&self, channel: Channel) -> Vec<u32> {
        let entries = self.shared.state().entries[channel.index()].of(self.id);
        for (table, entry, _) in &entries {
            // If the board does not respond, its thread notices.
            let _ = self.shared.ask(clears(*table, channel, *entry), Then::Nothing);
            self.shared.state().entries[channel.index()].free(*table, *entry);
        }
        self.clear_budget(channel);
        entries.into_iter().map(|(table, _, slot)| table.tag() + u32::from(slot)).collect()
    }

    /// Stops what it has sent on its own, because it has said nothing for this long. It learns of it if it is still there.
    pub(super) fn stop_entries(&self, after: Duration) {
        let mut has_stopped = false;
        for channel in Channel::ALL {
            let setup = self.setup();
            let tags = self.clear_entries(channel);
            drop(setup);
            let mut state = self.shared.state();
            for tag in tags {
                has_stopped = true;
                let ended = Event::TransmitFailed { channel, tag, reason: TransmitFailure::Aborted };
                let owner = Some(Owner { client: self.id, tag });
                let ended = Entry { owner, ..Entry::event(state.latest_ticks, ended) };
                state.deliver(&mut vec![ended]);
            }
        }
        if has_stopped {
            self.shared.tell(News::DeadMan { client: self.name.clone(), after });
        }
    }

    pub(super) fn set_periodic(
        &self,
        channel: Channel,
        slot: u8,
        entry: Option<Periodic>,
    ) -> Result<Reply, Refusal> {
        let tick_hz = self.with(|state, _| state.hello.as_ref().map_or(0, |hello| hello.tick_hz));
        let (mut had, mut has_stopped) = (None, false);
        if let Some(entry) = &entry {
            // The first frame leaves at once, however long the period is.
            self.may_transmit_on(channel)?;
            let rate = f64::from(tick_hz) / f64::from(entry.period_ticks.max(1));
            self.must_be_permitted(Role::Send, |permit, _| permit.send(entry.frame.id()))?;
            has_stopped = self.take_first_of_entry(channel, slot, rate)?;
            self.must_be_permitted(Role::Send, |permit, _| {
                let Some(most) = permit.frames_per_second else { return Ok(()) };
                let (of, now) = ((self.holder(), channel, slot), Instant::now());
                had =
                    lock(&self.budget).set_periodic(of, rate, most, now).map_err(|()| Denied::Rate(most))?;
                Ok(())
            })?;
        }
        let noted = entry.as_ref().map(|entry| {
            let period_ms = f64::from(entry.period_ticks) * 1e3 / f64::from(tick_hz.max(1));
            json!({ "periodic": slot, "frame": entry.frame.to_string(), "period_ms": period_ms })
        });
        let is_cleared = entry.is_none();
        let command = |slot, entry| Command::SetPeriodic { channel, slot, entry };
        let slots = self.with(|state, _| state.hello.as_ref().map_or(0, |hello| hello.periodic_slots));
        let result = self.set_entry(Table::Periodic, channel, slot, slots, entry, command);
        if result.is_err() != is_cleared
            && let Some(most) = self.frames_per_second()
        {
            // What was refused has changed nothing: an entry that was there goes on, unless it was stopped.
            let had = had.filter(|_| !has_stopped);
            lock(&self.budget).has_periodic((self.holder(), channel, slot), had, most, Instant::now());
        }
        if result.is_ok() {
            let event = if is_cleared { "cleared" } else { "set" };
            self.note(event, channel, || noted.unwrap_or_else(|| json!({ "periodic": slot })));
        }
        result
    }

    pub(super) fn set_trigger(
        &self,
        channel: Channel,
        slot: u8,
        entry: Option<Trigger>,
    ) -> Result<Reply, Refusal> {
        if let Some(entry) = &entry {
            self.must_be_permitted(Role::Send, |permit, _| {
                permit.send(entry.reply.id())?;
                permit.frames_per_second.map_or(Ok(()), |most| Err(Denied::Replies(most)))
            })?;
        }
        let noted = entry.as_ref().map(|entry| json!({ "reply": slot, "frame": entry.reply.to_string() }));
        let command = |slot, entry| Command::SetTrigger { channel, slot, entry };
        let slots = self.with(|state, _| state.hello.as_ref().map_or(0, |hello| hello.trigger_slots));
        let result = self.set_entry(Table::Triggers, channel, slot, slots, entry, command);
        if result.is_ok() {
            let event = if noted.is_none() { "cleared" } else { "set" };
            self.note(event, channel, || noted.unwrap_or_else(|| json!({ "reply": slot })));
        }
        result
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
        // All of the board's entries are in use, including those of other clients.
        let taken = taken.ok_or(Refusal::QueueFull { free: 0 })?;
        let result = self.shared.ask(command(taken, Some(entry)), Then::Nothing);
        if result.is_err() && had.is_none() {
            self.shared.state().entries[channel.index()].free(table, taken);
        }
        result
    }
}
