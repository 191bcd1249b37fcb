//! Messages of services that no standard names: one that is refused was a request.

use std::collections::VecDeque;

use crate::iso_tp::Transfer;

/// How many messages are kept.
const MOST: usize = 64;

/// The last one of each sender.
#[derive(Clone, Debug, Default)]
pub struct Unnamed(VecDeque<Transfer>);

impl Unnamed {
    pub fn keep(&mut self, transfer: Transfer) {
        self.0.retain(|before| (before.channel, before.from) != (transfer.channel, transfer.from));
        if self.0.len() == MOST {
            self.0.pop_front();
        }
        self.0.push_back(transfer);
    }

    /// Takes out the request for `sid` that this refuses, if it came at most so many nanoseconds before.
    pub fn take(&mut self, refusal: &Transfer, sid: u8, within_ns: i64) -> Option<Transfer> {
        let place = self.0.iter().rposition(|request| {
            request.channel == refusal.channel
                && request.data.first() == Some(&sid)
                && refusal.start_ns.saturating_sub(request.time_ns) <= within_ns
                && match request.to {
                    Some(to) => to == refusal.from,
                    None => request.from.id.is_extended() == refusal.from.id.is_extended(),
                }
        })?;
        self.0.remove(place)
    }

    /// Frames of this channel were lost.
    pub fn frames_lost(&mut self, channel: u8) {
        for request in self.0.iter_mut().filter(|request| request.channel == channel) {
            request.frames_lost = true;
        }
    }
}
