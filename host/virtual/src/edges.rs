//! Measures receive pins: what the board's interrupt does, without its timing constraints.

use std::collections::VecDeque;

use cantap_firmware::ports::{EDGES_KEPT, EdgeMeter, PinEdge};
use cantap_wire::Channel;

/// The meter.
#[derive(Default)]
pub struct VirtualMeter {
    watched: Option<Channel>,
    kept: VecDeque<PinEdge>,
    /// There was no room, and nothing is recorded until there is.
    full: bool,
    blind: bool,
    dominant: bool,
}

impl VirtualMeter {
    /// The channel whose pin is watched.
    pub const fn watched(&self) -> Option<Channel> {
        self.watched
    }

    /// The level of the watched pin changed.
    pub fn edge(&mut self, at: u32, dominant: bool) {
        self.dominant = dominant;
        if self.kept.len() >= EDGES_KEPT {
            self.full = true;
        }
        if self.full {
            self.blind = true;
        } else {
            self.kept.push_back(PinEdge { at, dominant, unsure: std::mem::take(&mut self.blind) });
        }
    }
}

impl EdgeMeter for VirtualMeter {
    fn watch(&mut self, channel: Option<Channel>) {
        *self = Self { watched: channel, ..Self::default() };
    }

    fn next(&mut self) -> Option<PinEdge> {
        let edge = self.kept.pop_front();
        self.full &= !self.kept.is_empty();
        edge
    }

    fn is_dominant(&self) -> bool {
        self.dominant
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_meter_that_is_full_is_blind_until_it_is_emptied_and_says_so() {
        let mut meter = VirtualMeter::default();
        meter.watch(Some(Channel::Can2));
        for at in 0..EDGES_KEPT as u32 + 2 {
            meter.edge(at, at % 2 == 0);
        }
        let first: Vec<PinEdge> = std::iter::from_fn(|| meter.next()).collect();
        assert_eq!(first.len(), EDGES_KEPT);
        assert!(first.iter().all(|edge| !edge.unsure));
        meter.edge(1000, true);
        meter.edge(1001, false);
        assert_eq!(meter.next(), Some(PinEdge { at: 1000, dominant: true, unsure: true }));
        assert_eq!(meter.next(), Some(PinEdge { at: 1001, dominant: false, unsure: false }));
    }
}
