//! Frames that are sent again and again: by the device where it can, or else from here.

use std::time::Duration;

use cantap::periodic;
use cantap::wire::message::{Filter, Periodic, Trigger};
use cantap_can::{Channel, Frame};

use super::repeat::Repeat;
use super::run::LiveRun;
use super::settings::LiveError;
use crate::placement::{Runner, Statement};

impl LiveRun<'_> {
    pub(super) fn repeat_of(
        &mut self,
        place: usize,
        (handle, channel): (u32, Channel),
        frame: Frame,
        period_ns: u64,
    ) -> Result<(), LiveError> {
        let index = channel.index();
        let used: Vec<u8> =
            self.slots.iter().filter(|((of, _, _), _)| *of == index).map(|(_, slot)| *slot).collect();
        let known = self.slots.get(&(index, place, handle)).copied();
        let period_ticks = periodic::period_ticks(Duration::from_nanos(period_ns), self.tick_hz).ok();
        let is_of_device = period_ticks.is_some()
            && Statement::Periodic.place(self.target, used.len()).runner == Runner::Device;
        // From the last one down: whoever shares the session takes them from the first one up.
        let free = || {
            let mut slots = (0..self.periodic_slots).rev();
            slots.find(|slot| is_of_device && !used.contains(slot) && self.port.claim(channel, *slot))
        };
        let slot = known.or_else(free);
        let (Some(slot), Some(period_ticks)) = (slot, period_ticks) else {
            self.repeat_from_here((place, handle), channel, frame, period_ns);
            return Ok(());
        };
        let entry = Periodic { frame, period_ticks, count: 0, modifiers: heapless::Vec::new() };
        self.port.set_periodic(place, channel, slot, Some(entry))?;
        self.repeated.insert((index, slot), place);
        self.slots.insert((index, place, handle), slot);
        Ok(())
    }

    fn repeat_from_here(&mut self, of: (usize, u32), channel: Channel, frame: Frame, period_ns: u64) {
        match self.repeats.iter_mut().find(|repeat| repeat.of == of && repeat.channel == channel) {
            Some(repeat) => (repeat.frame, repeat.period_ns) = (frame, period_ns),
            None => self.repeats.push(Repeat {
                of,
                channel,
                frame,
                period_ns: period_ns.max(1),
                due_ns: self.now_ns,
            }),
        }
    }

    /// Sends the frames that are due from here; what was due while nothing could be sent is left out.
    pub(super) fn send_repeated(&mut self) -> Result<(), LiveError> {
        let now_ns = self.now_ns;
        let mut due = Vec::new();
        for repeat in self.repeats.iter_mut().filter(|repeat| repeat.due_ns <= now_ns) {
            let periods = (now_ns - repeat.due_ns) / repeat.period_ns + 1;
            repeat.due_ns += periods * repeat.period_ns;
            due.push((repeat.of.0, (repeat.channel, repeat.frame)));
        }
        due.into_iter().try_for_each(|(place, frame)| self.send_of(place, frame, false))
    }

    /// A reply of the device, for a script.
    pub(super) fn set_reply(
        &mut self,
        place: usize,
        (channel, slot): (Channel, u8),
        entry: Option<(Filter, Frame)>,
    ) -> Result<(), LiveError> {
        let key = (channel.index(), slot);
        if entry.is_some() {
            self.replies.insert(key, place);
            self.replied.insert(key, place);
        } else {
            self.replies.remove(&key);
        }
        let entry = entry.map(|(filter, reply)| Trigger { filter, reply, count: 0 });
        self.port.set_reply(channel, slot, entry)
    }

    /// The device does not reply any more for scripts that have ended.
    pub(super) fn end_replies(&mut self, is_meant: impl Fn(usize) -> bool) -> Result<(), LiveError> {
        let meant = self.replies.extract_if(.., |_, place| is_meant(*place)).map(|(key, _)| key);
        let meant: Vec<(usize, u8)> = meant.collect();
        meant
            .into_iter()
            .try_for_each(|(channel, slot)| self.port.set_reply(Channel::ALL[channel], slot, None))
    }

    /// Ends everything that the device does for scripts, as far as it is still there.
    pub(super) fn end_all(&mut self) {
        let _ = self.end_replies(|_| true);
        let _ = self.end_repeats(|_, _| true);
    }

    pub(super) fn end_repeats(&mut self, is_meant: impl Fn(usize, u32) -> bool) -> Result<(), LiveError> {
        self.repeats.retain(|repeat| !is_meant(repeat.of.0, repeat.of.1));
        let meant: Vec<(usize, usize, u32)> =
            self.slots.keys().filter(|(_, place, handle)| is_meant(*place, *handle)).copied().collect();
        for key in meant {
            if let Some(slot) = self.slots.remove(&key) {
                self.port.set_periodic(key.1, Channel::ALL[key.0], slot, None)?;
            }
        }
        Ok(())
    }
}
