//! How many frames a client may have sent: as many per second as its permissions say, of which its periodic entries take their share.

use std::collections::HashMap;
use std::time::Instant;

use cantap_wire::Channel;
use cantap_wire::message::MAX_SEND;

/// What is left.
#[derive(Default)]
pub struct Budget {
    /// Frames, and when there were so many.
    left: Option<(f64, Instant)>,
    /// Frames per second of each periodic entry, by its channel and slot.
    periodic: HashMap<(usize, u8), f64>,
}

impl Budget {
    /// Takes frames out, if there are enough. What is not used is kept for a second, or for one request.
    pub fn take(&mut self, frames: usize, per_second: u32, now: Instant) -> bool {
        let rate = (f64::from(per_second) - self.periodic.values().sum::<f64>()).max(0.0);
        let most = rate.max(if rate > 0.0 { MAX_SEND as f64 } else { 0.0 });
        let left = self.left.map_or(most, |(left, at)| {
            (left + rate * now.saturating_duration_since(at).as_secs_f64()).min(most)
        });
        let is_enough = left >= frames as f64;
        self.left = Some((if is_enough { left - frames as f64 } else { left }, now));
        is_enough
    }

    /// Sets the share of a periodic entry, if it fits.
    pub fn set_periodic(&mut self, channel: Channel, slot: u8, rate: f64, per_second: u32) -> bool {
        let key = (channel.index(), slot);
        let others: f64 = self.periodic.iter().filter(|(at, _)| **at != key).map(|(_, rate)| rate).sum();
        let fits = others + rate <= f64::from(per_second);
        if fits {
            self.periodic.insert(key, rate);
        }
        fits
    }

    /// A periodic entry is gone.
    pub fn clear_periodic(&mut self, channel: Channel, slot: u8) {
        self.periodic.remove(&(channel.index(), slot));
    }

    /// All of a channel's are gone.
    pub fn clear(&mut self, channel: Channel) {
        self.periodic.retain(|(at, _), _| *at != channel.index());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

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
        // Half of it is taken by a periodic entry, and no second one fits.
        assert!(budget.set_periodic(Channel::Can1, 0, 50.0, 100));
        assert!(!budget.set_periodic(Channel::Can2, 0, 51.0, 100));
        assert!(budget.set_periodic(Channel::Can1, 0, 60.0, 100), "its own share is replaced");
        let began = began + Duration::from_secs(100);
        let sent: usize =
            (0..10_000).map(|ms| usize::from(budget.take(1, 100, began + Duration::from_millis(ms)))).sum();
        assert!((435..=440).contains(&sent), "{sent}");
        assert!(budget.set_periodic(Channel::Can2, 0, 40.0, 100));
        assert!(!budget.take(1, 100, began + Duration::from_secs(1000)));
        budget.clear(Channel::Can1);
        assert!(budget.take(1, 100, began + Duration::from_secs(2000)));
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
