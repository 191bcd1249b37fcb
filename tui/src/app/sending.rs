//! The send list: frames sent by key, or periodically by the device itself.

use std::path::Path;

use cantap_trace::counted;

use super::super::model::Model;
use super::super::order::Order;
use super::entry::{SendEntry, parse_entry};
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

    /// Starts every entry of the selected one's group, or if all of them are on, stops them.
    pub(super) fn toggle_group(&mut self) {
        if !self.can_send() {
            return;
        }
        let Some(group) = self.send.get(self.selected).and_then(|entry| entry.group.clone()) else {
            "this entry is in no group; e adds one, as in 123#11 100ms group=engine"
                .clone_into(&mut self.message);
            return;
        };
        let is_of_it = |entry: &SendEntry| entry.group.as_ref() == Some(&group) && entry.period.is_some();
        let places: Vec<_> = (0..self.send.len()).filter(|place| is_of_it(&self.send[*place])).collect();
        let are_all_on = places.iter().all(|place| self.send[*place].slot.is_some());
        for place in places {
            match (are_all_on, self.send[place].slot) {
                (true, _) => self.stop_periodic(place),
                (false, None) => self.start_periodic(place),
                (false, Some(_)) => {}
            }
        }
    }

    /// Has the list written to a new file, a line for each entry, as [`Self::import_list`] reads it.
    pub(super) fn export_list(&mut self, path: &Path) {
        let text = self.send.iter().flat_map(|entry| [entry.text.as_str(), "\n"]).collect();
        self.order(Order::WriteList(path.to_owned(), text));
    }

    /// Adds the entries of a file: a line for each, `#` at the beginning of a line for a comment. If one of them is wrong, none is added.
    pub(super) fn import_list(&mut self, path: &Path, model: &Model) -> Result<(), String> {
        let text = std::fs::read(path).map_err(|error| format!("{}: {error}", path.display()))?;
        let text = String::from_utf8(text).map_err(|_| format!("{} is no text", path.display()))?;
        let lines = (1..).zip(text.lines()).map(|(number, line)| (number, line.trim()));
        let lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let entry = |(number, line): (u32, &str)| {
            parse_entry(line, model).map_err(|reason| format!("{}, line {number}: {reason}", path.display()))
        };
        let entries = lines.map(entry).collect::<Result<Vec<_>, _>>()?;
        self.message = format!("{} added; Space sends the selected one", counted(entries.len(), "entry"));
        self.send.extend(entries);
        Ok(())
    }

    /// Has the device send an entry periodically, in a separate slot.
    fn start_periodic(&mut self, place: usize) {
        let Some(entry) = self.send.get(place) else { return };
        let (channel, Some(repeated)) = (entry.channel, entry.repeated()) else { return };
        let is_free =
            |slot: &u8| !self.send.iter().any(|entry| (entry.channel, entry.slot) == (channel, Some(*slot)));
        // What this program hands over piece by piece takes none of the device's own slots.
        let slot = if repeated.changing.is_some() {
            (0..=u8::MAX).rev().find(is_free)
        } else {
            (0..=u8::MAX).find(is_free)
        };
        let Some(slot) = slot else {
            "no device sends more frames periodically; stop another one".clone_into(&mut self.message);
            return;
        };
        self.send[place].slot = Some(slot);
        self.order(Order::SetPeriodic(channel, slot, Some(repeated)));
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
