//! The send list: frames that go onto the bus by key, or periodically by the device itself.

use std::time::Duration;

use cantap::signals::encode;
use cantap::wire::message::Mode;
use cantap::{Channel, Frame};

use super::app::{App, Prompt, PromptKind};
use super::model::Model;
use super::source::Order;

/// A frame in the send list.
#[derive(Clone, Debug, PartialEq)]
pub struct SendEntry {
    /// As typed: a frame, or a message with its signals.
    pub text: String,
    /// Where to.
    pub channel: Channel,
    /// The frame.
    pub frame: Frame,
    /// How often; once per key without.
    pub period: Option<Duration>,
    /// Whether the device sends it now.
    pub on: bool,
    /// How often it was sent by key.
    pub sent: u64,
}

impl App {
    /// Between listen-only and normal.
    pub(super) fn toggle_mode(&mut self) {
        let Some(plan) = &mut self.plan else {
            "a file has no mode".clone_into(&mut self.message);
            return;
        };
        plan.mode = if plan.mode == Mode::ListenOnly { Mode::Normal } else { Mode::ListenOnly };
        let plan = plan.clone();
        self.send.iter_mut().for_each(|entry| entry.on = false);
        self.order(Order::Open(plan));
    }

    /// Whether frames can be sent; says why not.
    fn can_send(&mut self) -> bool {
        let reason = match &self.plan {
            None => "a file sends nothing; open a device with D",
            Some(plan) if !plan.mode.transmits() => {
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
        let Some(entry) = self.send.get_mut(self.selected) else {
            return;
        };
        if entry.period.is_none() {
            return self.send_once();
        }
        entry.on = !entry.on;
        self.order_periodic(self.selected);
    }

    fn order_periodic(&mut self, index: usize) {
        let Some(entry) = self.send.get(index) else {
            return;
        };
        let periodic = entry.period.filter(|_| entry.on).map(|period| (entry.frame, period));
        let order = Order::SetPeriodic(entry.channel, index as u8, periodic);
        self.order(order);
    }

    pub(super) fn put_entry(&mut self, place: Option<usize>, entry: SendEntry) {
        match place.and_then(|place| self.send.get_mut(place)) {
            Some(old) => {
                let was_on = old.on;
                *old = SendEntry { on: was_on && entry.period.is_some(), ..entry };
                if was_on {
                    self.order_periodic(place.unwrap_or_default());
                }
            }
            None => self.send.push(entry),
        }
    }

    pub(super) fn edit_entry(&mut self) {
        if let Some(entry) = self.send.get(self.selected) {
            self.prompt =
                Some(Prompt { kind: PromptKind::Send, text: entry.text.clone(), entry: Some(self.selected) });
        }
    }

    pub(super) fn delete_entry(&mut self) {
        if self.selected < self.send.len() {
            // Slots are by place, so all behind it move.
            let all_on: Vec<_> =
                (self.selected..self.send.len()).filter(|place| self.send[*place].on).collect();
            for place in all_on {
                let order = Order::SetPeriodic(self.send[place].channel, place as u8, None);
                self.order(order);
            }
            self.send.remove(self.selected);
            for place in self.selected..self.send.len() {
                if self.send[place].on {
                    self.order_periodic(place);
                }
            }
        }
    }
}

/// A line of the send list: `[CHANNEL:]FRAME [PERIOD]`, or a message with its signals in the frame's place.
pub fn parse_entry(text: &str, model: &Model) -> Result<SendEntry, String> {
    let (what, period) = match text.split_once(char::is_whitespace) {
        Some((what, period)) => (what, Some(crate::args::duration(period.trim())?)),
        None => (text, None),
    };
    if period.is_some_and(|period| period.is_zero()) {
        return Err("a period must be longer than nothing, such as 100ms".to_owned());
    }
    let (channel, what) = match what.split_once(':') {
        Some((number @ ("1" | "2"), what)) => (number.parse().ok().and_then(Channel::from_number), what),
        _ => (None, what),
    };
    let (frame, of_database) = if what.contains('#') {
        (what.parse::<Frame>().map_err(|error| error.to_string())?, None)
    } else {
        let number = channel.map(Channel::number);
        let encoded =
            encode::encode(model.signals.decoder(), number, what).map_err(|error| error.to_string())?;
        (encoded.frame, encoded.channel.and_then(Channel::from_number))
    };
    let channel = channel.or(of_database).unwrap_or(Channel::Can1);
    Ok(SendEntry { text: text.to_owned(), channel, frame, period, on: false, sent: 0 })
}
