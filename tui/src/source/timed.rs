//! Periodic frames that a device does not repeat by itself, because their values change: they are handed over ahead of their times, which the device's
//! timer keeps.

use std::collections::BTreeMap;

use cantap::device::channel_number;
use cantap::wire::message::{MAX_SEND, Refusal, TxFrame};
use cantap::{Channel, Device, DeviceError, Frame};

use super::super::order::Repeated;
use cantap_work::advice;
use cantap_work::channels::place_of;

/// Frames are handed over this long before their time: longer than the source is usually busy with something else. A frame that is sent by key waits
/// behind them, since a channel has one queue.
const AHEAD_MS: u64 = 100;
/// From an entry's start to its first frame.
const LEAD_MS: u64 = 20;

/// What is sent this way, on all devices.
#[derive(Default)]
pub(super) struct Timed {
    entries: Vec<Entry>,
    /// When the last frame handed over is due, in ticks, by the channel's number: what is due before it would wait behind it.
    latest: BTreeMap<u8, u64>,
}

struct Entry {
    /// The channel's number and the slot, by which the display knows it.
    number: u8,
    slot: u8,
    repeated: Repeated,
    /// Between two frames, in ticks.
    period: u64,
    /// When its first frame is due, in ticks; `None` before it begins.
    first: Option<u64>,
    /// Its next frame's number, from 0.
    round: u32,
}

/// An entry that goes no further.
pub(super) struct Ended {
    pub number: u8,
    pub slot: u8,
    pub reason: String,
}

impl Timed {
    /// Starts an entry whose values change, or stops the one in this slot. Returns false for what is the device's own to repeat, or to stop.
    pub fn set(&mut self, number: u8, slot: u8, repeated: Option<&Repeated>) -> bool {
        let before = self.entries.len();
        self.entries.retain(|entry| (entry.number, entry.slot) != (number, slot));
        match repeated {
            Some(repeated) if repeated.changing.is_some() => {
                let repeated = repeated.clone();
                self.entries.push(Entry { number, slot, repeated, period: 0, first: None, round: 0 });
                true
            }
            Some(_) => false,
            None => self.entries.len() < before,
        }
    }

    /// A device's session has ended.
    pub fn forget(&mut self, board: usize) {
        self.entries.retain(|entry| place_of(entry.number).0 != board);
        self.latest.retain(|number, _| place_of(*number).0 != board);
    }

    /// Hands over what is due soon. Returns what goes no further.
    pub fn go_on(&mut self, board: usize, device: &Device) -> Vec<Ended> {
        let mut ended = Vec::new();
        for channel in Channel::ALL {
            let number = channel_number(board, channel);
            if !self.entries.iter().any(|entry| entry.number == number) {
                continue;
            }
            // If it does not answer, the stream reports that.
            let Ok(now) = device.time() else { return ended };
            if let Err(reason) = self.hand_over(number, channel, device, now) {
                let (of_channel, others) =
                    std::mem::take(&mut self.entries).into_iter().partition(|entry| entry.number == number);
                self.entries = others;
                let of_channel: Vec<Entry> = of_channel;
                ended.extend(of_channel.into_iter().map(|Entry { slot, .. }| Ended {
                    number,
                    slot,
                    reason: reason.clone(),
                }));
            }
        }
        ended
    }

    /// Hands over what is due soon on a channel, in the order of the times.
    fn hand_over(&mut self, number: u8, channel: Channel, device: &Device, now: u64) -> Result<(), String> {
        let tick_hz = u64::from(device.hello().tick_hz);
        let begin =
            (now + tick_hz * LEAD_MS / 1000).max(self.latest.get(&number).map_or(0, |latest| latest + 1));
        for entry in self.entries.iter_mut().filter(|entry| entry.number == number) {
            entry.begin(begin, tick_hz);
            entry.skip_to(now);
        }
        let until = now + tick_hz * AHEAD_MS / 1000;
        loop {
            let mut frames = heapless::Vec::<TxFrame, MAX_SEND>::new();
            // Taken back if the device has no room.
            let rounds: Vec<u32> = self.entries.iter().map(|entry| entry.round).collect();
            while !frames.is_full()
                && let Some(entry) = self.next(number)
                && entry.due() <= until
            {
                let (frame, due) = (entry.frame(number, tick_hz)?, entry.due());
                entry.round += 1;
                // Cannot fail: there is room.
                let _ = frames.push(TxFrame { tag: 0, frame, at_ticks: Some(due) });
            }
            let Some(last) = frames.last().and_then(|frame| frame.at_ticks) else { return Ok(()) };
            match device.send(channel, &frames) {
                Ok(_) => _ = self.latest.insert(number, last),
                Err(DeviceError::Refused { refusal: Refusal::QueueFull { .. }, .. }) => {
                    for (entry, round) in self.entries.iter_mut().zip(rounds) {
                        entry.round = round;
                    }
                    return Ok(());
                }
                Err(error) => return Err(advice::explained(&error)),
            }
        }
    }

    /// The entry of a channel whose frame is due first.
    fn next(&mut self, number: u8) -> Option<&mut Entry> {
        self.entries.iter_mut().filter(|entry| entry.number == number).min_by_key(|entry| entry.due())
    }
}

impl Entry {
    fn begin(&mut self, at: u64, tick_hz: u64) {
        if self.first.is_none() {
            let period = self.repeated.period.as_nanos() * u128::from(tick_hz) / 1_000_000_000;
            self.period = u64::try_from(period).unwrap_or(u64::MAX).max(1);
            self.first = Some(at);
        }
    }

    /// Leaves out what should have been sent before now, because this program stood still: a burst would make up for nothing.
    fn skip_to(&mut self, now: u64) {
        if self.due() < now {
            let rounds = (now - self.first.unwrap_or(now)) / self.period + 1;
            self.round = u32::try_from(rounds).unwrap_or(u32::MAX);
        }
    }

    fn due(&self) -> u64 {
        let after = u64::from(self.round).saturating_mul(self.period);
        self.first.map_or(u64::MAX, |first| first.saturating_add(after))
    }

    fn frame(&self, number: u8, tick_hz: u64) -> Result<Frame, String> {
        let Some((changing, decoder)) = &self.repeated.changing else { return Ok(self.repeated.frame) };
        let since_s = f64::from(self.round) * self.period as f64 / tick_hz as f64;
        changing.frame(decoder, Some(number), since_s, self.round).map_err(|error| error.to_string())
    }
}
