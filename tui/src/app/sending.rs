//! The send list: frames sent by key, or periodically by the device itself.

use super::super::order::Order;
use super::entry::SendEntry;
use super::line::{Line, Prompt, PromptKind};
use super::state::App;

impl App {
    /// Whether frames can be sent; shows a message if not.
    fn can_send(&mut self) -> bool {
        let reason = match &self.plan {
            None => "a file sends nothing; open a device with D",
            Some(plan) if !plan.mode().transmits() => {
                "listen-only: nothing is sent; press m to take part in the bus"
            }
            Some(_) => return true,
        };
        reason.clone_into(&mut self.message);
        false
    }

    pub(super) fn send_once(&mut self) {
        if !self.can_send() {
            return;
        }
        if let Some(entry) = self.send.get_mut(self.selected) {
            entry.sent += 1;
            let order = Order::Send(entry.channel, entry.frame);
            self.order(order);
        }
    }

    pub(super) fn toggle_sending(&mut self) {
        if !self.can_send() {
            return;
        }
        match self.send.get(self.selected) {
            None => {}
            Some(entry) if entry.period.is_none() => self.send_once(),
            Some(entry) if entry.slot.is_some() => self.stop_periodic(self.selected),
            Some(_) => self.start_periodic(self.selected),
        }
    }

    /// Has the device send an entry periodically, in a separate slot.
    fn start_periodic(&mut self, place: usize) {
        let Some(SendEntry { channel, frame, period: Some(period), .. }) = self.send.get(place).cloned()
        else {
            return;
        };
        let in_use =
            |slot| self.send.iter().any(|entry| (entry.channel, entry.slot) == (channel, Some(slot)));
        let Some(slot) = (0..=u8::MAX).find(|slot| !in_use(*slot)) else {
            "no device sends more frames periodically; stop another one".clone_into(&mut self.message);
            return;
        };
        self.send[place].slot = Some(slot);
        self.order(Order::SetPeriodic(channel, slot, Some((frame, period))));
    }

    fn stop_periodic(&mut self, place: usize) {
        if let Some(entry) = self.send.get_mut(place)
            && let Some(slot) = entry.slot.take()
        {
            let order = Order::SetPeriodic(entry.channel, slot, None);
            self.order(order);
        }
    }

    /// Puts an entry in its place; if it is being sent periodically, that continues with the new one.
    pub(super) fn put_entry(&mut self, place: Option<usize>, entry: SendEntry) {
        let Some(place) = place.filter(|place| *place < self.send.len()) else {
            self.send.push(entry);
            return;
        };
        let (was_on, sent) = (self.send[place].slot.is_some(), self.send[place].sent);
        self.stop_periodic(place);
        self.send[place] = SendEntry { sent, ..entry };
        if was_on {
            self.start_periodic(place);
        }
    }

    pub(super) fn edit_entry(&mut self) {
        if let Some(entry) = self.send.get(self.selected) {
            let line = Line::new(&entry.text);
            self.prompt = Some(Prompt { kind: PromptKind::Send, line, entry: Some(self.selected) });
        }
    }

    pub(super) fn delete_entry(&mut self) {
        if self.selected < self.send.len() {
            self.stop_periodic(self.selected);
            self.send.remove(self.selected);
        }
    }
}
