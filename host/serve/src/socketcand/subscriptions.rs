//! What a client in BCM mode receives: each identifier as it subscribed to it, like Linux's broadcast manager.

use std::collections::HashMap;

use cantap_wire::{Frame, Id};

/// Which frames of an identifier are passed on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// All.
    All,
    /// When bits change that are set in this mask.
    Changes([u8; 8]),
    /// The same for each value of a multiplexer: its mask, then values and masks.
    Multiplexed([u8; 8], Vec<[u8; 8]>),
}

/// One identifier.
struct Subscription {
    wanted: Wanted,
    /// Minimum time between two frames in nanoseconds.
    interval_ns: i64,
    told_ns: Option<i64>,
    /// The last data for each value of the multiplexer; a single one without a multiplexer.
    last: Vec<Option<[u8; 8]>>,
    /// The latest frame held back by the interval.
    held: Option<(i64, Frame)>,
}

/// All subscriptions of a client.
#[derive(Default)]
pub struct Subscriptions {
    by_id: HashMap<Id, Subscription>,
}

/// Limit for a client's subscriptions: as many as there are standard identifiers, and more.
pub const MOST: usize = 4096;

impl Subscriptions {
    /// Adds one, or replaces the one with the same identifier. Returns whether there is room.
    pub fn add(&mut self, id: Id, wanted: Wanted, interval_us: u64) -> bool {
        if self.by_id.len() >= MOST && !self.by_id.contains_key(&id) {
            return false;
        }
        let values = if let Wanted::Multiplexed(_, values) = &wanted { values.len() } else { 1 };
        let interval_ns = i64::try_from(interval_us.saturating_mul(1000)).unwrap_or(i64::MAX);
        let subscription =
            Subscription { wanted, interval_ns, told_ns: None, last: vec![None; values], held: None };
        self.by_id.insert(id, subscription);
        true
    }

    pub fn remove(&mut self, id: Id) {
        self.by_id.remove(&id);
    }

    pub fn clear(&mut self) {
        self.by_id.clear();
    }

    /// Takes a frame. Returns it if it should be passed on now.
    pub fn take(&mut self, time_ns: i64, frame: &Frame) -> Option<(i64, Frame)> {
        let subscription = self.by_id.get_mut(&frame.id())?;
        if frame.is_remote() {
            // It has no content to compare.
            return (subscription.wanted == Wanted::All).then_some((time_ns, *frame));
        }
        if !subscription.changes(frame.padded_data()) {
            return None;
        }
        let is_early =
            subscription.told_ns.is_some_and(|told| time_ns.saturating_sub(told) < subscription.interval_ns);
        if is_early {
            subscription.held = Some((time_ns, *frame));
            return None;
        }
        subscription.told_ns = Some(time_ns);
        subscription.held = None;
        Some((time_ns, *frame))
    }

    /// What has been held back long enough, at a time in the stream.
    pub fn ripe(&mut self, now_ns: i64) -> Vec<(i64, Frame)> {
        let mut ripe = Vec::new();
        for subscription in self.by_id.values_mut() {
            let is_over = subscription
                .told_ns
                .is_none_or(|told| now_ns.saturating_sub(told) >= subscription.interval_ns);
            if is_over && let Some(held) = subscription.held.take() {
                subscription.told_ns = Some(now_ns);
                ripe.push(held);
            }
        }
        ripe.sort_by_key(|(time_ns, _)| *time_ns);
        ripe
    }
}

impl Subscription {
    /// Whether the masked data differ from before.
    fn changes(&mut self, data: [u8; 8]) -> bool {
        let (place, mask) = match &self.wanted {
            Wanted::All => return true,
            Wanted::Changes(mask) => (0, *mask),
            Wanted::Multiplexed(selector, values) => {
                let selects = |value: &[u8; 8]| masked(*value, *selector) == masked(data, *selector);
                let Some(place) = values.iter().position(selects) else { return false };
                // The multiplexer's own bits are not compared.
                let bits = std::array::from_fn(|at| values[place][at] & !selector[at]);
                (place, bits)
            }
        };
        let now = masked(data, mask);
        self.last[place].replace(now) != Some(now)
    }
}

fn masked(data: [u8; 8], mask: [u8; 8]) -> [u8; 8] {
    std::array::from_fn(|at| data[at] & mask[at])
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: u32 = 0x123;

    fn passed_on(subscriptions: &mut Subscriptions, frames: &[(i64, &str)]) -> Vec<i64> {
        let take = |(ms, text): &(i64, &str)| {
            subscriptions.take(ms * 1_000_000, &text.parse().unwrap()).map(|(time_ns, _)| time_ns / 1_000_000)
        };
        frames.iter().filter_map(take).collect()
    }

    #[test]
    fn a_filter_tells_changes_of_the_bits_that_count() {
        let mut all = Subscriptions::default();
        all.add(Id::standard(ID).unwrap(), Wanted::Changes([0xF0, 0, 0, 0, 0, 0, 0, 0]), 0);
        let frames =
            [(1, "123#11"), (2, "123#12"), (3, "123#21FF"), (4, "124#33"), (5, "00000123#44"), (6, "123#11")];
        assert_eq!(passed_on(&mut all, &frames), [1, 3, 6]);
    }

    #[test]
    fn a_multiplexer_s_values_change_for_themselves() {
        let mut all = Subscriptions::default();
        let selector = [0xFF, 0, 0, 0, 0, 0, 0, 0];
        let values = vec![[0x33, 0xFF, 0, 0, 0, 0, 0, 0], [0x56, 0, 0xFF, 0, 0, 0, 0, 0]];
        all.add(Id::standard(ID).unwrap(), Wanted::Multiplexed(selector, values), 0);
        let frames = [
            (1, "123#330100"),
            (2, "123#560100"),
            (3, "123#330101"),
            (4, "123#560200"),
            (5, "123#560201"),
            (6, "123#440000"),
            (7, "123#330201"),
        ];
        assert_eq!(passed_on(&mut all, &frames), [1, 2, 5, 7]);
    }

    #[test]
    fn an_interval_tells_the_latest_when_it_is_over() {
        let mut all = Subscriptions::default();
        all.add(Id::standard(ID).unwrap(), Wanted::All, 10_000);
        assert_eq!(passed_on(&mut all, &[(1, "123#01"), (2, "123#02"), (5, "123#03")]), [1]);
        assert!(all.ripe(10_000_000).is_empty());
        assert_eq!(all.ripe(11_000_000), [(5_000_000, "123#03".parse().unwrap())]);
        assert!(all.ripe(40_000_000).is_empty());
        all.remove(Id::standard(ID).unwrap());
        assert_eq!(passed_on(&mut all, &[(90, "123#01")]), [0_i64; 0]);
    }
}
