//! How many frames a certificate's clients may have sent: as many per second as its permissions say, of which periodic entries take their
//! share. All its connections, to whichever board, draw on one budget, which goes on when they leave: whoever connects twice or again
//! gets no more.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cantap_wire::Channel;
use cantap_wire::message::MAX_SEND;

use crate::stream::ClientId;

/// A client: the number of its board's first channel, and its own there.
pub type Holder = (usize, ClientId);
/// A client's periodic entry: the channel's place and the slot.
type Key = (Holder, usize, u8);

/// By certificates. The boards of a server have them in common.
pub type Budgets = Arc<Mutex<HashMap<String, Arc<Mutex<Budget>>>>>;

/// What is left.
#[derive(Debug, Default)]
pub struct Budget {
    /// Frames, and when there were so many.
    left: Option<(f64, Instant)>,
    /// Frames per second of each periodic entry.
    periodic: HashMap<Key, f64>,
}

impl Budget {
    /// Adds what has come since the last time, at the rate that periodic entries have left since then; returns what there is.
    fn settle(&mut self, per_second: u32, now: Instant) -> f64 {
        let rate = (f64::from(per_second) - self.periodic.values().sum::<f64>()).max(0.0);
        let most = if rate > 0.0 { rate.max(MAX_SEND as f64) } else { 0.0 };
        let left = self.left.map_or(most, |(left, at)| {
            (left + rate * now.saturating_duration_since(at).as_secs_f64()).min(most)
        });
        // Whoever has waited for the lock may have looked at the clock before: no time is counted twice.
        self.left = Some((left, self.left.map_or(now, |(_, at)| at.max(now))));
        left
    }

    /// Takes frames out, if there are enough. What is not used is kept for a second, or for one request.
    pub fn take(&mut self, frames: usize, per_second: u32, now: Instant) -> bool {
        let left = self.settle(per_second, now);
        let is_enough = left >= frames as f64;
        if is_enough && let Some((left, _)) = &mut self.left {
            *left -= frames as f64;
        }
        is_enough
    }

    /// How long a periodic entry has to stop before one with this rate is set in its place, if it leaves nothing for the first frame of that: in
    /// this time its share pays for the frame. `None` if there is no such entry, if enough comes while it goes on, if it takes longer than
    /// `within`, or if the rate does not fit.
    pub fn pause_for(
        &mut self,
        (holder, channel, slot): (Holder, Channel, u8),
        rate: f64,
        per_second: u32,
        now: Instant,
        within: Duration,
    ) -> Option<Duration> {
        let left = self.settle(per_second, now);
        let key = (holder, channel.index(), slot);
        let share = *self.periodic.get(&key)?;
        let free = f64::from(per_second) - self.periodic.values().sum::<f64>();
        let pause = Duration::try_from_secs_f64((1.0 - left) / share).ok()?;
        let is_enough = left + free.max(0.0) * within.as_secs_f64() >= 1.0;
        if is_enough || pause > within || rate > free + share {
            return None;
        }
        self.left = Some((0.0, now));
        Some(pause)
    }

    /// Sets the share of a periodic entry, if it fits; returns the one that it had.
    ///
    /// # Errors
    ///
    /// If it does not fit.
    pub fn set_periodic(
        &mut self,
        (holder, channel, slot): (Holder, Channel, u8),
        rate: f64,
        per_second: u32,
        now: Instant,
    ) -> Result<Option<f64>, ()> {
        self.settle(per_second, now);
        let key = (holder, channel.index(), slot);
        let others: f64 = self.periodic.iter().filter(|(at, _)| **at != key).map(|(_, rate)| rate).sum();
        if others + rate > f64::from(per_second) {
            return Err(());
        }
        Ok(self.periodic.insert(key, rate))
    }

    /// A periodic entry has this share, because it is as it was, or gone.
    pub fn has_periodic(
        &mut self,
        (holder, channel, slot): (Holder, Channel, u8),
        rate: Option<f64>,
        per_second: u32,
        now: Instant,
    ) {
        self.settle(per_second, now);
        let key = (holder, channel.index(), slot);
        match rate {
            Some(rate) => self.periodic.insert(key, rate),
            None => self.periodic.remove(&key),
        };
    }

    /// All of a client's on a channel are gone.
    pub fn clear(&mut self, (holder, channel): (Holder, Channel), per_second: u32, now: Instant) {
        self.settle(per_second, now);
        self.periodic.retain(|(of, at, _), _| *of != holder || *at != channel.index());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: Holder = (0, 1);
    const TWO: Holder = (0, 2);

    #[test]
    fn so_many_frames_a_second_and_no_more_however_they_are_sent() {
        let mut budget = Budget::default();
        let began = Instant::now();
        let mut sent = 0;
        for ms in 0..10_000 {
            sent += usize::from(budget.take(1, 100, began + Duration::from_millis(ms)));
        }
        // A second in advance.
        assert!((1095..=1100).contains(&sent), "{sent}");
        // Half of it is taken by a periodic entry, and no second one fits, whoever of its clients wants it.
        let began = began + Duration::from_secs(10);
        assert_eq!(budget.set_periodic((ONE, Channel::Can1, 0), 50.0, 100, began), Ok(None));
        assert_eq!(budget.set_periodic((TWO, Channel::Can2, 0), 51.0, 100, began), Err(()));
        assert_eq!(budget.set_periodic((TWO, Channel::Can1, 0), 51.0, 100, began), Err(()));
        let replaced = budget.set_periodic((ONE, Channel::Can1, 0), 60.0, 100, began);
        assert_eq!(replaced, Ok(Some(50.0)), "its own share is replaced");
        let began = began + Duration::from_secs(100);
        let sent: usize =
            (0..10_000).map(|ms| usize::from(budget.take(1, 100, began + Duration::from_millis(ms)))).sum();
        assert!((435..=440).contains(&sent), "{sent}");
        let began = began + Duration::from_secs(1000);
        assert_eq!(budget.set_periodic((TWO, Channel::Can1, 0), 40.0, 100, began), Ok(None));
        assert!(!budget.take(1, 100, began + Duration::from_secs(1000)));
        budget.clear((ONE, Channel::Can1), 100, began + Duration::from_secs(1000));
        let sent: usize = (1_000_000..1_010_000)
            .map(|ms| usize::from(budget.take(1, 100, began + Duration::from_millis(ms))))
            .sum();
        assert!((595..=600).contains(&sent), "the other client's goes on: {sent}");
    }

    /// Two clients that look at the clock in one order and have their turns in the other are given no second twice.
    #[test]
    fn a_time_that_is_past_brings_nothing() {
        let mut budget = Budget::default();
        let began = Instant::now();
        while budget.take(1, 100, began) {}
        let later = began + Duration::from_millis(100);
        assert!(budget.take(10, 100, later));
        assert_eq!(budget.set_periodic((ONE, Channel::Can1, 0), 1.0, 100, began), Ok(None));
        assert!(!budget.take(1, 100, later));
    }

    /// While an entry had its share, nothing was saved up for afterwards.
    #[test]
    fn setting_and_clearing_an_entry_again_and_again_gives_no_more() {
        let mut budget = Budget::default();
        let mut now = Instant::now();
        while budget.take(1, 100, now) {}
        let mut sent = 0;
        for _ in 0..10 {
            budget.set_periodic((ONE, Channel::Can1, 0), 100.0, 100, now).unwrap();
            now += Duration::from_secs(1);
            budget.has_periodic((ONE, Channel::Can1, 0), None, 100, now);
            sent += (0..1000).filter(|_| budget.take(1, 100, now)).count();
        }
        assert_eq!(sent, 0);
    }

    /// An entry that takes the whole rate stops for as long as its share takes to pay for the first frame of the next one.
    #[test]
    fn an_entry_that_takes_the_whole_rate_is_set_anew_after_a_pause() {
        let (mut budget, now) = (Budget::default(), Instant::now());
        let (of, within) = ((ONE, Channel::Can1, 0), Duration::from_millis(800));
        while budget.take(1, 100, now) {}
        assert_eq!(budget.pause_for(of, 100.0, 100, now, within), None, "there is none yet");
        budget.set_periodic(of, 100.0, 100, now).unwrap();
        assert!(!budget.take(1, 100, now + within), "nothing comes while it goes on");
        assert_eq!(
            budget.pause_for(of, 101.0, 100, now, within),
            None,
            "what would be refused stops nothing"
        );
        let pause = Some(Duration::from_millis(10));
        assert_eq!(budget.pause_for(of, 100.0, 100, now, within), pause);
        assert_eq!(budget.pause_for(of, 100.0, 100, now + Duration::from_secs(9), within), pause);
        assert_eq!(budget.set_periodic(of, 90.0, 100, now), Ok(Some(100.0)));
        assert_eq!(budget.pause_for(of, 100.0, 100, now, within), None, "ten frames a second are left");
        // At one frame a second it takes too long: the entry goes on as it was.
        let mut slow = Budget::default();
        while slow.take(1, 1, now) {}
        slow.set_periodic(of, 1.0, 1, now).unwrap();
        assert_eq!(slow.pause_for(of, 1.0, 1, now, within), None);
    }

    #[test]
    fn a_whole_request_goes_through_at_the_lowest_rate() {
        let mut budget = Budget::default();
        let began = Instant::now();
        assert!(budget.take(MAX_SEND, 1, began));
        assert!(!budget.take(1, 1, began));
        assert!(budget.take(1, 1, began + Duration::from_secs(2)));
    }
}
