//! The level of a bus over time: what a receive pin shows and no controller register reveals.

use std::collections::VecDeque;

use super::bits::FrameBits;
use super::node::BitTime;
use super::outcome::{FLAG, FrameEnd, Participant};

/// A change of the bus's level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// Core cycle.
    pub at: u64,
    /// The level after it.
    pub dominant: bool,
}

/// The edges to come, and the level before them.
#[derive(Debug, Default)]
pub struct Waveform {
    edges: VecDeque<Edge>,
    dominant: bool,
    /// Core cycles by which edges to recessive are late: a bus is actively driven dominant, but only drifts back to recessive.
    pub(super) slow_recessive: u64,
}

impl Waveform {
    /// The next edge, whether its time has come or not.
    pub fn next(&self) -> Option<Edge> {
        self.edges.front().copied()
    }

    /// Takes the next edge whose time has come.
    pub fn pass(&mut self, now: u64) -> Option<Edge> {
        let edge = self.edges.pop_front_if(|edge| edge.at <= now)?;
        self.dominant = edge.dominant;
        Some(edge)
    }

    /// Fixes the level from now on, in place of all pending edges.
    pub(super) fn hold(&mut self, now: u64, dominant: bool) {
        while self.edges.back().is_some_and(|edge| edge.at > now) {
            self.edges.pop_back();
        }
        self.push(now, dominant);
    }

    /// Adds the edges that a frame puts on the bus if it starts at `start` and ends like this.
    pub(super) fn frame(
        &mut self,
        start: u64,
        bit: BitTime,
        bits: &FrameBits,
        participants: &[Participant],
        outcome: &FrameEnd,
    ) {
        for (n, dominant) in levels(bits, participants, outcome).enumerate() {
            let at = start + bit.cycles(n as u64);
            self.push(if dominant { at } else { at + self.slow_recessive }, dominant);
        }
    }

    /// Puts other edges in place of all after `now`: those of these times at which the bus is dominant, in any order. The end of a time
    /// may be unknown.
    pub(super) fn redraw(&mut self, now: u64, mut dominant: Vec<(u64, Option<u64>)>) {
        dominant.sort_unstable();
        let mut merged: Vec<(u64, Option<u64>)> = Vec::with_capacity(dominant.len());
        for (from, to) in dominant {
            match merged.last_mut() {
                Some((_, end)) if end.is_none_or(|end| from <= end) => {
                    *end = end.and_then(|end| to.map(|to| to.max(end)));
                }
                _ => merged.push((from, to)),
            }
        }
        let is_dominant = merged.iter().any(|(from, to)| *from <= now && to.is_none_or(|to| to > now));
        self.hold(now, is_dominant);
        for (from, to) in merged {
            if from > now {
                self.push(from, true);
            }
            if let Some(to) = to.filter(|to| *to > now) {
                self.push(to + self.slow_recessive, false);
            }
        }
    }

    fn push(&mut self, at: u64, dominant: bool) {
        if dominant != self.edges.back().map_or(self.dominant, |edge| edge.dominant) {
            self.edges.push_back(Edge { at, dominant });
        }
    }
}

/// Whether each bit is dominant, from the start of frame until the bus is free. The first participant is the sender.
fn levels<'a>(
    bits: &'a FrameBits,
    participants: &'a [Participant],
    outcome: &'a FrameEnd,
) -> impl Iterator<Item = bool> + use<'a> {
    let given_up = outcome.of_participant(0).map_or(bits.len(), |detection| detection.bit + 1);
    let flags = move |n: usize| {
        let mut flags = outcome.detections.iter().filter(|detection| participants[detection.who].flags);
        flags.any(|detection| (detection.bit + 1..=detection.bit + FLAG).contains(&n))
    };
    let acknowledged = !outcome.acknowledged_by.is_empty();
    (0..=outcome.free_after.max(bits.len())).map(move |n| {
        let sent = n < given_up && bits.levels().get(n) == Some(&false);
        sent || acknowledged && n == bits.ack_slot() || flags(n)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cantap_can::BusErrorKind;

    const BIT: u64 = 144;

    fn wave(outcome: &FrameEnd, participants: &[Participant], slow_recessive: u64) -> Vec<(u64, bool)> {
        let bits = FrameBits::new(&"123#1122".parse().unwrap());
        let mut wave = Waveform { slow_recessive, ..Waveform::default() };
        wave.frame(1000, BitTime::of_cycles(BIT), &bits, participants, outcome);
        std::iter::from_fn(|| wave.pass(u64::MAX)).map(|edge| (edge.at - 1000, edge.dominant)).collect()
    }

    const SENDER: Participant = Participant { sender: true, acknowledges: true, flags: true, own: None };
    const RECEIVER: Participant = Participant { sender: false, acknowledges: true, flags: true, own: None };

    #[test]
    fn a_frame_s_edges_are_its_bits_with_the_acknowledgement() {
        let bits = FrameBits::new(&"123#1122".parse().unwrap());
        let participants = [SENDER, RECEIVER];
        let outcome = FrameEnd::of(&bits, &participants, None);
        let mut expected = bits.levels().to_vec();
        expected[bits.ack_slot()] = false;
        let edges = wave(&outcome, &participants, 10);
        let mut levels = vec![true; bits.len()];
        for (at, dominant) in &edges {
            let at = if *dominant { *at } else { *at - 10 };
            assert_eq!(at % BIT, 0);
            levels[(at / BIT) as usize..].fill(!dominant);
        }
        assert_eq!(levels, expected);
        assert_eq!(edges.first(), Some(&(0, true)));
    }

    #[test]
    fn an_error_flag_is_six_dominant_bits_and_more_where_others_answer() {
        let bits = FrameBits::new(&"123#1122".parse().unwrap());
        let confused = Participant { own: Some((20, BusErrorKind::Stuff)), ..RECEIVER };
        let participants = [SENDER, confused];
        let outcome = FrameEnd::of(&bits, &participants, None);
        let edges = wave(&outcome, &participants, 0);
        let (last, dominant) = edges[edges.len() - 1];
        assert!(!dominant);
        assert_eq!(last, outcome.recessive_from as u64 * BIT);
        let flag = last - edges[edges.len() - 2].0;
        assert!((6 * BIT..=12 * BIT).contains(&flag), "{flag}");
    }
}
